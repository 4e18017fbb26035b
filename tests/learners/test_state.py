import json

import numpy as np
import pytest
import torch
from safetensors.torch import load, save

from tests.learners.task import QUICK, Task, same
from unjam.learners.algorithms import LEARNERS
from unjam.learners.settings import LearnerSettings, PolicySettings, SACSettings
from unjam.learners.state import learner_state, restore_learner

torch.set_num_threads(1)  # more would fight for the cores over matrices of this size

every_learner = pytest.mark.parametrize("agent", LEARNERS)
WRAPPED = SACSettings(start_steps=0, updates_per_step=0.01, batch=16, buffer_rows=900, learn_temperature=True)
"""with a replay buffer that is full, and begins anew, in the third iteration of 400 rows"""


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
def test_a_restored_learner_goes_on_to_the_last_bit(
    agent: str, settings: LearnerSettings, learned: bool, before: int
) -> None:
    policy = PolicySettings(hidden=(8, 8), learn_exploration=learned)

    def new() -> Task:
        return Task(policy, settings, agent, hold=2)

    through = new().learn(4)
    counters, tensors = learner_state(new().learn(before).learner)
    # As a checkpoint does it, and in a process that has drawn other numbers since.
    counters, tensors = json.loads(json.dumps(counters)), load(save(tensors))
    torch.manual_seed(99)
    np.random.seed(99)
    resumed = new()
    restore_learner(resumed.learner, counters, tensors)
    resumed.learn(4)
    assert same(resumed.parameters(), through.parameters())
    assert learner_state(resumed.learner)[0] == learner_state(through.learner)[0]
    assert [entry.log for entry in resumed.iterations] == [entry.log for entry in through.iterations[before:]]
    assert [entry.number for entry in resumed.iterations] == [1, 2, 3, 4][before:]
    assert resumed.iterations[-1].actual_steps == 3200


@every_learner
def test_a_restored_learner_has_the_state_that_was_kept(agent: str) -> None:
    kept = learner_state(Task(agent=agent).learn(2).learner)
    other = Task(agent=agent, seed=5)
    assert not same(other.parameters(), kept[1])
    restore_learner(other.learner, *kept)
    counters, tensors = learner_state(other.learner)
    assert counters == kept[0]
    assert {"iteration": 2, "actual_steps": 1600}.items() <= counters.items()
    assert same(tensors, kept[1])


def test_the_state_holds_the_momenta_of_the_critic() -> None:
    _, tensors = learner_state(Task().learn(1).learner)
    momenta = [tensor for name, tensor in tensors.items() if name.endswith("/exp_avg")]
    assert len(momenta) == 4  # weight and bias of one hidden layer and of the head
    assert all(tensor.abs().max() > 0 for tensor in momenta)


@pytest.mark.parametrize("learned", [True, False])
def test_the_state_of_sac_holds_all_that_it_learns_from(learned: bool) -> None:
    settings = SACSettings(start_steps=0, updates_per_step=0.01, batch=16, learn_temperature=learned)
    _, tensors = learner_state(Task(settings=settings, agent="sac").learn(1).learner)
    parts = {name.partition("/")[0] for name in tensors}
    expected = {"policy", "actor.optimizer", "critic.optimizer", "replay"}
    assert parts == expected | ({"log_ent_coef", "ent_coef_optimizer"} if learned else set())
    assert any(name.startswith("policy/critic_target.") for name in tensors)
    assert len(tensors["replay/rewards"]) == 800  # and not the 200,000 that there is room for


def test_a_full_replay_buffer_is_kept_whole() -> None:
    _, tensors = learner_state(Task(settings=WRAPPED, agent="sac").learn(2).learner)
    assert len(tensors["replay/rewards"]) == 900


@every_learner
def test_a_kept_state_does_not_change_when_the_learner_goes_on(agent: str) -> None:
    task = Task(agent=agent).learn(1)
    _, tensors = learner_state(task.learner)
    before = {name: tensor.clone() for name, tensor in tensors.items()}
    task.learn(2)
    assert same(tensors, before)
    assert not same(task.parameters(), before)


@every_learner
def test_a_learner_that_goes_on_does_not_change_the_state_it_came_from(agent: str) -> None:
    counters, tensors = learner_state(Task(agent=agent).learn(1).learner)
    before = {name: tensor.clone() for name, tensor in tensors.items()}
    task = Task(agent=agent)
    restore_learner(task.learner, counters, tensors)
    task.learn(3)
    assert same(tensors, before)


@every_learner
def test_weights_of_another_network_are_refused(agent: str) -> None:
    counters, tensors = learner_state(Task(agent=agent).learn(1).learner)
    other = Task(PolicySettings(hidden=(4,)), agent=agent)
    with pytest.raises(RuntimeError, match="size mismatch"):
        restore_learner(other.learner, counters, tensors)
