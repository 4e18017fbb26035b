"""An ACC that follows more closely where capacity is short: traffic-adaptive cruise control."""

from math import exp
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic.dataclasses import dataclass

from unjam.drivers.driver import FormulaDriver, Memory
from unjam.drivers.local_state import MAX_OBSERVED_GAP, SPEED_SCALE, LocalState, ScaledInput
from unjam.parameters import STRICT, NonNegative, Positive
from unjam.physics.arrays import Array, clamp_min, namespace, stack_columns
from unjam.physics.idm import IDMArrays, IDMParameters, idm_acceleration

_MIN_GAP = 0.01
"""[m]; the intelligent driver model divides by the gap"""
NO_LEADER_GAP = 1e6
"""gap that holds nobody back [m]"""


class DrivingStrategy(NamedTuple):
    """What a state of traffic multiplies the time headway, the acceleration and the braking by."""

    time_headway: float
    acceleration: float
    deceleration: float


FREE_ROAD_STRATEGY = DrivingStrategy(1.0, 1.0, 1.0)
"""on a free road, and within a jam"""
JAM_TAIL_STRATEGY = DrivingStrategy(1.0, 1.0, 0.7)
"""a jam's tail: brakes early, for the safety of those behind"""
BOTTLENECK_STRATEGY = DrivingStrategy(0.7, 1.5, 1.0)
"""near where a ramp joins"""
JAM_HEAD_STRATEGY = DrivingStrategy(0.5, 2.0, 1.0)
"""a jam's head: what leaves it sooner lets it shrink"""


@dataclass(frozen=True, config=STRICT)
class AdaptiveACC(IDMParameters, FormulaDriver):
    """Follows as the intelligent driver model with a headway and an acceleration that fit the traffic around.

    It brakes early at a jam's tail, accelerates briskly out of its head, and keeps smaller gaps there and
    where a ramp joins. It tells where it is from its own speed beside its mean and from the map. Nothing
    makes it slower than others. The car's own ACC and the safety filter still bound it: where these keep
    1.1 s, it leaves a jam with 1.1 s.
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
    """a mean speed above it is a free road's [m/s]"""
    jam_speed: Positive = 11.1
    """a mean speed below it is a jam's [m/s]"""
    jam_front_speed_change: Positive = 2.8
    """change of speed against its mean that tells a jam's tail or head [m/s]"""
    averaging_time: Positive = 5.0
    """time over which the own speed is averaged [s]"""
    upstream_distance: NonNegative = 300.0
    """how far before a ramp joins the bottleneck begins [m]"""
    downstream_distance: NonNegative = 300.0
    """how far behind it it ends [m]"""
    time_step: Positive = 0.1
    """time between two decisions [s]; set by the road"""

    def initial_memory(self, n: int) -> Memory:
        """Return that no speed is known yet (NaN), and that nobody leaves a jam."""
        return {"mean_speed": np.full(n, np.nan), "leaves_jam": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration of the model with parameters that fit the traffic, and the new memory."""
        speed, last = state.speed, memory["mean_speed"]
        xp = namespace(speed)
        last = xp.where(xp.isnan(last), speed, last)
        mean = last + (1.0 - exp(-self.time_step / self.averaging_time)) * (speed - last)
        approaches, faster = speed - mean < -self.jam_front_speed_change, speed - mean > self.jam_front_speed_change
        ends = approaches | (mean > self.free_speed) | (mean < self.jam_speed)
        leaves = xp.where(faster, speed * 0.0 + 1.0, xp.where(ends, speed * 0.0, memory["leaves_jam"]))

        near = speed < 0.0
        if state.distance_to_merge is not None:
            near = (state.distance_to_merge < self.upstream_distance) & (
                state.distance_to_merge > -self.downstream_distance
            )
        factors = [speed * 0.0 + factor for factor in FREE_ROAD_STRATEGY]
        for holds, strategy in (
            (approaches, JAM_TAIL_STRATEGY),
            (near, BOTTLENECK_STRATEGY),
            (leaves > 0.0, JAM_HEAD_STRATEGY),
        ):
            factors = [xp.where(holds, speed * 0.0 + new, old) for new, old in zip(strategy, factors, strict=True)]
        return self._idm_acceleration(state, *factors), {"mean_speed": mean, "leaves_jam": leaves}

    def _idm_acceleration(
        self, state: LocalState, time_headway_factor: Array, acceleration_factor: Array, deceleration_factor: Array
    ) -> Array:
        """Return the model's acceleration with three of its parameters multiplied."""
        speed = state.speed
        xp, wanted = namespace(speed), state.allowed_speed
        parameters = IDMArrays(
            desired_speed=speed * 0.0 + self.desired_speed if wanted is None else wanted,
            time_headway=self.time_headway * time_headway_factor,
            max_acceleration=self.max_acceleration * acceleration_factor,
            comfortable_deceleration=self.comfortable_deceleration * deceleration_factor,
            exponent=self.exponent,
            minimum_gap=self.minimum_gap,
        )
        gap = clamp_min(state.leader_gap, _MIN_GAP)
        gap = xp.where(gap < MAX_OBSERVED_GAP, gap, gap * 0.0 + NO_LEADER_GAP)
        return idm_acceleration(speed, state.leader_speed, gap, parameters)

    def memory_features(self, memory: Memory) -> Array:
        """Return the mean own speed, scaled, and whether it leaves a jam, shape (n, 2)."""
        return stack_columns((memory["mean_speed"] / SPEED_SCALE, memory["leaves_jam"]))
