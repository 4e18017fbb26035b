"""The origin of a result: versions, machine, commit, command."""

import os
import platform
import subprocess
import sys
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from unjam import __version__
from unjam.kernels import kernel_info

RECORDED_PACKAGES = ("libsumo", "eclipse-sumo", "numpy", "torch", "stable-baselines3", "sb3-contrib", "gymnasium")


def manifest() -> dict[str, Any]:
    """Return the versions, machine, commit and command that are needed to repeat a result of this process."""
    return {
        "unjam": __version__,
        "commit": _source_commit(),
        "python": platform.python_version(),
        "packages": package_versions(),
        "machine": {"system": platform.platform(), "processor": platform.machine(), "cores": os.cpu_count()},
        "kernels": kernel_info(),
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def strip_folders(command: list[str]) -> list[str]:
    """Return a command for publication: names of files replace paths of the machine."""
    return [Path(word).name if "/" in word else word for word in command]


def package_versions() -> dict[str, str | None]:
    """Return the installed versions of the packages that results depend on; None: not installed."""
    versions: dict[str, str | None] = dict.fromkeys(RECORDED_PACKAGES)
    for name in versions:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions


def _source_commit() -> str | None:
    """Return the commit of the source tree, with `+` if it was changed; None outside a checkout."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():  # git settings of a repository around it could run programs
        return None
    describe = ["git", "describe", "--always", "--abbrev=12", "--dirty=+"]
    try:
        commit = subprocess.run(describe, cwd=root, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    tracked = subprocess.run(["git", "ls-files", "--error-unmatch", __file__], cwd=root, capture_output=True)
    return commit.stdout.strip() if tracked.returncode == 0 else None
