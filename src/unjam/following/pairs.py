"""Car-following data: pairs of one follower and one leader, their samples and segments, and the content of files."""

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
"""fields of a `Pair` that segments stack"""
MIN_PAIR_SECONDS = 20.0
"""minimum duration of a pair behind a CAV; shorter ones contain too little information [s]"""
MAX_GAP_JUMP = 0.5
"""change of the gap in a control step beyond that of the speeds, above which the follower is another vehicle [m]"""
MAX_LISTED_ROWS = 5
"""bad rows that a message lists"""


@dataclass(frozen=True, eq=False)
class Pair:
    """A trajectory of one driver behind one leader; T evenly spaced moments."""

    name: str
    """unique name of the trajectory"""
    driver: str
    """the follower; several trajectories may have the same driver"""
    step: float
    """time between two moments [s]"""
    speed: Floats = field(repr=False)
    """of the follower [m/s], shape (T,)"""
    leader_speed: Floats = field(repr=False)
    """[m/s], shape (T,)"""
    gap: Floats = field(repr=False)
    """from the follower's front bumper to the leader's rear bumper [m], shape (T,)"""
    kind: str = ""
    """of driver, if the data contain it: `human`, `ACC`"""
    split: str = ""
    """part of a published split, if there is one"""

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return (len(self.speed) - 1) * self.step

    @cached_property
    def acceleration(self) -> Floats:
        """Acceleration between each moment and the next as in an Euler step [m/s2], shape (T - 1,)."""
        return np.diff(self.speed) / self.step

    @cached_property
    def leader_path(self) -> Floats:
        """Position of the leader's rear bumper relative to the follower's initial front bumper [m], shape (T,).

        It is the follower's path in Euler steps plus the gap, so that a model that drives like the follower keeps
        exactly the recorded gap, regardless of errors in the leader's speed.
        """
        path = next_position(np.zeros(len(self.speed)), np.r_[0.0, np.cumsum(self.speed[1:])], self.step)
        return self.gap + path

    def part(self, first: int, last: int) -> "Pair":
        """Return the moments from `first` to before `last` as a trajectory."""
        return replace(self, **{name: getattr(self, name)[first:last] for name in ("speed", "leader_speed", "gap")})


@dataclass(frozen=True, eq=False)
class FollowingSamples:
    """Single moments of car following without a history; n of them."""

    speed: Floats
    leader_speed: Floats
    gap: Floats
    acceleration: Floats
    """until the next moment [m/s2]"""

    def __len__(self) -> int:
        return len(self.speed)

    @property
    def inputs(self) -> tuple[Floats, Floats, Floats]:
        """The inputs of a driver: own speed, leader speed and gap."""
        return self.speed, self.leader_speed, self.gap

    def select(self, indices: NDArray[np.int64]) -> "FollowingSamples":
        """Return some of the samples."""
        return FollowingSamples(*(values[indices] for values in vars(self).values()))


def following_samples(pairs: Sequence[Pair]) -> FollowingSamples:
    """Return all moments of `pairs` except the last of each, concatenated."""
    columns = [(each.speed[:-1], each.leader_speed[:-1], each.gap[:-1], each.acceleration) for each in pairs]
    return FollowingSamples(*map(np.concatenate, zip(*columns, strict=True)))


@dataclass(frozen=True, eq=False)
class Segments:
    """Parts of trajectories in columns; n segments of up to T moments."""

    speed: Floats = field(repr=False)
    """[m/s], shape (T, n); after the end of a segment its last value"""
    leader_speed: Floats = field(repr=False)
    gap: Floats = field(repr=False)
    leader_path: Floats = field(repr=False)
    """of `Pair`"""
    is_present: NDArray[np.bool_] = field(repr=False)
    """whether the segment lasts that long, shape (T, n)"""
    step: float
    """[s]"""
    pair_index: NDArray[np.int64] = field(repr=False)
    """index of the pair of each segment, shape (n,)"""

    @cached_property
    def sample_counts(self) -> NDArray[np.int64]:
        """Number of moments of each segment after the first, shape (n,)."""
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
        """Return some of the segments, cut to the longest of them."""
        length = int(self.is_present[:, indices].sum(0).max())
        columns = {name: getattr(self, name)[:length, indices] for name in (*SEGMENT_FIELDS, "is_present")}
        return replace(self, **columns, pair_index=self.pair_index[indices])


def make_segments(pairs: Sequence[Pair], segment_seconds: float | None = None) -> Segments:
    """Return `pairs` cut into segments of `segment_seconds`, the last of each pair shorter; None: whole pairs.

    Raises:
        InputError: the pairs have different time steps.
    """
    steps = {pair.step for pair in pairs}
    if len(steps) != 1:
        raise invalid_value("time step", sorted(steps), "the same in all trajectories [s]")
    (step,) = steps
    parts, pair_index = list[Pair](), list[int]()
    for number, pair in enumerate(pairs):
        length = len(pair.speed) if segment_seconds is None else round(segment_seconds / step) + 1
        for first in range(0, len(pair.speed) - 1, max(1, length - 1)):
            parts.append(pair.part(first, first + length))
            pair_index.append(number)
    lengths = np.array([len(part.speed) for part in parts])
    longest = int(lengths.max())

    def stack(name: str) -> Floats:
        columns = (getattr(part, name) for part in parts)
        return np.stack([np.pad(column, (0, longest - len(column)), mode="edge") for column in columns], 1)

    is_present = np.arange(longest)[:, None] < lengths
    speed, leader_speed, gap, leader_path = map(stack, SEGMENT_FIELDS)
    return Segments(speed, leader_speed, gap, leader_path, is_present, step, np.array(pair_index))


def split_by_driver(pairs: Sequence[Pair], shares: Sequence[float], seed: int) -> list[Pair]:
    """Return `pairs` with `split` set to train, validation or test, which have these `shares` of the drivers."""
    drivers = sorted({pair.driver for pair in pairs})
    order = np.random.default_rng(seed).permutation(len(drivers))
    borders = np.round(np.cumsum(shares) * len(drivers)).astype(int)
    indices = np.searchsorted(borders, np.argsort(order), side="right").clip(max=len(SPLITS) - 1)
    splits = {driver: SPLITS[index] for driver, index in zip(drivers, indices, strict=True)}
    return [replace(pair, split=splits[pair.driver]) for pair in pairs]


def pairs_in_splits(pairs: Sequence[Pair], *splits: str) -> list[Pair]:
    """Return the pairs of some parts of a split."""
    return [pair for pair in pairs if pair.split in splits]


def pairs_behind_cavs(
    recordings: Iterable[LocalState], control_step: float, steps_per_control_step: int = 1
) -> list[Pair]:
    """Return trajectories of the followers of CAVs from observations of shape (T,), one every `control_step` [s]."""
    pairs = []
    for number, states in enumerate(recordings):
        max_gap = np.where(np.isnan(states.loop_length), MAX_OBSERVED_GAP, states.loop_length)
        is_missing = states.follower_gap >= max_gap
        own, behind, steps = states.speed, states.follower_speed, steps_per_control_step
        expected = states.follower_gap[:-1] + distance_driven(own[:-1], own[1:], control_step / steps, steps)
        expected = expected - distance_driven(behind[:-1], behind[1:], control_step / steps, steps)
        is_other = np.abs(states.follower_gap[1:] - expected) > MAX_GAP_JUMP
        cuts = np.flatnonzero(np.r_[True, is_other | is_missing[1:] | is_missing[:-1], True])
        for first, last in pairwise(cuts):
            if (last - first) * control_step >= MIN_PAIR_SECONDS:
                speed, leader_speed, gap = (
                    np.asarray(each[first:last], np.float64) for each in (behind, own, states.follower_gap)
                )
                name = f"{number}-{first}"
                pairs.append(Pair(name, name, control_step, speed, leader_speed, gap))
    return pairs


@dataclass(frozen=True)
class ReadOptions:
    """Options for reading a file."""

    drop_bad_rows: bool = False
    """whether bad rows are dropped, which ends their trajectory, instead of refused"""
    min_seconds: float = 20.0
    """minimum duration of a trajectory; shorter ones are skipped and counted [s]"""
    driver_columns: tuple[str, ...] = ()
    """columns of a plain table that together name the driver, if it has no column `driver`"""
    kind_columns: tuple[str, ...] = ()
    """the same for `kind`"""


@dataclass(frozen=True)
class ReadResult:
    """The content of a file."""

    pairs: list[Pair] = field(repr=False)
    rows: int
    """in the file"""
    bad_rows: dict[int, str]
    """reason for each dropped row, by its line in the file, where the header is line 1"""
    skipped_rows: dict[str, int]
    """numbers of valid rows that are not used, by reason"""

    def summary_lines(self) -> list[str]:
        """Return a summary of what was read and what was not."""
        used = sum(len(pair.speed) for pair in self.pairs)
        lines = [f"{len(self.pairs)} trajectories with {used:,} of {self.rows:,} rows"]
        lines += [f"skipped: {count:,} rows: {reason}" for reason, count in self.skipped_rows.items() if count]
        dropped = [f"dropped: line {line}: {reason}" for line, reason in self.bad_rows.items()]
        more = len(dropped) - MAX_LISTED_ROWS
        return [*lines, *dropped[:MAX_LISTED_ROWS], *([f"dropped: {more} more bad rows"] if more > 0 else [])]
