"""What the command line prints: tables for people, one JSON document for programs, progress on the side."""

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from unjam.files import to_json

LINE_SECONDS = 5.0
"""time between two plain lines of progress where there is no terminal"""

PIPE_WIDTH = 160
"""columns of a table where there is no terminal"""

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


def metrics_table(rows_by_driver: dict[str, list[dict[str, Any]]]) -> Table:
    """Return the table of the verdict and all metrics: mean and 95 % bootstrap interval over episodes."""
    from unjam.measures.drivable import verdicts
    from unjam.measures.metrics import METRICS
    from unjam.measures.statistics import digits_of, estimate

    table = new_table(("metric", "unit"), list(map(escape, rows_by_driver)))
    table.add_row("could a car drive so?", "", *(said or "–" for said in verdicts(rows_by_driver).values()))
    for name, metric in METRICS.items():
        cells = []
        for rows in rows_by_driver.values():
            found = estimate([row[name] for row in rows])
            if found.count == 0:
                cells.append("–")
                continue
            digits = digits_of(found, metric.digits)
            mean, low, high = (f"{value:.{digits}f}" for value in (found.mean, found.low, found.high))
            interval = f" [dim]\\[{low}, {high}][/dim]" if found.count > 1 else ""
            share = f" [dim]{found.count} of {len(rows)}[/dim]" if found.count < len(rows) else ""
            cells.append(f"{mean}{interval}{share}")
        table.add_row(metric.label, metric.unit, *cells)
    return table


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
