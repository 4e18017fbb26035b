from dataclasses import replace

import numpy as np
import pytest

from unjam.drivers import LocalState, PISaturation
from unjam.following.calibration import calibrate_human_drivers
from unjam.models.environment_data import EnvironmentData, Recording
from unjam.physics.idm import IDMParameters
from unjam.recordings.trajectories import trajectories_behind_cavs
from unjam.scenarios import Ring
from unjam.worlds.episode import run_episode

HUMANS = IDMParameters(time_headway=1.6, max_acceleration=0.7)
RING = Ring(length=(300, 320), vehicles=20, horizon=900, noise=0.0, humans=HUMANS)


@pytest.fixture(scope="module")
def data() -> EnvironmentData:
    recorded = EnvironmentData(10_000)
    recorded.add([run_episode(RING, PISaturation(), (seed,)) for seed in range(2)], RING)
    return recorded


@pytest.mark.long
def test_calibration_finds_the_parameters_of_human_drivers(data: EnvironmentData) -> None:
    scenario = replace(RING, humans=IDMParameters())
    calibrated = calibrate_human_drivers(states_of(data), scenario)
    assert calibrated.time_headway == pytest.approx(HUMANS.time_headway, abs=0.1)
    assert calibrated.max_acceleration == pytest.approx(HUMANS.max_acceleration, rel=0.2)
    assert (calibrated.desired_speed, calibrated.minimum_gap) == (30.0, 2.0)


def test_trajectories_are_those_of_the_followers(data: EnvironmentData) -> None:
    trajectories = trajectories_behind_cavs(states_of(data), RING.control_step)
    assert len(trajectories) == 2
    states = data.recordings[0].states
    np.testing.assert_array_equal(trajectories[0].leader_speed, states.speed[: len(trajectories[0].speed)])
    np.testing.assert_array_equal(trajectories[0].gap, states.follower_gap[: len(trajectories[0].speed)])


def test_another_follower_starts_another_trajectory(data: EnvironmentData) -> None:
    recording = data.recordings[0]
    gap = np.array(recording.states.follower_gap, np.float64)
    gap[400:] += 30.0
    trajectories = trajectories_behind_cavs([with_follower_gap(recording, gap)], RING.control_step)
    assert [len(trajectory.speed) for trajectory in trajectories] == [400, 501]


def test_hard_braking_within_a_control_step_is_not_taken_for_another_follower() -> None:
    # The follower brakes with 4 m/s2 in five steps of 0.2 s per control step, behind a leader that keeps 20 m/s.
    speed_changes = np.repeat([*[0.0] * 5, -4.0, -4.0, *[0.0] * 2, 4.0, 4.0, *[0.0] * 14], 5) * 0.2
    follower_speeds = 20.0 + np.concatenate([[0.0], np.cumsum(speed_changes)])
    gap = 20.0 + np.concatenate([[0.0], np.cumsum(20.0 - follower_speeds[1:]) * 0.2])
    leader_speed, missing = np.full(26, 20.0), np.full(26, np.nan)
    states = LocalState(leader_speed, leader_speed, leader_speed, follower_speeds[::5], gap[::5], missing, missing)
    assert [
        len(trajectories_behind_cav.speed) for trajectories_behind_cav in trajectories_behind_cavs([states], 1.0, 5)
    ] == [26]
    assert trajectories_behind_cavs([states], 1.0) == []


def test_without_followers_the_parameters_of_the_scenario_remain(data: EnvironmentData) -> None:
    recording = data.recordings[0]
    without_follower = with_follower_gap(recording, np.array(recording.states.loop_length, np.float64))
    assert trajectories_behind_cavs([without_follower], RING.control_step) == []
    assert calibrate_human_drivers([without_follower], RING) == RING.humans


def with_follower_gap(recording: Recording, follower_gap: np.ndarray) -> LocalState:
    return LocalState(*recording.states)._replace(follower_gap=follower_gap)


def states_of(data: EnvironmentData) -> list[LocalState]:
    return [recording.states for recording in data.recordings]
