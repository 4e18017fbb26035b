"""Drivers that contain other drivers: mixtures, switches, impairments, the safety filter, and history features."""

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
"""key in the memory of a mixture: index of the driver of each CAV"""
INNER_KEY = "inner"
"""key in the memory of a wrapper: memory of the inner driver"""
AVERAGING_TIMES = (10.0, 40.0, 160.0)
"""time constants of the means [s]: within a wave, of a wave, of several waves"""
SPEED_STD_SCALE, MEAN_GAP_SCALE = 2.0, 20.0
"""divisors of the standard deviation of speed [m/s] and of the mean gap [m] in network inputs"""
MEAN_KEYS = ("mean_speed", "mean_square", "mean_gap")
"""keys of the means in the memory, without the averaging time that follows"""
MAX_DELAY_ERROR = 1e-9
"""allowed difference between the delay of an actuator and whole control steps [s]"""
MAX_GATHERING_TIME = 30.0
"""time in which all vehicles gather if their queue fits on the road [s]"""
MIN_SHARED_PENETRATION_RATE = 0.06
"""penetration rate from which on a closed road counts as shared by several CAVs; a single CAV among 16 vehicles also
reaches it, because the rate does not contain the number of CAVs"""


def select_rows(condition: Array, if_true: Array, if_false: Array) -> Array:
    """Return an array with rows of `if_true` or `if_false`, of equal shapes, by a condition of shape (n,)."""
    return np.where(condition.reshape(-1, *[1] * (np.ndim(if_true) - 1)), if_true, if_false)


class CompositeDriver(Driver):
    """A dataclass with drivers in its fields; field names are the keys of their memories, but `inner` for `driver`."""

    @cached_property
    def inner_drivers(self) -> dict[str, Driver]:
        """Drivers in the fields, in order, by the keys of their memories."""
        parts = (named_parts(self) or {}).items()
        return {INNER_KEY if name == "driver" else name: part for name, part in parts if isinstance(part, Driver)}


class DriverWrapper(CompositeDriver):
    """A driver that contains one inner driver, with its time gaps and memory features."""

    inner_key: ClassVar[str] = INNER_KEY
    """key of the inner driver"""

    @property
    def memory_inputs(self) -> tuple[ScaledInput, ...]:
        """Descriptions of the columns of the inner driver's memory features, in order."""
        return self.inner_drivers[self.inner_key].memory_inputs

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return the time gaps of the inner driver."""
        return self.inner_drivers[self.inner_key].time_gaps(state, memory[self.inner_key])

    def memory_features(self, memory: Memory) -> Array | None:
        """Return the memory features of the inner driver."""
        return self.inner_drivers[self.inner_key].memory_features(memory[self.inner_key])


@dataclass(frozen=True)
class MixedDriver(CompositeDriver):
    """Assigns its drivers to CAVs in rotation; on open roads, in the order in which the CAVs enter."""

    class_requirements: ClassVar[Requirements] = Requirements(needs_arrays=True)

    drivers: tuple[Driver, ...]

    def __post_init__(self) -> None:
        if any(driver.is_driven_by_simulator for driver in self.drivers):
            raise InputError("driver: 'human' is not allowed among several; 'idm' drives like a human driver")

    @cached_property
    def inner_drivers(self) -> dict[str, Driver]:
        """All drivers, by their indices as text."""
        return {str(index): driver for index, driver in enumerate(self.drivers)}

    def initial_memory(self, n: int) -> Memory:
        """Return the index of the driver of each CAV, and the memories of all drivers for all CAVs."""
        return {DRIVER_INDEX_KEY: np.arange(n, dtype=np.float64) % len(self.drivers), **super().initial_memory(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration of each CAV from its driver, and the new memory."""
        answers = {key: driver.act(state, memory[key]) for key, driver in self.inner_drivers.items()}
        new_memories = {key: new_memory for key, (_, new_memory) in answers.items()}
        accelerations = self._select_by_driver(memory, (acceleration for acceleration, _ in answers.values()))
        return accelerations, {**memory, **new_memories}

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return the time gap of each CAV from its driver, NaN for drivers without; None if no driver has time gaps."""
        all_time_gaps = (driver.time_gaps(state, memory[key]) for key, driver in self.inner_drivers.items())
        return self._select_by_driver(memory, all_time_gaps)

    def _select_by_driver(self, memory: Memory, answers: Iterable[Array | None]) -> Array | None:
        """Return the answer for each CAV from its driver, NaN for drivers without; None if no driver has an answer."""
        selected = None
        for index, answer in enumerate(answers):
            if answer is not None:
                previous = answer * nan if selected is None else selected
                selected = namespace(answer).where(memory[DRIVER_INDEX_KEY] == index, answer, previous)
        return selected

    def describe(self) -> str:
        """Return the descriptions of all drivers, joined by +."""
        return "+".join(driver.describe() for driver in self.drivers)


@parameter_dataclass(frozen=True, config=COMPOSITE_CONFIG)
class ImpairedDriver(DriverWrapper):
    """An inner driver with noise on its observed gaps, and a delay of its commands."""

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
        """Return the memory of the inner driver, zero elapsed steps, and a zero acceleration for each delayed step."""
        delay_steps = round(self.delay / self.time_step)
        return {**super().initial_memory(n), "step": np.zeros(n), "pending": np.zeros((n, delay_steps))}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the inner driver's acceleration from `delay` ago, and the memory with its current acceleration."""
        acceleration, new_memory = self.driver.act(self._add_gap_noise(state, memory["step"]), memory[INNER_KEY])
        pending = np.concatenate([memory["pending"], np.asarray(acceleration)[:, None]], axis=1)
        return pending[:, 0], {INNER_KEY: new_memory, "step": memory["step"] + 1.0, "pending": pending[:, 1:]}

    def _add_gap_noise(self, state: LocalState, step: Array) -> LocalState:
        if self.gap_noise == 0.0 or not len(step):
            return state
        # Rows must not influence each other. Therefore the observation of a row is the seed of its noise.
        rows = np.stack([step, state.speed, state.leader_gap, state.follower_gap], -1)
        noise = [np.random.default_rng(row.view(np.uint64).tolist()).normal(size=2) for row in rows]
        ahead, behind = self.gap_noise * np.array(noise).T
        return state._replace(
            leader_gap=np.maximum(state.leader_gap + ahead, MIN_SENSED_GAP),
            follower_gap=np.maximum(state.follower_gap + behind, MIN_SENSED_GAP),
        )

    def describe(self) -> str:
        """Return the description of the inner driver, and its impairments."""
        impairments = (("delay", self.delay, "s"), ("gap noise", self.gap_noise, "m"))
        texts = [f"{name} {value:g} {unit}" for name, value, unit in impairments if value]
        return f"{self.driver.describe()} ({', '.join(texts) or 'unimpaired'})"


@parameter_dataclass(frozen=True, config=COMPOSITE_CONFIG)
class FilteredDriver(DriverWrapper):
    """An inner driver with the limits and the safety filter of a road, for vehicles without their own filter.

    Controllers are exported in this form. A road with the same filter and actuator, and one simulation step per control
    step, does not change its commands.
    """

    class_requirements: ClassVar[Requirements] = NO_REQUIREMENTS

    driver: Driver
    action_limit: Positive
    """largest acceleration in either direction that the driver may command [m/s2]"""
    safety: SafetyFilter
    time_step: Positive
    """control step [s]"""
    actuator: Actuator = INSTANT_ACTUATOR
    """delay and lag of the vehicle"""

    @model_validator(mode="after")
    def _check_delay(self) -> "FilteredDriver":
        delay, step = self.actuator.delay, self.time_step
        self.actuator.check_step(step)
        if abs(delay - step * self.actuator.delay_steps(step)) > MAX_DELAY_ERROR:
            raise ValueError(f"actuator.delay: {delay:g} is not allowed; allowed: whole control steps of {step:g} s")
        return self

    @cached_property
    def limits(self) -> Limits:
        """Limits of the filtered acceleration: the action limit, and maximum braking if it is harder [m/s2]."""
        return Limits(-max(self.action_limit, self.safety.braking), self.action_limit)

    def initial_memory(self, n: int) -> Memory:
        """Return the memory of the inner driver, and an actuator without acceleration and pending commands."""
        actuator_state = self.actuator.initial_state(np.zeros(n), self.time_step)
        return {**super().initial_memory(n), **self._actuator_memory(actuator_state)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the filtered acceleration of the inner driver, and the new memory."""
        acceleration, new_memory = self.driver.act(state, memory[INNER_KEY])
        acceleration = clip(acceleration, -self.action_limit, self.action_limit)
        following_state, actuator, step = FollowingState(*state[:3]), self.actuator, self.time_step
        actuator_state = ActuatorState(memory.get("acceleration"), tuple(memory[key] for key in self._pending_keys))
        command, new_state = actuate(self.safety, actuator, acceleration, following_state, actuator_state, step)
        return command, {INNER_KEY: new_memory, **self._actuator_memory(new_state)}

    @cached_property
    def _pending_keys(self) -> tuple[str, ...]:
        return tuple(f"pending_{index}" for index in range(self.actuator.delay_steps(self.time_step)))

    def _actuator_memory(self, state: ActuatorState) -> Memory:
        if self.actuator.is_instant:
            return {}
        return {"acceleration": state.acceleration, **dict(zip(self._pending_keys, state.pending, strict=True))}

    def describe(self) -> str:
        """Return the description of the inner driver, and that it is filtered."""
        return f"{self.driver.describe()}, filtered"


@parameter_dataclass(frozen=True, config=COMPOSITE_CONFIG)
class HistoryDriver(DriverWrapper):
    """An inner driver with means of own speed, its square, and leader gap, as memory features for a network."""

    class_requirements: ClassVar[Requirements] = NO_REQUIREMENTS

    driver: Driver
    time_step: Positive
    """control step [s]"""

    @property
    def memory_inputs(self) -> tuple[ScaledInput, ...]:
        """Descriptions of the inner driver's memory features and of the means, in order."""
        statistics = (
            ("mean own speed", SPEED_SCALE, "m/s"),
            ("standard deviation of own speed", SPEED_STD_SCALE, "m/s"),
            ("mean gap", MEAN_GAP_SCALE, "m"),
        )
        history_inputs = (
            ScaledInput(f"{name} over {time:g} s", scale, unit)
            for time in AVERAGING_TIMES
            for name, scale, unit in statistics
        )
        return (*self.driver.memory_inputs, *history_inputs)

    def initial_memory(self, n: int) -> Memory:
        """Return the memory of the inner driver, zero steps, and zero means."""
        means = {f"{key}_{time:g}": np.zeros(n) for time in AVERAGING_TIMES for key in MEAN_KEYS}
        return {**super().initial_memory(n), "steps": np.zeros(n), **means}

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return `memory` as if the inner driver and the means had observed `history`."""
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
            for key, value in zip(MEAN_KEYS, (speed, speed * speed, gap), strict=True):
                mean = memory[f"{key}_{time:g}"]
                new_memory[f"{key}_{time:g}"] = mean + weight * (value - mean)
        return new_memory

    def memory_features(self, memory: Memory) -> Array:
        """Return the inner driver's features; mean and standard deviation of speed, and mean gap, by averaging time."""
        columns: list[Array] = []
        for time in AVERAGING_TIMES:
            speed, square, gap = (memory[f"{key}_{time:g}"] for key in MEAN_KEYS)
            deviation = square_root(clamp_min(square - speed * speed, 0.0) + 1e-9)  # the gradient at zero is infinite
            columns += [speed / SPEED_SCALE, deviation / SPEED_STD_SCALE, gap / MEAN_GAP_SCALE]
        history_columns = stack_columns(tuple(columns))
        inner_columns = self.driver.memory_features(memory[INNER_KEY])
        return history_columns if inner_columns is None else join_columns([inner_columns, history_columns])

    def describe(self) -> str:
        """Return the description of the inner driver, and that it has a history."""
        return f"{self.driver.describe()}, with history"


@parameter_dataclass(frozen=True, config=COMPOSITE_CONFIG)
class QueueFallback(CompositeDriver):
    """Switches from a driver that leads all vehicles in one queue to a fallback if the queue does not form, or breaks.

    A queue that is longer than half a lap meets its own tail at the crossing, and no map contains the time gaps of
    human drivers. Therefore the queue must form within `MAX_GATHERING_TIME`. The switch is final.
    """

    primary: Driver
    fallback: Driver
    time_step: Positive
    """control step [s]"""

    class_requirements: ClassVar[Requirements] = Requirements(needs_loop=True, needs_numpy=True)

    def initial_memory(self, n: int) -> Memory:
        """Return the memories of both drivers, and zeros: no elapsed time [s], no queue, and no switch."""
        queue_memory = {key: np.zeros(n) for key in ("elapsed", "has_gathered", "gave_up")}
        return {**super().initial_memory(n), **queue_memory}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration of the active driver, and the new memory; the fallback remembers no steps before."""
        new_memory = self._update_queue_memory(state, memory)
        gave_up = new_memory["gave_up"]
        if type(gave_up) is float:
            key, driver = ("fallback", self.fallback) if gave_up else ("primary", self.primary)
            acceleration, new_memory[key] = driver.act(state, memory[key])
            return acceleration, new_memory
        acceleration, new_memory["primary"] = self.primary.act(state, memory["primary"])
        fallback_acceleration, fallback_memory = self.fallback.act(state, memory["fallback"])
        select_active = partial(select_rows, gave_up > 0.0)
        new_memory["fallback"] = map_leaves(select_active, fallback_memory, memory["fallback"])
        return select_active(fallback_acceleration, acceleration), new_memory

    def _update_queue_memory(self, state: LocalState, memory: Memory) -> Memory:
        gap_fraction, elapsed = state.leader_gap / state.loop_length, memory["elapsed"] + self.time_step
        xp, ones = namespace(gap_fraction), memory["has_gathered"] * 0.0 + 1.0
        has_gathered = xp.where(gap_fraction >= GATHERED_LAP_FRACTION, ones, memory["has_gathered"])
        is_broken = (has_gathered > 0.0) & (gap_fraction < BROKEN_LAP_FRACTION)
        has_failed = is_broken | ((has_gathered == 0.0) & (elapsed > MAX_GATHERING_TIME))
        gave_up = xp.where(has_failed, ones, memory["gave_up"])
        return {**memory, "elapsed": elapsed, "has_gathered": has_gathered, "gave_up": gave_up}

    def describe(self) -> str:
        """Return the descriptions of both drivers."""
        return f"{self.primary.describe()} while the queue holds, else {self.fallback.describe()}"


@parameter_dataclass(frozen=True, config=COMPOSITE_CONFIG)
class RoadTypeSwitch(CompositeDriver):
    """Drives by the inner driver for the type of the road, which map and roadside messages determine.

    All CAVs of an episode are on one road. Memories of drivers for other road types keep their initial values.
    """

    class_requirements: ClassVar[Requirements] = Requirements(
        used_fields=frozenset({"distance_to_crossing", "penetration_rate"}), needs_numpy=True
    )

    motorway: Driver
    """driver on roads that provide `lane_speeds`"""

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
        """Return the driver for an open `road`, or the drivers for closed roads; all drivers if `road` is None."""
        if road is None:
            return self.inner_drivers.values()
        if road.is_closed:
            return self.crossing_loop, self.loop, self.shared_loop or self.loop
        return (self.motorway if "lane_speeds" in road.provided_fields else self.open_road,)

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration of the driver for this road type, and the new memory."""
        road_type = self._road_type(state)
        acceleration, new_memory = self.inner_drivers[road_type].act(state, memory[road_type])
        return acceleration, {**memory, road_type: new_memory}

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return the time gaps of the driver for this road type."""
        road_type = self._road_type(state)
        return self.inner_drivers[road_type].time_gaps(state, memory[road_type])

    def describe(self) -> str:
        """Return the descriptions of all drivers with their road types."""
        return ", ".join(f"{road_type}: {driver.describe()}" for road_type, driver in self.inner_drivers.items())

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
