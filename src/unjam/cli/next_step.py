"""What to type next: the line at the end of a verb, and after a stop."""

import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from unjam.cli.options import DEFAULT_WORKERS
from unjam.cli.output import aside
from unjam.errors import InputError, MissingPartError

if TYPE_CHECKING:
    from unjam.measures.statistics import Estimate


def say_next(why: str, *words: object) -> None:
    """Print a command line that makes sense now, whole: it is copied."""
    aside.print(f"{why}: {shlex.join(['unjam', *map(str, words)])}", soft_wrap=True, markup=False)


def after_drive(scenario: str, drivers: Sequence[str]) -> None:
    """Compare with people first, then learn on an expert, then look at what was learned."""
    from unjam.drivers.registry import DRIVERS

    experts = [driver for driver in drivers if driver.partition(":")[0] in DRIVERS and driver != "human"]
    if "human" not in drivers:
        say_next("compare with people", *_command_without_out(), "-d", "human")
    elif experts and len(experts) == len(drivers) - 1:
        say_next("learn on an expert", "train", scenario, "--expert", experts[-1], "--preset", "demo")
    elif drivers != ["human"]:
        say_next("see it", "watch", scenario, "-d", drivers[-1], "--video", f"{Path(scenario).stem}.gif")
    else:
        say_next("compare with an expert", *_command_without_out(), "-d", "pi")


def _command_without_out() -> list[str]:
    """Return what was typed, but for the folder that is now taken."""
    words = list(sys.argv[1:])
    if "--out" in words:
        place = words.index("--out")
        del words[place : place + 2]
    return [word for word in words if not word.startswith("--out=")]


def after_training(folder: Path, gain: "Estimate | None", steps: int) -> None:
    """Ship what gained, train on what did not; a single held-out seed shows nothing."""
    if gain is not None and not gain.low > 0:
        say_next("no gain is shown; train longer", "train", "--resume", folder, "--steps", 2 * steps)
    else:
        say_next("ship it", "export", folder, "--to", f"{folder.name}.unjam")


@contextmanager
def resumable(folder: Path, workers: int) -> Iterator[None]:
    """Say how a training goes on that is stopped in the midst of it."""
    try:
        yield
    except BaseException as stop:
        mendable = isinstance(stop, InputError | MissingPartError)
        if not mendable and (folder / "config.toml").is_file():
            once = [] if workers == DEFAULT_WORKERS else ["--workers", workers]
            say_next("go on with", "train", "--resume", folder, *once)
        raise
