"""Updates of the policy beyond a limit on its string gain are taken back."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.learners.test_algorithm_1 import every_learner
from tests.learners.toy_task import INPUTS, Toy, same
from unjam.drivers.network import Network
from unjam.errors import InputError
from unjam.learners.learner import MAX_HALVINGS, limit_update
from unjam.learners.settings import PolicySettings

OBSERVATIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (50, INPUTS))


def residual(network: Network) -> float:
    """Stands for the string gain: it is zero for the first policy, and grows in the toy task."""
    return 1.0 + float(np.abs(network(OBSERVATIONS)).mean())


def changed(agent: str) -> tuple[Toy, list[torch.Tensor]]:
    """Return a learner after an iteration, and its parameters before it."""
    toy = Toy(agent=agent)
    before = [each.detach().clone() for each in toy.learner.policy_parameters()]
    return toy.learn(1), before


@every_learner
def test_an_allowed_update_stays_as_it_is(agent: str) -> None:
    toy, before = changed(agent)
    after = toy.parameters()
    assert limit_update(toy.learner, before, lambda network: True) == 1.0
    assert same(toy.parameters(), after)


@every_learner
def test_an_update_is_halved_until_it_is_allowed(agent: str) -> None:
    toy, before = changed(agent)
    whole = residual(toy.learner.network())
    assert whole > 1.0
    limit = 1.0 + (whole - 1.0) / 3.0
    share = limit_update(toy.learner, before, lambda network: residual(network) <= limit)
    assert share in [0.5**halvings for halvings in range(1, MAX_HALVINGS + 1)]
    assert 1.0 < residual(toy.learner.network()) <= limit


@every_learner
def test_an_update_of_which_nothing_is_allowed_is_taken_back_exactly(agent: str) -> None:
    toy, before = changed(agent)
    assert limit_update(toy.learner, before, lambda network: False) == 0.0
    assert all(torch.equal(one, other) for one, other in zip(toy.learner.policy_parameters(), before, strict=True))


@every_learner
def test_a_policy_never_exceeds_its_limit_while_it_learns(agent: str) -> None:
    settings = PolicySettings(hidden=(16,), exploration_std=0.2)
    free = Toy(agent=agent, policy=settings).learn(6)
    limit = 1.0 + (residual(free.learner.network()) - 1.0) / 2.0
    limited = Toy(agent=agent, policy=replace(settings, max_string_gain=limit), string_gain=residual).learn(6)
    assert all(residual(network) <= limit for network in limited.networks)
    assert 1.0 < residual(limited.learner.network()) <= limit
    assert any(iteration.log["kept_update"] < 1.0 for iteration in limited.iterations)


def test_a_first_policy_beyond_the_limit_is_refused() -> None:
    policy = PolicySettings(hidden=(16,), max_string_gain=1.02)
    with pytest.raises(InputError, match=r"policy.max_string_gain: 1.02 is not allowed; allowed: at least 1.310, the"):
        Toy(policy=policy, string_gain=lambda network: 1.31)


def test_a_learner_of_which_no_update_can_be_taken_back_is_refused() -> None:
    toy = Toy(policy=PolicySettings(hidden=(16,), max_string_gain=1.02))
    toy.learner.policy_parameters = list
    with pytest.raises(InputError, match=r"policy.max_string_gain: TRPO has no policy_parameters\(\)"):
        type(toy.algorithm)(replace(toy.spec, string_gain=residual), toy.learner)
