import json
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import load, save
from scipy.integrate import quad
from scipy.stats import norm
from torch.distributions import Normal

from tests.learners.toy_task import QUICK, Toy, same
from unjam.learners.learner import policy_distance
from unjam.learners.settings import AGENT_NAMES, LearnerSettings, PolicySettings, SACSettings

torch.set_num_threads(1)  # more threads are slower with small matrices

every_learner = pytest.mark.parametrize("agent", AGENT_NAMES)
WRAPPED = SACSettings(
    learning_starts=0, gradient_steps_per_step=0.01, batch_size=16, buffer_size=900, learn_temperature=True
)
"""with a replay buffer that is full, and overwrites its oldest rows, in the third iteration of 400 rows"""


@pytest.mark.parametrize(
    ("agent", "settings", "learned"),
    [
        *((agent, settings, True) for agent, settings in QUICK.items()),
        ("trpo", QUICK["trpo"], False),
        ("ppo", QUICK["ppo"], False),
        ("sac", WRAPPED, True),
    ],
)
@pytest.mark.parametrize("before", [1, 3])
def test_restored_learner_continues_bit_identically(
    agent: str, settings: LearnerSettings, learned: bool, before: int
) -> None:
    policy = PolicySettings(hidden=(8, 8), learn_exploration_std=learned)

    def new() -> Toy:
        return Toy(policy, settings, agent, action_repeat=2)

    uninterrupted = new().learn(4)
    values, tensors = new().learn(before).algorithm.state()
    # As a checkpoint does it, and in a process that has drawn other numbers since.
    state = json.loads(json.dumps(values)), load(save(tensors))
    torch.manual_seed(99)
    np.random.seed(99)
    resumed = new()
    resumed.resume(state, before)
    resumed.learn(4)
    assert same(resumed.parameters(), uninterrupted.parameters())
    assert resumed.algorithm.state()[0] == uninterrupted.algorithm.state()[0]
    assert [entry.log for entry in resumed.iterations] == [entry.log for entry in uninterrupted.iterations[before:]]
    assert [entry.number for entry in resumed.iterations] == [1, 2, 3, 4][before:]
    assert resumed.iterations[-1].environment_steps == 3200


@every_learner
def test_restored_learner_has_the_stored_state(agent: str) -> None:
    stored = Toy(agent=agent).learn(2).algorithm.state()
    other = Toy(agent=agent, seed=5)
    assert not same(other.parameters(), stored[1])
    other.algorithm.restore(*stored)
    values, tensors = other.algorithm.state()
    assert values == stored[0]
    assert same(tensors, stored[1])


def test_state_includes_the_momenta_of_the_critic() -> None:
    _, tensors = Toy().learn(1).algorithm.state()
    momenta = [tensor for name, tensor in tensors.items() if name.endswith("/exp_avg")]
    assert len(momenta) == 4  # weight and bias of one hidden layer and of the head
    assert all(tensor.abs().max() > 0 for tensor in momenta)


@pytest.mark.parametrize("learned", [True, False])
def test_state_of_sac_includes_all_that_it_learns_from(learned: bool) -> None:
    settings = SACSettings(learning_starts=0, gradient_steps_per_step=0.01, batch_size=16, learn_temperature=learned)
    _, tensors = Toy(settings=settings, agent="sac").learn(1).algorithm.state()
    parts = {name.partition("/")[0] for name in tensors}
    expected = {"policy", "actor.optimizer", "critic.optimizer", "replay"}
    assert parts == expected | ({"log_ent_coef", "ent_coef_optimizer"} if learned else set())
    assert any(name.startswith("policy/critic_target.") for name in tensors)
    assert len(tensors["replay/rewards"]) == 800  # and not the capacity of 200,000


def test_full_replay_buffer_is_stored_completely() -> None:
    _, tensors = Toy(settings=WRAPPED, agent="sac").learn(2).algorithm.state()
    assert len(tensors["replay/rewards"]) == 900


@every_learner
def test_stored_state_does_not_change_with_further_learning(agent: str) -> None:
    task = Toy(agent=agent).learn(1)
    _, tensors = task.algorithm.state()
    before = {name: tensor.clone() for name, tensor in tensors.items()}
    task.learn(2)
    assert same(tensors, before)
    assert not same(task.parameters(), before)


@every_learner
def test_restored_learner_does_not_change_its_source_state(agent: str) -> None:
    values, tensors = Toy(agent=agent).learn(1).algorithm.state()
    before = {name: tensor.clone() for name, tensor in tensors.items()}
    task = Toy(agent=agent)
    task.algorithm.restore(values, tensors)
    task.learn(3)
    assert same(tensors, before)


@every_learner
def test_weights_of_another_network_are_refused(agent: str) -> None:
    values, tensors = Toy(agent=agent).learn(1).algorithm.state()
    other = Toy(PolicySettings(hidden=(4,)), agent=agent)
    with pytest.raises(ValueError, match=r"has the shape .*, expected"):
        other.algorithm.restore(values, tensors)


@every_learner
def test_stored_tensors_of_another_shape_are_refused_before_anything_is_computed_with_them(agent: str) -> None:
    values, tensors = Toy(agent=agent).learn(1).algorithm.state()
    other = Toy(agent=agent)
    for name, tensor in tensors.items():
        changed = tensor.reshape(-1)[:1].reshape(1, 1, 1)
        with pytest.raises((ValueError, RuntimeError), match=f"shape|size|{name}"):
            other.algorithm.restore(values, {**tensors, name: changed})
    incomplete = {name: tensor for name, tensor in tensors.items() if not name.endswith("/exp_avg_sq")}
    with pytest.raises(ValueError, match="is no state of Adam"):
        other.algorithm.restore(values, incomplete)


means = st.floats(-3, 3)
stds = st.floats(0.05, 3)


def of(mean: float, std: float) -> Normal:
    return Normal(torch.tensor([mean]), torch.tensor([std]))


@pytest.mark.long
@given(means, stds, means, stds)
def test_policy_distance_is_half_the_integral_of_the_density_difference(m: float, s: float, n: float, t: float) -> None:
    def difference(x: float) -> float:
        return float(abs(norm.pdf(x, m, s) - norm.pdf(x, n, t)))

    low, high = min(m - 9 * s, n - 9 * t), max(m + 9 * s, n + 9 * t)
    points = np.unique(np.concatenate([[low, high], m + s * np.arange(-3, 4), n + t * np.arange(-3, 4)]))
    expected = 0.5 * sum(quad(difference, a, b)[0] for a, b in pairwise(points))
    assert abs(float(policy_distance(of(m, s), of(n, t))) - expected) < 1e-5


@given(means, stds)
def test_policy_distance_is_zero_for_equal_and_one_for_distant_policies(mean: float, std: float) -> None:
    assert float(policy_distance(of(mean, std), of(mean, std))) == 0.0
    assert float(policy_distance(of(mean, std), of(mean + 100 * std, std))) > 0.999


@given(means, stds, means, stds)
def test_policy_distance_is_symmetric(m: float, s: float, n: float, t: float) -> None:
    forward, backward = policy_distance(of(m, s), of(n, t)), policy_distance(of(n, t), of(m, s))
    torch.testing.assert_close(forward, backward, atol=1e-6, rtol=0)
