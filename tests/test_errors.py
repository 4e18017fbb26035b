import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import unjam
from unjam.drivers.registry import driver_from_name
from unjam.errors import InputError, invalid_value
from unjam.scenarios import make_scenario
from unjam.text import format_count, printable, to_one_line
from unjam.training.config import load_config
from unjam.worlds.reward import make_reward

PACKAGE = Path(unjam.__file__).parent


@pytest.mark.parametrize(
    ("count", "text"), [(0, "0 trials"), (1, "1 trial"), (1.0, "1 trial"), (2, "2 trials"), (2000, "2,000 trials")]
)
def test_a_count_has_the_right_plural(count: float, text: str) -> None:
    assert format_count(count, "trial") == text
    assert format_count(count, "trajectory", "trajectories").endswith("y" if count == 1 else "ies")


COUNTED = "CAV|controller|driver|drive|episode|file|network|recording|result|road|row|run|seed|trial|training|vehicle"


def test_messages_have_the_plural_of_what_they_count() -> None:
    pattern = re.compile(rf"\{{(?:len|sum)\([^{{}}]*\)[^{{}}]*\}} (?:[a-z]+ )?(?:{COUNTED})s\b(?!.* if len\()")
    lines = {
        f"{path.relative_to(PACKAGE)}: {line.strip()}"
        for path in PACKAGE.rglob("*.py")
        for line in path.read_text().splitlines()
        if pattern.search(line) and not re.search(r"\{len\([A-Z_]+\)", line)
    }
    assert lines == {line for line in lines if line.startswith("training/assess.py: ")}, "use format_count"


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
    assert [to_one_line(f" a\n{'b' * count}", 6) for count in (4, 5)] == ["a bbbb", "a bbb…"]


@pytest.mark.parametrize(
    "hidden", ["\x1b", "\u202e", "\u200b", "\u2028", "\u3164", "\u034f", "\ufe0f", "\U000e0100", "\u2800"]
)
def test_what_cannot_be_seen_in_a_name_is_marked(hidden: str) -> None:
    assert printable(f"ring{hidden}") == "ring?"


def test_visible_letters_and_spaces_are_shown_as_they_are() -> None:
    text = "Straße 環状\u00a0道 é e\u0301 \u2009– m/s²\n"
    assert printable(text) == text
