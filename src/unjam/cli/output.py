"""Output of the command line: tables, JSON, progress on standard error, and suggestions of next commands."""

import json
import shlex
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from shutil import get_terminal_size
from textwrap import fill, wrap
from typing import Any, Self, TextIO

from rich.console import Console, ConsoleOptions, RenderableType
from rich.measure import Measurement
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from unjam.controller import DEFAULT_DRIVER
from unjam.drivers.registry import DRIVERS
from unjam.errors import InputError, MissingPartError
from unjam.files import to_json
from unjam.measures.metric_table import RowsByDriver, choose_baseline, metric_table
from unjam.measures.metrics import METRICS
from unjam.measures.statistics import Estimate, is_expert_unchanged
from unjam.measures.verdict import short_table_metrics, verdicts
from unjam.text import format_duration, printable, split_label

PROGRESS_LINE_SECONDS = 5.0  # interval of lines of progress without a terminal [s]
MIN_TIMED_SECONDS = 1.0  # elapsed time from which the remaining time is estimated
NARROW_COLUMN_WIDTHS = 18, 7  # columns of metrics and units in a narrow terminal [characters]
WIDE_OPTIONS_WIDTH = 130  # width of a terminal from which each row of an assessment is one line [characters]
MAX_HEADING_LENGTH = 45  # headings shorten longer names of drivers [characters]
TEXT_COLUMN_WIDTHS = {" ": 22, "\n": 15}
"""width of headings and verdicts, as that of most numbers [characters]; by separator of mean and interval"""


class TerminalConsole(Console):
    """A console that replaces control characters in texts from files."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Yield the segments of a renderable without control characters in the text."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(printable(segment.text), segment.style)


def _fixed_width(stream: TextIO) -> int | None:
    """Return the width for a file or pipe: COLUMNS or 80 characters; None for a terminal, which can be resized."""
    return None if stream.isatty() else get_terminal_size().columns


console = TerminalConsole(highlight=False, markup=False, emoji=False, width=_fixed_width(sys.stdout))
err_console = TerminalConsole(stderr=True, highlight=False, markup=False, emoji=False, width=_fixed_width(sys.stderr))
"""for progress and messages, because standard output is for results"""


def print_json(document: Any) -> None:
    """Print one JSON document; NaN, which JSON does not have, becomes null."""
    sys.stdout.write(to_json(document, indent=1) + "\n")


def new_table(text_columns: Sequence[str] = (), number_columns: Sequence[str] = ()) -> Table:
    """Return an empty table with columns of text, then columns of numbers.

    No text is cut. Names in the first column are not wrapped, so that they can be copied, but names of quantities are.
    """
    table = Table(box=None, pad_edge=False, header_style="bold", show_header=any(text_columns))
    for index, heading in enumerate(text_columns):
        is_name, color = index == 0 and "unit" not in text_columns, "dim" if heading == "unit" else None
        table.add_column(heading, style=color, overflow="fold", no_wrap=is_name)
    for heading in number_columns:
        table.add_column(heading, justify="right", overflow="fold")
    return table


def print_results(
    rows_by_driver: RowsByDriver, shows_all: bool, baseline: str = "", first_metrics: Sequence[str] = ()
) -> None:
    """Print verdicts on drivers, and the main metrics of their road or all metrics with differences."""
    for verdict in verdicts(rows_by_driver, baseline):
        for line in verdict.lines:
            print_wrapped(line)
    if shows_all:
        print_metrics(rows_by_driver, choose_baseline(rows_by_driver, baseline))
    else:
        print_metrics(rows_by_driver, "", (*first_metrics, *short_table_metrics(rows_by_driver)))
        err_console.print("all metrics, with differences: --all")


def print_wrapped(line: str) -> None:
    """Print a line, wrapped between words, with a hanging indent."""
    hanging = " " * (2 + len(line) - len(line.lstrip()))
    wrapping = {"subsequent_indent": hanging, "break_long_words": False, "break_on_hyphens": False}
    console.print(fill(line, console.width, **wrapping), soft_wrap=True)


def print_metrics(rows_by_driver: RowsByDriver, baseline: str, names: Iterable[str] = METRICS) -> None:
    """Print feasibility, metrics with 95 % confidence intervals, and the differences to a baseline if there is one.

    In a narrow terminal intervals are below means; if this does not suffice, there are several tables. Long names of
    drivers are listed below the tables.
    """
    headings, rows = metric_table(rows_by_driver, baseline, names)
    long_labels = [label for label in rows_by_driver if len(label) > MAX_HEADING_LENGTH]
    for number, label in enumerate(long_labels, 1):
        headings = [heading.replace(label, f"{label.partition(':')[0]}:… ({number})") for heading in headings]
    columns = {label: [index] for index, label in enumerate(rows_by_driver)}
    compared_labels = [label for label in columns if label != baseline]
    for label, index in zip(compared_labels, range(len(columns), len(headings)), strict=False):
        columns[label].append(index)  # a difference; without a baseline there are none

    def build_table(columns: Sequence[int], separator: str) -> Table:
        width = TEXT_COLUMN_WIDTHS[separator]
        table = new_table(("metric", "unit"), [break_label(headings[index], width) for index in columns])
        for column in table.columns[2:]:
            column.no_wrap = True
        if separator != " ":
            table.columns[0].width, table.columns[1].width = NARROW_COLUMN_WIDTHS
        for row in rows:
            cells = ((fill(row.cells[index].mean, width), row.cells[index].interval) for index in columns)
            texts = (Text.assemble(mean, separator, (ci, "dim")) if ci else Text(mean) for mean, ci in cells)
            table.add_row(row.label, row.unit, *texts)
        return table

    def fits(columns: Sequence[int], separator: str) -> bool:
        unlimited = console.options.update_width(10_000)
        return Measurement.get(console, unlimited, build_table(columns, separator)).maximum <= console.width

    separator = " " if fits(range(len(headings)), " ") else "\n"
    blocks = [list[int]()]
    for driver_columns in columns.values():
        block = sorted([*blocks[-1], *driver_columns])
        blocks[-1:] = [block] if not blocks[-1] or fits(block, separator) else [blocks[-1], driver_columns]
    for block in blocks:
        console.print(build_table(block, separator))
    for number, label in enumerate(long_labels, 1):
        console.print(f"({number}) " + break_label(label, console.width - 4).replace("\n", "\n    "), soft_wrap=True)


def break_label(label: str, width: int) -> str:
    """Break the name of a driver into lines of at most `width` characters, after punctuation if possible."""
    lines = [""]
    for part in (part for word in split_label(label) for part in wrap(word, width, drop_whitespace=False)):
        lines[-1:] = [lines[-1] + part] if len(lines[-1] + part) <= width else [lines[-1], part]
    return "\n".join(filter(None, lines))


def print_options(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print the main table of an assessment without its last two columns, which are verdicts."""
    is_narrow = console.width < WIDE_OPTIONS_WIDTH
    broken_headings = [text.replace(" − ", "\n− ").replace(" [", "\n[") if is_narrow else text for text in headings]
    table = new_table(broken_headings[:2], broken_headings[2:-2])
    table.columns[1].max_width, table.columns[1].overflow = NARROW_COLUMN_WIDTHS[0] - 6 if is_narrow else None, "fold"
    for column in table.columns[2:]:
        column.no_wrap = True
    for row in rows:
        table.add_row(*(text.replace(" [", "\n[") if is_narrow else text for text in row[:-2]))
    console.print(table)


def print_notes(notes: Sequence[str]) -> None:
    """Print notes on the metrics, one line each."""
    for note in notes:
        err_console.print(f"note: {note}", soft_wrap=True)


class ProgressReporter:
    """Shows the progress of counted work: a bar on a terminal, elsewhere occasional plain lines."""

    def __init__(self, label: str, unit: str = "", total: int | None = None) -> None:
        """Prepare to count work named `label` in steps named `unit`."""
        self._label, self._unit = label, f" {unit}" if unit else ""
        self._is_plain = not err_console.is_terminal
        columns = (TextColumn("{task.description}"), BarColumn(16), TaskProgressColumn(), TimeRemainingColumn())
        self._bar = Progress(*columns, console=err_console, transient=True, disable=self._is_plain)
        self._task, self._total = self._bar.add_task(label, total=total), total or 0
        self._done: dict[Any, int] = {}
        self._start_time: float | None = None  # time of the first report
        self._last_line = time.monotonic()

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if not self._is_plain:  # older versions of rich end a line even if the bar is disabled
            self._bar.stop()

    def __call__(self, done: int, total: int) -> None:
        """Show that `done` of `total` steps are done."""
        self._bar.update(self._task, completed=done, total=total)
        now = time.monotonic()
        self._start_time = self._start_time or now
        if self._is_plain and now - self._last_line > PROGRESS_LINE_SECONDS:
            self._last_line = now
            elapsed, remaining = now - self._start_time, ""
            if 0 < done < total and elapsed >= MIN_TIMED_SECONDS:
                remaining = f", {format_duration(elapsed * (total - done) / done)} left"
            err_console.print(f"{self._label}: {done:,} of {total:,}{self._unit}{remaining}")

    def begin(self, label: str, total: int) -> None:
        """Begin to count the steps of other work, named `label`, from zero."""
        self._label, self._total, self._done = label, total, {}
        self._start_time, self._last_line = None, time.monotonic()
        self._bar.reset(self._task, description=label, total=total)
        if self._is_plain:
            err_console.print(label)

    def update(self, episode: Any, steps: int) -> None:
        """Show the progress of parallel episodes, of which one has made `steps` steps."""
        self._done[episode] = steps
        self(sum(self._done.values()), self._total)


def print_next_command(reason: str, *arguments: object) -> None:
    """Suggest a command line without line breaks, so that it can be copied."""
    err_console.print(f"{reason}: {shlex.join(['unjam', *map(str, arguments)])}", soft_wrap=True)


def suggest_after_drive(
    scenario: str,
    drivers: Sequence[str],
    changes: Mapping[str, Any],
    reward: str,
    backend: str = "sumo",
    is_drawable: bool = True,
    controller: str = DEFAULT_DRIVER,
) -> None:
    """Suggest the next command on the same road: compare drivers, train on an expert, or watch a controller."""
    controllers = [driver for driver in drivers if driver != "human"]
    if "human" not in drivers:
        print_next_command("compare with human drivers", *arguments_without("--out"), "-d", "human")
    elif not controllers:
        print_next_command("compare with a controller", *arguments_without("--out"), "-d", controller)
    elif all(driver.partition(":")[0] in DRIVERS for driver in controllers):
        command = "train", scenario, "--expert", controllers[-1], "--preset", "demo"
        options = setting_options(changes, "scenario_options.", reward, backend)
        print_next_command("train on an expert", *command, *options)
    elif is_drawable and not controllers[-1].partition(":")[0].endswith(".zip"):  # cannot run in a worker
        command = "watch", scenario, "-d", controllers[-1], "--video", f"{Path(scenario).stem}.gif"
        print_next_command(f"watch {controllers[-1]}", *command, *setting_options(changes, backend=backend))


def setting_options(
    changes: Mapping[str, Any], prefix: str = "", reward: str = "", backend: str = "sumo"
) -> Iterator[str]:
    """Yield command-line options that set these values, each key with `prefix`, the reward, and the backend.

    A command with a prefix has a configuration, in which the backend is a setting.
    """
    if reward:
        yield from ("--reward", reward)
    if backend != "sumo":
        yield from ("--set", f"backend={backend}") if prefix else ("--backend", backend)
    for key, value in changes.items():
        yield from ("--set", f"{prefix}{key}={setting_text(value)}")


def setting_text(value: Any) -> str:
    """Return a value as `--set` reads it: a text unchanged, other values as TOML."""
    return value if isinstance(value, str) else _toml_text(value)


def _toml_text(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key} = {_toml_text(entry)}' for key, entry in value.items())}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml_text, value))}]"
    return json.dumps(value)


def arguments_without(*options: str) -> list[str]:
    """Return the arguments of the running command without these options, which have values."""
    arguments, words = list[str](), iter(sys.argv[1:])
    for word in words:
        if word in options:
            next(words, "")
        elif not any(word.startswith(f"{option}=" if option.startswith("--") else option) for option in options):
            arguments.append(word)
    return arguments


def suggest_after_training(folder: Path, gain: "Estimate | None", steps: int, run: Path, is_finished: bool) -> None:
    """Suggest to export the controller if its gain is positive or unknown, or else to continue an unfinished training.

    `folder` has the results of one road, and `run` the training; for a training on one road both are the same. `gain`
    is None for a single test seed.
    """
    if gain is None or gain.low > 0:
        print_next_command("export it", "export", folder, "--out", f"{folder.name}.unjam")
    elif not is_finished:
        reason = "no gain is shown"
        if is_expert_unchanged(gain):
            reason = "the controller drives as its expert: no network was better in validation"
        print_next_command(f"{reason}; train longer", "train", "--resume", run, "--steps", 2 * steps)


@contextmanager
def suggest_resume(file: Path, *command: object) -> Iterator[None]:
    """Print the command that resumes the work if the block raises an error, and `file`, which it needs, exists."""
    try:
        yield
    except BaseException as error:
        if not isinstance(error, InputError | MissingPartError) and file.is_file():
            print_next_command("resume with", *command)
        raise
