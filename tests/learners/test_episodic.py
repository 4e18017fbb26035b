import numpy as np
import pytest
import torch

from tests.learners.task import DECISIONS, INPUTS, Task, same
from unjam.errors import UnjamError
from unjam.learners.algorithms import LEARNERS
from unjam.learners.episodic import seed_iteration
from unjam.learners.settings import PolicySettings

torch.set_num_threads(1)  # more would fight for the cores over matrices of this size

every_learner = pytest.mark.parametrize("agent", LEARNERS)


@every_learner
def test_the_same_seed_gives_the_same_parameters_to_the_last_bit(agent: str) -> None:
    one, other = (Task(agent=agent).learn(3) for _ in range(2))
    assert same(one.parameters(), other.parameters())
    assert [entry.log for entry in one.iterations] == [entry.log for entry in other.iterations]
    assert not same(one.parameters(), Task(agent=agent, seed=1).learn(3).parameters())


@every_learner
def test_what_others_draw_in_between_changes_nothing(agent: str) -> None:
    task, disturbed = Task(agent=agent), Task(agent=agent)
    for iterations in (1, 2, 3):
        task.learn(iterations)
        torch.rand(7)
        np.random.rand(7)
        disturbed.learn(iterations)
    assert same(task.parameters(), disturbed.parameters())


@every_learner
@pytest.mark.parametrize("hold", [1, 5])
def test_counts_decisions_and_not_looks(agent: str, hold: int) -> None:
    task = Task(agent=agent, hold=hold, episodes=3)
    task.learner.run(2 * 3 * DECISIONS)
    assert [entry.actual_steps for entry in task.iterations] == [300, 600]
    assert [entry.number for entry in task.iterations] == [1, 2]


@every_learner
def test_ends_with_the_first_iteration_that_reaches_the_budget(agent: str) -> None:
    task = Task(agent=agent, episodes=3)
    task.learner.run(301)
    assert task.learner.num_timesteps == 600
    task.learner.run(600)
    assert len(task.iterations) == 2
    task.learner.run(601)
    assert task.learner.num_timesteps == 900


@every_learner
def test_each_iteration_is_driven_by_what_the_one_before_learned(agent: str) -> None:
    task = Task(agent=agent).learn(2)
    rows = np.random.default_rng(0).uniform(size=(5, INPUTS))
    found = [network(rows) for network in (*task.networks, task.learner.network())]
    assert (found[0] == 0.0).all()
    assert not np.array_equal(found[1], found[0])
    assert not np.array_equal(found[2], found[1])


@every_learner
def test_an_iteration_tells_what_progress_needs(agent: str) -> None:
    (iteration,) = Task(agent=agent).learn(1).iterations
    assert iteration.log
    assert all(type(value) is float and np.isfinite(value) for value in iteration.log.values())
    assert set(iteration.seconds) == {"actual", "update"}
    assert min(iteration.seconds.values()) > 0.0
    assert iteration.virtual_steps == 0
    assert len(iteration.episodes) == 8


@every_learner
@pytest.mark.parametrize("sees_road", [True, False])
def test_only_the_critic_sees_the_road_that_was_drawn(agent: str, sees_road: bool) -> None:
    policy = PolicySettings(hidden=(8,), critic_sees_road=sees_road)
    task = Task(policy, agent=agent, episodes=2)
    learner = task.learner
    learner.collect_rollouts()
    rows = next(learner.updates()).rows
    assert rows.observations.shape == (2 * DECISIONS, INPUTS + sees_road)
    if sees_road:
        assert set(rows.observations[:, INPUTS]) == {-1.0, 1.0}
    assert task.learner.observation_space.shape == (INPUTS + sees_road,)
    assert task.learner.network().inputs == INPUTS


def test_each_iteration_of_each_run_draws_its_own_numbers() -> None:
    drawn = {}
    for run, iteration in [(0, 1), (0, 2), (1, 1), (1, 2)]:
        seed_iteration(run, iteration)
        drawn[run, iteration] = (float(torch.rand(1)), float(np.random.rand()))
        seed_iteration(run, iteration)
        assert (float(torch.rand(1)), float(np.random.rand())) == drawn[run, iteration]
    assert len(set(drawn.values())) == 4


@every_learner
@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
def test_a_reward_that_is_not_finite_is_named_before_anything_is_learned(agent: str) -> None:
    task = Task(agent=agent, target=lambda observations: np.full(len(observations), 1e200))
    before = task.parameters()
    with pytest.raises(UnjamError, match="learner: rewards of iteration 1 are not finite"):
        task.learn(1)
    assert same(task.parameters(), before)
    assert task.iterations == []


@every_learner
def test_a_parameter_that_is_not_finite_is_named_in_the_same_iteration(agent: str) -> None:
    task = Task(agent=agent)
    critic = (p for name, p in task.learner.policy.named_parameters() if "value" in name or "critic" in name)
    with torch.no_grad():
        next(critic)[0] = torch.nan
    with pytest.raises(UnjamError, match=r"learner: \S+ is not finite in iteration 1") as caught:
        task.learn(1)
    assert "\n" not in str(caught.value)
    assert task.iterations == []
