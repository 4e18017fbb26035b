"""Car-following drivers of a CAV: human-like models and cruise controls."""

from math import pi
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import model_validator

from unjam.drivers.driver import FormulaDriver, Memory
from unjam.drivers.local_state import MAX_OBSERVED_GAP, SPEED_SCALE, LocalState, ScaledInput
from unjam.drivers.requirements import Requirements
from unjam.drivers.smooth_acc import update_mean
from unjam.drivers.speed_history import empty_window, fill_window, slide_window, window_mean_speed
from unjam.parameters import STRICT, NonNegative, Positive, parameter_dataclass
from unjam.physics.arrays import Array, clamp_min, clip, namespace, stack_columns
from unjam.physics.idm import IDMArrays, IDMParameters, idm_acceleration

MIN_IDM_GAP = 0.01
"""smallest gap for the Intelligent Driver Model, which divides by the gap [m]"""
NO_LEADER_GAP = 1e6
"""gap that stands for a road without a leader in the Intelligent Driver Model [m]"""


@parameter_dataclass(frozen=True, config=STRICT)
class IDM(IDMParameters, FormulaDriver):
    """A CAV that drives like an ideal human driver, without noise and within the action limit.

    Source: Treiber, Hennecke, Helbing 2000; paper Eq. 5-6 with the parameters of Table B1.
    """

    name: ClassVar[str] = "idm"

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the IDM acceleration."""
        gap = clamp_min(state.leader_gap, MIN_IDM_GAP)
        return idm_acceleration(state.speed, state.leader_speed, gap, self), memory


@parameter_dataclass(frozen=True, config=STRICT)
class Human(FormulaDriver):
    """The human baseline: the simulator drives the vehicle as one of its human drivers, with their noise."""

    name: ClassVar[str] = "human"
    is_driven_by_simulator: ClassVar[bool] = True

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration of the paper's IDM; the simulator does not use it."""
        return IDM().act(state, memory)


@parameter_dataclass(frozen=True, config=STRICT)
class OVM(FormulaDriver):
    """Accelerates towards an optimal speed, which depends on the gap, and towards the leader's speed.

    Source: Bando et al. 1995, Phys. Rev. E 51:1035, with relative speed; defaults as Flow's `OVMController`.
    """

    name: ClassVar[str] = "ovm"

    gap_gain: NonNegative = 1.0
    """alpha: acceleration per m/s below the optimal speed [1/s]"""
    speed_gain: NonNegative = 1.0
    """beta: acceleration per m/s of relative speed of the leader [1/s]"""
    stop_gap: NonNegative = 2.0
    """h_st: gap below which the optimal speed is zero [m]"""
    go_gap: Positive = 15.0
    """h_go: gap above which the optimal speed is `max_speed` [m]"""
    max_speed: Positive = 30.0
    """v_max: highest optimal speed [m/s]"""

    @model_validator(mode="after")
    def _check_gap_order(self) -> "OVM":
        if self.go_gap <= self.stop_gap:
            raise ValueError(f"go_gap: {self.go_gap:g} is not allowed; allowed: > stop_gap, {self.stop_gap:g}")
        return self

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the optimal speed."""
        gap_share = clip((state.leader_gap - self.stop_gap) / (self.go_gap - self.stop_gap), 0.0, 1.0)
        optimal_speed = self.max_speed / 2.0 * (1.0 - namespace(gap_share).cos(pi * gap_share))
        acceleration = self.gap_gain * (optimal_speed - state.speed)
        return acceleration + self.speed_gain * (state.leader_speed - state.speed), memory


@parameter_dataclass(frozen=True, config=STRICT)
class BCM(FormulaDriver):
    """Accelerates towards equal gaps and equal relative speeds ahead and behind, and towards a desired speed.

    Waves cannot grow if all vehicles use this model; they can if one CAV drives among human drivers.
    Source: Horn and Wang 2017, IEEE Trans. Intell. Transp. Syst. 19(10); defaults as Flow's `BCMController`.
    """

    name: ClassVar[str] = "bcm"

    gap_gain: NonNegative = 1.0
    """k_d: acceleration per meter by which the gap ahead exceeds the gap behind [1/s2]"""
    speed_gain: NonNegative = 1.0
    """k_v: acceleration per m/s by which the gap ahead grows faster than the gap behind [1/s]"""
    desired_speed_gain: NonNegative = 1.0
    """k_c: acceleration per m/s below the desired speed [1/s]"""
    desired_speed: NonNegative = 8.0
    """speed on a free road [m/s]"""

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the bilateral acceleration."""
        gap_difference = state.leader_gap - state.follower_gap
        speed_difference = (state.leader_speed - state.speed) - (state.speed - state.follower_speed)
        free = self.desired_speed_gain * (self.desired_speed - state.speed)
        return self.gap_gain * gap_difference + self.speed_gain * speed_difference + free, memory


@parameter_dataclass(frozen=True, config=STRICT)
class ACC(FormulaDriver):
    """Keeps a constant time gap to the leader, and never drives faster than its set speed.

    The defaults are a fit to production cars. Source: Milanés and Shladover 2014, Transp. Res. C 48:285-300,
    Eq. 4 and 5.
    """

    name: ClassVar[str] = "acc"

    time_gap: Positive = 1.1
    """desired time gap [s]"""
    standstill_gap: NonNegative = 2.0
    """desired gap at standstill [m]"""
    set_speed: Positive = 30.0
    """speed on a free road [m/s]"""
    gap_gain: NonNegative = 0.23
    """acceleration per meter of excess gap [1/s2]"""
    speed_gain: NonNegative = 0.07
    """acceleration per m/s of relative speed of the leader [1/s]"""
    set_speed_gain: NonNegative = 0.4
    """acceleration per m/s below the set speed [1/s]"""

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the smaller of the accelerations for following and for free driving."""
        return self.acceleration(state, self.set_speed), memory

    def acceleration(self, state: LocalState, set_speed: Array) -> Array:
        """Return the acceleration of `act` with the given set speed [m/s], one for all rows or for each row."""
        excess_gap = state.leader_gap - self.standstill_gap - self.time_gap * state.speed
        following = self.gap_gain * excess_gap + self.speed_gain * (state.leader_speed - state.speed)
        free = self.set_speed_gain * (set_speed - state.speed)
        return namespace(state.speed).minimum(following, free)


@parameter_dataclass(frozen=True, config=STRICT)
class LACC(FormulaDriver):
    """Linear adaptive cruise control whose acceleration follows its command with a lag.

    Source: Rajamani 2012, Vehicle Dynamics and Control, chapter 6; the defaults are those of Flow's
    `LACController`, which also subtracts a vehicle length from the gap (here `standstill_gap`).
    """

    name: ClassVar[str] = "lacc"

    gap_gain: NonNegative = 0.3
    """k_1: acceleration per meter of excess gap [1/s2]"""
    speed_gain: NonNegative = 0.4
    """k_2: acceleration per m/s of relative speed of the leader [1/s]"""
    time_gap: NonNegative = 1.0
    """h: desired time gap [s]"""
    standstill_gap: NonNegative = 5.0
    """desired gap at standstill [m]"""
    lag: Positive = 0.1
    """tau: time constant with which the acceleration follows the command [s]"""
    time_step: Positive = 0.1
    """control step [s]; set by the road"""

    def initial_memory(self, n: int) -> Memory:
        """Return zero accelerations."""
        return {"acceleration": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the lagged acceleration, which is also the memory."""
        excess_gap = state.leader_gap - self.standstill_gap - self.time_gap * state.speed
        command = self.gap_gain * excess_gap + self.speed_gain * (state.leader_speed - state.speed)
        response = min(1.0, self.time_step / self.lag)  # a step longer than the lag reaches the command
        acceleration = memory["acceleration"] + response * (command - memory["acceleration"])
        return acceleration, {"acceleration": acceleration}


@parameter_dataclass(frozen=True, config=STRICT)
class FollowerStopper(FormulaDriver):
    """Drives at the desired speed while the gap allows it, and below it in three regions of the gap.

    In the field experiment the desired speed was an external estimate of the speed of traffic. By default it is the
    mean speed of the leader over the last `window` seconds. With its own mean speed, a stopped CAV would never start.
    Source: Stern et al. 2018, Transp. Res. C 89:205-221, section 3.1; with time gaps: Lichtlé et al. 2022, ICRA.
    """

    name: ClassVar[str] = "follower-stopper"

    desired_speed: NonNegative | None = None
    """U [m/s]; None: mean speed of the leader over the window"""
    window: Positive = 38.0
    """time over which the leader's speed is averaged [s]"""
    gaps: tuple[Positive, Positive, Positive] = (4.5, 5.25, 6.0)
    """boundaries of the three regions at equal speeds [m]"""
    decelerations: tuple[Positive, Positive, Positive] = (1.5, 1.0, 0.5)
    """decelerations from the closing speed to zero; each boundary is larger by the distance that this takes [m/s2]"""
    boundary_time_gaps: tuple[NonNegative, NonNegative, NonNegative] = (0.0, 0.0, 0.0)
    """time gaps of the boundaries at equal speeds, if these are larger than `gaps` [s]; the version for motorways has
    0.4, 0.6 and 0.8, and follows the leader's speed (a `window` of one step)"""
    time_constant: NonNegative = 0.0
    """time constant of the approach to the command [s]; 0: one time step"""
    time_step: Positive = 0.1
    """control step [s]; set by the road"""

    @model_validator(mode="after")
    def _check_gap_order(self) -> "FollowerStopper":
        stop, follow, free = self.gaps
        if not stop < follow < free:
            raise ValueError(f"gaps: {list(self.gaps)} is not allowed; allowed: each larger than the previous one")
        if list(times := self.boundary_time_gaps) != sorted(times):
            raise ValueError(f"boundary_time_gaps: {list(times)} is not allowed; allowed: in ascending order")
        return self

    def initial_memory(self, n: int) -> Memory:
        """Return an empty window."""
        return empty_window(n, self.window, self.time_step)

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return `memory` with the leader's speeds from the warm-up in its window."""
        return fill_window(memory, history.leader_speed)

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the commanded speed, and the new memory."""
        window = slide_window(memory, state.leader_speed)
        mean = window_mean_speed(window)
        desired_speed = mean if self.desired_speed is None else mean * 0.0 + self.desired_speed
        return self.acceleration(state, desired_speed), window

    def acceleration(self, state: LocalState, desired_speed: Array) -> Array:
        """Return the acceleration of `act` with the given desired speeds [m/s], shape (n,)."""
        xp = namespace(state.speed)
        closing_speed = xp.minimum(state.leader_speed - state.speed, state.speed * 0.0)
        stop, follow, free = (
            clamp_min(state.speed * time_gap, gap) + closing_speed**2 / (2.0 * deceleration)
            for gap, time_gap, deceleration in zip(self.gaps, self.boundary_time_gaps, self.decelerations, strict=True)
        )
        gap = state.leader_gap
        follow_speed = xp.minimum(state.leader_speed, desired_speed)
        command = follow_speed * clip((gap - stop) / (follow - stop), 0.0, 1.0)
        command = command + (desired_speed - follow_speed) * clip((gap - follow) / (free - follow), 0.0, 1.0)
        return (command - state.speed) / max(self.time_constant, self.time_step)


@parameter_dataclass(frozen=True, config=STRICT)
class Constant(FormulaDriver):
    """Commands the same acceleration in every step; only the safety filter or SUMO prevents a collision."""

    name: ClassVar[str] = "constant"

    acceleration: float = 0.0
    """commanded acceleration [m/s2]"""

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the constant acceleration."""
        return state.speed * 0.0 + self.acceleration, memory


class DrivingStrategy(NamedTuple):
    """Factors of time headway, acceleration and deceleration in a traffic state."""

    time_headway: float
    acceleration: float
    deceleration: float


FREE_ROAD_STRATEGY, BOTTLENECK_STRATEGY = DrivingStrategy(1.0, 1.0, 1.0), DrivingStrategy(0.7, 1.5, 1.0)
"""strategies on a free road or within a jam, and near a merge"""
JAM_TAIL_STRATEGY, JAM_HEAD_STRATEGY = DrivingStrategy(1.0, 1.0, 0.7), DrivingStrategy(0.5, 2.0, 1.0)
"""strategies at the upstream end of a jam, for early braking, and at the downstream end, for a larger outflow"""


@parameter_dataclass(frozen=True, config=STRICT)
class AdaptiveACC(IDMParameters, FormulaDriver):
    """Follows its leader by the Intelligent Driver Model with parameters that depend on the traffic state.

    The CAV brakes early at the upstream end of a jam, accelerates briskly at the downstream end, and keeps smaller gaps
    there and near a merge. It detects the traffic state from the difference between its speed and its mean speed, and
    from the map. It never drives more slowly than others on purpose. The vehicle's own ACC and the safety filter still
    limit the CAV: if these keep a time gap of 1.1 s, the CAV leaves a jam with this time gap.
    Source: Kesting, Treiber, Schönhof, Helbing 2008, Transp. Res. C 16:668-683, tables 1 and 2.
    """

    name: ClassVar[str] = "adaptive-acc"
    class_requirements: ClassVar = Requirements(used_fields=frozenset({"allowed_speed", "distance_to_merge"}))
    class_memory_inputs: ClassVar[tuple[ScaledInput, ...]] = (
        ScaledInput("mean own speed", SPEED_SCALE, "m/s"),
        ScaledInput("leaves a jam", 1.0, ""),
    )

    time_headway: Positive = 1.5
    """T on a free road [s]"""
    max_acceleration: Positive = 1.4
    """a on a free road [m/s2]"""
    comfortable_deceleration: Positive = 2.0
    """b on a free road [m/s2]"""
    free_speed: Positive = 16.7
    """mean speed above which the road counts as free [m/s]"""
    jam_speed: Positive = 11.1
    """mean speed below which the traffic counts as jammed [m/s]"""
    jam_front_speed_change: Positive = 2.8
    """difference between speed and mean speed at the ends of a jam [m/s]"""
    averaging_time: Positive = 5.0
    """time over which the own speed is averaged [s]"""
    upstream_distance: NonNegative = 300.0
    """distance before a merge at which the bottleneck begins [m]"""
    downstream_distance: NonNegative = 300.0
    """distance after the merge at which the bottleneck ends [m]"""
    time_step: Positive = 0.1
    """control step [s]; set by the road"""

    def initial_memory(self, n: int) -> Memory:
        """Return an unknown mean speed (NaN), outside of any jam."""
        return {"mean_speed": np.full(n, np.nan), "leaves_jam": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration of the model with the parameters for the traffic state, and the new memory."""
        xp, speed = namespace(state.speed), state.speed
        mean = update_mean(memory["mean_speed"], speed, self.averaging_time, self.time_step)
        at_tail, at_head = speed - mean < -self.jam_front_speed_change, speed - mean > self.jam_front_speed_change
        has_left = at_tail | (mean > self.free_speed) | (mean < self.jam_speed)
        leaves_jam = xp.where(at_head, speed * 0.0 + 1.0, xp.where(has_left, speed * 0.0, memory["leaves_jam"]))
        distance, at_merge = state.distance_to_merge, speed < 0.0
        if distance is not None:
            at_merge = (distance < self.upstream_distance) & (distance > -self.downstream_distance)
        factors = [speed * 0.0 + factor for factor in FREE_ROAD_STRATEGY]
        for is_active, strategy in (  # a later strategy replaces an earlier one
            (at_tail, JAM_TAIL_STRATEGY),
            (at_merge, BOTTLENECK_STRATEGY),
            (leaves_jam > 0.0, JAM_HEAD_STRATEGY),
        ):
            pairs = zip(strategy, factors, strict=True)
            factors = [xp.where(is_active, speed * 0.0 + factor, previous) for factor, previous in pairs]
        parameters = IDMArrays(
            desired_speed=speed * 0.0 + self.desired_speed if state.allowed_speed is None else state.allowed_speed,
            time_headway=self.time_headway * factors[0],
            max_acceleration=self.max_acceleration * factors[1],
            comfortable_deceleration=self.comfortable_deceleration * factors[2],
            exponent=self.exponent,
            minimum_gap=self.minimum_gap,
        )
        gap = clamp_min(state.leader_gap, MIN_IDM_GAP)
        gap = xp.where(gap < MAX_OBSERVED_GAP, gap, gap * 0.0 + NO_LEADER_GAP)
        acceleration = idm_acceleration(speed, state.leader_speed, gap, parameters)
        return acceleration, {"mean_speed": mean, "leaves_jam": leaves_jam}

    def memory_features(self, memory: Memory) -> Array:
        """Return the scaled mean own speed, and whether the CAV leaves a jam, shape (n, 2)."""
        return stack_columns((memory["mean_speed"] / SPEED_SCALE, memory["leaves_jam"]))
