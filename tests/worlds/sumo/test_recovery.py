"""Are time gaps after cut-ins the CAV's own only once it has recovered, in SUMO and in a batch?"""

from pathlib import Path

import numpy as np
import pytest

from unjam.controller import make_driver
from unjam.measures.feasibility import FEASIBLE
from unjam.measures.metrics import measure
from unjam.scenarios import OnRamp, make_scenario
from unjam.scenarios.user_network import ACC_SETTINGS
from unjam.worlds.audit import FollowingStatistics
from unjam.worlds.batch.on_ramp.record import MotorwayLog
from unjam.worlds.batch.on_ramp.traffic import make_vehicles
from unjam.worlds.batch.on_ramp.vehicles import MotorwayVehicles
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo import multi_lane
from unjam.worlds.sumo.backend import SumoBackend
from unjam_paper.open_test_roads import OpenTestRoad, RoadSection, write_road_files

TRUCKS = OpenTestRoad((RoadSection(1500.0, 2, 36.0),), (0.8,), trucks=0.25)
"""a road without a bottleneck on which cars overtake trucks, and cut in"""


def test_an_acc_that_restores_its_gap_after_cut_ins_is_feasible(
    tmp_path: Path, sumo: SumoBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    changes = {"penetration_rate": 0.3, "horizon": 240, **ACC_SETTINGS}
    scenario = make_scenario(str(write_road_files(TRUCKS, tmp_path)), changes)
    driver = make_driver("cruise", scenario.control_step)
    episode = run_episode(scenario, driver, (1,), backend=sumo)
    found = episode.audit.following
    assert 1.0 <= found.min_time_gap < 1.3
    assert found.share_short_time_gap == 0.0
    assert measure(episode)["feasibility"] == FEASIBLE
    monkeypatch.setattr(multi_lane, "is_recovering", lambda *about: False)
    every = run_episode(scenario, driver, (1,), backend=sumo).audit.following
    assert every.min_time_gap < 0.8
    assert every.share_short_time_gap > 0.001
    assert every.min_time_to_collision == found.min_time_to_collision


def follow(gaps: list[float], speeds: list[float]) -> FollowingStatistics:
    """Return how a batch sees the CAV on the second of two roads, behind a leader at 20 m/s, step by step."""
    roads = [OnRamp().draw(np.random.default_rng(1))] * 2
    log = MotorwayLog(roads, OnRamp())
    length = roads[0].vehicle_length
    for gap, speed in zip(gaps, speeds, strict=True):
        column = np.array([0.0, 0.0])
        known = (column + 1.4, column + 1.3, column + 2.0, column + 2.0, column + 1.0, column)
        road, entry, way = (np.array(each) for each in ([1, 1], [0, 1], [1, 1]))
        places, both = np.array([100.0, 100.0 + length + gap]), np.array([speed, 20.0])
        vehicles = make_vehicles(road, entry, way, places, both, column, *known, column + 30.0)
        no_vehicles = MotorwayVehicles(*(each[:0] for each in vehicles))
        log.record_step(vehicles, np.array([1, -1]), no_vehicles, np.array([0]))
    settled = np.concatenate(log._steady_following, 1)
    assert (settled[0] == 1).all()
    return log._audit(1, [], settled[1:]).following


def test_a_batch_excludes_the_recovery_and_nothing_after_it() -> None:
    opening = np.linspace(10.0, 25.0, 31).tolist()
    found = follow([*opening, 25.0, 25.0], [19.0] * 31 + [20.0, 20.0])
    assert found.min_time_gap == pytest.approx(25.0 / 20.0, rel=0.2)
    assert found.share_short_time_gap == 0.0
    stays = follow([*opening[:15], *[17.0] * 5], [19.0] * 15 + [20.0] * 5)
    assert stays.min_time_gap == pytest.approx(17.0 / 20.0)
    assert stays.share_short_time_gap == 1.0  # of the moments that count
