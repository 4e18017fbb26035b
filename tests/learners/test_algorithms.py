from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.learners.task import INPUTS, Target, Task, constant_target, mean_return, same, sloped_target
from unjam.drivers.network import Network
from unjam.learners.algorithms import LEARNERS
from unjam.learners.rows import discounted_returns, rows_of
from unjam.learners.settings import LearnerSettings, PolicySettings, PPOSettings, SACSettings, TRPOSettings

torch.set_num_threads(1)  # more would fight for the cores over matrices of this size


# Nothing in the task has late consequences, so a small discount is enough.
TO_LEARN: dict[str, LearnerSettings] = {
    "trpo": TRPOSettings(critic_epochs=3, gamma=0.8, gae_lambda=0.9),
    "ppo": PPOSettings(epochs=20, gamma=0.8, gae_lambda=0.9),
    "sac": SACSettings(
        gamma=0.5,
        start_steps=1600,
        rate=5e-3,
        tau=0.02,
        reward_scale=10.0,
        temperature=0.02,
        batch=64,
        updates_per_step=0.04,
    ),
}


@pytest.mark.parametrize(
    ("target", "hold"), [(constant_target, 1), pytest.param(sloped_target, 5, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize(
    "agent", [pytest.param(name, marks=pytest.mark.slow) if name == "ppo" else name for name in LEARNERS]
)
def test_learns_to_be_at_the_target(agent: str, target: Target, hold: int) -> None:
    policy = PolicySettings(hidden=(16,), exploration_std=0.2)
    episodes = 8 if hold == 1 else 20
    task = Task(policy, TO_LEARN[agent], agent, target=target, hold=hold, episodes=episodes)
    task.learn(12 if agent == "sac" else 30)
    observations = np.random.default_rng(9).uniform(-1.0, 1.0, size=(500, INPUTS))
    at_start = np.abs(task.networks[0](observations) - target(observations)).mean()
    at_end = np.abs(task.learner.network()(observations) - target(observations)).mean()
    assert at_end < 0.1 < at_start / 2
    assert mean_return(task.iterations[-1]) > mean_return(task.iterations[0]) / 2  # both are negative


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


def test_settings_reach_ppo() -> None:
    settings = PPOSettings(gamma=0.9, gae_lambda=0.5, clip=0.3, epochs=4, actor_rate=0.01, critic_rate=0.02)
    learner: Any = Task(settings=settings, agent="ppo").learn(1).learner
    assert (learner.rollout_buffer.gamma, learner.rollout_buffer.gae_lambda) == (0.9, 0.5)
    assert learner.clip_range(1.0) == 0.3
    assert [group["lr"] for group in learner.policy.optimizer.param_groups] == [0.01, 0.02]


@pytest.mark.parametrize(("minibatches", "steps_per_epoch"), [(1, 1), (3, 3)])
def test_each_epoch_of_ppo_takes_all_rows_in_so_many_parts(minibatches: int, steps_per_epoch: int) -> None:
    settings = PPOSettings(epochs=5, minibatches=minibatches)
    parameters = Task(settings=settings, agent="ppo", episodes=3).learn(2).parameters()
    steps = {int(tensor) for name, tensor in parameters.items() if name.endswith("/step")}
    assert steps == {2 * 5 * steps_per_epoch}


def test_actor_and_critic_of_ppo_learn_at_their_own_rates() -> None:
    def moved(actor_rate: float, critic_rate: float) -> dict[bool, float]:
        settings = PPOSettings(epochs=5, actor_rate=actor_rate, critic_rate=critic_rate)
        task = Task(settings=settings, agent="ppo")
        before = task.parameters()
        after = task.learn(2).parameters()
        found = {True: 0.0, False: 0.0}
        for name, tensor in before.items():
            if name.startswith("policy/") and "scale" not in name:
                critic = "value" in name
                found[critic] = max(found[critic], float((after[name] - tensor).abs().max()))
        return found

    assert moved(1e-12, 1e-2)[False] < 1e-8 < 1e-3 < moved(1e-12, 1e-2)[True]
    assert moved(1e-2, 1e-12)[True] < 1e-8 < 1e-3 < moved(1e-2, 1e-12)[False]


@pytest.mark.parametrize("start", ["expert", "uniform"])
def test_sac_learns_nothing_before_its_start_is_driven(start: Any) -> None:
    settings = SACSettings(start=start, start_steps=1700, updates_per_step=0.02, batch=8)
    task = Task(PolicySettings(hidden=(16,), exploration_std=0.1), settings, "sac").learn(4)
    updates = [entry.log.get("n_updates", 0.0) for entry in task.iterations]
    assert updates == [0.0, 0.0, 48.0, 64.0]  # 800 actual steps in each iteration
    rows = np.zeros((2000, INPUTS))
    noise = np.random.default_rng(0).normal(size=len(rows))
    stds = [network.explore(rows, noise).std() for network in task.networks]
    expected = 0.1 if start == "expert" else 3**-0.5
    assert stds[:3] == pytest.approx([expected] * 3, rel=0.05)
    assert stds[3] == pytest.approx(0.1, rel=0.2)  # the policy's own, after its first few updates
    assert (task.networks[2](rows) == 0.0).all()


def test_an_iteration_of_sac_makes_at_least_one_update() -> None:
    settings = SACSettings(start_steps=0, updates_per_step=1e-9, batch=8)
    task = Task(settings=settings, agent="sac").learn(2)
    assert [entry.log["n_updates"] for entry in task.iterations] == [1.0, 2.0]


@pytest.mark.parametrize("normalise", [True, False])
def test_rewards_of_sac_are_shifted_by_the_mean_of_the_first_iteration_and_scaled(normalise: bool) -> None:
    policy = PolicySettings(hidden=(8,), normalise_value=normalise)
    settings = SACSettings(start_steps=0, updates_per_step=0.01, batch=8, reward_scale=3.0)
    task = Task(policy, settings, "sac").learn(2)
    earned = [
        np.concatenate([episode.trajectories[0].reward for episode in entry.episodes])
        for entry in task.iterations
    ]
    offset = earned[0].mean() if normalise else 0.0
    expected = 3.0 * (np.concatenate(earned) - offset)
    np.testing.assert_allclose(task.parameters()["replay/rewards"][:, 0], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("learned", [True, False])
def test_the_temperature_of_sac_changes_only_where_it_is_learned(learned: bool) -> None:
    settings = SACSettings(
        start_steps=0, updates_per_step=0.02, batch=8, temperature=0.3, learn_temperature=learned
    )
    logs = [entry.log["ent_coef"] for entry in Task(settings=settings, agent="sac").learn(3).iterations]
    assert logs[0] == pytest.approx(0.3, rel=0.01)
    assert (logs[-1] == logs[0]) is not learned


def test_settings_reach_sac() -> None:
    settings = SACSettings(
        gamma=0.9, tau=0.1, rate=0.02, batch=33, buffer_rows=77, learn_temperature=True, target_entropy=-3.0
    )
    learner: Any = Task(settings=settings, agent="sac").learner
    assert (learner.gamma, learner.tau, learner.batch_size) == (0.9, 0.1, 33)
    assert learner.replay_buffer.buffer_size == 77
    assert learner.target_entropy == -3.0
    optimisers = (learner.actor.optimizer, learner.critic.optimizer, learner.ent_coef_optimizer)
    assert {optimiser.param_groups[0]["lr"] for optimiser in optimisers} == {0.02}
