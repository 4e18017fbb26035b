"""Episodes with drivers: `unjam drive` measures them, `watch` shows one, `assess` compares controllers on a road."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from unjam.cli import options as opt
from unjam.cli import output
from unjam.cli.output import console, err_console, print_json
from unjam.controller import make_driver
from unjam.controller.domain import controller_notes
from unjam.drivers.driver import Driver
from unjam.errors import InputError, MissingPartError, invalid_value, raise_failure
from unjam.files import check_parent_folder
from unjam.measures.metrics import measure
from unjam.measures.notes import episode_notes
from unjam.processes import has_display
from unjam.scenarios import make_scenario, scenario_recipe
from unjam.scenarios.scenario import Scenario
from unjam.scenarios.user_network import ACC_SETTINGS
from unjam.text import format_duration
from unjam.training.drive import drive
from unjam.training.evaluate import raise_failures
from unjam.training.run_folder import check_controllers, lock_new_folder
from unjam.training.trial_log import REQUEST_FILE
from unjam.worlds.backend import backend_notes, check_support, open_backend
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool


@opt.with_options(changes=opt.scenario_changes)
def drive_command(
    *,
    scenario: opt.ScenarioArgument,
    driver: Annotated[
        list[str] | None,
        Option(
            "--driver",
            "-d",
            help="Driver of the CAVs: a name, name:parameter=value, your own path.py:name, a run folder, a .unjam "
            "file, or an .onnx file with a description; drivers joined by + share the CAVs. Repeat the "
            "option to compare drivers on the same traffic.",
            show_default="human and unjam:best; on recorded roads human and unjam:recorded-tuned. On your own network "
            "the default gives CAVs ACCs, as in assess",
        ),
    ] = None,
    episodes: Annotated[int, Option("--episodes", "-n", min=1, help="Number of episodes.")] = 5,
    seed: opt.SeedOption = 0,
    test_seeds: Annotated[
        bool, Option("--test-seeds", help="Use the test seeds of trainings instead of --seed.")
    ] = False,
    changes: dict[str, Any],
    reward: opt.RewardOption = "",
    backend: opt.BackendOption = "sumo",
    settings: opt.ScenarioSettingsOption = None,
    workers: opt.WorkersOption = opt.DEFAULT_WORKERS,
    out: opt.OutOption = None,
    report: Annotated[bool, Option(help="Write the results and a report.html into a folder.")] = True,
    baseline: Annotated[
        str, Option(help="Driver that the others are compared with, one of --driver.", show_default="human")
    ] = "",
    show_all: opt.AllMetricsOption = False,
    json: opt.JsonOption = False,
) -> None:
    """Run episodes with one or several drivers: verdicts, a table of metrics and a report.

    Examples:

    - unjam drive ring --driver human
    - unjam drive ring-warm --driver pi --length 230
    - unjam drive ring-jammed -d human -d pi -d pi:time_constant=0 --episodes 10
    - unjam drive ring --driver my_driver.py:gentle --json
    - unjam drive my.sumocfg --penetration-rate 0.1
    - unjam drive ring-jammed -d human -d pi --humans drivers.json
    - unjam drive ring -d pi -d runs/ring-001 --test-seeds --episodes 20
    """
    changes = opt.merge_settings(changes, opt.parse_settings(settings))
    if out is not None and not report:
        raise InputError(f"out: {str(out)!r} is not allowed with --no-report; allowed: --report")
    if not driver and scenario.endswith(".sumocfg"):
        changes = ACC_SETTINGS | changes
    road = make_scenario(scenario, changes)
    driver = driver or ["human", road.controller]
    total = road.max_episode_steps * episodes * len(driver)
    folder = opt.new_folder(out, f"drive-{Path(scenario).stem}") if report else None
    with output.ProgressReporter(f"driving {Path(scenario).name}", "steps", total) as progress:
        result = drive(
            *(scenario, driver, episodes, seed, changes, reward, workers, folder, progress.update),
            test_seeds=test_seeds,
            backend=backend,
            baseline=baseline,
        )
    if json:
        print_json(result.document())
    elif any(row["status"] != "failed" for rows in result.rows.values() for row in rows):
        output.print_results(result.rows, show_all, result.baseline)
        output.print_notes(result.notes)
        first = next(iter(result.rows.values()))[0]
        if command := road.plain_sumo_command(first["sumo_seed"]):
            output.print_notes([f"the traffic of the first episode in plain SUMO, without CAVs: {command}"])
        if result.report is not None:
            err_console.print(f"report: {result.report}")
        is_drawable = all(len(episode.outline) or len(episode.poses) for episode in result.plot_episodes.values())
        output.suggest_after_drive(scenario, driver, changes, reward, backend, is_drawable, road.controller)
    raise_failures(result)


@opt.with_options(changes=opt.scenario_changes)
def watch_command(
    *,
    scenario: opt.ScenarioArgument,
    drivers: Annotated[
        list[str], Option("--driver", "-d", help="One driver, as in drive; a run folder: its trained controller.")
    ],
    seed: opt.SeedOption = 0,
    video: Annotated[Path | None, Option(help="Write a video instead: a .gif, .webp or .mp4 file.")] = None,
    pace: Annotated[float, Option(min=0.1, max=1000.0, help="Playback speed relative to real time.")] = 10.0,
    backend: opt.BackendOption = "sumo",
    changes: dict[str, Any],
    settings: opt.ScenarioSettingsOption = None,
    json: opt.JsonOption = False,
) -> None:
    """Watch an episode in SUMO's window, or write a video of it, which needs no display.

    Examples:

    - unjam watch ring --driver pi
    - unjam watch ring-jammed --driver runs/ring-001 --video wave.mp4
    """
    from unjam.reports.video import check_video_format, write_video

    if len(drivers) > 1:
        raise invalid_value("driver", ", ".join(drivers), "one driver")
    if video is None and backend != "sumo":
        raise invalid_value("backend", backend, "sumo, the only one with a window; or --video")
    (name,) = drivers
    road = make_scenario(scenario, opt.merge_settings(changes, opt.parse_settings(settings)))
    driver = make_driver(name, road.control_step)
    check_controllers(name, "watch")
    output.print_notes(controller_notes(scenario_recipe(road), [name], {}))
    if video is None:
        episode = watch_in_window(road, driver, (seed,), pace)
    else:
        check_video_format(video)
        check_parent_folder(video)
        with open_backend(backend) as simulator:
            check_support(simulator, road)
        output.print_notes(backend_notes(backend, road))
        err_console.print("simulating the episode")
        with WorkerPool(1) as pool:
            episode = pool.run([EpisodeTask(road, driver, (seed,), record_details=True, backend=backend)])[0]
    row = measure(episode)
    output.print_notes(episode_notes({name: [row]}))
    if episode.has_run and video is not None:
        err_console.print("writing the video")
        write_video(episode, video, name, pace)
    if json:
        entries = {"scenario": scenario, "backend": backend, "driver": name}
        print_json({**entries, "video": str(video) if video else None, "episode": row})
    raise_failure([row])
    if not json and video is not None:
        console.print(f"video: {video}", soft_wrap=True)


def watch_in_window(scenario: Scenario, driver: Driver, seed: Sequence[int], pace: float) -> Episode:
    """Run an episode in SUMO's window, `pace` times as fast as real time, and return it.

    Raises:
        MissingPartError: there is no display.
    """
    if not has_display():
        raise MissingPartError("watch: no display; write a video: --video FILE, or use xvfb-run unjam watch ...")
    delay = 1000.0 / pace  # [ms] for each second of simulation: SUMO scales --delay with the step length
    window_options = ("--start", "true", "--quit-on-end", "true", "--delay", str(delay))
    with Simulation("gui", gui_options=window_options) as simulation:
        return run_episode(scenario, driver, seed, backend=SumoBackend(simulation))


@opt.with_options(changes=opt.network_changes)
def assess_command(
    *,
    scenario: Annotated[str, Argument(help="Your own .sumocfg file.", metavar="FILE")],
    driver: Annotated[
        list[str] | None,
        Option(
            "--driver",
            "-d",
            help="Controller of the CAVs, as in drive; of several, the best is selected.",
            show_default="unjam:best, follower-stopper, pi",
        ),
    ] = None,
    penetration_rates: Annotated[
        str,
        Option(
            "--penetration-rates",
            "--penetration-rate",
            help="Penetration rates among the vehicles of --cav-classes, with commas.",
        ),
    ] = "0.05,0.1,0.2",
    episodes: Annotated[int, Option("--episodes", "-n", min=1, help="Maximum number of episodes.")] = 240,
    minutes: Annotated[
        float | None, Option(help="Time limit [min], exceeded only by the minimum number of test seeds.")
    ] = None,
    precision: Annotated[
        float, Option(help="Sufficient half-width of the confidence interval of travel time, as a share of it.")
    ] = 0.02,
    settings: opt.ScenarioSettingsOption = None,
    workers: opt.WorkersOption = opt.DEFAULT_WORKERS,
    out: opt.OutOption = None,
    json: opt.JsonOption = False,
    changes: dict[str, Any],
) -> None:
    """Assess CAVs on your own road: compare human drivers, ACC vehicles and controllers on equal seeds.

    For each penetration rate a controller is selected on tuning seeds and evaluated on test seeds. It is
    recommended only if travel time is shown to be shorter than with human drivers and than with ACC vehicles,
    flow is not lower, the CAVs are feasible, and human drivers do not brake hard more often. There is no --backend:
    only SUMO simulates your network.

    Examples:

    - unjam assess my.sumocfg
    - unjam assess my.sumocfg --penetration-rates 0.05,0.2 -d acc -d pi --minutes 30
    - unjam assess my.sumocfg -d runs/my-001 --penetration-rates 0.1 --begin 28800 --end 32400 --json
    """
    from unjam.reports.assessment import OPTION_HEADINGS, option_rows, parse_assessment
    from unjam.training.assess import assess
    from unjam.training.assessment_request import DEFAULT_CONTROLLERS, make_request

    drivers, changes = driver or DEFAULT_CONTROLLERS, opt.merge_settings(changes, opt.parse_settings(settings))
    rates = _parse_penetration_rates(penetration_rates)
    request = make_request(scenario, rates, episodes, precision, minutes, drivers, changes)
    folder = opt.new_folder(out, f"assess-{Path(scenario).stem}")
    progress = output.ProgressReporter("assessing", "steps")
    resume = output.suggest_resume(folder / REQUEST_FILE, *output.arguments_without("--out"), "--out", folder)
    with lock_new_folder(folder, resumable_file=REQUEST_FILE), resume, progress, WorkerPool(workers) as pool:
        on_message = (lambda line: None) if json else partial(err_console.print, soft_wrap=True)
        assessment = assess(request, folder, pool, progress.update, on_message, progress.begin)
    document = assessment.document
    if json:
        print_json({**document, "folder": str(folder), "report": str(assessment.page)})
        return
    for line in (document["headline"], document["acc_finding"]):
        output.print_wrapped(line)
    output.print_options(OPTION_HEADINGS, option_rows(parse_assessment(document)))
    notable_acc_results = [result for result in assessment.acc_results if result.needs_comment]
    for result in (*assessment.controller_results, *notable_acc_results):
        output.print_wrapped(f"- {result.summary}")
    output.print_notes(document["notes"])
    err_console.print(f"report: {assessment.page}", soft_wrap=True)
    if missing := document["missing_budget"]:
        seeds, duration = missing["min_test_seeds"], format_duration(missing["min_seconds"])
        arguments = output.arguments_without("--out", "--driver", "-d", "--episodes", "-n", "--minutes")
        driver_arguments = [word for name in missing["drivers"] for word in ("-d", name)]
        command = *arguments, *driver_arguments, "--episodes", missing["min_episodes"], "--out", folder
        output.print_next_command(f"for a verdict ({seeds} test seeds at least, about {duration})", *command)


def _parse_penetration_rates(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise invalid_value("penetration_rates", text, "numbers from 0 to 1, like 0.02,0.1") from None
