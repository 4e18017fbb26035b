"""Run the command line like a user."""

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
PLAIN = {"NO_COLOR": "1", "COLUMNS": "160"}


@pytest.fixture(scope="session")
def preloaded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """Run `unjam` in a folder, in forks of a process that has imported torch."""
    output_folder = tmp_path_factory.mktemp("preloaded")
    with subprocess.Popen(
        [sys.executable, "-m", "tests.system.preloaded"],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **PLAIN},
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None

        def run(*arguments: str, folder: Path, pictures: bool) -> subprocess.CompletedProcess[str]:
            out, errors = output_folder / "out", output_folder / "errors"
            request = {"arguments": arguments, "folder": str(folder), "out": str(out), "errors": str(errors)}
            print(json.dumps({**request, "pictures": pictures}), file=process.stdin, flush=True)
            assert process.stdout is not None
            code = int(process.stdout.readline())
            return subprocess.CompletedProcess(arguments, code, out.read_text(), errors.read_text())

        yield run
        process.stdin.close()


@pytest.fixture
def unjam(tmp_path: Path, preloaded: Run) -> Run:
    """Run `unjam` with arguments in an empty folder; in a new process if its environment differs.

    With `pictures=False` the figures of a report are empty, which saves time; a new process always draws them.
    """

    def run(
        *arguments: object, environment: Mapping[str, str] | None = None, pictures: bool = True, **options: Any
    ) -> subprocess.CompletedProcess[str]:
        words = [str(argument) for argument in arguments]
        if environment is None and not options:
            return preloaded(*words, folder=tmp_path, pictures=pictures)
        return subprocess.run(
            [UNJAM, *words],
            cwd=options.pop("cwd", tmp_path),
            env={**os.environ, **PLAIN, **(environment or {})},
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
            **options,
        )

    return run
