import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import random_network
from tests.worlds.sumo.user_networks import straight
from tests.worlds.test_record import fingerprint
from unjam.drivers import IDM, Constant, Driver, FollowerStopper, Human, LocalState, PISaturation, ResidualDriver
from unjam.drivers.observation import local_observation
from unjam.drivers.safety import SafetyFilter
from unjam.drivers.user_driver import FileDriver
from unjam.errors import EpisodeError, InputError
from unjam.scenarios import Ring, make_scenario
from unjam.scenarios.road import ClosedRoad
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.simulation import Simulation

RING = Ring(horizon=300)
SHORT_RING = replace(RING, horizon=20)
UNFILTERED = replace(RING, safety=SafetyFilter(active=False))
RESIDUAL = ResidualDriver(PISaturation(), random_network(), 1.0)


def drives_badly(simulation: Simulation) -> None:
    ring = replace(UNFILTERED, actuation="raw", horizon=3000)
    assert run_episode(ring, Constant(1.0), (9,), backend=SumoBackend(simulation)).status == "collision"


def another_road(simulation: Simulation) -> None:
    ring = Ring(length=(130, 140), vehicles=11, cavs=3, warmup=77, horizon=50, simulation_step=0.2)
    driver = replace(RESIDUAL, expert=PISaturation(time_step=0.2))
    run_episode(ring, driver, (9,), explore=True, record_details=True, backend=SumoBackend(simulation))


def stops_in_the_middle(simulation: Simulation) -> None:
    class Stops(Driver):
        def act(self, state: LocalState, memory: dict) -> tuple:
            if state.route_position[0] > 0.5:
                raise KeyboardInterrupt
            return state.speed * 0.0 + 1.0, memory

    with pytest.raises(KeyboardInterrupt):
        run_episode(RING, Stops(), (9,), backend=SumoBackend(simulation))


def cannot_start(simulation: Simulation) -> None:
    with pytest.raises(EpisodeError):
        run_episode(replace(RING, emission_class="coal"), IDM(), (9,), backend=SumoBackend(simulation))


def uses_up_random_numbers(simulation: Simulation) -> None:
    random.seed(9)
    np.random.seed(9)
    run_episode(RING, IDM(), (9,), backend=SumoBackend(simulation))


@pytest.mark.parametrize(
    ("scenario", "driver"),
    [
        (RING, PISaturation()),
        (replace(RING, warmup=120), RESIDUAL),
        (replace(RING, cavs=2, steps_per_control_step=2), FollowerStopper(time_step=0.2)),
        (replace(RING, warmup=50, actuation="flow"), Human()),
    ],
)
@pytest.mark.parametrize(
    "before", [drives_badly, another_road, stops_in_the_middle, cannot_start, uses_up_random_numbers]
)
def test_an_episode_is_bit_identical_whatever_ran_before(
    scenario: Ring, driver: Driver, before: Callable[[Simulation], None]
) -> None:
    first = fingerprint(run_episode(scenario, driver, (1, 2), explore=True))
    with Simulation() as simulation:
        before(simulation)
        second = run_episode(scenario, driver, (1, 2), explore=True, backend=SumoBackend(simulation))
        before(simulation)
        third = run_episode(scenario, driver, (1, 2), explore=True, backend=SumoBackend(simulation))
    fourth = run_episode(scenario, driver, (1, 2), explore=True)
    assert [fingerprint(episode) for episode in (second, third, fourth)] == [first] * 3


def test_an_episode_without_a_simulation_closes_its_own(my_drivers: Path) -> None:
    with pytest.raises(InputError):
        run_episode(RING, FileDriver(my_drivers, "broken"), (0,))
    run_episode(replace(RING, horizon=1), IDM(), (0,))
    Simulation().close()


def test_an_episode_takes_a_scenario_by_name_and_class(sumo: SumoBackend) -> None:
    expected = fingerprint(run_episode(Ring(), Human(), 3, backend=sumo))
    for scenario in ("ring", Ring):
        assert fingerprint(run_episode(scenario, Human(), 3, backend=sumo)) == expected
    with pytest.raises(InputError, match=r"^scenario: 'rign' .*ring"):
        run_episode("rign", Human(), 3, backend=sumo)


def test_other_seeds_give_other_roads_and_other_noise(sumo: SumoBackend) -> None:
    seeds = [(0,), (1,), (2,), (0, 1), (1, 1), (1, 2, 3)]
    fixed = replace(RING, length=(230, 230))
    found = [run_episode(fixed, IDM(), seed, backend=sumo) for seed in seeds]
    assert len({episode.speeds.tobytes() for episode in found}) == len(seeds)
    assert [episode.seed for episode in found] == seeds
    short = replace(RING, horizon=1)
    lengths = {run_episode(short, IDM(), (seed,), backend=sumo).loop_length for seed in range(12)}
    assert len(lengths) > 6


def test_the_same_seed_is_the_same_traffic_for_every_driver(sumo: SumoBackend) -> None:
    ring = replace(RING, warmup=100, horizon=1)
    found = [run_episode(ring, driver, (4,), backend=sumo) for driver in (IDM(), Human(), Constant(1.0), RESIDUAL)]
    assert len({episode.speeds[0].tobytes() for episode in found}) == 1
    assert len({str(episode.drawn_values) for episode in found}) == 1


@pytest.mark.parametrize(("warmup", "held", "hold", "cavs"), [(0, 1, 1, 1), (30, 5, 1, 2), (0, 1, 7, 3)])
def test_records_have_a_row_for_each_control_step_and_one_for_the_end(
    warmup: int, held: int, hold: int, cavs: int, sumo: SumoBackend
) -> None:
    ring = replace(RING, horizon=60, warmup=warmup, steps_per_control_step=held, cavs=cavs)
    driver = replace(RESIDUAL, expert=PISaturation(time_step=ring.control_step), action_repeat=hold)
    episode = run_episode(ring, driver, (0,), backend=sumo)
    assert episode.control_steps == 60
    for array in (episode.speeds, episode.positions, episode.gaps):
        assert array.shape == (61, 22)
        assert np.isfinite(array).all()
    for trajectory in episode.trajectories:
        assert trajectory.start_step == 0
        assert {values.shape for values in trajectory.states if values is not None} == {(61,)}
        assert trajectory.observations.shape == (-(-60 // hold) + 1, 5)
        once = (
            trajectory.expert_acceleration,
            trajectory.residual,
            trajectory.applied_acceleration,
            trajectory.shield_braking,
        )
        assert {values.shape for values in once} == {(60,)}
        assert {values.shape for values in trajectory.reward_terms.values()} == {(60,)}
        assert trajectory.action_repeat == hold
        assert not trajectory.terminated
    assert (episode.status, episode.collisions, episode.warmup) == ("completed", 0, warmup)


@pytest.mark.parametrize("cavs", [1, 2, 3, 4, 22])
def test_each_trajectory_belongs_to_its_vehicle(cavs: int, sumo: SumoBackend) -> None:
    class Different(Driver):
        def act(self, state: LocalState, memory: dict) -> tuple:
            return np.linspace(0.1, 0.4, len(state.speed)), memory

    ring = replace(UNFILTERED, cavs=cavs, horizon=80)
    episode = run_episode(ring, Different(), (0,), backend=sumo)
    assert tuple(trajectory.vehicle for trajectory in episode.trajectories) == episode.cav_ids
    assert len(episode.cav_ids) == cavs
    for trajectory, push in zip(episode.trajectories, np.linspace(0.1, 0.4, cavs), strict=True):
        place = episode.vehicle_ids.index(trajectory.vehicle)
        ahead, behind = (place + 1) % 22, (place - 1) % 22
        states = trajectory.states
        np.testing.assert_array_equal(states.speed, episode.speeds[:, place])
        np.testing.assert_array_equal(states.leader_speed, episode.speeds[:, ahead])
        np.testing.assert_array_equal(states.leader_gap, episode.gaps[:, place])
        np.testing.assert_array_equal(states.follower_speed, episode.speeds[:, behind])
        np.testing.assert_array_equal(states.follower_gap, episode.gaps[:, behind])
        along = episode.positions[:, place] % episode.loop_length
        np.testing.assert_allclose(states.route_position, along, atol=1e-9)
        np.testing.assert_array_equal(states.loop_length, episode.loop_length)
        np.testing.assert_array_equal(trajectory.applied_acceleration, push)
        np.testing.assert_array_equal(trajectory.expert_acceleration, push)
        assert not trajectory.residual.any()


def test_the_values_drawn_from_the_seed_are_recorded(sumo: SumoBackend) -> None:
    episode = run_episode(RING, IDM(), (5,), backend=sumo)
    assert episode.drawn_values == {"length": episode.loop_length}
    assert 220 <= episode.loop_length <= 270
    assert 3.0 <= episode.limit_speed <= 5.27
    np.testing.assert_allclose(episode.positions[0], np.arange(22) * episode.loop_length / 22, atol=1e-9)
    assert episode.outline[-1, 0] == episode.loop_length


@pytest.mark.parametrize("cavs", [1, 2])
@pytest.mark.parametrize("hold", [1, 7])
@pytest.mark.parametrize("expert", [PISaturation(time_constant=0), IDM()])
def test_expert_and_residual_add_up_to_the_applied_acceleration(
    cavs: int, hold: int, expert: Driver, sumo: SumoBackend
) -> None:
    ring = replace(RING, cavs=cavs, horizon=500, warmup=50)
    driver = ResidualDriver(expert, random_network(), 0.5, action_repeat=hold)
    calm, explored = (run_episode(ring, driver, (0,), explore=explore, backend=sumo) for explore in (False, True))
    for episode in (calm, explored):
        for trajectory in episode.trajectories:
            total = np.clip(trajectory.expert_acceleration + trajectory.residual, -0.5, 0.5)
            np.testing.assert_array_equal(trajectory.applied_acceleration, total)
            assert np.abs(trajectory.expert_acceleration).max() <= 0.5
            seen = local_observation(trajectory.states.select(slice(None, None, hold)))
            looks = len(trajectory.observations) - 1
            np.testing.assert_allclose(trajectory.observations[:-1], seen[:looks], atol=1e-12)
            end = local_observation(trajectory.states.select(slice(-1, None)))
            np.testing.assert_allclose(trajectory.observations[-1:], end, atol=1e-12)
    for trajectory in calm.trajectories:
        wanted = driver.network(trajectory.observations[:-1])
        np.testing.assert_allclose(trajectory.residual, np.repeat(wanted, hold)[:500], atol=1e-12)
        assert np.abs(trajectory.residual).max() > 0.01


@pytest.mark.long
@pytest.mark.parametrize("cavs", [1, 2])
@pytest.mark.parametrize("hold", [1, 5])
def test_exploration_adds_noise_with_the_networks_standard_deviation(cavs: int, hold: int, sumo: SumoBackend) -> None:
    driver = replace(RESIDUAL, action_repeat=hold)
    ring = replace(RING, cavs=cavs, horizon=1000 * hold)
    episode = run_episode(ring, driver, (0,), explore=True, backend=sumo)
    noises = []
    for trajectory in episode.trajectories:
        chosen, _ = trajectory.actions_and_rewards
        np.testing.assert_array_equal(trajectory.residual, np.repeat(chosen, hold))
        noises.append(chosen - driver.network(trajectory.observations[:-1]))
        assert noises[-1].std() == pytest.approx(0.2, rel=0.06)
        assert abs(noises[-1].mean()) < 0.03
        assert abs(np.corrcoef(noises[-1][:-1], noises[-1][1:])[0, 1]) < 0.1
    if cavs == 2:
        assert abs(np.corrcoef(*noises)[0, 1]) < 0.1


def test_exploration_depends_on_the_seed_and_does_not_change_the_traffic_noise(sumo: SumoBackend) -> None:
    ring = replace(RING, length=(230, 230), horizon=100)
    mute = replace(RESIDUAL, network=replace(RESIDUAL.network, exploration_std=0.0))
    still = run_episode(ring, mute, (0,), backend=sumo)
    explored = run_episode(ring, mute, (0,), explore=True, backend=sumo)
    np.testing.assert_array_equal(explored.speeds, still.speeds)
    first, second = (run_episode(ring, RESIDUAL, (seed,), explore=True, backend=sumo) for seed in (0, 1))
    noises = [
        trajectory.residual - RESIDUAL.network(trajectory.observations[:-1])
        for trajectory in (first.trajectories[0], second.trajectories[0])
    ]
    assert np.abs(noises[0] - noises[1]).min() > 0.0


def test_a_driver_without_a_network_has_no_residual(sumo: SumoBackend) -> None:
    driver = PISaturation(time_constant=0)
    episode = run_episode(RING, driver, (0,), explore=True, backend=sumo)
    trajectory = episode.trajectories[0]
    np.testing.assert_array_equal(trajectory.expert_acceleration, trajectory.applied_acceleration)
    assert not trajectory.residual.any()
    assert trajectory.observations.shape == (1, 0)
    still = run_episode(RING, driver, (0,), backend=sumo)
    assert fingerprint(still) == fingerprint(episode)


def test_recording_fuel_is_optional_and_changes_nothing_else(sumo: SumoBackend) -> None:
    without = run_episode(RING, IDM(), (0,), backend=sumo)
    episode = run_episode(RING, IDM(), (0,), record_details=True, backend=sumo)
    assert without.fuel.shape == (0, 0)
    assert episode.fuel.shape == (300, 22)
    assert (episode.fuel >= 0.0).all()
    assert (episode.fuel > 0.0).mean() > 0.5
    # A petrol car burns about a litre an hour standing still, and some ten driving slowly [mg/s].
    assert 100.0 < episode.fuel.mean() < 3000.0
    assert fingerprint(replace(episode, fuel=without.fuel)) == fingerprint(without)


def test_fuel_depends_on_the_emission_class(sumo: SumoBackend) -> None:
    van = replace(RING, emission_class="HBEFA4/LCV_diesel_N1-III_Euro-6ab")
    car, other = (
        run_episode(scenario, IDM(), (0,), record_details=True, backend=sumo).fuel.mean() for scenario in (RING, van)
    )
    assert other > 1.1 * car


def test_the_default_reward_is_the_scenarios_own(sumo: SumoBackend) -> None:
    episode = run_episode(RING, PISaturation(), (0,), backend=sumo)
    trajectory = episode.trajectories[0]
    assert set(trajectory.reward_terms) == {"speed", "acceleration"}
    np.testing.assert_allclose(trajectory.reward_terms["speed"], 0.2 * episode.speeds[1:].mean(1), atol=1e-12)
    np.testing.assert_allclose(trajectory.reward_terms["acceleration"], -4.0 * np.abs(trajectory.applied_acceleration))


def test_named_rewards_and_users_rewards_are_used(my_drivers: Path, sumo: SumoBackend) -> None:
    ring = replace(UNFILTERED, cavs=2)
    found = run_episode(ring, Constant(0.2), (0,), "eq16", backend=sumo).trajectories
    assert set(found[0].reward_terms) == {"speed", "time_gap", "acceleration"}
    episode = run_episode(ring, Constant(0.2), (0,), f"{my_drivers}:calm", backend=sumo)
    for trajectory in episode.trajectories:
        assert set(trajectory.reward_terms) == {"speed", "push"}
        np.testing.assert_allclose(trajectory.reward_terms["speed"], episode.speeds[1:].mean(1))
        np.testing.assert_allclose(trajectory.reward_terms["push"], -0.4)


def test_time_gaps_of_a_reward_are_those_after_each_step(sumo: SumoBackend) -> None:
    episode = run_episode(UNFILTERED, Constant(1.0), (0,), "eq16", backend=sumo)
    trajectory = episode.trajectories[0]
    gap, speed = trajectory.states.leader_gap[1:], trajectory.states.speed[1:]
    expected = [-0.1 * max(1.0 - g / max(v, 1e-3), 0.0) for g, v in zip(gap, speed, strict=True)]
    np.testing.assert_allclose(trajectory.reward_terms["time_gap"], expected, atol=1e-12)
    assert trajectory.reward_terms["time_gap"].min() < 0.0


BAD_REWARDS = """
import numpy as np

def late(outcome):
    speed = outcome.speeds.mean(-1)
    return {"good": speed, "bad": np.where(np.arange(len(speed)) == 7, np.inf, speed)}

def large(outcome):
    return {"good": outcome.speeds.mean(-1), "bad": np.full(len(outcome.speeds), -1e308)}

def empty(outcome):
    return {}

def total(outcome):
    return outcome.speeds.mean()

def each_vehicle(outcome):
    return {"speed": outcome.speeds}

def listed(outcome):
    return {"speed": [1] * len(outcome.has_crashed)}
"""


def test_a_reward_that_is_not_finite_is_refused_with_its_term_and_step(
    my_drivers: Path, tmp_path: Path, sumo: SumoBackend
) -> None:
    with pytest.raises(InputError, match=r"reward mine\.py:wrong_reward: step 0: term 'speed' is nan; allowed: finite"):
        run_episode(RING, IDM(), (0,), f"{my_drivers}:wrong_reward", backend=sumo)
    file = tmp_path / "rewards.py"
    file.write_text(BAD_REWARDS)
    with pytest.raises(InputError, match=r"reward rewards\.py:late: step 7: term 'bad' is inf; allowed: finite"):
        run_episode(RING, IDM(), (0,), f"{file}:late", backend=sumo)
    with pytest.raises(InputError, match=r"large: step 0: term 'bad' is -1e\+308; allowed: finite, at most 1e\+30"):
        run_episode(RING, IDM(), (0,), f"{file}:large", backend=sumo)
    with pytest.raises(InputError, match=r"empty: it has no terms; allowed: at least one"):
        run_episode(RING, IDM(), (0,), f"{file}:empty", backend=sumo)
    with pytest.raises(InputError, match=r"term 'speed' is .*e\+20\d; allowed: finite, at most 1e\+30"):
        run_episode(RING, IDM(), (0,), "released:speed=1e208", backend=sumo)


@pytest.mark.parametrize("name", ["total", "each_vehicle"])
def test_a_reward_of_a_wrong_shape_is_refused(name: str, tmp_path: Path, sumo: SumoBackend) -> None:
    file = tmp_path / "rewards.py"
    file.write_text(BAD_REWARDS)
    with pytest.raises(
        InputError,
        match=rf"reward rewards\.py:{name}: term '\w+' has shape .*; allowed: \(300,\), one for each control step",
    ):
        run_episode(RING, IDM(), (0,), f"{file}:{name}", backend=sumo)


def test_a_reward_may_return_lists_of_integers(tmp_path: Path, sumo: SumoBackend) -> None:
    file = tmp_path / "rewards.py"
    file.write_text(BAD_REWARDS)
    episode = run_episode(RING, IDM(), (0,), f"{file}:listed", backend=sumo)
    assert episode.trajectories[0].reward_terms["speed"].dtype == np.float64


def test_an_unknown_reward_is_refused_before_anything_runs() -> None:
    with pytest.raises(InputError, match="reward: 'fame' is not allowed"):
        run_episode(RING, IDM(), (0,), "fame")


def test_progress_is_reported_during_warm_up_and_episode(sumo: SumoBackend) -> None:
    reported: list[int] = []
    ring = replace(RING, warmup=1200, horizon=2600)
    run_episode(ring, IDM(), (0,), backend=sumo, on_progress=reported.append)
    assert reported == sorted(reported)
    assert reported.count(0) >= 2
    assert 2000 < reported[-1] <= 2600
    assert len(set(reported)) >= 4


def test_a_trajectory_has_the_experts_memory_of_the_warm_up(sumo: SumoBackend) -> None:
    warm = Ring(length=(230, 230), vehicles=8, horizon=20, warmup=30)
    driver = ResidualDriver(PISaturation(), random_network(), 1.0, action_repeat=5)
    trajectory = run_episode(warm, driver, (3,), backend=sumo).trajectories[0]
    assert set(trajectory.initial_memory) == {"window", "total", "count", "command"}
    assert trajectory.initial_memory["count"] == 30
    memory = {name: values[None] for name, values in trajectory.initial_memory.items()}
    for step in range(20):
        seen = trajectory.states.select(slice(step, step + 1))
        expert, memory = driver.expert.act(seen, memory)
        assert np.clip(expert[0], -1.0, 1.0) == pytest.approx(trajectory.expert_acceleration[step], abs=1e-12)


def insists(state: LocalState) -> np.ndarray:
    """Drives as it would, and takes two from all that it is shown, by force where it must."""
    wanted = np.clip(0.5 * np.subtract(state.leader_speed, state.speed), -1, 1)
    for values in filter(lambda each: each is not None, state):
        with pytest.raises(ValueError, match="read-only"):
            values -= 2.0
        values.flags.writeable = True
        values -= 2.0
    return wanted


@pytest.mark.parametrize("road", ["ring", "figure-eight", "merge", "on-ramp", "own"])
def test_a_driver_cannot_change_its_measurements(road: str, sumo: SumoBackend, tmp_path: Path) -> None:
    if road == "own":
        flow = '<flow id="f" type="car" route="along" begin="0" end="60" period="3"/>'
        road = str(straight(tmp_path, flow, length=300.0))
    closed = road in ("ring", "figure-eight")
    share = {"cavs": 2, "warmup": 0} if closed else {"penetration_rate": 0.5}
    scenario = make_scenario(road, {**share, "horizon": 30})

    def honest(state: LocalState) -> np.ndarray:
        return np.clip(0.5 * np.subtract(state.leader_speed, state.speed), -1, 1)

    driven = [run_episode(scenario, driver, (0,), backend=sumo) for driver in (honest, insists)]
    assert driven[0].trajectories
    assert fingerprint(driven[0]) == fingerprint(driven[1])


def test_a_seed_may_be_any_non_negative_integer(sumo: SumoBackend) -> None:
    first, *others = (run_episode(SHORT_RING, PISaturation(), seed, backend=sumo) for seed in (3, np.int64(3), [3]))
    assert all(np.array_equal(first.speeds, other.speeds) for other in others)
    for wrong in (-1, "1", 0.5, [0.5]):
        with pytest.raises(InputError, match=r"seed: .* is not allowed; allowed: an integer >= 0"):
            run_episode(SHORT_RING, PISaturation(), wrong, backend=sumo)  # pyright: ignore[reportArgumentType]


def test_an_episode_in_sumo_draws_its_road_once(monkeypatch: pytest.MonkeyPatch, sumo: SumoBackend) -> None:
    drawn, draw = list[ClosedRoad](), Ring.draw

    def noted(self: Ring, generator: np.random.Generator) -> ClosedRoad:
        drawn.append(draw(self, generator))
        return drawn[-1]

    monkeypatch.setattr(Ring, "draw", noted)
    run_episode(replace(SHORT_RING, horizon=2), IDM(), (1,), backend=sumo)
    assert len(drawn) == 1
