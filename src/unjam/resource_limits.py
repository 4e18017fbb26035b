"""Read untrusted files in a resource-limited subprocess, which runs the command line."""

import json
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from unjam.child_processes import child_environment, python_command
from unjam.controller.verify import PartCheck
from unjam.errors import UnjamError, invalid_value
from unjam.trust import TRUST_CODE_OPTION


def verify_controller(
    path: Path | str, *, trust_code: bool = False, signer: Path | str | None = None
) -> list[PartCheck]:
    """Return the check of each part of a `.unjam` file or a run folder; only trusted code runs.

    A part is `checked`, `absent`, or only `stated` by its author. As in `unjam verify`, a subprocess with limited
    memory and time reads the file, without writing and network if the system can block them.

    Args:
        path: the file, or the folder.
        trust_code: whether Python code that a run folder names may run.
        signer: file of the public key of the required signer; None: any signature or none.

    Raises:
        InputError: the first failed check, code that is not trusted, or a missing signature of `signer`.
        MissingPartError: a part could not be checked because a package is not installed.
    """
    if not isinstance(trust_code, bool):
        raise invalid_value("trust_code", trust_code, "True or False")
    if not (signer is None or isinstance(signer, Path | str)):
        raise invalid_value("signer", signer, "the file of a public key")
    options = [*([TRUST_CODE_OPTION] if trust_code else []), *([] if signer is None else [f"--signer={signer}"])]
    parts = _run_json_command("verify", *options, "--", str(path))["parts"]
    return [PartCheck(**part) for part in parts]


def write_report(folders: Sequence[Path | str], target: Path | str) -> Path:
    """Write the report of one folder of results, or a comparison of several; return its path.

    As in `unjam report`, a subprocess reads the folders; it can write only into the folder of `target`. Raise
    `InputError` if a folder holds no results or is being written, `DiskError` if the page cannot be written.
    """
    _run_json_command("report", "--out", str(target), "--", *map(str, folders))
    return Path(target)


def _run_json_command(name: str, *arguments: str) -> Any:
    """Run a command with `--json` and return its output; raise its error if it fails."""
    command = python_command("-m", "unjam", name, "--json", *arguments)
    process = subprocess.run(command, capture_output=True, text=True, env=child_environment(), check=False)
    if process.returncode == 0:
        return json.loads(process.stdout)
    lines = process.stderr.strip().splitlines() or [f"unjam: {name}: exit code {process.returncode}"]
    classes = {error.exit_code: error for error in UnjamError.__subclasses__() if error.exit_code > 1}
    raise classes.get(process.returncode, UnjamError)(lines[-1].removeprefix("unjam: "))
