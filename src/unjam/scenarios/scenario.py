"""The base class of all scenarios: settings of traffic, of CAVs, and of the start and the end of an episode."""

import sys
from collections.abc import Sequence
from dataclasses import field, fields
from functools import cached_property
from math import inf
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from unjam.drivers.command import Limits
from unjam.drivers.requirements import RoadInterface
from unjam.drivers.safety import Actuator, SafetyFilter
from unjam.drivers.sensors import Sensors
from unjam.drivers.user_driver import UserFunction
from unjam.parameters import (
    STRICT,
    NonNegative,
    NonNegativeInt,
    Positive,
    PositiveInt,
    Subclassable,
    check_part,
    is_packaged,
    parameter_dataclass,
)
from unjam.physics.arrays import Array, clamp_max, clamp_min, namespace
from unjam.physics.idm import IDMArrays, IDMParameters, desired_speed_from_acceleration, idm_acceleration
from unjam.physics.kinematics import next_speed
from unjam.scenarios.population import Population, population_file, read_population
from unjam.scenarios.road import Road
from unjam.scenarios.road_checks import check_repeated_road, check_road
from unjam.text import format_count

UNLIMITED_ACCELERATION = 20.0
"""acceleration limit of a CAV's vehicle type in SUMO [m/s2], above all commands: only safety checks limit them"""
VEHICLE_LENGTH = 5.0
"""default length of vehicles [m]"""
SUMO_ACCELERATION = 2.6
"""acceleration limit of commanded human drivers and of cars [m/s2], SUMO's default"""
MIN_CAV_GAP = 0.5
"""gap that SUMO keeps for a CAV [m]"""
MIN_SET_SPEED = 0.1
"""lowest set speed that SUMO accepts [m/s]"""
IDM_SUBSTEP = 0.25
"""approximate length of the steps into which SUMO's IDM divides a simulation step [s]"""
MAX_HORIZON = 10_000_000
"""control steps of the longest episode, twelve days of 0.1 s; a longer one would fill the memory"""
MAX_EPISODE_STEPS = 10 * MAX_HORIZON
"""simulation steps of the longest episode"""
MAX_EPISODE_VEHICLES, MAX_EPISODE_DISTANCE = 1_000_000, 1_000_000_000
"""maximum number of vehicles that want to enter in an episode, and maximum distance at top speed [m]"""

Actuation = Literal["shielded", "raw", "flow", "cruise"]
HumanControl = Literal["native", "commanded"]


@parameter_dataclass(frozen=True, config=STRICT)
class CruiseControl(Subclassable):
    """A CAV's own ACC, which is SUMO's IDM, and the CAV's motivation to change lanes.

    An ACC is worse than human drivers if its acceleration is low, not if its time gap is long. With a setting of 1 s,
    the time gap sometimes falls below 0.8 s.
    """

    time_gap: Positive = 1.1
    """time gap behind the leader [s]"""
    acceleration: Positive | None = 2.5
    """maximum acceleration [m/s2]; None, on a user network: that of the vehicle that the CAV replaces"""
    deceleration: Positive | None = 2.0
    """comfortable deceleration [m/s2]; None, on a user network: that of the vehicle that the CAV replaces"""
    minimum_gap: Positive = 2.0
    """gap to a standing leader [m]"""
    keep_right: NonNegative | None = None
    """eagerness to keep right; None: that of the replaced vehicle, mostly 1; 0: none"""
    speed_gain: NonNegative | None = None
    """eagerness to change lanes for a higher speed; None: that of the replaced vehicle"""
    cooperation: Annotated[float, Field(ge=0, le=1)] | None = None
    """willingness to change lanes and slow down for mandatory lane changes; None: that of the replaced vehicle"""

    def set_speed(
        self,
        speed: Array,
        target_speed: Array,
        max_acceleration: float,
        step: float,
        vehicle_limits: tuple[Array, Array] | None = None,
    ) -> Array:
        """Return the set speed with which the ACC accelerates as commanded on a free road [m/s], shape (n,).

        The set speed is infinite where the command reaches `max_acceleration` or the acceleration of the ACC.

        Args:
            speed: current speeds [m/s], shape (n,).
            target_speed: commanded speeds after a step [m/s], shape (n,).
            max_acceleration: largest acceleration that a CAV can command [m/s2].
            step: simulation step [s].
            vehicle_limits: acceleration and comfortable deceleration of an ACC for which the settings are None [m/s2].
        """
        xp, command = namespace(speed), (target_speed - speed) / step
        vehicle_acceleration, vehicle_deceleration = vehicle_limits or (0.0, 0.0)
        acceleration: Array = self.acceleration or vehicle_acceleration
        deceleration: Array = self.deceleration or vehicle_deceleration
        is_capped = command < clamp_max(acceleration, max_acceleration) - 1e-6
        acc = IDMArrays(0.0, self.time_gap, acceleration, deceleration, IDMParameters().exponent, self.minimum_gap)
        desired = desired_speed_from_acceleration(xp.where(is_capped, command, 0.0 * command), speed, acc)
        set_speed = clamp_min(xp.maximum(target_speed, desired), MIN_SET_SPEED)
        # SUMO's IDM overshoots a low set speed within a step, brakes, and may then stand forever.
        substeps = max(1, int(step / IDM_SUBSTEP + 0.5))
        next_speeds, min_rising_speed = speed, 2.0 * acceleration * step / substeps
        acc = acc._replace(desired_speed=set_speed)
        for _ in range(substeps):
            substep_acceleration = idm_acceleration(next_speeds, next_speeds, inf, acc)
            next_speeds = next_speed(next_speeds, substep_acceleration, step / substeps)
        set_speed = xp.where(next_speeds <= speed, clamp_min(set_speed, min_rising_speed), set_speed)
        set_speed = clamp_min(xp.where(command <= 0.0, target_speed, set_speed), MIN_SET_SPEED)
        return xp.where(is_capped, set_speed, 0.0 * set_speed + inf)


def check_milliseconds(step: float) -> float:
    """Return a step [s]; raise `ValueError` unless it is a whole number of milliseconds, SUMO's unit of time."""
    if abs(1000.0 * step - round(1000.0 * step)) > 1e-9:
        raise ValueError("a whole number of milliseconds, as SUMO counts")
    return step


SimulationStep = Annotated[float, Field(ge=0.001, le=10), AfterValidator(check_milliseconds)]
"""a time step of SUMO [s]"""
Horizon = Annotated[PositiveInt, Field(le=MAX_HORIZON)]
"""control steps in an episode"""


def sumo_seed(seed: Sequence[int]) -> int:
    """Return the value of SUMO's option `--seed` in the episode with this seed."""
    return int(_spawn_seeds(seed)[3].generate_state(1)[0]) % 2**31


def _spawn_seeds(seed: Sequence[int]) -> list[np.random.SeedSequence]:
    """Return the seeds of road, noise, exploration, simulator and sensors of an episode."""
    return np.random.SeedSequence(list(seed)).spawn(5)


@parameter_dataclass(frozen=True, config=STRICT)
class Scenario(Subclassable):
    """The settings that all scenarios share; each kind of road adds settings."""

    title: ClassVar[str]
    reward: ClassVar[str]
    """the default reward"""
    controller: ClassVar[str] = "unjam:best"
    """the packaged controller that was made for this kind of road"""
    is_closed: ClassVar[bool] = True
    """whether the road is a loop"""
    road_model: ClassVar[str] = ""
    """world model of the whole road, a key of `unjam.models.registry`; empty: none"""
    has_route_position: ClassVar[bool] = True
    """whether vehicles have a position along a common route"""
    has_vehicle_types: ClassVar[bool] = False
    """whether the user defines vehicle types; a CAV keeps the properties of its type"""
    reads_user_files: ClassVar[bool] = False
    """whether the road consists of SUMO files of the user, which are simulated in a sandbox"""
    sumo_human_gap: ClassVar[float] = 0.0
    """gap that SUMO keeps for commanded human drivers [m]"""

    simulation_step: SimulationStep = 0.1
    """time step of SUMO [s]"""
    steps_per_control_step: PositiveInt = 1
    """simulation steps for which one command is applied"""
    horizon: Horizon = 3000
    """control steps in an episode"""
    warmup: NonNegativeInt = 0
    """human-only simulation steps before the drivers of the CAVs take over"""
    remember_warmup: bool = True
    """whether the memory of a driver includes observations of the warm-up"""
    action_limit: Positive = 1.0
    """largest acceleration that a CAV can command, in either direction [m/s2]"""
    actuation: Actuation = "shielded"
    """how SUMO carries out the commands of a CAV. `shielded`: exactly, but SUMO brakes if a command is unsafe, and the
    override is counted; `raw`: exactly, and a collision ends the episode; `flow`: limited by SUMO's human model, as in
    Flow; `cruise`: the CAV's own ACC keeps the distance, and commands only reduce its set speed, which suits roads with
    several lanes, where SUMO makes room for vehicles that change lanes"""
    cruise: CruiseControl = field(default_factory=CruiseControl)
    """the CAV's own ACC, used with the actuation `cruise`"""
    safety: SafetyFilter = field(default_factory=SafetyFilter)
    """safety filter of each CAV, which checks commands in every simulation step"""
    actuator: Actuator = field(default_factory=Actuator)
    """delay and lag of a CAV's response to commands"""
    sensors: Sensors = field(default_factory=Sensors)
    """measurement errors of a CAV's sensors"""
    enforce_human_limits: bool = True
    """whether the limits of brakes and engine also apply to commanded human drivers in an emergency"""
    humans: IDMParameters = field(default_factory=IDMParameters)
    """parameters of human drivers"""
    population: str = ""
    """calibrated human drivers: a file of `unjam fit-drivers`, `unjam:ngsim` or `unjam:astazero`; empty: `humans`"""
    human_control: HumanControl = "native"
    """computation of the motion of human drivers. `native`: SUMO's own IDM with noise on its speeds; `commanded`: the
    same IDM and noise as a speed command in every step, as in Flow, while another model of SUMO keeps vehicles safe and
    obeys the right of way. With the paper's parameters, SUMO's own IDM hardly enters crossings"""
    right_of_way: bool = True
    """whether vehicles obey the right of way where roads meet; otherwise SUMO only prevents collisions"""
    impatience: Annotated[float, Field(ge=0, le=1)] = 0.0
    """readiness of vehicles that must yield to accept a gap in crossing traffic (SUMO's `impatience`)"""
    noise: NonNegative = 0.2
    """standard deviation of the acceleration noise of human drivers [m/s2]"""
    noise_scaling: Literal["sqrt-step", "none"] = "sqrt-step"
    """standard deviation of the noise in a step. `sqrt-step`: `noise` times the square root of the step's duration, as
    in Flow; `none`: `noise`, as in Table B1 of the paper"""
    emission_class: str = "HBEFA4/PC_petrol_Euro-6ab"
    """SUMO's emission class of all vehicles, which determines fuel"""

    @model_validator(mode="after")
    def _check_nested_settings(self) -> Self:
        for parameter in fields(self):
            value = getattr(self, parameter.name)
            for settings in value if isinstance(value, tuple) else (value,):
                check_part(f"scenario {type(self).__name__}.{parameter.name}", settings)
        return self

    @model_validator(mode="after")
    def _check_extent(self) -> Self:
        """Raise `ValueError` for episodes that would take years or need too much memory."""
        steps = self.warmup + self.horizon * self.steps_per_control_step
        for name, value, largest in (
            ("steps_per_control_step, warmup", steps, MAX_EPISODE_STEPS),
            ("vehicles of an episode", self.max_vehicles, MAX_EPISODE_VEHICLES),
            ("meters of an episode at top speed", self.max_duration * self.top_speed, MAX_EPISODE_DISTANCE),
        ):
            if not value <= largest:
                raise ValueError(f"{name}: {value:.10g} is not allowed; allowed: <= {largest:,}")
        return self

    @model_validator(mode="after")
    def _check_filter_and_acc(self) -> Self:
        for name in ("acceleration", "deceleration"):
            if not self.has_vehicle_types and getattr(self.cruise, name) is None:
                raise ValueError(f"cruise.{name}: None is not allowed on {self.title}; allowed: > 0")
        self.actuator.check_step(self.simulation_step)
        for name in ("gap_error", "speed_error"):
            assumed, actual = getattr(self.safety, name), getattr(self.sensors, name)
            if self.safety.active and assumed < actual:
                raise ValueError(f"safety.{name}: {assumed:g} is not allowed; allowed: >= sensors.{name}, {actual:g}")
        return self

    @property
    def provided_fields(self) -> tuple[str, ...]:
        """Optional fields of a `LocalState` that this road provides."""
        return ()

    @property
    def max_leader_speed(self) -> float:
        """Largest speed of the recorded vehicles [m/s]; 0 without recorded vehicles."""
        return 0.0

    @property
    def user_files(self) -> list[Path]:
        """Data files that episodes depend on, without the Python file of a user's class."""
        return [population_file(self.population)] if self.population else []

    @property
    def interface(self) -> RoadInterface:
        """The properties of this road that drivers may require."""
        fields = frozenset(self.provided_fields)
        return RoadInterface(self.title, self.is_closed, self.has_route_position, fields, self.control_step)

    def plain_sumo_command(self, seed: int) -> str:
        """Return a command that runs the same traffic without CAVs in plain SUMO; empty on built-in roads."""
        return ""

    @property
    def notes(self) -> list[str]:
        """Notes on this road for users, shown with results."""
        return []

    @property
    def training_notes(self) -> list[str]:
        """Notes for users on the results of a training on this road."""
        return []

    @property
    def control_step(self) -> float:
        """Time between two commands [s]."""
        return self.simulation_step * self.steps_per_control_step

    @property
    def noise_per_step(self) -> float:
        """Standard deviation of the acceleration noise in one simulation step [m/s2]."""
        return self.noise * (self.simulation_step**0.5 if self.noise_scaling == "sqrt-step" else 1.0)

    @property
    def cav_max_braking(self) -> float:
        """Strongest braking of a CAV [m/s2]; an active safety filter limits it to that of a car's brakes."""
        return self.safety.braking if self.safety.active else UNLIMITED_ACCELERATION

    @property
    def max_duration(self) -> float:
        """Longest duration of an episode, warm-up included [s]."""
        return self.simulation_step * (self.warmup + self.horizon * self.steps_per_control_step)

    @property
    def max_vehicles(self) -> float:
        """Number of vehicles that want to enter in an episode, according to the settings; 0: unknown."""
        return 0.0

    @property
    def max_episode_steps(self) -> int:
        """Maximum number of control steps of an episode; below the horizon if the road ends the episode earlier."""
        return self.horizon

    @property
    def acceleration_limits(self) -> Limits:
        """Accelerations that a CAV can command."""
        return Limits.symmetric(self.action_limit)

    @cached_property
    def driver_population(self) -> Population | None:
        """The human drivers of the file `population`."""
        return read_population(self.population) if self.population else None

    @property
    def top_speed(self) -> float:
        """Speed limit of the road: the largest desired speed of its human drivers [m/s]."""
        population = self.driver_population
        return population.max_desired_speed if population else self.humans.desired_speed

    def check_native_humans(self, context: str) -> None:
        """Raise `ValueError` unless SUMO can simulate the human drivers itself; messages name the road, `context`."""
        if self.driver_population and self.driver_population.residual is not None:
            reason = "SUMO computes the motion of human drivers itself"
            raise ValueError(f"population: a residual network is not allowed {context}: {reason}")
        if self.human_control != "native":
            raise ValueError(f"human_control: 'commanded' is not allowed {context}; allowed: 'native'")

    def draw_humans(self, vehicle_ids: Sequence[str], generator: np.random.Generator) -> dict[str, IDMParameters]:
        """Return the parameters of the human driver of each vehicle; empty if all drivers have those of `humans`."""
        population = self.driver_population
        if population is None:
            return {}
        return dict(zip(vehicle_ids, population.draw(len(vehicle_ids), generator), strict=True))

    @property
    def population_description(self) -> str:
        """The number and origin of the calibrated drivers, as one phrase."""
        drivers = self.driver_population.drivers if self.driver_population else ()
        return f"{format_count(len(drivers), 'calibrated driver')} of {self.population}"

    @property
    def human_description(self) -> str:
        """The model of the human drivers, as one phrase."""
        if self.driver_population:
            return self.population_description
        return f"IDM with acceleration noise of std {self.noise_per_step:.3f} m/s2 a step"

    def draw(self, generator: np.random.Generator) -> Road:
        """Return the road of one episode; all random draws come from `generator`."""
        raise NotImplementedError

    def scale_drawn_values(self, drawn_values: dict[str, float]) -> tuple[float, ...]:
        """Return the drawn values of an episode as inputs of a critic, scaled from their ranges to [-1, 1]."""
        return tuple(
            (drawn_values[name] - (low + high) / 2) / max((high - low) / 2, 1e-9)
            for name, (low, high) in self.drawn_ranges.items()
        )

    @property
    def drawn_ranges(self) -> dict[str, tuple[float, float]]:
        """Ranges of the values that each episode draws and that a critic can use."""
        return {}

    def stratum(self, index: int, count: int) -> Self:
        """Return this scenario with part `index` of `count` parts of its drawn ranges, for stratified sampling."""
        return self

    def draw_from_seed(self, seed: Sequence[int]) -> tuple[Road, Sequence[np.random.SeedSequence]]:
        """Return the road of an episode's seed, and the seeds of noise, exploration, simulator and sensors."""
        road_seed, *other_seeds = _spawn_seeds(seed)
        kind = type(self)
        if is_packaged(kind):
            return self.draw(np.random.default_rng(road_seed)), other_seeds
        file = getattr(sys.modules.get(kind.__module__), "__file__", None) or ""
        draw = UserFunction(self.draw, kind.__name__, file)  # reports errors with their line
        road, repeated_road = (draw(np.random.default_rng(road_seed)) for _ in range(2))
        check_road(road, VEHICLE_LENGTH, kind.__name__)
        check_repeated_road(road, repeated_road, kind.__name__)
        return road, other_seeds

    def possible_cav_ids(self) -> tuple[str, ...]:
        """Return the ids of all possible CAVs of an episode."""
        raise NotImplementedError

    def summary(self) -> list[tuple[str, str]]:
        """Return a description of this road for `unjam scenarios`, as (name, text) pairs."""
        return list(zip(("road", "vehicles", "limit", "limit is"), self._summary_texts(), strict=True))

    def _summary_texts(self) -> tuple[str, str, str, str]:
        """Return texts on the road, its vehicles, its limit speed, and the definition of the limit speed."""
        raise NotImplementedError
