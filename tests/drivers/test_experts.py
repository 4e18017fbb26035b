"""What all built-in drivers have in common."""

import numpy as np
import pytest
import torch

from tests.conftest import random_network
from unjam.drivers import DRIVERS, Driver, ResidualDriver, check_driver
from unjam.drivers.check import random_state
from unjam.drivers.driver import scalar_memory
from unjam.drivers.registry import driver_from_name, driver_from_recipe, driver_recipe

EXPERTS = [
    "human",
    "idm",
    "idm:time_headway=1.5",
    "pi",
    "pi:time_constant=0,safe_gap_rule=closing,first_command=zero",
    "pi:window=0.3",
    "pi-from-gap",
    "pi-from-gap:fade_time=2,history_factor=0.3",
    "follower-stopper",
    "follower-stopper:desired_speed=4",
    "acc",
    "acc:time_gap=2,set_speed=5",
    "smooth-acc",
    "smooth-acc:averaging_time=0,time_constant=0,history_factor=0.2",
    "lacc:lag=0.4",
    "lacc:lag=0.01",
    "bcm:desired_speed=4",
    "ovm",
    "pacer",
    "pacer:harmonics=[7,-0.8,0.7,-1.3,0.7]",
    "pacer:use_tuned=true",
    "jam-absorber",
    "jam-absorber:first_position=-1000,last_position=1000,jam_speed=15",
    "jam-absorber:gap_gain=0,extra_acceleration=0.9,speed_gain=0.8",
    "cruise",
    "jam-ahead",
    "jam-ahead:all_lanes=true,last_section=9",
    "gap-maker:merge_time_gap=1.5,downstream_distance=300",
    "adaptive-acc",
    "advisory-speed:advised_speed=20",
    "adaptive-acc:time_headway=1.2,jam_front_speed_change=0.5",
    "constant:acceleration=0.2",
]


@pytest.fixture(params=EXPERTS)
def expert(request: pytest.FixtureRequest) -> Driver:
    return driver_from_name(request.param, 0.1)


def test_every_driver_is_among_them() -> None:
    assert {text.partition(":")[0] for text in EXPERTS} == set(DRIVERS)


def test_keeps_the_contract(expert: Driver) -> None:
    check_driver(expert)


def test_plain_numbers_give_what_arrays_give(expert: Driver) -> None:
    if expert.requirements().needs_arrays:
        pytest.skip("messages are arrays")
    generator = np.random.default_rng(1)
    memory = expert.initial_memory(1)
    numbers = scalar_memory(memory)
    for _ in range(60):
        state = random_state(generator, 1)
        expected, memory = expert.act(state, memory)
        found, numbers = expert.act(state.map(lambda values: float(values[0])), numbers)
        assert type(found) is float
        assert found == pytest.approx(float(expected[0]), abs=1e-12)


def test_tensors_give_what_arrays_give(expert: Driver) -> None:
    assert not expert.requirements().needs_numpy
    generator = np.random.default_rng(2)
    memory = expert.initial_memory(6)
    tensors = {key: torch.tensor(values) for key, values in memory.items()}
    for _ in range(60):
        state = random_state(generator, 6)
        expected, memory = expert.act(state, memory)
        found, tensors = expert.act(state.map(lambda values: torch.tensor(values)), tensors)
        np.testing.assert_allclose(found.numpy(), expected, atol=1e-12)


def test_rows_of_different_age_do_not_mix(expert: Driver) -> None:
    """Memories taken at different times, as the virtual environment takes them, go on as they would alone."""
    generator = np.random.default_rng(3)
    ages = [0, 1, 7, 400]
    alone = []
    for age in ages:
        memory = expert.initial_memory(1)
        for _ in range(age):
            _, memory = expert.act(random_state(generator, 1), memory)
        alone.append(memory)
    together = {key: np.concatenate([memory[key] for memory in alone]) for key in alone[0]}
    for _ in range(5):
        state = random_state(generator, len(ages))
        found, together = expert.act(state, together)
        for row in range(len(ages)):
            one = state.select(slice(row, row + 1))
            expected, alone[row] = expert.act(one, alone[row])
            assert found[row] == pytest.approx(expected[0], abs=1e-12)


def test_recipe_makes_the_same_driver_again(expert: Driver) -> None:
    recipe, arrays = driver_recipe(expert)
    assert driver_from_recipe(recipe, arrays) == expert


def test_recipe_of_a_residual_on_a_residual_keeps_both_networks() -> None:
    inner = ResidualDriver(driver_from_name("pi", 0.1), random_network(5, seed=1), 1.0)
    parts = ("local", "expert_acceleration", "expert_memory")
    outer = ResidualDriver(inner, random_network(8, seed=2), 1.0, parts, action_repeat=3)
    again = driver_from_recipe(*driver_recipe(outer))
    check_driver(again)
    generator = np.random.default_rng(4)
    memories = [driver.initial_memory(4) for driver in (outer, again)]
    for _ in range(10):
        state = random_state(generator, 4)
        expected, memories[0] = outer.act(state, memories[0])
        found, memories[1] = again.act(state, memories[1])
        np.testing.assert_array_equal(found, expected)
