"""A training in a process of its own, for a program that imported NumPy before unjam: see `unjam.kernels`.

The child, `python -m unjam.training.apart`, reads one line of JSON and answers lines: a list of a word and
what belongs to it.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from unjam.errors import DiskError, EpisodeError, InputError, MissingPartError, UnjamError
from unjam.parameters import build
from unjam.training.config import RunConfig

KINDS = {kind.__name__: kind for kind in (InputError, MissingPartError, DiskError, EpisodeError)}

Rows = dict[str, list[dict[str, Any]]]
"""of metrics, one per episode, by driver"""
OnIteration = Callable[[dict[str, Any]], None]
"""called with each row of progress as it is written"""
OnProgress = Callable[[tuple[str, int], int], None]
"""called with how far the judgement is: ((driver, episode), decisions)"""


def train_apart(
    config: RunConfig,
    folder: Path,
    resume: bool,
    on_iteration: OnIteration | None,
    progress: OnProgress | None,
) -> dict[str, Rows]:
    """Train as `unjam.train` does, and return the rows of the judgement, by road and driver.

    Raises:
        UnjamError: of the same kind as in this process.
    """
    child = subprocess.Popen(
        [sys.executable, "-m", "unjam.training.apart"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        encoding="utf-8",
    )
    try:
        assert child.stdin is not None
        assert child.stdout is not None
        child.stdin.write(json.dumps([asdict(config), os.fspath(folder), resume, sys.path]))
        child.stdin.close()
        for line in child.stdout:
            word, *content = json.loads(line)
            if word == "row" and on_iteration is not None:
                on_iteration(content[0])
            elif word == "judged" and progress is not None:
                progress((content[0], content[1]), content[2])
            elif word == "error":
                raise KINDS.get(content[0], UnjamError)(content[1])
            elif word == "done":
                return content[0]
        raise UnjamError(f"training: its process ended with code {child.wait()}")
    finally:
        child.terminate()  # where it has ended by itself, this does nothing
        child.wait()


def main() -> None:
    """Train as the line on standard input says."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # SUMO and user code may print: not into the answers
    values, folder, resume, path = json.loads(sys.stdin.read())
    sys.path[:] = path  # a user's driver imports what it did in the program

    def say(*words: Any) -> None:
        print(json.dumps(words), file=answers, flush=True)

    try:
        from unjam.training.train import train_here

        rows = train_here(
            build(RunConfig, values, ""),
            Path(folder),
            resume,
            lambda row: say("row", row),
            lambda episode, steps: say("judged", *episode, steps),
        )
        say("done", rows)
    except UnjamError as error:
        say("error", type(error).__name__, str(error))


if __name__ == "__main__":
    main()
