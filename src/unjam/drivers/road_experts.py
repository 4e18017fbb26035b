"""The experts of the figure eight, the merge and motorways: they know where they are, and what is ahead."""

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property
from math import nan
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from unjam.drivers.driver import FormulaDriver, Memory
from unjam.drivers.local_state import SECTIONS_AHEAD, LocalState, ScaledInput, lap_angle
from unjam.parameters import STRICT, NonNegative, Positive
from unjam.physics.arrays import Array, as_column, clamp_min, namespace

Harmonics = tuple[float, ...]
LapFraction = Annotated[float, Field(ge=0, lt=1)]
GATHERED_LAP_FRACTION, BROKEN_LAP_FRACTION = 0.5, 0.45
"""shares of the lap that are free ahead: once all have gathered behind, and when their queue is broken"""
MIN_PACE = 1.0
"""[m/s]: whoever stands still never gathers anybody"""
MAX_JAM_DISTANCE = 60.0
"""a jam farther away is not yet waited for [m]"""
FREE_ROAD_GAP = 99.0
"""gap from which on there is no leader [m]"""
MAX_OVERRUN = 50.0
"""[m] beyond `last_position`, where it waits no longer"""
UNBOUNDED_ACCELERATION = 100.0
"""acceleration that no ACC has: nothing holds it back [m/s2]"""
MIN_REPORTED_CONGESTION = 0.5
"""from which on a smoothed report says that a section is congested"""

SectionIndex = Annotated[int, Field(ge=0, lt=SECTIONS_AHEAD)]


def _tuned_pacer(harmonics: Harmonics, gap_gain: float, target_gap: float) -> dict[str, Any]:
    """Return the fields of a tuned pacer; all gather until half the lap is free."""
    gathering = {"gathering_gap": GATHERED_LAP_FRACTION, "regathering_gap": BROKEN_LAP_FRACTION}
    return {"harmonics": harmonics, "gap_gain": gap_gain, "target_gap": target_gap, **gathering}


TUNED_PACERS: dict[float, dict[str, Any]] = {
    422.2: _tuned_pacer((6.729, -2.092, 1.602, -0.929, 0.851, -0.096, 0.105), 0.051, 0.483),
    449.0: _tuned_pacer((7.449, -2.059, 1.966, -0.94, 0.791, -0.028, 0.01), 0.047, 0.509),
    462.5: _tuned_pacer((7.973, -1.865, 2.48, -0.422, 0.173, 0.027, 0.063), 0.038, 0.545),
    475.9: _tuned_pacer((8.35, -2.057, 3.128, 0.477, 0.086, -0.086, 0.075), 0.04, 0.552),
    489.3: _tuned_pacer((9.039, -1.791, 3.513, 1.051, 0.015, 0.024, 0.216), 0.044, 0.581),
}
"""what `use_tuned` uses, by the length of the lap [m], found by results/experts/tune_pacer.py.

Of the figure eight with radii 30, 32, 33, 34 and 35 m; at 34 m 0.1 m/s slower than what the search found,
which broke on one seed of ten.
"""


@dataclass(frozen=True, config=STRICT)
class Pacer(FormulaDriver):
    """Waits until all have gathered behind it, then leads them round at a pace that they can keep together.

    On the figure eight a queue that is longer than half a lap meets its own tail at the crossing. Driven
    slowly at first, the CAV collects everybody into one queue; then it drives a lap in `lap_time`, or at a
    pace that varies over the lap. It must know where it is on the road.
    """

    name: ClassVar[str] = "pacer"
    needs_loop: ClassVar[bool] = True
    memory_inputs: ClassVar[tuple[ScaledInput, ...]] = (ScaledInput("queue has gathered", 1.0, ""),)

    lap_time: Positive = 69.0
    """time for a lap [s]: 6.5 m/s at a radius of 32 m, 7.1 m/s at 35 m"""
    harmonics: Annotated[Harmonics, Field(max_length=9)] = ()
    """(V, a1, b1, a2, b2, ...) [m/s] instead of `lap_time`: pace V + a1 cos x + b1 sin x + a2 cos 2x + ...,
    where x is the place on the lap, 0 to 2 pi from its start"""
    gap_gain: NonNegative = 0.0
    """how much faster it drives for each metre of free road ahead beyond `target_gap` [1/s], and slower for
    each that lacks: a queue that has grown long may close up"""
    target_gap: LapFraction = 0.5
    """share of the lap that is free ahead at the pace itself"""
    use_tuned: bool = False
    """whether to use, instead of all this, what was found for the figure eight of the nearest radius"""
    gathering_speed: NonNegative = 2.0
    """speed while the others gather behind [m/s]"""
    gathering_gap: LapFraction = 0.4
    """share of the lap that must be free ahead before the pace begins"""
    regathering_gap: LapFraction = 0.0
    """share of the lap below which the queue counts as broken, and the others gather anew"""
    time_constant: Positive = 0.1
    """time over which the wanted speed is reached [s]"""

    @model_validator(mode="after")
    def _check_harmonics(self) -> "Pacer":
        if len(self.harmonics) % 2 == 0 and self.harmonics:
            raise ValueError(f"harmonics: {self.harmonics} is not allowed; allowed: an odd count, (V, a1, b1, ...)")
        return self

    def initial_memory(self, n: int) -> Memory:
        """Return that nobody has gathered yet."""
        return {"has_gathered": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the pace, and whether all have gathered by now."""
        if not self.use_tuned:
            return self._lead_queue(state, memory)
        loop = state.loop_length
        xp = namespace(loop)
        acceleration, gathered, nearest = loop * 0.0, loop * 0.0, loop * 0.0 + float("inf")
        for lap in self._nearest_laps(loop):
            found, after = self._tuned_pacers[lap].act(state, memory)
            closer = abs(loop - lap) < nearest
            acceleration = xp.where(closer, found, acceleration)
            gathered = xp.where(closer, after["has_gathered"], gathered)
            nearest = xp.where(closer, abs(loop - lap), nearest)
        return acceleration, {"has_gathered": gathered}

    def _nearest_laps(self, loop_length: Array) -> Iterable[float]:
        """Return the laps of those pacers that drive somebody; of tensors, which may be traced, all."""
        if isinstance(loop_length, float):
            return [min(self._tuned_pacers, key=lambda lap: abs(loop_length - lap))]
        if not isinstance(loop_length, np.ndarray):
            return self._tuned_pacers
        laps = np.array([*self._tuned_pacers])
        return laps[sorted(set(abs(laps[:, None] - loop_length).argmin(0).tolist()))].tolist()

    @cached_property
    def _tuned_pacers(self) -> dict[float, "Pacer"]:
        return {lap: replace(self, use_tuned=False, **values) for lap, values in TUNED_PACERS.items()}

    def _lead_queue(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        loop, free = state.loop_length, state.leader_gap
        xp = namespace(state.speed)
        ready, broken = free >= self.gathering_gap * loop, free < self.regathering_gap * loop
        gathered = xp.where(ready, free * 0.0 + 1.0, xp.where(broken, free * 0.0, memory["has_gathered"]))
        pace = self._pace(state) + self.gap_gain * (free - self.target_gap * loop)
        pace = clamp_min(pace, MIN_PACE)
        wanted = xp.where(gathered > 0.0, pace, free * 0.0 + self.gathering_speed)
        return (wanted - state.speed) / self.time_constant, {"has_gathered": gathered}

    def _pace(self, state: LocalState) -> Array:
        """Return the pace where the vehicles are, before what the free road ahead changes."""
        if not self.harmonics:
            return state.loop_length / self.lap_time
        xp = namespace(state.speed)
        mean, *rest = self.harmonics
        place = lap_angle(state)
        pace = place * 0.0 + mean
        for number, (cosine, sine) in enumerate(zip(rest[::2], rest[1::2], strict=True), start=1):
            pace = pace + cosine * xp.cos(number * place) + sine * xp.sin(number * place)
        return pace

    def memory_features(self, memory: Memory) -> Array:
        """Return whether all have gathered, shape (n, 1)."""
        return as_column(memory["has_gathered"])


@dataclass(frozen=True, config=STRICT)
class JamAbsorber(FormulaDriver):
    """Follows its leader linearly; where that one is caught in a jam, it crawls until there is room ahead.

    While it crawls less arrives at the bottleneck than leaves it, and the jam ahead of it dissolves; those
    behind it then pass at speed. It crawls only within a stretch before the bottleneck, so it must know its
    position along the road; where there is none it only follows. After jam-absorption driving, "slow in, fast
    out": Nishi et al. 2013, Transp. Res. B 50:116-129.
    """

    name: ClassVar[str] = "jam-absorber"
    memory_inputs: ClassVar[tuple[ScaledInput, ...]] = (ScaledInput("waits for the jam to dissolve", 1.0, ""),)

    jam_speed: NonNegative = 10.0
    """a leader slower than this is caught in a jam [m/s]"""
    crawl_speed: NonNegative = 3.5
    """speed while it waits [m/s]"""
    release_gap: Positive = 22.0
    """gap at which it may go on [m], where the leader is fast enough"""
    release_speed: NonNegative = 8.3
    """what is fast enough [m/s]"""
    first_position: float = -580.0
    """along the road, from where it may begin to wait [m]"""
    last_position: float = -270.0
    """up to where it may begin to wait [m]"""
    gap_gain: NonNegative = 0.25
    """acceleration for each metre of gap too much [1/s2]"""
    speed_gain: NonNegative = 1.2
    """acceleration for each m/s that the leader is faster [1/s]"""
    time_gap: NonNegative = 1.4
    """wanted gap over own speed [s]"""
    standstill_gap: NonNegative = 4.0
    """wanted gap of a standing vehicle [m]"""
    extra_acceleration: NonNegative = 0.0
    """acceleration besides [m/s2]; without a `gap_gain` it so closes up as far as the shield lets it"""

    def initial_memory(self, n: int) -> Memory:
        """Return that nobody waits."""
        return {"is_waiting": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration, and who waits from now on."""
        xp, zero = namespace(state.speed), state.speed * 0.0
        place, gap, ahead = state.route_position, state.leader_gap, state.leader_speed
        within = (place > self.first_position) & (place < self.last_position)
        jam = within & (ahead < self.jam_speed) & (gap < MAX_JAM_DISTANCE)
        waits = xp.where(jam, zero + 1.0, memory["is_waiting"])
        gone = ((gap >= self.release_gap) & (ahead >= self.release_speed)) | (gap >= FREE_ROAD_GAP)
        too_far = place > self.last_position + MAX_OVERRUN
        waits = xp.where(gone | too_far, zero, waits)
        excess = gap - self.standstill_gap - self.time_gap * state.speed
        follow = self.gap_gain * excess + self.speed_gain * (ahead - state.speed) + self.extra_acceleration
        crawl = xp.minimum(self.crawl_speed - state.speed, follow)
        return xp.where(waits > 0.0, crawl, follow), {"is_waiting": waits}

    def memory_features(self, memory: Memory) -> Array:
        """Return whether it waits, shape (n, 1)."""
        return as_column(memory["is_waiting"])


@dataclass(frozen=True, config=STRICT)
class Cruise(FormulaDriver):
    """Never holds the car back: where it has its own ACC, that one drives.

    What the ACC is like is the road's to say (`cruise.time_gap`, `cruise.acceleration`). Without an ACC
    it accelerates as hard as it may.
    """

    name: ClassVar[str] = "cruise"

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return an acceleration beyond what any ACC wants; nothing is remembered."""
        return state.speed * 0.0 + UNBOUNDED_ACCELERATION, memory


@dataclass(frozen=True, config=STRICT)
class JamAhead(FormulaDriver):
    """Upstream of a ramp or a jam, drives no faster than its own lane does a few hundred metres ahead.

    So it arrives at the tail of a jam hardly faster than the jam moves, keeps room for those who merge, and
    the jam ahead gets less than it lets go. Elsewhere, and where no message says how fast the road ahead is,
    its own ACC drives. It gives way to nobody on purpose: those behind pass where there are lanes.

    Where no map says where ramps join, it slows down only for sections that the roadside service reports as
    congested: dense free flow may be far slower than a road allows. Without such a report it never does.
    `congestion` is not in `told`: graphs and manifests describe the road with a map, which does not use it.
    """

    name: ClassVar[str] = "jam-ahead"
    accepts_floats: ClassVar[bool] = False
    required_fields: ClassVar[tuple[str, ...]] = (
        "allowed_speed",
        "distance_to_merge",
        "lane_speeds",
        "road_speeds",
        "penetration_rate",
    )

    first_section: SectionIndex = 0
    """first section ahead that counts, of 100 m each; 0 is the one that it is in"""
    last_section: SectionIndex = 4
    """last section ahead that counts"""
    speed_margin: float = -2.0
    """how much faster than the mean ahead it may drive where CAVs are few [m/s]"""
    margin_by_penetration: float = 20.0
    """what more it may, times the share of CAVs [m/s]: where they are many, the mean ahead is that of others
    who hold back, and each would be slower than the next"""
    min_speed: NonNegative = 5.0
    """it is never held back below this [m/s]"""
    max_deceleration: Positive = 1.5
    """largest braking for the sake of the cap [m/s2]"""
    all_lanes: bool = False
    """whether the mean is that of all lanes of the main road"""
    time_constant: Positive = 3.0
    """time over which the cap is reached [s]"""
    jam_speed_ratio: Positive = 0.75
    """share of what is allowed that the mean ahead must be below, too, where no map says where ramps join"""

    @model_validator(mode="after")
    def _check_section_order(self) -> "JamAhead":
        if self.last_section < self.first_section:
            raise ValueError(
                f"last_section: {self.last_section} is not allowed; allowed: >= first_section, {self.first_section}"
            )
        return self

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the cap, beyond any ACC's where there is none."""
        speeds = state.road_speeds if self.all_lanes else state.lane_speeds
        free = state.speed * 0.0 + UNBOUNDED_ACCELERATION
        if speeds is None:
            return free, memory
        ahead = speeds[..., self.first_section : self.last_section + 1].mean(-1)
        xp = namespace(free)
        share = 0.0 if state.penetration_rate is None else state.penetration_rate
        wanted = ahead + self.speed_margin + self.margin_by_penetration * share
        cap = xp.minimum(clamp_min(wanted, self.min_speed), state.allowed_speed)
        towards = clamp_min((cap - state.speed) / self.time_constant, -self.max_deceleration)
        if state.distance_to_merge is not None:
            return xp.where(state.distance_to_merge > 0.0, towards, free), memory
        if state.congestion is None:
            return free, memory
        congested = (state.congestion[..., self.first_section : self.last_section + 1] >= MIN_REPORTED_CONGESTION).any(
            -1
        )
        return xp.where(congested & (ahead < self.jam_speed_ratio * state.allowed_speed), towards, free), memory


@dataclass(frozen=True, config=STRICT)
class GapMaker(JamAhead):
    """As `jam-ahead`, and just before a ramp joins keeps a longer time headway while others are on its right.

    There somebody from the ramp, or from the lane that the ramp's vehicles push into, finds a gap without
    making anybody brake. It needs a car with an ACC of its own. After cooperative merging, as in Scarinci and
    Heydecker 2014, Transp. Rev. 34:775-797.
    """

    name: ClassVar[str] = "gap-maker"
    required_fields: ClassVar[tuple[str, ...]] = (*JamAhead.required_fields, "adjacent_gaps")

    merge_time_gap: Positive = 2.0
    """time headway while it makes room [s]"""
    upstream_distance: NonNegative = 300.0
    """how far before a ramp joins it begins [m]"""
    downstream_distance: NonNegative = 0.0
    """how far behind it it ends [m]: there the ramp's lane runs beside the road"""
    max_neighbor_gap: Positive = 40.0
    """gap to somebody on the right, ahead or behind, for whom it makes room [m]"""

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return the time headway of those who make room [s], NaN for the others."""
        if state.adjacent_gaps is None or state.distance_to_merge is None:
            return None
        xp, beside = namespace(state.speed), state.adjacent_gaps[..., 2:]
        somebody = (beside < self.max_neighbor_gap).any(-1)
        makes = (
            somebody
            & (state.distance_to_merge > -self.downstream_distance)
            & (state.distance_to_merge < self.upstream_distance)
        )
        zero = state.speed * 0.0
        return xp.where(makes, zero + self.merge_time_gap, zero + nan)
