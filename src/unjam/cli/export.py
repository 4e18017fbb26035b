"""`unjam export`: a controller as one file that can be shipped."""

from pathlib import Path
from typing import Annotated

import typer

from unjam.cli.options import JsonOption


def export(
    source: Annotated[
        str, typer.Argument(help="Folder of a training run; or any driver, as in drive --driver.")
    ],
    to: Annotated[Path, typer.Option("--to", help="The file to write; ends in .unjam.")],
    onnx: Annotated[
        bool, typer.Option("--onnx", help="Add the ONNX graph of the whole controller, and write it beside.")
    ] = False,
    scenario: Annotated[
        str,
        typer.Option(help="Road whose time step and bounds a driver by itself gets.", show_default="ring"),
    ] = "",
    json: JsonOption = False,
) -> None:
    """Write a controller into one file with all that is needed to run it elsewhere.

    Its manifest says what it observes, in which order and units, what it remembers, and how far it may be
    trusted. A sample of a held-out episode goes with it, on which `unjam verify` compares.

    Examples:

      unjam export runs/ring-001 --to ring.unjam

      unjam export runs/ring-001 --to ring.unjam --onnx

      unjam export pi:window=30 --scenario merge --to pi.unjam
    """
    from unjam.cli.output import aside, console, print_json
    from unjam.training.export import export_controller

    done = export_controller(source, to, onnx, scenario)
    if json:
        graph = str(done.graph) if done.graph else None
        print_json(
            {"file": str(done.file), "onnx": graph, "driver": done.driver, "decisions": done.decisions}
        )
        return
    for written in filter(None, (done.file, done.graph)):
        console.print(f"{written}: {written.stat().st_size:,} bytes")
    aside.print(f"{done.driver}, verified on {done.decisions:,} decisions of a held-out episode")
