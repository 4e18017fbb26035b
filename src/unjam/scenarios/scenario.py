"""What a scenario is: where the vehicles drive, how an episode starts and when it ends."""

from collections.abc import Sequence
from dataclasses import field
from functools import cached_property
from math import inf
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator
from pydantic.dataclasses import dataclass

from unjam.drivers.command import Limits
from unjam.drivers.safety import Actuator, SafetyFilter
from unjam.drivers.sensors import Sensors
from unjam.parameters import STRICT, NonNegative, NonNegativeInt, Positive, PositiveInt
from unjam.physics.arrays import Array, clamp_max, clamp_min, namespace
from unjam.physics.idm import IDMArrays, IDMParameters, desired_speed_from_acceleration, idm_acceleration
from unjam.physics.kinematics import next_speed
from unjam.scenarios.population import Population, read_population
from unjam.scenarios.road import Road

UNLIMITED_ACCELERATION = 20.0
"""accelerations of an obedient CAV's type [m/s2]: far beyond what it asks for, so that only safety clips"""
VEHICLE_LENGTH = 5.0
"""[m], of every vehicle"""
SUMO_ACCELERATION = 2.6
"""of commanded people and of cars, SUMO's own [m/s2]"""
MIN_CAV_GAP = 0.5
"""gap that SUMO keeps for a CAV [m]"""
MIN_SET_SPEED = 0.1
"""set speed below which SUMO has none [m/s]"""
IDM_SUBSTEP = 0.25
"""about how long the steps are that SUMO's IDM makes within one of the simulation [s]"""

Actuation = Literal["shielded", "raw", "flow", "cruise"]
"""How SUMO carries out a CAV's command.

`shielded`: exactly, until it is unsafe; then SUMO brakes, and the override is counted.
`raw`: exactly, always; a collision ends the episode.
`flow`: as in Flow, the CAV is also bound by SUMO's human model and can never accelerate beyond it.
`cruise`: the CAV's own ACC follows and keeps its distance; commands can only hold it back. With lanes, where
SUMO makes room for who changes them, it is the one that works.
"""

HumanControl = Literal["native", "commanded"]
"""Who computes how people drive.

`native`: SUMO's own IDM with the scenario's parameters, to whose speeds noise is added.
`commanded`: the same IDM and noise as a speed command in every step, as Flow does it, over a quicker model
of SUMO's that keeps vehicles safe and obeys the right of way. SUMO's IDM with the paper's parameters alone is
far more timid where roads cross.
"""


@dataclass(frozen=True, config=STRICT)
class CruiseControl:
    """A CAV's own ACC, an IDM as SUMO has it, and how it changes lanes.

    What makes an ACC worse than people is weak acceleration, not a long headway. With 1 s it follows below
    0.8 s for moments.
    """

    time_gap: Positive = 1.1
    """[s]"""
    acceleration: Positive | None = 2.5
    """[m/s2]; None, on your own network: that of the vehicle which the CAV replaces"""
    deceleration: Positive | None = 2.0
    """comfortable [m/s2]; None likewise"""
    minimum_gap: Positive = 2.0
    """to who stands ahead [m]"""
    keep_right: NonNegative | None = None
    """how eagerly it keeps right; None: as the vehicle does by itself, 1 for most; 0: it does not"""
    speed_gain: NonNegative | None = None
    """how eagerly it changes lanes to be faster, likewise"""

    def set_speed(
        self,
        speed: Array,
        target_speed: Array,
        max_acceleration: float,
        step: float,
        vehicle_limits: tuple[Array, Array] | None = None,
    ) -> Array:
        """Return the set speed with which it accelerates as wanted where nobody is near [m/s].

        Infinite where it may drive as it likes: as hard as it can, or as anybody may ask.

        Args:
            speed: own [m/s], shape (n,).
            wanted: how fast it is to be after a step [m/s], shape (n,).
            highest: acceleration that anybody may ask for [m/s2].
            step: of the simulation [s].
            vehicle: acceleration and comfortable deceleration of each vehicle [m/s2], shape (n,), which the
                ACC has where it has none of its own.
        """
        xp, asked = namespace(speed), (target_speed - speed) / step
        own_most, own_braking = vehicle_limits or (0.0, 0.0)
        most: Array = self.acceleration or own_most
        braking: Array = self.deceleration or own_braking
        held = asked < clamp_max(most, max_acceleration) - 1e-6
        acc = IDMArrays(0.0, self.time_gap, most, braking, IDMParameters().exponent, self.minimum_gap)
        faster = desired_speed_from_acceleration(xp.where(held, asked, 0.0 * asked), speed, acc)
        rising = clamp_min(xp.maximum(target_speed, faster), MIN_SET_SPEED)
        # SUMO's IDM overshoots low set speeds within a step, brakes for it, and may stand for ever.
        parts = max(1, int(step / IDM_SUBSTEP + 0.5))
        reached, steady = speed, 2.0 * most * step / parts
        told = acc._replace(desired_speed=rising)
        for _ in range(parts):
            reached = next_speed(reached, idm_acceleration(reached, reached, inf, told), step / parts)
        rising = xp.where(reached <= speed, clamp_min(rising, steady), rising)
        found = clamp_min(xp.where(asked <= 0.0, target_speed, rising), MIN_SET_SPEED)
        return xp.where(held, found, 0.0 * found + inf)


def whole_milliseconds(step: float) -> float:
    """Return a step [s]; raise `ValueError` where it is none of SUMO's, which counts milliseconds."""
    if abs(1000.0 * step - round(1000.0 * step)) > 1e-9:
        raise ValueError("a whole number of milliseconds, as SUMO counts")
    return step


MAX_HORIZON = 10_000_000
"""decisions of the longest episode: twelve days in tenths of a second; more would fill the memory"""


@dataclass(frozen=True, config=STRICT)
class Scenario:
    """What all scenarios share; each kind of road adds its own."""

    title: ClassVar[str]
    reward: ClassVar[str]
    """reward used where none is named"""
    is_closed: ClassVar[bool] = True
    """whether the road is a loop"""
    has_coordinate: ClassVar[bool] = True
    """whether vehicles have a position along the road"""
    provided_fields: ClassVar[tuple[str, ...]] = ()
    """fields of a `LocalState` that CAVs are told here and not everywhere"""
    has_vehicle_types: ClassVar[bool] = False
    """whether vehicles have types of the user's, whose properties a CAV keeps"""
    sumo_human_gap: ClassVar[float] = 0.0
    """gap that SUMO keeps for commanded people [m]"""

    simulation_step: Annotated[Positive, AfterValidator(whole_milliseconds)] = 0.1
    """time step of SUMO [s]"""
    steps_per_control_step: PositiveInt = 1
    """simulation steps for which one command holds"""
    horizon: Annotated[PositiveInt, Field(le=MAX_HORIZON)] = 3000
    """decisions in an episode"""
    warmup: NonNegativeInt = 0
    """all-human simulation steps before the CAVs take over"""
    remember_warmup: bool = True
    """whether a driver may remember the warm-up, which it saw but did not drive"""
    action_limit: Positive = 1.0
    """largest acceleration that a CAV may ask for, in either direction [m/s2]"""
    actuation: Actuation = "shielded"
    """how SUMO carries out a CAV's command: `shielded` exactly until it is unsafe, then SUMO brakes; `raw`
    exactly; `flow` bound by the human IDM; `cruise` bound by the CAV's own ACC"""
    cruise: CruiseControl = field(default_factory=CruiseControl)
    """the CAV's own ACC, where it is what follows"""
    safety: SafetyFilter = field(default_factory=SafetyFilter)
    """the filter between driver and road, of every CAV, in every simulation step"""
    actuator: Actuator = field(default_factory=Actuator)
    """how late a CAV does what it is told"""
    sensors: Sensors = field(default_factory=Sensors)
    """how wrong what a CAV senses of its neighbours is"""
    enforce_human_limits: bool = True
    """whether commanded people keep to what brakes and engine can do, in an emergency too"""
    humans: IDMParameters = field(default_factory=IDMParameters)
    """how people drive"""
    population: str = ""
    """calibrated drivers, each of whom drives in its own way: a file of `unjam fit-drivers`, `unjam:ngsim` or
    `unjam:astazero`; empty: all drive as `humans` says"""
    human_control: HumanControl = "native"
    """who computes how people drive: `native` SUMO's own IDM; `commanded` the same IDM as a speed command in
    every step, as in Flow"""
    right_of_way: bool = True
    """whether vehicles obey the right of way where roads meet; if not, SUMO only keeps them from colliding"""
    impatience: Annotated[float, Field(ge=0, le=1)] = 0.0
    """how readily vehicles that must yield take a gap in crossing traffic (SUMO's `impatience`)"""
    noise: NonNegative = 0.2
    """standard deviation of the humans' acceleration noise [m/s2]"""
    noise_scaling: Literal["sqrt-step", "none"] = "sqrt-step"
    """`sqrt-step`: noise times sqrt(time step), as Flow; `none`: as the paper says"""
    emission_class: str = "HBEFA4/PC_petrol_Euro-6ab"
    """SUMO's emission class of every vehicle, for fuel"""

    @model_validator(mode="after")
    def _acc_has_limits(self) -> Self:
        for name in ("acceleration", "deceleration"):
            if not self.has_vehicle_types and getattr(self.cruise, name) is None:
                raise ValueError(f"cruise.{name}: None is not allowed on {self.title}; allowed: > 0")
        return self

    @model_validator(mode="after")
    def _filter_covers_sensor_errors(self) -> Self:
        for name in ("gap_error", "speed_error"):
            known, largest = getattr(self.safety, name), getattr(self.sensors, name)
            if self.safety.active and known < largest:
                raise ValueError(f"safety.{name}: {known:g} is not allowed; allowed: >= sensors.{name}, {largest:g}")
        return self

    @property
    def notes(self) -> list[str]:
        """What a user must know of this road beside the results."""
        return []

    @property
    def control_step(self) -> float:
        """Time between two decisions [s]."""
        return self.simulation_step * self.steps_per_control_step

    @property
    def noise_per_step(self) -> float:
        """Standard deviation of the acceleration noise in one simulation step [m/s2]."""
        scale = self.simulation_step**0.5 if self.noise_scaling == "sqrt-step" else 1.0
        return self.noise * scale

    @property
    def cav_max_braking(self) -> float:
        """How hard a CAV can brake at all [m/s2]: with a car's brakes where a filter keeps it safe."""
        return self.safety.braking if self.safety.active else UNLIMITED_ACCELERATION

    @property
    def max_duration(self) -> float:
        """How long an episode lasts at most, warm-up included [s]."""
        return self.simulation_step * (self.warmup + self.horizon * self.steps_per_control_step)

    @property
    def acceleration_limits(self) -> Limits:
        """Accelerations that a CAV may ask for."""
        return Limits.symmetric(self.action_limit)

    @cached_property
    def driver_population(self) -> Population | None:
        """The people of `population`, read once."""
        return read_population(self.population) if self.population else None

    @property
    def top_speed(self) -> float:
        """What the road allows: as fast as the fastest driver wants to be [m/s]."""
        population = self.driver_population
        return population.max_desired_speed if population else self.humans.desired_speed

    def check_native_humans(self, context: str) -> None:
        """Raise `ValueError` unless SUMO itself can drive these people, as it must `where` this is."""
        if self.driver_population and self.driver_population.residual is not None:
            raise ValueError(
                f"population: one with a residual network is not allowed {context}: SUMO's own IDM drives them there"
            )
        if self.human_control != "native":
            raise ValueError(f"human_control: 'commanded' is not allowed {context}; allowed: 'native'")

    def draw_humans(self, names: Sequence[str], generator: np.random.Generator) -> dict[str, IDMParameters]:
        """Return who drives which vehicle; nobody where all drive as `humans` says."""
        population = self.driver_population
        return dict(zip(names, population.draw(len(names), generator), strict=True)) if population else {}

    @property
    def population_description(self) -> str:
        """Who the people of `population` are."""
        drivers = self.driver_population.drivers if self.driver_population else ()
        return f"{len(drivers)} calibrated drivers of {self.population}"

    @property
    def human_description(self) -> str:
        """How people drive."""
        if self.driver_population:
            return self.population_description
        return f"IDM with acceleration noise of std {self.noise_per_step:.3f} m/s2 a step"

    def draw(self, generator: np.random.Generator) -> Road:
        """Return the road of one episode; everything random about it comes from `generator`."""
        raise NotImplementedError

    def scale_drawn_values(self, drawn_values: dict[str, float]) -> tuple[float, ...]:
        """Return what an episode has drawn, each number scaled to [-1, 1] over its range: for a critic."""
        return tuple(
            (drawn_values[name] - (low + high) / 2) / max((high - low) / 2, 1e-9)
            for name, (low, high) in self.drawn_ranges.items()
        )

    @property
    def drawn_ranges(self) -> dict[str, tuple[float, float]]:
        """What each episode draws anew that a critic could see, and from which range."""
        return {}

    def stratum(self, index: int, count: int) -> Self:
        """Return this scenario with what it draws narrowed to one of `count` equal parts of the range.

        Episodes of all parts cover the range evenly: with few episodes, whether a ring is long or short
        otherwise hides what the driver does.
        """
        return self

    def draw_from_seed(self, seed: Sequence[int]) -> tuple[Road, Sequence[np.random.SeedSequence]]:
        """Return the road of an episode's seed; and the seeds of noise, exploration, simulator, sensors."""
        road, *others = np.random.SeedSequence(list(seed)).spawn(5)
        return self.draw(np.random.default_rng(road)), others

    def possible_cav_ids(self) -> tuple[str, ...]:
        """Return the ids of all CAVs that an episode may have."""
        raise NotImplementedError

    def facts(self) -> list[tuple[str, str]]:
        """Return what a reader wants to know of this road, as (name, value) pairs."""
        raise NotImplementedError
