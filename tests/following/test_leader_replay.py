import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.recordings.synthetic_trajectories import follower, idm_driver
from unjam.following.leader_replay import (
    add_residual,
    as_driver_model,
    follow_leader,
    idm_function,
    individual_idm,
    simulate_followers,
)
from unjam.physics.idm import PAPER_IDM, IDMParameters
from unjam.recordings.trajectories import Floats, make_segments
from unjam.scenarios.population import residual_inputs

QUICK = IDMParameters(time_headway=0.8, max_acceleration=1.5)


def test_true_driver_has_no_error() -> None:
    segments = make_segments([idm_driver(QUICK, seed=1), idm_driver(QUICK, seed=2, seconds=25.0)])
    simulated = simulate_followers(as_driver_model(idm_function(QUICK)), segments)
    assert simulated.gap_mse.max() < 1e-18
    assert simulated.speed_mse.max() < 1e-18


def test_another_driver_has_an_error() -> None:
    simulated = simulate_followers(as_driver_model(idm_function(PAPER_IDM)), make_segments([idm_driver(QUICK)]))
    assert simulated.gap_mse[0] > 0.5
    assert not simulated.has_collided[0]


def test_vehicle_that_never_brakes_touches_its_leader_and_stays_behind_it() -> None:
    segments = make_segments([idm_driver(QUICK)])

    def accelerate(speed: Floats, leader_speed: Floats, gap: Floats) -> Floats:
        return speed * 0.0 + 1.0

    assert simulate_followers(as_driver_model(accelerate), segments).has_collided[0]
    states = list(follow_leader(accelerate, segments.initial_state, segments.leader, segments.time_step))
    assert min(gap[0] for _, gap in states) == 0.0
    assert max(speed[0] for speed, _ in states) < 20.0


@given(weight=st.floats(0, 1), gap=st.floats(3.0, 60.0), speed=st.floats(0.0, 20.0))
def test_weighted_headway_lies_between_the_common_and_the_initial_one(weight: float, gap: float, speed: float) -> None:
    start = (np.array([speed]), np.array([gap]))
    inputs = (np.array([10.0]), np.array([10.0]), np.array([20.0]))
    acceleration, common, initial = (
        individual_idm(PAPER_IDM, share)(*start)(*inputs)[0] for share in (weight, 0.0, 1.0)
    )
    assert min(common, initial) - 1e-9 <= acceleration <= max(common, initial) + 1e-9


def test_residual_is_added_within_the_limits() -> None:
    inputs = (np.array([10.0, 10.0]), np.array([9.0, 9.0]), np.array([20.0, 0.5]))
    base = as_driver_model(idm_function(PAPER_IDM))
    model = add_residual(base, lambda columns: columns[..., 1], (-4.0, 2.0))
    acceleration = model(*inputs[::2])(*inputs)
    assert acceleration[0] == pytest.approx(idm_function(PAPER_IDM)(*inputs)[0] - 1.0)
    assert acceleration[1] == -4.0


def test_tensors_equal_arrays() -> None:
    trajectory = follower(idm_function(QUICK))
    leader = (trajectory.leader_speed[:, None], trajectory.leader_path[:, None])
    start = (trajectory.speed[:1], trajectory.gap[:1])
    model = individual_idm(PAPER_IDM, 0.4, (-4.0, 2.0))
    arrays = list(follow_leader(model(*start), start, leader, 0.1))
    speed, gap = map(torch.as_tensor, start)
    tensors = list(follow_leader(model(speed, gap), (speed, gap), [torch.as_tensor(one) for one in leader], 0.1))
    for one, other in zip(arrays, tensors, strict=True):
        np.testing.assert_allclose(other[1].numpy(), one[1])


def test_residual_inputs_are_speed_relative_speed_and_gap() -> None:
    values = residual_inputs(np.array([5.0]), np.array([7.0]), np.array([9.0]))
    np.testing.assert_array_equal(values, [[5.0, 2.0, 9.0]])
