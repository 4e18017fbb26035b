"""`unjam report`: one self-contained HTML page."""

from pathlib import Path
from typing import Annotated

import typer

from unjam.cli.options import JsonOption


def report(
    folders: Annotated[list[Path], typer.Argument(help="Folders of results: of training runs, or of drive.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", help="The page to write.", show_default="report.html in the folder"),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Write the report of a folder of results, or of several compared: one HTML page that needs no network.

    Examples:

      unjam report runs/ring-001

      unjam report runs/ring-001 runs/ring-002 --out compared.html
    """
    from unjam.cli.output import console, print_json
    from unjam.reports.html import write_report

    target = out or (folders[0] / "report.html" if len(folders) == 1 else Path("comparison.html"))
    written = write_report(folders, target)
    if json:
        print_json({"report": str(written), "folders": [str(folder) for folder in folders]})
    else:
        console.print(str(written))
