"""Audit of the physics of all vehicles in every simulation step: braking, time gaps, jerk."""

from collections import defaultdict
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.safety import FollowingState
from unjam.physics.arrays import Floats

BRAKING_THRESHOLDS = (3.5, 4.5, 9.0)
"""thresholds of braking [m/s2]: limit of ISO 15622 above 20 m/s, hard braking, and the limit on dry asphalt"""
BRAKING_TOLERANCE = 1e-6
"""rounding tolerance of these thresholds [m/s2]"""
OVERRIDE_TOLERANCE = 1e-4
"""largest change of a command that does not count as an override [m/s2]: SUMO stops creeping at the minimum gap"""
MIN_TIME_GAP_SPEED = 1.0
"""speed above which time gaps are evaluated [m/s]"""
SHORT_TIME_GAP = 1.0
"""time gap below which a step counts as short [s]"""
HUMAN_DRIVER, CAV_DRIVER, CAV_AFTER_CUT_IN = 0, 1, 2
"""kinds of drivers with separate braking statistics; the last kind is a CAV just after another vehicle cut in"""
CUT_IN_SECONDS = 3.0
"""time after a change of leader in which braking is counted separately [s]"""
STEADY_FOLLOWING_SECONDS = 5.0
"""time behind the same leader in which car following is not yet counted [s]"""
BRAKING_BLOCK_STEPS = 1000
"""number of steps that are counted together, because counting each step would take longer than simulating it"""


@dataclass(frozen=True)
class BrakingStatistics:
    """Statistics of the braking of several vehicles; a sample is one vehicle in one simulation step."""

    max_braking: float = 0.0
    """maximum braking [m/s2]; zero without braking"""
    exceedances: tuple[int, ...] = (0,) * len(BRAKING_THRESHOLDS)
    """number of samples beyond each of `BRAKING_THRESHOLDS`"""
    samples: int = 0

    def __add__(self, other: "BrakingStatistics") -> "BrakingStatistics":
        exceedances = tuple(sum(pair) for pair in zip(self.exceedances, other.exceedances, strict=True))
        return BrakingStatistics(max(self.max_braking, other.max_braking), exceedances, self.samples + other.samples)


@dataclass(frozen=True)
class FollowingStatistics:
    """Statistics of the CAVs' car following, over all simulation steps."""

    min_time_gap: float = np.inf
    """minimum time gap above 1 m/s, without recovery after cut-ins [s]"""
    min_time_to_collision: float = np.inf
    """minimum time to collision: gap over closing speed [s]"""
    max_required_braking: float = 0.0
    """maximum deceleration rate to avoid a crash: closing speed squared over twice the gap [m/s2]"""
    share_short_time_gap: float = 0.0
    """share of the time above 1 m/s with a time gap below 1 s, without recovery after cut-ins"""
    max_jerk: float = 0.0
    """maximum jerk [m/s3]"""
    override_share: float = 0.0
    """share of the commands that SUMO's safety check changed, except for the right of way"""
    yield_share: float = 0.0
    """share of the commands that SUMO changed near a crossing, where vehicles yield"""


@dataclass(frozen=True)
class Audit:
    """Braking of all vehicles and car following of the CAVs in an episode."""

    human_braking: BrakingStatistics = field(default_factory=BrakingStatistics)
    cav_braking: BrakingStatistics = field(default_factory=BrakingStatistics)
    following: FollowingStatistics = field(default_factory=FollowingStatistics)
    required_time_gap: float = 0.0
    """time gap that CAVs must keep [s]"""
    has_lanes: bool = False
    """whether vehicles can cut in; `following` then contains steady car following only"""
    cut_in_braking: BrakingStatistics = field(default_factory=BrakingStatistics)
    """braking of CAVs just after another vehicle cut in; not part of `cav_braking`"""


def braking_statistics(accelerations: Any) -> BrakingStatistics:
    """Return the braking statistics of accelerations [m/s2], any shape."""
    samples = np.asarray(accelerations, np.float64).ravel()
    if not samples.size:
        return BrakingStatistics()
    hard = samples[samples < -BRAKING_THRESHOLDS[0]]
    exceedances = tuple(int((hard < -limit - BRAKING_TOLERANCE).sum()) for limit in BRAKING_THRESHOLDS)
    return BrakingStatistics(float(max(0.0, -samples.min())), exceedances, samples.size)


class BrakingLog:
    """Counts the braking of each kind of driver step by step, with constant memory."""

    def __init__(self, step: float) -> None:
        self._step, self._statistics = step, defaultdict[int, BrakingStatistics](BrakingStatistics)
        self._block: list[tuple[Floats, NDArray[np.unsignedinteger]]] = []

    def add(self, speed_changes: Floats, driver_kinds: NDArray[np.unsignedinteger]) -> None:
        """Add the speed changes of n vehicles in one step [m/s], and their driver kinds: shape (n,)."""
        self._block.append((speed_changes, driver_kinds))
        if len(self._block) == BRAKING_BLOCK_STEPS:
            self._count_block()

    def statistics(self, driver_kind: int) -> BrakingStatistics:
        """Return the braking statistics of a driver kind so far."""
        self._count_block()
        return self._statistics[driver_kind]

    def _count_block(self) -> None:
        if self._block:
            speed_changes, kinds = (np.concatenate(parts) for parts in zip(*self._block, strict=True))
            order = np.argsort(kinds, kind="stable")  # a radix sort, fast for small integers
            present, starts = np.unique(kinds[order], return_index=True)
            for kind, changes in zip(present.tolist(), np.split(speed_changes[order], starts[1:]), strict=False):
                self._statistics[kind] += braking_statistics(changes / self._step)
            self._block.clear()


def is_recovering(was_recovering: Any, seconds: Any, previous: FollowingState, current: FollowingState) -> Any:
    """Return whether a CAV still recovers from a change of its leader: its time gap is short, but increases.

    In each step after the first 5 s, the time gap must increase, or the leader must be faster; a recovery that has
    ended does not start again. `seconds` is the time behind this leader; at zero, the values of the previous step,
    `was_recovering` and `previous`, are ignored. Source: UN Regulation No. 157, 5.2.3.3.
    """
    is_short = (current.speed > MIN_TIME_GAP_SPEED) & (current.gap < SHORT_TIME_GAP * current.speed)
    increases = (current.leader_speed > current.speed) | (current.gap * previous.speed > previous.gap * current.speed)
    return is_short & ((seconds <= 0.0) | (was_recovering & (increases | (seconds <= STEADY_FOLLOWING_SECONDS))))


def following_statistics(
    speed: Floats,
    leader_speed: Floats,
    gap: Floats,
    step: float,
    is_overridden: Any = (),
    is_yielding: Any = (),
    in_recovery: Any = False,
) -> FollowingStatistics:
    """Return statistics of speeds [m/s] and gaps [m]: shape (steps, CAVs), one `step` [s] apart, NaN without a CAV.

    `is_overridden` marks commands that SUMO changed, `is_yielding` those near a crossing. Time gaps `in_recovery` are
    not counted. Sources: TTC after Hayward 1972; DRAC after Almqvist et al. 1991; SAE J2944.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        is_moving, closing = speed > MIN_TIME_GAP_SPEED, speed - leader_speed
        time_gaps = (gap / speed)[is_moving & ~np.asarray(in_recovery, bool)]
        is_closing = (closing > 0) & (gap > 0)
        times_to_collision, required_braking = (gap / closing)[is_closing], (closing**2 / (2.0 * gap))[is_closing]
        jerks = np.abs(np.diff(speed, 2, axis=0)) / step**2
    overridden, yielding = np.asarray(is_overridden, bool), np.asarray(is_yielding, bool)
    return FollowingStatistics(
        min_time_gap=float(time_gaps.min(initial=np.inf)),
        min_time_to_collision=0.0 if (gap <= 0).any() else float(times_to_collision.min(initial=np.inf)),
        max_required_braking=float(required_braking.max(initial=0.0)),
        share_short_time_gap=_true_share(time_gaps < SHORT_TIME_GAP),
        max_jerk=float(np.nanmax(jerks, initial=0.0)),
        override_share=_true_share(overridden & ~yielding),
        yield_share=_true_share(overridden & yielding),
    )


def _true_share(flags: NDArray[np.bool_]) -> float:
    return float(flags.mean()) if flags.size else 0.0
