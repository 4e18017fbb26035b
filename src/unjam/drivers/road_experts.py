"""Experts for the figure eight, the merge and motorways, which use positions and roadside information."""

from math import inf, nan
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field, model_validator

from unjam.drivers.driver import FormulaDriver, Memory
from unjam.drivers.local_state import SECTIONS_AHEAD, LocalState, ScaledInput, lap_angle
from unjam.drivers.requirements import Requirements
from unjam.parameters import STRICT, NonNegative, Positive, parameter_dataclass
from unjam.physics.arrays import Array, as_column, clamp_min, namespace

Harmonics = tuple[float, ...]
LapFraction = Annotated[float, Field(ge=0, lt=1)]
GATHERED_LAP_FRACTION, BROKEN_LAP_FRACTION = 0.5, 0.45
"""free shares of the lap ahead: from the first on, all have gathered behind; below the second, their queue is broken"""
MIN_PACE = 1.0
"""minimum speed of a pacer [m/s]; at standstill no queue would form"""
MAX_JAM_DISTANCE, FREE_ROAD_GAP, MAX_OVERRUN = 60.0, 99.0, 50.0
"""distance to a jam from which a jam absorber waits, gap from which the road counts as free, and distance after
`last_position` at which it stops waiting [m]"""
UNBOUNDED_ACCELERATION = 100.0
"""acceleration above that of any ACC, which does not limit the vehicle [m/s2]"""
MIN_REPORTED_CONGESTION = 0.5
"""value of a smoothed report from which a section counts as congested"""

SectionIndex = Annotated[int, Field(ge=0, lt=SECTIONS_AHEAD)]


TUNED_PACES: dict[float, tuple[Harmonics, float, float]] = {
    422.2: ((6.729, -2.092, 1.602, -0.929, 0.851, -0.096, 0.105), 0.051, 0.483),
    449.0: ((7.449, -2.059, 1.966, -0.94, 0.791, -0.028, 0.01), 0.047, 0.509),
    462.5: ((7.973, -1.865, 2.48, -0.422, 0.173, 0.027, 0.063), 0.038, 0.545),
    475.9: ((8.35, -2.057, 3.128, 0.477, 0.086, -0.086, 0.075), 0.04, 0.552),
    489.3: ((9.039, -1.791, 3.513, 1.051, 0.015, 0.024, 0.216), 0.044, 0.581),
}
"""`harmonics`, `gap_gain` and `target_gap` for `use_tuned` by the length of the lap [m], found by a search over the
pace: of radii of 30, 32, 33, 34 (0.1 m/s lower than found, as the queue broke on one of ten seeds) and 35 m"""


@parameter_dataclass(frozen=True, config=STRICT)
class Pacer(FormulaDriver):
    """Waits until all vehicles have gathered behind it, then leads them at a pace at which the queue holds.

    On the figure eight a queue that is longer than half a lap meets its own tail at the crossing. The CAV drives
    slowly at first, until all vehicles are in one queue; then it drives a lap in `lap_time`, or at a pace that varies
    over the lap. It needs its position on the road.
    """

    name: ClassVar[str] = "pacer"
    class_requirements: ClassVar[Requirements] = Requirements(needs_loop=True)
    class_memory_inputs: ClassVar[tuple[ScaledInput, ...]] = (ScaledInput("queue has gathered", 1.0, ""),)

    lap_time: Positive = 69.0
    """time for a lap [s]; the default gives 6.5 m/s at a radius of 32 m and 7.1 m/s at 35 m"""
    harmonics: Annotated[Harmonics, Field(max_length=9)] = ()
    """(V, a1, b1, a2, b2, ...) [m/s] instead of `lap_time`: pace V + a1 cos x + b1 sin x + a2 cos 2x + ...,
    where x is the position on the lap, 0 to 2 pi from its start"""
    gap_gain: NonNegative = 0.0
    """change of the pace per meter of free road ahead above or below `target_gap` [1/s]: a long queue may close up"""
    target_gap: LapFraction = 0.5
    """free share of the lap ahead at which the pace is unchanged"""
    use_tuned: bool = False
    """whether to use `TUNED_PACES` for the nearest radius of a figure eight, and shares of the lap of 0.5 and 0.45 from
    which the queue has gathered and below which it is broken: the parameters for these have no effect then"""
    gathering_speed: NonNegative = 2.0
    """speed while the others gather behind it [m/s]"""
    gathering_gap: LapFraction = 0.4
    """free share of the lap ahead from which it drives at the pace"""
    regathering_gap: LapFraction = 0.0
    """free share of the lap ahead below which the queue counts as broken, and the others gather again"""
    time_constant: Positive = 0.1
    """time constant of the approach to the pace [s]"""

    @model_validator(mode="after")
    def _check_harmonics(self) -> "Pacer":
        if len(self.harmonics) % 2 == 0 and self.harmonics:
            raise ValueError(f"harmonics: {self.harmonics} is not allowed; allowed: an odd count, (V, a1, b1, ...)")
        return self

    def initial_memory(self, n: int) -> Memory:
        """Return that the queue has not gathered yet."""
        return {"has_gathered": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the pace, and whether the queue has gathered."""
        loop, free = state.loop_length, state.leader_gap
        xp, gaps = namespace(state.speed), (self.gathering_gap, self.regathering_gap)
        from_gap, below_gap = (GATHERED_LAP_FRACTION, BROKEN_LAP_FRACTION) if self.use_tuned else gaps
        ready, broken = free >= from_gap * loop, free < below_gap * loop
        gathered = xp.where(ready, free * 0.0 + 1.0, xp.where(broken, free * 0.0, memory["has_gathered"]))
        target = xp.where(gathered > 0.0, self._pace(state), free * 0.0 + self.gathering_speed)
        return (target - state.speed) / self.time_constant, {"has_gathered": gathered}

    def _pace(self, state: LocalState) -> Array:
        """Return the pace by the free road ahead; with `use_tuned` of the nearest lap, for tensors, by all laps."""
        if not self.use_tuned:
            return _pace_of(state, self.harmonics, self.gap_gain, self.target_gap, self.lap_time)
        loop, laps = state.loop_length, [*TUNED_PACES]
        if isinstance(loop, float):
            laps = [min(laps, key=lambda lap: abs(loop - lap))]
        elif isinstance(loop, np.ndarray):  # tensors may be traced
            laps = [laps[row] for row in np.unique(abs(np.array(laps)[:, None] - loop).argmin(0))]
        pace, nearest, xp = loop * 0.0, loop * 0.0 + inf, namespace(loop)
        for lap in laps:
            closer = abs(loop - lap) < nearest
            pace = xp.where(closer, _pace_of(state, *TUNED_PACES[lap]), pace)
            nearest = xp.where(closer, abs(loop - lap), nearest)
        return pace

    def memory_features(self, memory: Memory) -> Array:
        """Return whether the queue has gathered, shape (n, 1)."""
        return as_column(memory["has_gathered"])


def _pace_of(state: LocalState, harmonics: Harmonics, gain: float, target_gap: float, lap_time: float = nan) -> Array:
    xp, loop, angle = namespace(state.speed), state.loop_length, lap_angle(state)
    pace = angle * 0.0 + harmonics[0] if harmonics else loop / lap_time
    for number, (cosine, sine) in enumerate(zip(harmonics[1::2], harmonics[2::2], strict=True), start=1):
        pace = pace + cosine * xp.cos(number * angle) + sine * xp.sin(number * angle)
    return clamp_min(pace + gain * (state.leader_gap - target_gap * loop), MIN_PACE)


@parameter_dataclass(frozen=True, config=STRICT)
class JamAbsorber(FormulaDriver):
    """Follows its leader linearly; if the leader is in a jam, it crawls until there is free road ahead.

    While it crawls, the inflow of the bottleneck is smaller than its outflow, and the jam ahead dissolves; the vehicles
    behind then pass at speed. It crawls only on a section before the bottleneck, so it needs its position along the
    road; without one it only follows. Based on jam-absorption driving, "slow in, fast out": Nishi et al. 2013,
    Transp. Res. B 50:116-129.
    """

    name: ClassVar[str] = "jam-absorber"
    class_memory_inputs: ClassVar[tuple[ScaledInput, ...]] = (ScaledInput("waits for the jam to dissolve", 1.0, ""),)

    jam_speed: NonNegative = 10.0
    """speed of the leader below which it counts as jammed [m/s]"""
    crawl_speed: NonNegative = 3.5
    """speed while it waits [m/s]"""
    release_gap: Positive = 22.0
    """gap from which it continues [m], behind a leader with `release_speed`"""
    release_speed: NonNegative = 8.3
    """minimum speed of the leader to continue [m/s]"""
    first_position: float = -580.0
    """position along the road from which it may begin to wait [m]"""
    last_position: float = -270.0
    """position up to which it may begin to wait [m]"""
    gap_gain: NonNegative = 0.25
    """acceleration per meter of excess gap [1/s2]"""
    speed_gain: NonNegative = 1.2
    """acceleration per m/s of relative speed of the leader [1/s]"""
    time_gap: NonNegative = 1.4
    """desired time gap [s]"""
    standstill_gap: NonNegative = 4.0
    """desired gap at standstill [m]"""
    extra_acceleration: NonNegative = 0.0
    """additional acceleration [m/s2]; without a `gap_gain` it closes up as far as SUMO's safety check allows"""

    def initial_memory(self, n: int) -> Memory:
        """Return that it does not wait."""
        return {"is_waiting": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration, and whether it waits from now on."""
        xp, zero = namespace(state.speed), state.speed * 0.0
        position, gap, leader_speed = state.route_position, state.leader_gap, state.leader_speed
        within = (position > self.first_position) & (position < self.last_position)
        jam = within & (leader_speed < self.jam_speed) & (gap < MAX_JAM_DISTANCE)
        waits = xp.where(jam, zero + 1.0, memory["is_waiting"])
        dissolved = ((gap >= self.release_gap) & (leader_speed >= self.release_speed)) | (gap >= FREE_ROAD_GAP)
        waits = xp.where(dissolved | (position > self.last_position + MAX_OVERRUN), zero, waits)
        excess = gap - self.standstill_gap - self.time_gap * state.speed
        follow = self.gap_gain * excess + self.speed_gain * (leader_speed - state.speed) + self.extra_acceleration
        crawl = xp.minimum(self.crawl_speed - state.speed, follow)
        return xp.where(waits > 0.0, crawl, follow), {"is_waiting": waits}

    def memory_features(self, memory: Memory) -> Array:
        """Return whether it waits, shape (n, 1)."""
        return as_column(memory["is_waiting"])


@parameter_dataclass(frozen=True, config=STRICT)
class Cruise(FormulaDriver):
    """Does not limit the vehicle: on roads with ACC, the vehicle's own ACC drives.

    The scenario has the parameters of the ACC (`cruise.time_gap`, `cruise.acceleration`). Without an ACC the vehicle
    accelerates at its limit.
    """

    name: ClassVar[str] = "cruise"

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return an acceleration above that of any ACC."""
        return state.speed * 0.0 + UNBOUNDED_ACCELERATION, memory


@parameter_dataclass(frozen=True, config=STRICT)
class AdvisorySpeed(FormulaDriver):
    """Drives no faster than a fixed speed on a section upstream of a ramp; elsewhere its own ACC drives.

    It needs neither messages nor feedback: the cheapest alternative to every driver that does. Without a map of ramps,
    as on your own network, it drives no faster than this speed everywhere.
    """

    name: ClassVar[str] = "advisory-speed"
    class_requirements: ClassVar[Requirements] = Requirements(
        required_fields=frozenset({"allowed_speed"}), used_fields=frozenset({"allowed_speed", "distance_to_merge"})
    )

    advised_speed: Positive = 19.4
    """speed that is advised to all CAVs [m/s]"""
    first_distance: NonNegative = 1500.0
    """distance upstream of the merging section at which the section begins [m]"""
    last_distance: NonNegative = 0.0
    """distance upstream of the merging section at which it ends [m]"""
    max_deceleration: Positive = 1.5
    """maximum braking towards the speed [m/s2]"""
    time_constant: Positive = 3.0
    """time constant of the approach to the speed [s]"""

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the speed on the section, elsewhere one above that of any ACC."""
        distance, free = state.distance_to_merge, state.speed * 0.0 + UNBOUNDED_ACCELERATION
        towards = clamp_min((self.advised_speed - state.speed) / self.time_constant, -self.max_deceleration)
        if distance is None:
            return towards, memory
        is_advised = (distance < self.first_distance) & (distance > self.last_distance)
        return namespace(free).where(is_advised, towards, free), memory


@parameter_dataclass(frozen=True, config=STRICT)
class JamAhead(FormulaDriver):
    """Caps the speed upstream of a ramp or a jam near the mean speed of its own lane a few hundred meters ahead.

    Therefore it reaches the tail of a jam hardly faster than the jam moves, leaves gaps for merging vehicles, and the
    inflow of the jam ahead is smaller than its outflow. Elsewhere, and without messages about the road ahead, its own
    ACC drives. It does not yield on purpose: vehicles behind it can overtake on other lanes.

    Without a map of ramps it slows down only for sections that the roadside service reports as congested: dense free
    traffic may be far slower than the speed limit. Without such a report it never slows down. `congestion` is not in
    `used_fields`: graphs and manifests describe the road with a map, on which it is not used.
    """

    name: ClassVar[str] = "jam-ahead"
    class_requirements: ClassVar[Requirements] = Requirements(
        used_fields=frozenset({"allowed_speed", "distance_to_merge", "lane_speeds", "road_speeds", "penetration_rate"}),
        needs_arrays=True,
    )

    first_section: SectionIndex = 0
    """first section ahead in the mean, of 100 m each; 0 is the own section"""
    last_section: SectionIndex = 4
    """last section ahead in the mean"""
    speed_margin: float = -2.0
    """cap above the mean speed ahead at low penetration rates [m/s]"""
    margin_by_penetration: float = 20.0
    """increase of the cap with the penetration rate [m/s]: if CAVs are many, the mean ahead is that of other CAVs with
    caps, and each would be slower than the next"""
    min_speed: NonNegative = 5.0
    """lowest cap [m/s]"""
    max_deceleration: Positive = 1.5
    """maximum braking towards the cap [m/s2]"""
    all_lanes: bool = False
    """whether the mean is over all lanes of the main road"""
    time_constant: Positive = 3.0
    """time constant of the approach to the cap [s]"""
    jam_speed_ratio: Positive = 0.75
    """share of the allowed speed below which the mean ahead counts as a jam, on roads without a map of ramps"""
    free_speed_ratio: Positive | None = None
    """with a map of ramps: share of the allowed speed from which on no cap is needed; None: there always is one"""

    @model_validator(mode="after")
    def _check_section_order(self) -> "JamAhead":
        first, last = self.first_section, self.last_section
        if last < first:
            raise ValueError(f"last_section: {last} is not allowed; allowed: >= first_section, {first}")
        return self

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the cap; without a cap one above that of any ACC."""
        speeds = state.road_speeds if self.all_lanes else state.lane_speeds
        free = state.speed * 0.0 + UNBOUNDED_ACCELERATION
        if speeds is None:
            return free, memory
        xp, sections = namespace(free), slice(self.first_section, self.last_section + 1)
        ahead = speeds[..., sections].mean(-1)
        rate = 0.0 if state.penetration_rate is None else state.penetration_rate
        cap = clamp_min(ahead + self.speed_margin + self.margin_by_penetration * rate, self.min_speed)
        cap = xp.minimum(cap, state.allowed_speed)
        towards = clamp_min((cap - state.speed) / self.time_constant, -self.max_deceleration)
        if state.distance_to_merge is not None:
            is_capped = state.distance_to_merge > 0.0
            if self.free_speed_ratio is not None:
                is_capped = is_capped & (ahead < self.free_speed_ratio * state.allowed_speed)
            return xp.where(is_capped, towards, free), memory
        if state.congestion is None:
            return free, memory
        congested = (state.congestion[..., sections] >= MIN_REPORTED_CONGESTION).any(-1)
        return xp.where(congested & (ahead < self.jam_speed_ratio * state.allowed_speed), towards, free), memory


@parameter_dataclass(frozen=True, config=STRICT)
class GapMaker(JamAhead):
    """As `jam-ahead`, with a longer time gap shortly before a merge while there are vehicles on its right.

    Vehicles from the ramp, or from the lane next to it, then find a gap in which no vehicle must brake. It needs a
    vehicle with its own ACC. Based on cooperative merging, as in Scarinci and Heydecker 2014, Transp. Rev. 34:775-797.
    """

    name: ClassVar[str] = "gap-maker"
    class_requirements: ClassVar[Requirements] = JamAhead.class_requirements._replace(
        used_fields=JamAhead.class_requirements.used_fields | {"adjacent_gaps"}
    )

    merge_time_gap: Positive = 2.0
    """time gap while it opens a gap [s]"""
    upstream_distance: NonNegative = 300.0
    """distance before the merge at which it begins [m]"""
    downstream_distance: NonNegative = 0.0
    """distance after the merge at which it ends [m]; there the ramp's lane runs next to the road"""
    max_neighbor_gap: Positive = 40.0
    """gap to a vehicle on the right, ahead or behind, below which it opens a gap [m]"""

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return the time gap while it opens a gap [s], else NaN."""
        gaps, distance = state.adjacent_gaps, state.distance_to_merge
        if gaps is None or distance is None:
            return None
        has_neighbor = (gaps[..., 2:] < self.max_neighbor_gap).any(-1)
        opens_gap = has_neighbor & (distance > -self.downstream_distance) & (distance < self.upstream_distance)
        zero = state.speed * 0.0
        return namespace(zero).where(opens_gap, zero + self.merge_time_gap, zero + nan)
