from dataclasses import replace
from functools import partial
from typing import Any, cast

import numpy as np
import pytest
import torch
from torch.distributions import Normal

from tests.learners.toy_task import INPUTS, Toy, make_policy, of_any_size, random_rows, same, shake
from unjam.drivers import PISaturation, ResidualDriver
from unjam.drivers.network import Network
from unjam.drivers.observation import observation_size
from unjam.learners.experience import discounted_returns, make_experience
from unjam.learners.sb3_learner import policy_spaces
from unjam.learners.settings import PolicySettings, PPOSettings, TRPOSettings
from unjam.learners.trpo_ppo import ResidualPolicy
from unjam.scenarios import Ring
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend

torch.set_num_threads(1)  # more threads are slower with small matrices
new_policy = partial(make_policy, ResidualPolicy)


def mean_of(policy: ResidualPolicy, rows: np.ndarray) -> np.ndarray:
    with torch.no_grad():
        return policy.get_distribution(torch.as_tensor(rows)).mode()[:, 0].numpy()


def value_of(policy: ResidualPolicy, rows: np.ndarray) -> np.ndarray:
    with torch.no_grad():
        return policy.predict_values(torch.as_tensor(rows))[:, 0].numpy()


@pytest.mark.parametrize("seed", range(5))
def test_residual_of_a_new_policy_is_exactly_zero(seed: int) -> None:
    policy, rows = new_policy(seed=seed), random_rows(200, 5, seed)
    assert (mean_of(policy, rows) == 0.0).all()
    assert (policy.network()(rows.astype(float)) == 0.0).all()


def test_policy_without_zero_init_has_random_residuals() -> None:
    rows = random_rows(200, 5, 0)
    assert mean_of(new_policy(PolicySettings(zero_init=False)), rows).std() > 0.01


@pytest.mark.parametrize("action_repeat", [1, 10])
@pytest.mark.parametrize("cavs", [1, 3])
def test_new_policy_drives_exactly_as_its_expert(action_repeat: int, cavs: int, sumo: SumoBackend) -> None:
    ring = Ring(length=(230, 230), horizon=200, warmup=100, cavs=cavs)
    expert, parts = PISaturation(), PolicySettings().inputs
    network = new_policy(inputs=observation_size(parts, expert)).network()
    driver = ResidualDriver(expert, network, ring.action_limit, parts, action_repeat)
    expert_episode = run_episode(ring, expert, (3,), backend=sumo)
    residual_episode = run_episode(ring, driver, (3,), backend=sumo)
    np.testing.assert_array_equal(residual_episode.speeds, expert_episode.speeds)
    np.testing.assert_array_equal(residual_episode.positions, expert_episode.positions)
    for residual_trajectory, expert_trajectory in zip(
        residual_episode.trajectories, expert_episode.trajectories, strict=True
    ):
        np.testing.assert_array_equal(residual_trajectory.applied_acceleration, expert_trajectory.applied_acceleration)
        assert (residual_trajectory.residual == 0.0).all()
    assert np.abs(expert_episode.trajectories[0].applied_acceleration).max() > 0.1


@of_any_size
def test_numpy_network_equals_the_torch_policy(
    seed: int, inputs: int, hidden: list[int], authority: float, rows: int
) -> None:
    policy = new_policy(PolicySettings(hidden=tuple(hidden), authority=authority), inputs, critic_inputs=2)
    shake(policy, seed)
    observations = random_rows(rows, inputs + 2, seed)
    found = policy.network()(observations[:, :inputs].astype(float))
    np.testing.assert_allclose(found, mean_of(policy, observations), rtol=0, atol=1e-6)


def test_numpy_network_keeps_its_weights_while_the_policy_learns() -> None:
    policy = new_policy()
    shake(policy, 1)
    network, rows = policy.network(), random_rows(10, 5).astype(float)
    before = network(rows)
    shake(policy, 2)
    np.testing.assert_array_equal(network(rows), before)
    assert np.abs(policy.network()(rows) - before).max() > 1e-3


def test_actor_and_critic_have_separate_learning_rates() -> None:
    policy = new_policy(critic_inputs=2)
    policy.set_learning_rates(actor=0.1, critic=0.2)
    rates = {id(parameter): group["lr"] for group in policy.optimizer.param_groups for parameter in group["params"]}
    for name, parameter in policy.named_parameters():
        assert rates.pop(id(parameter)) == (0.2 if "value" in name else 0.1), name
    assert not rates


@pytest.mark.parametrize(("authority", "action_limit"), [(1.0, 1.0), (0.3, 1.0), (0.5, 2.0)])
def test_the_mean_reaches_its_authority_and_never_exceeds_it(authority: float, action_limit: float) -> None:
    policy = new_policy(PolicySettings(authority=authority), action_limit=action_limit)
    shake(policy, 3, scale=30.0)
    rows, bound = random_rows(300, 5), authority * action_limit
    for found in (mean_of(policy, rows), policy.network()(rows.astype(float))):
        assert np.abs(found).max() <= np.float32(bound)
        assert np.abs(found).max() > 0.99 * bound
        assert (found > 0).any()
        assert (found < 0).any()


def test_privileged_inputs_change_the_value_and_not_the_residual() -> None:
    policy = new_policy(critic_inputs=2)
    shake(policy, 4)
    rows = random_rows(50, 7)
    other = rows.copy()
    other[:, 5:] += 1.0
    np.testing.assert_array_equal(mean_of(policy, other), mean_of(policy, rows))
    assert np.abs(value_of(policy, other) - value_of(policy, rows)).min() > 1e-4


def test_critic_uses_the_inputs_of_the_actor() -> None:
    policy = new_policy(critic_inputs=2)
    shake(policy, 5)
    rows = random_rows(50, 7)
    other = rows.copy()
    other[:, :5] += 1.0
    assert np.abs(value_of(policy, other) - value_of(policy, rows)).min() > 1e-4


@pytest.mark.parametrize("learned", [True, False])
def test_initial_exploration_has_the_set_standard_deviation(learned: bool) -> None:
    settings = PolicySettings(exploration_std=0.25, learn_exploration_std=learned)
    policy = new_policy(settings, action_limit=2.0)
    assert policy.network().exploration_std == pytest.approx(0.5, rel=1e-6)
    torch.manual_seed(0)
    drawn = policy.get_distribution(torch.zeros(20_000, 5)).sample().detach()
    assert float(drawn.std()) == pytest.approx(0.5, rel=0.02)


def test_episode_noise_of_the_network_has_the_deviation_of_the_policy() -> None:
    policy = new_policy(PolicySettings(exploration_std=0.1, exploration="per_episode"), action_limit=2.0)
    shake(policy, 3)
    network, rows = policy.network(), random_rows(6, 5)
    assert network.exploration_std == pytest.approx(0.2, rel=1e-6)
    noise = np.random.default_rng(0).normal(size=(20_000, 1, network.episode_noise_size))
    drawn = np.stack([network.explore(rows.astype(float), each) for each in noise])
    with torch.no_grad():
        expected = cast(Normal, policy.get_distribution(torch.as_tensor(rows)).distribution)
    np.testing.assert_allclose(drawn.std(0), expected.stddev[:, 0], rtol=0.03)
    np.testing.assert_allclose(drawn.mean(0), expected.mean[:, 0], atol=0.02)
    assert "log_std" not in dict(policy.named_parameters())


def test_episode_noise_explores_with_zero_hidden_units() -> None:
    policy = new_policy(PolicySettings(exploration_std=0.1, exploration="per_episode"), action_limit=2.0)
    with torch.no_grad():
        at_rest = cast(Normal, policy.get_distribution(torch.zeros(1, 5)).distribution)
    assert float(at_rest.stddev) == pytest.approx(0.2, rel=1e-4)
    network = policy.network()
    bias_alone = np.eye(network.episode_noise_size)[-1:]
    assert network.explore(np.zeros((1, 5)), bias_alone)[0] == pytest.approx(0.2, rel=1e-6)


@pytest.mark.parametrize("learned", [True, False])
def test_log_std_is_a_parameter_only_if_learned(learned: bool) -> None:
    policy = new_policy(PolicySettings(learn_exploration_std=learned))
    assert ("log_std" in dict(policy.named_parameters())) is learned
    optimized = {id(parameter) for group in policy.optimizer.param_groups for parameter in group["params"]}
    assert (id(policy.log_std) in optimized) is learned
    assert "log_std" in policy.state_dict()


def test_optimizer_has_every_parameter_of_the_policy() -> None:
    policy = new_policy(critic_inputs=1)
    optimized = {id(parameter) for group in policy.optimizer.param_groups for parameter in group["params"]}
    assert optimized == {id(parameter) for parameter in policy.parameters()}


def test_value_has_the_set_scale() -> None:
    policy, rows = new_policy(), random_rows(20, 5)
    before = value_of(policy, rows)
    policy.scale_value(150.0, 20.0)
    np.testing.assert_allclose(value_of(policy, rows), 150.0 + 20.0 * before, rtol=1e-6)
    assert np.ptp(before) > 1e-3


def test_value_scale_is_stored_with_the_weights_and_not_learned() -> None:
    policy, other = new_policy(seed=1), new_policy(seed=2)
    policy.scale_value(150.0, 20.0)
    other.load_state_dict(policy.state_dict())
    rows = random_rows(20, 5)
    np.testing.assert_array_equal(value_of(other, rows), value_of(policy, rows))
    assert not [name for name, _ in policy.named_parameters() if "scale" in name]


def test_spaces_have_the_inputs_of_both_networks_and_the_bounds_of_the_mean() -> None:
    observations, actions = policy_spaces(5, 2, 0.7)
    assert observations.shape == (7,)
    assert actions.shape == (1,)
    assert float(actions.high[0]) == pytest.approx(0.7)
    assert float(actions.low[0]) == pytest.approx(-0.7)


def test_each_update_stays_within_the_trust_region() -> None:
    task = Toy(settings=TRPOSettings(critic_epochs=1, target_kl=0.02)).learn(5)
    networks = [*task.networks, task.learner.network()]
    for iteration, before, after in zip(task.iterations, networks[:-1], networks[1:], strict=True):
        observations = np.concatenate([e.trajectories[0].observations[:-1] for e in iteration.episodes[0]])
        old, new = before.exploration_std, after.exploration_std
        largest_changes = (after(observations) - before(observations)) ** 2
        divergence = float(np.mean(np.log(old / new) + (new**2 + largest_changes) / (2 * old**2) - 0.5))
        assert 0.2 * 0.02 < divergence <= 0.02 * 1.001
        assert divergence == pytest.approx(iteration.log["kl_divergence_loss"], rel=0.01)


@pytest.mark.parametrize("learned", [True, False])
def test_exploration_std_changes_only_if_learned(learned: bool) -> None:
    policy = PolicySettings(hidden=(8,), exploration_std=0.2, learn_exploration_std=learned)
    task = Toy(policy).learn(3)
    found = task.learner.network().exploration_std
    assert (found == task.networks[0].exploration_std) is not learned
    assert same_mean(task.networks[0], task.learner.network()) is False


def same_mean(one: Network, other: Network) -> bool:
    rows = np.random.default_rng(0).uniform(size=(5, INPUTS))
    return bool(np.array_equal(one(rows), other(rows)))


@pytest.mark.parametrize("normalize", [True, False])
def test_value_scale_comes_from_the_first_iteration(normalize: bool) -> None:
    policy = PolicySettings(hidden=(8,), normalize_value=normalize)
    task = Toy(policy).learn(3)
    trajectories = [episode.trajectories[0] for episode in task.iterations[0].episodes[0]]
    returns = discounted_returns(make_experience(trajectories, [()] * len(trajectories)), 0.99)
    expected = [returns.mean(), returns.std()] if normalize else [0.0, 1.0]
    assert task.parameters()["policy/value_net.scale"].tolist() == pytest.approx(expected, rel=1e-5)


def test_value_scale_of_constant_returns_is_positive() -> None:
    policy = PolicySettings(hidden=(8,), exploration_std=1e-9)
    task = Toy(policy, target=lambda rows: np.zeros(len(rows))).learn(2)
    assert task.parameters()["policy/value_net.scale"][1] > 0.0
    assert all(torch.isfinite(tensor).all() for tensor in task.parameters().values())


def test_settings_reach_the_learner() -> None:
    settings = TRPOSettings(
        gamma=0.9, gae_lambda=0.5, target_kl=0.07, cg_damping=0.2, cg_max_steps=7, critic_epochs=4, critic_batch_size=33
    )
    learner: Any = Toy(settings=replace(settings, critic_learning_rate=0.02, critic_weight_decay=0.3)).learner.sb3
    (group,) = learner.policy.optimizer.param_groups
    assert (learner.rollout_buffer.gamma, learner.rollout_buffer.gae_lambda) == (0.9, 0.5)
    assert (learner.target_kl, learner.cg_damping, learner.cg_max_steps) == (0.07, 0.2, 7)
    assert (learner.n_critic_updates, learner.batch_size) == (4, 33)
    assert (group["lr"], group["weight_decay"], group["eps"]) == (0.02, 0.3, 1e-5)


def test_weight_decay_of_the_critic_does_not_change_the_actor() -> None:
    def actor(weight_decay: float) -> dict[str, Any]:
        found = (
            Toy(settings=TRPOSettings(critic_weight_decay=weight_decay, critic_learning_rate=0.01))
            .learn(1)
            .parameters()
        )
        return {name: tensor for name, tensor in found.items() if "value" not in name and "policy/" in name}

    def critic(weight_decay: float) -> torch.Tensor:
        found = (
            Toy(settings=TRPOSettings(critic_weight_decay=weight_decay, critic_learning_rate=0.01))
            .learn(1)
            .parameters()
        )
        return found["policy/value_net.linear.weight"]

    assert same(actor(0.0), actor(5.0))
    assert not torch.equal(critic(0.0), critic(5.0))


def test_settings_reach_ppo() -> None:
    settings = PPOSettings(
        gamma=0.9, gae_lambda=0.5, clip_range=0.3, epochs=4, actor_learning_rate=0.01, critic_learning_rate=0.02
    )
    learner: Any = Toy(settings=settings, agent="ppo").learn(1).learner.sb3
    assert (learner.rollout_buffer.gamma, learner.rollout_buffer.gae_lambda) == (0.9, 0.5)
    assert learner.clip_range(1.0) == 0.3
    assert [group["lr"] for group in learner.policy.optimizer.param_groups] == [0.01, 0.02]


@pytest.mark.parametrize(("minibatches", "steps_per_epoch"), [(1, 1), (3, 3)])
def test_each_epoch_of_ppo_has_the_set_number_of_minibatches(minibatches: int, steps_per_epoch: int) -> None:
    settings = PPOSettings(epochs=5, minibatches=minibatches)
    parameters = Toy(settings=settings, agent="ppo", episodes=3).learn(2).parameters()
    steps = {int(tensor) for name, tensor in parameters.items() if name.endswith("/step")}
    assert steps == {2 * 5 * steps_per_epoch}


def test_actor_and_critic_of_ppo_learn_at_separate_rates() -> None:
    def largest_changes(actor_rate: float, critic_rate: float) -> dict[bool, float]:
        settings = PPOSettings(epochs=5, actor_learning_rate=actor_rate, critic_learning_rate=critic_rate)
        task = Toy(settings=settings, agent="ppo")
        before = task.parameters()
        after = task.learn(2).parameters()
        found = {True: 0.0, False: 0.0}
        for name, tensor in before.items():
            if name.startswith("policy/") and "scale" not in name:
                critic = "value" in name
                found[critic] = max(found[critic], float((after[name] - tensor).abs().max()))
        return found

    assert largest_changes(1e-12, 1e-2)[False] < 1e-8 < 1e-3 < largest_changes(1e-12, 1e-2)[True]
    assert largest_changes(1e-2, 1e-12)[True] < 1e-8 < 1e-3 < largest_changes(1e-2, 1e-12)[False]
