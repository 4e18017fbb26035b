import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.following.made_up import follower, idm_driver
from unjam.following.open_loop import (
    add_residual,
    fixed_driver,
    follow_leader,
    idm_function,
    individual_idm,
    one_step_error,
    simulate_open_loop,
)
from unjam.following.pairs import make_segments
from unjam.physics.idm import PAPER_IDM, IDMParameters
from unjam.scenarios.population import residual_inputs

QUICK = IDMParameters(time_headway=0.8, max_acceleration=1.5)


def test_who_drives_as_the_driver_did_makes_no_error() -> None:
    stretches = make_segments([idm_driver(QUICK, seed=1), idm_driver(QUICK, seed=2, seconds=25.0)])
    drove = simulate_open_loop(fixed_driver(idm_function(QUICK)), stretches)
    assert drove.gap_mse.max() < 1e-18
    assert drove.speed_mse.max() < 1e-18
    assert one_step_error(fixed_driver(idm_function(QUICK)), stretches).max() < 1e-18


def test_another_driver_makes_one() -> None:
    drove = simulate_open_loop(fixed_driver(idm_function(PAPER_IDM)), make_segments([idm_driver(QUICK)]))
    assert drove.gap_mse[0] > 0.5
    assert not drove.has_collided[0]


def test_who_never_brakes_touches_its_leader_and_stays_behind_it() -> None:
    drove = simulate_open_loop(
        fixed_driver(lambda speed, leader_speed, gap: speed * 0.0 + 1.0), make_segments([idm_driver(QUICK)])
    )
    assert drove.has_collided[0]
    assert drove.gap.min() == 0.0
    assert drove.speed.max() < 20.0


@given(kept=st.floats(0, 1), gap=st.floats(3.0, 60.0), speed=st.floats(0.0, 20.0))
def test_a_kept_headway_lies_between_that_of_all_and_that_of_the_start(kept: float, gap: float, speed: float) -> None:
    start = (np.array([speed]), np.array([gap]))
    now = (np.array([10.0]), np.array([10.0]), np.array([20.0]))
    found, least, most = (individual_idm(PAPER_IDM, share)(*start)(*now)[0] for share in (kept, 0.0, 1.0))
    assert min(least, most) - 1e-9 <= found <= max(least, most) + 1e-9


def test_a_residual_is_added_and_limits_hold() -> None:
    now = (np.array([10.0, 10.0]), np.array([9.0, 9.0]), np.array([20.0, 0.5]))
    base = fixed_driver(idm_function(PAPER_IDM))
    model = add_residual(base, lambda inputs: inputs[..., 1], (-4.0, 2.0))
    found = model(*now[::2])(*now)
    assert found[0] == pytest.approx(idm_function(PAPER_IDM)(*now)[0] - 1.0)
    assert found[1] == -4.0


def test_tensors_drive_as_arrays_do() -> None:
    pair = follower(idm_function(QUICK))
    leader = (pair.leader_speed[:, None], pair.leader_path[:, None])
    start = (pair.speed[:1], pair.gap[:1])
    model = individual_idm(PAPER_IDM, 0.4, (-4.0, 2.0))
    arrays = list(follow_leader(model(*start), start, leader, 0.1))
    speed, gap = map(torch.as_tensor, start)
    tensors = list(follow_leader(model(speed, gap), (speed, gap), [torch.as_tensor(one) for one in leader], 0.1))
    for one, other in zip(arrays, tensors, strict=True):
        np.testing.assert_allclose(other[1].numpy(), one[1])


def test_a_network_sees_speed_relative_speed_and_gap() -> None:
    seen = residual_inputs(np.array([5.0]), np.array([7.0]), np.array([9.0]))
    np.testing.assert_array_equal(seen, [[5.0, 2.0, 9.0]])
