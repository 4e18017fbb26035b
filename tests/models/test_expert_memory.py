from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.conftest import random_network
from unjam.drivers import IDM, Driver, LocalState, PISaturation, ResidualDriver
from unjam.drivers.check import random_state
from unjam.drivers.driver import Memory
from unjam.drivers.local_state import COMMON_FIELDS, state_of_ones
from unjam.drivers.user_driver import FileDriver
from unjam.errors import InputError
from unjam.models.environment_data import EnvironmentData, reconstruct_memory
from unjam.models.rollouts import NumPyDriverAdapter, tensor_driver, tensor_memory
from unjam.scenarios import Ring
from unjam.tree import leaves, map_leaves
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.simulation import Simulation

RING = Ring(length=(60, 70), vehicles=5, cavs=2, horizon=90)


def record_memories(driver: Driver, monkeypatch: pytest.MonkeyPatch) -> list[Memory]:
    """Record the memories with which a driver acts from now on."""
    memories: list[Memory] = []
    kind, act = type(driver), type(driver).act

    def recorded_act(self: Driver, state: LocalState, memory: Memory) -> tuple:
        if self is driver:
            memories.append(map_leaves(np.array, memory))
        return act(self, state, memory)

    monkeypatch.setattr(kind, "act", recorded_act)
    return memories


def experts(my_drivers: Path) -> list[Driver]:
    return [
        PISaturation(window=3.0),
        FileDriver(my_drivers, "Keeper"),
        ResidualDriver(PISaturation(window=2.0), random_network(seed=3), 1.0, action_repeat=4),
    ]


@pytest.mark.parametrize("number", [0, 1, 2])
@pytest.mark.parametrize("warmup", [0, 40])
def test_memory_equals_that_of_the_actual_drive(
    number: int, warmup: int, my_drivers: Path, sumo: SumoBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two episodes with two CAVs each, driven with exploration; random starts in all four trajectories."""
    expert = experts(my_drivers)[number]
    driver = ResidualDriver(expert, random_network(), 1.0, action_repeat=3)
    ring, data, memories = replace(RING, warmup=warmup), EnvironmentData(1000), []
    for seed in range(2):
        with monkeypatch.context() as patch:
            recorded = record_memories(expert, patch)
            data.add([run_episode(ring, driver, (seed,), explore=True, backend=sumo)], ring)
        memories += [recorded, recorded]
    start_indices = np.random.default_rng(0).permutation(data.start_indices())[:40]
    found = reconstruct_memory(expert, data.recordings, start_indices)
    for row, (index, step) in enumerate(start_indices):
        expected_memory = memories[index][step]
        leaves_found, expected = dict(leaves(found)), dict(leaves(expected_memory))
        assert leaves_found.keys() == expected.keys()
        for key, values in expected.items():
            np.testing.assert_allclose(leaves_found[key][row], values[index % 2], atol=1e-10)


def test_memory_has_no_later_or_foreign_states() -> None:
    """A window goes back to the start of its own trajectory, and no further."""
    expert = PISaturation(window=100.0)
    data = EnvironmentData(1000)
    driver = ResidualDriver(expert, random_network(), 1.0, action_repeat=10)
    with Simulation() as simulation:
        episodes = [run_episode(RING, driver, (seed,), backend=SumoBackend(simulation)) for seed in range(3)]
    data.add(episodes, RING)
    start_indices = data.start_indices()
    found = reconstruct_memory(expert, data.recordings, start_indices)
    for row, (index, step) in enumerate(start_indices):
        speeds = data.recordings[index].states.speed[:step]
        assert found["count"][row] == step
        np.testing.assert_array_equal(found["window"][row, :step], speeds)
        assert not found["window"][row, step:].any()


def test_driver_without_memory_has_empty_memory() -> None:
    data = EnvironmentData(1000)
    driver = ResidualDriver(IDM(), random_network(), 1.0)
    data.add([run_episode(RING, driver, (1,))], RING)
    assert reconstruct_memory(IDM(), data.recordings, data.start_indices()[:5]) == {}


def test_built_in_drivers_take_tensors_without_adapter(my_drivers: Path) -> None:
    pi = PISaturation()
    assert tensor_driver(pi, "cpu") is pi
    assert isinstance(tensor_driver(FileDriver(my_drivers, "Keeper"), "cpu"), NumPyDriverAdapter)
    user_expert = ResidualDriver(FileDriver(my_drivers, "Keeper"), random_network(), 1.0)
    assert isinstance(tensor_driver(user_expert, "cpu"), NumPyDriverAdapter)


@pytest.mark.parametrize("number", [0, 1, 2])
def test_tensor_driver_equals_array_driver(number: int, my_drivers: Path) -> None:
    expert = experts(my_drivers)[number]
    on_tensors = tensor_driver(expert, "cpu")
    generator = np.random.default_rng(1)
    memory = expert.initial_memory(4)
    tensors = tensor_memory(on_tensors, memory, "cpu")
    for _ in range(50):
        state = random_state(generator, 4)
        expected, memory = expert.act(state, memory)
        tensor_state = state.map(lambda values: torch.tensor(values, dtype=torch.float32))
        found, tensors = on_tensors.act(tensor_state, tensors)
        assert found.dtype == torch.float32
        np.testing.assert_allclose(found.numpy(), expected, atol=1e-4)
        features = on_tensors.memory_features(tensors)
        expected_features = expert.memory_features(memory)
        assert (features is None) == (expected_features is None)
        if features is not None and expected_features is not None:
            np.testing.assert_allclose(features.numpy(), expected_features, atol=1e-4)


def test_non_finite_acceleration_raises_error(my_drivers: Path) -> None:
    state = state_of_ones(COMMON_FIELDS, torch.ones, 3)
    with pytest.raises(InputError, match="model rollout: acceleration is nan; allowed: finite"):
        tensor_driver(FileDriver(my_drivers, "broken"), "cpu").act(state, {})
    with pytest.raises(InputError, match=r"shape \(4,\); allowed: \(3,\)"):
        tensor_driver(FileDriver(my_drivers, "short"), "cpu").act(state, {})
