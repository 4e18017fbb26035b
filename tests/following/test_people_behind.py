from dataclasses import replace

import numpy as np
import pytest

from unjam.drivers import LocalState, PISaturation
from unjam.following.calibration import calibrate_human_drivers
from unjam.following.pairs import pairs_behind_cavs
from unjam.models.environment_data import EnvironmentData, Recording
from unjam.physics.idm import IDMParameters
from unjam.scenarios import Ring
from unjam.worlds.episode import run_episode

OTHERS = IDMParameters(time_headway=1.6, max_acceleration=0.7)
RING = Ring(length=(300, 320), vehicles=20, horizon=900, noise=0.0, humans=OTHERS)


@pytest.fixture(scope="module")
def data() -> EnvironmentData:
    kept = EnvironmentData(10_000)
    kept.add([run_episode(RING, PISaturation(), (seed,)) for seed in range(2)], RING)
    return kept


@pytest.mark.long
def test_finds_how_people_on_the_road_drive(data: EnvironmentData) -> None:
    believed = replace(RING, humans=IDMParameters())
    found = calibrate_human_drivers(states_of(data), believed)
    assert found.time_headway == pytest.approx(OTHERS.time_headway, abs=0.1)
    assert found.max_acceleration == pytest.approx(OTHERS.max_acceleration, rel=0.2)
    assert (found.desired_speed, found.minimum_gap) == (30.0, 2.0)


def test_a_drive_is_that_of_the_vehicle_behind(data: EnvironmentData) -> None:
    pairs = pairs_behind_cavs(states_of(data), RING.control_step)
    assert len(pairs) == 2
    states = data.recordings[0].states
    np.testing.assert_array_equal(pairs[0].leader_speed, states.speed[: len(pairs[0].speed)])
    np.testing.assert_array_equal(pairs[0].gap, states.follower_gap[: len(pairs[0].speed)])


def test_another_vehicle_behind_is_another_drive(data: EnvironmentData) -> None:
    recording = data.recordings[0]
    gap = np.array(recording.states.follower_gap, np.float64)
    gap[400:] += 30.0
    pairs = pairs_behind_cavs([changed(recording, gap)], RING.control_step)
    assert [len(pair.speed) for pair in pairs] == [400, 501]


def test_steps_within_a_decision_count_and_hard_braking_is_not_taken_for_another_vehicle() -> None:
    # The follower brakes with 4 m/s2 in five steps of 0.2 s a decision, behind somebody who keeps 20 m/s.
    changes = np.repeat([*[0.0] * 5, -4.0, -4.0, *[0.0] * 2, 4.0, 4.0, *[0.0] * 14], 5) * 0.2
    every = 20.0 + np.concatenate([[0.0], np.cumsum(changes)])
    gap = 20.0 + np.concatenate([[0.0], np.cumsum(20.0 - every[1:]) * 0.2])
    own, none = np.full(26, 20.0), np.full(26, np.nan)
    states = LocalState(own, own, own, every[::5], gap[::5], none, none)
    assert [len(pair.speed) for pair in pairs_behind_cavs([states], 1.0, 5)] == [26]
    assert pairs_behind_cavs([states], 1.0) == []


def test_where_nobody_drove_behind_people_stay_as_they_are_known(data: EnvironmentData) -> None:
    recording = data.recordings[0]
    alone = changed(recording, np.array(recording.states.loop_length, np.float64))
    assert pairs_behind_cavs([alone], RING.control_step) == []
    assert calibrate_human_drivers([alone], RING) == RING.humans


def changed(recording: Recording, follower_gap: np.ndarray) -> LocalState:
    return LocalState(*recording.states)._replace(follower_gap=follower_gap)


def states_of(data: EnvironmentData) -> list[LocalState]:
    return [recording.states for recording in data.recordings]
