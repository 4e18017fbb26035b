"""Long episodes of many vehicles: what is thinned and shared says the same as what is not."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.reports.open_roads import ramp_episode, user_episode
from tests.worlds.sumo.user_networks import straight
from unjam.controller import make_driver
from unjam.measures.metrics import measure
from unjam.reports.html import replay_data
from unjam.reports.results import pack_episode, to_plot_episode, unpack_episode
from unjam.reports.space_time import lane_map_figure
from unjam.scenarios import make_scenario
from unjam.worlds import open_road_log, reward
from unjam.worlds.episode import run_episode
from unjam.worlds.open_road_log import TrafficLog
from unjam.worlds.record import Episode
from unjam.worlds.reward import REWARDS, episode_reward_terms, make_reward
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.simulation import Simulation

Stays = list[tuple[int, int]]
"""of each vehicle its first moment, and how many more it stays"""


@pytest.fixture(scope="module")
def small() -> Iterator[None]:
    """Limits that a minute of traffic is beyond."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(open_road_log, "MAX_UNSHARED_CELLS", 1000)
        patch.setattr(open_road_log, "MAX_SNAPSHOT_VEHICLES", 1500)
        patch.setattr(open_road_log, "SHARED_COLUMN_FRAMES", 20)
        patch.setattr(reward, "MAX_REWARD_CELLS", 500)
        yield


@pytest.fixture(scope="module")
def whole() -> Episode:
    return ramp_episode()


@pytest.fixture(scope="module")
def thinned_episode(whole: Episode, small: None) -> Episode:
    return ramp_episode.__wrapped__()


@given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 12)), max_size=25), st.integers(1, 60))
def test_every_speed_is_in_a_column_of_its_group(stays: Stays, most: int) -> None:
    moments = max((first + more for first, more in stays), default=0) + 1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(open_road_log, "MAX_UNSHARED_CELLS", 0)
        patch.setattr(open_road_log, "MAX_SNAPSHOT_VEHICLES", most)
        log = TrafficLog()
        for time in range(moments):
            there = [number for number, (first, more) in enumerate(stays) if first <= time <= first + more]
            log.add([f"v{number}" for number in there], [100.0 * number + time for number in there])
            if log.needs_snapshot:
                log.add_snapshot({"positions": [1e4 * number + time for number in there]})
        numbers = [int(name[1:]) for name in log.vehicle_ids]
        groups = [number % 2 for number in numbers]
        columns = log.columns(groups)
    speeds, positions = log.speeds(columns), log.snapshots("positions", columns)
    assert len(positions) == len(range(0, moments, log.snapshot_stride))
    assert np.isfinite(speeds).sum() == sum(more + 1 for _, more in stays)
    for number, column, group in zip(numbers, columns, groups, strict=True):
        first, more = stays[number]
        during = np.arange(first, first + more + 1)
        assert speeds[during, column].tolist() == (100.0 * number + during).tolist()
        pictured = during[during % log.snapshot_stride == 0]
        assert positions[pictured // log.snapshot_stride, column].tolist() == (1e4 * number + pictured).tolist()
        assert {groups[other] for other in np.flatnonzero(columns == column)} == {group}


def test_every_moment_has_a_snapshot_until_there_are_many() -> None:
    log = TrafficLog()
    for time in range(100):
        log.add(["one", "other"], [1.0, 2.0])
        assert log.needs_snapshot
        log.add_snapshot({"positions": [time, time]})
    assert log.snapshot_stride == 1
    assert log.columns(["", ""]).tolist() == [0, 1]


def test_metrics_are_the_same_with_shared_columns(whole: Episode, thinned_episode: Episode) -> None:
    assert thinned_episode.snapshot_stride > 1
    assert 0 < thinned_episode.speeds.shape[1] < whole.speeds.shape[1] == len(whole.vehicle_ids)
    assert (thinned_episode.vehicle_ids, thinned_episode.cav_ids) == (whole.vehicle_ids, whole.cav_ids)
    column = dict(zip(thinned_episode.vehicle_ids, thinned_episode.vehicle_columns, strict=True))
    for number, name in enumerate(whole.vehicle_ids):
        there = ~np.isnan(whole.speeds[:, number])
        np.testing.assert_array_equal(thinned_episode.speeds[there, column[name]], whole.speeds[there, number])
    cavs = {column[name] for name in whole.cav_ids}
    assert set(thinned_episode.cav_columns) == cavs
    assert not cavs & {column[name] for name in set(whole.vehicle_ids) - set(whole.cav_ids)}
    expected, found = measure(whole), measure(thinned_episode)
    for name, value in expected.items():
        close = isinstance(value, float)
        assert found[name] == (pytest.approx(value, nan_ok=True, rel=1e-9) if close else value), name


def test_figures_of_thinned_snapshots_show_the_remaining_moments(whole: Episode, thinned_episode: Episode) -> None:
    every = thinned_episode.snapshot_stride
    one, other = to_plot_episode("", whole), to_plot_episode("", thinned_episode)
    assert other.control_step == pytest.approx(one.control_step * every)
    assert len(other.speeds) == len(other.positions) == len(other.backlog) == len(one.speeds[::every])
    column = dict(zip(thinned_episode.vehicle_ids, thinned_episode.vehicle_columns, strict=True))
    for number, name in enumerate(whole.vehicle_ids):
        there = ~np.isnan(whole.speeds[::every, number])
        for quantity in ("positions", "lane_indices", "poses"):
            kept, all_of_it = getattr(other, quantity), getattr(one, quantity)[::every]
            np.testing.assert_array_equal(kept[there, column[name]], all_of_it[there, number])
    read = unpack_episode(pack_episode(other))
    np.testing.assert_array_equal(read["positions"], other.positions.astype(np.float32))
    (driver,) = replay_data([other])["drivers"]
    assert driver["vehicles"] <= other.speeds.shape[1]
    assert lane_map_figure([replace(other, driver="it")]).axes


def test_a_reward_computed_in_parts_is_the_same(whole: Episode, small: None) -> None:
    assert whole.speeds.size > reward.MAX_REWARD_CELLS
    seen = (whole.speeds, whole.trajectories, False, whole.backlog)
    parts = {name: episode_reward_terms(make_reward(f"{name}:time_gap=1,comfort=1"), *seen) for name in REWARDS}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reward, "MAX_REWARD_CELLS", 10**9)
        at_once = {name: episode_reward_terms(make_reward(f"{name}:time_gap=1,comfort=1"), *seen) for name in REWARDS}
    for name, terms in at_once.items():
        assert terms.keys() == parts[name].keys()
        for term, values in terms.items():
            np.testing.assert_allclose(parts[name][term], values, rtol=1e-12, atol=1e-12)


def test_a_collision_belongs_to_the_last_part(whole: Episode, small: None) -> None:
    def crashes(outcome: object) -> dict[str, np.ndarray]:
        return {"crashed": 1.0 * outcome.has_crashed}  # pyright: ignore[reportAttributeAccessIssue]

    found = episode_reward_terms(crashes, whole.speeds, whole.trajectories, True, whole.backlog)["crashed"]
    assert np.flatnonzero(found).tolist() == [whole.control_steps - 1]


def test_metrics_of_a_users_network_with_several_classes_are_the_same_with_shared_columns(
    tmp_path: Path, simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    bikes = '<vType id="bike" vClass="bicycle" speedDev="0"/>'
    flow = '<flow id="{0}" type="{0}" route="along" begin="0" end="60" period="{1}"/>'
    demand = bikes + flow.format("car", 4) + flow.format("bike", 9)
    path = straight(tmp_path, demand, length=150.0, end=100.0, step=0.5)
    scenario, results = make_scenario(str(path), {"penetration_rate": 0.5}), list[Episode]()
    for cells in (10**9, 0):
        monkeypatch.setattr(open_road_log, "MAX_UNSHARED_CELLS", cells)
        driver = make_driver("acc", scenario.control_step)
        results.append(run_episode(scenario, driver, 1, backend=SumoBackend(simulation), record_details=True))
    whole, shared = results
    assert shared.speeds.shape[1] < whole.speeds.shape[1] == len(whole.vehicle_ids)
    found = measure(shared)
    for name, value in measure(whole).items():
        is_number = isinstance(value, float)
        assert found[name] == (pytest.approx(value, nan_ok=True, rel=1e-9) if is_number else value), name
    assert found["fuel_by_power"] > 0.0


@pytest.mark.long
def test_a_users_network_is_thinned_as_well(tmp_path: Path, small: None) -> None:
    episode = user_episode(tmp_path)
    shown = to_plot_episode("", episode)
    assert episode.snapshot_stride > 1
    there = ~np.isnan(shown.speeds)
    np.testing.assert_array_equal(np.isnan(shown.poses[..., 0]), ~there)
    assert 0 < np.isfinite(shown.positions).sum() <= there.sum()
    on_route = np.isfinite(shown.positions)
    assert (np.diff(shown.positions, axis=0)[on_route[1:] & on_route[:-1]] > -1e-6).all()
