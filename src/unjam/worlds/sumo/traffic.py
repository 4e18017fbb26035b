"""The common part of all SUMO environments."""

from collections.abc import Callable, Collection, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.command import Command, commanded_accelerations
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import CAVActuation, FollowingState
from unjam.drivers.sensors import SensorReadings
from unjam.errors import EpisodeError
from unjam.physics.arrays import Array
from unjam.physics.idm import IDMParameters
from unjam.scenarios.road import OpenRoad, Road
from unjam.scenarios.scenario import Scenario, sumo_seed
from unjam.worlds.record import Episode, Floats
from unjam.worlds.sumo.inputs import sumo_inputs
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.world import ProgressCallback, World

ODOMETER_TOLERANCE = 1e-6
"""allowed difference of positions from SUMO's odometer at the end [m]"""
ODOMETER_RELATIVE_TOLERANCE = 1e-10
"""the same relative to the distance driven: sums of many steps are rounded"""
WARMUP_PROGRESS_STEPS = 10
NO_SPEED_COMMAND = -1.0
"""speed command with which SUMO drives"""


class SeedTree(NamedTuple):
    """The source of all random numbers of an episode."""

    entropy: tuple[int, ...]
    children: Sequence[np.random.SeedSequence]
    """of noise, exploration, SUMO and sensors"""


class RoadScene(NamedTuple):
    """One moment of a road with n vehicles and their speeds [m/s], for pictures."""

    lane_lines: Floats
    """rows (x, y) [m]; a row of NaN between two lines"""
    poses: Floats
    """rows (x, y, heading) of the front bumpers: [m], and [rad] against the x axis, shape (n, 3)"""
    speeds: Floats
    is_cav: NDArray[np.bool_]


RoadT = TypeVar("RoadT", bound=Road)
OpenRoadT = TypeVar("OpenRoadT", bound=OpenRoad)


class Traffic(World[Episode], Generic[RoadT]):
    """The world of a road in SUMO."""

    is_scalar = False
    measured_fields: Collection[str] = ()
    """optional fields of `LocalState` that the driver uses; others are not measured, as that takes time"""
    cav_ids: Sequence[str]
    """the CAVs on the road now, in order of entry: the rows of states and commands"""
    speeds: Sequence[float] | Floats
    """of all vehicles on the road now [m/s]"""
    remaining_rows: Sequence[int] | None = None  # pyright: ignore[reportIncompatibleMethodOverride]

    def __init__(
        self, scenario: Scenario, road: RoadT, seed: SeedTree, simulation: Simulation, record_details: bool
    ) -> None:
        """Put the vehicles on the road; nothing moves yet."""
        self.seed = seed.entropy
        noise_seed, exploration_seed, _, sensor_seed = seed.children
        self.scenario, self.road = scenario, road
        self.limits = scenario.acceleration_limits
        self.has_crashed = False
        self.stop_at_contact = True
        """whether contact of a CAV ends an episode on a user's network; on built-in roads it always does"""
        self.is_finished = False
        self.stop_reason = ""
        """why SUMO's own rules end the episode early; empty: they do not"""
        self.control_steps = 0
        self.entered_count = 0
        self.record_details = record_details
        """whether fuel and, on roads with ends, positions (x, y) are recorded"""
        self._is_controlled = False
        braking, step = scenario.safety.leader_braking, scenario.simulation_step
        self._sensor_readings = (
            None if scenario.sensors.is_exact else SensorReadings(scenario.sensors, braking, step, sensor_seed)
        )
        self._cav_actuation = CAVActuation(scenario.safety, scenario.actuator, step)
        self._sensed_state: tuple[int, LocalState] | None = None
        self._noise_generator = np.random.default_rng(noise_seed)
        self._exploration_generator = np.random.default_rng(exploration_seed)
        self._episode_noise: Floats | None = None
        self._simulation = simulation
        simulation.load(sumo_inputs(scenario, road), step, sumo_seed(self.seed))

    def _warm_up(self, simulate: Callable[[], None], on_progress: ProgressCallback | None) -> None:
        """Simulate human-only traffic; raise `EpisodeError` if there is a collision."""
        for step in range(self.scenario.warmup):
            simulate()
            if self.has_crashed or self.stop_reason:
                reason = self.stop_reason or "collision"
                raise EpisodeError(f"{reason} in step {step} of the all-human warm-up")
            if on_progress is not None and step % WARMUP_PROGRESS_STEPS == 0:
                on_progress(0)

    @property
    def cav_count(self) -> int:
        """Number of CAVs on the road now."""
        return len(self.cav_ids)

    @property
    def backlog(self) -> int:
        """The insertion backlog now."""
        return 0

    @property
    def expects_cavs(self) -> bool:
        """Whether a CAV may still enter."""
        return False

    @property
    def has_ended(self) -> bool:
        """Whether the horizon is reached, the road stays empty, or the episode has ended early."""
        is_over = self.has_crashed or self.is_finished or bool(self.stop_reason)
        return is_over or self.control_steps >= self.scenario.horizon

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

    def _apply_acceleration(self, name: str, acceleration: float, state: FollowingState) -> tuple[float, float]:
        """Return the acceleration of a CAV after the safety filter, and its actual acceleration [m/s2]."""
        sensed = state if self._sensor_readings is None else self._sensor_readings.read_for_filter(name, state)
        return self._cav_actuation.apply(name, acceleration, sensed)

    def noise(self, episode_noise_size: int = 0) -> Array:
        """Return standard normal noise for one control step, as `World.noise`; of a scalar CAV shape (size,)."""
        if not episode_noise_size:
            return self._exploration_generator.standard_normal(len(self.cav_ids))
        if self._episode_noise is None:
            self._episode_noise = self._exploration_generator.standard_normal(episode_noise_size)
        return self._episode_noise if self.is_scalar else np.tile(self._episode_noise, (len(self.cav_ids), 1))

    def last_applied_acceleration(self) -> Floats:
        """Return the CAVs' accelerations in the last control step, after the safety filter [m/s2], shape (CAVs,)."""
        raise NotImplementedError

    def scene(self) -> RoadScene:
        """Return the current state of the road for pictures."""
        raise NotImplementedError

    def _limited_accelerations(self, command: Command | None) -> list[float]:
        """Return the CAVs' commands within the limits [m/s2]; raise `InputError` if one is invalid."""
        return commanded_accelerations(command, self.limits, self.cav_ids, self.control_steps)

    def _human_parameters(self, names: Sequence[str]) -> list[IDMParameters]:
        return [self.road.human_parameters.get(name, self.scenario.humans) for name in names]

    def _check_odometer(self, names: Sequence[str], start_positions: Floats, positions: Floats) -> None:
        """Raise `EpisodeError` if positions differ from the start plus SUMO's odometer [m]."""
        error = np.abs(start_positions + np.array(self._simulation.distances(names)) - positions).max(initial=0.0)
        if error > max(ODOMETER_TOLERANCE, ODOMETER_RELATIVE_TOLERANCE * positions.max(initial=0.0)):
            raise EpisodeError(f"positions differ from SUMO's odometer by {error:.2g} m")

    def _common_fields(self) -> dict[str, Any]:
        """Return the common fields of all records; raise `LostWorkerError` if other code changed the simulation."""
        self._simulation.check()
        return {
            "seed": self.seed,
            "status": "collision" if self.has_crashed else "teleports" if self.stop_reason else "completed",
            "reason": "" if self.has_crashed else self.stop_reason,
            "control_step": self.scenario.control_step,
            "warmup": self.scenario.warmup,
            "drawn_values": self.road.drawn_values,
            "limit_speed": self.road.limit_speed,
        }
