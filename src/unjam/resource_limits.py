"""Python functions that read untrusted files in a resource-limited subprocess, the command line."""

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

    Each is `checked`, `absent`, or `stated` by the maker alone; no part that is there is left unchecked. As in `unjam
    verify`, a subprocess with little memory and time reads it, if possible without writing and network.

    Args:
        path: the file, or the folder.
        trust_code: whether Python code that a run folder names may run.
        signer: file of the public key that must have signed it; None: any signature or none.

    Raises:
        InputError: the first problem, in one line; also code that is not trusted, or a missing signature of `signer`.
        MissingPartError: a part could not be checked, as a package is not installed.
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

    As in `unjam report`, a subprocess reads the folders, which can write only into the folder of `target`. Raise
    `InputError` if a folder holds no results or is being written, `DiskError` if the page cannot be written.
    """
    _run_json_command("report", "--out", str(target), "--", *map(str, folders))
    return Path(target)


def _run_json_command(name: str, *arguments: str) -> Any:
    """Return the JSON output of a command of the command line; raise its error if it fails."""
    command = python_command("-m", "unjam", name, "--json", *arguments)
    process = subprocess.run(command, capture_output=True, text=True, env=child_environment(), check=False)
    if process.returncode == 0:
        return json.loads(process.stdout)
    lines = process.stderr.strip().splitlines() or [f"unjam: {name}: exit code {process.returncode}"]
    classes = {error.exit_code: error for error in UnjamError.__subclasses__() if error.exit_code > 1}
    raise classes.get(process.returncode, UnjamError)(lines[-1].removeprefix("unjam: "))
