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
    from unjam.measures.metric_table import TableCell
    from unjam.measures.statistics import Estimate

PROGRESS_LINE_SECONDS = 5.0
"""time between two plain lines of progress where there is no terminal"""

PIPED_TABLE_WIDTH = 160
"""columns of a table where there is no terminal"""
NARROW_COLUMN_WIDTHS = 18, 7
"""columns of the names of metrics and of their units where there is little room"""
TEXT_COLUMN_WIDTH = 22
"""columns of headings and verdicts: as wide as most numbers with their intervals"""

for name, way in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
    if getattr(sys, name) is None:  # it was closed: what goes there goes nowhere, not into the next file
        setattr(sys, name, open(os.devnull, way))  # noqa: SIM115

console = Console(highlight=False, markup=False, width=None if sys.stdout.isatty() else PIPED_TABLE_WIDTH)
err_console = Console(
    stderr=True, highlight=False, markup=False, width=None if sys.stderr.isatty() else PIPED_TABLE_WIDTH
)
"""progress and messages: standard output is for results; names with brackets stay as they are in both"""


def print_json(document: Any) -> None:
    """Print one JSON document: NaN, which JSON does not know, becomes null."""
    sys.stdout.write(to_json(document, indent=1) + "\n")


def new_table(text_columns: Sequence[str] = (), number_columns: Sequence[str] = (), style: str = "bold") -> Table:
    """Return an empty table: columns of words (that of units dim), then of numbers; headings in `style`."""
    table = Table(box=None, pad_edge=False, header_style=style, show_header=bool(text_columns))
    for heading in text_columns:
        table.add_column(heading, style="dim" if heading == "unit" else None)
    for heading in number_columns:
        table.add_column(heading, justify="right")
    return table


def print_metrics(rows_by_driver: dict[str, list[dict[str, Any]]]) -> None:
    """Print the verdict and all metrics, with 95 % intervals, and what each driver is beyond the baseline.

    Where not all drivers fit beside each other there are several tables; where not even one does, intervals
    stand below means.
    """
    from unjam.measures.metric_table import choose_baseline, metric_table, table_headings

    baseline = choose_baseline(rows_by_driver)
    headings, rows = table_headings(rows_by_driver, baseline), metric_table(rows_by_driver, baseline)
    columns = {label: [number] for number, label in enumerate(rows_by_driver)}
    compared = [label for label in columns if label != baseline]
    for label, number in zip(compared, range(len(columns), len(headings)), strict=False):
        columns[label].append(number)  # nobody is compared without a baseline

    def build_table(columns: Sequence[int], separator: str) -> Table:
        table = new_table(("metric", "unit"), [fill(escape(headings[number]), TEXT_COLUMN_WIDTH) for number in columns])
        for column in table.columns[2:]:
            column.no_wrap = True
        if separator != " ":
            table.columns[0].width, table.columns[1].width = NARROW_COLUMN_WIDTHS
        for row in rows:
            table.add_row(row.label, row.unit, *(_cell_markup(row.cells[number], separator) for number in columns))
        return table

    def fits(columns: Sequence[int], separator: str) -> bool:
        unlimited = console.options.update_width(10 * PIPED_TABLE_WIDTH)
        return Measurement.get(console, unlimited, build_table(columns, separator)).maximum <= console.width

    separator = " " if all(fits(each, " ") for each in columns.values()) else "\n"
    blocks = [list[int]()]
    for each in columns.values():
        together = sorted([*blocks[-1], *each])
        if blocks[-1] and not fits(together, separator):
            blocks.append(each)
        else:
            blocks[-1] = together
    for block in blocks:
        console.print(build_table(block, separator), markup=True)


def print_notes(notes: Sequence[str]) -> None:
    """Print what a reader of the metrics should know, a line for each note."""
    for note in notes:
        err_console.print(f"note: {note}", markup=False, soft_wrap=True)


def _cell_markup(cell: "TableCell", separator: str) -> str:
    """Return a cell in rich's markup: its interval dim, verdicts in lines."""
    interval = escape(cell.interval).join(("[dim]", "[/dim]")) if cell.interval else ""
    return separator.join(filter(None, (escape(fill(cell.mean, TEXT_COLUMN_WIDTH)), interval)))


class ProgressReporter:
    """Progress of things that are counted: a bar on a terminal, plain lines now and then elsewhere."""

    def __init__(self, label: str, unit: str = "", total: int | None = None) -> None:
        """Prepare to count what is called `label`, in `unit`."""
        self._label, self._unit = label, f" {unit}" if unit else ""
        self._is_plain = not err_console.is_terminal
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self._bar = Progress(*columns, console=err_console, transient=True, disable=self._is_plain)
        self._task = self._bar.add_task(label, total=total)
        self._last_line = time.monotonic()

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if not self._is_plain:  # it ends a line, even where it is disabled, in older versions of rich
            self._bar.stop()

    def __call__(self, done: int, total: int) -> None:
        """Note how many are done, and of how many."""
        self._bar.update(self._task, completed=done, total=total)
        if self._is_plain and time.monotonic() - self._last_line > PROGRESS_LINE_SECONDS:
            self._last_line = time.monotonic()
            err_console.print(f"{self._label}: {done:,} of {total:,}{self._unit}")


@contextmanager
def report_steps(label: str, total: int) -> Iterator[Callable[[Any, int], None]]:
    """Show the progress of many episodes at once: call it with an episode and the steps it has come to."""
    done: dict[Any, int] = {}
    with ProgressReporter(label, "steps") as counted:

        def update(episode: Any, steps: int) -> None:
            done[episode] = steps
            counted(sum(done.values()), total)

        yield update


def print_next_command(reason: str, *arguments: object) -> None:
    """Print a command line that makes sense now, whole: it is copied."""
    err_console.print(f"{reason}: {shlex.join(['unjam', *map(str, arguments)])}", soft_wrap=True, markup=False)


def suggest_after_drive(scenario: str, drivers: Sequence[str], changes: Mapping[str, Any], reward: str) -> None:
    """Compare with people first, then learn on an expert, then look at what was learned, on the same road."""
    from unjam.drivers.registry import DRIVERS

    experts = [driver for driver in drivers if driver.partition(":")[0] in DRIVERS and driver != "human"]
    if "human" not in drivers:
        print_next_command("compare with people", *_arguments_without_out(), "-d", "human")
    elif experts and len(experts) == len(drivers) - 1:
        learn = "train", scenario, "--expert", experts[-1], "--preset", "demo"
        print_next_command("learn on an expert", *learn, *setting_options(changes, "road.", reward))
    elif others := [driver for driver in drivers if driver != "human"]:
        see = "watch", scenario, "-d", others[-1], "--video", f"{Path(scenario).stem}.gif"
        print_next_command("see it", *see, *setting_options(changes))
    else:
        print_next_command("compare with an expert", *_arguments_without_out(), "-d", "pi")


def setting_options(changes: Mapping[str, Any], prefix: str = "", reward: str = "") -> Iterator[str]:
    """Yield the options that ask for a reward, if there is one, and change a scenario so."""
    if reward:
        yield from ("--reward", reward)
    for key, value in changes.items():
        yield from ("--set", f"{prefix}{key}={value if isinstance(value, str) else json.dumps(value)}")


def _arguments_without_out() -> list[str]:
    """Return what was typed, but for the folder that is now taken."""
    words = list(sys.argv[1:])
    if "--out" in words:
        place = words.index("--out")
        del words[place : place + 2]
    return [word for word in words if not word.startswith("--out=")]


def suggest_after_training(folder: Path, gain: "Estimate | None", steps: int, run: Path, is_finished: bool) -> None:
    """Ship what gained, train on what did not, unless that is `over`; a single held-out seed shows nothing.

    `folder` is a road's, `run` that of the training: the same, where it is of one road.
    """
    if gain is not None and not gain.low > 0:
        if not is_finished:
            print_next_command("no gain is shown; train longer", "train", "--resume", run, "--steps", 2 * steps)
    else:
        print_next_command("export it" if gain is None else "ship it", "export", folder, "--to", f"{folder.name}.unjam")


@contextmanager
def suggest_resume(folder: Path, workers: int) -> Iterator[None]:
    """Say how a training goes on that is stopped in the midst of it."""
    try:
        yield
    except BaseException as stop:
        mendable = isinstance(stop, InputError | MissingPartError)
        if not mendable and (folder / "config.toml").is_file():
            once = [] if workers == DEFAULT_WORKERS else ["--workers", workers]
            print_next_command("go on with", "train", "--resume", folder, *once)
        raise
