"""The merge in SUMO: its human drivers, and what is counted."""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from typing import Any

import libsumo
import numpy as np
import pytest

from unjam.drivers import Constant, Driver, Human, PISaturation
from unjam.drivers.command import Command
from unjam.errors import EpisodeError
from unjam.measures.metrics import measure
from unjam.scenarios import Merge
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode
from unjam.worlds.sumo.backend import SumoBackend, make_traffic, sumo_inputs
from unjam.worlds.sumo.merge_road import MergingTraffic
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool
from unjam.worlds.world import DriverLog

STEP = 0.2


def merging(scenario: Merge, simulation: Simulation, seed: int = 1, controlled: bool = True) -> MergingTraffic:
    traffic = make_traffic(scenario, (seed,), simulation)
    assert isinstance(traffic, MergingTraffic)
    traffic.start(controlled)
    return traffic


def idm(speed: float, leader_speed: float, gap: float) -> float:
    """Eq. 5-6 with Table B1, written down once more [m/s2]."""
    wanted = 2.0 + max(speed + speed * (speed - leader_speed) / (2 * 1.5**0.5), 0.0)
    return 1.0 - (speed / 30.0) ** 4 - (wanted / gap) ** 2


class Commands:
    """Commands in each step and speeds of the IDM, on and off the junction."""

    def __init__(
        self, traffic: MergingTraffic, simulation: Simulation, monkeypatch: pytest.MonkeyPatch, steps: int
    ) -> None:
        asked: dict[str, float] = {}
        command = simulation.command_speeds
        self.off: list[tuple[float, float, float]] = []
        """of human drivers off the junction: previous speed, command, IDM"""
        self.done: list[float] = []
        """by how much each of them then drove faster than it was asked to"""
        self.on: list[float] = []
        """commands to human drivers on the junction"""

        def listen(names: Any, speeds: Any) -> None:
            names, speeds = list(names), list(speeds)
            for name, speed in zip(names, speeds, strict=True):
                asked.setdefault(name, speed)  # a CAV is asked for twice
            command(names, speeds)

        monkeypatch.setattr(simulation, "command_speeds", listen)
        for _ in range(steps):
            asked.clear()
            ids = list(libsumo.vehicle.getIDList())
            edges = {name: libsumo.vehicle.getRoadID(name) for name in ids}
            speeds = {name: libsumo.vehicle.getSpeed(name) for name in ids}
            streams = traffic._streams
            places = dict(zip(streams.vehicle_ids, streams.positions, strict=True))
            traffic._simulate({})
            after = {name: libsumo.vehicle.getSpeed(name) for name in libsumo.vehicle.getIDList()}
            assert asked.keys() == set(ids)
            for name, speed in speeds.items():
                if edges[name].startswith(":meeting"):
                    self.on.append(asked[name])
                    continue
                own = places[name]
                leader = leader_of(places, name, traffic)
                gap = np.inf if leader is None else max(places[leader] - own - 5.0, 0.01)
                wanted = speed + STEP * idm(speed, speeds.get(leader or "", speed), gap)
                self.off.append((speed, asked[name], wanted))
                if name in after:
                    self.done.append(after[name] - asked[name])


def leader_of(places: dict[str, float], name: str, traffic: MergingTraffic) -> str | None:
    """The nearest ahead of a vehicle on its own branch or beyond the meeting place."""
    own, origins = places[name], traffic.road.origins
    ahead = [
        other
        for other, place in places.items()
        if place > own and (place >= 0 or origins[other].branch == origins[name].branch)
    ]
    return min(ahead, key=lambda other: places[other], default=None)


def test_human_drivers_follow_the_idm_and_sumo_drives_on_the_junction(
    simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    traffic = merging(Merge(noise=0.0, penetration_rate=0.0), simulation)
    found = Commands(traffic, simulation, monkeypatch, 400)
    _, asked, wanted = np.array(found.off).T
    assert len(asked) > 5000
    np.testing.assert_allclose(asked, np.maximum(wanted, 0.0), atol=1e-6)
    assert len(found.on) > 100
    assert set(found.on) == {-1.0}
    done = np.array(found.done)  # SUMO only ever makes them slower, to keep them safe
    assert done.max() < 1e-9
    assert (done > -1e-9).mean() > 0.8


def test_human_noise_is_normal_with_the_configured_size(
    simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    traffic = merging(Merge(penetration_rate=0.0, standing_vehicles=0), simulation)
    found = Commands(traffic, simulation, monkeypatch, 400)
    speed, asked, wanted = np.array(found.off).T
    noise = ((asked - wanted) / STEP)[speed > 3.0]
    assert len(noise) > 4000
    assert noise.std() == pytest.approx(0.2 * STEP**0.5, rel=0.03)
    assert abs(noise.mean()) < 4 * noise.std() / len(noise) ** 0.5
    assert np.mean(np.abs(noise) < noise.std()) == pytest.approx(0.683, abs=0.02)


def test_human_drivers_obey_the_right_of_way_if_configured(simulation: Simulation) -> None:
    for right_of_way, mode in ((False, 1), (True, 25)):
        traffic = merging(Merge(right_of_way=right_of_way, penetration_rate=0.3), simulation)
        for _ in range(20):
            traffic.advance(Command(np.zeros(len(traffic.cav_ids))))
        modes = {
            libsumo.vehicle.getSpeedMode(name) for name in libsumo.vehicle.getIDList() if name not in traffic.cav_ids
        }
        assert modes == {mode}
        assert {libsumo.vehicle.getSpeedMode(name) for name in traffic.cav_ids} == {31 if right_of_way else 1}
        assert {libsumo.vehicle.getTypeID(name) for name in traffic.cav_ids} == {"cav"}


def test_backlog_and_arrivals_agree_with_the_demand_and_with_sumo(simulation: Simulation) -> None:
    traffic = merging(Merge(), simulation)
    written = ElementTree.fromstring(sumo_inputs(traffic.scenario, traffic.road).traffic_xml)
    departs = [float(vehicle.get("depart", "nan")) for vehicle in written.iter("vehicle")]
    seen: set[str] = set(libsumo.vehicle.getIDList())
    waiting, gone = [0], []
    for _ in range(120):
        traffic.advance(Command(np.zeros(len(traffic.cav_ids))))
        there = set(libsumo.vehicle.getIDList())
        seen |= there
        due = sum(time < libsumo.simulation.getTime() for time in departs)
        waiting.append(due - len(seen))
        gone.append(len(seen) - len(there))
    found = traffic.record(DriverLog())
    assert max(waiting) > 3
    np.testing.assert_allclose(found.backlog, waiting, atol=1)  # one that is due in this very step
    assert np.mean(found.backlog == waiting) > 0.8
    assert found.arrivals == gone[-1] > 10


def test_outflow_and_backlog_metrics_are_these_counts(sumo: SumoBackend) -> None:
    episode = run_episode(Merge(horizon=120), PISaturation(time_step=1.0), (1,), backend=sumo)
    row = measure(episode)
    last = episode.speeds[-1]
    left = np.isnan(last).sum()
    assert episode.arrivals == left
    assert row["outflow_veh_per_h"] == pytest.approx(left * 30.0)
    assert row["insertion_backlog_veh"] == episode.backlog[-1]


def test_positions_that_differ_from_sumos_odometer_are_an_error(
    simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    traffic = merging(Merge(), simulation)
    for _ in range(10):
        traffic.advance(Command(np.zeros(len(traffic.cav_ids))))
    driven = simulation.distances
    monkeypatch.setattr(simulation, "distances", lambda ids: [way + 2e-6 for way in driven(ids)])
    with pytest.raises(EpisodeError, match="positions differ from SUMO's odometer by 2e-06 m"):
        traffic.record(DriverLog())


def test_snapshots_of_a_merge(sumo: SumoBackend) -> None:
    episode = run_episode(Merge(horizon=60), PISaturation(time_step=1.0), (1,), record_details=True, backend=sumo)
    assert len(episode.branches) == len(episode.vehicle_ids)
    for name, branch in zip(episode.vehicle_ids, episode.branches, strict=True):
        assert branch == ("ramp" if re.match("human_r", name) else "highway")
    x, y, heading = np.moveaxis(episode.poses, -1, 0)
    on_highway = np.array([branch == "highway" for branch in episode.branches])
    there = ~np.isnan(episode.speeds)
    straight = there & on_highway
    np.testing.assert_allclose(y[straight], -1.6, atol=1e-6)
    np.testing.assert_allclose(heading[straight], 0.0, atol=1e-6)
    beyond = there & (episode.positions >= 0)
    np.testing.assert_allclose(x[beyond], 100.0 - (100.0 - episode.positions[beyond]) * 0.88675, atol=0.01)
    on_ramp = there & ~on_highway & (episode.positions < -25)
    np.testing.assert_allclose(heading[on_ramp], np.pi / 4, atol=1e-3)
    assert episode.lane_lines.shape[1] == 2
    assert np.nanmin(episode.lane_lines[:, 0]) == -600.0
    assert np.nanmax(episode.lane_lines[:, 0]) == 100.0


def episodes_of(driver: Driver, seeds: Sequence[int], **changes: Any) -> list[Episode]:
    with WorkerPool(2) as workers:
        found = workers.run([EpisodeTask(Merge(**changes), driver, (seed,)) for seed in seeds])
    assert [episode.status for episode in found] == ["completed"] * len(seeds)
    assert all(episode.collisions == 0 for episode in found)
    return found


def fleet_mean(episodes: Sequence[Episode]) -> float:
    return float(np.mean([measure(episode)["mean_speed"] for episode in episodes]))


@pytest.fixture(scope="module")
def human() -> list[Episode]:
    return episodes_of(Human(), range(2))


@pytest.mark.slow
def test_from_standstill_human_traffic_stays_jammed_and_pi_makes_it_worse(human: list[Episode]) -> None:
    pi = episodes_of(PISaturation(time_step=1.0), range(2))
    assert 8.5 < fleet_mean(human) < 13.5
    assert fleet_mean(pi) < fleet_mean(human)
    assert all(episode.backlog[-1] > 5 for episode in [*human, *pi])


@pytest.mark.slow
def test_from_an_empty_road_human_traffic_flows_freely(human: list[Episode]) -> None:
    free = episodes_of(Human(), range(2), standing_vehicles=0)
    assert fleet_mean(free) == pytest.approx(19.9, rel=0.06)
    assert fleet_mean(free) < min(episode.limit_speed for episode in free)
    assert all(episode.backlog[-1] <= 1 for episode in free)
    assert min(episode.arrivals for episode in free) > max(episode.arrivals for episode in human)


@pytest.mark.slow
def test_no_driver_collides() -> None:
    for driver in (Constant(1.0), Constant(-0.1)):
        episodes_of(driver, range(2), horizon=200, penetration_rate=0.3)


@pytest.mark.slow
def test_twenty_seeds_agree_with_flow() -> None:
    human = episodes_of(Human(), range(20))
    assert fleet_mean(human) == pytest.approx(11.0, rel=0.05)
    assert fleet_mean(episodes_of(Human(), range(20), standing_vehicles=0)) == pytest.approx(19.9, rel=0.03)
    assert fleet_mean(episodes_of(PISaturation(time_step=1.0), range(20))) < fleet_mean(human)
