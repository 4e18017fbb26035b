"""Training runs: `unjam runs` lists, compares and removes them, and prints their progress as CSV."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from unjam.cli.options import JsonOption
from unjam.cli.output import console, err_console, new_table, print_json, print_next_command
from unjam.errors import InputError

RunsFolderOption = Annotated[Path, Option("--folder", help="The folder that contains the runs.")]
RunNamesArgument = Annotated[list[str], Argument(help="Names of runs, as listed, or their folders.", metavar="NAME...")]
DEFAULT_RUNS_FOLDER = Path("runs")

runs_app = typer.Typer(name="runs", rich_markup_mode="markdown")


@runs_app.callback(invoke_without_command=True)
def list_runs_command(
    context: typer.Context,
    folder: RunsFolderOption = DEFAULT_RUNS_FOLDER,
    scenario: Annotated[str, Option(help="Only runs on this scenario.")] = "",
    json: JsonOption = False,
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
    from unjam.training.runs import list_runs

    runs = list_runs(folder, scenario) if folder != DEFAULT_RUNS_FOLDER or folder.is_dir() else []
    if json:
        print_json([run.document() for run in runs])
        return
    if not runs:
        kind = f" on {scenario}" if scenario else ""
        err_console.print(f"no runs{kind} in {folder}; start one: unjam train ring --preset demo")
        return
    table = new_table(("run", "scenario", "preset", "state"), ("steps", "difference to expert"))
    for run in runs:
        steps = f"{run.steps:,}" if run.state == "finished" else f"{run.steps:,} of {run.config.steps:,}"
        for number, (road, config) in enumerate(run.config.task_configs().items()):
            cells = ("", "", "") if number else (run.config.preset or "–", run.state, steps)
            name = f"  {road}" if number else run.name
            table.add_row(name, Path(config.scenario).name, *cells, _gain_text(run.gains[road]))
    console.print(table)


def _gain_text(gain: Any) -> str:
    from unjam.measures.statistics import format_difference

    return format_difference(gain) if gain else "–"


@runs_app.command("compare")
def compare_command(
    names: RunNamesArgument, folder: RunsFolderOption = DEFAULT_RUNS_FOLDER, json: JsonOption = False
) -> None:
    """Compare runs: their returns, and the settings in which they differ.

    Example:

    - unjam runs compare ring-001 ring-002
    """
    from unjam.training.runs import config_differences

    if len(names) < 2:
        raise InputError("compare: one run is not allowed; allowed: two or more")
    runs = _find_runs(names, folder)
    settings = config_differences(runs)
    if json:
        print_json({"runs": [run.document() for run in runs], "settings": settings})
        return
    table = new_table(("", *(run.name for run in runs)))
    table.add_row("state", *(run.state for run in runs))
    table.add_row("steps done", *(f"{run.steps:,}" for run in runs))
    for road in dict.fromkeys(road for run in runs for road in run.gains):
        label = f"difference to expert, {road}" if road else "difference to expert"
        table.add_row(label, *(_gain_text(run.gains.get(road)) for run in runs))
    for name, values in settings.items():
        table.add_row(name, *("–" if value is None else str(value) for value in values))
    console.print(table)
    if not settings:
        console.print("their settings are the same")
    print_next_command("on one page", "report", *(run.folder for run in runs), "--out", "compared.html")


@runs_app.command("progress")
def progress_command(
    name: Annotated[str, Argument(help="Name of a run, as listed, or its folder.")],
    folder: RunsFolderOption = DEFAULT_RUNS_FOLDER,
    json: JsonOption = False,
) -> None:
    """Print a run's progress as CSV: a row per iteration; names of nested values contain dots.

    Example:

    - unjam runs progress ring-001 > progress.csv
    """
    import pandas as pd

    from unjam.reports.results import read_progress

    rows = read_progress(_find_runs([name], folder)[0].folder)
    if json:
        print_json(rows)
    else:
        pd.json_normalize(rows).to_csv(sys.stdout, index=False)


@runs_app.command("remove")
def remove_command(
    names: RunNamesArgument,
    folder: RunsFolderOption = DEFAULT_RUNS_FOLDER,
    yes: Annotated[bool, Option("--yes", "-y", help="Do not ask.")] = False,
    json: JsonOption = False,
) -> None:
    """Remove runs permanently, with their folders; asks for confirmation.

    Folders that are not run folders, and runs that are being trained, are not removed.

    Example:

    - unjam runs remove ring-001 ring-002 --yes
    """
    from unjam.training.runs import remove_run

    runs = _find_runs(names, folder)
    for run in runs:
        if run.state == "running":
            raise InputError(f"run: {str(run.folder)!r} is being trained; allowed: runs that have ended")
    if not yes and (json or not sys.stdin.isatty()):
        raise InputError("remove: confirmation needs a terminal; allowed: with --yes")
    for run in runs:
        size = sum(path.stat().st_size for path in run.folder.rglob("*") if path.is_file()) / 1e6
        if yes or typer.confirm(f"Remove {run.folder} ({run.state}, {run.steps:,} steps, {size:.0f} MB)?"):
            remove_run(run.folder)
            err_console.print(f"removed {run.folder}")
    if json:
        print_json({"removed": [str(run.folder) for run in runs]})


def _find_runs(names: Sequence[str], folder: Path) -> list[Any]:
    from unjam.training.runs import find_run, read_run

    runs = (read_run(find_run(name, folder), name) for name in names)
    return list({run.folder.resolve(): run for run in runs}.values())
