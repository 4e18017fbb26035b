"""After a cut-in, the time gaps of a CAV count again once it has recovered, in SUMO and in a batch."""

from pathlib import Path

import numpy as np
import pytest

from unjam.controller import make_driver
from unjam.measures.feasibility import FEASIBLE
from unjam.measures.metrics import measure
from unjam.scenarios import make_scenario
from unjam.scenarios.motorway import ON_RAMP
from unjam.scenarios.user_network import ACC_SETTINGS
from unjam.worlds import audit
from unjam.worlds.audit import FollowingStatistics
from unjam.worlds.batch.motorway.record import MotorwayLog
from unjam.worlds.batch.motorway.traffic import make_vehicles
from unjam.worlds.batch.motorway.vehicles import MotorwayVehicles
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam_paper.open_test_roads import OpenTestRoad, RoadSection, write_road_files

TRUCKS = OpenTestRoad((RoadSection(1500.0, 2, 36.0),), (0.8,), trucks=0.25)
"""a road without a bottleneck, on which cars overtake trucks and then cut in"""


@pytest.mark.long
def test_an_acc_that_restores_its_gap_after_cut_ins_is_feasible(
    tmp_path: Path, sumo: SumoBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    changes = {"penetration_rate": 0.3, "horizon": 240, **ACC_SETTINGS}
    scenario = make_scenario(str(write_road_files(TRUCKS, tmp_path)), changes)
    driver = make_driver("cruise", scenario.control_step)
    episode = run_episode(scenario, driver, (1,), backend=sumo)
    recovered = episode.audit.following
    assert 1.0 <= recovered.min_time_gap < 1.3
    assert recovered.share_short_time_gap == 0.0
    assert measure(episode)["feasibility"] == FEASIBLE
    monkeypatch.setattr(audit, "is_recovering", lambda *arguments: False)
    without_exclusion = run_episode(scenario, driver, (1,), backend=sumo).audit.following
    assert without_exclusion.min_time_gap < 0.8
    assert without_exclusion.share_short_time_gap > 0.001
    assert without_exclusion.min_time_to_collision == recovered.min_time_to_collision


def following_statistics(gaps: list[float], speeds: list[float]) -> FollowingStatistics:
    """Return the audit of a CAV behind a leader at 20 m/s, on the second of two roads of a batch.

    `gaps` [m] and `speeds` [m/s] of the CAV have one value per simulation step.
    """
    roads = [ON_RAMP.draw(np.random.default_rng(1))] * 2
    log = MotorwayLog(roads, ON_RAMP)
    length = roads[0].geometry.vehicle_length
    for gap, speed in zip(gaps, speeds, strict=True):
        zeros = np.zeros(2)
        properties = (zeros + 1.4, zeros + 1.3, zeros + 2.0, zeros + 2.0, zeros + 1.0, zeros)
        road_index, entry_number, lane = (np.array(each) for each in ([1, 1], [0, 1], [1, 1]))
        positions, vehicle_speeds = np.array([100.0, 100.0 + length + gap]), np.array([speed, 20.0])
        vehicles = make_vehicles(
            road_index, entry_number, lane, positions, vehicle_speeds, zeros, *properties, zeros + 30.0
        )
        no_vehicles = MotorwayVehicles(*(each[:0] for each in vehicles))
        log.record_step(vehicles, np.array([1, -1]), no_vehicles, np.array([0]))
    rows = np.concatenate(log._steady_following, 1)
    assert (rows[0] == 1).all()
    return log._make_audit(1, [], rows[1:]).following


def test_a_batch_excludes_the_recovery_and_nothing_after_it() -> None:
    growing_gaps = np.linspace(10.0, 25.0, 31).tolist()
    recovered = following_statistics([*growing_gaps, 25.0, 25.0], [19.0] * 31 + [20.0, 20.0])
    assert recovered.min_time_gap == pytest.approx(25.0 / 20.0, rel=0.2)
    assert recovered.share_short_time_gap == 0.0
    too_close = following_statistics([*growing_gaps[:15], *[17.0] * 5], [19.0] * 15 + [20.0] * 5)
    assert too_close.min_time_gap == pytest.approx(17.0 / 20.0)
    assert too_close.share_short_time_gap == 1.0  # of the steps after the recovery
