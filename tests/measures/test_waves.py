from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from unjam.measures.waves import speed_along_road, wave_speed

LOOP, STEP = 230.0, 0.1


def travelling(speed: float, size: float = 2.0) -> Any:
    """Vehicles whose speed is that of a pattern that travels at `speed` along the road."""
    times = np.arange(1200) * STEP
    positions = np.arange(22) * LOOP / 22 + 3.0 * times[:, None]
    pattern = np.cos(2 * np.pi * (positions - speed * times[:, None]) / LOOP) ** 3
    return SimpleNamespace(speeds=4.0 + size * pattern, positions=positions, loop_length=LOOP, step=STEP)


@pytest.mark.parametrize("speed", [-5.6, -3.0, 0.0, 4.0])
def test_the_speed_of_a_travelling_pattern_is_found(speed: float) -> None:
    assert wave_speed(travelling(speed)) == pytest.approx(speed, abs=0.1)


def test_where_nothing_waves_there_is_no_wave() -> None:
    assert np.isnan(wave_speed(travelling(-5.0, size=0.1)))


def test_the_road_closes_on_itself() -> None:
    field = speed_along_road(np.array([[1.0, 3.0]]), np.array([[10.0, LOOP - 10.0]]), LOOP)
    assert field[0, 0] == pytest.approx(2.0)
