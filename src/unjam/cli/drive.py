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
    assignments,
    new_folder,
    people_changes,
    scenario_changes,
    together,
    with_options,
)
from unjam.cli.output import (
    after_drive,
    aside,
    console,
    counting_steps,
    print_json,
    print_metrics,
    print_notes,
)
from unjam.errors import InputError, MissingPartError
from unjam.processes import has_display

if TYPE_CHECKING:
    from unjam.drivers.driver import Driver
    from unjam.scenarios.scenario import Scenario
    from unjam.worlds.record import Episode
from unjam.errors import wrong


@with_options(changes=scenario_changes)
def drive(
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
    held_out: Annotated[
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
    from unjam.controller import BEST
    from unjam.measures.effect import beside_people
    from unjam.scenarios import make_scenario
    from unjam.scenarios.own_network import WITH_OWN_ACC
    from unjam.training.evaluate import drive as run
    from unjam.training.evaluate import raise_failures

    changes = together(changes, assignments(settings))
    if out is not None and not report:
        raise InputError("out: it is not allowed with --no-report, which writes nothing")
    if not driver:
        driver = ["human", BEST]
        changes = (WITH_OWN_ACC if scenario.endswith(".sumocfg") else {}) | changes
    total = make_scenario(scenario, changes).horizon * episodes * len(driver)
    folder = new_folder(out, f"drive-{Path(scenario).stem}") if report else None
    with counting_steps(f"driving {Path(scenario).name}", total) as steps:
        result = run(scenario, driver, episodes, seed, changes, reward, workers, folder, steps, held_out)
    if json:
        print_json(result.document())
    elif any(row["status"] != "failed" for rows in result.rows.values() for row in rows):
        print_metrics(result.rows)
        for label, effect in beside_people(result.rows).items():
            if (count := effect.flow.count) == 0:
                continue
            seeds = f"{count} paired seed{'' if count == 1 else 's'}"
            words = f"{label} beside people alone, {seeds}: {effect.words}"
            console.print(words, soft_wrap=True)
        print_notes(result.notes)
        if result.report is not None:
            aside.print(f"report: {result.report}")
        after_drive(scenario, driver, changes, reward)
    raise_failures(result)


@with_options(changes=scenario_changes)
def watch(
    *,
    scenario: ScenarioArgument,
    drivers: Annotated[
        list[str],
        typer.Option("--driver", "-d", help="One, as in drive; a run folder shows its trained controller."),
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
    from unjam.controller.domain import notes_on_controllers
    from unjam.files import check_folder
    from unjam.measures.metrics import measure
    from unjam.measures.notes import notes_of_rows
    from unjam.reports.film import check_format, write_video
    from unjam.scenarios import make_scenario, scenario_recipe
    from unjam.training.evaluate import raise_failure
    from unjam.worlds.workers import EpisodeTask, Workers

    if len(drivers) > 1:
        raise wrong("driver", ", ".join(drivers), "one")
    (driver,) = drivers
    road = make_scenario(scenario, together(changes, assignments(settings)))
    driven = make_driver(driver, road.decision_step)
    print_notes(notes_on_controllers(scenario_recipe(road), [driver], {}))
    if video is None:
        episode = watch_in_window(road, driven, (seed,), pace)
    else:
        check_format(video)
        check_folder(video)
        aside.print("driving")
        with Workers(1) as workers:
            episode = workers.run([EpisodeTask(road, driven, (seed,), full=True)])[0]
    row = measure(episode)
    print_notes(notes_of_rows({driver: [row]}))
    if episode.ok and video is not None:
        aside.print("drawing")
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
        raise MissingPartError(
            "watch: no display; write a film: --video FILE, or use xvfb-run unjam watch ..."
        )
    delay = 1000.0 / pace  # [ms] for a second of simulation, however many steps it has
    options = ("--start", "true", "--quit-on-end", "true", "--delay", str(delay))
    with Simulation("gui", gui_options=options) as window:
        return run_episode(scenario, driver, seed, simulation=window)


@with_options(changes=people_changes)
def assess(
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
    shares: Annotated[
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
    from unjam.training.assess import DRIVERS_OF_OPEN_ROADS, question
    from unjam.training.assess import assess as run
    from unjam.training.folder import new_and_owned
    from unjam.worlds.workers import Workers

    drivers, changes = driver or DRIVERS_OF_OPEN_ROADS, together(changes, assignments(settings))
    asked = question(scenario, _shares(shares), episodes, precision, minutes, drivers, changes)
    folder = new_folder(out, f"assess-{Path(scenario).stem}")
    total = asked.road.horizon * episodes
    counting = counting_steps("assessing, at most", total)
    with new_and_owned(folder), counting as steps, Workers(workers) as pool:
        found = run(asked, folder, pool, steps, (lambda line: None) if json else aside.print)
    if json:
        print_json({**found.document, "folder": str(folder), "report": str(found.page)})
        return
    console.print(found.document["headline"], soft_wrap=True, markup=False)
    for each in (*found.judged, *found.acc):
        console.print(f"- {each.words}", soft_wrap=True, markup=False)
    for note in found.document["notes"]:
        aside.print(note, soft_wrap=True, markup=False)
    aside.print(f"report: {found.page}", soft_wrap=True, markup=False)


def _shares(text: str) -> list[float]:
    """Return the numbers of a list like 0.02,0.1."""
    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise wrong("shares", text, "numbers from 0 to 1, like 0.02,0.1") from None
