"""`unjam model`: how far the virtual environment of a run is from the actual one."""

from pathlib import Path
from typing import Annotated

import typer

from unjam.cli.options import JsonOption


def model(
    run: Annotated[Path, typer.Argument(help="Folder of a training run with a virtual environment.")],
    json: JsonOption = False,
) -> None:
    """Show where the virtual environment of a run agrees with the actual one, and where it does not.

    All errors are root mean squares on episodes that no network learned from, beside those of the base alone
    and beside how much there was to predict. The pictures are in the run's report, which is written anew.

    Examples:

      unjam model runs/ring-001

      unjam model runs/ring-001 --json
    """
    from rich.table import Table

    from unjam.cli.output import aside, console, print_json
    from unjam.reports.html import write_report
    from unjam.reports.model import bound_of, cells, error_rows, headings, trust_of, verdict_of
    from unjam.reports.results import read_progress
    from unjam.training.folder import read_config
    from unjam.training.model_facts import newest_model_facts

    facts = newest_model_facts(run, read_config(run))
    ended = (run / "evaluation.json").is_file()
    report = write_report([run], run / "report.html") if ended else None
    if json:
        print_json({"run": str(run), "report": str(report) if report else None, **facts})
        return
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("root mean square")
    table.add_column("unit", style="dim")
    for heading in headings(facts):
        table.add_column(heading, justify="right")
    for row in error_rows(facts):
        table.add_row(row["number"], row["unit"], *cells(row))
    console.print(table)
    for line in (verdict_of(facts), trust_of(read_progress(run)), bound_of(facts)):
        console.print(line)
    aside.print(f"report: {report}" if report else f"no report before the training has ended: --resume {run}")
