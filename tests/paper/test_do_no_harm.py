"""Verdicts, breakdowns and roads of the study `do-no-harm`."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from unjam.controller import make_driver
from unjam.drivers.roadside import CongestionMonitor
from unjam.measures.metrics import measure
from unjam.scenarios import make_scenario
from unjam.scenarios.user_network import ACC_SETTINGS
from unjam.training.selection import ACC_DRIVER
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.worker_pool import WorkerPool
from unjam_paper import do_no_harm, open_test_roads
from unjam_paper.do_no_harm import (
    DO_NO_HARM,
    HARM,
    HARM_UNDECIDED,
    NO_HARM,
    TESTED_CONTROLLER,
    evaluate_harm,
    has_breakdown,
)
from unjam_paper.open_test_roads import EPISODE_SECONDS, OPEN_TEST_ROADS, OpenTestRoad, RoadSection, write_road_files
from unjam_paper.study import StudyFolder


def rows(*values: tuple[float, float]) -> list[dict[str, Any]]:
    names = "travel_time", "outflow_veh_per_h"
    return [{"seed": seed, **dict(zip(names, each, strict=True))} for seed, each in enumerate(values)]


ACC_ROWS = rows((100.0, 4000.0), (110.0, 4000.0), (120.0, 4000.0))


@pytest.mark.parametrize(
    ("own", "breakdown", "verdict"),
    [
        (ACC_ROWS, False, NO_HARM),
        (rows((90.0, 4000.0), (99.5, 4010.0), (108.0, 4000.0)), False, NO_HARM),
        (rows((101.0, 4000.0), (111.0, 4000.0), (121.0, 4000.0)), False, HARM),
        (rows((101.0, 4000.0), (111.0, 4000.0), (121.0, 4000.0)), True, NO_HARM),
        (rows((103.0, 4000.0), (113.5, 4000.0), (123.5, 4000.0)), True, HARM),
        (rows((90.0, 3900.0), (99.0, 3900.0), (108.0, 3900.0)), True, HARM),
        (rows((90.0, 4000.0), (120.0, 4000.0), (118.0, 4000.0)), True, HARM_UNDECIDED),
        (rows((90.0, 4000.0), (99.0, 3800.0), (108.0, 4200.0)), True, HARM_UNDECIDED),
        (ACC_ROWS[:2], True, HARM_UNDECIDED),
        ([], True, HARM_UNDECIDED),
    ],
)
def test_the_verdict_follows_from_both_intervals(own: list[dict[str, Any]], breakdown: bool, verdict: str) -> None:
    assert evaluate_harm(own, ACC_ROWS, breakdown).verdict == verdict


ROAD = OpenTestRoad((RoadSection(1000, 2, 30), RoadSection(1000, 2, 20)), (0.5,))


def episode(speed: float, seconds: int, spacing: float = 25.0) -> Episode:
    """Vehicles at fixed positions, slow in a section of 250 m for some seconds."""
    positions = np.arange(0.0, 1000.0, spacing)
    is_slow = (positions >= 250.0) & (positions < 500.0)
    speeds = np.where(is_slow & (np.arange(600)[:, None] < seconds), speed, 29.0)
    return Episode((0,), "completed", control_step=1.0, speeds=speeds, positions=np.tile(positions, (600, 1)))


def test_a_breakdown_is_slow_for_two_minutes_with_flow() -> None:
    assert has_breakdown(episode(17.0, 180), ROAD)
    assert not has_breakdown(episode(19.0, 180), ROAD), "faster than 0.6 of 30 m/s"
    assert not has_breakdown(episode(17.0, 100), ROAD), "too short"
    assert not has_breakdown(episode(4.0, 180, spacing=125.0), ROAD), "hardly any flow"


def test_queues_at_signals_are_no_breakdown() -> None:
    signals = OpenTestRoad((RoadSection(1000, 2, 30, has_signal=True), RoadSection(1000, 2, 20)), (0.5,))
    assert not has_breakdown(episode(10.0, 600), signals)


def test_braking_before_a_lower_speed_limit_is_no_breakdown() -> None:
    curve = OpenTestRoad((RoadSection(500, 2, 40), RoadSection(500, 2, 20)), (0.5,))
    assert not has_breakdown(episode(17.0, 600), curve)


def test_roads_have_the_documented_range() -> None:
    sections = [section for road in OPEN_TEST_ROADS.values() for section in road.sections]
    assert len(OPEN_TEST_ROADS) >= 10
    assert {min(each.speed for each in sections) < 25, max(each.speed for each in sections)} == {True, 45}
    assert {section.lanes for section in sections} == {1, 2, 3, 4, 5}
    demands = [share for road in OPEN_TEST_ROADS.values() for share in road.demand]
    assert (min(demands), max(demands)) == (0.3, 1.1)


@pytest.mark.long
@pytest.mark.parametrize("name", OPEN_TEST_ROADS)
def test_sumo_loads_the_files_of_each_road(name: str, tmp_path: Path) -> None:
    road = OPEN_TEST_ROADS[name]
    scenario: Any = make_scenario(str(write_road_files(road, tmp_path)), {"penetration_rate": 0.1})
    assert (1 + scenario.horizon) * scenario.control_step == EPISODE_SECONDS  # the first step inserts vehicles
    network = (tmp_path / "road.net.xml").read_text()
    assert ('type="traffic_light"' in network) == road.has_signals


def travel_time(road: OpenTestRoad, driver: str, seconds: float, folder: Path, simulation: Simulation) -> float:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(open_test_roads, "EPISODE_SECONDS", seconds)
        file = write_road_files(road, folder)
    scenario = make_scenario(str(file), {"penetration_rate": 0.1, "steps_per_control_step": 2, **ACC_SETTINGS})
    made = make_driver(driver, scenario.control_step)
    return measure(run_episode(scenario, made, (1,), backend=SumoBackend(simulation)))["travel_time"]


@pytest.mark.slow
def test_no_set_speed_is_reduced_in_dense_free_flow_far_below_the_limit(
    tmp_path: Path, simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the congestion report it is: the mean speed ahead is below three quarters of the limit."""
    road = OPEN_TEST_ROADS["limit far above the flow"]
    acc, controller = (travel_time(road, each, 700.0, tmp_path, simulation) for each in (ACC_DRIVER, TESTED_CONTROLLER))
    assert controller == acc
    monkeypatch.setattr(CongestionMonitor, "update", lambda monitor, counts, sums: np.ones(len(counts), bool))
    assert travel_time(road, TESTED_CONTROLLER, 700.0, tmp_path, simulation) > 1.01 * acc


@pytest.mark.slow
def test_set_speeds_are_reduced_upstream_of_an_overloaded_ramp(tmp_path: Path, simulation: Simulation) -> None:
    road = OPEN_TEST_ROADS["on-ramp, overloaded"]
    acc, controller = (travel_time(road, each, 700.0, tmp_path, simulation) for each in (ACC_DRIVER, TESTED_CONTROLLER))
    assert controller != acc


@pytest.mark.slow
def test_the_study_ends_by_itself_and_can_be_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    short = {name: OpenTestRoad((RoadSection(400, 1, 25),), (share,)) for name, share in (("a", 0.5), ("b", 0.6))}
    monkeypatch.setattr(do_no_harm, "OPEN_TEST_ROADS", short)
    monkeypatch.setattr(do_no_harm, "SEED_BATCH", 3)
    monkeypatch.setattr(do_no_harm, "PENETRATION_RATES", (0.4, 0.6))
    monkeypatch.setattr(open_test_roads, "EPISODE_SECONDS", 60.0)
    run_each = WorkerPool.run_and_map
    batches: list[int] = []

    def stop_in_the_second(pool: WorkerPool, tasks: Any, transform: Any, on_progress: Any = None) -> Any:
        batches.append(len(tasks))
        if len(batches) == 2:
            raise KeyboardInterrupt
        return run_each(pool, tasks, transform, on_progress)

    monkeypatch.setattr(WorkerPool, "run_and_map", stop_in_the_second)
    with pytest.raises(KeyboardInterrupt):
        DO_NO_HARM.run(StudyFolder(tmp_path), 1, tmp_path, 1)
    for _ in range(2):  # the second call finds nothing to run
        DO_NO_HARM.run(StudyFolder(tmp_path), 1, tmp_path, 1)
    assert batches == [15, 15, 15], "the baseline, and both drivers at two penetration rates, on three seeds"
    table = DO_NO_HARM.tables["harm"](tmp_path)
    assert table["road"].tolist() == ["a", "a", "b", "b"]
    assert set(table["verdict"]) == {NO_HARM}
    assert set(table["seeds"]) == {3}
