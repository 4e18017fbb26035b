"""Tables, progress and suggested commands are printed as documented."""

import json
import os
import re
import shlex
import subprocess
import sys
from io import StringIO
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from unjam.cli import output
from unjam.cli.catalog import parameter_entries
from unjam.cli.options import parse_settings
from unjam.cli.train import _TrainingProgress
from unjam.measures.metric_table import choose_baseline
from unjam.measures.metrics import METRICS
from unjam.measures.statistics import estimate
from unjam.parameters import parse_assignments
from unjam.reports.assessment import OPTION_HEADINGS
from unjam.scenarios import SCENARIOS, Recorded, example_scenario
from unjam.training.config import RunConfig

USUAL: dict[str, Any] = {"status": "completed", "reason": "", **dict.fromkeys(METRICS, 1.0)}
LABELS = ("human", "pi", "idm", "a_long_file_of_mine.py:a_long_name_of_mine")


def rows_of(first: float) -> list[dict[str, Any]]:
    returns = (first, first + 100.0, first + 300.0)
    return [{**USUAL, "seed": seed, "return": value} for seed, value in enumerate(returns)]


def print_example(monkeypatch: pytest.MonkeyPatch, width: int, labels: tuple[str, ...] = LABELS) -> list[str]:
    text = StringIO()
    monkeypatch.setattr(output, "console", Console(file=text, width=width, highlight=False))
    rows = {label: rows_of(1000.0 * number) for number, label in enumerate(labels)}
    output.print_metrics(rows, choose_baseline(rows))
    return [line.rstrip() for line in text.getvalue().splitlines()]


@pytest.mark.parametrize("width", [80, 120, 160, 400])
def test_intervals_are_not_broken_and_lines_fit_the_terminal(monkeypatch: pytest.MonkeyPatch, width: int) -> None:
    lines = print_example(monkeypatch, width)
    assert max(map(len, lines)) <= width
    assert not any("…" in line for line in lines)
    assert all(line.count("[") == line.count("]") for line in lines)
    assert (
        sum(line.count("pi") for line in lines if line.startswith("metric")) >= 2
    )  # and the difference to the human baseline
    assert "+1000" in "\n".join(lines)


def test_verdicts_are_wrapped_also_without_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    text, label = StringIO(), "a_very_long_file_of_mine.py:a_very_long_name"
    monkeypatch.setattr(output, "console", output.TerminalConsole(file=text, width=80))
    output.print_results({"human": rows_of(1.0), label: rows_of(2.0)}, shows_all=False)
    lines = text.getvalue().splitlines()
    assert lines[0].startswith(f"{label}: ")
    assert lines[1].startswith("  "), "the verdict goes on"
    assert max(map(len, lines)) <= 80


@pytest.mark.parametrize(("columns", "width"), [({}, 80), ({"COLUMNS": "132"}, 132)])
def test_without_a_terminal_output_has_80_columns_or_as_many_as_columns_says(
    columns: dict[str, str], width: int
) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "COLUMNS"} | columns
    code = "from unjam.cli import output; print(output.console.width, output.err_console.width)"
    command = [sys.executable, "-c", code]
    found = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert found.stdout.split() == [str(width)] * 2


def test_names_are_printed_as_they_are() -> None:
    with output.console.capture() as text:
        output.print_results({"human": rows_of(1.0), "a.py:car:zero: [b]x": rows_of(2.0)}, shows_all=False)
    assert "a.py:car:zero: [b]x: " in text.get()


@pytest.mark.parametrize(
    ("label", "lines"),
    [
        ("my_driver.py:steady", ["my_driver.py:", "steady"]),
        ("a_name_without_end.py:f", ["a_name_without_", "end.py:f"]),
        ("unjam:ring-jammed-best", ["unjam:ring-", "jammed-best"]),
        ("pi", ["pi"]),
    ],
)
def test_headings_break_after_punctuation(label: str, lines: list[str]) -> None:
    assert output.break_label(label, 15).splitlines() == lines


def test_tables_cut_nothing_and_keep_names_whole() -> None:
    name, words = "a-run-with-a-long-name-001", "a-word-that-is-longer-than-its-column " * 3
    table = output.new_table(("run", "scenario", "state"), ("steps",))
    table.add_row(name, f"{words}end-of-{'x' * 90}", words, "1,234,567,890")
    text = StringIO()
    output.TerminalConsole(file=text, width=80).print(table)
    lines = text.getvalue().splitlines()
    assert max(len(line.rstrip()) for line in lines) <= 80
    assert any(line.startswith(f"{name} ") for line in lines)
    assert "…" not in text.getvalue()
    assert text.getvalue().count("x") >= 90


def test_wide_terminals_have_one_table(monkeypatch: pytest.MonkeyPatch) -> None:
    def tables(width: int) -> int:
        return sum(line.startswith("metric") for line in print_example(monkeypatch, width))

    assert (tables(400), tables(120) > 1) == (1, True)


@pytest.mark.parametrize("width", [80, 160])
def test_long_names_of_drivers_are_below_the_table(monkeypatch: pytest.MonkeyPatch, width: int) -> None:
    long_name = "pi:window=30,catch_up_speed=1.2,gap_lower=6,gap_upper=40,time_constant=0.9,first_command=zero"
    lines = print_example(monkeypatch, width, ("human", long_name))
    assert max(map(len, lines)) <= width
    assert any("pi:… (1)" in line for line in lines)
    below = lines[next(number for number, line in enumerate(lines) if line.startswith("(1) ")) :]
    assert "".join(line.strip() for line in below).removeprefix("(1) ") == long_name


def test_a_single_driver_is_not_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    assert print_example(monkeypatch, 120, ("pi",))[0].split() == ["metric", "unit", "pi"]


@pytest.fixture
def messages(monkeypatch: pytest.MonkeyPatch) -> StringIO:
    """Capture messages on standard error."""
    text = StringIO()
    monkeypatch.setattr(output, "err_console", Console(file=text, width=400))
    return text


def test_progress_says_at_once_what_begins_and_later_how_long_it_takes(
    messages: StringIO, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([0.0, 0.0, 1.0, 11.0, 20.0, 20.5])
    monkeypatch.setattr(output, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    progress = output.ProgressReporter("assessing", "steps")
    progress.begin("simulating seed 1 of 1", 100)
    progress.update("a", 10)
    progress.update("b", 10)
    progress.begin("simulating test seeds 1 to 3", 900)
    progress.update("a", 10)
    assert lines_of(messages) == [
        "simulating seed 1 of 1",
        "simulating seed 1 of 1: 20 of 100 steps, 40 s left",
        "simulating test seeds 1 to 3",
    ]


@pytest.mark.parametrize("words", ["--out x -n 9 -d a -d b", "--out=x -n9 -da --driver=b --episodes=3"])
def test_the_next_command_has_other_values_of_options(words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["unjam", "assess", "my.sumocfg", *words.split(), "--end", "60"])
    rest = output.arguments_without("--out", "--driver", "-d", "--episodes", "-n")
    assert rest == ["assess", "my.sumocfg", "--end", "60"]


@pytest.mark.parametrize("width", [80, 100, 160])
def test_main_table_of_an_assessment_fits_the_terminal(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    text = StringIO()
    monkeypatch.setattr(output, "console", Console(file=text, width=width, highlight=False))
    row = ["10 %", "follower-stopper", *["-10.4 [-20.4, +14.2]"] * 2, *["-1026 [-2021, +3074]"] * 2, "feasible", "yes"]
    output.print_options(OPTION_HEADINGS, [row])
    lines = text.getvalue().splitlines()
    assert max(len(line.rstrip()) for line in lines) <= width
    assert text.getvalue().count("[-20.4, +14.2]") == text.getvalue().count("[-2021, +3074]") == 2


def test_progress_names_the_road_with_the_smallest_difference(
    messages: StringIO, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.modules[_TrainingProgress.__module__], "err_console", output.err_console)
    row = {"iteration": 1, "environment_steps": 10, "return_mean": 5.0, "return_expert": 4.0}
    roads = {"ring": {"return_validation": 9.0, "return_expert": 3.0}, "eight": {"return_validation": 1.0}}
    roads["eight"]["return_expert"] = 4.4
    monkeypatch.setattr(sys.modules[_TrainingProgress.__module__], "planned_steps", lambda config: 30)
    with _TrainingProgress(RunConfig(steps=25), Path("run")) as progress:
        progress.show_iteration({**row, "return_validation": 6.0, "tasks": roads})
        progress.show_iteration(
            {**row, "iteration": 11, "environment_steps": 30, "return_validation": None, "tasks": {}}
        )
    text = "return 5, validation 6 at 10 (expert 4; smallest difference on eight: -3)"
    lines = [line.partition("steps, ")[2] for line in messages.getvalue().splitlines()]
    assert lines == [f"{text}, 0 s left", text]
    assert "30 of 30 steps" in messages.getvalue(), "the steps that will be trained, not those of the configuration"


@pytest.mark.parametrize(("first", "expected"), [(1, ["3 min", "20 s"]), (21, ["", "10 s"])])
def test_progress_has_the_time_that_is_left(
    messages: StringIO, monkeypatch: pytest.MonkeyPatch, first: int, expected: list[str]
) -> None:
    module = sys.modules[_TrainingProgress.__module__]
    monkeypatch.setattr(module, "err_console", output.err_console)
    clock = iter([0.0, 50.0, 80.0])
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    row = {"return_mean": 5.0, "return_expert": 4.0, "return_validation": None}
    monkeypatch.setattr(module, "planned_steps", lambda config: config.steps)
    progress = _TrainingProgress(RunConfig(steps=50), Path("run"))
    for iteration, steps in ((first, 10), (first + 5, 40)):
        progress.show_iteration({**row, "iteration": iteration, "environment_steps": steps})
    left = [line.partition("expert 4)")[2].removeprefix(", ").removesuffix(" left") for line in lines_of(messages)]
    assert left == expected


@pytest.mark.parametrize(("iterations", "seconds", "lines"), [(6, 1.0, 6), (1000, 1.0, 21), (1000, 100.0, 160)])
def test_progress_has_lines_at_equal_steps_and_no_long_silence(
    messages: StringIO, monkeypatch: pytest.MonkeyPatch, iterations: int, seconds: float, lines: int
) -> None:
    module = sys.modules[_TrainingProgress.__module__]
    monkeypatch.setattr(module, "err_console", output.err_console)
    monkeypatch.setattr(module, "planned_steps", lambda config: config.steps)
    clock = iter(seconds * number for number in range(iterations + 1))
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    progress = _TrainingProgress(RunConfig(steps=100 * iterations), Path("run"))
    row = {"return_mean": 5.0, "return_expert": 4.0, "return_validation": None}
    for iteration in range(1, iterations + 1):
        progress.show_iteration({**row, "iteration": iteration, "environment_steps": 100 * iteration})
    found = lines_of(messages)
    assert len(found) == lines
    assert all(line.endswith(" left") for line in found[:-1])
    assert f"{100 * iterations:,} of {100 * iterations:,} steps" in found[-1]


def lines_of(messages: StringIO) -> list[str]:
    return messages.getvalue().splitlines()


def test_human_drivers_are_to_be_compared_with_the_controller_of_the_road(
    messages: StringIO, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["unjam", "drive", "recorded", "-d", "human"])
    output.suggest_after_drive("recorded", ["human"], {}, "", controller=Recorded.controller)
    suggestion = "compare with a controller: unjam drive recorded -d human -d unjam:recorded-tuned\n"
    assert messages.getvalue() == suggestion


def test_a_training_on_several_roads_is_resumed_as_a_whole(messages: StringIO) -> None:
    output.suggest_after_training(Path("runs/all/ring"), estimate([0.0] * 3), 100, Path("runs/all"), is_finished=False)
    assert "unjam train --resume runs/all --steps 200" in messages.getvalue()
    assert "drives as its expert: no network was better" in messages.getvalue()


def test_a_training_that_changed_the_expert_without_a_gain_is_not_called_its_expert(messages: StringIO) -> None:
    output.suggest_after_training(Path("runs/one"), estimate([-1.0, 1.0, 0.5]), 100, Path("runs/one"), False)
    assert messages.getvalue() == "no gain is shown; train longer: unjam train --resume runs/one --steps 200\n"


def test_a_finished_training_is_exported_if_it_gained(messages: StringIO) -> None:
    output.suggest_after_training(Path("runs/one"), estimate([0.0, 0.0]), 100, Path("runs/one"), is_finished=True)
    assert messages.getvalue() == ""
    output.suggest_after_training(Path("runs/one"), estimate([5.0, 6.0, 7.0]), 100, Path("runs/one"), is_finished=True)
    assert messages.getvalue() == "export it: unjam export runs/one --out one.unjam\n"


@pytest.mark.parametrize(
    ("drivers", "changes", "command", "backend"),
    [
        (
            ["human", "unjam:best"],
            {"population": "unjam:ngsim", "length": [230, 240]},
            "unjam watch ring -d unjam:best --video ring.gif --set population=unjam:ngsim --set 'length=[230, 240]'",
            "sumo",
        ),
        (
            ["human", "pi"],
            {"cavs": 2, "actuation": "raw"},
            "unjam train ring --expert pi --preset demo --reward eq16 --set scenario_options.cavs=2 "
            "--set scenario_options.actuation=raw",
            "sumo",
        ),
        (["unjam:best", "human"], {}, "unjam watch ring -d unjam:best --video ring.gif", "sumo"),
        (["unjam:best", "human"], {}, "unjam watch ring -d unjam:best --video ring.gif --backend batch", "batch"),
        (["pi", "human"], {}, "unjam train ring --expert pi --preset demo --reward eq16 --set backend=batch", "batch"),
    ],
)
def test_the_command_after_a_drive_is_for_the_same_road(
    drivers: list[str], changes: dict[str, Any], command: str, backend: str, messages: StringIO
) -> None:
    output.suggest_after_drive("ring", drivers, changes, "eq16", backend)
    proposed = messages.getvalue().strip().partition(": ")[2]
    assert proposed == command
    settings = [word for option, word in pairwise(shlex.split(proposed)) if option == "--set"]
    parsed = parse_assignments(settings, "--set")
    assert parsed.pop("backend", backend) == backend
    assert {key.removeprefix("scenario_options."): value for key, value in parsed.items()} == changes


def test_the_evaluation_after_a_training_shows_its_progress(
    messages: StringIO, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.modules[_TrainingProgress.__module__], "err_console", output.err_console)
    monkeypatch.setattr(output, "PROGRESS_LINE_SECONDS", -1.0)
    monkeypatch.setattr(sys.modules[_TrainingProgress.__module__], "evaluation_steps", lambda config, folder: 3000)
    with _TrainingProgress(RunConfig(), Path("run")) as progress:
        for episode, steps in ((("pi", 0), 500), (("pi", 1), 500), (("pi", 0), 1500)):
            progress.show_evaluation(episode, steps)
    label = "evaluating on test seeds"
    lines = [f"{label}: {steps} of 3,000 steps" for steps in ("500", "1,000", "2,000")]
    assert messages.getvalue().splitlines() == [label, *lines]


HOSTILE_TEXT = "road\x1b[31m\u202ered\x9b2J\x07\u2066"


def table_of(text: str) -> Table:
    table = Table(title=text)
    table.add_column(text)
    table.add_row(Text(text, "bold"))
    return table


@pytest.mark.parametrize("printed", [HOSTILE_TEXT, Text(HOSTILE_TEXT), table_of(HOSTILE_TEXT), Panel(HOSTILE_TEXT)])
@pytest.mark.parametrize("is_terminal", [False, True])
def test_texts_of_strangers_do_not_control_the_terminal(printed: Any, is_terminal: bool) -> None:
    text = StringIO()
    console = output.TerminalConsole(file=text, width=80, force_terminal=is_terminal, color_system=None)
    console.print(printed)
    assert "red" in text.getvalue()
    assert not {"\x1b[31m", "\u202e", "\x9b", "\x07", "\u2066"} & set(re.split(r"(\x1b\[31m|.)", text.getvalue()))


def test_a_console_keeps_styles_and_no_break_spaces() -> None:
    text = StringIO()
    output.TerminalConsole(file=text, width=80, force_terminal=True, color_system="standard").print(
        Text("1.0\u00a0[0.9, 1.1] – ü", "red")
    )
    assert text.getvalue() == "\x1b[31m1.0\u00a0[0.9, 1.1] – ü\x1b[0m\n"


@pytest.mark.parametrize("name", SCENARIOS)
def test_defaults_of_parameters_are_shown_as_they_are_set(name: str) -> None:
    for entry in parameter_entries(example_scenario(name)):
        default = entry["default"]
        for value in default.values() if isinstance(default, dict) else (default,):
            if value is not None:
                expected = json.loads(json.dumps(value))
                assert parse_settings([f"x={output.setting_text(value)}"]) == {"x": expected}, entry["name"]
