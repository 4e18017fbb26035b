from typing import Any

import numpy as np
import pytest

from unjam.drivers import IDM, PISaturation, check_driver
from unjam.drivers.check import random_state
from unjam.studies.impaired import Impaired, impaired


@pytest.mark.parametrize("driver", ["idm", "pi"])
def test_it_keeps_the_contract_of_drivers(driver: str) -> None:
    check_driver(impaired(driver, 0.1, delay=0.3, gap_noise=0.5))


def test_unimpaired_it_is_the_driver_itself() -> None:
    generator = np.random.default_rng(0)
    mine, other = impaired("pi", 0.1), PISaturation()
    memory, theirs = mine.initial_memory(3), other.initial_memory(3)
    for _ in range(20):
        state = random_state(generator, 3)
        found, memory = mine.act(state, memory)
        expected, theirs = other.act(state, theirs)
        np.testing.assert_array_equal(found, expected)


def test_what_it_says_is_carried_out_later() -> None:
    generator = np.random.default_rng(0)
    late = impaired("idm", 0.1, delay=0.3)
    memory, said, done = late.initial_memory(2), [], []
    for _ in range(20):
        state = random_state(generator, 2)
        said.append(IDM().act(state, {})[0])
        found, memory = late.act(state, memory)
        done.append(found)
    np.testing.assert_array_equal(done[:3], np.zeros((3, 2)))
    np.testing.assert_array_equal(done[3:], said[:-3])


def test_it_sees_gaps_with_noise_of_its_own_for_each_vehicle_and_moment() -> None:
    seen: list[Any] = []

    class Eye:
        def act(self, state: Any, memory: Any) -> Any:
            seen.append((state.leader_gap, state.follower_gap))
            return state.speed * 0.0, memory

    blurred: Any = Impaired("idm", 0.0, 0.5, 0.1)
    memory = blurred.initial_memory(4)
    blurred._driver = Eye()
    state = random_state(np.random.default_rng(0), 4)
    state = state._replace(leader_gap=np.full(4, 20.0), follower_gap=np.full(4, 30.0), speed=np.arange(4.0))
    for _ in range(500):
        _, memory = blurred.act(state, memory)
    errors = np.array(seen) - np.array([20.0, 30.0])[:, None]
    assert errors.std() == pytest.approx(0.5, rel=0.05)
    assert abs(errors.mean()) < 0.05
    assert np.abs(np.corrcoef(errors.reshape(500, 8).T) - np.eye(8)).max() < 0.2
