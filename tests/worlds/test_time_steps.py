"""A driver is refused wherever it meets a road with another control step than its formulas assume."""

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

import unjam
from tests.conftest import random_network
from unjam.controller import make_driver
from unjam.controller.certificate import certify_driver
from unjam.drivers.car_following import IDM, Constant
from unjam.drivers.driver import Driver
from unjam.drivers.local_state import LocalState
from unjam.drivers.pi_saturation import PISaturation
from unjam.drivers.registry import DRIVERS, driver_from_name
from unjam.drivers.residual import ResidualDriver
from unjam.drivers.safety import SafetyFilter
from unjam.drivers.user_driver import FileDriver, as_driver
from unjam.drivers.wrappers import (
    FilteredDriver,
    HistoryDriver,
    ImpairedDriver,
    MixedDriver,
    QueueFallback,
    RoadTypeSwitch,
)
from unjam.environments.gymnasium_env import RoadEnv
from unjam.errors import InputError
from unjam.physics.idm import IDMParameters
from unjam.scenarios import Merge, Ring, Scenario
from unjam.scenarios.motorway import ON_RAMP
from unjam.training.config import load_config
from unjam.training.run_folder import check_config
from unjam.worlds.batch.run import run_batch
from unjam.worlds.episode import Task, check_can_drive, run_episode
from unjam.worlds.worker_pool import EpisodeTask

OTHER_STEP = {"steps_per_control_step": 3, "length": (230, 230), "horizon": 10}
ROAD = Ring(steps_per_control_step=3, length=(230, 230), horizon=10)
TIMED = [name for name, kind in DRIVERS.items() if "time_step" in {field.name for field in fields(kind)}]  # pyright: ignore[reportArgumentType]
REFUSED = r"is not allowed on ring: its time_step is 0\.1 s; allowed: 0\.3 s, the control step"


class Mine:
    """A user's driver that stores its time step."""

    def __init__(self, time_step: float = 0.1) -> None:
        self.time_step = time_step

    def initial_memory(self, n: int) -> dict[str, object]:
        return {}

    def act(self, state: LocalState, memory: dict[str, object]) -> tuple[object, dict[str, object]]:
        return state.speed * self.time_step, memory


def wrapped(driver: Driver, step: float) -> dict[str, Driver]:
    """Return a driver for `step` in every driver that contains another."""
    return {
        "mixed": MixedDriver((IDM(), driver)),
        "impaired": ImpairedDriver(driver, time_step=step),
        "filtered": FilteredDriver(driver, 1.0, SafetyFilter(), step),
        "history": HistoryDriver(driver, step),
        "fallback": QueueFallback(IDM(), driver, step),
        "switch": RoadTypeSwitch(IDM(), IDM(), driver, IDM()),
        "residual": ResidualDriver(driver, random_network(), 1.0),
    }


OWN_STEP: dict[str, Callable[[float], Driver]] = {
    **{name: lambda step, name=name: driver_from_name(name, step) for name in TIMED},
    **{name: lambda step, name=name: wrapped(PISaturation(time_step=step), step)[name] for name in wrapped(IDM(), 0.1)},
    **{
        f"{name} alone": lambda step, name=name: wrapped(IDM(), step)[name]
        for name in ("impaired", "filtered", "history", "fallback")
    },
    "object": lambda step: as_driver(Mine(step)),
    "class": lambda step: as_driver(Mine, step),
}
"""every driver that has a time step, for a time step"""


@pytest.mark.parametrize("name", OWN_STEP)
def test_a_driver_with_another_time_step_is_refused(name: str) -> None:
    with pytest.raises(InputError, match=REFUSED):
        check_can_drive(OWN_STEP[name](0.1), ROAD)
    check_can_drive(OWN_STEP[name](0.3), ROAD)
    check_can_drive(OWN_STEP[name](0.1), Ring())


@pytest.mark.parametrize("stores_it", [True, False])
def test_the_class_of_a_file_is_refused_with_another_time_step(tmp_path: Path, stores_it: bool) -> None:
    attribute = "time_step" if stores_it else "duration"
    code = f"class D:\n    def __init__(self, time_step=0.1): self.{attribute} = time_step\n"
    code += "    def initial_memory(self, n): return {}\n"
    code += "    def act(self, state, memory): return 0 * state.speed, memory\n"
    (tmp_path / "own.py").write_text(f"{code}def plain(state): return 0 * state.speed\n")
    with pytest.raises(InputError, match=REFUSED):
        check_can_drive(FileDriver(tmp_path / "own.py", "D"), ROAD)
    check_can_drive(FileDriver(tmp_path / "own.py", "D", time_step=0.3), ROAD)
    check_can_drive(FileDriver(tmp_path / "own.py", "plain"), ROAD)


MEETINGS: dict[str, Callable[[], object]] = {
    "run_episode": lambda: run_episode(ROAD, PISaturation(), 0),
    "run_batch": lambda: run_batch([EpisodeTask(ROAD, PISaturation(), (0,))]),
    "drive": lambda: unjam.drive("ring", PISaturation(), episodes=1, scenario_options=OTHER_STEP),
    "environment": lambda: RoadEnv("ring", **OTHER_STEP, expert=PISaturation()),
    "task": lambda: Task(ROAD, PISaturation()),
    "expert": lambda: check_config(load_config(changes={"expert": "unjam:ring-tuned", "scenario_options": OTHER_STEP})),
    "baseline": lambda: check_config(
        load_config(changes={"evaluation.baselines": ["unjam:ring-tuned"], "scenario_options": OTHER_STEP})
    ),
}


@pytest.mark.parametrize("name", MEETINGS)
def test_it_is_refused_wherever_a_driver_meets_a_road(name: str) -> None:
    with pytest.raises(InputError, match=REFUSED):
        MEETINGS[name]()


def test_certification_refuses_a_controller_with_another_time_step_than_its_filter() -> None:
    driver = FilteredDriver(PISaturation(), 1.0, SafetyFilter(), 0.3)
    states = LocalState(*([10.0],) * 7).map(np.array)
    with pytest.raises(InputError, match=r"certify: .* its time_step is 0\.1 s; allowed: 0\.3 s"):
        certify_driver(driver, states, IDMParameters())


@pytest.mark.parametrize("scenario", [Merge(), ON_RAMP, Ring()])
def test_only_drivers_that_a_road_selects_need_its_control_step(scenario: Scenario) -> None:
    switch = make_driver("unjam:best", scenario.control_step)
    check_can_drive(switch, scenario)
    with pytest.raises(InputError, match="allowed: 1 s"):
        check_can_drive(switch, Ring(steps_per_control_step=10))
    motorway = RoadTypeSwitch(PISaturation(time_step=1.0), Constant(), Constant(), PISaturation(time_step=0.3))
    check_can_drive(motorway, ON_RAMP)
    with pytest.raises(InputError, match=r"not allowed on merge: its time_step is 0\.3 s; allowed: 1 s"):
        check_can_drive(motorway, Merge())
