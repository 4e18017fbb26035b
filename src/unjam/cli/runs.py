"""`unjam runs`: the trainings that there are, compared, as CSV, removed."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from unjam.cli.options import JsonOption
from unjam.cli.output import console, err_console, new_table, print_json, print_next_command
from unjam.errors import InputError

RunsFolderOption = Annotated[Path, typer.Option("--under", help="The folder that holds the runs.")]
RunNamesArgument = Annotated[
    list[str], typer.Argument(help="Names of runs, as listed, or their folders.", metavar="NAME...")
]
DEFAULT_RUNS_FOLDER = Path("runs")

runs_app = typer.Typer(name="runs", rich_markup_mode="markdown")


@runs_app.callback(invoke_without_command=True)
def list_runs_command(
    context: typer.Context,
    folder: RunsFolderOption = DEFAULT_RUNS_FOLDER,
    scenario: Annotated[str, typer.Option(help="Only those that train on this scenario.")] = "",
    json: JsonOption = False,
) -> None:
    """List the training runs in a folder: how far each is, and what it gained on its expert.

    Examples:

      unjam runs

      unjam runs --under studies --scenario ring --json

      unjam runs compare ring-001 ring-002

      unjam runs progress ring-001 > progress.csv

      unjam runs remove ring-001
    """
    if context.invoked_subcommand is not None:
        if folder != DEFAULT_RUNS_FOLDER or scenario or json:
            allowed = f"behind it, as in unjam runs {context.invoked_subcommand} --under studies"
            raise InputError(f"runs: options are not allowed before the command; allowed: {allowed}")
        return
    from unjam.training.runs import list_runs

    found = list_runs(folder, scenario) if folder != DEFAULT_RUNS_FOLDER or folder.is_dir() else []
    if json:
        print_json([run.document() for run in found])
        return
    if not found:
        of = f" of {scenario}" if scenario else ""
        err_console.print(f"no runs{of} in {folder}; begin one: unjam train ring --preset demo")
        return
    table = new_table(("run", "scenario", "preset", "state"), ("steps", "beyond the expert"))
    for run in found:
        steps = f"{run.steps:,}" if run.state == "finished" else f"{run.steps:,} of {run.config.steps:,}"
        for number, (road, config) in enumerate(run.config.task_configs().items()):
            about = ("", "", "") if number else (run.config.preset or "–", run.state, steps)
            name = f"  {road}" if number else run.name
            table.add_row(name, Path(config.scenario).name, *about, _gain_text(run.gains[road]))
    console.print(table)


def _gain_text(gain: Any) -> str:
    from unjam.measures.statistics import format_difference

    return format_difference(gain) if gain else "–"


@runs_app.command()
def compare_command(
    names: RunNamesArgument, folder: RunsFolderOption = DEFAULT_RUNS_FOLDER, json: JsonOption = False
) -> None:
    """Compare runs: what each reached, and the settings in which they differ.

    Example:

      unjam runs compare ring-001 ring-002
    """
    from unjam.training.runs import config_differences

    if len(names) < 2:
        raise InputError("compare: one run is not allowed; allowed: two or more")
    found = _find_runs(names, folder)
    settings = config_differences(found)
    if json:
        print_json({"runs": [run.document() for run in found], "settings": settings})
        return
    table = new_table(("", *(run.name for run in found)))
    table.add_row("state", *(run.state for run in found))
    table.add_row("steps done", *(f"{run.steps:,}" for run in found))
    roads = dict.fromkeys(road for run in found for road in run.gains)
    for road in roads:
        label = f"beyond the expert, {road}" if road else "beyond the expert"
        table.add_row(label, *(_gain_text(run.gains.get(road)) for run in found))
    for name, values in settings.items():
        table.add_row(name, *("–" if value is None else str(value) for value in values))
    console.print(table)
    if not settings:
        console.print("their settings are the same")
    print_next_command("on one page", "report", *(run.folder for run in found), "--out", "compared.html")


@runs_app.command()
def progress_command(
    name: Annotated[str, typer.Argument(help="Name of a run, as listed, or its folder.")],
    folder: RunsFolderOption = DEFAULT_RUNS_FOLDER,
    json: JsonOption = False,
) -> None:
    """Print a run's progress as CSV: a row per iteration; names of what is within others have dots.

    Example:

      unjam runs progress ring-001 > progress.csv
    """
    import pandas as pd

    from unjam.reports.results import read_progress

    (run,) = _find_runs([name], folder)
    rows = read_progress(run.folder)
    if json:
        print_json(rows)
    else:
        pd.json_normalize(rows).to_csv(sys.stdout, index=False)


@runs_app.command()
def remove_command(
    names: RunNamesArgument,
    folder: RunsFolderOption = DEFAULT_RUNS_FOLDER,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    json: JsonOption = False,
) -> None:
    """Remove runs for good, with all that is in their folders; asks first.

    What is not a run folder, or is being trained into, is left as it is.

    Example:

      unjam runs remove ring-001 ring-002 --yes
    """
    from unjam.training.runs import remove_run

    found = _find_runs(names, folder)
    for run in found:
        if run.state == "running":
            raise InputError(f"run: {str(run.folder)!r} is being trained; allowed: runs that have ended")
    if not yes and (json or not sys.stdin.isatty()):
        raise InputError("remove: there is nobody to ask; allowed: with --yes")
    for run in found:
        size = sum(path.stat().st_size for path in run.folder.rglob("*") if path.is_file()) / 1e6
        question = f"Remove {run.folder} ({run.state}, {run.steps:,} steps, {size:.0f} MB)?"
        if yes or typer.confirm(question):
            remove_run(run.folder)
            err_console.print(f"removed {run.folder}")
    if json:
        print_json({"removed": [str(run.folder) for run in found]})


def _find_runs(names: Sequence[str], folder: Path) -> list[Any]:
    from unjam.training.runs import find_run, read_run

    found = (read_run(find_run(name, folder), name) for name in names)
    return list({run.folder.resolve(): run for run in found}.values())
