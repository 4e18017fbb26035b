from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.learners.toy_task import (
    CONTROL_STEPS,
    INPUTS,
    Target,
    Toy,
    constant_target,
    mean_return,
    same,
    sloped_target,
)
from unjam.errors import UnjamError
from unjam.learners.algorithm import seed_iteration
from unjam.learners.experience import environment_experience, make_experience, return_after_exit
from unjam.learners.settings import (
    AGENT_NAMES,
    LearnerSettings,
    PolicySettings,
    PPOSettings,
    SACSettings,
    TD3Settings,
    TRPOSettings,
)

torch.set_num_threads(1)  # more threads are slower with small matrices

every_learner = pytest.mark.parametrize("agent", AGENT_NAMES)


@every_learner
def test_same_seed_gives_bit_identical_parameters(agent: str) -> None:
    one, other = (Toy(agent=agent).learn(3) for _ in range(2))
    assert same(one.parameters(), other.parameters())
    assert [entry.log for entry in one.iterations] == [entry.log for entry in other.iterations]
    assert not same(one.parameters(), Toy(agent=agent, seed=1).learn(3).parameters())


@every_learner
def test_other_random_numbers_do_not_change_training(agent: str) -> None:
    task, disturbed = Toy(agent=agent), Toy(agent=agent)
    for iterations in (1, 2, 3):
        task.learn(iterations)
        torch.rand(7)
        np.random.rand(7)
        disturbed.learn(iterations)
    assert same(task.parameters(), disturbed.parameters())


@every_learner
@pytest.mark.parametrize("action_repeat", [1, 5])
def test_environment_steps_count_control_steps_and_not_actions(agent: str, action_repeat: int) -> None:
    task = Toy(agent=agent, action_repeat=action_repeat, episodes=3)
    task.run(2 * 3 * CONTROL_STEPS)
    assert [entry.environment_steps for entry in task.iterations] == [300, 600]
    assert [entry.number for entry in task.iterations] == [1, 2]


@every_learner
def test_training_ends_with_the_iteration_that_reaches_the_budget(agent: str) -> None:
    task = Toy(agent=agent, episodes=3)
    task.run(301)
    assert task.collector.environment_steps == 600
    task.run(600)
    assert len(task.iterations) == 2
    task.run(601)
    assert task.collector.environment_steps == 900


@every_learner
def test_each_iteration_drives_the_newest_policy(agent: str) -> None:
    task = Toy(agent=agent).learn(2)
    rows = np.random.default_rng(0).uniform(size=(5, INPUTS))
    residuals = [network(rows) for network in (*task.networks, task.learner.network())]
    assert (residuals[0] == 0.0).all()
    assert not np.array_equal(residuals[1], residuals[0])
    assert not np.array_equal(residuals[2], residuals[1])


@every_learner
def test_iteration_has_the_values_of_progress(agent: str) -> None:
    (iteration,) = Toy(agent=agent).learn(1).iterations
    assert iteration.log
    assert all(type(value) is float and np.isfinite(value) for value in iteration.log.values())
    assert set(iteration.seconds) == {"update"}
    assert min(iteration.seconds.values()) > 0.0
    assert iteration.model_steps == 0
    assert len(iteration.episodes[0]) == 8


@every_learner
@pytest.mark.parametrize("is_privileged", [True, False])
def test_only_the_critic_gets_the_drawn_values(agent: str, is_privileged: bool) -> None:
    policy = PolicySettings(hidden=(8,), privileged_critic=is_privileged)
    task = Toy(policy, agent=agent, episodes=2)
    rows = environment_experience(task.spec, task.collect(task.learner.network(), 1), 1)
    assert rows.observations.shape == (2 * CONTROL_STEPS, INPUTS + is_privileged)
    if is_privileged:
        assert set(rows.observations[:, INPUTS]) == {-1.0, 1.0}
    assert task.learner.sb3.observation_space.shape == (INPUTS + is_privileged,)
    assert task.learner.network().input_size == INPUTS


def test_return_after_exit_is_discounted_by_action_to_the_last_one() -> None:
    reward = np.arange(1.0, 12.0)
    task = Toy(action_repeat=2)
    (episode,) = task.collect(task.learner.network(), 1)[0][:1]
    (stays,) = episode.trajectories
    leaves = replace(stays, residual=np.zeros(4), applied_acceleration=np.zeros(4), action_repeat=2)
    complete = replace(episode, speeds=np.zeros((12, 1)), reward_terms={"one": reward})
    expected = 0.9 * (5.0 + 6.0) + 0.9**2 * (7.0 + 8.0) + 0.9**3 * (9.0 + 10.0) + 0.9**4 * 11.0
    assert return_after_exit(complete, leaves, 0.9, 11) == pytest.approx(expected)
    assert return_after_exit(complete, replace(leaves, terminated=True), 0.9, 11) is None
    assert return_after_exit(replace(complete, speeds=np.zeros((5, 1))), leaves, 0.9, 4) is None
    assert return_after_exit(complete, leaves, 0.9, 12) is None  # truncated
    ended = (replace(complete, speeds=np.full((12, 1), np.nan)), replace(complete, status="collision"))
    assert [return_after_exit(each, leaves, 0.9, 12) for each in ended] == [pytest.approx(expected)] * 2
    without_return, with_return = make_experience([leaves], [()]), make_experience([leaves], [()], [expected])
    assert with_return.rewards[-1] - without_return.rewards[-1] == pytest.approx(expected)
    assert (without_return.terminated.tolist(), with_return.terminated.tolist()) == ([False], [True])


def test_each_iteration_of_each_run_has_its_own_random_numbers() -> None:
    numbers = {}
    for run, iteration in [(0, 1), (0, 2), (1, 1), (1, 2)]:
        seed_iteration(run, iteration)
        numbers[run, iteration] = (float(torch.rand(1)), float(np.random.rand()))
        seed_iteration(run, iteration)
        assert (float(torch.rand(1)), float(np.random.rand())) == numbers[run, iteration]
    for part in (0, 1):  # of several updates of an iteration
        seed_iteration(1, 2, part)
        numbers[2, part] = (float(torch.rand(1)), float(np.random.rand()))
    assert len(set(numbers.values())) == 6


@every_learner
@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
def test_non_finite_reward_is_named_before_the_update(agent: str) -> None:
    task = Toy(agent=agent, target=lambda observations: np.full(len(observations), 1e200))
    before = task.parameters()
    with pytest.raises(UnjamError, match="learner: rewards of iteration 1 are not finite"):
        task.learn(1)
    assert same(task.parameters(), before)
    assert task.iterations == []


@every_learner
def test_non_finite_parameter_is_named_in_the_same_iteration(agent: str) -> None:
    task = Toy(agent=agent)
    critic = (p for name, p in task.learner.sb3.policy.named_parameters() if "value" in name or "critic" in name)
    with torch.no_grad():
        next(critic)[0] = torch.nan
    with pytest.raises(UnjamError, match=r"learner: \S+ is not finite in iteration 1") as caught:
        task.learn(1)
    assert "\n" not in str(caught.value)
    assert task.iterations == []


@pytest.mark.parametrize("agent", ["trpo", "ppo"])
def test_vanished_exploration_raises_error(agent: str, monkeypatch: pytest.MonkeyPatch) -> None:
    task = Toy(agent=agent)
    log_std = dict(task.learner.sb3.policy.named_parameters())["log_std"]
    monkeypatch.setattr(task.learner, "learn", lambda update: log_std.data.fill_(-200.0))
    with pytest.raises(UnjamError, match="learner: the exploration noise is zero in iteration 1: a smaller step"):
        task.learn(1)


# Nothing in the task has late consequences, so a small discount is enough.
TO_LEARN: dict[str, LearnerSettings] = {
    "trpo": TRPOSettings(critic_epochs=3, gamma=0.8, gae_lambda=0.9),
    "ppo": PPOSettings(epochs=20, gamma=0.8, gae_lambda=0.9),
    "sac": SACSettings(
        gamma=0.5,
        learning_starts=1600,
        learning_rate=5e-3,
        tau=0.02,
        reward_scale=10.0,
        temperature=0.02,
        batch_size=64,
        gradient_steps_per_step=0.04,
    ),
    "td3": TD3Settings(
        gamma=0.5,
        learning_starts=1600,
        learning_rate=5e-3,
        tau=0.02,
        reward_scale=10.0,
        batch_size=64,
        gradient_steps_per_step=0.04,
    ),
}


@pytest.mark.long
@pytest.mark.parametrize(
    ("target", "action_repeat"), [(constant_target, 1), pytest.param(sloped_target, 5, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize(
    "agent", [pytest.param(name, marks=pytest.mark.slow) if name == "ppo" else name for name in AGENT_NAMES]
)
def test_learner_reaches_the_target(agent: str, target: Target, action_repeat: int) -> None:
    policy = PolicySettings(hidden=(16,), exploration_std=0.2)
    episodes = 8 if action_repeat == 1 else 20
    task = Toy(policy, TO_LEARN[agent], agent, target=target, action_repeat=action_repeat, episodes=episodes)
    task.learn(12 if agent in ("sac", "td3") else 30)
    observations = np.random.default_rng(9).uniform(-1.0, 1.0, size=(500, INPUTS))
    at_start = np.abs(task.networks[0](observations) - target(observations)).mean()
    at_end = np.abs(task.learner.network()(observations) - target(observations)).mean()
    assert at_end < 0.1 < at_start / 2
    assert mean_return(task.iterations[-1]) > mean_return(task.iterations[0]) / 2  # both are negative
