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

MEMBERS, TIMES, EXAMPLES = 4, 20, 2


def facts_of(**changes: Any) -> dict[str, Any]:
    """The `model.json` of a model that halves the error of its base, except for the follower gap."""
    times = np.linspace(0.5, 10.0, TIMES)
    replayed = {
        name: {
            "model": 0.05 * times if name != "follower_gap" else 0.3 * times,
            "spread": 0.01 * times,
            "base": 0.1 * times if name != "speed" else 0.0 * times,
            "change": 0.2 * times,
        }
        for name in PREDICTED_QUANTITIES
        if name != "reward"
    }
    replayed["speed"]["model"] = 1e-7 * times
    line = 5.0 + np.sin(times)
    example = {"recorded": line, "members": [line + 0.1 * n for n in range(MEMBERS)], "base": line + 1.0}
    quantities = {"leader_gap": example, "leader_speed": example}
    steps = {name: {"base": 0.02, "model": 0.01, "change": 0.03} for name in PREDICTED_QUANTITIES}
    steps["speed"] = {"base": 0.0, "model": 0.0, "change": 0.01}
    steps["follower_gap"] = {"base": 0.02, "model": 0.03, "change": 0.03}
    bins = {
        "values": [1.0, 2.0, 5.0],
        "control_steps": [10, 10, 10],
        "base": {name: [0.1, 0.2, 0.3] for name in PREDICTED_QUANTITIES},
        "model": {name: [0.1, 0.1, 0.1] for name in PREDICTED_QUANTITIES},
    }
    facts = {
        "iteration": 3,
        "base": "idm",
        "members": MEMBERS,
        "control_step": 0.1,
        "k_star": 12,
        "validation_steps": 1234,
        "one_step": steps,
        "by_state": {"leader_gap": bins, "speed": bins},
        "replay": {
            "times": times,
            "starts": 50,
            "quantities": replayed,
            "examples": [
                {"start_time": 10.0 * n, "drawn_values": {}, "quantities": quantities} for n in range(EXAMPLES)
            ],
        },
        "bound": {
            "eps_pi": 0.2,
            "eps_m": 0.1,
            "max_reward": 1.0,
            "largest_return": 1000.0,
            "k": [1, 10, 100],
            "bound": [9000.0, 5000.0, 80000.0],
        },
    }
    return {**json.loads(json.dumps(facts, default=np.ndarray.tolist)), **changes}


def progress_of(**changes: Any) -> list[dict[str, Any]]:
    """Rows of progress of a run with a learned model."""
    errors = {"unexplained_variance": 0.15, "total_variation": 0.1, "training_loss": 0.3}
    facts = {"k_star": 12, "eps_m": 0.15, "eps_m_by_estimator": errors, "return_model": 5.5}
    facts |= {"return_environment": 5.25, **changes}
    return [
        {
            "iteration": number,
            "environment_steps": 12_000 * number,
            "return_mean": 90.0,
            "return_expert": 100.0,
            "return_validation": 101.0,
            "model": facts,
            "seconds": {"collect": 2.0, "fit": 1.0, "roll_out": 0.1, "update": 0.5},
        }
        for number in (1, 2, 3)
    ]


def test_table_has_errors_one_step_ahead_and_at_the_end() -> None:
    facts = facts_of()
    assert error_headings(facts)[:3] == ["change, 0.1 s", "IDM alone, 0.1 s", "model, 0.1 s"]
    assert error_headings(facts)[-1] == "model, 10 s"
    table = {row["label"]: row["cells"] for row in error_rows(facts)}
    assert table["leader speed"] == ["0.03", "0.02", "0.01", "2", "1", "0.5"]
    assert table["own speed"] == ["0.01", "0", "0", "2", "0", "0"]
    assert table["reward"][3:] == ["–", "–", "–"]


@pytest.mark.parametrize(
    ("value", "text"), [(None, "–"), (3e-14, "0"), (0.00123, "0.0012"), (64.3, "64"), (9.96, "10")]
)
def test_errors_have_two_significant_digits(value: float | None, text: str) -> None:
    assert error_text(value) == text


def test_verdict_lists_smaller_and_larger_errors() -> None:
    first, final = error_verdict(facts_of()).split(". ")
    assert first.startswith(
        "One step ahead, the model's errors relative to its base are smaller for leader speed (by 50\u00a0%)"
    )
    assert first.endswith("and larger for follower gap (by 50\u00a0%)")
    assert "own speed" not in first
    assert final.startswith("10 s ahead")
    assert final.endswith("and larger for follower gap (by 200\u00a0%).")


def test_errors_relative_to_an_exact_base_have_no_percentage() -> None:
    facts = facts_of()
    facts["one_step"]["speed"] = {"base": 0.0, "model": 0.002, "change": 0.01}
    assert f"larger for {PREDICTED_QUANTITIES['speed'][0]}, " in error_verdict(facts)


def test_errors_of_a_model_that_equals_its_base_are_equal() -> None:
    facts = facts_of()
    for errors in (*facts["one_step"].values(), *facts["replay"]["quantities"].values()):
        errors["model"] = errors["base"]
    assert error_verdict(facts) == (
        "One step ahead, the model's errors relative to its base are equal. "
        "10 s ahead, the model's errors relative to its base are equal."
    )


def test_summary_has_returns_in_model_and_environment() -> None:
    text = rollout_summary(progress_of())
    assert "k* = 12" in text
    assert "the same policy is 5.50 in the model and 5.25 in the environment" in text


def test_summary_without_rollouts_has_no_returns() -> None:
    text = rollout_summary(progress_of(k_star=0, return_model=None))
    assert "k* = 0" in text
    assert "return" not in text


def test_bound_above_the_largest_return_is_not_informative() -> None:
    text = bound_summary(facts_of())
    assert "from 9,000 (k = 1) over 5,000 (k = 10) to 80,000 (k = 100)" in text
    assert text.endswith("= 1,000: even the smallest bound is 5 times as large, so it is not informative.")


def test_bound_below_the_largest_return_has_its_share() -> None:
    bound = {**facts_of()["bound"], "bound": [900.0, 250.0, 800.0]}
    assert bound_summary(facts_of(bound=bound)).endswith("the smallest bound is 0.25 of it.")
    assert bound_summary(facts_of(bound=None)) == ""


def test_only_runs_with_a_learned_model_have_a_section() -> None:
    def section(model: dict[str, Any] | None) -> dict[str, Any] | None:
        return model_section(Results(Path("run"), {}, {}, {}, progress_of(), "", model))

    assert section(None) is None
    found = section(facts_of(base="none"))
    assert found is not None
    assert "the assumption that nothing changes, plus an ensemble of 4 networks" in found["description"]
    assert "1,234 control steps" in found["description"]
    assert [row["label"] for row in found["table"]] == [label for label, _ in PREDICTED_QUANTITIES.values()]


Draw = Callable[[], Figure]
FIGURES: dict[str, tuple[Draw, int]] = {
    "rollouts": (lambda: rollout_figure(progress_of(), facts_of()), 4),
    "errors": (lambda: error_figure(facts_of()), 6),
    "examples": (lambda: example_figure(facts_of()), 2 * EXAMPLES),
}


def panels_with_title(figure: Figure, text: str) -> list[Axes]:
    return [axes for axes in figure.axes if text in axes.get_title(loc="left")]


def lines_of(axes: Axes) -> dict[str, np.ndarray]:
    """The lines of a panel, by label."""
    return {str(line.get_label()): np.asarray(line.get_ydata(), float) for line in axes.lines}


@pytest.mark.long
@pytest.mark.parametrize("name", FIGURES)
def test_every_panel_has_a_title_and_lines_and_figures_are_reproducible(name: str) -> None:
    draw, panels = FIGURES[name]
    figure = draw()
    assert len(figure.axes) == panels
    assert all(axes.get_title(loc="left") and axes.get_xlabel() and axes.lines for axes in figure.axes)
    width, height = figure.get_size_inches()
    assert width > height
    assert data_uri(figure) == data_uri(draw())


@pytest.mark.long
def test_texts_of_panels_do_not_overlap() -> None:
    for draw, _ in FIGURES.values():
        figure = draw()
        figure.draw_without_rendering()
        boxes = [axes.get_tightbbox() for axes in figure.axes]
        for number, box in enumerate(boxes):
            for other in boxes[number + 1 :]:
                assert box is not None
                assert other is not None
                assert not (box.overlaps(other))


def test_examples_have_a_line_for_each_member_and_the_recording() -> None:
    figure = example_figure(facts_of())
    panels = panels_with_title(figure, "leader gap [m], from 10 s on")
    assert len(panels) == 1
    lines = panels[0].lines
    assert len(lines) == MEMBERS + 2
    found = facts_of()["replay"]["examples"][1]["quantities"]["leader_gap"]
    np.testing.assert_allclose(lines_of(panels[0])["recorded"], found["recorded"])
    np.testing.assert_allclose(lines_of(panels[0])["IDM alone"], found["base"])


def test_error_figure_has_the_spread_and_the_end_of_rollouts() -> None:
    (panel,) = panels_with_title(error_figure(facts_of()), "error: leader speed [m/s]")
    found = facts_of()["replay"]["quantities"]["leader_speed"]
    lines = lines_of(panel)
    for label, name in {"model, one member": "model", "spread of the members": "spread", "IDM alone": "base"}.items():
        np.testing.assert_allclose(lines[label], found[name])
    (end,) = [line for line in panel.lines if "k*" in str(line.get_label())]
    assert list(np.asarray(end.get_xdata())) == pytest.approx([1.2, 1.2])
    (panel,) = panels_with_title(error_figure(facts_of(k_star=0)), "error: leader speed [m/s]")
    assert not any("k*" in label for label in lines_of(panel))


def test_returns_have_a_gap_in_iterations_without_rollouts() -> None:
    progress = progress_of()
    progress[0] = progress_of(return_model=None, return_environment=None)[0]
    (panel,) = panels_with_title(rollout_figure(progress, facts_of()), "return over k* control steps")
    np.testing.assert_array_equal(lines_of(panel)["model"], [np.nan, 5.5, 5.5])


def test_panel_of_a_missing_bound_is_hidden() -> None:
    single = progress_of(
        eps_m_by_estimator={"unexplained_variance": 0.1, "total_variation": None, "training_loss": 0.2}
    )
    figure = rollout_figure(single, facts_of(bound=None))
    assert [axes.get_visible() for axes in figure.axes] == [True, True, True, False]


def test_legend_has_the_name_of_the_base_model() -> None:
    picture = data_uri(example_figure(facts_of(base="none")))
    text = base64.b64decode(picture.partition(",")[2]).decode()
    assert re.search("<!-- no change -->", text)
