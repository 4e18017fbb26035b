"""`unjam doctor`: is everything there, and what to do if not."""

from typing import Any

import typer

from unjam.cli.options import JsonOption
from unjam.errors import MissingPartError


def doctor(json: JsonOption = False) -> None:
    """Check SUMO, its version, a display, the cache, and one real episode; say what to do where one fails.

    Exit code 3 if a needed part is missing.

    Example:

      unjam doctor
    """
    from unjam.cli.output import console, print_json
    from unjam.training.health import check_health

    checks = check_health()
    missing = [check for check in checks if not check.ok and check.needed]
    if json:
        document: dict[str, Any] = {"ok": not missing, "checks": [check.__dict__ for check in checks]}
        print_json(document)
    else:
        for check in checks:
            mark = (
                "[green]ok[/green]     "
                if check.ok
                else "[red]missing[/red]"
                if check.needed
                else "[yellow]no[/yellow]     "
            )
            console.print(f"{mark} {check.name}: {check.found}")
            if not check.ok:
                console.print(f"        {check.remedy}")
    if missing:
        raise typer.Exit(MissingPartError.exit_code)
