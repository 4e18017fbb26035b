"""Traffic-adaptive cruise control: an ACC that follows more closely where road capacity is limited."""

from math import exp
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic.dataclasses import dataclass

from unjam.drivers.car_following import MIN_IDM_GAP
from unjam.drivers.driver import FormulaDriver, Memory
from unjam.drivers.local_state import MAX_OBSERVED_GAP, SPEED_SCALE, LocalState, ScaledInput
from unjam.parameters import STRICT, NonNegative, Positive
from unjam.physics.arrays import Array, clamp_min, namespace, stack_columns
from unjam.physics.idm import IDMArrays, IDMParameters, idm_acceleration

NO_LEADER_GAP = 1e6
"""gap without any effect [m]"""


class DrivingStrategy(NamedTuple):
    """Factors of time headway, acceleration and deceleration in a traffic state."""

    time_headway: float
    acceleration: float
    deceleration: float


FREE_ROAD_STRATEGY = DrivingStrategy(1.0, 1.0, 1.0)
"""on a free road, and in a jam"""
JAM_TAIL_STRATEGY = DrivingStrategy(1.0, 1.0, 0.7)
"""at the upstream end of a jam: early braking, for the safety of the vehicles behind"""
BOTTLENECK_STRATEGY = DrivingStrategy(0.7, 1.5, 1.0)
"""near a merge"""
JAM_HEAD_STRATEGY = DrivingStrategy(0.5, 2.0, 1.0)
"""at the downstream end of a jam: a higher outflow makes it shrink"""


@dataclass(frozen=True, config=STRICT)
class AdaptiveACC(IDMParameters, FormulaDriver):
    """Follows by the Intelligent Driver Model with parameters that depend on the traffic state.

    It brakes early at the upstream end of a jam, accelerates briskly at the downstream end, and keeps smaller gaps
    there and near a merge. It detects the traffic state from the difference between its speed and its mean speed, and
    from the map. It never drives more slowly than others on purpose. The vehicle's own ACC and the safety filter still
    limit it: if they keep 1.1 s, it leaves a jam with 1.1 s.
    Source: Kesting, Treiber, Schönhof, Helbing 2008, Transp. Res. C 16:668-683, tables 1 and 2.
    """

    name: ClassVar[str] = "adaptive-acc"
    required_fields: ClassVar[tuple[str, ...]] = ("allowed_speed", "distance_to_merge")
    memory_inputs: ClassVar[tuple[ScaledInput, ...]] = (
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
        speed, last = state.speed, memory["mean_speed"]
        xp = namespace(speed)
        last = xp.where(xp.isnan(last), speed, last)
        mean = last + (1.0 - exp(-self.time_step / self.averaging_time)) * (speed - last)
        approaches, faster = speed - mean < -self.jam_front_speed_change, speed - mean > self.jam_front_speed_change
        ends = approaches | (mean > self.free_speed) | (mean < self.jam_speed)
        leaves = xp.where(faster, speed * 0.0 + 1.0, xp.where(ends, speed * 0.0, memory["leaves_jam"]))
        distance, near = state.distance_to_merge, speed < 0.0
        if distance is not None:
            near = (distance < self.upstream_distance) & (distance > -self.downstream_distance)
        factors = [speed * 0.0 + factor for factor in FREE_ROAD_STRATEGY]
        strategies = (approaches, JAM_TAIL_STRATEGY), (near, BOTTLENECK_STRATEGY), (leaves > 0.0, JAM_HEAD_STRATEGY)
        for holds, strategy in strategies:
            factors = [xp.where(holds, speed * 0.0 + new, old) for new, old in zip(strategy, factors, strict=True)]
        return self._idm_acceleration(state, *factors), {"mean_speed": mean, "leaves_jam": leaves}

    def _idm_acceleration(
        self, state: LocalState, time_headway_factor: Array, acceleration_factor: Array, deceleration_factor: Array
    ) -> Array:
        speed = state.speed
        xp, allowed = namespace(speed), state.allowed_speed
        parameters = IDMArrays(
            desired_speed=speed * 0.0 + self.desired_speed if allowed is None else allowed,
            time_headway=self.time_headway * time_headway_factor,
            max_acceleration=self.max_acceleration * acceleration_factor,
            comfortable_deceleration=self.comfortable_deceleration * deceleration_factor,
            exponent=self.exponent,
            minimum_gap=self.minimum_gap,
        )
        gap = clamp_min(state.leader_gap, MIN_IDM_GAP)
        gap = xp.where(gap < MAX_OBSERVED_GAP, gap, gap * 0.0 + NO_LEADER_GAP)
        return idm_acceleration(speed, state.leader_speed, gap, parameters)

    def memory_features(self, memory: Memory) -> Array:
        """Return the mean own speed, scaled, and whether it leaves a jam, shape (n, 2)."""
        return stack_columns((memory["mean_speed"] / SPEED_SCALE, memory["leaves_jam"]))
