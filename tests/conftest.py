"""Settings, fixtures and helpers of all tests."""

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

if "UNJAM_STATE" not in os.environ:  # code that tests trust is not trusted for the user
    os.environ["UNJAM_STATE"] = STATE = tempfile.mkdtemp(prefix="state-of-tests-")
else:
    STATE = ""

# Programs that a shell starts in the background ignore interrupts, and so would processes that tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Tests of hypothesis have no deadline and the same examples each time; `make test-all` uses the profile `thorough`.
settings.register_profile("unjam", deadline=None, derandomize=True, max_examples=10)
settings.register_profile("thorough", deadline=None, derandomize=True, max_examples=200)
settings.load_profile("unjam")


LONGEST_FOLDERS = ("system", "training", "paper", "reports", "worlds")
"""folders whose tests take longest"""
LONG_TESTS = {*(Path(__file__).parent / "long_tests.txt").read_text().splitlines()}
"""tests that took more than 1.2 s on two cores, by `pytest --durations=0`, except tests of trust and of drift"""


@pytest.hookimpl(tryfirst=True)  # before tests are selected by their marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark long tests, and run the slowest folders first, so that both processes end at about the same time."""
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
    with Simulation() as running:
        yield running


@pytest.fixture
def sumo() -> Iterator[SumoBackend]:
    with SumoBackend() as backend:
        yield backend


@pytest.fixture
def without_pictures() -> Iterator[None]:
    """Leave the pictures of reports empty."""
    with empty_pictures():
        yield


@pytest.fixture
def my_drivers(tmp_path: Path) -> Path:
    """Return a file of a user with valid and invalid drivers and rewards."""
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
    """Return a local state in which only the leader matters."""
    speeds, leader_speeds, gaps = (np.asarray(values, float) for values in (speed, leader_speed, gap))
    return LocalState(speeds, leader_speeds, gaps, speeds, gaps, speeds * 0.0, speeds * 0.0 + 230.0)


def random_network(inputs: int = 5, seed: int = 0, size: int = 16, scale: float = 0.3, outputs: int = 1) -> Network:
    """Return a network with random weights; with two outputs, the second one is the size of its exploration noise."""
    generator = np.random.default_rng(seed)
    sizes = [inputs, size, size, outputs]
    layers = tuple(
        (generator.normal(size=(rows, columns)) * scale, generator.normal(size=columns) * scale)
        for rows, columns in itertools.pairwise(sizes)
    )
    return Network(layers, authority=1.0, exploration_std=0.2)


def unrun_driver(code: Path, prefix: str) -> FileDriver:
    """Return the driver `gentle` of a file, of which no code has run, after adding code at the begin of the file."""
    driver = FileDriver(code, "gentle")
    code.write_text(prefix + code.read_text())
    object.__setattr__(driver, "sha256", sha256_of(code.read_bytes()))
    return driver
