"""The one loop, on a world without a simulator."""

from dataclasses import replace

import numpy as np
import pytest

from tests.conftest import random_network
from tests.mock_world import MockWorld
from unjam.drivers import IDM, Human, LocalState, PISaturation, ResidualDriver
from unjam.drivers.command import Command, Limits
from unjam.drivers.wrappers import ImpairedDriver, MixedDriver
from unjam.errors import InputError
from unjam.worlds.drive import DriveLoop, drive_world
from unjam.worlds.world import RecordedWorld

PI = PISaturation()
RESIDUAL = ResidualDriver(PI, random_network(), 1.0, action_repeat=4)


def test_a_drive_lasts_until_the_world_has_ended() -> None:
    applied, driven = drive_world(MockWorld(decisions=25), PI)
    assert applied.shape == (25, 3)
    assert driven.decisions == []


def test_a_single_cav_with_floats_drives_as_one_row() -> None:
    rows, _ = drive_world(MockWorld(rows=1), RESIDUAL)
    plain, _ = drive_world(MockWorld(rows=1, single=True), RESIDUAL)
    np.testing.assert_allclose(plain, rows, atol=1e-12)


def test_decisions_and_the_last_observation_are_recorded() -> None:
    world = MockWorld()
    applied, driven = drive_world(world, RESIDUAL)
    experts, residuals, seen = (np.array(part) for part in zip(*driven.decisions, strict=True))
    np.testing.assert_allclose(applied, (experts + residuals).clip(-1.0, 1.0))
    assert seen.shape == (40, 3, 5)
    assert driven.last_observation is not None
    np.testing.assert_allclose(driven.last_observation[:, 0], world.local_state().speed / 10.0)
    assert len(driven.initial_memories) == 3
    assert driven.action_repeat == 4


def test_there_is_no_exploration_by_default() -> None:
    calm, _ = drive_world(MockWorld(), RESIDUAL)
    again, _ = drive_world(MockWorld(), RESIDUAL)
    np.testing.assert_array_equal(calm, again)
    assert not np.array_equal(calm, drive_world(MockWorld(), RESIDUAL, explore=True)[0])


def test_per_episode_noise_is_the_same_in_all_control_steps_and_can_have_the_opposite_sign() -> None:
    lasting = replace(RESIDUAL, network=replace(random_network(), episode_noise=True), action_limit=100.0)
    reported = [drive_world(MockWorld(decisions=4), lasting, explore)[0] for explore in (0.0, 1.0, -1.0)]
    (calm, one, other), again = reported, drive_world(MockWorld(decisions=4), lasting, 1.0)[0]
    np.testing.assert_array_equal(one, again)
    np.testing.assert_allclose(one[0] - calm[0], calm[0] - other[0], atol=1e-12)
    assert np.abs(one[0] - calm[0]).min() > 0.01


@pytest.mark.parametrize("driver", [PI, RESIDUAL, MixedDriver((PI, IDM())), ImpairedDriver(PI, delay=0.3)])
def test_memory_follows_its_vehicle_when_others_leave_and_enter(driver: MixedDriver) -> None:
    world = MockWorld(turnover=5)
    driving = DriveLoop(world, driver)
    for _ in driving:
        assert np.asarray(world.local_state().speed).shape == (3,)
    assert world.entered_count == 3 + 40 // 5
    assert len(driving.initial_memories) == world.entered_count


def test_a_new_cav_has_an_initial_memory() -> None:
    driving = DriveLoop(MockWorld(turnover=5), PI)
    seen = [driving.memory["count"].tolist() for _ in driving]
    assert seen[3:6] == [[4, 4, 4], [5, 5, 0], [6, 6, 1]]


def test_a_native_driver_makes_no_decisions() -> None:
    assert list(DriveLoop(MockWorld(decisions=3), Human())) == [None] * 3


def test_progress_is_reported_every_ten_control_steps() -> None:
    reported: list[int] = []
    drive_world(MockWorld(decisions=25), PI, on_progress=reported.append)
    assert reported == [10, 20]


def test_a_drive_can_continue_with_a_given_memory() -> None:
    states = LocalState(*(np.full((6, 2), value) for value in (4.0, 5.0, 10.0, 3.0, 8.0, 20.0, 250.0)))
    whole = drive_world(RecordedWorld(states, Limits(-1.0, 1.0)), PI)
    first = DriveLoop(RecordedWorld(states.select(slice(2)), Limits(-1.0, 1.0)), PI)
    assert len(list(first)) == 2
    rest = RecordedWorld(states.select(slice(2, None)), Limits(-1.0, 1.0))
    np.testing.assert_array_equal(drive_world(rest, PI, memory=first.memory), whole[2:])


def test_a_recording_names_the_row_with_an_invalid_command() -> None:
    states = LocalState(*(np.full((6, 2), value) for value in (4.0, 5.0, 10.0, 3.0, 8.0, 20.0, 250.0)))
    world = RecordedWorld(states, Limits(-1.0, 1.0))
    world.advance(Command(np.zeros(2)))
    with pytest.raises(InputError, match="driver: step 1: acceleration of row 1 is nan; allowed: finite"):
        world.advance(Command(np.array([0.0, np.nan])))
