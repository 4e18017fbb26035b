from math import pi

import numpy as np
import pytest

from unjam.drivers import LocalState, Pacer
from unjam.drivers.pacer import TUNED


def state(gap: float, place: float = 0.0, loop: float = 450.0, speed: float = 0.0) -> LocalState:
    values = (speed, 0.0, gap, 0.0, 5.0, place * loop, loop)
    return LocalState(*(np.array([value]) for value in values))


def wanted(driver: Pacer, *states: LocalState) -> float:
    memory = driver.initial_memory(1)
    acceleration = np.zeros(1)
    for entry in states:
        acceleration, memory = driver.act(entry, memory)
    return float(acceleration[0] * driver.time_constant + states[-1].speed[0])


def at(harmonics: tuple[float, ...], place: float) -> float:
    mean, a1, b1, a2, b2 = harmonics
    x = 2 * pi * place
    return mean + a1 * np.cos(x) + b1 * np.sin(x) + a2 * np.cos(2 * x) + b2 * np.sin(2 * x)


def test_drives_slowly_until_the_road_ahead_is_free() -> None:
    assert wanted(Pacer(), state(gap=0.39 * 450)) == pytest.approx(2.0)


def test_then_drives_a_lap_in_its_time() -> None:
    assert wanted(Pacer(lap_time=70), state(gap=0.41 * 450)) == pytest.approx(450 / 70)


def test_keeps_its_pace_once_all_have_gathered() -> None:
    assert wanted(Pacer(lap_time=70), state(gap=200.0), state(gap=10.0)) == pytest.approx(450 / 70)


@pytest.mark.parametrize("place", [0.0, 0.1, 0.25, 0.7])
def test_pace_varies_over_the_lap_as_its_harmonics_say(place: float) -> None:
    harmonics = (7.0, -0.8, 0.7, -1.3, 0.2)
    found = wanted(Pacer(harmonics=harmonics), state(gap=200.0, place=place))
    assert found == pytest.approx(at(harmonics, place))


@pytest.mark.parametrize("lap", TUNED)
def test_varying_takes_the_harmonics_of_the_nearest_lap(lap: float) -> None:
    found = wanted(Pacer(varying=True), state(gap=300.0, place=0.3, loop=lap + 2.0))
    assert found == pytest.approx(at(TUNED[lap], 0.3))
