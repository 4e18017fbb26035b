import numpy as np
import pytest

from tests.conftest import state_of
from unjam.drivers import ACC, LACC


def test_lacc_gives_the_reference_values_of_flow() -> None:
    driver = LACC()
    accelerations, _ = driver.act(state_of([0] * 5, [0] * 5, [5, 10, 15, 20, 25]), driver.initial_memory(5))
    np.testing.assert_allclose(accelerations, [0.0, 1.5, 3.0, 4.5, 6.0])


def test_lacc_comes_near_its_command_with_the_lag() -> None:
    driver = LACC(lag=1.0)
    memory, acceleration = driver.initial_memory(1), np.zeros(1)
    for _ in range(10):
        acceleration, memory = driver.act(state_of([0], [0], [15]), memory)
    assert acceleration[0] == pytest.approx(3.0 * (1 - 0.9**10))


def test_acc_is_at_rest_at_its_time_gap() -> None:
    acceleration, _ = ACC().act(state_of([10], [10], [2 + 1.1 * 10]), {})
    assert acceleration[0] == pytest.approx(0.0)


@pytest.mark.parametrize(("gap", "leader_speed", "expected"), [(14, 10, 0.23), (13, 11, 0.07), (12, 10, -0.23)])
def test_acc_follows_with_its_gains(gap: float, leader_speed: float, expected: float) -> None:
    acceleration, _ = ACC().act(state_of([10], [leader_speed], [gap]), {})
    assert acceleration[0] == pytest.approx(expected)


def test_acc_never_drives_faster_than_its_set_speed() -> None:
    acceleration, _ = ACC(set_speed=8).act(state_of([10], [30], [100]), {})
    assert acceleration[0] == pytest.approx(0.4 * -2.0)
