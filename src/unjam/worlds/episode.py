"""Episodes as a pure function: `run_episode(scenario, driver, seed) -> Episode`."""

import importlib.util
import random
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.abc import MetaPathFinder
from types import ModuleType
from typing import Any, SupportsIndex

import numpy as np

from unjam.drivers.driver import Driver
from unjam.drivers.observation import NetworkInput, feature
from unjam.drivers.requirements import Requirements
from unjam.drivers.user_driver import DriverLike, as_driver
from unjam.errors import InputError, NoCavError
from unjam.parameters import check_integer
from unjam.scenarios import ScenarioLike, make_scenario
from unjam.scenarios.scenario import Scenario
from unjam.text import format_count
from unjam.worlds.backend import BackendLike, WorldOptions, check_support, open_backend, open_world
from unjam.worlds.drive import drive_world
from unjam.worlds.record import Episode
from unjam.worlds.reward import Reward, RewardLike, episode_reward_terms, make_reward
from unjam.worlds.world import ProgressCallback

_generators_lock = threading.Lock()
_generator_states: list[tuple[Any, Any, Any]] = []
"""for each running block of `seeded_generators`, the states of the global generators before the first block"""


@dataclass(frozen=True)
class Task:
    """One scenario of a training; a training takes a list of tasks."""

    scenario: Scenario
    expert: Driver
    """the driver before training, to which the residual is added"""
    reward: str = ""
    weight: float = 1.0
    """share of the environment steps, relative to the weights of the other tasks"""
    name: str = ""
    """name in progress reports, tables and folders; empty for a single task"""

    def __post_init__(self) -> None:
        check_can_drive(self.expert, self.scenario)


def run_episode(
    scenario: ScenarioLike,
    driver: DriverLike,
    seed: SupportsIndex | Sequence[int],
    reward: RewardLike = "",
    explore: float = 0.0,
    record_details: bool = False,
    backend: BackendLike = "sumo",
    on_progress: ProgressCallback | None = None,
    stop_at_contact: bool = True,
) -> Episode:
    """Run one episode and return its record.

    The result depends only on scenario, driver, seed, reward, `explore`, backend and `stop_at_contact`, not on the
    process, its earlier episodes, or the clock. The global random generators are seeded for the user's code.

    Args:
        scenario: road, traffic and horizon: a `Scenario`, its class or its name, as in `unjam.make_scenario`.
        driver: drives each CAV: a driver, an object with `act` and `initial_memory`, the class of one, or a function
            of the state.
        seed: one integer or several, from which all random numbers come.
        reward: a name, `path.py:name`, or a function of an `Outcome`; empty: the scenario's own.
        explore: factor of the exploration noise of a residual driver: 1, -1 for the opposite sign, or 0.
        record_details: whether fuel and, on roads with ends, positions (x, y) are recorded (10 % slower).
        backend: the simulator: `sumo`, `batch`, `path.py:name`, or an object, which stays open for other episodes.
        on_progress: called regularly with the number of control steps so far.
        stop_at_contact: whether contact of a CAV ends an episode on a user's network, as in training. Otherwise the
            traffic goes on as in plain SUMO, and the contact is recorded.

    Raises:
        InputError: driver or reward return a value that is not finite, or of a wrong shape, or the backend does not
            support the scenario.
        SumoInputError: SUMO refuses files or options, at the start or later in the episode.
        EpisodeError: SUMO cannot run the scenario for another reason, or other code in this process has started,
            stepped or closed a simulation through libsumo meanwhile (`LostWorkerError`).
        UnjamError: another episode runs in the backend.
    """
    scenario, seed = make_scenario(scenario), as_seed(seed)
    with seeded_generators(seed):
        driver = as_driver(driver, scenario.control_step)  # may call a class of the user
    check_can_drive(driver, scenario)
    reward_function = make_reward(reward or scenario.reward)
    requirements = driver.requirements(scenario.interface)
    accepts_floats = not requirements.needs_arrays
    options = WorldOptions(requirements.measured_fields, record_details, accepts_floats, stop_at_contact)
    with seeded_generators(seed), open_backend(backend) as simulator:
        check_support(simulator, scenario)
        with open_world(simulator, scenario, seed, options) as world:
            episode = drive_world(world, driver, explore, on_progress=on_progress)
        check_has_cavs(episode, driver)
        return add_reward_terms(episode, reward_function)


@contextmanager
def seeded_generators(seed: Sequence[int]) -> Iterator[None]:
    """Seed the global generators of Python, NumPy and torch (on the CPU) for code of the user.

    torch is seeded at the latest when it is imported. The generators are restored when the last of several blocks
    ends; until then, other threads must not draw from them.
    """
    seed_words, torch = np.random.SeedSequence(seed).generate_state(4), sys.modules.get("torch")
    torch_seeder = _TorchSeeder(int(seed_words[0]))
    with _generators_lock:
        states = random.getstate(), np.random.get_state(), torch and torch.get_rng_state()
        _generator_states.append(_generator_states[0] if _generator_states else states)
        random.seed(seed_words.tobytes())
        np.random.seed(seed_words)
        if torch:
            torch.default_generator.manual_seed(int(seed_words[0]))
        else:
            sys.meta_path.insert(0, torch_seeder)
    try:
        yield
    finally:
        with _generators_lock:
            python_state, numpy_state, torch_state = _generator_states.pop()
            torch_seeder.remove()
            if not _generator_states:
                random.setstate(python_state)
                np.random.set_state(numpy_state)
                if torch and torch_state is not None:
                    torch.set_rng_state(torch_state)
                elif "torch" in sys.modules:  # imported in the block
                    sys.modules["torch"].seed()


class _TorchSeeder(MetaPathFinder):
    """An import hook that seeds the generator of torch right after the first import of torch."""

    def __init__(self, seed: int) -> None:
        self._seed = seed

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        if fullname != "torch":
            return None
        self.remove()
        specification = importlib.util.find_spec("torch")
        if specification is None or specification.loader is None:
            return specification
        execute = specification.loader.exec_module

        def execute_and_seed(module: ModuleType) -> None:
            execute(module)
            module.default_generator.manual_seed(self._seed)

        specification.loader.exec_module = execute_and_seed  # pyright: ignore[reportAttributeAccessIssue]
        return specification

    def remove(self) -> None:
        if self in sys.meta_path:
            sys.meta_path.remove(self)


def as_seed(seed: SupportsIndex | Sequence[int]) -> tuple[int, ...]:
    """Return a seed as a tuple of integers; raise `InputError` for negative numbers and other values."""
    values: Any = seed if isinstance(seed, Sequence | np.ndarray) else [seed]
    return tuple(check_integer("seed", value, 0) for value in values)


def check_can_drive(driver: Driver, scenario: Scenario, label: str = "driver: it") -> None:
    """Raise `InputError`, which starts with `label`, if a scenario does not meet the requirements of a driver."""
    _check_requirements(driver.requirements(scenario.interface), scenario, label)


def check_policy_inputs(features: Sequence[NetworkInput], scenario: Scenario, context: str) -> None:
    """Raise `InputError`, which starts with `context`, if a scenario does not meet the requirements of a feature."""
    for name in features:
        _check_requirements(feature(name).requirements, scenario, f"{context}: {name!r}")


def _check_requirements(requirements: Requirements, scenario: Scenario, label: str) -> None:
    if reason := requirements.unmet_reason(scenario.interface):
        raise InputError(f"{label} is not allowed on {scenario.title}: {reason}")


def check_has_cavs(episode: Episode, driver: Driver) -> None:
    """Raise `NoCavError` if a driver that must control CAVs had none in an episode."""
    if not episode.cav_ids and not driver.is_driven_by_simulator:
        steps = format_count(episode.control_steps, "control step")
        raise NoCavError(f"no CAV was on the road in {steps}: make more vehicles CAVs")


def can_drive(driver: Driver, scenario: Scenario) -> bool:
    """Return whether a scenario meets the requirements of a driver, such as a loop or a ramp, except time steps."""
    road = scenario.interface
    return not driver.requirements(road)._replace(time_steps=frozenset()).unmet_reason(road)


def add_reward_terms(episode: Episode, reward: Reward) -> Episode:
    """Return an episode with its reward terms; raise `InputError` if a term is not finite."""
    has_crashed = episode.status == "collision"
    terms = episode_reward_terms(reward, episode.speeds, episode.trajectories, has_crashed, episode.backlog)
    trajectories = tuple(
        replace(trajectory, reward_terms={name: values[trajectory.step_slice] for name, values in terms.items()})
        for trajectory in episode.trajectories
    )
    return replace(episode, reward_terms=terms, trajectories=trajectories)
