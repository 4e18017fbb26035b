from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from unjam.agents.buffers import discounted_returns, rows_of
from unjam.agents.settings import PolicySettings, TRPOSettings
from unjam.drivers.network import Network

from .task import INPUTS, Target, Task, constant_target, mean_return, same, sloped_target

torch.set_num_threads(1)  # more would fight for the cores over matrices of this size


@pytest.mark.parametrize("hold", [1, 5])
@pytest.mark.parametrize("target", [constant_target, sloped_target])
def test_learns_to_be_at_the_target(target: Target, hold: int) -> None:
    policy = PolicySettings(hidden=(16,), exploration_std=0.2)
    settings = TRPOSettings(critic_epochs=3, gamma=0.8, gae_lambda=0.9)  # nothing here has late consequences
    task = Task(policy, settings, target=target, hold=hold, episodes=8 if hold == 1 else 20).learn(30)
    observations = np.random.default_rng(9).uniform(-1.0, 1.0, size=(500, INPUTS))
    at_start = np.abs(task.networks[0](observations) - target(observations)).mean()
    at_end = np.abs(task.learner.network()(observations) - target(observations)).mean()
    assert at_end < 0.1 < at_start / 2
    assert mean_return(task.iterations[-1]) > mean_return(task.iterations[0]) / 10  # both are negative


def test_each_update_stays_within_the_trust_region() -> None:
    task = Task(settings=TRPOSettings(critic_epochs=1, target_kl=0.02)).learn(5)
    networks = [*task.networks, task.learner.network()]
    for iteration, before, after in zip(task.iterations, networks[:-1], networks[1:], strict=True):
        observations = np.concatenate([e.trajectories[0].observations[:-1] for e in iteration.episodes])
        old, new = before.exploration_std, after.exploration_std
        moved = (after(observations) - before(observations)) ** 2
        divergence = float(np.mean(np.log(old / new) + (new**2 + moved) / (2 * old**2) - 0.5))
        assert 0.2 * 0.02 < divergence <= 0.02 * 1.001
        assert divergence == pytest.approx(iteration.log["kl_divergence_loss"], rel=0.01)


@pytest.mark.parametrize("learned", [True, False])
def test_exploration_changes_only_where_it_is_learned(learned: bool) -> None:
    policy = PolicySettings(hidden=(8,), exploration_std=0.2, learn_exploration=learned)
    task = Task(policy).learn(3)
    found = task.learner.network().exploration_std
    assert (found == task.networks[0].exploration_std) is not learned
    assert same_mean(task.networks[0], task.learner.network()) is False


def same_mean(one: Network, other: Network) -> bool:
    rows = np.random.default_rng(0).uniform(size=(5, INPUTS))
    return bool(np.array_equal(one(rows), other(rows)))


@pytest.mark.parametrize("normalise", [True, False])
def test_units_of_the_value_come_from_the_first_iteration(normalise: bool) -> None:
    policy = PolicySettings(hidden=(8,), normalise_value=normalise)
    task = Task(policy).learn(3)
    trajectories = [episode.trajectories[0] for episode in task.iterations[0].episodes]
    returns = discounted_returns(rows_of(trajectories, [()] * len(trajectories)), 0.99)
    expected = [returns.mean(), returns.std()] if normalise else [0.0, 1.0]
    assert task.parameters()["policy/value_net.scale"].tolist() == pytest.approx(expected, rel=1e-5)


def test_the_units_of_a_value_that_never_changes_stay_usable() -> None:
    policy = PolicySettings(hidden=(8,), exploration_std=1e-9)
    task = Task(policy, target=lambda rows: np.zeros(len(rows))).learn(2)
    assert task.parameters()["policy/value_net.scale"][1] > 0.0
    assert all(torch.isfinite(tensor).all() for tensor in task.parameters().values())


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
    learner: Any = Task(settings=replace(settings, critic_rate=0.02, value_l2=0.3)).learner
    (group,) = learner.policy.optimizer.param_groups
    assert (learner.rollout_buffer.gamma, learner.rollout_buffer.gae_lambda) == (0.9, 0.5)
    assert (learner.target_kl, learner.cg_damping, learner.cg_max_steps) == (0.07, 0.2, 7)
    assert (learner.n_critic_updates, learner.batch_size) == (4, 33)
    assert (group["lr"], group["weight_decay"], group["eps"]) == (0.02, 0.3, 1e-5)


def test_the_decay_of_the_value_network_leaves_the_actor_alone() -> None:
    def actor(value_l2: float) -> dict[str, Any]:
        found = Task(settings=TRPOSettings(value_l2=value_l2, critic_rate=0.01)).learn(1).parameters()
        return {name: tensor for name, tensor in found.items() if "value" not in name and "policy/" in name}

    def critic(value_l2: float) -> torch.Tensor:
        found = Task(settings=TRPOSettings(value_l2=value_l2, critic_rate=0.01)).learn(1).parameters()
        return found["policy/value_net.linear.weight"]

    assert same(actor(0.0), actor(5.0))
    assert not torch.equal(critic(0.0), critic(5.0))
