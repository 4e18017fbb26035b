"""CAVs that come and go, on the merge: what each stay records, and what a driver remembers of it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.conftest import random_network
from tests.worlds.test_record import fingerprint, serialize_and_restore
from unjam.drivers import IDM, Constant, Driver, Human, LocalState, Memory, PISaturation, ResidualDriver
from unjam.drivers.command import Command
from unjam.drivers.observation import local_observation
from unjam.drivers.user_driver import as_driver
from unjam.errors import InputError
from unjam.scenarios import Merge
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode, Trajectory
from unjam.worlds.sumo.backend import SumoBackend, make_traffic
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

MERGE = Merge(penetration_rate=0.3, horizon=120)


class Counting(Driver):
    """Pushes harder the longer it has been on the road, and remembers in numbers and in rows of them."""

    def initial_memory(self, n: int) -> Memory:
        return {"decisions": np.zeros(n), "speeds": np.full((n, 3), -1.0)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Any, Memory]:
        speeds = np.column_stack([state.speed, memory["speeds"][:, :-1]])
        after = {"decisions": memory["decisions"] + 1.0, "speeds": speeds}
        # Also by its speed three decisions ago: wrong at once where rows are mixed up.
        return 0.001 * memory["decisions"] + 0.01 * memory["speeds"][:, -1], after


def expected_of_counting(trajectory: Trajectory) -> Any:
    speed = trajectory.states.speed
    old = np.concatenate([np.full(3, -1.0), speed])[: len(speed) - 1]
    return 0.001 * np.arange(len(speed) - 1) + 0.01 * old


@pytest.fixture(scope="module")
def counted_episode() -> Episode:
    return run_episode(MERGE, Counting(), (2,))


def test_each_cav_has_its_own_memory_from_its_entry(counted_episode: Episode) -> None:
    assert len(counted_episode.trajectories) > 12
    for trajectory in counted_episode.trajectories:
        np.testing.assert_allclose(
            trajectory.applied_acceleration, expected_of_counting(trajectory), rtol=0, atol=1e-12
        )


def test_cavs_enter_and_leave_during_the_episode(counted_episode: Episode) -> None:
    stays = [
        (each.start_step, each.start_step + len(each.applied_acceleration)) for each in counted_episode.trajectories
    ]
    assert len({start for start, _ in stays}) > 10
    assert sum(end < 120 for _, end in stays) > 3
    assert sum(end == 120 for _, end in stays) > 3
    assert [start for start, _ in stays] == sorted(start for start, _ in stays)


def test_each_trip_of_a_cav_is_one_trajectory_with_its_records(counted_episode: Episode) -> None:
    assert len({each.vehicle for each in counted_episode.trajectories}) == len(counted_episode.trajectories)
    assert counted_episode.cav_ids == tuple(each.vehicle for each in counted_episode.trajectories)
    for trajectory in counted_episode.trajectories:
        column = counted_episode.vehicle_ids.index(trajectory.vehicle)
        start, end = trajectory.start_step, trajectory.start_step + len(trajectory.applied_acceleration)
        speeds = counted_episode.speeds[:, column]
        there = np.flatnonzero(~np.isnan(speeds))
        assert there.tolist() == list(range(start, end + 1))
        states = trajectory.states
        np.testing.assert_array_equal(states.speed, speeds[start : end + 1])
        np.testing.assert_array_equal(states.leader_gap, counted_episode.gaps[start : end + 1, column])
        np.testing.assert_array_equal(states.route_position, counted_episode.positions[start : end + 1, column])
        assert np.isnan(states.loop_length).all()
        assert not trajectory.terminated
        for name, values in trajectory.reward_terms.items():
            np.testing.assert_array_equal(values, counted_episode.reward_terms[name][start:end])


def test_leader_and_follower_of_a_trip_are_as_recorded(counted_episode: Episode) -> None:
    seen = 0
    for trajectory in counted_episode.trajectories:
        column = counted_episode.vehicle_ids.index(trajectory.vehicle)
        for moment in range(len(trajectory.applied_acceleration) + 1):
            row = trajectory.start_step + moment
            own, others = counted_episode.positions[row, column], np.delete(counted_episode.positions[row], column)
            speeds = np.delete(counted_episode.speeds[row], column)
            states = trajectory.states.select(moment)
            for gap, speed, place in (
                (states.leader_gap, states.leader_speed, own + 5.0 + states.leader_gap),
                (states.follower_gap, states.follower_speed, own - 5.0 - states.follower_gap),
            ):
                if gap == 100.0:
                    assert speed == states.speed
                    continue
                found = np.flatnonzero(np.abs(others - place) < 1e-6)
                assert speed in speeds[found]
                seen += 1
    assert seen > 1000


def test_commands_are_carried_out_unless_the_shield_brakes(counted_episode: Episode) -> None:
    for trajectory in counted_episode.trajectories:
        speed, free = trajectory.states.speed, trajectory.shield_braking < 1e-9
        expected = np.maximum(speed[:-1] + trajectory.applied_acceleration, 0.0)  # five steps of 0.2 s
        calm = free & (expected < 29.0) & (speed[:-1] > 1.0)
        np.testing.assert_allclose(speed[1:][calm], expected[calm], atol=1e-9)
        assert (speed[1:] <= expected + 1e-9).all()


@pytest.mark.long
def test_the_same_seed_gives_the_same_bytes_in_process_and_in_workers(sumo: SumoBackend) -> None:
    residual = ResidualDriver(PISaturation(time_step=1.0), random_network(), 1.0, action_repeat=3)
    tasks = [
        EpisodeTask(MERGE, residual, (2,), explore=True),
        EpisodeTask(replace(MERGE, warmup=100), Counting(), (5, 1)),
        EpisodeTask(replace(MERGE, penetration_rate=0.0), Human(), (2,)),
    ]
    with WorkerPool(2) as workers:
        found = [fingerprint(episode) for episode in workers.run([*tasks[:1], *tasks[2:]])]
    here = [run_episode(task.scenario, task.driver, task.seed, explore=task.explore, backend=sumo) for task in tasks]
    again = [run_episode(task.scenario, task.driver, task.seed, explore=task.explore, backend=sumo) for task in tasks]
    assert [fingerprint(episode) for episode in again] == [fingerprint(episode) for episode in here]
    assert found == [fingerprint(here[0]), fingerprint(here[2])]
    assert [fingerprint(serialize_and_restore(episode)) for episode in here] == [fingerprint(each) for each in here]


def test_the_same_vehicles_are_cavs_for_every_driver(sumo: SumoBackend) -> None:
    short = replace(MERGE, horizon=40)
    driven = [run_episode(short, driver, (4,), backend=sumo) for driver in (Human(), Constant(0.5))]
    early = [[name for name in episode.cav_ids if int(name.removeprefix("cav_")) < 15] for episode in driven]
    assert early[0] == early[1] != []


def test_cavs_with_a_native_driver_have_trajectories(sumo: SumoBackend) -> None:
    episode = run_episode(MERGE, Human(), (2,), backend=sumo)
    assert len(episode.trajectories) > 5
    for trajectory in episode.trajectories:
        np.testing.assert_allclose(trajectory.applied_acceleration, np.diff(trajectory.states.speed), atol=1e-12)
        assert not trajectory.shield_braking.any()


@pytest.mark.parametrize("hold", [1, 4])
def test_a_residual_driver_counts_its_actions_from_each_entry(hold: int, sumo: SumoBackend) -> None:
    driver = ResidualDriver(Counting(), random_network(), 1.0, action_repeat=hold)
    episode = run_episode(MERGE, driver, (2,), explore=True, backend=sumo)
    noises = []
    assert len(episode.trajectories) > 5
    for trajectory in episode.trajectories:
        steps = len(trajectory.applied_acceleration)
        np.testing.assert_allclose(trajectory.expert_acceleration, expected_of_counting(trajectory), atol=1e-12)
        total = np.clip(trajectory.expert_acceleration + trajectory.residual, -1.0, 1.0)
        np.testing.assert_allclose(trajectory.applied_acceleration, total, atol=1e-12)
        looks = [*range(0, steps, hold), steps]
        seen = local_observation(trajectory.states.select(looks))
        np.testing.assert_allclose(trajectory.observations, seen, atol=1e-12)
        chosen, _ = trajectory.actions_and_rewards
        np.testing.assert_array_equal(trajectory.residual, np.repeat(chosen, hold)[:steps])
        noises.append(chosen - driver.network(trajectory.observations[:-1]))
        assert trajectory.initial_memory.keys() == {"decisions", "speeds"}
        assert trajectory.initial_memory["decisions"] == 0.0
        np.testing.assert_array_equal(trajectory.initial_memory["speeds"], -1.0)
    noise = np.concatenate(noises)
    assert noise.std() == pytest.approx(0.2, rel=0.15)
    assert len(np.unique(noise)) == len(noise)


def test_a_trip_can_be_replayed_from_its_trajectory(sumo: SumoBackend) -> None:
    driver = ResidualDriver(PISaturation(time_step=1.0), random_network(), 1.0)
    episode = run_episode(MERGE, driver, (2,), backend=sumo)
    for trajectory in episode.trajectories:
        memory = {name: values[None] for name, values in trajectory.initial_memory.items()}
        for step in range(len(trajectory.applied_acceleration)):
            state = trajectory.states.select(slice(step, step + 1))
            expert, memory = driver.expert.act(state, memory)
            assert np.clip(expert[0], -1, 1) == pytest.approx(trajectory.expert_acceleration[step], abs=1e-12)


def test_exploration_does_not_change_the_traffic_noise(sumo: SumoBackend) -> None:
    mute = ResidualDriver(Constant(), replace(random_network(), exploration_std=0.0), 1.0)
    still, explored = (run_episode(MERGE, mute, (2,), explore=explore, backend=sumo) for explore in (False, True))
    np.testing.assert_array_equal(explored.speeds, still.speeds)


def test_a_driver_without_memory_drives_all_cavs(sumo: SumoBackend) -> None:
    function = as_driver(lambda state: 0.1 * (state.leader_speed - state.speed))
    episode = run_episode(MERGE, function, (2,), backend=sumo)
    for trajectory in episode.trajectories:
        states = trajectory.states.select(slice(-1))
        wanted = np.clip(0.1 * (states.leader_speed - states.speed), -1, 1)
        np.testing.assert_allclose(trajectory.applied_acceleration, wanted, atol=1e-12)


@pytest.mark.parametrize(
    "driver", [IDM(), ResidualDriver(PISaturation(time_step=1.0), random_network(), 1.0, action_repeat=2)]
)
def test_time_continues_while_no_cav_is_on_the_road(driver: Driver, sumo: SumoBackend) -> None:
    lonely = Merge(cavs=1, standing_vehicles=0, horizon=150)
    episode = run_episode(lonely, driver, (3,), explore=True, backend=sumo)
    (trajectory,) = episode.trajectories
    assert trajectory.start_step > 3
    assert trajectory.start_step + len(trajectory.applied_acceleration) < 150
    assert episode.control_steps == 150
    assert {values.shape for values in episode.reward_terms.values()} == {(150,)}


def test_an_episode_without_cavs_is_an_error_in_one_line(sumo: SumoBackend) -> None:
    empty = Merge(penetration_rate=0.0, horizon=10)
    with pytest.raises(InputError, match="no CAV was on the road in 10 control steps"):
        run_episode(empty, Constant(), (0,), backend=sumo)
    assert run_episode(empty, Human(), (0,), backend=sumo).trajectories == ()


def test_a_warmup_hands_over_the_cavs_that_are_on_the_road(sumo: SumoBackend) -> None:
    warm = replace(MERGE, warmup=200, horizon=60)
    episode = run_episode(warm, Counting(), (2,), backend=sumo)
    assert sum(trajectory.start_step == 0 for trajectory in episode.trajectories) > 2
    for trajectory in episode.trajectories:
        np.testing.assert_allclose(trajectory.applied_acceleration, expected_of_counting(trajectory), atol=1e-12)
    assert episode.warmup == 200
    assert (~np.isnan(episode.speeds[0])).sum() > 15


def test_a_collision_terminates_the_trips_that_it_ends_and_no_earlier_ones(sumo: SumoBackend) -> None:
    reckless = Merge(penetration_rate=0.5, actuation="raw", standing_vehicles=0)
    episode = run_episode(reckless, Constant(1.0), (1,), backend=sumo)
    assert (episode.status, episode.collisions >= 2) == ("collision", True)
    assert episode.control_steps < 600
    ends = [each.start_step + len(each.applied_acceleration) for each in episode.trajectories]
    assert [each.terminated for each in episode.trajectories] == [end == episode.control_steps for end in ends]
    assert episode.reward[-1] == 0.0


def test_remaining_rows_follow_leaving_and_entering_cavs(simulation: Simulation) -> None:
    traffic = make_traffic(MERGE, (2,), simulation)
    traffic.start(is_controlled=True)
    moved = 0
    for _ in range(100):
        before = list(traffic.cav_ids)
        traffic.advance(Command(np.zeros(len(before))))
        stayed = before if traffic.remaining_rows is None else [before[row] for row in traffic.remaining_rows]
        assert list(traffic.cav_ids[: len(stayed)]) == stayed
        assert not set(traffic.cav_ids[len(stayed) :]) & set(before)
        assert traffic.local_state().speed.shape == (len(traffic.cav_ids),)
        moved += stayed != before
    assert moved > 2


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (lambda state: np.zeros(len(state.speed) + 1), r"<lambda>: acceleration has shape \(\d+,\); allowed: \(\d+,\)"),
        (lambda state: state.speed * np.nan, r"driver: step \d+: acceleration of cav_0 is nan; allowed: finite"),
    ],
)
def test_a_wrong_answer_is_refused(answer: Any, words: str, sumo: SumoBackend) -> None:
    everyone = Merge(penetration_rate=1.0, standing_vehicles=0, horizon=20)
    with pytest.raises(InputError, match=words):
        run_episode(everyone, as_driver(answer), (0,), backend=sumo)


def test_recording_fuel_and_poses_is_optional_and_changes_nothing_else(sumo: SumoBackend) -> None:
    short = replace(MERGE, horizon=40)
    plain, full = (run_episode(short, Counting(), (2,), record_details=asked, backend=sumo) for asked in (False, True))
    steps, vehicles = plain.speeds.shape
    assert (plain.fuel.shape, plain.poses.shape, plain.lane_lines.shape) == ((0, 0), (0, 0, 3), (0, 2))
    assert (full.fuel.shape, full.poses.shape) == ((steps - 1,), (steps, vehicles, 3))
    assert (full.fuel > 0).all()
    np.testing.assert_array_equal(np.isnan(full.poses[..., 0]), np.isnan(full.speeds))
    same = replace(full, fuel=plain.fuel, poses=plain.poses, lane_lines=plain.lane_lines)
    assert fingerprint(same) == fingerprint(plain)
