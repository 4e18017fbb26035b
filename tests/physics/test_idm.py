import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from unjam.errors import InputError
from unjam.parameters import build_dataclass
from unjam.physics.idm import (
    IDMParameters,
    desired_gap,
    desired_speed_from_acceleration,
    equilibrium_gap,
    equilibrium_speed,
    idm_acceleration,
)
from unjam.physics.kinematics import next_speed
from unjam.scenarios import Ring
from unjam.worlds.sumo.backend import sumo_inputs
from unjam.worlds.sumo.simulation import Simulation

speeds = st.floats(0.0, 29.0)
gaps = st.floats(0.5, 200.0)


def test_reference_values_of_a_standing_driver() -> None:
    found = idm_acceleration(np.zeros(5), np.zeros(5), np.array([10.0, 20, 30, 40, 50]))
    np.testing.assert_allclose(found, [0.96, 0.99, 0.995556, 0.9975, 0.9984], atol=5e-7)


def test_reference_values_closing_in_and_falling_back() -> None:
    found = idm_acceleration(np.array([10.0, 10.0]), np.array([8.0, 12.0]), np.array([20.0, 20.0]))
    np.testing.assert_allclose(found, [-0.028913, 0.950886], atol=3e-6)


@given(speeds, st.floats(-3.0, 0.99))
def test_desired_speed_from_acceleration_inverts_free_acceleration(speed: float, acceleration: float) -> None:
    desired_speed = desired_speed_from_acceleration(acceleration, speed + 0.1)
    driver = IDMParameters(desired_speed=desired_speed)
    assert idm_acceleration(speed + 0.1, speed + 0.1, 1e9, driver) == pytest.approx(acceleration, abs=1e-9)


@given(speeds, speeds, gaps)
def test_agrees_with_a_second_implementation(speed: float, leader: float, gap: float) -> None:
    desired = 2 + max(0.0, speed * 1 + speed * (speed - leader) / (2 * (1 * 1.5) ** 0.5))
    expected = 1 * (1 - (speed / 30) ** 4 - (desired / gap) ** 2)
    assert idm_acceleration(speed, leader, gap) == pytest.approx(expected, rel=1e-12, abs=1e-12)


@given(speeds)
def test_acceleration_is_zero_in_equilibrium(speed: float) -> None:
    assert idm_acceleration(speed, speed, equilibrium_gap(speed)) == pytest.approx(0.0, abs=1e-9)


@given(st.floats(2.001, 500.0))
def test_equilibrium_speed_inverts_equilibrium_gap(gap: float) -> None:
    assert equilibrium_gap(equilibrium_speed(gap)) == pytest.approx(gap, rel=1e-9)


def test_equilibrium_speeds_of_rings_are_those_of_the_paper() -> None:
    found = [equilibrium_speed(length / 22 - 5) for length in range(220, 280, 10)]
    np.testing.assert_allclose(found, [3.000, 3.454, 3.908, 4.362, 4.816, 5.269], atol=5e-4)
    assert np.mean([equilibrium_speed(length / 22 - 5) for length in range(220, 271)]) == pytest.approx(4.135, abs=5e-4)


def test_no_equilibrium_speed_below_the_standstill_gap() -> None:
    assert equilibrium_speed(2.0) == 0.0


@pytest.mark.parametrize("speed", [-0.1, 30.0, 31.0])
def test_no_equilibrium_gap_beyond_the_desired_speed(speed: float) -> None:
    with pytest.raises(ValueError, match="no equilibrium gap"):
        equilibrium_gap(speed)


def test_arrays_tensors_and_floats_agree() -> None:
    generator = np.random.default_rng(0)
    speed, leader, gap = (generator.uniform(0, 15, 50), generator.uniform(0, 15, 50), generator.uniform(1, 60, 50))
    arrays = idm_acceleration(speed, leader, gap)
    tensors = idm_acceleration(torch.tensor(speed), torch.tensor(leader), torch.tensor(gap))
    numbers = [
        idm_acceleration(float(own), float(ahead), float(distance))
        for own, ahead, distance in zip(speed, leader, gap, strict=True)
    ]
    np.testing.assert_allclose(tensors.numpy(), arrays, rtol=1e-12)
    np.testing.assert_allclose(numbers, arrays, rtol=1e-12)


def test_desired_gap_never_falls_below_the_standstill_gap() -> None:
    assert desired_gap(10.0, -50.0) == 2.0


@pytest.mark.parametrize("name", ["desired_speed", "max_acceleration", "comfortable_deceleration"])
def test_parameters_must_be_positive(name: str) -> None:
    with pytest.raises(InputError, match=f"{name}.*greater than 0"):
        build_dataclass(IDMParameters, {name: 0.0}, "idm")


def test_equals_the_idm_of_sumo_in_every_step(simulation: Simulation) -> None:
    """All-human traffic without noise, with a start-up and its shock wave; one step ahead, to 1e-12."""
    ring = Ring(length=(230, 230))
    road = ring.draw(np.random.default_rng(0))
    simulation.load(sumo_inputs(ring, road), 0.1, seed=1)
    positions = road.start_positions.copy()
    speeds = np.zeros(22)
    generator = np.random.default_rng(1)
    for step in range(600):
        leaders = np.roll(np.arange(22), -1)
        gaps = (positions[leaders] - positions) % road.loop_length - 5.0
        expected = next_speed(speeds, idm_acceleration(speeds, speeds[leaders], gaps), 0.1)
        simulation.step()
        speeds = np.array(simulation.speeds(road.vehicle_ids))
        np.testing.assert_allclose(speeds, expected, atol=1e-12)
        positions += speeds * 0.1
        if step % 20 == 0:  # disturb them, so that they brake and accelerate hard
            speeds = np.maximum(0.0, speeds + generator.normal(0, 0.5, 22))
            simulation.replace_speeds(road.vehicle_ids, speeds.tolist())
