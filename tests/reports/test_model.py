import base64
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from unjam.reports.figures import data_uri
from unjam.reports.model import (
    PREDICTED_QUANTITIES,
    bound_summary,
    error_cells,
    error_figure,
    error_headings,
    error_rows,
    error_text,
    error_verdict,
    example_figure,
    model_section,
    rollout_figure,
    rollout_summary,
)
from unjam.reports.results import Results

MEMBERS, MOMENTS, EXAMPLES = 4, 20, 2


def facts_of(**changes: Any) -> dict[str, Any]:
    """What `model.json` says of a model that halves the error of its base, but for the follower's."""
    seconds = np.linspace(0.5, 10.0, MOMENTS)
    ahead = {
        name: {
            "model": 0.05 * seconds if name != "follower_gap" else 0.3 * seconds,
            "spread": 0.01 * seconds,
            "base": 0.1 * seconds if name != "speed" else 0.0 * seconds,
            "change": 0.2 * seconds,
        }
        for name in PREDICTED_QUANTITIES
        if name != "reward"
    }
    ahead["speed"]["model"] = 1e-7 * seconds
    line = 5.0 + np.sin(seconds)
    example = {"actual": line, "members": [line + 0.1 * n for n in range(MEMBERS)], "base": line + 1.0}
    numbers = {"leader_gap": example, "leader_speed": example}
    steps = {name: {"base": 0.02, "model": 0.01, "change": 0.03} for name in PREDICTED_QUANTITIES}
    steps["speed"] = {"base": 0.0, "model": 0.0, "change": 0.01}
    steps["follower_gap"] = {"base": 0.02, "model": 0.03, "change": 0.03}
    bins = {
        "at": [1.0, 2.0, 5.0],
        "decisions": [10, 10, 10],
        "base": {name: [0.1, 0.2, 0.3] for name in PREDICTED_QUANTITIES},
        "model": {name: [0.1, 0.1, 0.1] for name in PREDICTED_QUANTITIES},
    }
    facts = {
        "iteration": 3,
        "base": "idm",
        "members": MEMBERS,
        "control_step": 0.1,
        "k_star": 12,
        "held_out": 1234,
        "one_step": steps,
        "where": {"leader_gap": bins, "speed": bins},
        "replay": {
            "seconds": seconds,
            "starts": 50,
            "numbers": ahead,
            "examples": [{"begins": 10.0 * n, "drawn": [0.2], "numbers": numbers} for n in range(EXAMPLES)],
        },
        "bound": {
            "eps_pi": 0.2,
            "eps_m": 0.1,
            "max_reward": 1.0,
            "largest_return": 1000.0,
            "k": [1, 10, 100],
            "C": [9000.0, 5000.0, 80000.0],
        },
    }
    return {**json.loads(json.dumps(facts, default=np.ndarray.tolist)), **changes}


def progress_of(**virtual: Any) -> list[dict[str, Any]]:
    """Rows of progress of a run with a virtual environment."""
    errors = {"unexplained": 0.15, "total_variation": 0.1, "released": 0.3}
    facts = {"k_star": 12, "eps_m": 0.15, "eps_m_by_estimator": errors, "return_virtual": 5.5}
    facts |= {"return_actual": 5.25, **virtual}
    return [
        {
            "iteration": number,
            "environment_steps": 12_000 * number,
            "return_mean": 90.0,
            "return_expert": 100.0,
            "return_validation": 101.0,
            "virtual": facts,
            "seconds": {"actual": 2.0, "fit": 1.0, "imagine": 0.1, "update": 0.5},
        }
        for number in (1, 2, 3)
    ]


def test_the_table_has_each_number_now_and_later() -> None:
    facts = facts_of()
    assert error_headings(facts)[:3] == ["change, 0.1 s", "IDM alone, 0.1 s", "model, 0.1 s"]
    assert error_headings(facts)[-1] == "model, 10 s"
    table = {row["number"]: error_cells(row) for row in error_rows(facts)}
    assert table["leader's speed"] == ["0.03", "0.02", "0.01", "2", "1", "0.5"]
    assert table["own speed"] == ["0.01", "0", "0", "2", "0", "0"]
    assert table["reward"][3:] == ["–", "–", "–"]


@pytest.mark.parametrize(
    ("value", "text"), [(None, "–"), (3e-14, "0"), (0.00123, "0.0012"), (64.3, "64"), (9.96, "10")]
)
def test_errors_have_two_digits(value: float | None, text: str) -> None:
    assert error_text(value) == text


def test_the_verdict_names_what_is_better_and_what_is_worse() -> None:
    first, later = error_verdict(facts_of()).split(". ")
    assert first.startswith("One step ahead the model is less wrong than the base in leader's speed (by 50\u00a0%)")
    assert first.endswith("and more wrong in gap of the follower (by 50\u00a0%)")
    assert "own speed" not in first
    assert later.startswith("10 s ahead")
    assert later.endswith("and more wrong in gap of the follower (by 200\u00a0%).")


def test_a_base_that_knows_a_number_exactly_is_left_behind_by_no_share() -> None:
    facts = facts_of()
    facts["one_step"]["speed"] = {"base": 0.0, "model": 0.002, "change": 0.01}
    assert f"more wrong in {PREDICTED_QUANTITIES['speed'][0]}, " in error_verdict(facts)


def test_a_model_that_is_its_base_is_as_wrong() -> None:
    facts = facts_of()
    for found in (*facts["one_step"].values(), *facts["replay"]["numbers"].values()):
        found["model"] = found["base"]
    assert error_verdict(facts) == (
        "One step ahead the model is as wrong as its base. 10 s ahead the model is as wrong as its base."
    )


def test_virtual_and_actual_returns_stand_side_by_side() -> None:
    words = rollout_summary(progress_of())
    assert "k* = 12" in words
    assert "earns 5.50 in the virtual environment, and earned 5.25 in the actual one" in words


def test_without_rollouts_there_are_no_returns() -> None:
    words = rollout_summary(progress_of(k_star=0, return_virtual=None))
    assert "k* = 0" in words
    assert "earns" not in words


def test_the_bound_is_called_what_it_is() -> None:
    words = bound_summary(facts_of())
    assert "from 9,000 (k = 1) over 5,000 (k = 10) to 80,000 (k = 100)" in words
    assert words.endswith("= 1,000: even at its best it is 5 times that, so it says nothing.")


def test_a_bound_that_says_something_is_not_called_empty() -> None:
    bound = {**facts_of()["bound"], "C": [900.0, 250.0, 800.0]}
    assert bound_summary(facts_of(bound=bound)).endswith("at its best it is 0.25 of that.")
    assert bound_summary(facts_of(bound=None)) == ""


def test_only_runs_with_a_virtual_environment_have_a_section() -> None:
    def section(model: dict[str, Any] | None) -> dict[str, Any] | None:
        return model_section(Results(Path("run"), {}, {}, {}, progress_of(), "", model))

    assert section(None) is None
    found = section(facts_of(base="none"))
    assert found is not None
    assert "nothing known but that nothing changes, plus an ensemble of 4 networks" in found["about"]
    assert "1,234 decisions" in found["about"]
    assert [row["label"] for row in found["table"]] == [label for label, _ in PREDICTED_QUANTITIES.values()]


Draw = Callable[[], Figure]
PICTURES: dict[str, tuple[Draw, int]] = {
    "trust": (lambda: rollout_figure(progress_of(), facts_of()), 4),
    "errors": (lambda: error_figure(facts_of()), 6),
    "examples": (lambda: example_figure(facts_of()), 2 * EXAMPLES),
}


def titled(figure: Figure, words: str) -> list[Axes]:
    return [axes for axes in figure.axes if words in axes.get_title(loc="left")]


def drawn(axes: Axes) -> dict[str, np.ndarray]:
    """The lines of a panel, by label."""
    return {str(line.get_label()): np.asarray(line.get_ydata(), float) for line in axes.lines}


@pytest.mark.long
@pytest.mark.parametrize("name", PICTURES)
def test_every_panel_has_a_title_and_lines_and_a_picture_can_be_made(name: str) -> None:
    draw, panels = PICTURES[name]
    figure = draw()
    assert len(figure.axes) == panels
    assert all(axes.get_title(loc="left") and axes.get_xlabel() and axes.lines for axes in figure.axes)
    width, height = figure.get_size_inches()
    assert width > height
    assert data_uri(figure) == data_uri(draw())


def test_no_text_of_a_panel_lies_on_that_of_another() -> None:
    for draw, _ in PICTURES.values():
        figure = draw()
        figure.draw_without_rendering()
        boxes = [axes.get_tightbbox() for axes in figure.axes]
        for number, box in enumerate(boxes):
            for other in boxes[number + 1 :]:
                assert box is not None
                assert other is not None
                assert not (box.overlaps(other))


def test_each_member_is_a_line_beside_what_happened() -> None:
    figure = example_figure(facts_of())
    panels = titled(figure, "gap to the leader [m], from 10 s on")
    assert len(panels) == 1
    lines = panels[0].lines
    assert len(lines) == MEMBERS + 2
    found = facts_of()["replay"]["examples"][1]["numbers"]["leader_gap"]
    np.testing.assert_allclose(drawn(panels[0])["actual"], found["actual"])
    np.testing.assert_allclose(drawn(panels[0])["IDM alone"], found["base"])


def test_errors_are_drawn_with_the_spread_and_where_rollouts_end() -> None:
    (panel,) = titled(error_figure(facts_of()), "error: leader's speed [m/s]")
    found = facts_of()["replay"]["numbers"]["leader_speed"]
    lines = drawn(panel)
    for label, name in {"model, a member": "model", "spread of the members": "spread", "IDM alone": "base"}.items():
        np.testing.assert_allclose(lines[label], found[name])
    (end,) = [line for line in panel.lines if "k*" in str(line.get_label())]
    assert list(np.asarray(end.get_xdata())) == pytest.approx([1.2, 1.2])
    (panel,) = titled(error_figure(facts_of(k_star=0)), "error: leader's speed [m/s]")
    assert not any("k*" in label for label in drawn(panel))


def test_iterations_without_rollouts_leave_a_gap_in_the_returns() -> None:
    progress = progress_of()
    progress[0] = progress_of(return_virtual=None, return_actual=None)[0]
    (panel,) = titled(rollout_figure(progress, facts_of()), "earned in k* decisions")
    np.testing.assert_array_equal(drawn(panel)["virtual"], [np.nan, 5.5, 5.5])


def test_without_a_bound_its_panel_is_left_out() -> None:
    single = progress_of(eps_m_by_estimator={"unexplained": 0.1, "total_variation": None, "released": 0.2})
    figure = rollout_figure(single, facts_of(bound=None))
    assert [axes.get_visible() for axes in figure.axes] == [True, True, True, False]


def test_the_base_is_called_by_its_name() -> None:
    picture = data_uri(example_figure(facts_of(base="none")))
    text = base64.b64decode(picture.partition(",")[2]).decode()
    assert re.search("<!-- nothing changes -->", text)
