from collections.abc import Callable
from dataclasses import replace
from typing import Any

import libsumo
import numpy as np
import pytest

from unjam.drivers import IDM, Constant, Driver, Human, LocalState, Memory, PISaturation
from unjam.drivers.local_state import COMMON_FIELDS
from unjam.drivers.requirements import NO_REQUIREMENTS
from unjam.drivers.safety import INSTANT_ACTUATOR, SafetyFilter
from unjam.errors import EpisodeError, InputError
from unjam.scenarios import Ring
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode, Floats
from unjam.worlds.sumo.backend import SumoBackend

RING = Ring(length=(230, 230), horizon=300, safety=SafetyFilter(active=False), actuator=INSTANT_ACTUATOR)
"""what SUMO does with commands, without the filter"""
STEP = 0.1


class Playback(Driver):
    """Commands given accelerations, one row after the other."""

    def __init__(self, rows: Floats) -> None:
        self.rows = rows

    def initial_memory(self, n: int) -> Memory:
        return {"step": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Any, Memory]:
        step = int(memory["step"][0])
        return np.broadcast_to(self.rows[step], state.speed.shape), {"step": memory["step"] + 1}


class Watcher(Playback):
    """Stands still and stores the history of the warm-up and its states."""

    def __init__(self) -> None:
        super().__init__(np.full(10_000, -1.0))
        self.history: list[LocalState] = []
        self.perceived: list[LocalState] = []

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        self.history.append(history)
        return memory

    def act(self, state: LocalState, memory: Memory) -> tuple[Any, Memory]:
        self.perceived.append(state)
        return super().act(state, memory)


class Answers(Driver):
    """Drives well until step 7, and then answers something else."""

    def __init__(self, answer: Callable[[Any], Any]) -> None:
        self.answer = answer

    def initial_memory(self, n: int) -> Memory:
        return {"step": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Any, Memory]:
        step = memory["step"] if isinstance(memory["step"], float) else memory["step"][0]
        return state.speed * 0.0 if step < 7 else self.answer(state.speed), {"step": memory["step"] + 1.0}


class PlainAnswers(Answers):
    class_requirements = NO_REQUIREMENTS


def moves(episode: Episode) -> Floats:
    """Speeds with which the vehicles moved, before noise, shape (T, N)."""
    return np.diff(episode.positions, axis=0) / STEP


def idm(episode: Episode) -> Floats:
    """Speeds with which the vehicles would move as the paper's humans, Eq. 5-6, shape (T, N)."""
    speed, gap = episode.speeds[:-1], episode.gaps[:-1]
    closing = speed - np.roll(speed, -1, 1)
    wanted = 2.0 + np.maximum(speed * 1.0 + speed * closing / (2 * np.sqrt(1.0 * 1.5)), 0.0)
    return np.maximum(speed + STEP * (1.0 - (speed / 30.0) ** 4 - (wanted / gap) ** 2), 0.0)


@pytest.mark.parametrize(
    ("vehicles", "cavs", "length"), [(2, 2, 40), (5, 1, 55), (11, 1, 120), (22, 1, 220), (44, 1, 520)]
)
def test_the_number_of_vehicles_is_as_configured(vehicles: int, cavs: int, length: int, sumo: SumoBackend) -> None:
    ring = replace(RING, vehicles=vehicles, cavs=cavs, length=(length, length))
    episode = run_episode(ring, PISaturation(), (0,), backend=sumo)
    assert episode.speeds.shape == (301, vehicles)
    assert len(episode.vehicle_ids) == vehicles
    assert len(episode.cav_ids) == len(episode.trajectories) == cavs
    assert episode.loop_length == length
    assert (episode.speeds[-1] > 0).any()
    assert np.isfinite(episode.speeds).all()
    np.testing.assert_allclose(episode.gaps.sum(1), length - 5.0 * vehicles, atol=1e-9)


@pytest.mark.parametrize("warmup", [0, 20])
def test_a_vehicle_that_vanishes_ends_the_episode_with_an_error(warmup: int, sumo: SumoBackend) -> None:
    def lose_one(speed: Any) -> Any:
        libsumo.vehicle.remove("human_5")
        return speed * 0.0

    with pytest.raises(EpisodeError, match="21 vehicles on the road; expected: 22"):
        run_episode(replace(RING, warmup=warmup), Answers(lose_one), (0,), backend=sumo)
    assert run_episode(RING, IDM(), (0,), backend=sumo).status == "completed"


def test_an_additional_vehicle_ends_the_episode_with_an_error(sumo: SumoBackend) -> None:
    def add_one(speed: Any) -> Any:
        route = libsumo.vehicle.getRouteID("cav_0")
        libsumo.vehicle.add("stranger", route, typeID="human", departPos="23")
        return speed * 0.0

    small = replace(RING, vehicles=5, length=(230, 230))
    with pytest.raises(EpisodeError, match="6 vehicles on the road; expected: 5"):
        run_episode(small, Answers(add_one), (0,), backend=sumo)


def test_human_drivers_and_native_cavs_move_as_in_the_paper(sumo: SumoBackend) -> None:
    episode = run_episode(replace(RING, horizon=1500), Human(), (0,), backend=sumo)
    np.testing.assert_allclose(moves(episode), idm(episode), rtol=0, atol=1e-9)
    assert np.ptp(episode.speeds[-1]) > 0.5
    assert not episode.trajectories[0].shield_braking.any()
    done = np.diff(episode.speeds[:, 0]) / STEP
    np.testing.assert_allclose(episode.trajectories[0].applied_acceleration, done, atol=1e-12)


def test_human_drivers_use_their_parameters(sumo: SumoBackend) -> None:
    slow = replace(RING, humans=replace(RING.humans, time_headway=2.0, max_acceleration=0.5), noise=0.0)
    episode = run_episode(slow, Human(), (0,), backend=sumo)
    speed, gap = episode.speeds[:-1], episode.gaps[:-1]
    acceleration = 0.5 * (1.0 - (speed / 30.0) ** 4 - ((2.0 + 2.0 * speed) / gap) ** 2)
    np.testing.assert_allclose(moves(episode), speed + STEP * acceleration, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "std"),
    [
        ({}, 0.2 * np.sqrt(0.1)),
        ({"noise_scaling": "none"}, 0.2),
        ({"noise": 0.5}, 0.5 * np.sqrt(0.1)),
        ({"noise": 0.0}, 0.0),
    ],
)
def test_human_noise_has_the_configured_standard_deviation(
    changes: dict[str, Any], std: float, sumo: SumoBackend
) -> None:
    ring = replace(RING, length=(270, 270), horizon=2000, **changes)
    episode = run_episode(ring, IDM(), (0,), backend=sumo)
    moved = moves(episode)
    noise = (episode.speeds[1:] - moved) / STEP
    np.testing.assert_allclose(noise[:, 0], 0.0, atol=1e-9)  # the CAV has none
    human = noise[:, 1:]
    fast = (moved[:, 1:] > 8 * STEP * std).all(1)  # no vehicle so slow that it would have to reverse
    assert fast.sum() > 1000
    human = human[fast]
    assert human.std() == pytest.approx(std, rel=0.02, abs=1e-9)
    assert abs(human.mean()) < 5 * std / np.sqrt(human.size) + 1e-9
    if std:
        assert abs(np.corrcoef(human[:-1].ravel(), human[1:].ravel())[0, 1]) < 0.03
        assert abs(np.corrcoef(human[:, 0], human[:, 1])[0, 1]) < 0.12
        assert np.mean(np.abs(human) < std) == pytest.approx(0.683, abs=0.01)
    assert episode.speeds.min() >= 0.0


def test_raw_follows_every_command_exactly(sumo: SumoBackend) -> None:
    commands = np.random.default_rng(1).uniform(-0.5, 1.0, 3000)
    ring = replace(RING, actuation="raw", horizon=3000)
    episode = run_episode(ring, Playback(commands), (0,), backend=sumo)
    speed = episode.trajectories[0].states.speed
    expected = np.maximum(speed[:-1] + STEP * commands[: episode.control_steps], 0.0)
    np.testing.assert_allclose(speed[1:], expected, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(episode.trajectories[0].applied_acceleration, commands[: episode.control_steps])
    assert not episode.trajectories[0].shield_braking.any()


def test_a_reckless_raw_driver_collides_and_the_episode_ends_there(sumo: SumoBackend) -> None:
    ring = replace(RING, actuation="raw", horizon=3000)
    episode = run_episode(ring, Constant(1.0), (0,), backend=sumo)
    trajectory = episode.trajectories[0]
    assert episode.status == "collision"
    assert episode.has_run
    assert trajectory.terminated
    assert episode.collisions == 2
    assert 0 < episode.control_steps < 200
    gap = trajectory.states.leader_gap
    assert len(gap) == episode.control_steps + 1
    assert gap[-1] < 0.0
    assert (gap[:-1] >= 0.0).all()
    assert trajectory.reward[-1] == 0.0
    assert (trajectory.reward[:-1] != 0.0).all()


@pytest.mark.parametrize("held", [3, 5, 20, 100])
def test_a_collision_ends_its_control_step(held: int, sumo: SumoBackend) -> None:
    ring = replace(RING, actuation="raw", horizon=3000, noise=0.0)
    exact = run_episode(ring, Constant(1.0), (0,), backend=sumo)
    coarse = replace(ring, steps_per_control_step=held, horizon=3000 // held)
    episode = run_episode(coarse, Constant(1.0), (0,), backend=sumo)
    assert episode.status == "collision"
    assert episode.control_steps == -(-exact.control_steps // held)
    assert episode.collisions == 2


@pytest.mark.long
@pytest.mark.parametrize("length", [160, 220, 270])
@pytest.mark.parametrize("held", [1, 5])
def test_the_same_driver_shielded_never_collides_and_every_override_is_counted(
    length: int, held: int, sumo: SumoBackend
) -> None:
    ring = replace(RING, horizon=3000 // held, length=(length, length), steps_per_control_step=held)
    for seed in range(2):
        episode = run_episode(ring, Constant(1.0), (seed,), backend=sumo)
        trajectory = episode.trajectories[0]
        assert (episode.status, episode.collisions, episode.control_steps) == ("completed", 0, 3000 // held)
        assert not trajectory.terminated
        assert episode.gaps.min() > 0.0
        assert (trajectory.shield_braking > 1e-6).mean() > 0.5
        np.testing.assert_array_equal(trajectory.applied_acceleration, 1.0)


def test_shielded_executes_every_command_exactly_except_for_the_counted_braking(sumo: SumoBackend) -> None:
    commands = np.random.default_rng(1).uniform(-0.6, 1.0, 3000)
    ring = replace(RING, horizon=3000)
    episode = run_episode(ring, Playback(commands), (0,), backend=sumo)
    trajectory = episode.trajectories[0]
    speed, shield = trajectory.states.speed, trajectory.shield_braking
    commanded = np.maximum(speed[:-1] + STEP * commands, 0.0)
    np.testing.assert_allclose(speed[1:], commanded - STEP * shield, rtol=0, atol=1e-9)
    assert (shield == 0.0).mean() > 0.1
    np.testing.assert_allclose(speed[1:][shield == 0.0], commanded[shield == 0.0], rtol=0, atol=1e-9)
    assert (shield > 1e-6).mean() > 0.05
    assert shield.min() >= 0.0


def test_the_shield_does_not_change_a_careful_driver(sumo: SumoBackend) -> None:
    ring = replace(RING, horizon=3000, length=(270, 270))
    trajectory = run_episode(ring, PISaturation(), (0,), backend=sumo).trajectories[0]
    assert trajectory.shield_braking.max() < 1e-9
    expected = np.maximum(trajectory.states.speed[:-1] + STEP * trajectory.applied_acceleration, 0.0)
    np.testing.assert_allclose(trajectory.states.speed[1:], expected, rtol=0, atol=1e-9)
    assert np.abs(trajectory.applied_acceleration).max() > 0.1


def test_the_shield_of_a_held_command_is_its_hardest_braking(sumo: SumoBackend) -> None:
    fine = run_episode(replace(RING, horizon=1000), Constant(1.0), (0,), backend=sumo)
    ring = replace(RING, horizon=200, steps_per_control_step=5)
    coarse = run_episode(ring, Constant(1.0), (0,), backend=sumo)
    expected = fine.trajectories[0].shield_braking.reshape(200, 5).max(1)
    np.testing.assert_array_equal(coarse.trajectories[0].shield_braking, expected)


def test_flow_never_exceeds_the_human_model(sumo: SumoBackend) -> None:
    commands = np.random.default_rng(1).uniform(-0.4, 1.0, 3000)
    ring = replace(RING, horizon=3000, actuation="flow", cavs=2)
    for driver in (Constant(1.0), Playback(commands)):
        episode = run_episode(ring, driver, (0,), backend=sumo)
        assert episode.status == "completed"
        for trajectory in episode.trajectories:
            place = episode.vehicle_ids.index(trajectory.vehicle)
            human = idm(episode)[:, place]
            assert (trajectory.states.speed[1:] <= human + 1e-9).all()
            commanded = np.maximum(trajectory.states.speed[:-1] + STEP * trajectory.applied_acceleration, 0.0)
            expected = np.minimum(commanded, human)
            np.testing.assert_allclose(trajectory.states.speed[1:], expected, rtol=0, atol=1e-9)
            assert (trajectory.shield_braking > 1e-6).any()


@pytest.mark.parametrize("limit", [0.4, 1.0, 3.0])
@pytest.mark.parametrize("wanted", [-50.0, 50.0])
def test_commands_stay_within_the_action_limit(limit: float, wanted: float, sumo: SumoBackend) -> None:
    ring = replace(RING, action_limit=limit, horizon=10, cavs=2)
    for driver in (Constant(wanted), Playback(np.full(10, wanted))):
        for scenario in (ring, replace(ring, cavs=1)):
            episode = run_episode(scenario, driver, (0,), backend=sumo)
            for trajectory in episode.trajectories:
                np.testing.assert_array_equal(trajectory.applied_acceleration, np.sign(wanted) * limit)
            assert episode.speeds[1, 0] == pytest.approx(max(np.sign(wanted) * limit * STEP, 0.0))


@pytest.mark.parametrize("kind", [Answers, PlainAnswers])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_acceleration_that_is_not_finite_is_refused_with_its_step(
    kind: type[Answers], value: float, sumo: SumoBackend
) -> None:
    with pytest.raises(InputError, match=f"driver: step 7: .*{value}.*allowed: finite"):
        run_episode(RING, kind(lambda speed: speed * 0.0 + value), (0,), backend=sumo)


def test_of_several_cavs_the_one_with_the_wrong_acceleration_is_named(sumo: SumoBackend) -> None:
    driver = Answers(lambda speed: np.array([0.0, np.nan, 0.0]))
    with pytest.raises(InputError, match="driver: step 7: acceleration of cav_7 is nan"):
        run_episode(replace(RING, cavs=3), driver, (0,), backend=sumo)


@pytest.mark.parametrize("cavs", [1, 3])
@pytest.mark.parametrize(
    "answer",
    [
        lambda speed: np.zeros(len(speed) + 1),
        lambda speed: np.zeros(0),
        lambda speed: speed[:, None] * 0.0,
        lambda speed: np.float64(0.5) if len(speed) > 1 else [],  # a single CAV may have a plain number
        lambda speed: np.array(0.5),
        lambda speed: None,
        lambda speed: np.array(["fast"] * len(speed)),
    ],
    ids=["one too many", "none", "column", "number", "no axis", "None", "words"],
)
def test_an_answer_that_is_not_one_number_for_each_cav_is_refused_with_its_step(
    answer: Callable[[Any], Any], cavs: int, sumo: SumoBackend
) -> None:
    with pytest.raises(InputError, match="driver: step 7: "):
        run_episode(replace(RING, cavs=cavs), Answers(answer), (0,), backend=sumo)


@pytest.mark.parametrize("kind", [np.int64, np.float32, bool])
def test_accelerations_may_have_any_numeric_type(kind: type, sumo: SumoBackend) -> None:
    expected, found = (
        run_episode(RING, Answers(answer), (0,), backend=sumo).speeds
        for answer in (lambda speed: np.ones(len(speed)), lambda speed: np.ones(len(speed), kind))
    )
    np.testing.assert_array_equal(found, expected)


def test_a_driver_recalls_the_last_minute_of_the_warm_up_oldest_first(sumo: SumoBackend) -> None:
    human = run_episode(replace(RING, horizon=900, cavs=2), Human(), (3,), backend=sumo)
    driver = Watcher()
    ring = replace(RING, warmup=750, cavs=2, horizon=20)
    episode = run_episode(ring, driver, (3,), backend=sumo)
    (history,) = driver.history
    for row, trajectory in enumerate(human.trajectories):
        for heard, was in zip(history[:7], trajectory.states[:7], strict=True):
            assert heard.shape == (2, 600)
            np.testing.assert_allclose(heard[row], was[150:750], rtol=0, atol=1e-9)
        for seen, was in zip(driver.perceived[0][:7], trajectory.states[:7], strict=True):
            assert seen[row] == pytest.approx(was[750], abs=1e-9)
    np.testing.assert_array_equal(episode.speeds[0], human.speeds[750])
    assert episode.warmup == 750


def test_a_short_warm_up_is_recalled_completely(sumo: SumoBackend) -> None:
    driver = Watcher()
    run_episode(replace(RING, warmup=7, horizon=5), driver, (3,), backend=sumo)
    human = run_episode(RING, Human(), (3,), backend=sumo).trajectories[0]
    np.testing.assert_array_equal(driver.history[0].speed, human.states.speed[None, :7])


def test_the_warm_up_is_recalled_once_per_control_step(sumo: SumoBackend) -> None:
    driver = Watcher()
    ring = replace(RING, warmup=752, horizon=4, steps_per_control_step=5)
    run_episode(ring, driver, (3,), backend=sumo)
    human = run_episode(replace(RING, horizon=800), Human(), (3,), backend=sumo).trajectories[0]
    moments = np.arange(752 - 120 * 5, 752, 5)
    assert driver.history[0].speed.shape == (1, 120)
    np.testing.assert_allclose(driver.history[0].leader_gap[0], human.states.leader_gap[moments], atol=1e-9)
    np.testing.assert_array_equal(driver.history[0].speed[0], human.states.speed[moments])


@pytest.mark.parametrize("changes", [{"warmup": 0}, {"warmup": 100, "remember_warmup": False}])
def test_no_warm_up_is_recalled_without_one_or_if_switched_off(changes: dict[str, Any], sumo: SumoBackend) -> None:
    driver = Watcher()
    run_episode(replace(RING, horizon=5, **changes), driver, (3,), backend=sumo)
    assert driver.history == []
    assert len(driver.perceived) == 5


def test_recalling_the_warm_up_changes_the_pi_driver(sumo: SumoBackend) -> None:
    ring = replace(RING, warmup=400)
    recalled, fresh = (
        run_episode(scenario, PISaturation(), (3,), backend=sumo).trajectories[0].applied_acceleration
        for scenario in (ring, replace(ring, remember_warmup=False))
    )
    assert not np.array_equal(recalled, fresh)


def test_observed_states_are_recorded(sumo: SumoBackend) -> None:
    driver = Watcher()
    episode = run_episode(replace(RING, cavs=3, horizon=80), driver, (3,), backend=sumo)
    for row, trajectory in enumerate(episode.trajectories):
        for name in COMMON_FIELDS:
            seen = [getattr(state, name)[row] for state in driver.perceived]
            np.testing.assert_allclose(seen, getattr(trajectory.states, name)[:-1], rtol=0, atol=1e-9)


@pytest.mark.parametrize("actuation", ["shielded", "raw", "flow"])
def test_a_command_is_held_for_the_steps_of_a_control_step(actuation: Any, sumo: SumoBackend) -> None:
    commands = np.random.default_rng(2).uniform(-0.8, 0.8, (60, 2))
    fine = replace(RING, cavs=2, horizon=300, warmup=50, actuation=actuation)
    coarse = replace(fine, horizon=60, steps_per_control_step=5)
    held = run_episode(coarse, Playback(commands), (1,), backend=sumo)
    each = run_episode(fine, Playback(np.repeat(commands, 5, 0)), (1,), backend=sumo)
    assert each.status == "completed"
    np.testing.assert_array_equal(held.speeds, each.speeds[::5])
    np.testing.assert_array_equal(held.positions, each.positions[::5])
    assert (held.control_steps, held.control_step, held.trajectories[0].states.speed.shape) == (60, 0.5, (61,))
    for row, trajectory in enumerate(held.trajectories):
        np.testing.assert_array_equal(trajectory.applied_acceleration, commands[:, row])


def test_a_finer_simulation_step_gives_similar_results(sumo: SumoBackend) -> None:
    ring = replace(RING, noise=0.0)
    coarse = run_episode(ring, IDM(), (0,), backend=sumo)
    fine = run_episode(replace(ring, simulation_step=0.05, steps_per_control_step=2), IDM(), (0,), backend=sumo)
    np.testing.assert_allclose(fine.speeds[-1], coarse.speeds[-1], atol=0.02)
    np.testing.assert_allclose(fine.positions[-1], coarse.positions[-1], atol=0.3)
    assert fine.control_step == coarse.control_step == 0.1


def test_positions_follow_from_speeds(sumo: SumoBackend) -> None:
    ring = replace(RING, warmup=30, cavs=3)
    episode = run_episode(ring, PISaturation(), (0,), backend=sumo)
    places = [episode.vehicle_ids.index(name) for name in episode.cav_ids]
    np.testing.assert_allclose(moves(episode)[:, places], episode.speeds[1:, places], atol=1e-9)
    quiet = run_episode(replace(ring, noise=0.0), PISaturation(), (0,), backend=sumo)
    np.testing.assert_allclose(moves(quiet), quiet.speeds[1:], atol=1e-9)
    ahead = np.roll(episode.positions, -1, 1)
    expected = (ahead - episode.positions) % episode.loop_length - 5.0
    np.testing.assert_allclose(episode.gaps, expected, atol=1e-9)
