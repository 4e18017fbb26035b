from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

from tests.learners.toy_task import INPUTS, Toy, make_policy, of_any_size, random_rows, residual_of, shake
from unjam.learners.sac_td3 import DeterministicResidualPolicy
from unjam.learners.settings import PolicySettings, TD3Settings

torch.set_num_threads(1)  # more threads are slower with small matrices
new_policy = partial(make_policy, DeterministicResidualPolicy)


@pytest.mark.parametrize(("std", "authority"), [(0.1, 1.0), (0.3, 0.5)])
def test_new_policy_has_zero_mean_and_noise_of_the_set_size(std: float, authority: float) -> None:
    policy = new_policy(PolicySettings(exploration_std=std, authority=authority), action_limit=2.0)
    network, rows = policy.network(), random_rows(200, 5)
    assert (residual_of(policy, rows) == 0.0).all()
    assert (network(rows.astype(float)) == 0.0).all()
    noise = np.random.default_rng(0).normal(size=len(rows))
    np.testing.assert_allclose(network.explore(rows.astype(float), noise), 2.0 * std * noise, atol=1e-12)


@of_any_size
def test_numpy_network_equals_the_torch_policy(
    seed: int, inputs: int, hidden: list[int], authority: float, rows: int
) -> None:
    policy = new_policy(PolicySettings(hidden=tuple(hidden), authority=authority), inputs, critic_inputs=2)
    shake(policy.actor, seed)
    observations = random_rows(rows, inputs + 2, seed)
    found = policy.network()(observations[:, :inputs].astype(float))
    np.testing.assert_allclose(found, residual_of(policy, observations), rtol=0, atol=1e-6)


def test_target_networks_start_as_copies() -> None:
    policy, rows = new_policy(critic_inputs=1), torch.as_tensor(random_rows(5, 6))
    action = torch.ones(5, 1)
    assert torch.equal(policy.actor(rows), policy.actor_target(rows))
    for found, target in zip(policy.critic(rows, action), policy.critic_target(rows, action), strict=True):
        assert torch.equal(found, target)


def test_td3_does_not_learn_before_learning_starts_and_keeps_its_noise() -> None:
    settings = TD3Settings(learning_starts=1700, gradient_steps_per_step=0.02, batch_size=8)
    toy = Toy(PolicySettings(hidden=(16,), exploration_std=0.1), settings, "td3").learn(4)
    updates = [entry.log.get("n_updates", 0.0) for entry in toy.iterations]
    assert updates == [0.0, 0.0, 48.0, 64.0]  # 800 environment steps in each iteration
    assert [network.exploration_std for network in toy.networks] == pytest.approx([0.1] * 4)
    assert (toy.networks[2](np.ones((3, INPUTS))) == 0.0).all()


def test_policy_delay_is_the_number_of_critic_updates_per_policy_update() -> None:
    settings = TD3Settings(learning_starts=0, gradient_steps_per_step=0.01, batch_size=8, policy_delay=4)
    tensors = Toy(settings=settings, agent="td3").learn(1).parameters()
    steps = {part: int(tensors[f"{part}.optimizer/0/step"]) for part in ("actor", "critic")}
    assert steps == {"actor": 2, "critic": 8}


def test_residual_distribution_is_exploration_noise_around_the_residual() -> None:
    toy = Toy(agent="td3").learn(2)
    observations = torch.as_tensor(random_rows(20, INPUTS + 1))
    noise = toy.learner.residual_distribution(observations)
    mean, std = noise.mean, noise.stddev
    network = toy.learner.network()
    np.testing.assert_allclose(mean.numpy(), network(observations[:, :INPUTS].numpy().astype(float)), atol=1e-6)
    assert set(std.tolist()) == {np.float32(network.exploration_std)}


def test_settings_reach_td3() -> None:
    settings = TD3Settings(gamma=0.9, tau=0.1, learning_rate=0.02, batch_size=33, buffer_size=77, policy_delay=3)
    learner: Any = Toy(settings=settings, agent="td3").learner.sb3
    assert (learner.gamma, learner.tau, learner.batch_size, learner.policy_delay) == (0.9, 0.1, 33, 3)
    assert (learner.target_policy_noise, learner.target_noise_clip) == (0.2, 0.5)
    assert learner.replay_buffer.buffer_size == 77
    optimizers = (learner.actor.optimizer, learner.critic.optimizer)
    assert {optimizer.param_groups[0]["lr"] for optimizer in optimizers} == {0.02}


def test_policy_without_zero_init_has_random_residuals() -> None:
    policy = new_policy(PolicySettings(zero_init=False))
    assert residual_of(policy, random_rows(200, 5, 0)).std() > 0.001
