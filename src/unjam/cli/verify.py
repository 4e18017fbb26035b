"""`unjam verify`: is a controller whole, and is it what it says."""

from pathlib import Path
from typing import Annotated

import typer

from unjam.cli.options import JsonOption


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

    from unjam.cli.output import console, print_json
    from unjam.controller.verify import verify_controller

    verified = verify_controller(file)
    if json:
        print_json({"file": str(file), "ok": True, "verified": {each.name: each.found for each in verified}})
        return
    for each in verified:
        console.print(f"[green]ok[/green] {each.name}: {escape(each.found)}")
