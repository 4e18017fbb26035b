"""The actual environment, step by step: what its roads have in common."""

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
from unjam.scenarios.scenario import Scenario
from unjam.worlds.record import Episode, Floats
from unjam.worlds.sumo.inputs import sumo_inputs
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.world import ProgressCallback, World

ODOMETER_TOLERANCE = 1e-6
"""by how much positions may differ from SUMO's odometer at the end [m]"""
ODOMETER_RELATIVE_TOLERANCE = 1e-10
"""the same as a share of what was driven: sums of many steps are rounded"""
WARMUP_PROGRESS_STEPS = 10
NO_SPEED_COMMAND = -1.0
"""the commanded speed that stands for none"""


class SeedTree(NamedTuple):
    """Where all that is random in an episode comes from."""

    entropy: tuple[int, ...]
    children: Sequence[np.random.SeedSequence]
    """of noise, exploration, SUMO and sensors"""


class RoadScene(NamedTuple):
    """One moment of a road, as pictures show it; n vehicles."""

    lane_lines: Floats
    """the road's lines: rows (x, y) [m]; a row of NaN between two lines"""
    poses: Floats
    """rows (x, y, heading) of the front bumpers: [m], and [rad] against the x axis, shape (n, 3)"""
    speeds: Floats
    """[m/s], shape (n,)"""
    is_cav: NDArray[np.bool_]
    """which of them are CAVs, shape (n,)"""


RoadT = TypeVar("RoadT", bound=Road)
OpenRoadT = TypeVar("OpenRoadT", bound=OpenRoad)


class Traffic(World[Episode], Generic[RoadT]):
    """The world of a road in SUMO: what roads with and without ends have in common."""

    is_scalar = False
    measured_fields: Collection[str] = ()
    """fields of a `LocalState` that the driver looks at: what only costs time otherwise is not measured"""
    cav_ids: Sequence[str]
    """the CAVs on the road now, in order of entry: the rows of what drivers are given and answer"""
    speeds: Sequence[float] | Floats
    """of all vehicles on the road now [m/s]"""
    remaining_rows: Sequence[int] | None = None  # pyright: ignore[reportIncompatibleMethodOverride]

    def __init__(
        self, scenario: Scenario, road: RoadT, seed: SeedTree, simulation: Simulation, record_details: bool
    ) -> None:
        """Put the vehicles on the road; nothing moves yet."""
        self.seed = seed.entropy
        noise_seed, exploration_seed, sumo_seed, sensor_seed = seed.children
        self.scenario = scenario
        self.limits = scenario.acceleration_limits
        self.road = road
        self.has_crashed = False
        self.stop_at_contact = True
        """whether contact of a CAV ends an episode on a user's network; on built-in roads it always does"""
        self.is_finished = False
        """whether nobody is on the road any more, nor will be"""
        self.stop_reason = ""
        """why SUMO's own rules end the episode early; empty: they do not"""
        self.control_steps = 0
        """made since the log began"""
        self.entered_count = 0
        self.record_details = record_details
        """whether fuel and, on roads with ends, places are recorded"""
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
        sumo = int(sumo_seed.generate_state(1)[0]) % 2**31
        simulation.load(sumo_inputs(scenario, road), scenario.simulation_step, sumo)

    def _warm_up(self, simulate: Callable[[], None], on_progress: ProgressCallback | None) -> None:
        """Let people drive alone; raise `EpisodeError` where they collide."""
        for step in range(self.scenario.warmup):
            simulate()
            if self.has_crashed or self.stop_reason:
                why = self.stop_reason or "collision"
                raise EpisodeError(f"{why} in step {step} of the all-human warm-up")
            if on_progress is not None and step % WARMUP_PROGRESS_STEPS == 0:
                on_progress(0)

    @property
    def cav_count(self) -> int:
        """How many CAVs are on the road now."""
        return len(self.cav_ids)

    @property
    def backlog(self) -> int:
        """How many want to enter now and cannot."""
        return 0

    @property
    def expects_cavs(self) -> bool:
        """Whether a CAV may still enter."""
        return False

    @property
    def has_ended(self) -> bool:
        """Whether the horizon is reached, the road stays empty, or something ended the episode early."""
        return (
            self.has_crashed
            or self.is_finished
            or bool(self.stop_reason)
            or self.control_steps >= self.scenario.horizon
        )

    def local_state(self) -> LocalState:
        """Return what the CAVs perceive now: arrays of shape (CAVs,), or plain numbers of a single one."""
        if self._sensor_readings is None:
            return self.exact_state()
        if self._sensed_state is None or self._sensed_state[0] != self.control_steps:
            self._sensed_state = (
                self.control_steps,
                self._sensor_readings.read_for_driver(self.cav_ids, self.exact_state()),
            )
        return self._sensed_state[1]

    def exact_state(self) -> LocalState:
        """Return what exact sensors of the CAVs would read now."""
        raise NotImplementedError

    def _apply_acceleration(self, name: str, acceleration: float, state: FollowingState) -> tuple[float, float]:
        """Return what a CAV is told of the acceleration that is wanted, and what it does [m/s2]."""
        known = state if self._sensor_readings is None else self._sensor_readings.read_for_filter(name, state)
        return self._cav_actuation.apply(name, acceleration, known)

    def noise(self, episode_noise_size: int = 0) -> Array:
        """Return standard normal noise for one decision: an array (CAVs,), or a plain number.

        With `episode_noise`, so many for each CAV, alike for all and in all decisions; of a single one (lasting,).
        """
        if not episode_noise_size:
            return self._exploration_generator.standard_normal(len(self.cav_ids))
        if self._episode_noise is None:
            self._episode_noise = self._exploration_generator.standard_normal(episode_noise_size)
        return self._episode_noise if self.is_scalar else np.tile(self._episode_noise, (len(self.cav_ids), 1))

    def last_applied_acceleration(self) -> Floats:
        """Return what the CAVs were told in the last decision, once it was filtered [m/s2], shape (CAVs,)."""
        raise NotImplementedError

    def scene(self) -> RoadScene:
        """Return this moment as pictures show it."""
        raise NotImplementedError

    def _limited_accelerations(self, command: Command | None) -> list[float]:
        """Return what the CAVs are told, within the limits [m/s2]; raise `InputError` where it cannot be."""
        return commanded_accelerations(command, self.limits, self.cav_ids, self.control_steps)

    def _human_parameters(self, names: Sequence[str]) -> list[IDMParameters]:
        """Return how the human driver of each vehicle drives."""
        return [self.road.human_parameters.get(name, self.scenario.humans) for name in names]

    def _check_odometer(self, names: Sequence[str], start_positions: Floats, positions: Floats) -> None:
        """Raise `EpisodeError` where `starts` and what SUMO says was driven are not the positions [m]."""
        error = np.abs(start_positions + np.array(self._simulation.distances(names)) - positions).max(initial=0.0)
        if error > max(ODOMETER_TOLERANCE, ODOMETER_RELATIVE_TOLERANCE * positions.max(initial=0.0)):
            raise EpisodeError(f"positions differ from SUMO's odometer by {error:.2g} m")

    def _common_fields(self) -> dict[str, Any]:
        """Return what every record says; raise `LostWorkerError` where other code has changed the simulation."""
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
