from collections.abc import Callable

import numpy as np
import pytest

from unjam.drivers.registry import driver_from_name
from unjam.errors import InputError, invalid_value, one_line, printable
from unjam.scenarios import make_scenario
from unjam.training.config import load_config
from unjam.worlds.reward import make_reward


@pytest.mark.parametrize(
    ("make", "meant"),
    [
        (lambda: make_scenario("rign-jammed"), "ring-jammed"),
        (lambda: make_scenario("ring", {"vehicels": 3}), "vehicles"),
        (lambda: make_scenario("ring", {"safety.time_gp": 1}), "time_gap"),
        (lambda: driver_from_name("folower-stopper", 0.1), "follower-stopper"),
        (lambda: driver_from_name("pi:time_constnt=1", 0.1), "time_constant"),
        (lambda: make_reward("relased"), "released"),
        (lambda: load_config(preset="dmo"), "demo"),
        (lambda: load_config(changes={"trpo.gama": 0.9}), "gamma"),
        (lambda: load_config(changes={"scenaro": "ring"}), "scenario"),
    ],
)
def test_a_similar_name_is_suggested(make: Callable[[], object], meant: str) -> None:
    with pytest.raises(InputError) as caught:
        make()
    assert str(caught.value).endswith(f"; did you mean {meant!r}?")


def test_nothing_is_suggested_without_a_similar_name() -> None:
    with pytest.raises(InputError) as caught:
        make_scenario("xyz")
    assert "did you mean" not in str(caught.value)


def test_a_value_of_several_lines_is_shown_on_one() -> None:
    assert str(invalid_value("x", np.eye(2), "1")) == "x: array([[1., 0.],        [0., 1.]]) is not allowed; allowed: 1"


def test_a_long_text_is_cut_visibly() -> None:
    assert [one_line(f" a\n{'b' * count}", 6) for count in (4, 5)] == ["a bbbb", "a bbb…"]


@pytest.mark.parametrize(
    "hidden", ["\x1b", "\u202e", "\u200b", "\u2028", "\u3164", "\u034f", "\ufe0f", "\U000e0100", "\u2800"]
)
def test_what_cannot_be_seen_in_a_name_is_marked(hidden: str) -> None:
    assert printable(f"ring{hidden}") == "ring?"


def test_visible_letters_and_spaces_are_shown_as_they_are() -> None:
    text = "Straße 環状\u00a0道 é e\u0301 \u2009– m/s²\n"
    assert printable(text) == text
