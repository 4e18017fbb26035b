import numpy as np
import pytest
import torch

from tests.conftest import random_network
from unjam.controller import make_driver
from unjam.drivers import IDM, Driver, LocalState, PISaturation, ResidualDriver, check_driver
from unjam.drivers.check import random_state
from unjam.drivers.driver import scalar_memory
from unjam.drivers.network import Network
from unjam.drivers.observation import observation_size
from unjam.drivers.safety import SafetyFilter
from unjam.drivers.wrappers import FilteredDriver, HistoryDriver
from unjam.tree import map_leaves

ALL_PARTS = ("local", "expert_acceleration", "expert_memory", "loop_length", "lap_position", "route_position")


def zero_network(inputs: int) -> Network:
    layers = ((np.ones((inputs, 4)), np.ones(4)), (np.zeros((4, 1)), np.zeros(1)))
    return Network(layers, 1.0, 0.1)


def test_with_a_zero_network_it_is_exactly_its_expert_within_the_limit() -> None:
    expert = PISaturation(time_constant=0)
    driver = ResidualDriver(expert, zero_network(5), 1.0)
    generator = np.random.default_rng(0)
    memory, expert_memory = driver.initial_memory(5), expert.initial_memory(5)
    for _ in range(40):
        state = random_state(generator, 5)
        found, memory = driver.act(state, memory)
        expected, expert_memory = expert.act(state, expert_memory)
        np.testing.assert_array_equal(found, expected.clip(-1.0, 1.0))


def test_adds_expert_and_residual_and_clips_the_sum() -> None:
    driver = ResidualDriver(IDM(), random_network(5, scale=2.0), 1.0)
    state = random_state(np.random.default_rng(1), 200)
    decision = driver.decide(state, driver.initial_memory(200))
    expected = decision.expert + decision.residual
    np.testing.assert_array_equal(decision.command.acceleration, expected.clip(-1.0, 1.0))
    assert (np.abs(expected) > 1.0).any()
    assert np.abs(decision.expert).max() <= 1.0


@pytest.mark.parametrize("hold", [1, 3, 10])
@pytest.mark.parametrize("parts", [("local",), ALL_PARTS])
def test_keeps_the_contract_of_drivers(hold: int, parts: tuple) -> None:
    expert = PISaturation()
    network = random_network(observation_size(parts, expert))
    check_driver(ResidualDriver(expert, network, 1.0, parts, hold))


@pytest.mark.parametrize("hold", [1, 4])
@pytest.mark.parametrize("expert", [PISaturation(), HistoryDriver(PISaturation(), 0.1)])
def test_plain_numbers_give_what_arrays_give(expert: Driver, hold: int) -> None:
    driver = ResidualDriver(expert, random_network(observation_size(ALL_PARTS, expert)), 1.0, ALL_PARTS, hold)
    generator = np.random.default_rng(2)
    memory = driver.initial_memory(1)
    numbers = scalar_memory(memory)
    assert not driver.requirements().needs_arrays
    for _ in range(25):
        state = random_state(generator, 1)
        expected, memory = driver.act(state, memory)
        found, numbers = driver.act(state.map(lambda values: float(values[0])), numbers)
        assert found == pytest.approx(float(expected[0]), abs=1e-12)


@pytest.mark.parametrize("hold", [1, 4])
def test_tensors_give_what_arrays_give(hold: int) -> None:
    inner = ResidualDriver(PISaturation(), random_network(), 1.0, action_repeat=2)
    network = random_network(observation_size(ALL_PARTS, inner))
    driver = ResidualDriver(inner, network, 1.0, ALL_PARTS, hold)
    assert not driver.requirements().needs_numpy
    generator = np.random.default_rng(5)
    memory = driver.initial_memory(6)
    tensors = map_leaves(torch.tensor, memory)
    for _ in range(12):
        state, noise = random_state(generator, 6), generator.normal(size=6)
        expected = driver.decide(state, memory, lambda: noise)  # noqa: B023
        memory = expected.memory
        on_tensors = state.map(lambda values: torch.tensor(values))
        found = driver.decide(on_tensors, tensors, lambda: torch.tensor(noise))  # noqa: B023
        tensors = found.memory
        np.testing.assert_allclose(found.command.acceleration.numpy(), expected.command.acceleration, atol=1e-12)
        assert found.observation is not None
        assert expected.observation is not None
        np.testing.assert_allclose(found.observation.numpy(), expected.observation, atol=1e-12)


def test_holds_its_residual_for_as_many_decisions_as_asked() -> None:
    driver = ResidualDriver(IDM(), random_network(5), 1.0, action_repeat=3)
    generator = np.random.default_rng(3)
    memory, residuals = driver.initial_memory(2), []
    for _ in range(9):
        decision = driver.decide(random_state(generator, 2), memory)
        memory = decision.memory
        residuals.append(decision.residual)
    for start in (0, 3, 6):
        np.testing.assert_array_equal(residuals[start], residuals[start + 2])
    assert not np.array_equal(residuals[2], residuals[3])


def test_explores_only_when_given_noise() -> None:
    driver = ResidualDriver(IDM(), random_network(5), 1.0)
    state = random_state(np.random.default_rng(4), 3)
    still = driver.decide(state, driver.initial_memory(3)).residual
    moved = driver.decide(state, driver.initial_memory(3), lambda: np.array([1.0, 0.0, -1.0])).residual
    np.testing.assert_allclose(moved - still, [0.2, 0.0, -0.2], atol=1e-12)


def test_a_residual_on_a_residual_that_both_hold_keep_apart() -> None:
    inner = ResidualDriver(PISaturation(), random_network(5, seed=1), 1.0, action_repeat=2)
    outer = ResidualDriver(inner, random_network(5, seed=2), 1.0, action_repeat=5)
    check_driver(outer)


def test_observes_what_was_asked_for() -> None:
    driver = ResidualDriver(PISaturation(), random_network(9), 1.0, ALL_PARTS)
    state = LocalState(*(np.array([value]) for value in (4.0, 5.0, 10.0, 3.0, 8.0, 20.0, 250.0)))
    seen = driver.observation(state, driver.initial_memory(1))[0]
    np.testing.assert_allclose(seen[:5], [0.4, 0.2, 0.5, -0.2, 0.4])
    assert abs(seen[5]) <= 1.0
    assert seen[6] == pytest.approx(0.4)  # mean own speed after one step is the own speed
    assert seen[8] == pytest.approx(1.0)


def test_what_its_expert_asks_of_the_cars_own_accs_is_asked_however_deep_it_stands() -> None:
    expert = make_driver("gap-maker", 1.0)
    one = ResidualDriver(expert, random_network(), 1.0)
    state = random_state(np.random.default_rng(3), 40, optional_fields=True)
    asked = expert.time_gaps(state, expert.initial_memory(40))
    assert asked is not None
    assert np.isfinite(asked).any()
    for driver in (one, ResidualDriver(one, random_network(), 1.0), FilteredDriver(one, 1.0, SafetyFilter(), 1.0)):
        found = driver.time_gaps(state, driver.initial_memory(40))
        np.testing.assert_array_equal(np.array(found), asked)


def test_what_its_expert_remembers_is_seen_through_a_filter_too() -> None:
    expert = PISaturation()
    around = FilteredDriver(expert, 1.0, SafetyFilter(), 0.1)
    parts = ("local", "expert_memory")
    assert observation_size(parts, around) == observation_size(parts, expert) == 7
    driver = ResidualDriver(around, random_network(7), 1.0, parts)
    check_driver(driver)
