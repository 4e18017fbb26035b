"""Drivers that contain other drivers: mixtures and switches, impaired sensing, the safety filter, history features."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, partial
from math import exp, nan
from typing import ClassVar

import numpy as np
from pydantic import ConfigDict, model_validator

from unjam.drivers.command import Limits
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import SPEED_SCALE, LocalState, ScaledInput
from unjam.drivers.requirements import NO_REQUIREMENTS, Requirements, RoadInterface
from unjam.drivers.road_experts import BROKEN_LAP_FRACTION, GATHERED_LAP_FRACTION
from unjam.drivers.safety import INSTANT_ACTUATOR, Actuator, ActuatorState, FollowingState, SafetyFilter, actuate
from unjam.drivers.sensors import MIN_SENSED_GAP
from unjam.drivers.speed_history import MAX_WINDOW_STEPS
from unjam.errors import InputError
from unjam.parameters import STRICT, NonNegative, Positive, parameter_dataclass
from unjam.physics.arrays import Array, clamp_min, clip, join_columns, namespace, square_root, stack_columns
from unjam.tree import map_leaves, named_parts

COMPOSITE_CONFIG: ConfigDict = {**STRICT, "arbitrary_types_allowed": True}
"""configuration of parameter dataclasses with drivers among their fields"""
DRIVER_INDEX_KEY = "driver_index"
"""name in the memory of a mixture: the driver of a CAV"""
INNER_KEY = "inner"
"""name in the memory of a wrapper: that of the inner driver"""
AVERAGING_TIMES = (10.0, 40.0, 160.0)
"""time constants of the means [s]: within a wave, of a wave, of several waves"""
SPEED_STD_SCALE, MEAN_GAP_SCALE = 2.0, 20.0
"""divisors of the standard deviation of speed [m/s] and of the mean gap [m] in network inputs"""
MEAN_KEYS = ("mean_speed", "mean_square", "mean_gap")
"""names of the means in the memory, before their averaging time"""
MAX_DELAY_ERROR = 1e-9
"""allowed difference between the delay of an actuator and whole control steps [s]"""
MAX_GATHERING_TIME = 30.0
"""time in which all vehicles gather if their queue fits on the road [s]"""
MIN_SHARED_PENETRATION_RATE = 0.06
"""penetration rate from which a closed road counts as shared by several CAVs; one CAV among 16 vehicles counts, too,
because the rate does not give their number"""


def select_rows(condition: Array, if_true: Array, if_false: Array) -> Array:
    """Return the rows of one of two arrays of any equal shape, by a condition of shape (n,)."""
    return np.where(condition.reshape(-1, *[1] * (np.ndim(if_true) - 1)), if_true, if_false)


class CompositeDriver(Driver):
    """A driver that contains other drivers in fields of a dataclass; the field `driver` has the memory name `inner`."""

    @cached_property
    def inner_drivers(self) -> dict[str, Driver]:
        """The drivers in its fields, in order."""
        parts = (named_parts(self) or {}).items()
        return {INNER_KEY if name == "driver" else name: part for name, part in parts if isinstance(part, Driver)}


class DriverWrapper(CompositeDriver):
    """A driver around one inner driver."""

    inner_key: ClassVar[str] = INNER_KEY

    @property
    def memory_inputs(self) -> tuple[ScaledInput, ...]:
        """Those of the inner driver."""
        return self.inner_drivers[self.inner_key].memory_inputs

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return those of the inner driver."""
        return self.inner_drivers[self.inner_key].time_gaps(state, memory[self.inner_key])

    def memory_features(self, memory: Memory) -> Array | None:
        """Return those of the inner driver."""
        return self.inner_drivers[self.inner_key].memory_features(memory[self.inner_key])


@dataclass(frozen=True)
class MixedDriver(CompositeDriver):
    """Assigns drivers to CAVs in turn, again from the first after the last; CAVs of open roads in order of entry."""

    class_requirements: ClassVar[Requirements] = Requirements(needs_arrays=True)

    drivers: tuple[Driver, ...]

    def __post_init__(self) -> None:
        if any(driver.is_driven_by_simulator for driver in self.drivers):
            raise InputError("driver: 'human' is not allowed among several; 'idm' drives like a human driver")

    @cached_property
    def inner_drivers(self) -> dict[str, Driver]:
        """All of them, by number."""
        return {str(number): driver for number, driver in enumerate(self.drivers)}

    def initial_memory(self, n: int) -> Memory:
        """Return the driver of each CAV, and the memories of all drivers for all CAVs."""
        return {DRIVER_INDEX_KEY: np.arange(n, dtype=np.float64) % len(self.drivers), **super().initial_memory(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration by the driver of each CAV, and the new memory."""
        answers = {key: driver.act(state, memory[key]) for key, driver in self.inner_drivers.items()}
        new_memories = {key: new_memory for key, (_, new_memory) in answers.items()}
        return self._select(memory, (acceleration for acceleration, _ in answers.values())), {**memory, **new_memories}

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return the time gap by the driver of each CAV."""
        return self._select(
            memory, (driver.time_gaps(state, memory[key]) for key, driver in self.inner_drivers.items())
        )

    def _select(self, memory: Memory, answers: Iterable[Array | None]) -> Array | None:
        """Return the answer by the driver of each CAV, NaN for those without; None if there is no answer."""
        selected = None
        for number, answer in enumerate(answers):
            if answer is not None:
                previous = answer * nan if selected is None else selected
                selected = namespace(answer).where(memory[DRIVER_INDEX_KEY] == number, answer, previous)
        return selected

    def describe(self) -> str:
        """Return all of them, joined by +."""
        return "+".join(driver.describe() for driver in self.drivers)


@parameter_dataclass(frozen=True, config=COMPOSITE_CONFIG)
class ImpairedDriver(DriverWrapper):
    """Drives as another driver does with noisy gaps and delayed commands."""

    driver: Driver
    delay: NonNegative = 0.0
    """delay of a command, rounded to whole control steps [s]"""
    gap_noise: NonNegative = 0.0
    """standard deviation of the errors of both gaps, independent in each control step [m]"""
    time_step: Positive = 0.1
    """control step [s]"""

    @model_validator(mode="after")
    def _check_delay(self) -> "ImpairedDriver":
        if self.delay / self.time_step > MAX_WINDOW_STEPS:
            allowed = f"at most {MAX_WINDOW_STEPS:,} steps of {self.time_step:g} s"
            raise ValueError(f"delay: {self.delay:g} is not allowed; allowed: {allowed}")
        return self

    def initial_memory(self, n: int) -> Memory:
        """Return the memory of the inner driver, no elapsed step, and zero accelerations until the delay has passed."""
        delay_steps = round(self.delay / self.time_step)
        return {**super().initial_memory(n), "step": np.zeros(n), "pending": np.zeros((n, delay_steps))}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration of the inner driver from `delay` ago, and store the current one."""
        acceleration, new_memory = self.driver.act(self._add_gap_noise(state, memory["step"]), memory[INNER_KEY])
        pending = np.concatenate([memory["pending"], np.asarray(acceleration)[:, None]], axis=1)
        return pending[:, 0], {INNER_KEY: new_memory, "step": memory["step"] + 1.0, "pending": pending[:, 1:]}

    def _add_gap_noise(self, state: LocalState, step: Array) -> LocalState:
        if self.gap_noise == 0.0 or not len(step):
            return state
        # The answer of a driver must not depend on other rows, so the observation of a row seeds its noise.
        rows = np.stack([step, state.speed, state.leader_gap, state.follower_gap], -1)
        noise = [np.random.default_rng(row.view(np.uint64).tolist()).normal(size=2) for row in rows]
        ahead, behind = self.gap_noise * np.array(noise).T
        return state._replace(
            leader_gap=np.maximum(state.leader_gap + ahead, MIN_SENSED_GAP),
            follower_gap=np.maximum(state.follower_gap + behind, MIN_SENSED_GAP),
        )

    def describe(self) -> str:
        """Return the inner driver and its impairments."""
        impairments = (("delay", self.delay, "s"), ("gap noise", self.gap_noise, "m"))
        words = [f"{name} {value:g} {unit}" for name, value, unit in impairments if value]
        return f"{self.driver.describe()} ({', '.join(words) or 'unimpaired'})"


@parameter_dataclass(frozen=True, config=COMPOSITE_CONFIG)
class FilteredDriver(DriverWrapper):
    """Another driver with the limits and the safety filter of a road, for a vehicle without its own filter.

    Controllers are exported in this form. On a road with the same filter and actuator and one simulation step per
    control step, nothing changes.
    """

    class_requirements: ClassVar[Requirements] = NO_REQUIREMENTS

    driver: Driver
    action_limit: Positive
    """largest acceleration in either direction that the driver may command [m/s2]"""
    safety: SafetyFilter
    time_step: Positive
    """control step [s]"""
    actuator: Actuator = INSTANT_ACTUATOR
    """delay and lag of the vehicle that carries out the commands"""

    @model_validator(mode="after")
    def _check_delay(self) -> "FilteredDriver":
        delay, step = self.actuator.delay, self.time_step
        self.actuator.check_step(step)
        if abs(delay - step * self.actuator.delay_steps(step)) > MAX_DELAY_ERROR:
            raise ValueError(f"actuator.delay: {delay:g} is not allowed; allowed: whole control steps of {step:g} s")
        return self

    @cached_property
    def limits(self) -> Limits:
        """Limits of the result: those of the driver, and the brakes of the vehicle."""
        return Limits(-max(self.action_limit, self.safety.braking), self.action_limit)

    def initial_memory(self, n: int) -> Memory:
        """Return the memory of the inner driver, and an actuator without acceleration and pending commands."""
        at_rest = self.actuator.initial_state(np.zeros(n), self.time_step)
        return {**super().initial_memory(n), **self._actuator_memory(at_rest)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the filtered acceleration of the inner driver, and the new memory."""
        acceleration, new_memory = self.driver.act(state, memory[INNER_KEY])
        acceleration = clip(acceleration, -self.action_limit, self.action_limit)
        following, actuator, step = FollowingState(*state[:3]), self.actuator, self.time_step
        previous_state = ActuatorState(memory.get("acceleration"), tuple(memory[key] for key in self._pending_keys))
        command, responding = actuate(self.safety, actuator, acceleration, following, previous_state, step)
        return command, {INNER_KEY: new_memory, **self._actuator_memory(responding)}

    @cached_property
    def _pending_keys(self) -> tuple[str, ...]:
        return tuple(f"pending_{number}" for number in range(self.actuator.delay_steps(self.time_step)))

    def _actuator_memory(self, state: ActuatorState) -> Memory:
        if self.actuator.is_instant:
            return {}
        return {"acceleration": state.acceleration, **dict(zip(self._pending_keys, state.pending, strict=True))}

    def describe(self) -> str:
        """Return the inner driver, and that it is filtered."""
        return f"{self.driver.describe()}, filtered"


@parameter_dataclass(frozen=True, config=COMPOSITE_CONFIG)
class HistoryDriver(DriverWrapper):
    """Drives as another driver does, and keeps means of its own speed, its square, and its gap for a network."""

    class_requirements: ClassVar[Requirements] = NO_REQUIREMENTS

    driver: Driver
    time_step: Positive
    """control step [s]"""

    @property
    def memory_inputs(self) -> tuple[ScaledInput, ...]:
        """Those of the inner driver, and its own."""
        kinds = (("mean own speed", SPEED_SCALE, "m/s"), ("standard deviation of own speed", SPEED_STD_SCALE, "m/s"))
        entries = [(time, *kind) for time in AVERAGING_TIMES for kind in (*kinds, ("mean gap", MEAN_GAP_SCALE, "m"))]
        own_inputs = (ScaledInput(f"{name} over {time:g} s", scale, unit) for time, name, scale, unit in entries)
        return (*self.driver.memory_inputs, *own_inputs)

    def initial_memory(self, n: int) -> Memory:
        """Return the memory of the inner driver, and means over no steps."""
        means = {f"{name}_{time:g}": np.zeros(n) for time in AVERAGING_TIMES for name in MEAN_KEYS}
        return {**super().initial_memory(n), "steps": np.zeros(n), **means}

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return `memory` as if both had observed `history`."""
        memory = super().recall(memory, history)
        for step in range(history.speed.shape[1]):
            memory = self._update_means(memory, history.speed[:, step], history.leader_gap[:, step])
        return memory

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration of the inner driver, and the new memory."""
        acceleration, new_memory = self.driver.act(state, memory[INNER_KEY])
        return acceleration, {**self._update_means(memory, state.speed, state.leader_gap), INNER_KEY: new_memory}

    def _update_means(self, memory: Memory, speed: Array, gap: Array) -> Memory:
        xp, new_memory = namespace(speed), dict(memory)
        new_memory["steps"] = memory["steps"] + 1.0
        early_weight = 1.0 / new_memory["steps"]
        for time in AVERAGING_TIMES:
            late_weight = 1.0 - exp(-self.time_step / time)
            weight = xp.where(early_weight > late_weight, early_weight, early_weight * 0.0 + late_weight)
            for name, value in zip(MEAN_KEYS, (speed, speed * speed, gap), strict=True):
                mean = memory[f"{name}_{time:g}"]
                new_memory[f"{name}_{time:g}"] = mean + weight * (value - mean)
        return new_memory

    def memory_features(self, memory: Memory) -> Array:
        """Return those of the inner driver; mean and standard deviation of speed and mean gap by averaging time."""
        columns: list[Array] = []
        for time in AVERAGING_TIMES:
            speed, square, gap = (memory[f"{name}_{time:g}"] for name in MEAN_KEYS)
            deviation = square_root(clamp_min(square - speed * speed, 0.0) + 1e-9)  # never the root of zero
            columns += [speed / SPEED_SCALE, deviation / SPEED_STD_SCALE, gap / MEAN_GAP_SCALE]
        own_columns = stack_columns(tuple(columns))
        inner_columns = self.driver.memory_features(memory[INNER_KEY])
        return own_columns if inner_columns is None else join_columns([inner_columns, own_columns])

    def describe(self) -> str:
        """Return the inner driver, and that it has a history."""
        return f"{self.driver.describe()}, with history"


@parameter_dataclass(frozen=True, config=COMPOSITE_CONFIG)
class QueueFallback(CompositeDriver):
    """Drives by a driver that leads all others in one queue, and by a fallback once that queue has not held.

    A queue that is longer than half a lap meets its own tail at the crossing, and no map provides the time gaps of
    human drivers. So it must form within `MAX_GATHERING_TIME`, and must not break. The switch is final.
    """

    primary: Driver
    fallback: Driver
    time_step: Positive
    """control step [s]"""

    class_requirements: ClassVar[Requirements] = Requirements(needs_loop=True, needs_numpy=True)

    def initial_memory(self, n: int) -> Memory:
        """Return the memories of both, without elapsed time [s], queue and switch."""
        own_memory = {key: np.zeros(n) for key in ("elapsed", "has_gathered", "gave_up")}
        return {**super().initial_memory(n), **own_memory}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration by the active driver, and the new memory; that of the fallback starts with it."""
        new_memory = self._update_memory(state, memory)
        gave_up = new_memory["gave_up"]
        if type(gave_up) is float:
            key, driver = ("fallback", self.fallback) if gave_up else ("primary", self.primary)
            acceleration, new_memory[key] = driver.act(state, memory[key])
            return acceleration, new_memory
        acceleration, new_memory["primary"] = self.primary.act(state, memory["primary"])
        fallback_acceleration, fallback_memory = self.fallback.act(state, memory["fallback"])
        select = partial(select_rows, gave_up > 0.0)
        new_memory["fallback"] = map_leaves(select, fallback_memory, memory["fallback"])
        return select(fallback_acceleration, acceleration), new_memory

    def _update_memory(self, state: LocalState, memory: Memory) -> Memory:
        free, elapsed = state.leader_gap / state.loop_length, memory["elapsed"] + self.time_step
        xp, ones = namespace(free), memory["has_gathered"] * 0.0 + 1.0
        gathered = xp.where(free >= GATHERED_LAP_FRACTION, ones, memory["has_gathered"])
        is_broken = (gathered > 0.0) & (free < BROKEN_LAP_FRACTION)
        failed = is_broken | ((gathered == 0.0) & (elapsed > MAX_GATHERING_TIME))
        gave_up = xp.where(failed, ones, memory["gave_up"])
        return {**memory, "elapsed": elapsed, "has_gathered": gathered, "gave_up": gave_up}

    def describe(self) -> str:
        """Return both."""
        return f"{self.primary.describe()} while the queue holds, else {self.fallback.describe()}"


@parameter_dataclass(frozen=True, config=COMPOSITE_CONFIG)
class RoadTypeSwitch(CompositeDriver):
    """Drives by one of its inner drivers, selected by road type: from the vehicle's map and roadside messages.

    All CAVs of an episode are on one road. The memories for other road types keep their initial values.
    """

    class_requirements: ClassVar[Requirements] = Requirements(
        used_fields=frozenset({"distance_to_crossing", "penetration_rate"}), needs_numpy=True
    )

    motorway: Driver
    """driver on roads with measured speeds of the lanes ahead"""
    crossing_loop: Driver
    """driver on a closed road that crosses itself"""
    loop: Driver
    """driver on any other closed road"""
    open_road: Driver
    """driver on open roads without roadside information"""
    shared_loop: Driver | None = None
    """driver on closed roads without a crossing and with a penetration rate of at least `MIN_SHARED_PENETRATION_RATE`;
    None: `loop`"""

    def active_drivers(self, road: RoadInterface | None) -> Iterable[Driver]:
        """Return the driver of an open road, or all drivers of closed roads."""
        if road is None:
            return self.inner_drivers.values()
        if road.is_closed:
            return self.crossing_loop, self.loop, self.shared_loop or self.loop
        return (self.motorway if "lane_speeds" in road.provided_fields else self.open_road,)

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration by the driver for this road type, and the new memory."""
        name = self._road_type(state)
        acceleration, new_memory = self.inner_drivers[name].act(state, memory[name])
        return acceleration, {**memory, name: new_memory}

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return those of the driver for this road type."""
        name = self._road_type(state)
        return self.inner_drivers[name].time_gaps(state, memory[name])

    def describe(self) -> str:
        """Return all of them with their road types."""
        return ", ".join(f"{name}: {driver.describe()}" for name, driver in self.inner_drivers.items())

    def _road_type(self, state: LocalState) -> str:
        if state.lane_speeds is not None:
            return "motorway"
        if state.distance_to_crossing is not None:
            return "crossing_loop"
        length, rate = state.loop_length, state.penetration_rate
        is_open = length != length if isinstance(length, float) else namespace(length).isnan(length).all()
        if bool(is_open):
            return "open_road"
        if self.shared_loop is None or rate is None:
            return "loop"
        rate = rate if isinstance(rate, float) else float(rate[0])
        return "shared_loop" if rate >= MIN_SHARED_PENETRATION_RATE else "loop"
