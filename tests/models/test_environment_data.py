from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.conftest import random_network
from tests.models.toy_dynamics import ToyDynamics, environment_data
from tests.worlds.test_record import fingerprint
from unjam.drivers import IDM, LocalState, PISaturation, ResidualDriver
from unjam.drivers.local_state import COMMON_FIELDS
from unjam.errors import InputError
from unjam.models.environment_data import EnvironmentData, is_holdout_episode
from unjam.scenarios import Ring
from unjam.tree import pack, unpack
from unjam.worlds.record import Episode, Trajectory

RING = Ring()


def trajectory(number: int, control_steps: int, action_repeat: int = 1, terminated: bool = False) -> Trajectory:
    """Return a trajectory in which every number identifies its source."""
    steps = np.arange(control_steps + 1, dtype=np.float64) + 1000.0 * number
    zeros = np.zeros(control_steps)
    return Trajectory(
        vehicle="cav_0",
        start_step=0,
        states=LocalState(*(steps + 0.1 * field for field in range(len(COMMON_FIELDS)))),
        observations=np.zeros((1, 0)),
        expert_acceleration=zeros,
        residual=zeros,
        applied_acceleration=steps[:-1] / 1e6,
        filter_braking=zeros,
        shield_braking=zeros,
        reward_terms={"one": steps[:-1], "two": zeros + 1},
        initial_memory={"number": np.array(float(number))},
        action_repeat=action_repeat,
        terminated=terminated,
    )


def episode(*trajectories: Trajectory, length: float = 245.0, status: str = "completed") -> Episode:
    return Episode(seed=(1,), status=status, drawn_values={"length": length}, trajectories=trajectories)


def make_data(*control_steps: int, rows: int = 10**6, action_repeat: int = 1) -> EnvironmentData:
    data = EnvironmentData(rows)
    data.add([episode(trajectory(number, count, action_repeat)) for number, count in enumerate(control_steps)], RING)
    return data


def test_transitions_are_control_steps_in_order() -> None:
    data = EnvironmentData(100)
    two_cavs = episode(trajectory(0, 3), trajectory(1, 2, terminated=True), length=270.0)
    data.add([two_cavs, episode(trajectory(2, 4), length=220.0)], RING)
    found = data.transitions(0.2)
    assert len(data) == 9
    np.testing.assert_array_equal(found.states.speed, [0, 1, 2, 1000, 1001, 2000, 2001, 2002, 2003])
    np.testing.assert_array_equal(found.next_states.speed, found.states.speed + 1)
    np.testing.assert_allclose(found.next_states.leader_gap, found.next_states.speed + 0.2)
    np.testing.assert_allclose(found.acceleration, found.states.speed / 1e6)
    np.testing.assert_array_equal(found.reward, found.states.speed + 1)
    np.testing.assert_array_equal(found.drawn_values[:, 0], [1.0] * 5 + [-1.0] * 4)
    np.testing.assert_array_equal(np.flatnonzero(found.crashed), [4])


def test_failed_episodes_are_not_stored() -> None:
    data = EnvironmentData(100)
    data.add([Episode(seed=(1,), status="failed"), episode(trajectory(0, 3))], RING)
    assert len(data) == 3
    assert data.recordings[0].episode == 1


@given(st.lists(st.integers(1, 30), min_size=1, max_size=12), st.integers(1, 60))
def test_newest_episodes_are_stored_completely(control_steps: list[int], rows: int) -> None:
    data = make_data(*control_steps, rows=rows)
    stored = [recording.episode for recording in data.recordings]
    assert stored == list(range(len(control_steps)))[-len(stored) :]
    assert len(data) == sum(control_steps[-len(stored) :])
    assert len(data) >= min(rows, sum(control_steps))
    assert len(data) - control_steps[stored[0]] < rows  # without the oldest there would be too few


@pytest.mark.parametrize("share", [0.1, 0.2, 0.5])
def test_holdout_share_holds_from_the_first_episode_on(share: float) -> None:
    is_held_out = np.array([is_holdout_episode(number, share) for number in range(1000)])
    assert is_held_out[0]
    for first in range(0, 900, 90):
        assert is_held_out[first : first + 100].mean() == pytest.approx(share, abs=0.02)
    for parts in (2, 4, 5, 8):  # episodes take turns over as many parts of the road's range
        assert all(is_held_out[part::parts].any() for part in range(parts))


def test_holdout_episode_stays_complete_and_held_out() -> None:
    data = make_data(*[10] * 8, rows=60)
    for _ in range(2):
        found = data.transitions(0.2)
        numbers = (found.states.speed // 1000).astype(int)
        assert set(numbers[found.is_holdout]) == {5}
        assert 5 not in numbers[~found.is_holdout]
        data.add([episode(trajectory(9, 1))], RING)


@pytest.mark.parametrize("control_steps", [(10,), (10, 1)])
def test_end_of_a_single_episode_is_held_out(control_steps: tuple[int, ...]) -> None:
    data = make_data(*control_steps)
    data.recordings = [replace(recording, episode=0) for recording in data.recordings]
    found = data.transitions(0.2)
    np.testing.assert_array_equal(found.states.speed[found.is_holdout], [8, 9])


def test_transitions_without_data_raise_error() -> None:
    with pytest.raises(InputError, match="no environment steps"):
        EnvironmentData(10).transitions(0.2)


def test_start_indices_are_due_actions_with_enough_steps_left() -> None:
    data = make_data(7, 3, action_repeat=3)
    assert data.start_indices().tolist() == [[0, 0], [0, 3], [0, 6], [1, 0]]
    assert data.start_indices(3).tolist() == [[0, 0], [0, 3], [1, 0]]
    assert data.start_indices(8).tolist() == []
    found = data.states_at(data.start_indices()[[3, 1, 1]])
    np.testing.assert_array_equal(found.speed, [1000, 3, 3])
    np.testing.assert_allclose(found.leader_gap, np.array([1000, 3, 3]) + 0.2)


def test_pack_and_unpack_restore_data() -> None:
    driver = ResidualDriver(PISaturation(window=2.0), random_network(), 1.0, action_repeat=4)
    data = environment_data(ToyDynamics(), driver, 2, 30)
    restored = unpack(EnvironmentData, *pack(data))
    assert fingerprint(tuple(restored.recordings)) == fingerprint(tuple(data.recordings))
    assert (restored.capacity, restored.episode_count) == (data.capacity, data.episode_count)
    assert restored.recordings[0].initial_memory.keys() == {"window", "total", "count", "command"}


def test_select_takes_rows_of_each_column() -> None:
    transitions = environment_data(ToyDynamics(), ResidualDriver(IDM(), random_network(), 1.0), 2, 30).transitions(0.2)
    rows = np.array([7, 3, 41])
    found = transitions.select(rows)
    for name, values in transitions._asdict().items():
        pairs = [(values, getattr(found, name))]
        if isinstance(values, LocalState):
            pairs = list(zip(values[:7], getattr(found, name)[:7], strict=True))
        for column, selected in pairs:
            np.testing.assert_array_equal(selected, column[rows])
