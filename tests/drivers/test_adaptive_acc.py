"""The traffic-adaptive ACC follows as its source states in each traffic state."""

import numpy as np
import pytest

from unjam.drivers.car_following import (
    BOTTLENECK_STRATEGY,
    FREE_ROAD_STRATEGY,
    JAM_HEAD_STRATEGY,
    JAM_TAIL_STRATEGY,
    AdaptiveACC,
    DrivingStrategy,
)
from unjam.drivers.local_state import MAX_OBSERVED_GAP, LocalState
from unjam.physics.idm import IDMParameters, idm_acceleration

DRIVER = AdaptiveACC(time_step=1.0)


def state(speed: float, gap: float = 40.0, to_merge: float = 1500.0) -> LocalState:
    """One CAV behind a leader that is as fast."""
    values = (speed, speed, gap, speed, 50.0, 0.0, np.nan)
    near = LocalState(*(np.array([value]) for value in values))
    return near._replace(allowed_speed=np.array([28.0]), distance_to_merge=np.array([to_merge]))


def after(*speeds: float, to_merge: float = 1500.0, gap: float = 40.0) -> float:
    """The last acceleration of a CAV that has driven these speeds."""
    memory, acceleration = DRIVER.initial_memory(1), np.zeros(1)
    for speed in speeds:
        acceleration, memory = DRIVER.act(state(speed, gap, to_merge), memory)
    return float(acceleration[0])


def expected(strategy: DrivingStrategy, speed: float, gap: float = 40.0) -> float:
    parameters = IDMParameters(
        desired_speed=28.0,
        time_headway=1.5 * strategy.time_headway,
        max_acceleration=1.4 * strategy.acceleration,
        comfortable_deceleration=2.0 * strategy.deceleration,
    )
    return idm_acceleration(speed, speed, gap, parameters)


@pytest.mark.parametrize(
    ("speeds", "distance_to_merge", "strategy"),
    [
        ((25.0, 25.0), 1500.0, FREE_ROAD_STRATEGY),
        ((8.0, 8.0), 1500.0, FREE_ROAD_STRATEGY),
        ((25.0, 15.0), 1500.0, JAM_TAIL_STRATEGY),
        ((4.0, 4.0, 14.0), 1500.0, JAM_HEAD_STRATEGY),
        ((25.0, 25.0), 200.0, BOTTLENECK_STRATEGY),
        ((25.0, 25.0), -200.0, BOTTLENECK_STRATEGY),
        ((25.0, 25.0), -400.0, FREE_ROAD_STRATEGY),
        ((4.0, 4.0, 14.0), 200.0, JAM_HEAD_STRATEGY),  # a jam's head counts more than the ramp
    ],
)
def test_it_follows_with_the_parameters_of_the_state_of_traffic(
    speeds: tuple[float, ...], distance_to_merge: float, strategy: DrivingStrategy
) -> None:
    assert after(*speeds, to_merge=distance_to_merge) == pytest.approx(expected(strategy, speeds[-1]))


def test_it_leaves_a_jam_until_its_mean_is_a_free_roads() -> None:
    out = (4.0, 4.0, 14.0, 14.0)
    assert after(*out) == pytest.approx(expected(JAM_HEAD_STRATEGY, 14.0))
    assert after(*out, *[18.0] * 15) == pytest.approx(expected(FREE_ROAD_STRATEGY, 18.0))


def test_it_brakes_earlier_at_a_jams_tail_than_people_of_its_headway() -> None:
    closing = state(20.0)._replace(leader_speed=np.array([5.0]))
    memory = {"mean_speed": np.array([25.0]), "leaves_jam": np.zeros(1)}
    early = DRIVER.act(closing, memory)[0][0]
    late = DRIVER.act(closing, {**memory, "mean_speed": np.array([20.0])})[0][0]
    assert early < late


def test_nobody_within_sight_holds_it_back() -> None:
    assert after(20.0, gap=MAX_OBSERVED_GAP) == pytest.approx(1.4 * (1.0 - (20.0 / 28.0) ** 4), abs=1e-4)
