from typing import Any

import pytest

from unjam.drivers import Constant, FollowerStopper, PISaturation
from unjam.drivers.registry import DRIVER_CLASSES, driver_from_name, driver_from_recipe, driver_recipe, is_serializable
from unjam.errors import InputError


def test_names_take_parameters() -> None:
    assert driver_from_name("pi:window=10,safe_gap_rule=closing", 0.2) == PISaturation(
        window=10, safe_gap_rule="closing", time_step=0.2
    )
    assert driver_from_name("follower-stopper:gaps=[1,2,3],desired_speed=5", 0.1) == FollowerStopper(
        gaps=(1, 2, 3), desired_speed=5
    )


def test_description_names_what_differs_from_the_defaults() -> None:
    assert driver_from_name("pi", 0.5).describe() == "pi"
    assert driver_from_name("pi:window=10", 0.1).describe() == "pi:window=10.0"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("poi", "driver: 'poi' is not allowed; allowed: human, idm, pi"),
        ("pi:speed=3", "driver pi.speed: unknown name"),
        ("pi:window=-1", "driver pi.window: -1 is not allowed; allowed: greater than 0"),
        ("pi:window=wide", "driver pi.window: 'wide' is not allowed"),
        ("pi:window=nan", "driver pi.window: nan is not allowed"),
        ("pi:safe_gap_rule=none", "driver pi.safe_gap_rule"),
        ("pi:window=1,oops", "allowed: key=value"),
        ("constant:acceleration=[1]", "driver constant.acceleration"),
        ("pi:gap_upper=7", "driver pi.gap_upper: 7 is not allowed; allowed: > gap_lower, 7"),
        ("ovm:go_gap=2", "driver ovm.go_gap: 2 is not allowed; allowed: > stop_gap, 2"),
        ("follower-stopper:gaps=[4.5,4.5,6]", "driver follower-stopper.gaps: .* each larger than the previous one"),
    ],
)
def test_wrong_names_and_values_get_one_clear_line(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        driver_from_name(text, 0.1)
    assert "\n" not in str(caught.value)


def test_a_class_of_ones_own_must_come_from_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    class Mine(Constant):
        pass

    for _ in range(2):
        with pytest.raises(InputError, match=r"allowed: path\.py:name, your class in a file"):
            driver_recipe(Mine())
        assert not is_serializable(Mine())
        monkeypatch.setitem(DRIVER_CLASSES, "mine", Mine)  # workers do not know what one process registers


@pytest.mark.parametrize(
    "wrong",
    [
        {"kind": "impaired", "delay": -3.0, "gap_noise": 0.0, "time_step": 0.1},
        {"kind": "impaired", "delay": 1e6, "gap_noise": 0.0, "time_step": 0.1},
        {"kind": "impaired", "delay": 1.0, "gap_noise": 0.0, "time_step": 0.0},
        {"kind": "history", "time_step": float("nan")},
    ],
)
def test_a_recipe_of_what_no_driver_is_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        driver_from_recipe({"driver": driver_recipe(PISaturation())[0], **wrong}, {})
