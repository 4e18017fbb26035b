import json
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.conftest import random_network
from tests.learners.toy_task import Iteration, iteration_of, same
from unjam.drivers import PISaturation
from unjam.drivers.network import Network
from unjam.drivers.observation import observation_size
from unjam.drivers.residual import ResidualDriver
from unjam.learners.agent import AgentSpec
from unjam.learners.algorithm import Collector, TaskEpisodes, run_iterations
from unjam.learners.algorithm_1 import Algorithm1, make_algorithm
from unjam.learners.learner import Update
from unjam.learners.model_rollouts import ModelRollouts, rollout_experience
from unjam.learners.settings import AGENT_NAMES, PolicySettings, PPOSettings, SACSettings, TD3Settings, TRPOSettings
from unjam.models.registry import RowWorldModel
from unjam.models.rollouts import RolloutBatch
from unjam.models.settings import ModelSettings
from unjam.models.world_model import RolloutPlan
from unjam.physics.idm import IDMParameters
from unjam.scenarios import Ring
from unjam.worlds.episode import Task, run_episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.simulation import Simulation

torch.set_num_threads(1)

RING = Ring(length=(110, 120), vehicles=9, horizon=120)
POLICY = PolicySettings(hidden=(16,))
MODEL = ModelSettings(members=2, hidden=(16,), epochs=2, max_fit_rows=500, k_max=30, kappa=30.0)
SETTINGS = {
    "trpo": TRPOSettings(critic_epochs=2, critic_batch_size=16),
    "ppo": PPOSettings(epochs=3),
    "sac": SACSettings(learning_starts=0, gradient_steps_per_step=0.02, batch_size=16, buffer_size=500),
    "td3": TD3Settings(learning_starts=0, gradient_steps_per_step=0.02, batch_size=16, buffer_size=500),
}
TASK = Task(RING, PISaturation())
FREE = ModelSettings(model_ratio=0.0)
INPUTS = observation_size(POLICY.inputs, PISaturation())

every_learner = pytest.mark.parametrize("agent", AGENT_NAMES)


def driver_of(network: Network) -> ResidualDriver:
    return ResidualDriver(PISaturation(), network, 1.0, POLICY.inputs, POLICY.action_repeat(0.1))


def spec_of(model: ModelSettings, gamma: float = 0.99) -> AgentSpec:
    return AgentSpec([TASK], POLICY, model, gamma, 0)


def algorithm_of(agent: str, model: ModelSettings) -> Algorithm1:
    settings = SETTINGS[agent]
    made = make_algorithm(agent, settings, spec_of(model, settings.gamma))
    assert isinstance(made, Algorithm1)
    return made


class Trained:
    """A learner on a small ring in SUMO, and its iterations."""

    def __init__(self, simulation: Simulation, agent: str, model: ModelSettings | None, **policy: Any) -> None:
        settings = replace(POLICY, **policy)
        self.iterations: list[Iteration] = []
        self.episodes_run = 0

        def collect(network: Network, iteration: int) -> TaskEpisodes:
            driver = ResidualDriver(PISaturation(), network, 1.0, settings.inputs, settings.action_repeat(0.1))
            self.episodes_run += 2
            return [
                [
                    run_episode(RING, driver, (0, iteration, index), explore=True, backend=SumoBackend(simulation))
                    for index in range(2)
                ]
            ]

        self.algorithm = algorithm_of(agent, model or FREE)
        self.collector = Collector(collect)
        self.learner: Any = self.algorithm.learner

    def learn(self, iterations: int) -> "Trained":
        budget = iterations * 2 * RING.horizon
        run_iterations(
            *(self.algorithm, self.collector, budget, 0),
            lambda log: self.iterations.append(iteration_of(self.collector, log)),
        )
        return self


@pytest.fixture(scope="module")
def shared() -> Iterator[Simulation]:
    with Simulation() as opened:
        yield opened


@pytest.mark.long
@every_learner
def test_model_rows_change_learning_without_environment_steps(agent: str, shared: Simulation) -> None:
    model_free, with_model = (Trained(shared, agent, model).learn(2) for model in (None, MODEL))
    assert [entry.environment_steps for entry in with_model.iterations] == [
        entry.environment_steps for entry in model_free.iterations
    ]
    assert with_model.episodes_run == model_free.episodes_run == 4
    assert [entry.model_steps for entry in model_free.iterations] == [0, 0]
    assert with_model.iterations[-1].model_steps >= 2 * 2 * RING.horizon
    assert not same(policy_of(model_free), policy_of(with_model))


def policy_of(trained: Trained) -> dict[str, torch.Tensor]:
    return dict(trained.learner.sb3.policy.state_dict())


@pytest.mark.long
@every_learner
@pytest.mark.parametrize("update", ["union", "sequential"])
def test_resumed_learner_has_the_same_model_and_data(agent: str, update: str, shared: Simulation) -> None:
    model = replace(MODEL, update_mode=update, model_updates=2)
    expected = Trained(shared, agent, model).learn(3)
    stopped = Trained(shared, agent, model).learn(1)
    resumed = Trained(shared, agent, model)
    resumed.algorithm.restore(*stopped.algorithm.state())
    resumed.collector.iteration, resumed.collector.environment_steps = 1, stopped.collector.environment_steps
    resumed.learn(3)
    assert same(resumed.algorithm.state()[1], expected.algorithm.state()[1])
    assert resumed.iterations[-1].model == expected.iterations[-1].model
    assert resumed.iterations[-1].model_steps == expected.iterations[-1].model_steps


@pytest.mark.parametrize("agent", ["trpo", "ppo"])
def test_the_ratio_is_exactly_one_before_each_update(agent: str, shared: Simulation) -> None:
    trained = Trained(shared, agent, replace(MODEL, update_mode="sequential", model_updates=2))
    learner = trained.learner
    updates: list[Update] = []

    def learn(update: Update) -> None:
        learner.fill_buffer(update.rows)
        buffer = learner.sb3.rollout_buffer
        observations, actions = (torch.as_tensor(part[:, 0]) for part in (buffer.observations, buffer.actions))
        _, log_prob, _ = learner.sb3.policy.evaluate_actions(observations, actions)
        np.testing.assert_array_equal(log_prob.detach().numpy(), buffer.log_probs[:, 0])
        updates.append(update)

    learner.learn = learn
    trained.learn(1)
    assert len(updates) == 3


def rollouts_of(rewards: np.ndarray, lengths: list[int], terminated: list[bool]) -> RolloutBatch:
    rows, action_count = rewards.shape
    generator = torch.Generator().manual_seed(0)
    return RolloutBatch(
        observations=torch.randn((rows, action_count + 1, INPUTS), generator=generator),
        actions=torch.randn((rows, action_count), generator=generator),
        rewards=torch.as_tensor(rewards),
        lengths=torch.tensor(lengths),
        terminated=torch.tensor(terminated),
        drawn_values=torch.linspace(-1, 1, rows)[:, None],
        control_steps=sum(lengths),
        clipped_share={},
    )


def test_rows_of_a_rollout_end_where_it_crashed() -> None:
    rollouts = rollouts_of(np.arange(6.0).reshape(2, 3), [3, 2], [False, True])
    rows = rollout_experience(rollouts, rollouts.drawn_values.numpy())
    assert rows.rewards.tolist() == [0, 1, 2, 3, 4]
    assert rows.starts.tolist() == [0, 3]
    assert rows.terminated.tolist() == [False, True]
    np.testing.assert_array_equal(rows.observations[3, :-1], rollouts.observations[1, 0])
    np.testing.assert_array_equal(rows.last_observations[1, :-1], rollouts.observations[1, 2])
    assert rows.observations[:, -1].tolist() == [-1, -1, -1, 1, 1]


def test_truncated_rollouts_are_bootstrapped(shared: Simulation) -> None:
    learner = Trained(shared, "trpo", None).learner
    rollouts = rollouts_of(np.array([[1.0, 2.0], [3.0, 4.0]]), [2, 2], [False, True])
    rows = rollout_experience(rollouts, rollouts.drawn_values.numpy())
    learner.fill_buffer(rows)
    with torch.no_grad():
        values, ends = (
            learner.sb3.policy.predict_values(torch.as_tensor(part)).numpy().ravel()
            for part in (rows.observations, rows.last_observations)
        )
    found = learner.sb3.rollout_buffer.advantages[:, 0]
    assert found[1] == pytest.approx(2.0 + learner.gamma * ends[0] - values[1], abs=1e-4)
    assert found[3] == pytest.approx(4.0 - values[3], abs=1e-4)


@pytest.mark.parametrize(
    ("rollout_starts", "start_episodes"), [("newest", {2, 3}), ("all", {0, 1, 2, 3}), ("first", {0, 1, 2, 3})]
)
def test_rollouts_start_in_the_set_episodes_with_the_set_ratio(
    shared: Simulation, rollout_starts: Any, start_episodes: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    rollouts = ModelRollouts(spec_of(replace(MODEL, model_ratio=3.0, rollout_starts=rollout_starts)))
    world_model: Any = rollouts.world_model
    network = random_network(INPUTS, scale=0.1)
    driver = ResidualDriver(PISaturation(), network, 1.0, POLICY.inputs, 10)
    for iteration in (1, 2):
        episodes = [
            run_episode(RING, driver, (9, iteration, n), explore=True, backend=SumoBackend(shared)) for n in (0, 1)
        ]
        rollouts.learn(episodes, iteration)
    plans, batches = list[RolloutPlan](), list[RolloutBatch]()
    simulate = world_model.simulate

    def recorded(plan: RolloutPlan) -> RolloutBatch:
        plans.append(plan)
        batches.append(simulate(plan))
        return batches[-1]

    monkeypatch.setattr(world_model, "simulate", recorded)
    rows = rollouts.roll_out(network, 2)
    assert rows is not None
    (batch,) = batches
    assert rollouts.k_star == 30
    assert batch.rewards.numel() == 3 * 240 / 10
    assert set(plans[0].starts[:, 0]) == start_episodes
    assert (set(plans[0].starts[:, 1]) == {0}) == (rollout_starts == "first")


def test_k_star_of_zero_gives_no_model_rows(shared: Simulation) -> None:
    trained = Trained(shared, "trpo", replace(MODEL, kappa=1e-6)).learn(2)
    assert [(entry.model[0]["k_star"], entry.model_steps) for entry in trained.iterations] == [(0, 0), (0, 0)]
    assert same(policy_of(trained), policy_of(Trained(shared, "trpo", None).learn(2)))


def test_real_ratio_mixes_environment_and_model_rows() -> None:
    sac: Any = algorithm_of("sac", FREE).learner
    buffer = sac.buffer
    environment, model = (
        rollout_experience(rollouts, rollouts.drawn_values.numpy())
        for rollouts in (rollouts_of(np.full((4, 3), reward), [3] * 4, [False] * 4) for reward in (1.0, 2.0))
    )
    sac.add_rows(buffer, environment)
    assert set(buffer.sample(8).rewards.numpy().ravel()) == {np.float32(0.1)}
    sac.add_rows(buffer.new_model_buffer(12), model)
    buffer.real_ratio = 0.25
    found = buffer.sample(8).rewards.numpy().ravel()
    assert sorted(found) == pytest.approx([0.1] * 2 + [0.2] * 6)
    buffer.model_buffer = None
    assert set(buffer.sample(8).rewards.numpy().ravel()) == {np.float32(0.1)}


def test_facts_of_the_model_are_complete(shared: Simulation) -> None:
    iteration = Trained(shared, "trpo", MODEL).learn(1).iterations[0]
    (model,) = iteration.model
    assert {"k_star", "eps_m", "eps_m_by_estimator", "one_step", "bound", "return_model", "return_environment"} <= set(
        model
    )
    assert set(iteration.seconds) == {"fit", "roll_out", "update"}
    assert 0 < iteration.log["eps_pi_mean"] <= iteration.log["eps_pi_max"] <= 1
    assert model["bound"] > abs(model["return_model"] - model["return_environment"])


def test_state_and_restore_keep_calibrated_humans(shared: Simulation) -> None:
    one, other = (RowWorldModel(MODEL, TASK, [1.0], (0,)) for _ in range(2))
    humans = IDMParameters(time_headway=1.3, max_acceleration=0.8)
    one.scenario = replace(RING, humans=humans)
    one.data.add([run_episode(RING, PISaturation(), (0,), backend=SumoBackend(shared))], RING)
    facts, tensors = one.state()
    other.restore(json.loads(json.dumps(facts)), tensors)
    assert other.scenario == one.scenario
