import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import ArrayLike

from unjam.drivers import LocalState
from unjam.measures.metrics import METRICS, measure
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.audit import Audit, BrakingStatistics, FollowingStatistics, following_statistics
from unjam.worlds.ordered_road import loop_neighbors, loop_state
from unjam.worlds.record import Episode, Floats, Trajectory, Trips, failed_episode
from unjam.worlds.reward import episode_reward_terms

LENGTH = 200.0
LIMIT = 8.0


def trajectory_of(states: LocalState, applied: ArrayLike = 0.0, **changes: Any) -> Trajectory:
    steps = len(states.speed) - 1
    values: dict[str, Any] = {
        "vehicle": "cav_0",
        "start_step": 0,
        "states": states,
        "observations": np.zeros((1, 0)),
        "expert_acceleration": np.zeros(steps),
        "residual": np.zeros(steps),
        "applied_acceleration": np.zeros(steps) + np.asarray(applied),
        "filter_braking": np.zeros(steps),
        "shield_braking": np.zeros(steps),
        "reward_terms": {"reward": np.zeros(steps)},
        "initial_memory": {},
        "action_repeat": 1,
        "terminated": False,
    }
    return Trajectory(**{**values, **changes})


def followed_in(states: LocalState, cavs: int, step: float) -> FollowingStatistics:
    """Following statistics of the first `cavs` vehicles; states have the shape (vehicles, steps)."""
    speed, leader, gap = (values[:cavs].T for values in states[:3])
    return following_statistics(speed, leader, gap, step)


def episode_of(
    speeds: ArrayLike, cavs: int = 1, step: float = 0.1, applied: ArrayLike = 0.0, **changes: Any
) -> Episode:
    """Vehicles with these speeds, shape (T + 1, N), evenly spread at the start; the first ones are CAVs."""
    moved = np.asarray(speeds, float)
    vehicles = moved.shape[1]
    positions = np.arange(vehicles) * (LENGTH / vehicles) + np.cumsum(moved, axis=0) * step - moved[0] * step
    states = loop_state(moved.T, positions.T, loop_neighbors(np.arange(vehicles), vehicles), LENGTH)
    angles = np.linspace(0, 2 * np.pi, 81)
    radius = LENGTH / (2 * np.pi)
    values: dict[str, Any] = {
        "seed": (0,),
        "status": "completed",
        "control_step": step,
        "drawn_values": {"length": LENGTH},
        "loop_length": LENGTH,
        "limit_speed": LIMIT,
        "vehicle_ids": tuple(f"{'cav' if n < cavs else 'human'}_{n}" for n in range(vehicles)),
        "cav_ids": tuple(f"cav_{n}" for n in range(cavs)),
        "audit": Audit(following=followed_in(states, cavs, step)),
        "speeds": moved,
        "positions": positions,
        "gaps": states.leader_gap.T,
        "outline": np.column_stack([angles * radius, radius * np.cos(angles), radius * np.sin(angles)]),
        "trajectories": tuple(trajectory_of(states.select(n), applied) for n in range(cavs)),
    }
    return Episode(**{**values, **changes})


def steady(speed: float, steps: int = 100, vehicles: int = 5) -> Floats:
    return np.full((steps + 1, vehicles), float(speed))


def metric(name: str, episode: Episode) -> float:
    return METRICS[name].function(episode)


def wave(waves: list[tuple[float, bool]], vehicles: int = 4, step: float = 0.1) -> Floats:
    """Speeds of traffic that for each (seconds, whether it is calm) is calm, or has a std of 1 m/s."""
    calm, waving = np.full(vehicles, 4.0), np.where(np.arange(vehicles) % 2, 3.0, 5.0)
    rows = [calm if is_calm else waving for seconds, is_calm in waves for _ in range(round(seconds / step))]
    return np.array(rows)


def test_uniform_traffic_has_its_speed_and_no_waves() -> None:
    row = measure(episode_of(steady(4.0)))
    for name in ("mean_speed", "mean_speed_steady", "cav_mean_speed"):
        assert row[name] == pytest.approx(4.0)
    for name in ("speed_std_fleet", "speed_std_fleet_steady", "speed_std_cav", "mean_abs_jerk", "share_standing"):
        assert row[name] == pytest.approx(0.0)
    assert row["speed_limit_ratio"] == row["speed_limit_ratio_steady"] == pytest.approx(0.5)
    assert row["min_ttc"] == np.inf
    assert row["min_time_gap"] == pytest.approx((LENGTH / 5 - VEHICLE_LENGTH) / 4.0)
    assert row["outflow_veh_per_h"] == pytest.approx(5 * 4.0 / LENGTH * 3600)
    assert row["steps"] == 100


def test_speed_std_of_two_groups() -> None:
    row = measure(episode_of(np.tile([2.0, 6.0, 2.0, 6.0], (51, 1))))
    assert row["mean_speed"] == pytest.approx(4.0)
    assert row["speed_std_fleet"] == pytest.approx(2.0)


def test_mean_speed_includes_the_start_up_and_steady_speed_does_not() -> None:
    speeds = np.vstack([steady(1.0, 500), steady(7.0, 0), steady(4.0, 998)])
    row = measure(episode_of(speeds))
    assert row["steps"] == 1500
    assert row["mean_speed"] == pytest.approx((500 * 1.0 + 7.0 + 999 * 4.0) / 1500)
    assert row["mean_speed_steady"] == pytest.approx((7.0 + 999 * 4.0) / 1000)
    assert row["speed_limit_ratio"] == pytest.approx(row["mean_speed"] / LIMIT)
    assert row["speed_limit_ratio_steady"] == pytest.approx(row["mean_speed_steady"] / LIMIT)


def test_wave_before_the_steady_state_counts_only_in_the_mean() -> None:
    row = measure(episode_of(np.vstack([wave([(50.0, False)]), steady(4.0, 1000, 4)])))
    assert row["speed_std_fleet"] == pytest.approx(499 / 1500, rel=0.01)
    assert row["speed_std_fleet_steady"] == pytest.approx(0.0)


def test_initial_state_does_not_count() -> None:
    speeds = steady(4.0)
    speeds[0] = [9.0, 0.0, 3.0, 9.0, 0.0]
    row = measure(episode_of(speeds))
    assert row["mean_speed"] == pytest.approx(4.0)
    assert row["speed_std_fleet"] == pytest.approx(0.0)
    assert row["share_standing"] == 0.0
    assert row["cav_mean_speed"] == pytest.approx(4.0)
    assert row["speed_std_cav"] == pytest.approx(0.0)


def test_paper_metrics_cover_the_cav_and_fleet_metrics_all_vehicles() -> None:
    slow_cav = measure(episode_of(np.tile([2.0, 6.0, 6.0, 6.0], (51, 1))))
    assert slow_cav["cav_mean_speed"] == pytest.approx(2.0)
    assert slow_cav["mean_speed"] == pytest.approx(5.0)
    assert slow_cav["speed_std_cav"] == pytest.approx(0.0)
    assert slow_cav["speed_std_fleet"] == pytest.approx(np.sqrt(3.0))

    together = np.repeat(np.array([[5.0], *([[3.0], [5.0]] * 50)]), 4, axis=1)
    pulsing = measure(episode_of(together))
    assert pulsing["speed_std_cav"] == pytest.approx(1.0)
    assert pulsing["speed_std_fleet"] == pytest.approx(0.0)


def test_metrics_of_several_cavs_are_averaged() -> None:
    row = measure(episode_of(np.tile([2.0, 4.0, 6.0, 6.0], (11, 1)), cavs=2))
    assert row["cav_mean_speed"] == pytest.approx(3.0)


def test_wave_is_dissolved_once_traffic_stays_calm() -> None:
    episode = episode_of(wave([(20.0, False), (70.0, True)]))
    assert metric("time_to_dissolve", episode) == pytest.approx(20.0)


def test_short_calm_period_does_not_count_as_dissolved() -> None:
    episode = episode_of(wave([(20.0, False), (59.0, True), (5.0, False), (61.0, True), (5.0, False)]))
    assert metric("time_to_dissolve", episode) == pytest.approx(84.0)


@pytest.mark.parametrize(
    ("waves", "why"),
    [
        ([(80.0, True)], "calm from the start"),
        ([(1.0, True), (20.0, False), (90.0, True)], "calm at the start"),
        ([(80.0, False)], "never calm"),
        ([(20.0, False), (59.0, True)], "calm for too short a time at the end"),
        ([(20.0, False), (59.0, True), (20.0, False)], "calm for too short a time in between"),
        ([(10.0, False)], "shorter than calm has to last"),
    ],
)
def test_time_to_dissolve_is_nan_without_a_wave_or_a_calm_end(waves: list[tuple[float, bool]], why: str) -> None:
    assert np.isnan(metric("time_to_dissolve", episode_of(wave(waves)))), why


@pytest.mark.parametrize("step", [0.1, 0.2, 1.0])
def test_time_to_dissolve_is_in_seconds_for_any_step(step: float) -> None:
    episode = episode_of(wave([(30.0, False), (65.0, True)], step=step), step=step)
    assert metric("time_to_dissolve", episode) == pytest.approx(30.0)


def test_standing_is_below_a_tenth_of_a_meter_per_second() -> None:
    assert metric("share_standing", episode_of(np.tile([0.0, 0.09, 0.1, 4.0], (11, 1)))) == pytest.approx(0.5)


def test_vehicles_off_the_road_are_left_out() -> None:
    speeds = np.tile([4.0, 0.0, 8.0, np.nan], (11, 1))
    episode = episode_of(speeds)
    assert metric("mean_speed", episode) == pytest.approx(4.0)
    assert metric("speed_std_fleet", episode) == pytest.approx(np.std([4.0, 0.0, 8.0]))
    assert metric("share_standing", episode) == pytest.approx(1 / 3)


def cav_states(**changes: list[float]) -> LocalState:
    """What a CAV perceives that follows at the speed of all others, but for `changes`."""
    steps = len(next(iter(changes.values())))
    usual = {"speed": 5.0, "leader_speed": 5.0, "leader_gap": 10.0, "follower_speed": 5.0, "follower_gap": 10.0}
    values = {name: np.full(steps, value) for name, value in usual.items()}
    values |= {name: np.array(value, float) for name, value in changes.items()}
    return LocalState(**values, route_position=np.zeros(steps), loop_length=np.full(steps, LENGTH))


def with_states(states: LocalState) -> Episode:
    column = states.map(lambda values: np.asarray(values)[None])
    audit, cav = Audit(following=followed_in(column, 1, 0.1)), trajectory_of(states)
    return episode_of(steady(5.0, len(states.speed) - 1), trajectories=(cav,), audit=audit)


def test_time_to_collision_of_a_closing_pair() -> None:
    states = cav_states(leader_gap=[12.0, 9.0, 8.0], leader_speed=[6.0, 3.0, 4.0])
    assert metric("min_ttc", with_states(states)) == pytest.approx(4.5)  # 9 m at 2 m/s; 8 m at 1 m/s take 8 s


def test_time_to_collision_includes_the_follower() -> None:
    states = cav_states(follower_gap=[10.0, 6.0, 6.0], follower_speed=[5.0, 8.0, 4.0])
    assert metric("min_ttc", with_states(states)) == pytest.approx(2.0)  # 6 m at 3 m/s


def test_time_to_collision_is_infinite_without_closing() -> None:
    assert metric("min_ttc", with_states(cav_states(leader_gap=[2.0, 2.0], leader_speed=[6.0, 6.0]))) == np.inf


def test_time_gap_counts_only_while_the_cav_moves() -> None:
    states = cav_states(speed=[0.5, 1.0, 2.0, 5.0], leader_gap=[0.1, 0.2, 3.0, 10.0])
    assert metric("min_time_gap", with_states(states)) == pytest.approx(1.5)
    assert np.isnan(metric("min_time_gap", with_states(cav_states(speed=[0.5, 0.9]))))


def test_constant_jerk_is_measured() -> None:
    times = np.arange(51) * 0.1
    speeds = steady(4.0, 50)
    speeds[:, 0] = 0.5 * 0.6 * times**2
    assert metric("mean_abs_jerk", episode_of(speeds)) == pytest.approx(0.6)


def test_jerk_counts_both_directions() -> None:
    speeds = steady(4.0, 4)
    speeds[:, 0] = [4.0, 4.1, 4.1, 4.1, 4.0]  # accelerations 1, 0, 0, -1: two changes of 1 in 0.1 s among three
    assert metric("mean_abs_jerk", episode_of(speeds)) == pytest.approx(2 * 10.0 / 3)


def test_acceleration_is_the_commanded_one() -> None:
    assert metric("mean_abs_accel", episode_of(steady(4.0, 4), applied=[1.0, -0.5, 0.0, 0.5])) == pytest.approx(0.5)


def test_outflow_of_a_loop_is_the_flow_past_a_point() -> None:
    speeds = np.tile([2.0, 4.0, 6.0, 8.0], (1001, 1))
    assert metric("outflow_veh_per_h", episode_of(speeds)) == pytest.approx(20.0 / LENGTH * 3600)


def test_constant_fuel_rate_is_measured() -> None:
    episode = episode_of(steady(4.0, 50), fuel=np.full((50, 5), 371.0))
    assert metric("fuel_ml_per_km", episode) == pytest.approx(0.5 / 4.0 * 1000)  # half a ml/s at 4 m/s


def test_unrecorded_fuel_is_nan() -> None:
    assert np.isnan(metric("fuel_ml_per_km", episode_of(steady(4.0))))


def test_return_counts_shared_reward_terms_once() -> None:
    terms = {"a": np.array([1.0, 2.0, 3.0]), "b": np.array([-1.0, 0.0, 0.0])}
    shares = tuple(trajectory_of(cav_states(speed=[5.0] * 4), reward_terms=terms) for _ in range(2))
    for cavs in ((), shares[:1], shares):
        episode = episode_of(steady(5.0, 3), trajectories=cavs, reward_terms=terms)
        assert metric("return", episode) == pytest.approx(5.0)


def test_return_eq16_rewards_speed_and_penalizes_acceleration_and_short_time_gaps() -> None:
    states = cav_states(speed=[5.0] * 3, leader_gap=[10.0, 2.5, 10.0])
    episode = episode_of(steady(5.0, 2), trajectories=(trajectory_of(states, [1.0, -0.5]),))
    assert metric("return_eq16", episode) == pytest.approx(2 * 5.0 - 0.1 * 0.5 - 0.1 * 1.5)


def test_shield_metrics_count_overrides_and_their_size() -> None:
    states = cav_states(speed=[5.0] * 5)
    first, second = np.array([0.0, 1e-9, 0.5, 3.0]), np.array([0.0, 0.0, 0.0, 1.0])
    cavs = tuple(trajectory_of(states, shield_braking=shield) for shield in (first, second))
    episode = episode_of(steady(5.0, 4), trajectories=cavs)
    assert metric("shield_override_share", episode) == pytest.approx(3 / 8)
    assert metric("shield_max_braking", episode) == pytest.approx(3.0)


def test_collision_is_measured_up_to_its_end() -> None:
    episode = episode_of(steady(4.0, 20), status="collision", collisions=2)
    row = measure(episode)
    assert row["status"] == "collision"
    assert row["collisions"] == 2.0
    assert row["mean_speed"] == pytest.approx(4.0)
    cav_states = (episode.speeds, episode.trajectories)
    crashed, calm = (
        episode_reward_terms(lambda outcome: {"end": 1.0 * outcome.has_crashed}, *cav_states, end, episode.backlog)[
            "end"
        ]
        for end in (True, False)
    )
    assert np.flatnonzero(crashed).tolist() == [20 - 1]
    assert not calm.any()


def test_collision_in_the_first_step_is_measured_without_warnings() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        row = measure(episode_of(steady(4.0, 1), status="collision", collisions=2))
    assert row["steps"] == 1
    assert row["mean_speed"] == pytest.approx(4.0)
    assert np.isnan(row["mean_abs_jerk"])


def test_failed_episode_has_a_reason_and_no_metrics() -> None:
    row = measure(failed_episode((3,), "SUMO cannot start: no road", "EpisodeError"))
    assert (row["seed"], row["status"]) == (3, "failed")
    assert (row["reason"], row["error"]) == ("SUMO cannot start: no road", "EpisodeError")
    assert all(np.isnan(row[name]) for name in METRICS)


def test_row_has_facts_drawn_values_and_every_metric() -> None:
    row = measure(episode_of(steady(4.0), seed=(7, 1)))
    about = {
        *("seed", "sumo_seed"),
        "status",
        "reason",
        "error",
        "warnings",
        "vehicles",
        "steps",
        "length",
        "required_time_gap",
        "has_lanes",
        *("teleports", "contacts"),
        "feasibility",
    }
    assert set(row) == about | set(METRICS)
    assert row["seed"] == [7, 1]
    assert row["length"] == LENGTH
    assert measure(episode_of(steady(4.0), seed=(7,)))["seed"] == 7
    assert all(isinstance(row[name], float) for name in METRICS)


def test_hard_braking_of_human_drivers_is_the_same_with_a_cav_that_changes_nothing() -> None:
    """One human driver brakes hard twice; in one episode another vehicle of five is a CAV."""
    twice = BrakingStatistics(max_braking=5.0, exceedances=(2, 2, 0))
    human = Audit(human_braking=replace(twice, samples=500))
    mixed = Audit(human_braking=replace(twice, samples=400), cav_braking=BrakingStatistics(samples=100))
    values = [metric("human_braking_beyond_4_5", episode_of(steady(4.0), audit=each)) for each in (human, mixed)]
    assert values == [4000.0, 4000.0]


@pytest.mark.parametrize("name", METRICS)
def test_every_metric_is_defined_with_its_unit(name: str) -> None:
    about, unit = METRICS[name].function.__doc__ or "", METRICS[name].unit
    assert len(about) > 20
    if unit:
        assert f"[{unit}]" in about
    else:
        assert "[" not in about


SPEEDS = arrays(
    np.float64,
    st.tuples(st.integers(2, 12), st.integers(2, 6)),
    elements=st.integers(0, 300).map(lambda tenths: tenths / 10),
)


@given(SPEEDS)
def test_speed_std_is_zero_only_for_equal_speeds(speeds: Floats) -> None:
    found = metric("speed_std_fleet", episode_of(speeds))
    alike = bool((np.ptp(speeds[1:], axis=1) == 0).all())
    assert (found < 1e-9) == alike


@given(SPEEDS, st.sampled_from([0.25, 2.0, 10.0]))
def test_speed_metrics_scale_with_their_unit(speeds: Floats, scale: float) -> None:
    for name in ("mean_speed", "speed_std_fleet", "speed_std_cav", "cav_mean_speed", "outflow_veh_per_h"):
        value, scaled = metric(name, episode_of(speeds)), metric(name, episode_of(speeds * scale))
        assert scaled == pytest.approx(value * scale, abs=1e-9)


@given(SPEEDS, st.randoms(use_true_random=False))
def test_fleet_metrics_do_not_depend_on_the_order_of_vehicles(speeds: Floats, chance: Any) -> None:
    order = list(range(speeds.shape[1]))
    chance.shuffle(order)
    for name in ("mean_speed", "speed_std_fleet", "share_standing", "outflow_veh_per_h"):
        one, other = episode_of(speeds), episode_of(speeds[:, order])
        assert metric(name, one) == pytest.approx(metric(name, other), abs=1e-9)


@given(SPEEDS)
def test_metrics_stay_within_their_bounds(speeds: Floats) -> None:
    row = measure(episode_of(speeds))
    assert speeds[1:].min() - 1e-9 <= row["mean_speed"] <= speeds[1:].max() + 1e-9
    assert 0 <= row["speed_std_fleet"] <= np.ptp(speeds[1:]) / 2 + 1e-9
    assert 0 <= row["share_standing"] <= 1
    assert row["speed_limit_ratio"] * LIMIT == pytest.approx(row["mean_speed"])


@given(st.floats(0.5, 20.0), st.sampled_from([0.05, 0.1, 0.5]))
def test_flow_of_uniform_traffic_is_density_times_speed(speed: float, step: float) -> None:
    found = metric("outflow_veh_per_h", episode_of(steady(speed), step=step))
    assert found == pytest.approx(5 / LENGTH * speed * 3600)


@pytest.mark.parametrize("name", ["mean_speed", "fuel_ml_per_km", "outflow_veh_per_h", "mean_abs_accel"])
@pytest.mark.parametrize("times", [2, 5])
def test_metrics_do_not_depend_on_the_episode_length(name: str, times: int) -> None:
    def measured(steps: int) -> float:
        return metric(name, episode_of(steady(4.0, steps), applied=0.3, fuel=np.full((steps, 5), 200.0)))

    assert measured(40 * times) == pytest.approx(measured(40))


def test_metrics_have_unique_labels() -> None:
    labels = [found.label for found in METRICS.values()]
    functions: list[Callable[[Episode], float]] = [found.function for found in METRICS.values()]
    assert len(set(labels)) == len(labels)
    assert len(set(functions)) == len(functions)


NAN = float("nan")


def open_episode(speeds: ArrayLike, **changes: Any) -> Episode:
    """An episode on a road with ends: NaN where a vehicle is not on it; one decision a second."""
    moved = np.asarray(speeds, float)
    steps, vehicles = len(moved) - 1, moved.shape[1]
    values: dict[str, Any] = {
        "seed": (0,),
        "status": "completed",
        "control_step": 1.0,
        "limit_speed": LIMIT,
        "vehicle_ids": tuple(f"human_{n}" for n in range(vehicles)),
        "speeds": moved,
        "positions": np.full_like(moved, np.nan),
        "gaps": np.full_like(moved, np.nan),
        "backlog": np.zeros(steps + 1),
        "fuel": np.where(np.isnan(moved[1:]), np.nan, 100.0),
        "reward_terms": {"speed": np.zeros(steps)},
    }
    return Episode(**{**values, **changes})


def test_vehicles_count_only_on_the_road() -> None:
    episode = open_episode([[4.0, NAN], [4.0, 1.0], [NAN, 3.0], [NAN, 0.0]])
    assert metric("mean_speed", episode) == pytest.approx((4.0 + 1.0 + 3.0 + 0.0) / 4)
    assert metric("mean_speed_steady", episode) == pytest.approx((3.0 + 0.0) / 2)  # of three steps the last two
    assert metric("speed_std_fleet", episode) == pytest.approx((1.5 + 0.0 + 0.0) / 3)
    assert metric("share_standing", episode) == pytest.approx(1 / 4)
    burnt = 4 * 100.0 / 742.0
    assert metric("fuel_ml_per_km", episode) == pytest.approx(burnt / 8.0 * 1000.0)
    assert np.isnan(metric("cav_mean_speed", episode))


def test_fuel_by_power_does_not_depend_on_when_a_vehicle_enters() -> None:
    late = np.full((11, 2), 20.0)
    late[:4, 1] = np.nan
    steady, entering = (metric("fuel_by_power", open_episode(speeds)) for speeds in (np.full((11, 2), 20.0), late))
    assert entering == pytest.approx(steady)


def test_fuel_by_power_on_a_users_network_is_that_of_motor_vehicles() -> None:
    speeds, zeros = np.array([[20.0, 5.0]] * 11), np.zeros(2)
    trips = Trips(("human_0", "human_1"), ("passenger", "bicycle"), zeros, zeros, zeros, np.zeros(2, bool))
    with_bicycle = metric("fuel_by_power", open_episode(speeds, trips=trips))
    assert with_bicycle == metric("fuel_by_power", open_episode(speeds[:, :1]))


def test_outflow_and_backlog_of_an_open_road() -> None:
    episode = open_episode(np.full((121, 3), 5.0), arrivals=7, backlog=np.arange(121.0))
    assert metric("outflow_veh_per_h", episode) == pytest.approx(7 * 30.0)
    assert metric("insertion_backlog_veh", episode) == 120.0
    assert metric("insertion_backlog_veh", episode_of(steady(4.0))) == 0.0


def test_collision_does_not_shorten_travel_time() -> None:
    episode = open_episode(np.full((11, 2), 5.0), backlog=np.full(11, 3.0), planned_duration=40.0)
    assert metric("travel_time", episode) == pytest.approx(10.0)
    assert metric("travel_time", replace(episode, status="collision")) == pytest.approx(40.0)
    later = replace(episode, status="collision", planned_duration=NAN)  # where no end was planned
    assert metric("travel_time", later) == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("steps", "counted"), [(1, 1), (2, 1), (3, 2), (10, 5), (999, 500), (1000, 500), (1001, 1000), (3000, 1000)]
)
def test_steady_state_is_the_last_thousand_steps_or_the_second_half(steps: int, counted: int) -> None:
    speeds = np.zeros((steps + 1, 3))
    speeds[-counted:] = 4.0
    assert metric("mean_speed_steady", episode_of(speeds)) == pytest.approx(4.0)
    speeds[-counted] = 0.0
    expected = 4.0 * (counted - 1) / counted
    assert metric("mean_speed_steady", episode_of(speeds)) == pytest.approx(expected)


def test_episode_without_vehicles_is_measured_without_warnings() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for vehicles in (0, 2):
            row = measure(open_episode(np.full((700, vehicles), np.nan)))
            for name in ("mean_speed", "mean_speed_steady", "speed_std_fleet", "share_standing", "fuel_ml_per_km"):
                assert np.isnan(row[name])
            assert row["outflow_veh_per_h"] == row["insertion_backlog_veh"] == 0.0


@pytest.mark.parametrize(("peak", "flow"), [((60.0, 90.0), 3600.0), ((0.0, 90.0), 1200.0), ((150.0, 200.0), 1440.0)])
def test_flow_of_a_demand_peak_counts_only_the_peak(peak: tuple[float, float], flow: float) -> None:
    # A vehicle leaves every second from the sixtieth on; without the peak within the episode all of it counts.
    speeds = np.where(np.arange(101)[:, None] <= np.arange(60, 160), 10.0, np.nan)
    assert metric("outflow_veh_per_h", open_episode(speeds, demand_peak=peak)) == pytest.approx(flow)


def test_amplification_is_that_of_waves_in_each_range_of_periods() -> None:
    times, factors = 0.1 * np.arange(6001), {"long": 1.5, "medium": 0.8, "short": 0.3}
    waves = {name: np.sin(2 * np.pi * times / period) for name, period in (("long", 100), ("medium", 40), ("short", 8))}
    recorded = 20.0 + 0.002 * times + sum(waves.values())  # a trend is no wave
    last = 20.0 + 0.002 * times + sum(factors[name] * np.roll(wave, 30) for name, wave in waves.items())
    motion = np.stack([np.cumsum(recorded) * 0.1, recorded], -1)[:, None]
    episode = episode_of(last[:, None], replayed_motion=motion)
    for name, factor in factors.items():
        assert metric(f"amplification_{name}", episode) == pytest.approx(factor, rel=0.02)
        assert np.isnan(metric(f"amplification_{name}", episode_of(steady(4.0))))
    calm = np.full_like(recorded, 20.0) + 0.03 * waves["medium"]  # rounding and noise are no waves
    motion = np.stack([np.cumsum(calm) * 0.1, calm], -1)[:, None]
    names = "amplification", *(f"amplification_{name}" for name in factors)
    assert all(np.isnan(metric(name, episode_of(last[:, None], replayed_motion=motion))) for name in names)
