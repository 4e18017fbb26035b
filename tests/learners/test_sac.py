import math
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

from tests.learners.toy_task import INPUTS, Toy, make_policy, of_any_size, random_rows, residual_of, shake
from unjam.learners.sac_td3 import SquashedResidualPolicy, uniform_network
from unjam.learners.settings import PolicySettings, SACSettings

torch.set_num_threads(1)  # more threads are slower with small matrices
new_policy = partial(make_policy, SquashedResidualPolicy)


def values_of(policy: SquashedResidualPolicy, rows: np.ndarray) -> np.ndarray:
    with torch.no_grad():
        return torch.cat(policy.critic(torch.as_tensor(rows), torch.zeros(len(rows), 1)), dim=1).numpy()


@pytest.mark.parametrize(("std", "authority"), [(0.1, 1.0), (0.3, 0.5)])
def test_new_policy_has_zero_mean_and_exploration_noise(std: float, authority: float) -> None:
    policy = new_policy(PolicySettings(exploration_std=std, authority=authority), action_limit=2.0)
    network, rows = policy.network(), random_rows(20_000, 5)
    assert (residual_of(policy, rows) == 0.0).all()
    assert (network(rows.astype(float)) == 0.0).all()
    noise = np.random.default_rng(0).normal(size=len(rows))
    explored = network.explore(rows.astype(float), noise)
    bound = 2.0 * authority
    np.testing.assert_allclose(explored, bound * np.tanh(2.0 * std / bound * noise), atol=1e-6)


@of_any_size
def test_numpy_network_equals_the_torch_policy_with_noise(
    seed: int, inputs: int, hidden: list[int], authority: float, rows: int
) -> None:
    policy = new_policy(PolicySettings(hidden=tuple(hidden), authority=authority), inputs, critic_inputs=2)
    shake(policy.actor, seed)
    observations = random_rows(rows, inputs + 2, seed)
    network = policy.network()
    found = network(observations[:, :inputs].astype(float))
    np.testing.assert_allclose(found, residual_of(policy, observations), rtol=0, atol=2e-6)
    noise = np.random.default_rng(seed).normal(size=rows)
    with torch.no_grad():
        mean, log_std, _ = policy.actor.get_action_dist_params(torch.as_tensor(observations))
    drawn = authority * np.tanh((mean + log_std.exp() * torch.as_tensor(noise)[:, None]).numpy()[:, 0])
    explored = network.explore(observations[:, :inputs].astype(float), noise)
    np.testing.assert_allclose(explored, drawn, rtol=0, atol=2e-5)


@pytest.mark.parametrize(("log_std", "clipped"), [(5.0, 2.0), (-30.0, -20.0)])
def test_numpy_network_bounds_noise_as_the_policy(log_std: float, clipped: float) -> None:
    policy = new_policy()
    with torch.no_grad():
        policy.actor.get_parameter("log_std.bias").fill_(log_std)
    found = policy.network().explore(np.zeros((1, 5)), np.array([1e-2]))
    np.testing.assert_allclose(found, np.tanh(math.exp(clipped) * 1e-2), rtol=1e-6)


def test_numpy_network_keeps_its_weights_while_the_policy_learns() -> None:
    policy = new_policy()
    network, rows = policy.network(), random_rows(10, 5).astype(float)
    shake(policy.actor, 2)
    assert (network(rows) == 0.0).all()
    assert np.abs(policy.network()(rows)).max() > 1e-3


def test_privileged_inputs_change_the_value_and_not_the_residual() -> None:
    policy = new_policy(critic_inputs=2)
    shake(policy, 4)
    rows = random_rows(50, 7)
    other = rows.copy()
    other[:, 5:] += 1.0
    np.testing.assert_array_equal(residual_of(policy, other), residual_of(policy, rows))
    assert np.abs(values_of(policy, other) - values_of(policy, rows)).min() > 1e-5


def test_target_starts_as_a_copy_of_the_critic() -> None:
    policy = new_policy(critic_inputs=1)
    rows = torch.as_tensor(random_rows(5, 6))
    for found, target in zip(
        policy.critic(rows, torch.ones(5, 1)), policy.critic_target(rows, torch.ones(5, 1)), strict=True
    ):
        assert torch.equal(found, target)


def test_critics_are_bounded_far_from_data() -> None:
    policy = new_policy(critic_inputs=1)
    rows = random_rows(200, 6)
    near, far = values_of(policy, rows), values_of(policy, 1000.0 * rows)
    assert np.abs(far).max() < 3.0 * np.abs(near).max()
    assert np.ptp(far) > 0.01


def test_uniform_network_covers_its_authority() -> None:
    network = uniform_network(3, authority=2.0)
    noise = np.random.default_rng(0).normal(size=200_000)
    found = np.sort(network.explore(np.ones((len(noise), 3)), noise))
    share = np.arange(len(found)) / len(found)
    assert np.abs(share - (found + 2.0) / 4.0).max() < 0.015
    assert (network(np.ones((4, 3))) == 0.0).all()


@pytest.mark.parametrize("start", ["expert", "uniform"])
def test_sac_does_not_learn_before_learning_starts(start: Any) -> None:
    settings = SACSettings(start_policy=start, learning_starts=1700, gradient_steps_per_step=0.02, batch_size=8)
    task = Toy(PolicySettings(hidden=(16,), exploration_std=0.1), settings, "sac").learn(4)
    updates = [entry.log.get("n_updates", 0.0) for entry in task.iterations]
    assert updates == [0.0, 0.0, 48.0, 64.0]  # 800 environment steps in each iteration
    rows = np.zeros((2000, INPUTS))
    noise = np.random.default_rng(0).normal(size=len(rows))
    stds = [network.explore(rows, noise).std() for network in task.networks]
    expected = 0.1 if start == "expert" else 3**-0.5
    assert stds[:3] == pytest.approx([expected] * 3, rel=0.05)
    assert stds[3] == pytest.approx(0.1, rel=0.2)  # the policy's own, after its first few updates
    assert (task.networks[2](rows) == 0.0).all()


def test_an_iteration_of_sac_makes_at_least_one_update() -> None:
    settings = SACSettings(learning_starts=0, gradient_steps_per_step=1e-9, batch_size=8)
    task = Toy(settings=settings, agent="sac").learn(2)
    assert [entry.log["n_updates"] for entry in task.iterations] == [1.0, 2.0]


@pytest.mark.parametrize("normalize", [True, False])
def test_rewards_of_sac_are_shifted_by_the_mean_of_the_first_iteration_and_scaled(normalize: bool) -> None:
    policy = PolicySettings(hidden=(8,), normalize_value=normalize)
    settings = SACSettings(learning_starts=0, gradient_steps_per_step=0.01, batch_size=8, reward_scale=3.0)
    task = Toy(policy, settings, "sac").learn(2)
    rewards = [
        np.concatenate([episode.trajectories[0].reward for episode in entry.episodes[0]]) for entry in task.iterations
    ]
    offset = rewards[0].mean() if normalize else 0.0
    expected = 3.0 * (np.concatenate(rewards) - offset)
    np.testing.assert_allclose(task.parameters()["replay/rewards"][:, 0], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("learned", [True, False])
def test_temperature_of_sac_changes_only_if_learned(learned: bool) -> None:
    settings = SACSettings(
        learning_starts=0, gradient_steps_per_step=0.02, batch_size=8, temperature=0.3, learn_temperature=learned
    )
    logs = [entry.log["ent_coef"] for entry in Toy(settings=settings, agent="sac").learn(3).iterations]
    assert logs[0] == pytest.approx(0.3, rel=0.01)
    assert (logs[-1] == logs[0]) is not learned


def test_settings_reach_sac() -> None:
    settings = SACSettings(
        gamma=0.9,
        tau=0.1,
        learning_rate=0.02,
        batch_size=33,
        buffer_size=77,
        learn_temperature=True,
        target_entropy=-3.0,
    )
    learner: Any = Toy(settings=settings, agent="sac").learner.sb3
    assert (learner.gamma, learner.tau, learner.batch_size) == (0.9, 0.1, 33)
    assert learner.replay_buffer.buffer_size == 77
    assert learner.target_entropy == -3.0
    optimizers = (learner.actor.optimizer, learner.critic.optimizer, learner.ent_coef_optimizer)
    assert {optimizer.param_groups[0]["lr"] for optimizer in optimizers} == {0.02}


def test_policy_without_zero_init_has_random_residuals() -> None:
    policy = new_policy(PolicySettings(zero_init=False))
    assert residual_of(policy, random_rows(200, 5, 0)).std() > 0.001
