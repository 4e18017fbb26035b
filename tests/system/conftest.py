"""Calling the command line as a user does."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

Run = Callable[..., subprocess.CompletedProcess[str]]

ROOT = Path(__file__).parents[2]
UNJAM = Path(sys.executable).with_name("unjam")
PLAIN = {"NO_COLOR": "1"}


@pytest.fixture(scope="session")
def warm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """Runs `unjam` in a folder, in a process of its own that need not import torch again."""
    place = tmp_path_factory.mktemp("warm")
    with subprocess.Popen(
        [sys.executable, "-m", "tests.system.warm"],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **PLAIN},
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None

        def run(*arguments: str, folder: Path, pictures: bool) -> subprocess.CompletedProcess[str]:
            out, errors = place / "out", place / "errors"
            request = {"arguments": arguments, "folder": str(folder), "out": str(out), "errors": str(errors)}
            print(json.dumps({**request, "pictures": pictures}), file=process.stdin, flush=True)
            assert process.stdout is not None
            code = int(process.stdout.readline())
            return subprocess.CompletedProcess(arguments, code, out.read_text(), errors.read_text())

        yield run
        process.stdin.close()


@pytest.fixture
def unjam(tmp_path: Path, warm: Run) -> Run:
    """Runs `unjam` with arguments in an empty folder; as a new process where its surroundings differ.

    Without `snapshots` those of a report are left empty, where nobody looks at them; a new process draws them.
    """

    def run(
        *arguments: object, environment: Mapping[str, str] | None = None, pictures: bool = True, **options: Any
    ) -> subprocess.CompletedProcess[str]:
        words = [str(argument) for argument in arguments]
        if environment is None and not options:
            return warm(*words, folder=tmp_path, pictures=pictures)
        return subprocess.run(
            [UNJAM, *words],
            cwd=tmp_path,
            env={**os.environ, **PLAIN, **(environment or {})},
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
            **options,
        )

    return run
