"""Are time gaps after cut-ins the CAV's own only once it has recovered, in SUMO and in a batch?"""

from pathlib import Path

import numpy as np
import pytest

from unjam.controller import make_driver
from unjam.measures.drivable import DRIVABLE
from unjam.measures.metrics import measure
from unjam.scenarios import OnRamp, make_scenario
from unjam.scenarios.own_network import WITH_OWN_ACC
from unjam.studies.harm_roads import HarmRoad, Stretch, write_road
from unjam.worlds.audit import Following
from unjam.worlds.batch.motorway import begun
from unjam.worlds.batch.motorway_record import MotorwayLog
from unjam.worlds.batch.vehicles import Vehicles
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo import lanes
from unjam.worlds.sumo.simulation import Simulation

TRUCKS = HarmRoad((Stretch(1500.0, 2, 36.0),), (0.8,), trucks=0.25)
"""a road without a bottleneck on which cars overtake trucks, and cut in"""


def test_an_acc_that_restores_its_gap_after_cut_ins_is_feasible(
    tmp_path: Path, simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    changes = {"cav_share": 0.3, "horizon": 240, **WITH_OWN_ACC}
    scenario = make_scenario(str(write_road(TRUCKS, tmp_path)), changes)
    driver = make_driver("cruise", scenario.decision_step)
    episode = run_episode(scenario, driver, (1,), simulation=simulation)
    found = episode.audit.following
    assert 1.0 <= found.headway < 1.3
    assert found.share_short == 0.0
    assert measure(episode)["drivable"] == DRIVABLE
    monkeypatch.setattr(lanes, "is_recovering", lambda *about: False)
    every = run_episode(scenario, driver, (1,), simulation=simulation).audit.following
    assert every.headway < 0.8
    assert every.share_short > 0.001
    assert every.time_to_collision == found.time_to_collision


def follow(gaps: list[float], speeds: list[float]) -> Following:
    """Return how a batch sees the CAV on the second of two roads, behind a leader at 20 m/s, step by step."""
    roads = [OnRamp().draw(np.random.default_rng(1))] * 2
    log = MotorwayLog(roads, entries=2, step=0.5, decision_step=1.0, planned=100.0)
    length = roads[0].vehicle_length
    for gap, speed in zip(gaps, speeds, strict=True):
        column = np.array([0.0, 0.0])
        known = (column + 1.4, column + 1.3, column + 2.0, column + 2.0, column + 1.0, column)
        road, entry, way = (np.array(each) for each in ([1, 1], [0, 1], [1, 1]))
        places, both = np.array([100.0, 100.0 + length + gap]), np.array([speed, 20.0])
        vehicles = begun(road, entry, way, places, both, column, *known, column + 30.0)
        nobody = Vehicles(*(each[:0] for each in vehicles))
        log.note_step(vehicles, np.array([1, -1]), nobody, np.array([0]), True)
    settled = np.concatenate(log._settled, 1)
    assert (settled[0] == 1).all()
    return log._audit(1, [], settled[1:]).following


def test_a_batch_excludes_the_recovery_and_nothing_after_it() -> None:
    opening = np.linspace(10.0, 25.0, 31).tolist()
    found = follow([*opening, 25.0, 25.0], [19.0] * 31 + [20.0, 20.0])
    assert found.headway == pytest.approx(25.0 / 20.0, rel=0.2)
    assert found.share_short == 0.0
    stays = follow([*opening[:15], *[17.0] * 5], [19.0] * 15 + [20.0] * 5)
    assert stays.headway == pytest.approx(17.0 / 20.0)
    assert stays.share_short == 1.0  # of the moments that count
