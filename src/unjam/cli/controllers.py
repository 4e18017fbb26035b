"""Controllers as files: `unjam export` writes one that can be shipped, `unjam verify` checks it."""

from pathlib import Path
from typing import Annotated

import typer

from unjam.cli.options import JsonOption
from unjam.cli.output import aside, console, print_json


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
    from unjam.training.export import export_controller

    done = export_controller(source, to, onnx, scenario)
    if json:
        files = {"file": str(done.file), "onnx": str(done.graph) if done.graph else None}
        print_json({**files, "driver": done.driver, "decisions": done.decisions})
        return
    for written in filter(None, (done.file, done.graph)):
        console.print(f"{written}: {written.stat().st_size:,} bytes")
    aside.print(f"{done.driver}, verified on {done.decisions:,} decisions of a held-out episode")


def verify(
    file: Annotated[Path, typer.Argument(help="A .unjam file, or the folder of a training run.")],
    json: JsonOption = False,
) -> None:
    """Check a controller: hashes, shapes, names, and that its forms agree on its recorded sample.

    Nothing of the file is executed. Exit code 2 and one line where something is wrong.

    Example:

      unjam verify ring.unjam
    """
    from rich.markup import escape

    from unjam.controller.verify import verify_controller

    verified = verify_controller(file)
    if json:
        found = {each.name: each.found for each in verified}
        print_json({"file": str(file), "ok": True, "verified": found})
        return
    for each in verified:
        console.print(f"[green]ok[/green] {each.name}: {escape(each.found)}")
