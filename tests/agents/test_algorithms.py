from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
import torch

from unjam.agents.algorithms import EpisodicTRPO, Iteration, seed_iteration
from unjam.agents.buffers import discounted_returns
from unjam.agents.settings import PolicySettings, TRPOSettings
from unjam.agents.state import learner_state
from unjam.drivers import LocalState
from unjam.drivers.network import Network
from unjam.scenarios import Ring
from unjam.traffic.record import Episode, Trajectory

torch.set_num_threads(1)  # more would fight for the cores over matrices of this size

INPUTS, DECISIONS = 2, 100
LENGTHS = (220.0, 270.0)

Target = Callable[[np.ndarray], np.ndarray]


def constant_target(observations: np.ndarray) -> np.ndarray:
    return np.full(len(observations), 0.4)


def sloped_target(observations: np.ndarray) -> np.ndarray:
    return 0.5 * observations[:, 0]


def episode_of(network: Network, seed: tuple[int, ...], hold: int, target: Target) -> Episode:
    """An episode of a task without a road: be at the target, which the observation tells."""
    generator = np.random.default_rng(seed)
    looks = DECISIONS // hold
    observations = generator.uniform(-1.0, 1.0, size=(looks + 1, INPUTS))
    chosen = network.explore(observations[:-1], generator.normal(size=looks))
    residual = np.repeat(chosen, hold)
    wanted = np.repeat(target(observations[:-1]), hold)
    nothing = np.zeros(DECISIONS)
    trajectory = Trajectory(
        vehicle="cav_0",
        start=0,
        states=LocalState(*[np.zeros(DECISIONS + 1)] * len(LocalState._fields)),
        observations=observations,
        expert=nothing,
        residual=residual,
        applied=residual,
        shield=nothing,
        terms={"near": -((residual - wanted) ** 2)},
        memory={},
        hold=hold,
        terminated=False,
    )
    drawn = {"length": LENGTHS[seed[-1] % 2]}
    speeds = np.zeros((DECISIONS + 1, 1))
    return Episode(seed=seed, status="completed", drawn=drawn, speeds=speeds, trajectories=(trajectory,))


@dataclass
class Task:
    """A learner of the task, and what its iterations told."""

    policy: PolicySettings = field(
        default_factory=lambda: PolicySettings(hidden=(16,), hold=1, exploration_std=0.2)
    )
    settings: TRPOSettings = field(default_factory=lambda: TRPOSettings(critic_epochs=3))
    seed: int = 0
    target: Target = constant_target
    episodes: int = 8
    iterations: list[Iteration] = field(default_factory=list)
    networks: list[Network] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.learner = EpisodicTRPO(
            INPUTS, Ring(), self.policy, self.settings, self.seed, self.collect, self.iterations.append
        )

    def collect(self, network: Network, iteration: int) -> list[Episode]:
        self.networks.append(network)
        return [
            episode_of(network, (self.seed, iteration, index), self.policy.hold, self.target)
            for index in range(self.episodes)
        ]

    def learn(self, iterations: int) -> "Task":
        self.learner.run(iterations * self.episodes * DECISIONS)
        return self

    def parameters(self) -> dict[str, torch.Tensor]:
        return learner_state(self.learner)[1]


def mean_return(iteration: Iteration) -> float:
    return float(np.mean([episode.trajectories[0].reward.sum() for episode in iteration.episodes]))


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("hold", [1, 5])
@pytest.mark.parametrize("target", [constant_target, sloped_target])
def test_learns_to_be_at_the_target(target: Target, hold: int) -> None:
    policy = PolicySettings(hidden=(16,), hold=hold, exploration_std=0.2)
    settings = TRPOSettings(critic_epochs=3, gamma=0.8, gae_lambda=0.9)  # nothing here has late consequences
    task = Task(policy, settings, target=target, episodes=8 if hold == 1 else 20).learn(30)
    observations = np.random.default_rng(9).uniform(-1.0, 1.0, size=(500, INPUTS))
    at_start = np.abs(task.networks[0](observations) - target(observations)).mean()
    at_end = np.abs(task.learner.policy.network()(observations) - target(observations)).mean()
    assert at_end < 0.1 < at_start / 2
    assert mean_return(task.iterations[-1]) > mean_return(task.iterations[0]) / 10  # both are negative


def test_the_same_seed_gives_the_same_parameters_to_the_last_bit() -> None:
    one, other = Task().learn(3), Task().learn(3)
    assert same(one.parameters(), other.parameters())
    assert [entry.log for entry in one.iterations] == [entry.log for entry in other.iterations]
    assert not same(one.parameters(), Task(seed=1).learn(3).parameters())


def test_what_others_draw_in_between_changes_nothing() -> None:
    task, disturbed = Task(), Task()
    for iterations in (1, 2, 3):
        task.learn(iterations)
        torch.rand(7)
        np.random.rand(7)
        disturbed.learn(iterations)
    assert same(task.parameters(), disturbed.parameters())


@pytest.mark.parametrize("hold", [1, 5])
def test_counts_decisions_and_not_looks(hold: int) -> None:
    task = Task(PolicySettings(hidden=(4,), hold=hold), episodes=3)
    task.learner.run(2 * 3 * DECISIONS)
    assert [entry.actual_steps for entry in task.iterations] == [300, 600]
    assert [entry.number for entry in task.iterations] == [1, 2]
    assert len(task.learner.rollout_buffer.rewards) == 3 * DECISIONS // hold


def test_ends_with_the_first_iteration_that_reaches_the_budget() -> None:
    task = Task(episodes=3)
    task.learner.run(301)
    assert task.learner.num_timesteps == 600
    task.learner.run(600)
    assert len(task.iterations) == 2
    task.learner.run(601)
    assert task.learner.num_timesteps == 900


def test_each_update_stays_within_the_trust_region() -> None:
    task = Task(settings=TRPOSettings(critic_epochs=1, target_kl=0.02)).learn(5)
    networks = [*task.networks, task.learner.policy.network()]
    for iteration, before, after in zip(task.iterations, networks[:-1], networks[1:], strict=True):
        observations = np.concatenate([e.trajectories[0].observations[:-1] for e in iteration.episodes])
        old, new = before.exploration_std, after.exploration_std
        moved = (after(observations) - before(observations)) ** 2
        divergence = float(np.mean(np.log(old / new) + (new**2 + moved) / (2 * old**2) - 0.5))
        assert 0.2 * 0.02 < divergence <= 0.02 * 1.001
        assert divergence == pytest.approx(iteration.log["kl_divergence_loss"], rel=0.01)


@pytest.mark.parametrize("learned", [True, False])
def test_exploration_changes_only_where_it_is_learned(learned: bool) -> None:
    policy = PolicySettings(hidden=(8,), hold=1, exploration_std=0.2, learn_exploration=learned)
    task = Task(policy).learn(3)
    found = task.learner.policy.network().exploration_std
    assert (found == task.networks[0].exploration_std) is not learned
    assert same_mean(task.networks[0], task.learner.policy.network()) is False


def same_mean(one: Network, other: Network) -> bool:
    rows = np.random.default_rng(0).uniform(size=(5, INPUTS))
    return bool(np.array_equal(one(rows), other(rows)))


def test_an_iteration_tells_what_progress_needs() -> None:
    (iteration,) = Task().learn(1).iterations
    expected = {"policy_objective", "kl_divergence_loss", "value_loss", "explained_variance", "std"}
    assert expected <= set(iteration.log)
    assert all(type(value) is float and np.isfinite(value) for value in iteration.log.values())
    assert set(iteration.seconds) == {"actual", "update"}
    assert min(iteration.seconds.values()) > 0.0
    assert iteration.virtual_steps == 0
    assert len(iteration.episodes) == 8


@pytest.mark.parametrize("normalise", [True, False])
def test_units_of_the_value_come_from_the_first_iteration(normalise: bool) -> None:
    policy = PolicySettings(hidden=(8,), hold=1, normalise_value=normalise)
    task = Task(policy).learn(3)
    trajectories = [episode.trajectories[0] for episode in task.iterations[0].episodes]
    returns = discounted_returns(trajectories, 0.99)
    expected = [returns.mean(), returns.std()] if normalise else [0.0, 1.0]
    assert task.parameters()["policy.value_net.scale"].tolist() == pytest.approx(expected, rel=1e-5)


def test_the_units_of_a_value_that_never_changes_stay_usable() -> None:
    policy = PolicySettings(hidden=(8,), hold=1, exploration_std=1e-9)
    task = Task(policy, target=lambda rows: np.zeros(len(rows))).learn(2)
    assert task.parameters()["policy.value_net.scale"][1] > 0.0
    assert all(torch.isfinite(tensor).all() for tensor in task.parameters().values())


@pytest.mark.parametrize("sees_road", [True, False])
def test_only_the_critic_sees_the_road_that_was_drawn(sees_road: bool) -> None:
    policy = PolicySettings(hidden=(8,), hold=1, critic_sees_road=sees_road)
    task = Task(policy, episodes=2).learn(1)
    width = INPUTS + sees_road
    assert task.learner.observation_space.shape == (width,)
    columns = task.learner.rollout_buffer.observations.reshape(2 * DECISIONS, width)
    assert task.learner.policy.network().inputs == INPUTS
    if sees_road:
        assert set(columns[:, INPUTS]) == {-1.0, 1.0}


def test_settings_reach_the_learner() -> None:
    settings = TRPOSettings(
        gamma=0.9,
        gae_lambda=0.5,
        target_kl=0.07,
        cg_damping=0.2,
        cg_steps=7,
        critic_epochs=4,
        critic_batch=33,
    )
    learner = Task(settings=replace(settings, critic_rate=0.02, value_l2=0.3)).learner
    (group,) = learner.policy.optimizer.param_groups
    assert (learner.rollout_buffer.gamma, learner.rollout_buffer.gae_lambda) == (0.9, 0.5)
    assert (learner.target_kl, learner.cg_damping, learner.cg_max_steps) == (0.07, 0.2, 7)
    assert (learner.n_critic_updates, learner.batch_size) == (4, 33)
    assert (group["lr"], group["weight_decay"], group["eps"]) == (0.02, 0.3, 1e-5)


def test_the_decay_of_the_value_network_leaves_the_actor_alone() -> None:
    def actor(value_l2: float) -> dict[str, Any]:
        found = Task(settings=TRPOSettings(value_l2=value_l2, critic_rate=0.01)).learn(1).parameters()
        return {name: tensor for name, tensor in found.items() if "value" not in name and "policy." in name}

    def critic(value_l2: float) -> torch.Tensor:
        found = Task(settings=TRPOSettings(value_l2=value_l2, critic_rate=0.01)).learn(1).parameters()
        return found["policy.value_net.linear.weight"]

    assert same(actor(0.0), actor(5.0))
    assert not torch.equal(critic(0.0), critic(5.0))


def test_each_iteration_of_each_run_draws_its_own_numbers() -> None:
    drawn = {}
    for run, iteration in [(0, 1), (0, 2), (1, 1), (1, 2)]:
        seed_iteration(run, iteration)
        drawn[run, iteration] = (float(torch.rand(1)), float(np.random.rand()))
        seed_iteration(run, iteration)
        assert (float(torch.rand(1)), float(np.random.rand())) == drawn[run, iteration]
    assert len(set(drawn.values())) == 4
