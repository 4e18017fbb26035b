"""Threads of one process: their environments give the numbers of one thread."""

import copy
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from threading import Barrier
from typing import Any

import gymnasium
import numpy as np
import pytest

from unjam.drivers import PISaturation
from unjam.environments.gymnasium_env import RoadEnv
from unjam.scenarios import Ring
from unjam.worlds.episode import run_episode

SHORT: Any = {"warmup": 0, "horizon": 60}
ACTION = np.full(1, 0.3, np.float32)
THREADS = 3

pytestmark = pytest.mark.filterwarnings("ignore:another simulation is open")


def rewards_of(environment: RoadEnv, seed: int) -> list[float]:
    environment.reset(seed=seed)
    return [environment.step(ACTION)[1] for _ in range(SHORT["horizon"])]


@pytest.mark.long
def test_environments_in_threads_give_the_numbers_of_one_thread() -> None:
    together, stdout = Barrier(THREADS), sys.stdout

    def in_thread(seed: int) -> list[float]:
        with closing(RoadEnv(**SHORT)) as environment:
            together.wait()
            return rewards_of(environment, seed)

    with closing(RoadEnv(**SHORT)) as alone:
        expected = [rewards_of(alone, seed) for seed in range(THREADS)]
    with ThreadPoolExecutor(THREADS) as threads:
        assert list(threads.map(in_thread, range(THREADS))) == expected
    assert sys.stdout is stdout


@pytest.mark.long
def test_episodes_in_threads_are_those_of_one_thread() -> None:
    together, road = Barrier(THREADS), Ring(**SHORT)

    def in_thread(seed: int) -> Any:
        together.wait()
        return run_episode(road, PISaturation(), seed).speeds

    expected = [run_episode(road, PISaturation(), seed).speeds for seed in range(THREADS)]
    with ThreadPoolExecutor(THREADS) as threads:
        np.testing.assert_array_equal(list(threads.map(in_thread, range(THREADS))), expected)


def test_threads_that_call_one_environment_take_turns() -> None:
    """Each step is made once, whichever thread makes it: the rewards are those of one thread."""
    with closing(RoadEnv(**SHORT)) as environment:
        expected = rewards_of(environment, 0)
        environment.reset(seed=0)
        with ThreadPoolExecutor(THREADS) as threads:
            found = threads.map(lambda _: environment.step(ACTION)[1], expected)
        assert sorted(found) == sorted(expected)


def test_an_environment_can_be_copied_until_it_is_reset() -> None:
    with closing(RoadEnv(**SHORT)) as environment, closing(copy.deepcopy(environment)) as other:
        first = rewards_of(environment, 0)
        environment.close()
        assert rewards_of(other, 0) == first


def test_a_vector_of_environments_in_one_process_gives_the_numbers_of_each_alone() -> None:
    with closing(RoadEnv(**SHORT)) as alone:
        expected = [rewards_of(alone, seed)[:20] for seed in (1, 2)]
    environments = gymnasium.make_vec("unjam/Ring-v0", num_envs=2, vectorization_mode="sync", **SHORT)
    environments.reset(seed=[1, 2])  # pyright: ignore[reportArgumentType]
    found = [environments.step(np.tile(ACTION, (2, 1)))[1] for _ in range(20)]
    environments.close()
    np.testing.assert_array_equal(np.transpose(found), expected)
