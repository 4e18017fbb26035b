"""Car-following data: trajectories of a follower behind a leader, and samples and segments of trajectories."""

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
"""fields of `FollowingTrajectory` that `Segments` has as arrays"""
MIN_TRAJECTORY_SECONDS = 20.0
"""minimum duration of a trajectory behind a CAV [s]; shorter ones contain too little information"""
MAX_GAP_JUMP = 0.5
"""maximum difference between the change of the gap in a control step and the change that follows from the speeds [m];
a larger difference means that the follower has changed"""


@dataclass(frozen=True, eq=False)
class FollowingTrajectory:
    """A trajectory of one driver behind one leader: T samples at equal intervals."""

    name: str
    """unique name of the trajectory"""
    driver: str
    """name of the follower's driver; several trajectories may have the same driver"""
    time_step: float
    """time between two samples [s]"""
    speed: Floats = field(repr=False)
    """speed of the follower [m/s], shape (T,)"""
    leader_speed: Floats = field(repr=False)
    """speed of the leader [m/s], shape (T,)"""
    gap: Floats = field(repr=False)
    """net gap, from the follower's front bumper to the leader's rear bumper [m], shape (T,)"""
    kind: str = ""
    """kind of the driver, such as `human` or `ACC`; empty if the data do not contain it"""
    split: str = ""
    """part of a data split, such as `train` or `test`; empty without a split"""

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return (len(self.speed) - 1) * self.time_step

    @cached_property
    def acceleration(self) -> Floats:
        """Acceleration from each sample to the next, as in an Euler step [m/s2], shape (T - 1,)."""
        return np.diff(self.speed) / self.time_step

    @cached_property
    def leader_path(self) -> Floats:
        """Position of the leader's rear bumper relative to the follower's initial front bumper [m], shape (T,).

        It is the recorded gap plus the follower's path in Euler steps, so that a model with the recorded speeds also
        has the recorded gaps.
        """
        path = next_position(np.zeros(len(self.speed)), np.r_[0.0, np.cumsum(self.speed[1:])], self.time_step)
        return self.gap + path

    def slice(self, first: int, end: int) -> "FollowingTrajectory":
        """Return the samples with indices from `first` to below `end` as a trajectory."""
        return replace(self, **{name: getattr(self, name)[first:end] for name in ("speed", "leader_speed", "gap")})

    def resample(self, time_step: float) -> "FollowingTrajectory":
        """Return the trajectory with another time step [s], interpolated between the samples."""
        times, old_times = regular_times(self.seconds, time_step), self.time_step * np.arange(len(self.speed))
        columns = {name: np.interp(times, old_times, getattr(self, name)) for name in ("speed", "leader_speed", "gap")}
        return replace(self, time_step=time_step, **columns)


def regular_times(seconds: float, time_step: float) -> Floats:
    """Return the times from zero to at most `seconds` at equal intervals [s]."""
    return time_step * np.arange(int(seconds / time_step + 1e-3) + 1, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class FollowingSamples:
    """Single samples of car following, in no order: n samples."""

    speed: Floats
    """speed of the follower [m/s], shape (n,)"""
    leader_speed: Floats
    """speed of the leader [m/s], shape (n,)"""
    gap: Floats
    """net gap [m], shape (n,)"""
    acceleration: Floats
    """acceleration of the follower until the next sample [m/s2], shape (n,)"""

    def __len__(self) -> int:
        return len(self.speed)

    @property
    def inputs(self) -> tuple[Floats, Floats, Floats]:
        """Inputs of an `AccelerationFunction`: own speed, leader speed and gap."""
        return self.speed, self.leader_speed, self.gap

    def select(self, indices: NDArray[np.int64]) -> "FollowingSamples":
        """Return the samples with these indices."""
        return FollowingSamples(*(values[indices] for values in vars(self).values()))


def following_samples(trajectories: Sequence[FollowingTrajectory]) -> FollowingSamples:
    """Return all samples of `trajectories`, except the last one of each, which has no acceleration."""
    rows = [(pair.speed[:-1], pair.leader_speed[:-1], pair.gap[:-1], pair.acceleration) for pair in trajectories]
    return FollowingSamples(*map(np.concatenate, zip(*rows, strict=True)))


@dataclass(frozen=True, eq=False)
class Segments:
    """Segments of trajectories, which are the columns of arrays: n segments of up to T samples."""

    speed: Floats = field(repr=False)
    """speed of the followers [m/s], shape (T, n); shorter segments repeat their last value"""
    leader_speed: Floats = field(repr=False)
    """speed of the leaders [m/s], shape (T, n); shorter segments repeat their last value"""
    gap: Floats = field(repr=False)
    """net gap [m], shape (T, n); shorter segments repeat their last value"""
    leader_path: Floats = field(repr=False)
    """`FollowingTrajectory.leader_path` of each segment [m], shape (T, n); shorter segments repeat their last value"""
    is_present: NDArray[np.bool_] = field(repr=False)
    """whether a value is a sample of the segment, not a repeated last value, shape (T, n)"""
    time_step: float
    """time between two samples [s]"""
    trajectory_index: NDArray[np.int64] = field(repr=False)
    """index of the trajectory of each segment, shape (n,)"""

    @cached_property
    def sample_counts(self) -> NDArray[np.int64]:
        """Number of samples of each segment after the first one, shape (n,)."""
        return self.is_present[1:].sum(0)

    @property
    def initial_state(self) -> tuple[Floats, Floats]:
        """Speed [m/s] and gap [m] of the first sample of each segment, shape (n,)."""
        return self.speed[0], self.gap[0]

    @property
    def leader(self) -> tuple[Floats, Floats]:
        """Speeds [m/s] and paths [m] of the leaders, shape (T, n)."""
        return self.leader_speed, self.leader_path

    def select(self, indices: NDArray[np.int64]) -> "Segments":
        """Return the segments with these indices; T becomes the length of the longest selected segment."""
        length = int(self.is_present[:, indices].sum(0).max())
        columns = {name: getattr(self, name)[:length, indices] for name in (*SEGMENT_FIELDS, "is_present")}
        return replace(self, **columns, trajectory_index=self.trajectory_index[indices])


def make_segments(trajectories: Sequence[FollowingTrajectory], segment_seconds: float | None = None) -> Segments:
    """Cut trajectories into segments of `segment_seconds` [s]; None: each trajectory is one segment.

    Raise `InputError` if the trajectories have different time steps.
    """
    steps = {trajectory.time_step for trajectory in trajectories}
    if len(steps) != 1:
        raise invalid_value("time step", sorted(steps), "the same in all trajectories [s]")
    (step,) = steps
    segments, trajectory_index = list[FollowingTrajectory](), list[int]()
    for index, trajectory in enumerate(trajectories):
        length = len(trajectory.speed) if segment_seconds is None else round(segment_seconds / step) + 1
        for first in range(0, len(trajectory.speed) - 1, max(1, length - 1)):
            segments.append(trajectory.slice(first, first + length))
            trajectory_index.append(index)
    lengths = np.array([len(segment.speed) for segment in segments])
    max_length = int(lengths.max())

    def stack(name: str) -> Floats:
        columns = (getattr(segment, name) for segment in segments)
        return np.stack([np.pad(column, (0, max_length - len(column)), mode="edge") for column in columns], 1)

    is_present = np.arange(max_length)[:, None] < lengths
    speed, leader_speed, gap, leader_path = map(stack, SEGMENT_FIELDS)
    return Segments(speed, leader_speed, gap, leader_path, is_present, step, np.array(trajectory_index))


def split_by_driver(
    trajectories: Sequence[FollowingTrajectory], shares: Sequence[float], seed: int
) -> list[FollowingTrajectory]:
    """Return the trajectories with a `split`: train, validation and test get these `shares` of drivers at random."""
    drivers = sorted({trajectory.driver for trajectory in trajectories})
    order = np.random.default_rng(seed).permutation(len(drivers))
    borders = np.round(np.cumsum(shares) * len(drivers)).astype(int)
    indices = np.searchsorted(borders, np.argsort(order), side="right").clip(max=len(SPLITS) - 1)
    splits = {driver: SPLITS[index] for driver, index in zip(drivers, indices, strict=True)}
    return [replace(trajectory, split=splits[trajectory.driver]) for trajectory in trajectories]


def select_splits(trajectories: Sequence[FollowingTrajectory], *splits: str) -> list[FollowingTrajectory]:
    """Return the trajectories in these parts of the data split."""
    return [trajectory for trajectory in trajectories if trajectory.split in splits]


def trajectories_behind_cavs(
    recordings: Iterable[LocalState], control_step: float, steps_per_control_step: int = 1
) -> list[FollowingTrajectory]:
    """Return the trajectories of the followers of CAVs, given the observations of each CAV, shape (T,).

    `control_step` is the time between two observations [s]. A trajectory ends when another vehicle becomes the
    follower, or when there is no follower.
    """
    trajectories = []
    for index, states in enumerate(recordings):
        max_gap = np.where(np.isnan(states.loop_length), MAX_OBSERVED_GAP, states.loop_length)
        is_missing = states.follower_gap >= max_gap
        leader, follower, steps = states.speed, states.follower_speed, steps_per_control_step
        expected = states.follower_gap[:-1] + distance_driven(leader[:-1], leader[1:], control_step / steps, steps)
        expected = expected - distance_driven(follower[:-1], follower[1:], control_step / steps, steps)
        has_new_follower = np.abs(states.follower_gap[1:] - expected) > MAX_GAP_JUMP
        cuts = np.flatnonzero(np.r_[True, has_new_follower | is_missing[1:] | is_missing[:-1], True])
        for first, end in pairwise(cuts):
            if (end - first) * control_step >= MIN_TRAJECTORY_SECONDS:
                columns = (follower, leader, states.follower_gap)
                speed, leader_speed, gap = (np.asarray(column[first:end], np.float64) for column in columns)
                name = f"{index}-{first}"
                trajectories.append(FollowingTrajectory(name, name, control_step, speed, leader_speed, gap))
    return trajectories
