import json

import numpy as np
import pytest
import torch
from safetensors.torch import load, save

from unjam.agents.settings import PolicySettings
from unjam.agents.state import learner_state, restore_learner

from .task import Task, same


@pytest.mark.parametrize("learned", [True, False])
def test_a_restored_learner_goes_on_to_the_last_bit(learned: bool) -> None:
    policy = PolicySettings(hidden=(8, 8), learn_exploration=learned)
    through = Task(policy, hold=2).learn(4)
    counters, tensors = learner_state(Task(policy, hold=2).learn(2).learner)
    # As a checkpoint does it, and in a process that has drawn other numbers since.
    counters, tensors = json.loads(json.dumps(counters)), load(save(tensors))
    torch.manual_seed(99)
    np.random.seed(99)
    resumed = Task(policy, hold=2)
    restore_learner(resumed.learner, counters, tensors)
    resumed.learn(4)
    assert same(resumed.parameters(), through.parameters())
    assert learner_state(resumed.learner)[0] == learner_state(through.learner)[0]
    assert [entry.log for entry in resumed.iterations] == [entry.log for entry in through.iterations[2:]]
    assert [entry.actual_steps for entry in resumed.iterations] == [2400, 3200]


def test_a_restored_learner_has_the_state_that_was_kept() -> None:
    kept = learner_state(Task().learn(2).learner)
    other = Task(seed=5)
    assert not same(other.parameters(), kept[1])
    restore_learner(other.learner, *kept)
    counters, tensors = learner_state(other.learner)
    assert counters == kept[0] == {"iteration": 2, "actual_steps": 1600, "updates": 2}
    assert same(tensors, kept[1])


def test_the_state_holds_the_momenta_of_the_critic() -> None:
    _, tensors = learner_state(Task().learn(1).learner)
    momenta = [tensor for name, tensor in tensors.items() if name.endswith("/exp_avg")]
    assert len(momenta) == 4  # weight and bias of one hidden layer and of the head
    assert all(tensor.abs().max() > 0 for tensor in momenta)


def test_a_kept_state_does_not_change_when_the_learner_goes_on() -> None:
    task = Task().learn(1)
    _, tensors = learner_state(task.learner)
    before = {name: tensor.clone() for name, tensor in tensors.items()}
    task.learn(2)
    assert same(tensors, before)
    assert not same(task.parameters(), before)


def test_a_learner_that_goes_on_does_not_change_the_state_it_came_from() -> None:
    counters, tensors = learner_state(Task().learn(1).learner)
    before = {name: tensor.clone() for name, tensor in tensors.items()}
    task = Task()
    restore_learner(task.learner, counters, tensors)
    task.learn(3)
    assert same(tensors, before)


def test_weights_of_another_network_are_refused() -> None:
    counters, tensors = learner_state(Task().learn(1).learner)
    other = Task(PolicySettings(hidden=(4,)))
    with pytest.raises(RuntimeError, match="size mismatch"):
        restore_learner(other.learner, counters, tensors)
