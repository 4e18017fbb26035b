"""Could cars and people have done that? The physics of all vehicles, in every simulation step."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.physics.arrays import Floats

BEYOND = (3.5, 4.5, 9.0)
"""brakings that are counted [m/s2]: ISO 15622's above 20 m/s, a hard one, and what dry asphalt allows"""
ROUNDING = 1e-6
"""of a braking [m/s2]"""
SHIELD_ROUNDING = 1e-4
"""by how much SUMO changes a command that it lets pass: it takes some micrometres beyond the smallest gap for
none, and holds who would creep there [m/s2]"""
MOVING_SPEED = 1.0
"""speed above which a time headway is a matter of safety [m/s]"""
SHORT_HEADWAY = 1.0
"""[s]"""
PEOPLE, CAV, CAV_CUT_IN = 0, 1, 2
"""whose braking it is; the last: of a CAV just after somebody else came before it"""
CUT_IN = 3.0
"""time after a change of leader in which braking is counted apart [s]"""
SETTLED = 5.0
"""time behind the same leader in which nothing is counted of how a CAV follows [s]"""
NOTED_AT_ONCE = 1000
"""steps that are counted together: one by one takes longer than they take to drive"""


@dataclass(frozen=True)
class Brakings:
    """How hard some vehicles braked; a moment is one vehicle in one simulation step."""

    hardest: float = 0.0
    """[m/s2]; zero where nobody braked"""
    beyond: tuple[int, ...] = (0,) * len(BEYOND)
    """moments with more than each of BEYOND"""
    moments: int = 0

    def __add__(self, other: "Brakings") -> "Brakings":
        """Return how hard the vehicles of both braked."""
        beyond = tuple(sum(both) for both in zip(self.beyond, other.beyond, strict=True))
        return Brakings(max(self.hardest, other.hardest), beyond, self.moments + other.moments)


@dataclass(frozen=True)
class Following:
    """How the CAVs followed those ahead, over all simulation steps."""

    headway: float = np.inf
    """smallest time gap while faster than 1 m/s, recovery after cut-ins excluded [s]"""
    time_to_collision: float = np.inf
    """smallest gap over closing speed [s]"""
    needed_braking: float = 0.0
    """largest deceleration rate to avoid a crash, closing speed squared over twice the gap [m/s2]"""
    share_short: float = 0.0
    """share of the time faster than 1 m/s with a time gap below one second, recovery excluded likewise"""
    jerk: float = 0.0
    """largest change of acceleration over time [m/s3]"""
    overridden: float = 0.0
    """share of the commands that SUMO's safety check changed, but for the right of way"""
    yielded: float = 0.0
    """share of the commands that SUMO changed near a crossing, where vehicles yield"""


@dataclass(frozen=True)
class Audit:
    """The physics of an episode."""

    people: Brakings = field(default_factory=Brakings)
    cavs: Brakings = field(default_factory=Brakings)
    following: Following = field(default_factory=Following)
    floor: float = 0.0
    """time headway that was demanded of CAVs [s]"""
    lanes: bool = False
    """whether others may cut in: `following` is then of those who follow the same for long"""
    cut_in: Brakings = field(default_factory=Brakings)
    """how hard CAVs braked just after somebody else came before them; not part of `cavs`"""


def brakings(accelerations: Any) -> Brakings:
    """Return how hard vehicles braked whose accelerations those are [m/s2], any shape."""
    all_of_them = np.asarray(accelerations, np.float64).ravel()
    if not all_of_them.size:
        return Brakings()
    hard = all_of_them[all_of_them < -BEYOND[0]]
    beyond = tuple(int((hard < -limit - ROUNDING).sum()) for limit in BEYOND)
    return Brakings(float(max(0.0, -all_of_them.min())), beyond, all_of_them.size)


class BrakingLog:
    """Counts how hard several kinds of vehicles brake, step by step; hours of them need no more memory."""

    def __init__(self, step: float) -> None:
        """Begin with nothing; what is noted are changes of speed in `step` seconds."""
        self._step, self._found = step, dict[int, Brakings]()
        self._changes: list[Floats] = []
        self._whose: list[NDArray[np.uint8]] = []

    def note(self, changes: Floats, whose: NDArray[np.uint8]) -> None:
        """Note how the speeds of n vehicles changed [m/s], and of which kind each is: shape (n,)."""
        self._changes.append(changes)
        self._whose.append(whose)
        if len(self._changes) == NOTED_AT_ONCE:
            self._count()

    def of(self, kind: int) -> Brakings:
        """Return how hard those of a kind braked so far."""
        self._count()
        return self._found.get(kind, Brakings())

    def _count(self) -> None:
        if not self._changes:
            return
        accelerations, whose = np.concatenate(self._changes) / self._step, np.concatenate(self._whose)
        for kind in np.unique(whose).tolist():
            self._found[kind] = self._found.get(kind, Brakings()) + brakings(accelerations[whose == kind])
        self._changes.clear()
        self._whose.clear()


class Pair(NamedTuple):
    """A CAV and its leader in a simulation step: numbers, or arrays with an element for each of n CAVs."""

    speed: Any
    """of the CAV [m/s]"""
    leader_speed: Any
    """[m/s]"""
    gap: Any
    """net gap [m]"""


def is_recovering(recovered_so_far: Any, lasts: Any, before: Pair, now: Pair) -> Any:
    """Return whether a CAV still recovers from a change of its leader: a short time gap that opens.

    Another vehicle that cuts in determines the first time gap, not the CAV. The CAV recovers as long as the
    time gap to this leader has been short ever since and, after the first 5 s, increases in each step or the
    leader is faster. Recovery that has ended does not begin again behind the same leader.
    Source: UN Regulation No. 157, 5.2.3.3, which lets a vehicle that cannot respect the minimum time gap
    because of other road users restore it at the next opportunity without harsh braking.

    Args:
        recovered_so_far: whether the CAV was recovering in the step before.
        lasts: time since it has this leader [s]; zero in the first step, whatever was before.
        before: the CAV and this leader in the step before.
        now: both now.
    """
    is_short = (now.speed > MOVING_SPEED) & (now.gap < SHORT_HEADWAY * now.speed)
    opens = (now.leader_speed > now.speed) | (now.gap * before.speed > before.gap * now.speed)
    return is_short & ((lasts <= 0.0) | (recovered_so_far & (opens | (lasts <= SETTLED))))


def following(
    speed: Floats,
    leader_speed: Floats,
    gap: Floats,
    step: float,
    overridden: Any = (),
    yielding: Any = (),
    recovering: Any = False,
) -> Following:
    """Return how CAVs followed; arrays of shape (moments, CAVs) one `step` apart, NaN where one is not there.

    `overridden` says which commands SUMO changed, `yielding` which were given near a crossing; any shape.
    Moments of `recovering` CAVs, as `is_recovering` finds them, do not count for time gaps.
    Sources: TTC after Hayward 1972; DRAC after Almqvist et al. 1991; SAE J2944.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        moving, closing = speed > MOVING_SPEED, speed - leader_speed
        headways = (gap / speed)[moving & ~np.asarray(recovering, bool)]
        nearing = (closing > 0) & (gap > 0)
        times, needed = (gap / closing)[nearing], (closing**2 / (2.0 * gap))[nearing]
        jerks = np.abs(np.diff(speed, 2, axis=0)) / step**2
    return Following(
        headway=float(headways.min(initial=np.inf)),
        time_to_collision=0.0 if (gap <= 0).any() else float(times.min(initial=np.inf)),
        needed_braking=float(needed.max(initial=0.0)),
        share_short=_share(headways < SHORT_HEADWAY),
        jerk=float(np.nanmax(jerks, initial=0.0)),
        overridden=_share(np.asarray(overridden, bool) & ~np.asarray(yielding, bool)),
        yielded=_share(np.asarray(overridden, bool) & np.asarray(yielding, bool)),
    )


def _share(there: NDArray[np.bool_]) -> float:
    """Return the share of what is true; zero of nothing."""
    return float(there.mean()) if there.size else 0.0
