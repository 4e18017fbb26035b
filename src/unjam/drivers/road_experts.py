"""Experts for the figure eight, the merge and motorways; they use positions and roadside information."""

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
"""gaps to the leader as shares of the lap: from the first on, all vehicles have gathered behind the CAV; below the
second, their queue is broken"""
MIN_PACE = 1.0
"""minimum speed of a pacer [m/s]; at standstill no queue would form"""
MAX_JAM_DISTANCE, FREE_ROAD_GAP, MAX_OVERRUN = 60.0, 99.0, 50.0
"""distances of a jam absorber [m]: largest gap to a jam at which it begins to wait, smallest gap on a free road, and
distance after `last_position` at which it stops waiting"""
UNBOUNDED_ACCELERATION = 100.0
"""acceleration above the acceleration of any ACC, so that it does not limit the vehicle [m/s2]"""
MIN_REPORTED_CONGESTION = 0.5
"""smallest value of `congestion` at which a section counts as congested"""
SectionIndex = Annotated[int, Field(ge=0, lt=SECTIONS_AHEAD)]
"""index of a section ahead; 0 is the section of the CAV"""

TUNED_PACES: dict[float, tuple[Harmonics, float, float]] = {
    422.2: ((6.729, -2.092, 1.602, -0.929, 0.851, -0.096, 0.105), 0.051, 0.483),
    449.0: ((7.449, -2.059, 1.966, -0.94, 0.791, -0.028, 0.01), 0.047, 0.509),
    462.5: ((7.973, -1.865, 2.48, -0.422, 0.173, 0.027, 0.063), 0.038, 0.545),
    475.9: ((8.35, -2.057, 3.128, 0.477, 0.086, -0.086, 0.075), 0.04, 0.552),
    489.3: ((9.039, -1.791, 3.513, 1.051, 0.015, 0.024, 0.216), 0.044, 0.581),
}
"""`harmonics`, `gap_gain` and `target_gap` for `use_tuned`, tuned by a search, for each length of the lap [m]: radii of
30, 32, 33, 34 and 35 m; for 34 m, the pace is 0.1 m/s lower, because the tuned queue broke on one of ten seeds"""


@parameter_dataclass(frozen=True, config=STRICT)
class Pacer(FormulaDriver):
    """Drives slowly until all vehicles have gathered behind it in one queue, then leads the queue at a pace.

    On the figure eight a queue that is longer than half a lap meets its own tail at the crossing. After gathering, the
    CAV drives a lap in `lap_time`, or at a pace that varies over the lap. It needs its position on the road.
    """

    name: ClassVar[str] = "pacer"
    class_requirements: ClassVar[Requirements] = Requirements(needs_loop=True)
    class_memory_inputs: ClassVar[tuple[ScaledInput, ...]] = (ScaledInput("queue has gathered", 1.0, ""),)

    lap_time: Positive = 69.0
    """time for a lap [s]; the default is 6.5 m/s at a radius of 32 m and 7.1 m/s at a radius of 35 m"""
    harmonics: Annotated[Harmonics, Field(max_length=9)] = ()
    """(V, a1, b1, a2, b2, ...) [m/s] instead of `lap_time`: pace V + a1 cos x + b1 sin x + a2 cos 2x + ...,
    where x is the position on the lap, 0 to 2 pi from its start"""
    gap_gain: NonNegative = 0.0
    """increase of the pace per meter by which the gap to the leader exceeds `target_gap` [1/s]"""
    target_gap: LapFraction = 0.5
    """gap to the leader at which the pace is unchanged, as a share of the lap"""
    use_tuned: bool = False
    """whether to use `TUNED_PACES` for the nearest radius of a figure eight, a `gathering_gap` of 0.5 and a
    `regathering_gap` of 0.45; the parameters for these have no effect then"""
    gathering_speed: NonNegative = 2.0
    """speed while other vehicles gather behind the CAV [m/s]"""
    gathering_gap: LapFraction = 0.4
    """gap to the leader from which on the CAV drives at the pace, as a share of the lap"""
    regathering_gap: LapFraction = 0.0
    """gap to the leader below which the queue is broken, and other vehicles gather again, as a share of the lap"""
    time_constant: Positive = 0.1
    """time constant of the approach to the pace [s]"""

    @model_validator(mode="after")
    def _check_harmonics(self) -> "Pacer":
        if len(self.harmonics) % 2 == 0 and self.harmonics:
            raise ValueError(f"harmonics: {self.harmonics} is not allowed; allowed: an odd count, (V, a1, b1, ...)")
        return self

    def initial_memory(self, n: int) -> Memory:
        """Return zeros: the queue has not gathered yet."""
        return {"has_gathered": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the pace, and whether the queue has gathered."""
        loop_length, gap = state.loop_length, state.leader_gap
        xp, parameters = namespace(state.speed), (self.gathering_gap, self.regathering_gap)
        fractions = (GATHERED_LAP_FRACTION, BROKEN_LAP_FRACTION) if self.use_tuned else parameters
        is_gathered, is_broken = gap >= fractions[0] * loop_length, gap < fractions[1] * loop_length
        has_gathered = xp.where(is_gathered, gap * 0.0 + 1.0, xp.where(is_broken, gap * 0.0, memory["has_gathered"]))
        target_speed = xp.where(has_gathered > 0.0, self._pace(state), gap * 0.0 + self.gathering_speed)
        return (target_speed - state.speed) / self.time_constant, {"has_gathered": has_gathered}

    def _pace(self, state: LocalState) -> Array:
        """Return the pace [m/s], shape (n,); with `use_tuned`, of the lap in `TUNED_PACES` with the nearest length."""
        if not self.use_tuned:
            return _compute_pace(state, self.harmonics, self.gap_gain, self.target_gap, self.lap_time)
        loop_length, laps = state.loop_length, [*TUNED_PACES]
        if isinstance(loop_length, float):
            laps = [min(laps, key=lambda lap: abs(loop_length - lap))]
        elif isinstance(loop_length, np.ndarray):  # for tensors, which may be traced, all laps
            laps = [laps[index] for index in np.unique(abs(np.array(laps)[:, None] - loop_length).argmin(0))]
        pace, smallest_difference, xp = loop_length * 0.0, loop_length * 0.0 + inf, namespace(loop_length)
        for lap in laps:
            difference = abs(loop_length - lap)
            is_nearer = difference < smallest_difference
            pace = xp.where(is_nearer, _compute_pace(state, *TUNED_PACES[lap]), pace)
            smallest_difference = xp.where(is_nearer, difference, smallest_difference)
        return pace

    def memory_features(self, memory: Memory) -> Array:
        """Return whether the queue has gathered, shape (n, 1)."""
        return as_column(memory["has_gathered"])


def _compute_pace(
    state: LocalState, harmonics: Harmonics, gap_gain: float, target_gap: float, lap_time: float = nan
) -> Array:
    xp, loop_length, angle = namespace(state.speed), state.loop_length, lap_angle(state)
    pace = angle * 0.0 + harmonics[0] if harmonics else loop_length / lap_time
    for order, (a, b) in enumerate(zip(harmonics[1::2], harmonics[2::2], strict=True), start=1):
        pace = pace + a * xp.cos(order * angle) + b * xp.sin(order * angle)
    return clamp_min(pace + gap_gain * (state.leader_gap - target_gap * loop_length), MIN_PACE)


@parameter_dataclass(frozen=True, config=STRICT)
class JamAbsorber(FormulaDriver):
    """Follows its leader by a linear controller; behind a jammed leader, it crawls until there is free road ahead.

    While the CAV crawls, the inflow of the bottleneck is smaller than its outflow, and the jam ahead dissolves; the
    vehicles behind then pass at speed. The CAV crawls only on a section before the bottleneck, and on roads where its
    position is known. Based on jam-absorption driving, "slow in, fast out": Nishi et al. 2013, Transp. Res. B
    50:116-129.
    """

    name: ClassVar[str] = "jam-absorber"
    class_memory_inputs: ClassVar[tuple[ScaledInput, ...]] = (ScaledInput("waits for the jam to dissolve", 1.0, ""),)

    jam_speed: NonNegative = 10.0
    """speed of the leader below which the leader counts as jammed [m/s]"""
    crawl_speed: NonNegative = 3.5
    """speed while the CAV waits for the jam to dissolve [m/s]"""
    release_gap: Positive = 22.0
    """minimum gap at which the CAV stops waiting behind a leader with `release_speed` [m]"""
    release_speed: NonNegative = 8.3
    """minimum speed of the leader at which the CAV stops waiting [m/s]"""
    first_position: float = -580.0
    """position along the road from which on the CAV may begin to wait [m]"""
    last_position: float = -270.0
    """position along the road up to which the CAV may begin to wait [m]"""
    gap_gain: NonNegative = 0.25
    """acceleration per meter of excess gap [1/s2]"""
    speed_gain: NonNegative = 1.2
    """acceleration per m/s of relative speed of the leader [1/s]"""
    time_gap: NonNegative = 1.4
    """desired time gap [s]"""
    standstill_gap: NonNegative = 4.0
    """desired gap at standstill [m]"""
    extra_acceleration: NonNegative = 0.0
    """additional acceleration [m/s2]; if `gap_gain` is 0, the CAV closes up as far as SUMO's safety check allows"""

    def initial_memory(self, n: int) -> Memory:
        """Return zeros: no CAV waits."""
        return {"is_waiting": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration, and whether the CAV waits after this step."""
        xp, zero = namespace(state.speed), state.speed * 0.0
        position, gap, leader_speed = state.route_position, state.leader_gap, state.leader_speed
        is_on_section = (position > self.first_position) & (position < self.last_position)
        is_jammed = is_on_section & (leader_speed < self.jam_speed) & (gap < MAX_JAM_DISTANCE)
        is_waiting = xp.where(is_jammed, zero + 1.0, memory["is_waiting"])
        is_free = ((gap >= self.release_gap) & (leader_speed >= self.release_speed)) | (gap >= FREE_ROAD_GAP)
        is_waiting = xp.where(is_free | (position > self.last_position + MAX_OVERRUN), zero, is_waiting)
        excess_gap = gap - self.standstill_gap - self.time_gap * state.speed
        follow = self.gap_gain * excess_gap + self.speed_gain * (leader_speed - state.speed) + self.extra_acceleration
        crawl = xp.minimum(self.crawl_speed - state.speed, follow)
        return xp.where(is_waiting > 0.0, crawl, follow), {"is_waiting": is_waiting}

    def memory_features(self, memory: Memory) -> Array:
        """Return whether the CAV waits, shape (n, 1)."""
        return as_column(memory["is_waiting"])


@parameter_dataclass(frozen=True, config=STRICT)
class Cruise(FormulaDriver):
    """Does not limit the vehicle: on roads with ACCs, the vehicle's own ACC drives.

    The scenario contains the parameters of the ACC (`cruise.time_gap`, `cruise.acceleration`). Without an ACC the
    vehicle accelerates at its limit.
    """

    name: ClassVar[str] = "cruise"

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return an acceleration above the acceleration of any ACC."""
        return state.speed * 0.0 + UNBOUNDED_ACCELERATION, memory


@parameter_dataclass(frozen=True, config=STRICT)
class AdvisorySpeed(FormulaDriver):
    """Drives no faster than a fixed speed on a section upstream of a ramp; elsewhere its own ACC drives.

    It needs neither messages nor feedback, and is therefore a simple reference for drivers that need them. Without a
    map of ramps, as on your own network, it drives no faster than this speed on the whole road.
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
    """maximum braking towards `advised_speed` [m/s2]"""
    time_constant: Positive = 3.0
    """time constant of the approach to `advised_speed` [s]"""

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards `advised_speed` on the section, and an unbounded acceleration elsewhere."""
        distance, unbounded = state.distance_to_merge, state.speed * 0.0 + UNBOUNDED_ACCELERATION
        advised = clamp_min((self.advised_speed - state.speed) / self.time_constant, -self.max_deceleration)
        if distance is None:
            return advised, memory
        is_advised = (distance < self.first_distance) & (distance > self.last_distance)
        return namespace(unbounded).where(is_advised, advised, unbounded), memory


@parameter_dataclass(frozen=True, config=STRICT)
class JamAhead(FormulaDriver):
    """Caps the speed upstream of a ramp or a jam near the mean speed of its own lane a few hundred meters ahead.

    Therefore the CAV reaches the tail of a jam hardly faster than the jam moves, leaves gaps for merging vehicles, and
    the inflow of the jam ahead is smaller than its outflow. Elsewhere, and without messages about the road ahead, its
    own ACC drives. It does not yield on purpose: vehicles behind the CAV can overtake on other lanes.

    Without a map of ramps the CAV slows down only for sections that the roadside service reports as congested, because
    dense free traffic may be far slower than the speed limit. `used_fields` does not contain `congestion`, because
    graphs and manifests describe roads with a map, on which this driver does not use the field.
    """

    name: ClassVar[str] = "jam-ahead"
    class_requirements: ClassVar[Requirements] = Requirements(
        used_fields=frozenset({"allowed_speed", "distance_to_merge", "lane_speeds", "road_speeds", "penetration_rate"}),
        needs_arrays=True,
    )

    first_section: SectionIndex = 0
    """first section of the mean speed ahead, of 100 m each; 0 is the own section"""
    last_section: SectionIndex = 4
    """last section of the mean speed ahead"""
    speed_margin: float = -2.0
    """cap minus mean speed ahead, at low penetration rates [m/s]"""
    margin_by_penetration: float = 20.0
    """increase of the cap with the penetration rate [m/s]: at high rates the mean speed ahead is the speed of CAVs with
    caps, and without this increase each CAV would be slower than the next one ahead"""
    min_speed: NonNegative = 5.0
    """lowest cap [m/s]"""
    max_deceleration: Positive = 1.5
    """maximum braking towards the cap [m/s2]"""
    all_lanes: bool = False
    """whether the mean speed ahead is that of all lanes of the main road, not of the own lane"""
    time_constant: Positive = 3.0
    """time constant of the approach to the cap [s]"""
    jam_speed_ratio: Positive = 0.75
    """without a map of ramps: the mean speed ahead, as a share of the allowed speed, below which there is a cap"""
    free_speed_ratio: Positive | None = None
    """the same with a map of ramps; None: there is a cap at any speed ahead"""

    @model_validator(mode="after")
    def _check_section_order(self) -> "JamAhead":
        first, last = self.first_section, self.last_section
        if last < first:
            raise ValueError(f"last_section: {last} is not allowed; allowed: >= first_section, {first}")
        return self

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the cap, and an unbounded acceleration without a cap."""
        speeds = state.road_speeds if self.all_lanes else state.lane_speeds
        unbounded = state.speed * 0.0 + UNBOUNDED_ACCELERATION
        if speeds is None:
            return unbounded, memory
        xp, sections = namespace(unbounded), slice(self.first_section, self.last_section + 1)
        speed_ahead = speeds[..., sections].mean(-1)
        rate = 0.0 if state.penetration_rate is None else state.penetration_rate
        cap = clamp_min(speed_ahead + self.speed_margin + self.margin_by_penetration * rate, self.min_speed)
        cap = xp.minimum(cap, state.allowed_speed)
        capped = clamp_min((cap - state.speed) / self.time_constant, -self.max_deceleration)
        if state.distance_to_merge is not None:
            has_cap = state.distance_to_merge > 0.0
            if self.free_speed_ratio is not None:
                has_cap = has_cap & (speed_ahead < self.free_speed_ratio * state.allowed_speed)
        elif state.congestion is not None:
            is_congested = (state.congestion[..., sections] >= MIN_REPORTED_CONGESTION).any(-1)
            has_cap = is_congested & (speed_ahead < self.jam_speed_ratio * state.allowed_speed)
        else:
            return unbounded, memory
        return xp.where(has_cap, capped, unbounded), memory


@parameter_dataclass(frozen=True, config=STRICT)
class GapMaker(JamAhead):
    """Drives as `jam-ahead`, with a longer time gap shortly before a merge if there are vehicles on its right.

    Vehicles from the ramp, or from the lane next to it, can then merge without a vehicle that must brake. The CAV must
    have its own ACC. Based on cooperative merging, as in Scarinci and Heydecker 2014, Transp. Rev. 34:775-797.
    """

    name: ClassVar[str] = "gap-maker"
    class_requirements: ClassVar[Requirements] = JamAhead.class_requirements._replace(
        used_fields=JamAhead.class_requirements.used_fields | {"adjacent_gaps"}
    )

    merge_time_gap: Positive = 2.0
    """time gap while the CAV opens a gap [s]"""
    upstream_distance: NonNegative = 300.0
    """distance before the merge from which on the CAV opens gaps [m]"""
    downstream_distance: NonNegative = 0.0
    """distance after the merge up to which the CAV opens gaps [m]; there the ramp's lane runs next to the road"""
    max_neighbor_gap: Positive = 40.0
    """gap to a vehicle on the right, ahead or behind, below which the CAV opens a gap [m]"""

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return `merge_time_gap` for CAVs that open a gap, else NaN [s]."""
        gaps, distance = state.adjacent_gaps, state.distance_to_merge
        if gaps is None or distance is None:
            return None
        has_neighbor = (gaps[..., 2:] < self.max_neighbor_gap).any(-1)
        opens_gap = has_neighbor & (distance > -self.downstream_distance) & (distance < self.upstream_distance)
        zero = state.speed * 0.0
        return namespace(zero).where(opens_gap, zero + self.merge_time_gap, zero + nan)
