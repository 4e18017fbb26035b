from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from unjam.drivers import LocalState
from unjam.drivers.check import random_state
from unjam.drivers.local_state import COMMON_FIELDS, MAX_OBSERVED_GAP
from unjam.drivers.network import Network
from unjam.models.row_model import BASE_DRIVERS, base_reward, base_step, missing_neighbors
from unjam.physics.idm import IDMParameters
from unjam.scenarios import Ring, make_scenario
from unjam.scenarios.population import Population, write_population
from unjam.worlds.reward import make_reward

MERGE_LIKE = Ring(simulation_step=0.2, steps_per_control_step=5, humans=IDMParameters(time_headway=1.4))


def literal_step(row: dict[str, float], acceleration: float, ring: Ring) -> dict[str, float]:
    """One control step of one row, written out: IDM behind, constant speed ahead, Euler steps."""
    p, dt = ring.humans, ring.simulation_step
    speed, follower_speed, gap, follower_gap = (
        row["speed"],
        row["follower_speed"],
        row["leader_gap"],
        row["follower_gap"],
    )
    for _ in range(ring.steps_per_control_step):
        desired_gap = p.minimum_gap + max(
            0.0,
            follower_speed * p.time_headway
            + follower_speed
            * (follower_speed - speed)
            / (2 * (p.max_acceleration * p.comfortable_deceleration) ** 0.5),
        )
        follower_acceleration = p.max_acceleration * (
            1 - (follower_speed / p.desired_speed) ** p.exponent - (desired_gap / max(follower_gap, 0.01)) ** 2
        )
        speed, follower_speed = (
            max(0.0, speed + dt * acceleration),
            max(0.0, follower_speed + dt * follower_acceleration),
        )
        gap += dt * (row["leader_speed"] - speed)
        follower_gap += dt * (speed - follower_speed)
    return {**row, "speed": speed, "follower_speed": follower_speed, "leader_gap": gap, "follower_gap": follower_gap}


@given(st.integers(0, 10**6), st.sampled_from([Ring(), MERGE_LIKE]))
def test_base_step_follows_equations_5_and_6_with_euler_steps(seed: int, ring: Ring) -> None:
    generator = np.random.default_rng(seed)
    state, acceleration = random_state(generator, 3), generator.uniform(-1, 1, 3)
    found = base_step("idm", ring, state, acceleration)
    for row in range(3):
        expected = literal_step(
            {name: float(values[row]) for name, values in zip(COMMON_FIELDS, state, strict=False)},
            float(acceleration[row]),
            ring,
        )
        for name, value in expected.items():
            assert getattr(found, name)[row] == pytest.approx(value, abs=1e-9), name


@pytest.mark.parametrize("base", BASE_DRIVERS)
@pytest.mark.parametrize("ring", [Ring(), MERGE_LIKE])
def test_base_step_of_tensors_equals_arrays(base: str, ring: Ring) -> None:
    generator = np.random.default_rng(1)
    state, acceleration = without_neighbors(random_state(generator, 8)), generator.uniform(-1, 1, 8)
    expected = base_step(base, ring, state, acceleration)
    tensors = state.map(lambda values: torch.tensor(values))
    found = base_step(base, ring, tensors, torch.tensor(acceleration))
    for name in COMMON_FIELDS:
        np.testing.assert_allclose(getattr(found, name).numpy(), getattr(expected, name), atol=1e-12)


def without_neighbors(state: LocalState) -> LocalState:
    """The same on an open road; the first row has no leader, and the second no follower."""
    gaps, follower_speed = state.leader_gap.copy(), state.follower_gap.copy()
    gaps[0] = follower_speed[1] = MAX_OBSERVED_GAP
    leader, follower = state.leader_speed.copy(), state.follower_speed.copy()
    leader[0], follower[1] = state.speed[0], state.speed[1]
    missing = np.full_like(gaps, np.nan)
    return LocalState(state.speed, leader, gaps, follower, follower_speed, missing, missing)


def test_missing_neighbors_stay_missing() -> None:
    state = without_neighbors(random_state(np.random.default_rng(2), 4))
    found = base_step("idm", MERGE_LIKE, state, np.array([1.0, -1.0, 0.5, 0.0]))
    assert found.leader_gap[0] == MAX_OBSERVED_GAP
    assert found.leader_speed[0] == found.speed[0]
    assert found.follower_gap[1] == MAX_OBSERVED_GAP
    assert found.follower_speed[1] == found.speed[1]
    ahead, follower_speed = missing_neighbors(found)
    assert ahead.tolist() == [True, False, False, False]
    assert follower_speed.tolist() == [False, True, False, False]


def test_distant_leader_on_a_closed_road_is_not_missing() -> None:
    state = random_state(np.random.default_rng(3), 1)._replace(leader_gap=np.array([150.0]))
    assert base_step("idm", Ring(), state, np.array([0.0])).leader_gap[0] != 150.0
    assert not missing_neighbors(state)[0].any()


def test_base_none_predicts_no_change() -> None:
    state = random_state(np.random.default_rng(4), 2)
    assert base_step("none", Ring(), state, np.ones(2)) is state
    nothing = base_reward("none", make_reward("released"), state, np.ones(2), np.zeros(2, bool))
    np.testing.assert_array_equal(nothing, 0.0)


def expected_reward(name: str, speeds: list[float], time_gap: float, acceleration: float) -> float:
    mean = sum(speeds) / len(speeds)
    if name == "released":
        return 4 * mean / 20 - 4 * abs(acceleration)
    return 30 - abs(30 - mean) - 0.1 * max(1 - time_gap, 0) - 0.1 * abs(acceleration)


@pytest.mark.parametrize("kind", [np.array, torch.tensor])
@pytest.mark.parametrize("name", ["released", "eq16"])
def test_reward_uses_the_mean_speed_of_present_vehicles(name: str, kind: Any) -> None:
    state = without_neighbors(random_state(np.random.default_rng(5), 3))
    acceleration = np.array([0.5, -1.0, 0.0])
    on_kind = state.map(lambda values: kind(values))
    found = base_reward("idm", make_reward(name), on_kind, kind(acceleration), kind([False, False, False]))
    for row, absent in enumerate(["leader_speed", "follower_speed", ""]):
        names = [n for n in ("speed", "leader_speed", "follower_speed") if n != absent]
        time_gap = state.leader_gap[row] / max(state.speed[row], 1e-3)
        speeds = [float(getattr(state, n)[row]) for n in names]
        assert float(found[row]) == pytest.approx(expected_reward(name, speeds, time_gap, acceleration[row]))


def test_typical_driver_of_a_population_includes_its_residual(tmp_path: Path) -> None:
    quarter = Network(((np.zeros((3, 1)), np.array([np.arctanh(0.5)])),), 0.5)
    typical = IDMParameters(time_headway=1.3)
    states = random_state(np.random.default_rng(0), 6)
    acceleration, state = (np.zeros(6), states._replace(follower_speed=states.speed, follower_gap=states.speed * 2 + 3))
    next_states = {}
    for residual in (None, quarter):
        path = tmp_path / "drivers.json"
        write_population(path, Population(typical, (typical,), (-4.0, 2.0), residual))
        road = make_scenario("ring", {"population": str(path)})
        next_states[residual] = base_step("population", road, state, acceleration)
    expected = base_step("idm", Ring(humans=typical), state, acceleration)
    np.testing.assert_allclose(next_states[None].follower_speed, expected.follower_speed)
    np.testing.assert_allclose(next_states[quarter].follower_speed, expected.follower_speed + 0.025)
