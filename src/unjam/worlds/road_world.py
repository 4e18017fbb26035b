"""The world of one road: its interface for inspection, and the common part of the worlds in a simulator."""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.command import Command, commanded_accelerations
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import CAVActuation, FollowingState
from unjam.drivers.sensors import SensorReadings
from unjam.errors import UnjamError
from unjam.physics.arrays import Array, Floats
from unjam.scenarios.road import Road
from unjam.scenarios.scenario import Scenario
from unjam.worlds.record import Episode, common_fields
from unjam.worlds.world import DriverLog, World

DrawnRoad = tuple[Road, Sequence[np.random.SeedSequence]]
"""value of `Scenario.draw_from_seed`"""


class RoadScene(NamedTuple):
    """A road with n vehicles at one moment, for pictures."""

    lane_lines: Floats
    """rows (x, y) [m]; rows of NaN separate lines"""
    poses: Floats
    """rows (x, y, heading) of the front bumpers [m, rad], shape (n, 3); heading 0 is the x axis"""
    speeds: Floats
    """speeds [m/s]"""
    is_cav: NDArray[np.bool_]


class RoadWorld(World[Episode], Protocol):
    """A `World` of one road that environments and pictures can inspect."""

    road: Road
    """the road that was drawn from the scenario"""
    cav_ids: Sequence[str]
    """ids of the CAVs on the road now, in order of entry, as the rows of states and commands"""
    speeds: Sequence[float] | Floats
    """speeds of all vehicles on the road [m/s]"""
    control_steps: int
    """number of control steps made"""
    has_crashed: bool
    """whether a collision ended the episode"""

    @property
    def backlog(self) -> int:
        """Current insertion backlog [vehicles]."""
        return 0

    @property
    def expects_cavs(self) -> bool:
        """Whether a CAV may still enter."""
        return False

    def exact_state(self) -> LocalState:
        """Return the current local state of the CAVs without sensor errors, arrays of shape (CAVs,)."""
        return self.local_state()

    def last_applied_acceleration(self) -> Array:
        """Return the CAVs' accelerations in the last control step, after the filter [m/s2]: (CAVs,), or a float."""
        ...

    def record_so_far(self) -> Episode:
        """Return the record so far, without the driver's decisions."""
        return self.record(DriverLog())

    def scene(self) -> RoadScene:
        """Return the current state of the road for pictures."""
        raise UnjamError("render: this backend draws no pictures; allowed: backend='sumo'")


class SimulatedRoad(RoadWorld):
    """The common part of worlds in a simulator: random numbers, sensors, safety filter, and end of the episode."""

    is_scalar = False
    remaining_rows: Sequence[int] | None = None  # pyright: ignore[reportIncompatibleMethodOverride]

    def __init__(self, scenario: Scenario, seed: Sequence[int], drawn_road: DrawnRoad | None = None) -> None:
        self.road, (noise_seed, exploration_seed, _, sensor_seed) = drawn_road or scenario.draw_from_seed(seed)
        self.scenario, self.seed, self.limits = scenario, tuple(seed), scenario.acceleration_limits
        self.has_crashed = False
        self.is_finished = False
        self.stop_reason = ""
        """reason of an early end by the rules of the simulator; empty if the episode goes on"""
        self.control_steps = self.entered_count = 0
        self.is_controlled = False
        braking, step = scenario.safety.leader_braking, scenario.simulation_step
        self._sensor_readings = (
            None if scenario.sensors.is_exact else SensorReadings(scenario.sensors, braking, step, sensor_seed)
        )
        self._cav_actuation = CAVActuation(scenario.safety, scenario.actuator, step)
        self._sensed_state: tuple[int, LocalState] | None = None
        self.noise_generator = np.random.default_rng(noise_seed)
        self._exploration_generator = np.random.default_rng(exploration_seed)
        self._episode_noise: Floats | None = None

    @property
    def cav_count(self) -> int:
        """Number of CAVs on the road."""
        return len(self.cav_ids)

    @property
    def has_ended(self) -> bool:
        """Whether the horizon is reached, no vehicle will enter the empty road, or the episode has ended early."""
        ends_early = self.has_crashed or self.is_finished or bool(self.stop_reason)
        return ends_early or self.control_steps >= self.scenario.horizon

    def local_state(self) -> LocalState:
        """Return the state that the CAVs observe now: arrays of shape (CAVs,), or floats of a single CAV."""
        if self._sensor_readings is None:
            return self.exact_state()
        if self._sensed_state is None or self._sensed_state[0] != self.control_steps:
            state = self._sensor_readings.read_for_driver(self.cav_ids, self.exact_state())
            self._sensed_state = self.control_steps, state
        return self._sensed_state[1]

    def exact_state(self) -> LocalState:
        """Return the exact local state of the CAVs now."""
        raise NotImplementedError

    def filtered_acceleration(self, name: str, acceleration: float, state: FollowingState) -> tuple[float, float]:
        """Return the acceleration of a CAV after the safety filter, and its actual acceleration [m/s2]."""
        sensed = state if self._sensor_readings is None else self._sensor_readings.read_for_filter(name, state)
        return self._cav_actuation.apply(name, acceleration, sensed)

    def noise(self, episode_noise_size: int = 0) -> Array:
        """Return standard normal noise for one control step as `World.noise`; shape (size,) if the CAV is scalar."""
        if not episode_noise_size:
            return self._exploration_generator.standard_normal(len(self.cav_ids))
        if self._episode_noise is None:
            self._episode_noise = self._exploration_generator.standard_normal(episode_noise_size)
        return self._episode_noise if self.is_scalar else np.tile(self._episode_noise, (len(self.cav_ids), 1))

    def limited_accelerations(self, command: Command | None) -> list[float]:
        """Return the CAVs' commands within the limits [m/s2]; raise `InputError` if one is invalid."""
        return commanded_accelerations(command, self.limits, self.cav_ids, self.control_steps)

    def record_fields(self) -> dict[str, Any]:
        """Return the common fields of all records."""
        return common_fields(self.scenario, self.road, self.seed, self.has_crashed, self.stop_reason)
