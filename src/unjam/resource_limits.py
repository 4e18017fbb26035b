"""What a program asks of files of others: the command line's verbs, in a process with their limits.

These are `unjam.verify_controller` and `unjam.write_report`.
"""

import json
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from unjam.child_processes import child_environment, python_command
from unjam.controller.verify import PartCheck
from unjam.errors import UnjamError
from unjam.trust import TRUST_CODE_OPTION


def verify_controller(path: Path | str, trust_code: bool = False, signer: Path | str | None = None) -> list[PartCheck]:
    """Return what is known of each part of a `.unjam` file or a run folder; only trusted code runs.

    Each is `checked`, `absent`, or `stated` by the maker alone; no part that is there is left unchecked.

    It is read as `unjam verify` reads it: in a process of its own, with little memory and time, which may
    neither write nor reach the network where the kernel sees to it.

    Args:
        path: the file, or the folder.
        trust_code: whether Python code that a run folder names runs all the same.
        signer: file of the public key that must have signed it; None where anybody may have, or nobody.

    Raises:
        InputError: the first thing that is wrong, in one line; also where there is code that is not trusted,
            or it is not signed by `signer`.
        MissingPartError: a part could not be checked, as a package is not installed.
    """
    options = [*([TRUST_CODE_OPTION] if trust_code else []), *([] if signer is None else [f"--signer={signer}"])]
    found = _run_json_command("verify", *options, "--", str(path))["parts"]
    return [PartCheck(**each) for each in found]


def write_report(folders: Sequence[Path | str], target: Path | str) -> Path:
    """Write the report of one folder of results, or a comparison of several; return its path.

    The folders are read as `unjam report` reads them, in a process that may write into the page's folder
    alone.

    Raises:
        InputError: a folder holds no results, or another process writes it.
        DiskError: the page cannot be written, or there is no folder for it.
    """
    _run_json_command("report", "--out", str(target), "--", *map(str, folders))
    return Path(target)


def _run_json_command(name: str, *arguments: str) -> Any:
    """Return what a verb of the command line answers; raise its error where it ends with another code."""
    command = python_command("-m", "unjam", name, "--json", *arguments)
    done = subprocess.run(command, capture_output=True, text=True, env=child_environment(), check=False)
    if done.returncode == 0:
        return json.loads(done.stdout)
    said = (done.stderr.strip().splitlines() or [f"unjam: {name}: exit code {done.returncode}"])[-1]
    kinds = {kind.exit_code: kind for kind in UnjamError.__subclasses__() if kind.exit_code > 1}
    raise kinds.get(done.returncode, UnjamError)(said.removeprefix("unjam: "))
