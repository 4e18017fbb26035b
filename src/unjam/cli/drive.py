"""Episodes with drivers: `unjam drive` measures them, `watch` shows one, `assess` recommends or does not."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from unjam.cli.options import (
    DEFAULT_WORKERS,
    JsonOption,
    OutOption,
    RewardOption,
    ScenarioArgument,
    ScenarioSettingsOption,
    SeedOption,
    WorkersOption,
    merge_settings,
    network_changes,
    new_folder,
    parse_settings,
    scenario_changes,
    with_options,
)
from unjam.cli.output import (
    console,
    err_console,
    print_json,
    print_metrics,
    print_notes,
    report_steps,
    suggest_after_drive,
)
from unjam.errors import InputError, MissingPartError
from unjam.processes import has_display

if TYPE_CHECKING:
    from unjam.drivers.driver import Driver
    from unjam.scenarios.scenario import Scenario
    from unjam.worlds.record import Episode
from unjam.errors import invalid_value


@with_options(changes=scenario_changes)
def drive_command(
    *,
    scenario: ScenarioArgument,
    driver: Annotated[
        list[str] | None,
        typer.Option(
            "--driver",
            "-d",
            help="Who drives the CAVs: a name, name:parameter=value, your own path.py:name, a run folder, or "
            "a .unjam file; joined by + they share the CAVs. Given several times, they are compared on "
            "the same traffic.",
            show_default="human and unjam:best; on your own network CAVs then have ACCs, as in assess",
        ),
    ] = None,
    episodes: Annotated[int, typer.Option("--episodes", "-n", min=1, help="Number of episodes.")] = 5,
    seed: SeedOption = 0,
    test_seeds: Annotated[
        bool, typer.Option("--held-out", help="On the seeds that judge trainings, instead of --seed.")
    ] = False,
    changes: dict[str, Any],
    reward: RewardOption = "",
    settings: ScenarioSettingsOption = None,
    workers: WorkersOption = DEFAULT_WORKERS,
    out: OutOption = None,
    report: Annotated[bool, typer.Option(help="Write the results and a report.html into a folder.")] = True,
    json: JsonOption = False,
) -> None:
    """Run episodes with a driver: live progress, a table of metrics, a report.

    Examples:

      unjam drive ring --driver human

      unjam drive ring-warm --driver pi --length 230

      unjam drive ring-jammed -d human -d pi -d pi:time_constant=0 --episodes 10

      unjam drive ring --driver my_driver.py:gentle --json

      unjam drive my.sumocfg --cav-share 0.1

      unjam drive ring-jammed -d human -d pi --humans drivers.json

      unjam drive ring -d pi -d runs/ring-001 --held-out --episodes 20
    """
    from unjam.controller import DEFAULT_DRIVER
    from unjam.measures.effect import effects_by_driver
    from unjam.scenarios import make_scenario
    from unjam.scenarios.user_network import ACC_SETTINGS
    from unjam.training.evaluate import drive as run
    from unjam.training.evaluate import raise_failures

    changes = merge_settings(changes, parse_settings(settings))
    if out is not None and not report:
        raise InputError("out: it is not allowed with --no-report, which writes nothing")
    if not driver:
        driver = ["human", DEFAULT_DRIVER]
        changes = (ACC_SETTINGS if scenario.endswith(".sumocfg") else {}) | changes
    total = make_scenario(scenario, changes).horizon * episodes * len(driver)
    folder = new_folder(out, f"drive-{Path(scenario).stem}") if report else None
    with report_steps(f"driving {Path(scenario).name}", total) as steps:
        result = run(scenario, driver, episodes, seed, changes, reward, workers, folder, steps, test_seeds)
    if json:
        print_json(result.document())
    elif any(row["status"] != "failed" for rows in result.rows.values() for row in rows):
        print_metrics(result.rows)
        for label, effect in effects_by_driver(result.rows).items():
            if (count := effect.flow.count) == 0:
                continue
            seeds = f"{count} paired seed{'' if count == 1 else 's'}"
            words = f"{label} beside people alone, {seeds}: {effect.summary}"
            console.print(words, soft_wrap=True)
        print_notes(result.notes)
        if result.report is not None:
            err_console.print(f"report: {result.report}")
        suggest_after_drive(scenario, driver, changes, reward)
    raise_failures(result)


@with_options(changes=scenario_changes)
def watch_command(
    *,
    scenario: ScenarioArgument,
    drivers: Annotated[
        list[str], typer.Option("--driver", "-d", help="One, as in drive; a run folder shows its trained controller.")
    ],
    seed: SeedOption = 0,
    video: Annotated[
        Path | None, typer.Option(help="Write a film (.gif, .webp, .mp4) instead; needs no display.")
    ] = None,
    pace: Annotated[float, typer.Option(min=0.1, max=1000.0, help="Times as fast as life.")] = 10.0,
    changes: dict[str, Any],
    settings: ScenarioSettingsOption = None,
    json: JsonOption = False,
) -> None:
    """Watch an episode in SUMO's window, or write a film of it without a display.

    Examples:

      unjam watch ring --driver pi

      unjam watch ring-jammed --driver runs/ring-001 --video wave.mp4
    """
    from unjam.controller import make_driver
    from unjam.controller.domain import controller_notes
    from unjam.files import check_parent_folder
    from unjam.measures.metrics import measure
    from unjam.measures.notes import episode_notes
    from unjam.reports.video import check_video_format, write_video
    from unjam.scenarios import make_scenario, scenario_recipe
    from unjam.training.evaluate import raise_failure
    from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

    if len(drivers) > 1:
        raise invalid_value("driver", ", ".join(drivers), "one")
    (driver,) = drivers
    road = make_scenario(scenario, merge_settings(changes, parse_settings(settings)))
    driven = make_driver(driver, road.control_step)
    print_notes(controller_notes(scenario_recipe(road), [driver], {}))
    if video is None:
        episode = watch_in_window(road, driven, (seed,), pace)
    else:
        check_video_format(video)
        check_parent_folder(video)
        err_console.print("driving")
        with WorkerPool(1) as workers:
            episode = workers.run([EpisodeTask(road, driven, (seed,), record_details=True)])[0]
    row = measure(episode)
    print_notes(episode_notes({driver: [row]}))
    if episode.has_run and video is not None:
        err_console.print("drawing")
        write_video(episode, video, driver, pace)
    if json:
        film = str(video) if video else None
        print_json({"scenario": scenario, "driver": driver, "video": film, "episode": row})
    raise_failure([row])
    if not json and video is not None:
        console.print(str(video))


def watch_in_window(scenario: "Scenario", driver: "Driver", seed: Sequence[int], pace: float) -> "Episode":
    """Run an episode in SUMO's window, `pace` times as fast as life; return it.

    Raises:
        MissingPartError: there is no display.
    """
    from unjam.worlds.episode import run_episode
    from unjam.worlds.sumo.simulation import Simulation

    if not has_display():
        raise MissingPartError("watch: no display; write a film: --video FILE, or use xvfb-run unjam watch ...")
    delay = 1000.0 / pace  # [ms] for a second of simulation, however many steps it has
    options = ("--start", "true", "--quit-on-end", "true", "--delay", str(delay))
    with Simulation("gui", gui_options=options) as window:
        return run_episode(scenario, driver, seed, simulation=window)


@with_options(changes=network_changes)
def assess_command(
    *,
    scenario: Annotated[str, typer.Argument(help="Your own .sumocfg file.", metavar="FILE")],
    driver: Annotated[
        list[str] | None,
        typer.Option(
            "--driver",
            "-d",
            help="Controller of the CAVs, as in drive; given several times, the best of them is chosen.",
            show_default="unjam:best, follower-stopper, pi",
        ),
    ] = None,
    penetration_rates: Annotated[
        str, typer.Option(help="Penetration rates among the vehicles of --cav-classes.")
    ] = "0.02,0.05,0.1,0.2",
    episodes: Annotated[int, typer.Option("--episodes", "-n", min=1, help="Episodes in all, at most.")] = 400,
    minutes: Annotated[
        float | None, typer.Option(help="Minutes, at most; looked at between batches of episodes.")
    ] = None,
    precision: Annotated[
        float,
        typer.Option(
            help="Half-width of the confidence interval of travel time that is narrow enough, relative to it."
        ),
    ] = 0.02,
    settings: ScenarioSettingsOption = None,
    workers: WorkersOption = DEFAULT_WORKERS,
    out: OutOption = None,
    json: JsonOption = False,
    changes: dict[str, Any],
) -> None:
    """What would CAVs do on my road? Compare human drivers, ACC vehicles and controllers on equal seeds.

    For each penetration rate a controller is chosen on tuning seeds and tested on others. It is recommended
    only if travel time is shown to be shorter than with human drivers and than with ACC vehicles, flow is not
    lower, the CAVs are feasible, and human drivers do not brake hard more often.

    Examples:

      unjam assess my.sumocfg

      unjam assess my.sumocfg --shares 0.05,0.2 -d acc -d pi --minutes 30

      unjam assess my.sumocfg -d runs/my-001 --shares 0.1 --begin 28800 --end 32400 --json
    """
    from unjam.training.assess import DEFAULT_CONTROLLERS, make_request
    from unjam.training.assess import assess as run
    from unjam.training.run_folder import lock_new_folder
    from unjam.worlds.worker_pool import WorkerPool

    drivers, changes = driver or DEFAULT_CONTROLLERS, merge_settings(changes, parse_settings(settings))
    asked = make_request(scenario, _parse_rates(penetration_rates), episodes, precision, minutes, drivers, changes)
    folder = new_folder(out, f"assess-{Path(scenario).stem}")
    total = asked.network.horizon * episodes
    counting = report_steps("assessing, at most", total)
    with lock_new_folder(folder), counting as steps, WorkerPool(workers) as pool:
        found = run(asked, folder, pool, steps, (lambda line: None) if json else err_console.print)
    if json:
        print_json({**found.document, "folder": str(folder), "report": str(found.page)})
        return
    console.print(found.document["headline"], soft_wrap=True, markup=False)
    for each in (*found.controller_results, *found.acc_results):
        console.print(f"- {each.summary}", soft_wrap=True, markup=False)
    for note in found.document["notes"]:
        err_console.print(note, soft_wrap=True, markup=False)
    err_console.print(f"report: {found.page}", soft_wrap=True, markup=False)


def _parse_rates(text: str) -> list[float]:
    """Return the numbers of a list like 0.02,0.1."""
    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise invalid_value("shares", text, "numbers from 0 to 1, like 0.02,0.1") from None
