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
"""states of the global generators before the first of the running blocks of `seeded_generators`, for each of them"""


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
    process, earlier episodes in it, or the clock. For the user's code the global generators are seeded meanwhile.

    Args:
        scenario: road, traffic and horizon: a `Scenario`, its class or its name, as in `unjam.make_scenario`.
        driver: of every CAV: a driver, an object with `act` and `initial_memory`, a class of them, or a function of the
            state.
        seed: an integer or several; all random numbers come from them.
        reward: a name, `path.py:name`, or a function of an `Outcome`; empty: the scenario's own.
        explore: factor of a residual driver's exploration noise: 1, -1 for the opposite sign, or 0.
        record_details: whether fuel and, on roads with ends, positions (x, y) are recorded (10 % slower).
        backend: the simulator: `sumo`, `batch`, `path.py:name`, or an object, which stays open for other episodes.
        on_progress: called now and then with the number of control steps made.
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
        driver = as_driver(driver, scenario.control_step)  # makes an object of a class
    check_can_drive(driver, scenario)
    reward_function = make_reward(reward or scenario.reward)
    needs = driver.requirements(scenario.interface)
    options = WorldOptions(needs.measured_fields, record_details, not needs.needs_arrays, stop_at_contact)
    with seeded_generators(seed), open_backend(backend) as simulator:
        check_support(simulator, scenario)
        with open_world(simulator, scenario, seed, options) as world:
            episode = drive_world(world, driver, explore, on_progress=on_progress)
        check_has_cavs(episode, driver)
        return add_reward_terms(episode, reward_function)


@contextmanager
def seeded_generators(seed: Sequence[int]) -> Iterator[None]:
    """Seed the global generators of Python, NumPy and torch (on the CPU) for code of the user.

    torch is seeded when the code imports it. The generators are restored when the last of several blocks ends; other
    threads must not draw from them meanwhile.
    """
    numbers, torch = np.random.SeedSequence(seed).generate_state(4), sys.modules.get("torch")
    torch_seeder = _TorchSeeder(int(numbers[0]))
    with _generators_lock:
        states = random.getstate(), np.random.get_state(), torch and torch.get_rng_state()
        _generator_states.append(_generator_states[0] if _generator_states else states)
        random.seed(numbers.tobytes())
        np.random.seed(numbers)
        if torch:
            torch.default_generator.manual_seed(int(numbers[0]))
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
    """Seeds torch's generator right after its first import."""

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
    """Return a seed's integers; raise `InputError` if one is negative or no integer."""
    numbers: Any = seed if isinstance(seed, Sequence | np.ndarray) else [seed]
    return tuple(check_integer("seed", number, 0) for number in numbers)


def check_can_drive(driver: Driver, scenario: Scenario, label: str = "driver: it") -> None:
    """Raise `InputError` if a scenario does not meet the requirements of a driver, which is called `label`."""
    _check_requirements(driver.requirements(scenario.interface), scenario, label)


def check_policy_inputs(features: Sequence[NetworkInput], scenario: Scenario, context: str) -> None:
    """Raise `InputError` if a scenario does not meet the requirements of a feature."""
    for name in features:
        _check_requirements(feature(name).requirements, scenario, f"{context}: {name!r}")


def _check_requirements(requirements: Requirements, scenario: Scenario, label: str) -> None:
    if reason := requirements.unmet_reason(scenario.interface):
        raise InputError(f"{label} is not allowed on {scenario.title}: {reason}")


def check_has_cavs(episode: Episode, driver: Driver) -> None:
    """Raise `NoCavError` if a driver had no CAV."""
    if not episode.cav_ids and not driver.is_driven_by_simulator:
        steps = format_count(episode.control_steps, "control step")
        raise NoCavError(f"no CAV was on the road in {steps}: make more vehicles CAVs")


def can_drive(driver: Driver, scenario: Scenario) -> bool:
    """Return whether a driver can drive a scenario, if its time step is right: some need a loop, or a ramp."""
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
