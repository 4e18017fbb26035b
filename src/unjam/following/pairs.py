"""What is known of how people drive: one follower behind one leader; and what was found in a file."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.local_state import MAX_OBSERVED_GAP, LocalState
from unjam.errors import invalid_value
from unjam.physics.arrays import Floats
from unjam.physics.kinematics import distance_driven, next_position

SPLITS = ("train", "validation", "test")
SEGMENT_FIELDS = ("speed", "leader_speed", "gap", "leader_path")
"""of a `Pair`, what stretches have side by side"""
MIN_PAIR_SECONDS = 20.0
"""drives behind a CAV that are shorter tell too little [s]"""
MAX_GAP_JUMP = 0.5
"""change of the gap in a decision that speeds do not explain, beyond which another vehicle is behind [m]"""
MAX_LISTED_ROWS = 5
"""bad rows that a message names"""


@dataclass(frozen=True, eq=False)
class Pair:
    """How one driver followed one leader; T evenly spaced moments."""

    name: str
    """of this trajectory, unlike that of any other"""
    driver: str
    """who followed; several trajectories may be of one driver"""
    step: float
    """time between two moments [s]"""
    speed: Floats = field(repr=False)
    """of the follower [m/s], shape (T,)"""
    leader_speed: Floats = field(repr=False)
    """[m/s], shape (T,)"""
    gap: Floats = field(repr=False)
    """from the follower's front bumper to the leader's rear bumper [m], shape (T,)"""
    kind: str = ""
    """of driver, where the data say it: `human`, `ACC`"""
    split: str = ""
    """to which part of a published split it belongs, where there is one"""

    @property
    def seconds(self) -> float:
        """How long it lasts [s]."""
        return (len(self.speed) - 1) * self.step

    @cached_property
    def acceleration(self) -> Floats:
        """Between each moment and the next, as an Euler step has it [m/s2], shape (T - 1,)."""
        return np.diff(self.speed) / self.step

    @cached_property
    def leader_path(self) -> Floats:
        """Where the leader's rear bumper is, from where the follower's front began [m], shape (T,).

        The follower's way by Euler steps, plus the gap: so a follower that drives as this one did keeps
        exactly the recorded gap, whatever errors there are in the leader's speed.
        """
        way = next_position(np.zeros(len(self.speed)), np.r_[0.0, np.cumsum(self.speed[1:])], self.step)
        return self.gap + way

    def part(self, first: int, last: int) -> "Pair":
        """Return the moments from `first` on and before `last` as a trajectory of its own."""
        cut = {each: getattr(self, each)[first:last] for each in ("speed", "leader_speed", "gap")}
        return replace(self, **cut)


@dataclass(frozen=True, eq=False)
class FollowingSamples:
    """Single moments, without what came before; n of them."""

    speed: Floats
    leader_speed: Floats
    gap: Floats
    acceleration: Floats
    """until the next moment [m/s2]"""

    def __len__(self) -> int:
        return len(self.speed)

    @property
    def inputs(self) -> tuple[Floats, Floats, Floats]:
        """What a driver sees: own speed, leader's speed and gap."""
        return self.speed, self.leader_speed, self.gap

    def select(self, indices: NDArray[np.int64]) -> "FollowingSamples":
        """Return the chosen moments."""
        return FollowingSamples(*(values[indices] for values in vars(self).values()))


def following_samples(pairs: Sequence[Pair]) -> FollowingSamples:
    """Return all moments of `pairs` but the last of each, one after the other."""

    def concatenate(name: str) -> Floats:
        return np.concatenate([getattr(pair, name)[: len(pair.acceleration)] for pair in pairs])

    return FollowingSamples(
        concatenate("speed"), concatenate("leader_speed"), concatenate("gap"), concatenate("acceleration")
    )


@dataclass(frozen=True, eq=False)
class Segments:
    """Trajectories side by side, of up to T moments; the first index is time. n stretches."""

    speed: Floats = field(repr=False)
    """[m/s], shape (T, n); past the end of a stretch its last value"""
    leader_speed: Floats = field(repr=False)
    gap: Floats = field(repr=False)
    leader_path: Floats = field(repr=False)
    """of `Pair`"""
    is_present: NDArray[np.bool_] = field(repr=False)
    """whether the stretch lasts that long, shape (T, n)"""
    step: float
    """[s]"""
    pair_index: NDArray[np.int64] = field(repr=False)
    """which pair each stretch is of, shape (n,)"""

    @cached_property
    def sample_counts(self) -> NDArray[np.int64]:
        """Moments of each stretch but the first, shape (n,)."""
        return self.is_present[1:].sum(0)

    @property
    def start(self) -> tuple[Floats, Floats]:
        """Speed and gap at the first moment, shape (n,)."""
        return self.speed[0], self.gap[0]

    @property
    def leader(self) -> tuple[Floats, Floats]:
        """Speeds and paths of the leaders, shape (T, n)."""
        return self.leader_speed, self.leader_path

    def select(self, indices: NDArray[np.int64]) -> "Segments":
        """Return the chosen stretches, as long as the longest of them."""
        long = int(self.is_present[:, indices].sum(0).max())
        cut = {name: getattr(self, name)[:long, indices] for name in (*SEGMENT_FIELDS, "is_present")}
        return replace(self, **cut, pair_index=self.pair_index[indices])


def make_segments(pairs: Sequence[Pair], segment_seconds: float | None = None) -> Segments:
    """Return `pairs` side by side, cut into stretches of `seconds`, the last of each as long as it is.

    None: each pair whole. What is left at an end and shorter than two moments is not there.

    Raises:
        InputError: the pairs have different time steps.
    """
    steps = {pair.step for pair in pairs}
    if len(steps) != 1:
        raise invalid_value("time step", sorted(steps), "one and the same in all trajectories [s]")
    (step,) = steps
    parts: list[Pair] = []
    owner: list[int] = []
    for number, pair in enumerate(pairs):
        length = len(pair.speed) if segment_seconds is None else round(segment_seconds / step) + 1
        for first in range(0, len(pair.speed) - 1, max(1, length - 1)):
            parts.append(pair.part(first, first + length))
            owner.append(number)
    lengths = np.array([len(part.speed) for part in parts])
    longest = int(lengths.max())

    def stack(name: str) -> Floats:
        columns = [getattr(part, name) for part in parts]
        return np.stack([np.pad(column, (0, longest - len(column)), mode="edge") for column in columns], 1)

    return Segments(
        **{name: stack(name) for name in SEGMENT_FIELDS},
        is_present=np.arange(longest)[:, None] < lengths,
        step=step,
        pair_index=np.array(owner),
    )


def split_by_driver(pairs: Sequence[Pair], shares: Sequence[float], seed: int) -> list[Pair]:
    """Return `pairs` with `split` set to train, validation or test; all pairs of a driver go together.

    `penetration_rates` are those of training, validation and test in the number of drivers; they add up to one.
    """
    drivers = sorted({pair.driver for pair in pairs})
    order = np.random.default_rng(seed).permutation(len(drivers))
    borders = np.round(np.cumsum(shares) * len(drivers)).astype(int)
    places = np.searchsorted(borders, np.argsort(order), side="right").clip(max=len(SPLITS) - 1)
    split = {driver: SPLITS[place] for driver, place in zip(drivers, places, strict=True)}
    return [replace(pair, split=split[pair.driver]) for pair in pairs]


def pairs_in_splits(pairs: Sequence[Pair], *splits: str) -> list[Pair]:
    """Return the pairs of these parts of the split."""
    return [pair for pair in pairs if pair.split in splits]


def pairs_behind_cavs(
    recordings: Iterable[LocalState], control_step: float, steps_per_control_step: int = 1
) -> list[Pair]:
    """Return the drives of those who followed a CAV, each of the same vehicle throughout.

    `recordings` are what CAVs perceived, each of shape (T,), a decision every `step` [s], of so many `steps`
    of the simulation.
    """
    pairs = []
    for number, states in enumerate(recordings):
        largest = np.where(np.isnan(states.loop_length), MAX_OBSERVED_GAP, states.loop_length)
        nobody = states.follower_gap >= largest
        ahead, behind = (
            distance_driven(speed[:-1], speed[1:], control_step / steps_per_control_step, steps_per_control_step)
            for speed in (states.speed, states.follower_speed)
        )
        expected = states.follower_gap[:-1] + ahead - behind
        other = np.abs(states.follower_gap[1:] - expected) > MAX_GAP_JUMP
        ends = np.flatnonzero(np.r_[True, other | nobody[1:] | nobody[:-1], True])
        for first, last in pairwise(ends):
            if (last - first) * control_step >= MIN_PAIR_SECONDS:
                seen = (states.follower_speed, states.speed, states.follower_gap)
                own, leader, gap = (np.asarray(values[first:last], np.float64) for values in seen)
                name = f"{number}-{first}"
                pairs.append(Pair(name, name, control_step, own, leader, gap))
    return pairs


@dataclass(frozen=True)
class ReadOptions:
    """How a file is read."""

    drop_bad_rows: bool = False
    """whether bad rows are cut out, and end their trajectory, instead of refused"""
    min_seconds: float = 20.0
    """trajectories shorter than that are left out, and counted [s]"""
    driver_columns: tuple[str, ...] = ()
    """plain tables: columns that together name the driver, where `driver` is not one"""
    kind_columns: tuple[str, ...] = ()
    """plain tables: columns that together name the kind of driver, where `kind` is not one"""


@dataclass(frozen=True)
class BadRow:
    """A row that cannot be used."""

    line: int
    """in the file, its header being line 1"""
    reason: str


@dataclass(frozen=True)
class ReadResult:
    """What a file holds."""

    pairs: list[Pair] = field(repr=False)
    rows: int
    """in the file"""
    bad_rows: list[BadRow]
    """rows that were cut out, with what was wrong"""
    skipped_rows: dict[str, int]
    """rows that are not wrong but of no use, by reason"""

    def summary_lines(self) -> list[str]:
        """Return lines that say what was read and what was not."""
        moments = sum(len(pair.speed) for pair in self.pairs)
        lines = [f"{len(self.pairs)} trajectories with {moments:,} of {self.rows:,} rows"]
        lines += [f"left out: {count:,} rows: {why}" for why, count in self.skipped_rows.items() if count]
        lines += [f"cut out: line {row.line}: {row.reason}" for row in self.bad_rows[:MAX_LISTED_ROWS]]
        if len(self.bad_rows) > MAX_LISTED_ROWS:
            lines.append(f"cut out: {len(self.bad_rows) - MAX_LISTED_ROWS} more bad rows")
        return lines
