"""Results of training runs: `unjam evaluate`, `model`, `report`, and `unjam runs`, which lists and removes runs."""

import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from unjam.cli import options as opt
from unjam.cli import output
from unjam.cli.output import console, err_console, print_json
from unjam.controller import make_driver
from unjam.drivers.registry import DRIVERS
from unjam.errors import InputError, resume_hint
from unjam.measures.statistics import format_difference
from unjam.processes import check_not_locked, continue_in_limited_child, lock_folder
from unjam.reports.results import CONTROLLER_FILE, read_progress, read_results
from unjam.text import printable, shorten_list
from unjam.training.evaluate import evaluate_run, evaluation_steps, gain_over_expert
from unjam.training.run_folder import check_controller, check_run_files, lock_new_folder, read_config
from unjam.training.runs import config_differences, find_run, list_runs, read_run, remove_run
from unjam.worlds.episode import check_can_drive
from unjam.worlds.worker_pool import WorkerPool


def evaluate_command(
    run: Annotated[Path, Argument(help="Folder of a training run.")],
    driver: Annotated[
        list[str] | None,
        Option(
            "--driver",
            "-d",
            help="Driver to compare with besides the run's expert, as in drive.",
            show_default="human and every formula of the package",
        ),
    ] = None,
    episodes: Annotated[
        int | None,
        Option(
            "--episodes", "-n", min=1, help="Test episodes per driver.", show_default="as in the run's configuration"
        ),
    ] = None,
    humans: opt.HumansOption = None,
    out: Annotated[
        Path | None,
        Option(help="Folder for the results.", show_default="the run; for a partial evaluation, a new one under runs/"),
    ] = None,
    workers: opt.WorkersOption = opt.DEFAULT_WORKERS,
    show_all: opt.AllMetricsOption = False,
    json: opt.JsonOption = False,
) -> None:
    """Compare a trained controller with every expert and the human baseline on fixed test seeds.

    A complete evaluation replaces the evaluation and the report of the run, unless --out names another folder. A
    partial evaluation, with selected drivers (-d), other human drivers (--humans) or fewer episodes than in the
    configuration of the run, is written into a new folder.

    Examples:

    - unjam evaluate runs/ring-001
    - unjam evaluate runs/ring-001 -d human -d pi
    - unjam evaluate runs/ring-001 --episodes 50 --json
    - unjam evaluate runs/ring-001 --humans drivers.json --out runs/other-drivers
    """
    config = read_config(run)
    check_run_files(run, config, "evaluate")
    check_controller(run, "evaluate")
    episodes = episodes or config.evaluation.episodes
    if driver or humans is not None or episodes < config.evaluation.episodes:
        out = opt.new_folder(out, f"evaluate-{run.resolve().name}")
    evaluation = replace(config.evaluation, baselines=tuple(driver or DRIVERS), episodes=episodes)
    options = {**config.scenario_options, **opt.network_changes(humans=humans)}
    config = replace(config, scenario_options=options, evaluation=evaluation)
    if config.tasks:
        raise InputError(f"run: {str(run)!r} has several roads; allowed: the folder of one of them")
    if not (run / CONTROLLER_FILE).is_file():
        raise InputError(f"run: {str(run)!r} has no controller yet{resume_hint(run)}")
    scenario = config.make_scenario()
    for name in driver or []:
        check_can_drive(make_driver(name, scenario.control_step), scenario, f"driver {name}")
    from unjam.reports.html import write_report_page  # loads matplotlib, so only after the checks
    from unjam.reports.summary import main_finding

    notes = [f"partial: compared with {', '.join(driver)} and the expert alone"] if driver else []
    total = evaluation_steps(config, run)
    target = out or run
    with lock_folder(target) if out is None else lock_new_folder(out):
        with output.ProgressReporter("evaluating", "steps", total) as progress, WorkerPool(workers) as pool:
            evaluation = evaluate_run(run, config, pool, progress.update, out, notes)
        page = write_report_page([target], target / "report.html")
    results = read_results(target)
    if json:
        gain, means = gain_over_expert(config, evaluation.rows), evaluation.means()
        facts = {"run": str(run), "folder": str(target), "scenario": config.scenario, "gain": gain and asdict(gain)}
        drivers = [{"driver": name, "episodes": rows, "mean": means[name]} for name, rows in evaluation.rows.items()]
        print_json({**facts, "drivers": drivers, "notes": results.metadata["notes"]})
        return
    output.print_wrapped(main_finding(results))
    output.print_results(evaluation.rows, show_all, first_metrics=["return"])
    output.print_notes(results.metadata["notes"])
    err_console.print(f"report: {page}")


def model_command(
    run: Annotated[Path, Argument(help="Folder of a training run with a learned model.")], json: opt.JsonOption = False
) -> None:
    """Show the errors of the learned model of a run relative to the environment.

    The errors are root mean squares on episodes that were not used for training, next to the errors of the base
    model alone and the size of the predicted changes. For a model of whole roads, the command compares the waves in
    model rollouts with those in a recorded episode. It also writes the report of the run, with figures, again.

    Examples:

    - unjam model runs/ring-001
    - unjam model runs/ring-001 --json
    """
    from matplotlib import get_cachedir

    continue_in_limited_child(f"model: {run}", run, Path(get_cachedir()))
    from unjam.reports import model
    from unjam.reports.html import write_report_page
    from unjam.training.model_facts import update_model_facts

    config = read_config(run)
    check_run_files(run, config, "model")
    with lock_folder(run):
        facts = update_model_facts(run, config)
        is_evaluated = (run / "evaluation.json").is_file()
        report = write_report_page([run], run / "report.html") if is_evaluated else None
    if json:
        print_json({"run": str(run), "report": str(report) if report else None, **facts})
        return
    lines = [model.rollout_summary(read_progress(run))]
    if "waves" in facts:
        table = output.new_table(("second half of the episode",), model.WAVE_HEADINGS)
        for label, row in model.wave_rows(facts):
            table.add_row(label, *row)
    else:
        table = output.new_table(("root mean square", "unit"), model.error_headings(facts))
        for row in model.error_rows(facts):
            table.add_row(row["label"], row["unit"], *row["cells"])
        lines = [model.error_verdict(facts), *lines, model.bound_summary(facts)]
    console.print(table)
    for line in lines:
        console.print(line)
    err_console.print(f"report: {report}" if report else f"no report before the end of the training: --resume {run}")


def report_command(
    folders: Annotated[list[Path], Argument(help="Folders of training runs, or of results of unjam drive.")],
    out: Annotated[
        Path | None,
        Option("--out", help="HTML file to write.", show_default="report.html in the folder, or comparison.html here"),
    ] = None,
    json: opt.JsonOption = False,
) -> None:
    """Write the report of one folder of results, or a comparison of several, as one HTML page that works offline.

    Examples:

    - unjam report runs/ring-001
    - unjam report runs/ring-001 runs/ring-002 --out compared.html
    """
    from matplotlib import get_cachedir

    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"report: {str(folder)!r} is not a folder; allowed: one with results")
    target = out or (folders[0] / "report.html" if len(folders) == 1 else Path("comparison.html"))
    opt.check_page_path(target)
    continue_in_limited_child(f"report: {', '.join(map(str, folders))}", target.absolute().parent, Path(get_cachedir()))
    from unjam.reports.html import write_report_page

    for folder in (*folders, target.parent):
        check_not_locked(folder)
    page = write_report_page(folders, target)
    if json:
        print_json({"report": str(page), "folders": list(map(str, folders))})
    else:
        console.print(str(page))


RunsFolderOption = Annotated[Path, Option("--folder", help="Folder that contains the runs.")]
RunNamesArgument = Annotated[list[str], Argument(help="Names of runs, as listed, or their folders.", metavar="NAME...")]
DEFAULT_RUNS_FOLDER = Path("runs")

runs_command = typer.Typer(name="runs", rich_markup_mode="markdown", add_completion=False)


@runs_command.callback(invoke_without_command=True)
@opt.with_trust_option
def list_runs_command(
    context: typer.Context,
    folder: RunsFolderOption = DEFAULT_RUNS_FOLDER,
    scenario: Annotated[str, Option(help="List only runs on this scenario.")] = "",
    json: opt.JsonOption = False,
) -> None:
    """List the training runs in a folder: their progress, and their return relative to the expert.

    Examples:

    - unjam runs
    - unjam runs --folder studies --scenario ring --json
    - unjam runs compare ring-001 ring-002
    - unjam runs progress ring-001 > progress.csv
    - unjam runs remove ring-001
    """
    if context.invoked_subcommand is not None:
        if folder != DEFAULT_RUNS_FOLDER or scenario or json:
            allowed = f"after it, as in unjam runs {context.invoked_subcommand} --folder studies"
            raise InputError(f"runs: options are not allowed before the command; allowed: {allowed}")
        return
    runs = list_runs(folder, scenario) if folder != DEFAULT_RUNS_FOLDER or folder.is_dir() else []
    if json:
        print_json([run.document() for run in runs])
        return
    if not runs:
        condition = f" on {scenario}" if scenario else ""
        err_console.print(f"no runs{condition} in {folder}; start one: unjam train ring --preset demo")
        return
    table = output.new_table(("run", "scenario", "preset", "state"), ("steps", "difference to expert"))
    for run in runs:
        steps = f"{run.steps:,}" if run.state == "finished" else f"{run.steps:,} of {run.config.steps:,}"
        for index, (road, config) in enumerate(run.config.task_configs().items()):
            cells = ("", "", "") if index else (run.config.preset or "–", run.state, steps)
            name = f"  {road}" if index else run.name
            reward = f", reward {config.reward}" if config.reward else ""
            table.add_row(name, f"{Path(config.scenario).name}{reward}", *cells, _gain_text(run.gains[road]))
    console.print(table)


def _gain_text(gain: Any) -> str:
    return format_difference(gain) if gain else "–"


@runs_command.command("compare")
@opt.with_trust_option
def compare_command(
    names: RunNamesArgument, folder: RunsFolderOption = DEFAULT_RUNS_FOLDER, json: opt.JsonOption = False
) -> None:
    """Compare the returns of runs, and list the settings in which they differ.

    Example:

    - unjam runs compare ring-001 ring-002
    """
    if len(names) < 2:
        raise InputError("compare: one run is not allowed; allowed: two or more")
    runs = _find_runs(names, folder)
    settings = config_differences(runs)
    if json:
        print_json({"runs": [run.document() for run in runs], "settings": settings})
        return
    table = output.new_table(("", *(run.name for run in runs)))
    table.add_row("state", *(run.state for run in runs))
    table.add_row("steps done", *(f"{run.steps:,}" for run in runs))
    for road in dict.fromkeys(road for run in runs for road in run.gains):
        label = f"difference to expert, {road}" if road else "difference to expert"
        table.add_row(label, *(_gain_text(run.gains.get(road)) for run in runs))
    for name, values in settings.items():
        table.add_row(name, *("–" if value is None else str(value) for value in values))
    console.print(table)
    if not settings:
        console.print("the settings of these runs are the same")
    folders = (run.folder for run in runs)
    output.print_next_command("compare them on one page", "report", *folders, "--out", "compared.html")


@runs_command.command("progress")
@opt.with_trust_option
def progress_command(
    name: Annotated[str, Argument(help="Name of a run, as listed, or its folder.")],
    folder: RunsFolderOption = DEFAULT_RUNS_FOLDER,
    json: opt.JsonOption = False,
) -> None:
    """Print the progress of a run as CSV with a row per iteration; names of nested values contain dots.

    Example:

    - unjam runs progress ring-001 > progress.csv
    """
    import pandas as pd

    from unjam.reports.summary import csv_text

    rows = read_progress(_find_runs([name], folder)[0].folder)
    if json:
        print_json(rows)
    else:
        sys.stdout.write(csv_text(pd.json_normalize(rows)))


@runs_command.command("remove")
@opt.with_trust_option
def remove_command(
    names: RunNamesArgument,
    folder: RunsFolderOption = DEFAULT_RUNS_FOLDER,
    yes: Annotated[bool, Option("--yes", "-y", help="Remove without asking for confirmation.")] = False,
    json: opt.JsonOption = False,
) -> None:
    """Remove runs and their folders permanently, after confirmation.

    Files in them that unjam did not write stay. Runs that are being trained, and folders that are not run folders, are
    refused.

    Example:

    - unjam runs remove ring-001 ring-002 --yes
    """
    runs = _find_runs(names, folder)
    for run in runs:
        if run.state == "running":
            raise InputError(f"run: {str(run.folder)!r} is being trained; allowed: runs that have ended")
    if not yes and (json or not sys.stdin.isatty()):
        raise InputError("remove: confirmation requires a terminal; allowed: --yes")
    for run in runs:
        size = sum(path.stat().st_size for path in run.folder.rglob("*") if path.is_file()) / 1e6
        question = f"Remove {run.folder} ({run.state}, {run.steps:,} steps, {size:.0f} MB)?"
        if yes or typer.confirm(printable(question)):
            remaining = [str(path.relative_to(run.folder)) for path in remove_run(run.folder)]
            note = f", except files that unjam did not write: {shorten_list(remaining)}" if remaining else ""
            err_console.print(f"removed {run.folder}{note}", soft_wrap=True)
    if json:
        print_json({"removed": [str(run.folder) for run in runs]})


def _find_runs(names: Sequence[str], folder: Path) -> list[Any]:
    """Return the runs with these names, each once."""
    runs = (read_run(find_run(name, folder), name) for name in names)
    return list({run.folder.resolve(): run for run in runs}.values())
