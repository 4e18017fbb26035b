"""The actual environment, step by step: what `run_episode` and every other view of it go through."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.errors import InputError
from unjam.physics.arrays import Array
from unjam.scenarios.road import Road
from unjam.scenarios.scenario import Scenario
from unjam.worlds.sumo.simulation import Simulation

Floats = NDArray[np.float64]


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


@dataclass(frozen=True)
class Stay:
    """One stay of one CAV on the road; T decisions."""

    vehicle: str
    number: int
    """it was the so many-th CAV to enter, from 0"""
    start: int
    """decision of the episode at which it began"""
    rows: NDArray[np.intp]
    """its row among the CAVs at each moment, shape (T + 1,)"""
    states: LocalState
    """what it perceived, shape (T + 1,)"""
    applied: Floats
    """its commands within the action limit; of humans what they did [m/s2], shape (T,)"""
    shield: Floats
    """hardest braking that SUMO added to each command, zero if it let it pass [m/s2], shape (T,)"""


@dataclass(frozen=True)
class TrafficLog:
    """All that happened since the log began; T decisions, N vehicles."""

    vehicle_ids: tuple[str, ...]
    cav_ids: tuple[str, ...]
    speeds: Floats
    """[m/s], shape (N, T + 1); NaN where a vehicle is not on the road"""
    positions: Floats
    """front bumpers along the route [m], shape (N, T + 1)"""
    gaps: Floats
    """to the vehicle ahead [m], shape (N, T + 1)"""
    fuel: Floats
    """fuel rate after each decision [mg/s], shape (T, N); without rows where it was not recorded"""
    stays: list[Stay]
    pictured: dict[str, Any]
    """what else the record of the episode says of its road: entries of `Episode`"""


RoadKind = TypeVar("RoadKind", bound=Road)


class Traffic(Generic[RoadKind]):
    """Start, perceive, advance by one decision, and the log of all of it.

    What roads with and without ends have in common.
    """

    single = False
    """whether its only CAV perceives and is driven in plain numbers instead of arrays of one row"""

    def __init__(
        self,
        scenario: Scenario,
        road: RoadKind,
        seeds: Sequence[np.random.SeedSequence],
        simulation: Simulation,
        full: bool,
    ) -> None:
        """Put the vehicles on the road; nothing moves yet. `seeds` are of noise, exploration and SUMO."""
        noise_seed, exploration_seed, sumo_seed = seeds
        self.scenario = scenario
        self.road = road
        self.crashed = False
        self.over = False
        """whether nobody is on the road any more, nor will be"""
        self.collisions = 0
        """vehicles in contact with another"""
        self.decisions = 0
        """made since the log began"""
        self.entered = 0
        """CAVs that the driver was given so far"""
        self.full = full
        """whether fuel and, on roads with ends, places are recorded"""
        self.log_fuel: list[list[float]] = []
        self._controlled = False
        self._noise_generator = np.random.default_rng(noise_seed)
        self._exploration_generator = np.random.default_rng(exploration_seed)
        self._simulation = simulation
        sumo = int(sumo_seed.generate_state(1)[0]) % 2**31
        simulation.load(road, scenario.simulation_step, sumo)

    def start(self, controlled: bool, progress: Callable[[int], None] | None = None) -> LocalState | None:
        """Run the warm-up, then hand the CAVs over, unless they stay human (`controlled` false).

        `progress` is called now and then with 0: no decision is made yet.

        Returns:
            What the CAVs perceived in the last minute of the warm-up at the times of decisions, shape
            (CAVs, moments), oldest first; None without a warm-up, and on roads with ends.
        """
        raise NotImplementedError

    @property
    def cavs(self) -> Sequence[str]:
        """The CAVs on the road now: the rows of what drivers are given and answer."""
        raise NotImplementedError

    @property
    def expects_cavs(self) -> bool:
        """Whether a CAV may still enter."""
        return False

    @property
    def stayed(self) -> Sequence[int]:
        """Rows of the CAVs before the last decision that are on the road after it."""
        return range(len(self.cavs))

    @property
    def speeds(self) -> Sequence[float]:
        """Speeds of all vehicles on the road now [m/s]."""
        raise NotImplementedError

    def local_state(self) -> LocalState:
        """Return what the CAVs perceive now: arrays of shape (CAVs,), or plain numbers of a single one."""
        raise NotImplementedError

    def carry(self, memory: Memory, driver: Driver) -> Memory:
        """Return a driver's memory with a row for each CAV that is on the road now, newcomers at the end.

        Call it after each decision, before the driver is asked again.
        """
        return memory

    def advance(self, acceleration: Array | None) -> None:
        """Simulate one decision: `acceleration` [m/s2] of every CAV, held over its simulation steps.

        A float or an array of shape (CAVs,), clipped to the action limit; None: the CAVs stay human.

        Raises:
            InputError: an acceleration is not finite, or there are not as many as CAVs.
        """
        raise NotImplementedError

    def exploration_noise(self) -> Iterator[Array]:
        """Yield standard normal noise for one decision after the other: arrays (CAVs,), or floats."""
        while True:
            yield self._exploration_generator.standard_normal(len(self.cavs))

    def log(self) -> TrafficLog:
        """Return what happened since the start."""
        raise NotImplementedError

    def scene(self) -> Scene:
        """Return this moment as pictures show it."""
        raise NotImplementedError

    def _checked(self, acceleration: Any) -> list[float]:
        """Return a driver's answer as plain floats; raise `InputError` where it cannot be commanded."""
        try:
            if self.single:
                values, shape = [float(acceleration)], (1,)
            else:
                wanted = np.asarray(acceleration, np.float64)
                values, shape = wanted.tolist(), wanted.shape
        except (TypeError, ValueError):
            raise InputError(f"{self._where()}: acceleration is not numbers: {acceleration!r}") from None
        if shape != (len(self.cavs),):
            allowed = f"({len(self.cavs)},), one for each CAV"
            raise InputError(f"{self._where()}: acceleration has shape {shape}; allowed: {allowed}")
        for name, value in zip(self.cavs, values, strict=True):
            if not isfinite(value):
                raise InputError(f"{self._where()}: acceleration of {name} is {value}; allowed: finite")
        return values

    def _where(self) -> str:
        return f"driver: step {self.decisions}"
