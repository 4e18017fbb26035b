"""`unjam runs`: the trainings that there are, compared, as CSV, removed."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from unjam.cli.options import JsonOption
from unjam.cli.output import aside, console, new_table, print_json, say_next
from unjam.errors import InputError

UnderOption = Annotated[Path, typer.Option("--under", help="The folder that holds the runs.")]
NamesArgument = Annotated[
    list[str], typer.Argument(help="Names of runs, as listed, or their folders.", metavar="NAME...")
]
RUNS = Path("runs")

runs = typer.Typer(name="runs", rich_markup_mode="markdown")


@runs.callback(invoke_without_command=True)
def list_them(
    context: typer.Context,
    under: UnderOption = RUNS,
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
        if under != RUNS or scenario or json:
            allowed = f"behind it, as in unjam runs {context.invoked_subcommand} --under studies"
            raise InputError(f"runs: options are not allowed before the command; allowed: {allowed}")
        return
    from unjam.training.runs import list_runs

    found = list_runs(under, scenario) if under != RUNS or under.is_dir() else []
    if json:
        print_json([run.document() for run in found])
        return
    if not found:
        of = f" of {scenario}" if scenario else ""
        aside.print(f"no runs{of} in {under}; begin one: unjam train ring --preset demo")
        return
    table = new_table(("run", "scenario", "preset", "state"), ("steps", "beyond the expert"))
    for run in found:
        steps = f"{run.steps:,}" if run.state == "finished" else f"{run.steps:,} of {run.config.steps:,}"
        for number, (road, config) in enumerate(run.config.roads().items()):
            about = ("", "", "") if number else (run.config.preset or "–", run.state, steps)
            name = f"  {road}" if number else run.name
            table.add_row(name, Path(config.scenario).name, *about, _gain_words(run.gains[road]))
    console.print(table)


def _gain_words(gain: Any) -> str:
    from unjam.measures.statistics import signed

    return signed(gain) if gain else "–"


@runs.command()
def compare(names: NamesArgument, under: UnderOption = RUNS, json: JsonOption = False) -> None:
    """Compare runs: what each reached, and the settings in which they differ.

    Example:

      unjam runs compare ring-001 ring-002
    """
    from unjam.training.runs import differences

    if len(names) < 2:
        raise InputError("compare: one run is not allowed; allowed: two or more")
    found = _read(names, under)
    settings = differences(found)
    if json:
        print_json({"runs": [run.document() for run in found], "settings": settings})
        return
    table = new_table(("", *(run.name for run in found)))
    table.add_row("state", *(run.state for run in found))
    table.add_row("steps done", *(f"{run.steps:,}" for run in found))
    roads = dict.fromkeys(road for run in found for road in run.gains)
    for road in roads:
        label = f"beyond the expert, {road}" if road else "beyond the expert"
        table.add_row(label, *(_gain_words(run.gains.get(road)) for run in found))
    for name, values in settings.items():
        table.add_row(name, *("–" if value is None else str(value) for value in values))
    console.print(table)
    if not settings:
        console.print("their settings are the same")
    say_next("on one page", "report", *(run.folder for run in found), "--out", "compared.html")


@runs.command()
def progress(
    name: Annotated[str, typer.Argument(help="Name of a run, as listed, or its folder.")],
    under: UnderOption = RUNS,
    json: JsonOption = False,
) -> None:
    """Print a run's progress as CSV: a row per iteration; names of what is within others have dots.

    Example:

      unjam runs progress ring-001 > progress.csv
    """
    import pandas as pd

    from unjam.reports.results import read_progress

    (run,) = _read([name], under)
    rows = read_progress(run.folder)
    if json:
        print_json(rows)
    else:
        pd.json_normalize(rows).to_csv(sys.stdout, index=False)


@runs.command()
def remove(
    names: NamesArgument,
    under: UnderOption = RUNS,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    json: JsonOption = False,
) -> None:
    """Remove runs for good, with all that is in their folders; asks first.

    What is not a run folder, or is being trained into, is left as it is.

    Example:

      unjam runs remove ring-001 ring-002 --yes
    """
    from unjam.training.runs import remove_run

    found = _read(names, under)
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
            aside.print(f"removed {run.folder}")
    if json:
        print_json({"removed": [str(run.folder) for run in found]})


def _read(names: Sequence[str], under: Path) -> list[Any]:
    from unjam.training.runs import find_run, read_run

    found = (read_run(find_run(name, under), name) for name in names)
    return list({run.folder.resolve(): run for run in found}.values())
