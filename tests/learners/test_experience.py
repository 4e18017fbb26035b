from dataclasses import fields

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer

from tests.learners.toy_task import make_policy, shake
from unjam.drivers import LocalState
from unjam.drivers.local_state import COMMON_FIELDS
from unjam.learners.experience import Experience, discounted_returns, join_experience, make_experience
from unjam.learners.sb3_learner import add_to_replay_buffer, fill_rollout_buffer, policy_spaces, shift_rewards
from unjam.learners.trpo_ppo import ResidualPolicy
from unjam.worlds.record import Trajectory

INPUTS = 3


def make_trajectory(seed: int, control_steps: int, action_repeat: int = 1, terminated: bool = False) -> Trajectory:
    """Return a trajectory of random numbers with repeated residuals."""
    generator = np.random.default_rng(seed)
    action_count = -(-control_steps // action_repeat)
    zeros = np.zeros(control_steps)
    return Trajectory(
        vehicle="cav_0",
        start_step=0,
        states=LocalState(*[np.zeros(control_steps + 1)] * len(COMMON_FIELDS)),
        observations=generator.normal(size=(action_count + 1, INPUTS)),
        expert_acceleration=zeros,
        residual=np.repeat(generator.normal(size=action_count), action_repeat)[:control_steps],
        applied_acceleration=zeros,
        filter_braking=zeros,
        shield_braking=zeros,
        reward_terms={"one": generator.normal(size=control_steps), "other": generator.uniform(size=control_steps)},
        initial_memory={},
        action_repeat=action_repeat,
        terminated=terminated,
    )


def random_policy(critic_inputs: int = 0, seed: int = 0) -> ResidualPolicy:
    policy = make_policy(ResidualPolicy, inputs=INPUTS, critic_inputs=critic_inputs)
    shake(policy, seed)
    policy.scale_value(3.0, 2.0)
    return policy


def fill(
    policy: ResidualPolicy,
    trajectories: list[Trajectory],
    extra: list[tuple[float, ...]] | None = None,
    gamma: float = 0.9,
    gae_lambda: float = 0.8,
) -> RolloutBuffer:
    spaces = policy.observation_space, policy.action_space
    buffer = RolloutBuffer(1, *spaces, device="cpu", gamma=gamma, gae_lambda=gae_lambda)
    fill_rollout_buffer(buffer, policy, make_experience(trajectories, extra or [()] * len(trajectories)))
    return buffer


def value(policy: ResidualPolicy, row: np.ndarray) -> float:
    with torch.no_grad():
        return float(policy.predict_values(torch.as_tensor(row[None], dtype=torch.float32)))


def action_rewards(trajectory: Trajectory) -> list[float]:
    """Return the rewards from one action of the network to the next."""
    rewards = [
        float(trajectory.reward_terms["one"][t] + trajectory.reward_terms["other"][t])
        for t in range(len(trajectory.residual))
    ]
    return [
        sum(rewards[start : start + trajectory.action_repeat])
        for start in range(0, len(rewards), trajectory.action_repeat)
    ]


def explicit_advantages(
    policy: ResidualPolicy, trajectory: Trajectory, gamma: float, gae_lambda: float
) -> tuple[list[float], list[float]]:
    """Return generalized advantage estimates and returns, from the definition: a sum over all later errors."""
    rewards = action_rewards(trajectory)
    values = [value(policy, row) for row in trajectory.observations]
    if trajectory.terminated:
        values[-1] = 0.0
    errors = [rewards[t] + gamma * values[t + 1] - values[t] for t in range(len(rewards))]
    advantages = [
        sum((gamma * gae_lambda) ** (later - t) * errors[later] for later in range(t, len(errors)))
        for t in range(len(errors))
    ]
    return advantages, [advantage + values[t] for t, advantage in enumerate(advantages)]


@settings(max_examples=40)
@given(
    shapes=st.lists(st.tuples(st.integers(1, 23), st.booleans()), min_size=1, max_size=4),
    action_repeat=st.integers(1, 5),
    gamma=st.floats(0.5, 0.999),
    gae_lambda=st.floats(0.0, 1.0),
)
def test_advantages_and_returns_are_computed_per_trajectory(
    shapes: list[tuple[int, bool]], action_repeat: int, gamma: float, gae_lambda: float
) -> None:
    policy = random_policy()
    trajectories = [
        make_trajectory(seed, control_steps, action_repeat, terminated)
        for seed, (control_steps, terminated) in enumerate(shapes)
    ]
    buffer = fill(policy, trajectories, gamma=gamma, gae_lambda=gae_lambda)
    expected = [explicit_advantages(policy, entry, gamma, gae_lambda) for entry in trajectories]
    advantages = [number for found, _ in expected for number in found]
    returns = [number for _, found in expected for number in found]
    np.testing.assert_allclose(buffer.advantages[:, 0], advantages, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(buffer.returns[:, 0], returns, rtol=1e-4, atol=1e-4)


def test_only_truncated_trajectories_are_bootstrapped() -> None:
    policy = random_policy()
    truncated, ended = make_trajectory(0, 6), make_trajectory(0, 6, terminated=True)
    last = {
        name: fill(policy, [entry], gae_lambda=1.0).returns[-1, 0]
        for name, entry in {"cut": truncated, "ended": ended}.items()
    }
    bootstrap = 0.9 * value(policy, truncated.observations[-1])
    assert abs(bootstrap) > 0.5
    assert last["cut"] - last["ended"] == pytest.approx(bootstrap, rel=1e-5)
    assert last["ended"] == pytest.approx(action_rewards(ended)[-1], rel=1e-5)


def test_trajectories_do_not_influence_each_other() -> None:
    policy = random_policy()
    first, second = make_trajectory(0, 7), make_trajectory(1, 5)
    both = fill(policy, [first, second]).advantages[:, 0]
    np.testing.assert_allclose(both[:7], fill(policy, [first]).advantages[:, 0], atol=1e-5)
    np.testing.assert_allclose(both[7:], fill(policy, [second]).advantages[:, 0], atol=1e-5)


def test_episodes_start_where_trajectories_start() -> None:
    buffer = fill(random_policy(), [make_trajectory(0, 4), make_trajectory(1, 1), make_trajectory(2, 3)])
    assert buffer.episode_starts[:, 0].tolist() == [1, 0, 0, 0, 1, 1, 0, 0]


def test_rows_are_actions_in_order() -> None:
    first, second = make_trajectory(0, 7, action_repeat=3), make_trajectory(1, 4, action_repeat=3)
    buffer = fill(random_policy(), [first, second])
    observations = np.concatenate([first.observations[:3], second.observations[:2]])
    np.testing.assert_array_equal(buffer.observations[:, 0], observations.astype(np.float32))
    actions = [*first.residual[[0, 3, 6]], *second.residual[[0, 3]]]
    np.testing.assert_array_equal(buffer.actions[:, 0, 0], np.array(actions, np.float32))


def test_rewards_of_a_held_residual_are_summed() -> None:
    trajectory = make_trajectory(0, 8, action_repeat=3, terminated=True)
    buffer = fill(random_policy(), [trajectory])
    np.testing.assert_allclose(buffer.rewards[:, 0], action_rewards(trajectory), rtol=1e-6)
    assert len(buffer.rewards) == 3
    assert buffer.rewards.sum() == pytest.approx(trajectory.reward.sum(), rel=1e-6)


def test_critic_inputs_follow_their_trajectory() -> None:
    trajectories = [make_trajectory(0, 3), make_trajectory(1, 2)]
    buffer = fill(random_policy(critic_inputs=1), trajectories, [(-1.0,), (0.5,)])
    assert buffer.observations[:, 0, INPUTS].tolist() == [-1.0, -1.0, -1.0, 0.5, 0.5]


def test_bootstrap_value_uses_the_critic_inputs_of_the_trajectory() -> None:
    policy = random_policy(critic_inputs=1)
    trajectory = make_trajectory(0, 5)
    buffer = fill(policy, [trajectory], [(0.7,)], gae_lambda=1.0)
    expected = action_rewards(trajectory)[-1] + 0.9 * value(policy, np.append(trajectory.observations[-1], 0.7))
    assert buffer.returns[-1, 0] == pytest.approx(expected, rel=1e-5)


def test_joined_experience_has_the_rows_of_all_parts() -> None:
    trajectories = [make_trajectory(seed, 3 + seed, action_repeat=2, terminated=seed == 1) for seed in range(4)]
    extra = [(float(seed),) for seed in range(4)]
    parts = [make_experience(trajectories[:1], extra[:1]), make_experience(trajectories[1:], extra[1:])]
    joined, expected = join_experience(parts), make_experience(trajectories, extra)
    for field in fields(Experience):
        np.testing.assert_array_equal(getattr(joined, field.name), getattr(expected, field.name))
        assert getattr(joined, field.name).dtype == getattr(expected, field.name).dtype


def test_next_observations_stay_within_their_trajectory() -> None:
    trajectories = [make_trajectory(0, 5, action_repeat=2), make_trajectory(1, 1), make_trajectory(2, 3)]
    rows = make_experience(trajectories, [()] * 3)
    expected = np.concatenate([trajectory.observations[1:] for trajectory in trajectories])
    np.testing.assert_array_equal(rows.next_observations, expected.astype(np.float32))
    assert rows.last_rows.tolist() == [2, 3, 6]


def test_number_of_critic_inputs_must_match_trajectories() -> None:
    with pytest.raises(ValueError, match="shorter"):
        fill(random_policy(critic_inputs=1), [make_trajectory(0, 3), make_trajectory(1, 3)], [(0.0,)])


def test_the_ratio_before_the_first_update_is_exactly_one() -> None:
    policy = random_policy()
    buffer = fill(policy, [make_trajectory(seed, 997, action_repeat=3) for seed in range(3)])
    observations, actions, before = (
        torch.as_tensor(rows[:, 0]) for rows in (buffer.observations, buffer.actions, buffer.log_probs)
    )
    with torch.no_grad():
        _, log_probs, _ = policy.evaluate_actions(observations, actions)
    assert len(log_probs) == 3 * 333
    assert (torch.exp(log_probs - before) == 1.0).all()


def test_the_ratio_is_one_in_the_shuffled_order_of_the_update() -> None:
    policy = random_policy()
    buffer = fill(policy, [make_trajectory(seed, 997, action_repeat=3) for seed in range(3)])
    (rows,) = buffer.get(batch_size=None)
    with torch.no_grad():
        _, log_probs, _ = policy.evaluate_actions(rows.observations, rows.actions)
    # Rows at the edge of a block of the matrix product may differ in their last bit.
    np.testing.assert_allclose(torch.exp(log_probs - rows.old_log_prob).numpy(), 1.0, rtol=0, atol=1e-6)
    assert not torch.equal(rows.old_log_prob, torch.as_tensor(buffer.log_probs[:, 0]))


def test_rollout_buffer_is_resized_for_each_iteration() -> None:
    policy = random_policy()
    buffer = fill(policy, [make_trajectory(0, 50)])
    fill_rollout_buffer(buffer, policy, make_experience([make_trajectory(1, 20)], [()]))
    assert len(buffer.rewards) == 20
    assert sum(len(rows.returns) for rows in buffer.get(7)) == 20
    np.testing.assert_array_equal(
        fill(policy, [make_trajectory(1, 20)]).advantages, buffer.swap_and_flatten(buffer.advantages)
    )


@given(
    shapes=st.lists(st.tuples(st.integers(1, 12), st.booleans()), min_size=1, max_size=3),
    action_repeat=st.integers(1, 4),
    gamma=st.floats(0.1, 0.99),
)
def test_discounted_returns_equal_explicit_sums(
    shapes: list[tuple[int, bool]], action_repeat: int, gamma: float
) -> None:
    trajectories = [
        make_trajectory(seed, control_steps, action_repeat, terminated)
        for seed, (control_steps, terminated) in enumerate(shapes)
    ]
    expected = []
    for trajectory in trajectories:
        rewards = action_rewards(trajectory)
        later_return = 0.0 if trajectory.terminated else sum(rewards) / len(rewards) / (1.0 - gamma)
        for t in range(len(rewards)):
            earlier = sum(gamma ** (later - t) * rewards[later] for later in range(t, len(rewards)))
            expected.append(earlier + gamma ** (len(rewards) - t) * later_return)
    np.testing.assert_allclose(
        discounted_returns(make_experience(trajectories, [()] * len(trajectories)), gamma),
        expected,
        rtol=1e-9,
        atol=1e-9,
    )


def test_truncated_trajectory_with_constant_reward_has_constant_returns() -> None:
    trajectory = make_trajectory(0, 30)
    trajectory.reward_terms["one"][:], trajectory.reward_terms["other"][:] = 1.5, 0.5
    np.testing.assert_allclose(discounted_returns(make_experience([trajectory], [()]), 0.95), 2.0 / 0.05)


def replay_buffer(size: int) -> ReplayBuffer:
    spaces = policy_spaces(INPUTS, 1, 2.0)
    return ReplayBuffer(size, *spaces, device="cpu", handle_timeout_termination=False)


def test_replay_buffer_equals_that_of_sb3_row_by_row() -> None:
    buffer, sb3_buffer = replay_buffer(20), replay_buffer(20)
    for iteration in range(4):
        trajectories = [
            make_trajectory(10 * iteration + seed, 7 + seed, action_repeat=2, terminated=seed == 1) for seed in range(2)
        ]
        extra = [(0.5,), (-0.5,)]
        rows = make_experience(trajectories, extra)
        add_to_replay_buffer(buffer, rows, 2.0, rows.rewards)
        for trajectory, more in zip(trajectories, extra, strict=True):
            observations = [np.append(row, more).astype(np.float32) for row in trajectory.observations]
            residuals, rewards = trajectory.actions_and_rewards
            for action_index, (residual, reward) in enumerate(zip(residuals, rewards, strict=True)):
                done = trajectory.terminated and action_index == len(rewards) - 1
                action = np.array([np.float32(residual) / np.float32(2.0)])
                sb3_buffer.add(
                    observations[action_index], observations[action_index + 1], action, reward, np.array(done), [{}]
                )
        assert (buffer.pos, buffer.full) == (sb3_buffer.pos, sb3_buffer.full)
        for name in ("observations", "next_observations", "actions", "rewards", "dones"):
            np.testing.assert_array_equal(getattr(buffer, name), getattr(sb3_buffer, name))
    assert buffer.full


def test_full_replay_buffer_has_the_newest_rows() -> None:
    buffer = replay_buffer(5)
    rows = make_experience([make_trajectory(0, 13)], [(0.0,)])
    add_to_replay_buffer(buffer, rows, 2.0, rows.rewards)
    assert sorted(buffer.rewards[:, 0]) == sorted(rows.rewards[-5:].astype(np.float32))


@given(
    shapes=st.lists(st.tuples(st.integers(1, 12), st.booleans()), min_size=1, max_size=3),
    gamma=st.floats(0.1, 0.99),
    offset=st.floats(-20.0, 20.0),
    later_return=st.floats(-50.0, 50.0),
)
def test_shifted_rewards_shift_all_values_equally(
    shapes: list[tuple[int, bool]], gamma: float, offset: float, later_return: float
) -> None:
    rows = make_experience(
        [make_trajectory(seed, size, 1, terminated) for seed, (size, terminated) in enumerate(shapes)],
        [()] * len(shapes),
    )

    def values_from(rewards: np.ndarray, bootstrap: float) -> np.ndarray:
        """Return the discounted rewards from each row on, with `bootstrap` after the end of a truncated trajectory."""
        found = np.empty(len(rewards))
        for first, last, terminated in zip(rows.starts, rows.last_rows, rows.terminated, strict=True):
            later = 0.0 if terminated else bootstrap
            for row in range(last, first - 1, -1):
                later = found[row] = rewards[row] + gamma * later
        return found

    missing = offset / (1.0 - gamma)
    shifted = values_from(shift_rewards(rows, offset, gamma), later_return - missing)
    np.testing.assert_allclose(shifted, values_from(rows.rewards, later_return) - missing, rtol=1e-9, atol=1e-6)
