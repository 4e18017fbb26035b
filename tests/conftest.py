"""What all tests share."""

import itertools
import os
import shutil
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from tests.pictures import empty_pictures
from unjam.drivers import LocalState
from unjam.drivers.network import Network
from unjam.drivers.user_driver import FileDriver
from unjam.files import sha256_of
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.simulation import Simulation

if "UNJAM_STATE" not in os.environ:  # which code the tests ran is not what the user ran
    os.environ["UNJAM_STATE"] = STATE = tempfile.mkdtemp(prefix="state-of-tests-")
else:
    STATE = ""

# What a shell starts in the background ignores interrupts, and so would all that a test starts to interrupt
signal.signal(signal.SIGINT, signal.default_int_handler)

# No timed tests, and the same each time. `make test-all` takes the thorough one.
settings.register_profile("unjam", deadline=None, derandomize=True, max_examples=10)
settings.register_profile("thorough", deadline=None, derandomize=True, max_examples=200)
settings.load_profile("unjam")


LONGEST_FOLDERS = ("system", "training", "paper", "reports", "worlds")


LONG_TESTS = {*(Path(__file__).parent / "long_tests.txt").read_text().splitlines()}
"""tests that took more than 1.2 s on two cores, by `pytest --durations=0`, without those of trust and of drift"""


@pytest.hookimpl(tryfirst=True)  # before tests are selected by their marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark long tests, and put the folders that take longest first, so that both processes end at about one time."""
    for item in items:
        if item.nodeid in LONG_TESTS:
            item.add_marker("long")
    ranks = {name: rank for rank, name in enumerate(LONGEST_FOLDERS)}
    tests = Path(__file__).parent
    items.sort(key=lambda item: ranks.get(item.path.relative_to(tests).parts[0], len(ranks)))


def pytest_unconfigure() -> None:
    if STATE:
        shutil.rmtree(STATE, ignore_errors=True)


@pytest.fixture
def simulation() -> Iterator[Simulation]:
    with Simulation() as opened:
        yield opened


@pytest.fixture
def sumo() -> Iterator[SumoBackend]:
    with SumoBackend() as opened:
        yield opened


@pytest.fixture
def without_pictures() -> Iterator[None]:
    """For a test in which reports need no pictures."""
    with empty_pictures():
        yield


@pytest.fixture
def my_drivers(tmp_path: Path) -> Path:
    """A user's file with drivers and rewards, good and bad."""
    path = tmp_path / "mine.py"
    path.write_text(
        """
import numpy as np

def gentle(state):
    return np.clip(0.2 * (state.leader_speed - state.speed) + 0.02 * (state.leader_gap - 8), -1, 0.3)

class Keeper:
    def __init__(self, gain=0.1, time_step=0.1):
        self.gain = gain
    def initial_memory(self, n):
        return {"last": np.zeros(n)}
    def act(self, state, memory):
        return self.gain * (state.leader_gap - 10) + 0.1 * memory["last"], {"last": state.speed}

def broken(state):
    return state.speed * np.nan

def short(state):
    return np.zeros(len(state.speed) + 1)

class NoMemory:
    def act(self, state, memory):
        return state.speed, memory

class Raises:
    def __init__(self):
        raise RuntimeError("no battery")

def raises(state):
    raise ValueError("lost the map")

def calm(outcome):
    return {"speed": np.nanmean(outcome.speeds, axis=-1), "push": -np.abs(outcome.accelerations).sum(-1)}

def wrong_reward(outcome):
    return {"speed": np.full(len(outcome.has_crashed), np.nan)}

not_callable = 3
"""
    )
    return path


def state_of(speed: object, leader_speed: object, gap: object) -> LocalState:
    """A local state in which only the leader matters."""
    own, leader, distance = (np.asarray(values, float) for values in (speed, leader_speed, gap))
    return LocalState(own, leader, distance, own, distance, own * 0.0, own * 0.0 + 230.0)


def random_network(inputs: int = 5, seed: int = 0, size: int = 16, scale: float = 0.3, outputs: int = 1) -> Network:
    """A network with random weights; with two outputs it sizes its own noise."""
    generator = np.random.default_rng(seed)
    sizes = [inputs, size, size, outputs]
    layers = tuple(
        (generator.normal(size=(rows, columns)) * scale, generator.normal(size=columns) * scale)
        for rows, columns in itertools.pairwise(sizes)
    )
    return Network(layers, authority=1.0, exploration_std=0.2)


def strangers_driver(code: Path, first: str) -> FileDriver:
    """The driver `gentle` of a file that does something `first`, as a stranger has it: none of it has run."""
    driver = FileDriver(code, "gentle")
    code.write_text(first + code.read_text())
    object.__setattr__(driver, "sha256", sha256_of(code.read_bytes()))
    return driver
