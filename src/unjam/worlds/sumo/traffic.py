"""The actual environment, step by step: what its roads have in common."""

from collections.abc import Callable, Collection, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.command import Command, accelerations
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import Ahead, Cars
from unjam.drivers.sensors import Readings
from unjam.errors import EpisodeError
from unjam.physics.arrays import Array
from unjam.physics.idm import IDMParameters
from unjam.scenarios.road import OpenRoad, Road
from unjam.scenarios.scenario import Scenario
from unjam.worlds.record import Episode, Floats
from unjam.worlds.sumo.files import files_of
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.world import OnProgress, World

ODOMETER_TOLERANCE = 1e-6
"""by how much positions may differ from SUMO's odometer at the end [m]"""
ROUNDED = 1e-10
"""the same as a share of what was driven: sums of many steps are rounded"""
WARMUP_PROGRESS_STEPS = 10
LEAVE_TO_SUMO = -1.0
"""the commanded speed that stands for none"""


class Seed(NamedTuple):
    """Where all that is random in an episode comes from."""

    entropy: tuple[int, ...]
    children: Sequence[np.random.SeedSequence]
    """of noise, exploration, SUMO and sensors"""


class Scene(NamedTuple):
    """One moment of a road, as pictures show it; n vehicles."""

    lines: Floats
    """the road's lines: rows (x, y) [m]; a row of NaN between two lines"""
    places: Floats
    """rows (x, y, heading) of the front bumpers: [m], and [rad] against the x axis, shape (n, 3)"""
    speeds: Floats
    """[m/s], shape (n,)"""
    cavs: NDArray[np.bool_]
    """which of them are CAVs, shape (n,)"""


RoadKind = TypeVar("RoadKind", bound=Road)
OpenKind = TypeVar("OpenKind", bound=OpenRoad)


class Traffic(World[Episode], Generic[RoadKind]):
    """The world of a road in SUMO: what roads with and without ends have in common."""

    single = False
    asked: Collection[str] = ()
    """fields of a `LocalState` that the driver looks at: what only costs time otherwise is not measured"""
    cavs: Sequence[str]
    """the CAVs on the road now, in order of entry: the rows of what drivers are given and answer"""
    speeds: Sequence[float] | Floats
    """of all vehicles on the road now [m/s]"""
    kept: Sequence[int] | None = None  # pyright: ignore[reportIncompatibleMethodOverride]

    def __init__(
        self, scenario: Scenario, road: RoadKind, seed: Seed, simulation: Simulation, full: bool
    ) -> None:
        """Put the vehicles on the road; nothing moves yet."""
        self.seed = seed.entropy
        noise_seed, exploration_seed, sumo_seed, sensor_seed = seed.children
        self.scenario = scenario
        self.limits = scenario.limits
        self.road = road
        self.crashed = False
        self.stop_at_contact = True
        """whether contact of a CAV ends an episode on a user's network; on built-in roads it always does"""
        self.over = False
        """whether nobody is on the road any more, nor will be"""
        self.stopped = ""
        """why SUMO's own rules end the episode early; empty: they do not"""
        self.decisions = 0
        """made since the log began"""
        self.entered = 0
        self.full = full
        """whether fuel and, on roads with ends, places are recorded"""
        self._controlled = False
        braking, step = scenario.safety.leader_braking, scenario.simulation_step
        self._readings = (
            None if scenario.sensors.exact else Readings(scenario.sensors, braking, step, sensor_seed)
        )
        self._cars = Cars(scenario.safety, scenario.actuator, step)
        self._perceived: tuple[int, LocalState] | None = None
        self._noise_generator = np.random.default_rng(noise_seed)
        self._exploration_generator = np.random.default_rng(exploration_seed)
        self._lasting: Floats | None = None
        self._simulation = simulation
        sumo = int(sumo_seed.generate_state(1)[0]) % 2**31
        simulation.load(files_of(scenario, road), scenario.simulation_step, sumo)

    def _warm_up(self, simulate: Callable[[], None], on_progress: OnProgress | None) -> None:
        """Let people drive alone; raise `EpisodeError` where they collide."""
        for step in range(self.scenario.warmup):
            simulate()
            if self.crashed or self.stopped:
                why = self.stopped or "collision"
                raise EpisodeError(f"{why} in step {step} of the all-human warm-up")
            if on_progress is not None and step % WARMUP_PROGRESS_STEPS == 0:
                on_progress(0)

    @property
    def rows(self) -> int:
        """How many CAVs are on the road now."""
        return len(self.cavs)

    @property
    def waiting(self) -> int:
        """How many want to enter now and cannot."""
        return 0

    @property
    def expects_cavs(self) -> bool:
        """Whether a CAV may still enter."""
        return False

    @property
    def ended(self) -> bool:
        """Whether the horizon is reached, the road stays empty, or something ended the episode early."""
        return self.crashed or self.over or bool(self.stopped) or self.decisions >= self.scenario.horizon

    def perceive(self) -> LocalState:
        """Return what the CAVs perceive now: arrays of shape (CAVs,), or plain numbers of a single one."""
        if self._readings is None:
            return self.exact_state()
        if self._perceived is None or self._perceived[0] != self.decisions:
            self._perceived = self.decisions, self._readings.of_driver(self.cavs, self.exact_state())
        return self._perceived[1]

    def exact_state(self) -> LocalState:
        """Return what exact sensors of the CAVs would read now."""
        raise NotImplementedError

    def _carry_out(self, name: str, wanted: float, ahead: Ahead) -> tuple[float, float]:
        """Return what a CAV is told of the acceleration that is wanted, and what it does [m/s2]."""
        known = ahead if self._readings is None else self._readings.of_filter(name, ahead)
        return self._cars.carry_out(name, wanted, known)

    def noise(self, lasting: int = 0) -> Array:
        """Return standard normal noise for one decision: an array (CAVs,), or a plain number.

        With `lasting`, so many for each CAV, alike for all and in all decisions; of a single one (lasting,).
        """
        if not lasting:
            return self._exploration_generator.standard_normal(len(self.cavs))
        if self._lasting is None:
            self._lasting = self._exploration_generator.standard_normal(lasting)
        return self._lasting if self.single else np.tile(self._lasting, (len(self.cavs), 1))

    def last_applied(self) -> Floats:
        """Return what the CAVs were told in the last decision, once it was filtered [m/s2], shape (CAVs,)."""
        raise NotImplementedError

    def scene(self) -> Scene:
        """Return this moment as pictures show it."""
        raise NotImplementedError

    def _told(self, command: Command | None) -> list[float]:
        """Return what the CAVs are told, within the limits [m/s2]; raise `InputError` where it cannot be."""
        return accelerations(command, self.limits, self.cavs, self.decisions)

    def _drivers_of(self, names: Sequence[str]) -> list[IDMParameters]:
        """Return how the human driver of each vehicle drives."""
        return [self.road.people.get(name, self.scenario.humans) for name in names]

    def _check_odometer(self, names: Sequence[str], starts: Floats, positions: Floats) -> None:
        """Raise `EpisodeError` where `starts` and what SUMO says was driven are not the positions [m]."""
        error = np.abs(starts + np.array(self._simulation.distances(names)) - positions).max(initial=0.0)
        if error > max(ODOMETER_TOLERANCE, ROUNDED * positions.max(initial=0.0)):
            raise EpisodeError(f"positions differ from SUMO's odometer by {error:.2g} m")

    def _facts(self) -> dict[str, Any]:
        """Return what every record says; raise `LostError` where other code has changed the simulation."""
        self._simulation.check()
        return {
            "seed": self.seed,
            "status": "collision" if self.crashed else "teleports" if self.stopped else "completed",
            "reason": "" if self.crashed else self.stopped,
            "step": self.scenario.decision_step,
            "warmup": self.scenario.warmup,
            "drawn": self.road.drawn,
            "limit_speed": self.road.limit_speed,
        }
