"""Could cars and people have done that? The physics of all vehicles, in every simulation step."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.physics.arrays import Floats

BRAKING_THRESHOLDS = (3.5, 4.5, 9.0)
"""brakings that are counted [m/s2]: ISO 15622's above 20 m/s, a hard one, and what dry asphalt allows"""
BRAKING_TOLERANCE = 1e-6
"""of a braking [m/s2]"""
OVERRIDE_TOLERANCE = 1e-4
"""by how much SUMO changes a command that it lets pass: it takes some micrometres beyond the smallest gap for
none, and holds who would creep there [m/s2]"""
MIN_TIME_GAP_SPEED = 1.0
"""speed above which a time headway is a matter of safety [m/s]"""
SHORT_TIME_GAP = 1.0
"""[s]"""
HUMAN_DRIVER, CAV_DRIVER, CAV_AFTER_CUT_IN = 0, 1, 2
"""whose braking it is; the last: of a CAV just after somebody else came before it"""
CUT_IN_SECONDS = 3.0
"""time after a change of leader in which braking is counted apart [s]"""
STEADY_FOLLOWING_SECONDS = 5.0
"""time behind the same leader in which nothing is counted of how a CAV follows [s]"""
BRAKING_BLOCK_STEPS = 1000
"""steps that are counted together: one by one takes longer than they take to drive"""


@dataclass(frozen=True)
class BrakingStatistics:
    """How hard some vehicles braked; a moment is one vehicle in one simulation step."""

    max_braking: float = 0.0
    """[m/s2]; zero where nobody braked"""
    exceedances: tuple[int, ...] = (0,) * len(BRAKING_THRESHOLDS)
    """moments with more than each of BEYOND"""
    samples: int = 0

    def __add__(self, other: "BrakingStatistics") -> "BrakingStatistics":
        """Return how hard the vehicles of both braked."""
        beyond = tuple(sum(both) for both in zip(self.exceedances, other.exceedances, strict=True))
        return BrakingStatistics(max(self.max_braking, other.max_braking), beyond, self.samples + other.samples)


@dataclass(frozen=True)
class FollowingStatistics:
    """How the CAVs followed those ahead, over all simulation steps."""

    min_time_gap: float = np.inf
    """smallest time gap while faster than 1 m/s, recovery after cut-ins excluded [s]"""
    min_time_to_collision: float = np.inf
    """smallest gap over closing speed [s]"""
    max_required_braking: float = 0.0
    """largest deceleration rate to avoid a crash, closing speed squared over twice the gap [m/s2]"""
    share_short_time_gap: float = 0.0
    """share of the time faster than 1 m/s with a time gap below one second, recovery excluded likewise"""
    max_jerk: float = 0.0
    """largest change of acceleration over time [m/s3]"""
    override_share: float = 0.0
    """share of the commands that SUMO's safety check changed, but for the right of way"""
    yield_share: float = 0.0
    """share of the commands that SUMO changed near a crossing, where vehicles yield"""


@dataclass(frozen=True)
class Audit:
    """The physics of an episode."""

    human_braking: BrakingStatistics = field(default_factory=BrakingStatistics)
    cav_braking: BrakingStatistics = field(default_factory=BrakingStatistics)
    following: FollowingStatistics = field(default_factory=FollowingStatistics)
    required_time_gap: float = 0.0
    """time headway that was demanded of CAVs [s]"""
    has_lanes: bool = False
    """whether others may cut in: `following` is then of those who follow the same for long"""
    cut_in_braking: BrakingStatistics = field(default_factory=BrakingStatistics)
    """how hard CAVs braked just after somebody else came before them; not part of `cavs`"""


def braking_statistics(accelerations: Any) -> BrakingStatistics:
    """Return how hard vehicles braked whose accelerations those are [m/s2], any shape."""
    all_of_them = np.asarray(accelerations, np.float64).ravel()
    if not all_of_them.size:
        return BrakingStatistics()
    hard = all_of_them[all_of_them < -BRAKING_THRESHOLDS[0]]
    beyond = tuple(int((hard < -limit - BRAKING_TOLERANCE).sum()) for limit in BRAKING_THRESHOLDS)
    return BrakingStatistics(float(max(0.0, -all_of_them.min())), beyond, all_of_them.size)


class BrakingLog:
    """Counts how hard several kinds of vehicles brake, step by step; hours of them need no more memory."""

    def __init__(self, step: float) -> None:
        """Begin with nothing; what is noted are changes of speed in `step` seconds."""
        self._step, self._statistics = step, dict[int, BrakingStatistics]()
        self._speed_changes: list[Floats] = []
        self._driver_kinds: list[NDArray[np.uint8]] = []

    def add(self, speed_changes: Floats, driver_kinds: NDArray[np.uint8]) -> None:
        """Note how the speeds of n vehicles changed [m/s], and of which kind each is: shape (n,)."""
        self._speed_changes.append(speed_changes)
        self._driver_kinds.append(driver_kinds)
        if len(self._speed_changes) == BRAKING_BLOCK_STEPS:
            self._count_block()

    def statistics(self, driver_kind: int) -> BrakingStatistics:
        """Return how hard those of a kind braked so far."""
        self._count_block()
        return self._statistics.get(driver_kind, BrakingStatistics())

    def _count_block(self) -> None:
        if not self._speed_changes:
            return
        accelerations, whose = np.concatenate(self._speed_changes) / self._step, np.concatenate(self._driver_kinds)
        for kind in np.unique(whose).tolist():
            self._statistics[kind] = self._statistics.get(kind, BrakingStatistics()) + braking_statistics(
                accelerations[whose == kind]
            )
        self._speed_changes.clear()
        self._driver_kinds.clear()


class FollowingPair(NamedTuple):
    """A CAV and its leader in a simulation step: numbers, or arrays with an element for each of n CAVs."""

    speed: Any
    """of the CAV [m/s]"""
    leader_speed: Any
    """[m/s]"""
    gap: Any
    """net gap [m]"""


def is_recovering(was_recovering: Any, time_behind_leader: Any, previous: FollowingPair, current: FollowingPair) -> Any:
    """Return whether a CAV still recovers from a change of its leader: a short time gap that opens.

    Another vehicle that cuts in determines the first time gap, not the CAV. The CAV recovers as long as the
    time gap to this leader has been short ever since and, after the first 5 s, increases in each step or the
    leader is faster. Recovery that has ended does not begin again behind the same leader.
    Source: UN Regulation No. 157, 5.2.3.3, which lets a vehicle that cannot respect the minimum time gap
    because of other road users restore it at the next opportunity without harsh braking.

    Args:
        was_recovering: whether the CAV was recovering in the previous step.
        time_behind_leader: time since it has this leader [s]; zero in the first step, whatever was before.
        previous: the CAV and this leader in the previous step.
        current: both in this step.
    """
    is_short = (current.speed > MIN_TIME_GAP_SPEED) & (current.gap < SHORT_TIME_GAP * current.speed)
    opens = (current.leader_speed > current.speed) | (current.gap * previous.speed > previous.gap * current.speed)
    return is_short & (
        (time_behind_leader <= 0.0) | (was_recovering & (opens | (time_behind_leader <= STEADY_FOLLOWING_SECONDS)))
    )


def following_statistics(
    speed: Floats,
    leader_speed: Floats,
    gap: Floats,
    step: float,
    overridden: Any = (),
    yielding: Any = (),
    recovering: Any = False,
) -> FollowingStatistics:
    """Return how CAVs followed; arrays of shape (moments, CAVs) one `step` apart, NaN where one is not there.

    `override_share` says which commands SUMO changed, `yielding` which were given near a crossing; any shape.
    Moments of `recovering` CAVs, as `is_recovering` finds them, do not count for time gaps.
    Sources: TTC after Hayward 1972; DRAC after Almqvist et al. 1991; SAE J2944.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        moving, closing = speed > MIN_TIME_GAP_SPEED, speed - leader_speed
        headways = (gap / speed)[moving & ~np.asarray(recovering, bool)]
        nearing = (closing > 0) & (gap > 0)
        times, needed = (gap / closing)[nearing], (closing**2 / (2.0 * gap))[nearing]
        jerks = np.abs(np.diff(speed, 2, axis=0)) / step**2
    return FollowingStatistics(
        min_time_gap=float(headways.min(initial=np.inf)),
        min_time_to_collision=0.0 if (gap <= 0).any() else float(times.min(initial=np.inf)),
        max_required_braking=float(needed.max(initial=0.0)),
        share_short_time_gap=_share(headways < SHORT_TIME_GAP),
        max_jerk=float(np.nanmax(jerks, initial=0.0)),
        override_share=_share(np.asarray(overridden, bool) & ~np.asarray(yielding, bool)),
        yield_share=_share(np.asarray(overridden, bool) & np.asarray(yielding, bool)),
    )


def _share(flags: NDArray[np.bool_]) -> float:
    """Return the share of what is true; zero of nothing."""
    return float(flags.mean()) if flags.size else 0.0
