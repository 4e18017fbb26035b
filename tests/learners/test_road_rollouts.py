"""Model rollouts on closed roads, compared with recorded episodes."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest

from unjam.drivers import IDM, PISaturation
from unjam.drivers.network import Network
from unjam.drivers.observation import observation_size
from unjam.drivers.safety import INSTANT_ACTUATOR, STANDARD_ACTUATOR, Actuator, SafetyFilter
from unjam.drivers.sensors import Sensors
from unjam.learners.agent import AgentSpec
from unjam.learners.model_rollouts import ModelRollouts, full_policy
from unjam.learners.settings import PolicySettings
from unjam.models.comparison import ReplayDriver
from unjam.models.road_model import base_human_model
from unjam.models.settings import ModelSettings
from unjam.models.whole_road_models import ClosedRoadModel
from unjam.scenarios import FigureEight, Ring
from unjam.scenarios.ring import LoopScenario
from unjam.worlds.batch.run import run_batch
from unjam.worlds.episode import Task
from unjam.worlds.record import Episode
from unjam.worlds.worker_pool import EpisodeTask

CONTROL_STEPS = 100
RING = Ring(length=(220, 240), vehicles=20, cavs=2, horizon=400, warmup=0)
EIGHT = FigureEight(cavs=2, horizon=400)
"""with vehicles that must yield"""
INEXACT = replace(RING, sensors=Sensors(0.5, 0.5, dropout=0.1), safety=SafetyFilter(gap_error=0.5, speed_error=0.5))
POLICY = PolicySettings(hidden=(8,))
MODEL = ModelSettings(kind="road", k_max=CONTROL_STEPS, model_ratio=1.0)


def network_of(exploration_std: float, policy: PolicySettings = POLICY) -> Network:
    generator = np.random.default_rng(3)
    sizes = [observation_size(policy.inputs, PISaturation()), 8, 1]
    layers = [
        (0.3 * generator.normal(size=(before, after)), 0.1 * generator.normal(size=after))
        for before, after in itertools.pairwise(sizes)
    ]
    return Network(tuple(layers), 1.0, exploration_std)


def learned_rollouts(road: LoopScenario, network: Network) -> tuple[ModelRollouts, ClosedRoadModel, list[Episode]]:
    """Rollouts of a model that is fitted to four episodes, this model, and these episodes."""
    task = Task(road, PISaturation())
    model_rollouts = ModelRollouts(AgentSpec([task], POLICY, MODEL, 0.99, 0))
    driver = full_policy(task, POLICY, network)
    tasks = [EpisodeTask(road, driver, (seed,), explore=True) for seed in range(4)]
    episodes = run_batch(tasks, allow_statistical=True)
    model_rollouts.learn(episodes, 1)
    assert isinstance(model_rollouts.world_model, ClosedRoadModel)
    return model_rollouts, model_rollouts.world_model, episodes


@pytest.mark.long
@pytest.mark.parametrize(
    "road", [RING, replace(RING, warmup=300), EIGHT], ids=["a ring", "a ring with a wave", "a figure eight"]
)
def test_rollouts_without_noise_equal_the_recording(road: LoopScenario) -> None:
    _, model, episodes = learned_rollouts(replace(road, noise=0.0), network_of(0.0))
    humans = base_human_model("idm", road)
    memory = ReplayDriver(np.zeros((0, 2))).initial_memory(2)
    for recording, start_step in ((0, 0), (2, 130), (4, 20), (6, 290)):  # each with the next one, two CAVs
        accelerations = [
            model.data.recordings[row].applied_acceleration[start_step:] for row in (recording, recording + 1)
        ]
        (found,) = model.simulate(
            *(ReplayDriver(np.stack(accelerations, 1)), memory, np.array([[recording, start_step]])),
            CONTROL_STEPS,
            humans,
            (1,),
        )
        episode, window = episodes[recording // 2], slice(start_step, start_step + CONTROL_STEPS + 1)
        np.testing.assert_allclose(found.speeds, episode.speeds[window], atol=1e-6)
        np.testing.assert_allclose(found.gaps, episode.gaps[window], atol=1e-5)


@pytest.mark.parametrize("actuator", [INSTANT_ACTUATOR, STANDARD_ACTUATOR])
def test_rollouts_continue_with_the_recorded_memory_and_commands(actuator: Actuator) -> None:
    network = network_of(0.0)
    model_rollouts, _, episodes = learned_rollouts(replace(RING, noise=0.0, actuator=actuator), network)
    model_rollouts.k_star = CONTROL_STEPS
    found = model_rollouts.roll_out(network, 1)
    assert found is not None
    recorded = [each.actions_and_rewards[1] for episode in episodes for each in episode.trajectories]
    equal_count = 0
    for rewards in found.rewards.reshape(-1, CONTROL_STEPS // 10):
        windows = [one[at : at + 10] for one in recorded for at in range(len(one) - 9)]
        equal_count += min(np.abs(window - rewards).max() for window in windows) < 1e-6
    # A quarter starts so late that the recording ends earlier.
    assert equal_count > 0.5 * len(found.starts)


@pytest.mark.long
@pytest.mark.parametrize("road", [RING, INEXACT, EIGHT], ids=["exact sensors", "wrong sensors", "a figure eight"])
def test_rollouts_with_noise_have_the_returns_of_the_road(road: LoopScenario) -> None:
    model_rollouts, _, _ = learned_rollouts(road, network_of(0.05))
    found = model_rollouts.roll_out(network_of(0.05), 1)
    assert found is not None
    assert len(found.rewards) == 2 * 4 * 400 / 10
    assert found.observations.shape[1] == observation_size(POLICY.inputs, PISaturation()) + 1
    facts = model_rollouts.facts
    assert facts["return_model"] == pytest.approx(facts["return_environment"], rel=0.1)
    assert facts["k_star"] == CONTROL_STEPS
    assert model_rollouts.model_steps == 4 * 400


def test_each_rollout_has_its_own_sensor_errors() -> None:
    _, model, _ = learned_rollouts(replace(INEXACT, noise=0.0), network_of(0.0))
    starts, humans = np.array([[0, 0], [0, 0]]), base_human_model("idm", RING)
    one, other = model.simulate(IDM(), {}, starts, CONTROL_STEPS, humans, (1,))
    assert np.abs(one.speeds - other.speeds).max() > 0.01


def test_too_short_k_star_gives_no_rollouts() -> None:
    model_rollouts, _, _ = learned_rollouts(RING, network_of(0.0))
    model_rollouts.k_star = 9
    assert model_rollouts.roll_out(network_of(0.0), 1) is None


@pytest.mark.long
@pytest.mark.parametrize("road", [RING, EIGHT], ids=["a ring", "a figure eight"])
def test_state_and_restore_keep_samples_and_noise(road: LoopScenario) -> None:
    _, one, _ = learned_rollouts(road, network_of(0.05))
    other = ClosedRoadModel(MODEL, Task(road, PISaturation()), [1.0], (0,))
    facts, tensors = one.state()
    other.restore(json.loads(json.dumps(facts)), tensors)
    assert len(other.samples) == 4
    for restored, stored in zip(other.samples, one.samples, strict=True):
        np.testing.assert_array_equal(restored.speeds, stored.speeds)
        assert restored.size == stored.size
        np.testing.assert_equal(restored.crossing_memory, stored.crossing_memory)
    assert float(other.ensemble.noise) == float(one.ensemble.noise) > 0.0
