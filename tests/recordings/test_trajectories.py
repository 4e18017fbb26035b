import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.recordings.synthetic_trajectories import idm_driver
from unjam.errors import InputError
from unjam.physics.idm import PAPER_IDM
from unjam.recordings.trajectories import (
    FollowingTrajectory,
    following_samples,
    make_segments,
    select_splits,
    split_by_driver,
)


def trajectories_of(count: int, drivers: int) -> list[FollowingTrajectory]:
    zeros = np.zeros(3)
    return [
        FollowingTrajectory(f"{number}", f"{number % drivers}", 0.1, zeros, zeros, zeros) for number in range(count)
    ]


def test_leader_path_minus_follower_path_is_the_recorded_gap() -> None:
    trajectory = idm_driver(PAPER_IDM)
    path = np.r_[0.0, np.cumsum(trajectory.speed[1:] * trajectory.time_step)]
    np.testing.assert_allclose(trajectory.leader_path - path, trajectory.gap)


def test_last_sample_of_each_trajectory_is_left_out() -> None:
    trajectories = [idm_driver(PAPER_IDM, seconds=3.0), idm_driver(PAPER_IDM, seconds=5.0)]
    samples = following_samples(trajectories)
    assert len(samples) == 30 + 50
    assert samples.acceleration[30] == pytest.approx((trajectories[1].speed[1] - trajectories[1].speed[0]) / 0.1)


@given(seconds=st.sampled_from([1.0, 2.5, 7.0, None]), lengths=st.lists(st.floats(0.5, 9.0), min_size=1, max_size=4))
def test_segments_contain_every_step_once(seconds: float | None, lengths: list[float]) -> None:
    trajectories = [idm_driver(PAPER_IDM, seconds=length) for length in lengths]
    segments = make_segments(trajectories, seconds)
    assert segments.is_present[1:].sum() == sum(len(each.speed) - 1 for each in trajectories)
    for number, trajectory in enumerate(trajectories):
        own = np.flatnonzero(segments.trajectory_index == number)
        speeds = [segments.speed[1:, index][segments.is_present[1:, index]] for index in own]
        np.testing.assert_array_equal(np.concatenate(speeds), trajectory.speed[1:])


def test_segments_require_equal_time_steps() -> None:
    zeros = np.zeros(3)
    trajectories = [FollowingTrajectory(str(step), "", step, zeros, zeros, zeros) for step in (0.1, 0.2)]
    with pytest.raises(InputError, match="time step"):
        make_segments(trajectories)


@given(count=st.integers(5, 40), drivers=st.integers(3, 40), seed=st.integers(0, 9))
def test_each_driver_is_in_one_part_of_a_split(count: int, drivers: int, seed: int) -> None:
    split = split_by_driver(trajectories_of(count, drivers), (0.6, 0.2, 0.2), seed)
    assert len(split) == count
    assert len({(each.driver, each.split) for each in split}) == len({each.driver for each in split})


def test_parts_of_a_split_have_their_shares() -> None:
    split = split_by_driver(trajectories_of(100, 100), (0.7, 0.1, 0.2), 0)
    assert [len(select_splits(split, name)) for name in ("train", "validation", "test")] == [70, 10, 20]
