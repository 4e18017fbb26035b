"""What the command line prints: tables, one JSON document, progress on the side, and what to type next."""

import json
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any, Self

from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from unjam.cli.options import DEFAULT_WORKERS
from unjam.errors import InputError, MissingPartError
from unjam.files import to_json

if TYPE_CHECKING:
    from unjam.measures.statistics import Estimate
    from unjam.measures.table import Cell

LINE_SECONDS = 5.0
"""time between two plain lines of progress where there is no terminal"""

PIPE_WIDTH = 160
"""columns of a table where there is no terminal"""
NARROW = 18, 7
"""columns of the names of metrics and of their units where there is little room"""
WORDS_WIDTH = 22
"""columns of headings and verdicts: as wide as most numbers with their intervals"""

for name, way in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
    if getattr(sys, name) is None:  # it was closed: what goes there goes nowhere, not into the next file
        setattr(sys, name, open(os.devnull, way))  # noqa: SIM115

console = Console(highlight=False, markup=False, width=None if sys.stdout.isatty() else PIPE_WIDTH)
aside = Console(stderr=True, highlight=False, markup=False, width=None if sys.stderr.isatty() else PIPE_WIDTH)
"""progress and messages: standard output is for results; names with brackets stay as they are in both"""


def print_json(document: Any) -> None:
    """Print one JSON document: NaN, which JSON does not know, becomes null."""
    sys.stdout.write(to_json(document, indent=1) + "\n")


def new_table(words: Sequence[str] = (), numbers: Sequence[str] = (), style: str = "bold") -> Table:
    """Return an empty table: columns of words (that of units dim), then of numbers; headings in `style`."""
    table = Table(box=None, pad_edge=False, header_style=style, show_header=bool(words))
    for heading in words:
        table.add_column(heading, style="dim" if heading == "unit" else None)
    for heading in numbers:
        table.add_column(heading, justify="right")
    return table


def print_metrics(rows_by_driver: dict[str, list[dict[str, Any]]]) -> None:
    """Print the verdict and all metrics, with 95 % intervals, and what each driver is beyond the baseline.

    Where not all drivers fit beside each other there are several tables; where not even one does, intervals
    stand below means.
    """
    from unjam.measures.table import baseline_of, headings_of, table_of

    baseline = baseline_of(rows_by_driver)
    headings, rows = headings_of(rows_by_driver, baseline), table_of(rows_by_driver, baseline)
    columns = {label: [number] for number, label in enumerate(rows_by_driver)}
    compared = [label for label in columns if label != baseline]
    for label, number in zip(compared, range(len(columns), len(headings)), strict=False):
        columns[label].append(number)  # nobody is compared without a baseline

    def of(chosen: Sequence[int], separator: str) -> Table:
        table = new_table(
            ("metric", "unit"), [fill(escape(headings[number]), WORDS_WIDTH) for number in chosen]
        )
        for column in table.columns[2:]:
            column.no_wrap = True
        if separator != " ":
            table.columns[0].width, table.columns[1].width = NARROW
        for row in rows:
            table.add_row(row.label, row.unit, *(_marked(row.cells[number], separator) for number in chosen))
        return table

    def fits(chosen: Sequence[int], separator: str) -> bool:
        unlimited = console.options.update_width(10 * PIPE_WIDTH)
        return Measurement.get(console, unlimited, of(chosen, separator)).maximum <= console.width

    separator = " " if all(fits(each, " ") for each in columns.values()) else "\n"
    blocks = [list[int]()]
    for each in columns.values():
        together = sorted([*blocks[-1], *each])
        if blocks[-1] and not fits(together, separator):
            blocks.append(each)
        else:
            blocks[-1] = together
    for block in blocks:
        console.print(of(block, separator), markup=True)


def print_notes(notes: Sequence[str]) -> None:
    """Print what a reader of the metrics should know, a line for each note."""
    for note in notes:
        aside.print(f"note: {note}", markup=False, soft_wrap=True)


def _marked(cell: "Cell", separator: str) -> str:
    """Return a cell in rich's markup: its interval dim, verdicts in lines."""
    interval = escape(cell.interval).join(("[dim]", "[/dim]")) if cell.interval else ""
    return separator.join(filter(None, (escape(fill(cell.mean, WORDS_WIDTH)), interval)))


class Counted:
    """Progress of things that are counted: a bar on a terminal, plain lines now and then elsewhere."""

    def __init__(self, label: str, unit: str = "", total: int | None = None) -> None:
        """Prepare to count what is called `label`, in `unit`."""
        self._label, self._unit = label, f" {unit}" if unit else ""
        self._plain = not aside.is_terminal
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self._bar = Progress(*columns, console=aside, transient=True, disable=self._plain)
        self._task = self._bar.add_task(label, total=total)
        self._last_line = time.monotonic()

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if not self._plain:  # it ends a line, even where it is disabled, in older versions of rich
            self._bar.stop()

    def __call__(self, done: int, of: int) -> None:
        """Note how many are done, and of how many."""
        self._bar.update(self._task, completed=done, total=of)
        if self._plain and time.monotonic() - self._last_line > LINE_SECONDS:
            self._last_line = time.monotonic()
            aside.print(f"{self._label}: {done:,} of {of:,}{self._unit}")


@contextmanager
def counting_steps(label: str, total: int) -> Iterator[Callable[[Any, int], None]]:
    """Show the progress of many episodes at once: call it with an episode and the steps it has come to."""
    done: dict[Any, int] = {}
    with Counted(label, "steps") as counted:

        def note(episode: Any, steps: int) -> None:
            done[episode] = steps
            counted(sum(done.values()), total)

        yield note


def say_next(why: str, *words: object) -> None:
    """Print a command line that makes sense now, whole: it is copied."""
    aside.print(f"{why}: {shlex.join(['unjam', *map(str, words)])}", soft_wrap=True, markup=False)


def after_drive(scenario: str, drivers: Sequence[str], changes: Mapping[str, Any], reward: str) -> None:
    """Compare with people first, then learn on an expert, then look at what was learned, on the same road."""
    from unjam.drivers.registry import DRIVERS

    experts = [driver for driver in drivers if driver.partition(":")[0] in DRIVERS and driver != "human"]
    if "human" not in drivers:
        say_next("compare with people", *_command_without_out(), "-d", "human")
    elif experts and len(experts) == len(drivers) - 1:
        learn = "train", scenario, "--expert", experts[-1], "--preset", "demo"
        say_next("learn on an expert", *learn, *as_options(changes, "road.", reward))
    elif others := [driver for driver in drivers if driver != "human"]:
        see = "watch", scenario, "-d", others[-1], "--video", f"{Path(scenario).stem}.gif"
        say_next("see it", *see, *as_options(changes))
    else:
        say_next("compare with an expert", *_command_without_out(), "-d", "pi")


def as_options(changes: Mapping[str, Any], prefix: str = "", reward: str = "") -> Iterator[str]:
    """Yield the options that ask for a reward, if there is one, and change a scenario so."""
    if reward:
        yield from ("--reward", reward)
    for key, value in changes.items():
        yield from ("--set", f"{prefix}{key}={value if isinstance(value, str) else json.dumps(value)}")


def _command_without_out() -> list[str]:
    """Return what was typed, but for the folder that is now taken."""
    words = list(sys.argv[1:])
    if "--out" in words:
        place = words.index("--out")
        del words[place : place + 2]
    return [word for word in words if not word.startswith("--out=")]


def after_training(folder: Path, gain: "Estimate | None", steps: int, run: Path, over: bool) -> None:
    """Ship what gained, train on what did not, unless that is `over`; a single held-out seed shows nothing.

    `folder` is a road's, `run` that of the training: the same, where it is of one road.
    """
    if gain is not None and not gain.low > 0:
        if not over:
            say_next("no gain is shown; train longer", "train", "--resume", run, "--steps", 2 * steps)
    else:
        say_next("export it" if gain is None else "ship it", "export", folder, "--to", f"{folder.name}.unjam")


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
