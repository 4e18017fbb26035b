"""Leaderboards: comparison of result files, those of strangers included."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from unjam.benchmarks.leaderboard import leaderboard_figure, leaderboard_rows, read_leaderboard
from unjam.benchmarks.result import FAMILY_METRICS, read_result, write_result
from unjam.cli import app
from unjam.errors import InputError

RESULTS = Path(__file__).parents[2] / "results/benchmark"
FILES = sorted(RESULTS.glob("*.json"))
PI = RESULTS / "pi.json"
RING = "ring-22-dense"


def edited(tmp_path: Path, edit: Callable[[dict[str, Any]], object]) -> Path:
    """Return a copy of a result after an edit by hand."""
    content = json.loads(PI.read_text())
    edit(content)
    file = tmp_path / "edited.json"
    file.write_text(json.dumps(content))
    return file


def set_entry(*path: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def edit(content: dict[str, Any]) -> None:
        for key in path[:-1]:
            content = content[key]
        content[path[-1]] = value

    return edit


def test_stored_results_are_ranked_by_their_mean_gain() -> None:
    results = read_leaderboard(FILES)
    gains = [result.mean_gain().mean for result in results.values()]
    assert gains == sorted(gains, reverse=True)
    assert results["human"].mean_gain().mean == 0.0
    assert next(iter(results)) == "unjam:best"
    assert len(leaderboard_figure(results).axes[0].get_yticklabels()) == len(FILES) == len(leaderboard_rows(results))


def test_gains_follow_from_the_rows_and_the_references() -> None:
    result = read_result(PI)
    assert result.gains()["ring-66-growing-2-cavs"] == pytest.approx(1.0, abs=1e-6), "PI is the best expert there"
    with pytest.raises(InputError, match=r"part: 'unsen' is not allowed; allowed: all roads, .* mean 'unseen'"):
        result.mean_gain("unsen")
    name, worst = result.worst_road
    assert worst == min(result.gains().values()) == result.gains()[name]


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (set_entry("suite", value="motorways-v1"), "'ring-22-no-warm-up' is not in motorways-v1"),
        (set_entry("suite", value="closed-roads-v9"), "suite: 'closed-roads-v9' is not allowed"),
        (set_entry("format", value=2), "format: it is not 1"),
        (set_entry("seeds", value=[[1, 2]]), "seeds"),
        (set_entry("driver", value=""), "driver"),
        (set_entry("training_steps", value="1e6"), "training_steps"),
        (set_entry("roads", value={}), "summary"),
        (set_entry("roads", RING, "driver", "mean_speed_second_half", value=[9.0] * 10), "summary.* from the rows"),
        (set_entry("roads", RING, "driver", "mean_speed_second_half", value=["9"] * 10), "numbers"),
        (set_entry("roads", RING, "driver", "mean_speed_second_half", value=[9e99] * 10), "summary.* from the rows"),
        (
            set_entry("roads", RING, "driver", "delay", value=[2.0, "x"] * 5),
            "delay: 'x' is not allowed; allowed: numbers",
        ),
        (
            set_entry("roads", RING, "driver", "status", value=["x", 2.0] * 5),
            "status: 2.0 is not allowed; allowed: texts",
        ),
        (set_entry("roads", RING, "driver", "mean_speed_second_half", value=[9.0]), "mean_speed_second_half"),
        (set_entry("roads", RING, "driver", "status", value=[None] * 10), "texts"),
        (set_entry("roads", RING, "driver", "speed", value=[9.0] * 10), "speed"),
        (set_entry("roads", RING, "driver", "code", value="import os"), "code"),
        (set_entry("summary", "feasible_roads", value=13), "summary.feasible_roads: 13 is not allowed; allowed: 12"),
        (lambda content: content["roads"].pop(RING), "summary"),
        (lambda content: (content["roads"].pop(RING), content.pop("summary")), "roads: 1 are missing"),
    ],
)
def test_files_that_contradict_themselves_are_refused_in_one_line(
    tmp_path: Path, edit: Callable[[dict[str, Any]], object], message: str
) -> None:
    file = edited(tmp_path, edit)
    with pytest.raises(InputError, match=message) as error:
        read_leaderboard([PI, file])
    assert str(error.value).startswith(f"{file}: ")
    assert "\n" not in str(error.value)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [1.2e9, 1e300, -1.7e308, 5e-324, 10**15])
def test_a_result_with_any_finite_numbers_can_be_read_again(value: float, tmp_path: Path) -> None:
    result, file = read_result(PI), tmp_path / "a.json"
    road = result.roads[RING]
    for name in FAMILY_METRICS[2:]:
        changed = replace(road, driver={**road.driver, name: [value] * 9 + [1.0]})
        written = replace(result, roads={**result.roads, RING: changed})
        write_result(file, written)
        assert read_leaderboard([file]) == {"pi": written}
        assert leaderboard_rows({"pi": written})


def test_another_human_baseline_is_refused(tmp_path: Path) -> None:
    result = read_result(PI)
    speeds = [value + 0.1 for value in result.roads[RING].baseline["mean_speed_second_half"]]  # pyright: ignore
    result.roads[RING].baseline["mean_speed_second_half"][:] = speeds
    with pytest.raises(InputError, match=r"ring-22-dense: performance of the human baseline .* as in closed-roads-v1"):
        result.check_comparable()


@pytest.mark.parametrize("content", [b"", b"[]", b"{", b"\xff", b'{"format": NaN}', b"[" * 100_000, b'"x"'])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "a.json"
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.json: it is not a result of `unjam benchmark`"):
        read_result(file)
    for other, reason in ((tmp_path, "it is not a file"), (tmp_path / "missing.json", "there is no such file")):
        with pytest.raises(InputError, match=f"^{other}: {reason}; allowed: a file of `unjam benchmark`$"):
            read_result(other)


def test_the_command_prints_eighty_columns_and_draws(tmp_path: Path) -> None:
    def rename(content: dict[str, Any]) -> None:
        content["driver"] = "$x^{$ \x1b[31m</svg>" + "y" * 60

    picture, file = tmp_path / "board.svg", edited(tmp_path, rename)
    ran = CliRunner().invoke(app, ["benchmark", "--compare", str(file), str(PI), "--out", str(picture)])
    assert ran.exit_code == 0, ran.output
    board = ran.stdout
    assert max(map(len, board.splitlines())) <= 80
    assert "ring-22-no-warm-up" in board
    assert "\x1b" not in board
    assert b"<svg" in picture.read_bytes()[:400]
    assert picture.read_bytes().count(b"</svg>") == 1
    labels = leaderboard_figure(read_leaderboard([file, PI])).axes[0].get_yticklabels()
    assert any(label.get_text().startswith("$x^{$ ?") and not label.get_parse_math() for label in labels)


@pytest.mark.parametrize(
    ("drivers", "labels"),
    [
        (("a", "b", "c"), ["a", "b", "c"]),
        (("pi", "pi", "b"), ["pi (0.json)", "pi (1.json)", "b"]),
        (("pi", "pi", "pi (0.json)"), ["1. pi (0.json)", "2. pi (1.json)", "3. pi (0.json)"]),
        (("pi\n", " pi", "p\x1b[2J"), ["pi (0.json)", "pi (1.json)", "p?[2J"]),
        (("x" * 300, "x" * 299, "b"), [f"{'x' * 33}… (0.json)", f"{'x' * 33}… (1.json)", "b"]),
    ],
)
def test_every_file_has_its_own_label(tmp_path: Path, drivers: tuple[str, ...], labels: list[str]) -> None:
    edits = [set_entry("driver", value=driver) for driver in drivers]
    files = [edited(tmp_path, edit).rename(tmp_path / f"{number}.json") for number, edit in enumerate(edits)]
    results = read_leaderboard(files)
    assert list(results) == labels
    assert [row[0] for row in leaderboard_rows(results)] == labels
