import base64
import re
from collections.abc import Callable

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tests.reports.test_model_story import EXAMPLES, MEMBERS, facts_of, progress_of
from unjam.reports.figures import data_uri
from unjam.reports.model_figures import errors, examples, trust

Draw = Callable[[bool], Figure]
PICTURES: dict[str, tuple[Draw, int]] = {
    "trust": (lambda wide: trust(progress_of(), facts_of(), wide), 4),
    "errors": (lambda wide: errors(facts_of(), wide), 6),
    "examples": (lambda wide: examples(facts_of(), wide), 2 * EXAMPLES),
}


def titled(figure: Figure, words: str) -> list[Axes]:
    return [axes for axes in figure.axes if words in axes.get_title(loc="left")]


def drawn(axes: Axes) -> dict[str, np.ndarray]:
    """The lines of a panel, by label."""
    return {str(line.get_label()): np.asarray(line.get_ydata(), float) for line in axes.lines}


@pytest.mark.parametrize("wide", [True, pytest.param(False, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", PICTURES)
def test_every_panel_has_a_title_and_lines_and_a_picture_can_be_made(name: str, wide: bool) -> None:
    draw, panels = PICTURES[name]
    figure = draw(wide)
    assert len(figure.axes) == panels
    assert all(axes.get_title(loc="left") and axes.get_xlabel() and axes.lines for axes in figure.axes)
    width, height = figure.get_size_inches()
    assert width > height if wide else width < height
    assert data_uri(figure, "svg") == data_uri(draw(wide), "svg")


def test_no_text_of_a_panel_lies_on_that_of_another() -> None:
    for draw, _ in PICTURES.values():
        for wide in (True, False):
            figure = draw(wide)
            figure.draw_without_rendering()
            boxes = [axes.get_tightbbox() for axes in figure.axes]
            for number, box in enumerate(boxes):
                for other in boxes[number + 1 :]:
                    assert box is not None
                    assert other is not None
                    assert not (box.overlaps(other))


def test_each_member_is_a_line_beside_what_happened() -> None:
    figure = examples(facts_of(), True)
    panels = titled(figure, "gap to the leader [m], from 10 s on")
    assert len(panels) == 1
    lines = panels[0].lines
    assert len(lines) == MEMBERS + 2
    found = facts_of()["replay"]["examples"][1]["numbers"]["leader_gap"]
    np.testing.assert_allclose(drawn(panels[0])["actual"], found["actual"])
    np.testing.assert_allclose(drawn(panels[0])["IDM alone"], found["base"])


def test_errors_are_drawn_with_the_spread_and_where_rollouts_end() -> None:
    (panel,) = titled(errors(facts_of()), "error: leader's speed [m/s]")
    found = facts_of()["replay"]["numbers"]["leader_speed"]
    lines = drawn(panel)
    for label, name in {
        "model, a member": "model",
        "spread of the members": "spread",
        "IDM alone": "base",
    }.items():
        np.testing.assert_allclose(lines[label], found[name])
    (end,) = [line for line in panel.lines if "k*" in str(line.get_label())]
    assert list(np.asarray(end.get_xdata())) == pytest.approx([1.2, 1.2])
    (panel,) = titled(errors(facts_of(k_star=0)), "error: leader's speed [m/s]")
    assert not any("k*" in label for label in drawn(panel))


def test_iterations_without_rollouts_leave_a_gap_in_the_returns() -> None:
    progress = progress_of()
    progress[0] = progress_of(return_virtual=None, return_actual=None)[0]
    (panel,) = titled(trust(progress, facts_of()), "earned in k* decisions")
    np.testing.assert_array_equal(drawn(panel)["virtual"], [np.nan, 5.5, 5.5])


def test_without_a_bound_its_panel_is_left_out() -> None:
    single = progress_of(eps_m_by_estimator={"unexplained": 0.1, "total_variation": None, "released": 0.2})
    figure = trust(single, facts_of(bound=None))
    assert [axes.get_visible() for axes in figure.axes] == [True, True, True, False]


def test_the_base_is_called_by_its_name() -> None:
    picture = data_uri(examples(facts_of(base="none")), "svg")
    text = base64.b64decode(picture.partition(",")[2]).decode()
    assert re.search("<!-- nothing changes -->", text)
