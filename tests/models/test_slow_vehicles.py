"""Models of vehicles that follow commands with delay and lag."""

from dataclasses import replace

import numpy as np
import pytest

from unjam.drivers import PISaturation
from unjam.drivers.safety import INSTANT_ACTUATOR, STANDARD_ACTUATOR
from unjam.models.comparison import recorded_states, replay_accelerations
from unjam.models.environment_data import EnvironmentData
from unjam.models.row_model import RowModel, residual_targets
from unjam.models.settings import ModelSettings
from unjam.scenarios import Ring
from unjam.worlds.batch.run import run_batch
from unjam.worlds.episode import run_episode
from unjam.worlds.worker_pool import EpisodeTask

RING = Ring(vehicles=8, length=(90, 95), horizon=200, warmup=100, actuator=STANDARD_ACTUATOR)
DRIVER = PISaturation(time_constant=0.5)


@pytest.fixture(scope="module")
def data() -> EnvironmentData:
    found = EnvironmentData(10_000, RING.actuator, RING.control_step)
    found.add(run_batch([EpisodeTask(RING, DRIVER, (seed,)) for seed in range(3)]), RING)
    return found


def test_the_base_predicts_the_own_speed_of_a_slow_vehicle_exactly(data: EnvironmentData) -> None:
    transitions = data.transitions(0.3)
    assert np.abs(transitions.response - transitions.acceleration).max() > 0.1
    own_speed = residual_targets(transitions, "idm", RING, "")[:, 0]
    np.testing.assert_allclose(own_speed, 0.0, atol=1e-9)


def test_replays_continue_with_the_acceleration_and_the_commands_on_their_way(data: EnvironmentData) -> None:
    starts = data.start_indices(40)[::7]
    model = RowModel(replace(ModelSettings(), members=1), len(RING.drawn_ranges), (0,))
    recorded = recorded_states(data, starts, 40)["speed"][:, 1:]
    replayed = replay_accelerations(model, data, starts, 40, RING)["speed"][0]
    np.testing.assert_allclose(replayed, recorded, atol=1e-4)
    at_rest = data.actuator_states_at(np.array([[0, 0], [2, 0]]))
    assert [at_rest.acceleration.tolist(), *(each.tolist() for each in at_rest.pending)] == [[0.0, 0.0]] * 3


def test_the_response_of_an_ideal_vehicle_is_its_command() -> None:
    ring = replace(RING, actuator=INSTANT_ACTUATOR)
    found = EnvironmentData(10_000)
    found.add([run_episode(ring, DRIVER, 0)], ring)
    transitions = found.transitions(0.3)
    np.testing.assert_array_equal(transitions.response, transitions.acceleration)
    assert found.actuator_states_at(found.start_indices()[:2]).pending == ()
