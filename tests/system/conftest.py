"""Calling the command line as a user does."""

import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

Run = Callable[..., subprocess.CompletedProcess[str]]

UNJAM = Path(sys.executable).with_name("unjam")


@pytest.fixture
def unjam(tmp_path: Path) -> Run:
    """Runs `unjam` with arguments in an empty folder."""

    def run(
        *arguments: object, environment: Mapping[str, str] | None = None, **options: Any
    ) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [UNJAM, *map(str, arguments)],
            cwd=tmp_path,
            env={**os.environ, "NO_COLOR": "1", **(environment or {})},
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
            **options,
        )

    return run
