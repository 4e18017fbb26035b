"""The command line reports incomplete episodes on a user network."""

import json
from pathlib import Path
from typing import Any

import pytest

import unjam as package
from tests.system.conftest import Run
from tests.worlds.sumo.user_networks import LATE, STANDING, TELEPORTS, UNSORTED, crossing, straight, two_way
from unjam.controller import make_driver
from unjam.errors import InputError
from unjam.scenarios import make_scenario
from unjam.worlds.episode import run_episode

IGNORED = "demand is missing, SUMO warns: Route file should be sorted by departure time, ignoring 'c'!"
NONE_ENTERED = "no vehicle entered before 60 s; the first departs at 25,200 s; use --begin 25200"
STOPPED = "episodes ended early: more than 0 teleports (max-num-teleports)"


def only_driver(run: Run, *words: object) -> dict[str, Any]:
    ran = run(*words, "--json", pictures=False)
    assert ran.returncode == 0, ran.stderr
    (found,) = json.loads(ran.stdout)["drivers"]
    return found


@pytest.mark.slow
def test_ignored_demand_is_in_terminal_json_and_report(unjam: Run, tmp_path: Path) -> None:
    straight(tmp_path, UNSORTED, end=90.0, step=0.5)
    drive = ("drive", "straight.sumocfg", "--penetration-rate", 0.5, "-d", "human", "-n", 2)
    count = "(2 warnings of this kind in 2 of 2 episodes)"
    ran = unjam(*drive, "--out", "out", pictures=False)
    assert f"note: {IGNORED} {count}" in ran.stderr
    assert IGNORED.replace("'", "&#39;") in (tmp_path / "out" / "report.html").read_text()
    found = only_driver(unjam, *drive, "--no-report")
    assert found["notes"][0] == f"{IGNORED} {count}"
    assert [row["vehicles"] for row in found["episodes"]] == [10, 10]
    assert found["early_ends"] == {}


@pytest.mark.parametrize(
    "words",
    [
        ("drive", "straight.sumocfg", "--penetration-rate", "0.1"),
        ("drive", "straight.sumocfg", "--penetration-rate", "0.1", "-d", "human", "--set", "horizon=119"),
        ("assess", "straight.sumocfg"),
        ("train", "straight.sumocfg", "--set", "scenario_options.penetration_rate=0.5", "--steps", "100"),
    ],
)
def test_traffic_without_vehicles_is_refused_in_one_line(words: tuple[str, ...], unjam: Run, tmp_path: Path) -> None:
    straight(tmp_path, LATE, step=0.5)
    ran = unjam(*words)
    assert (ran.returncode, ran.stdout) == (2, "")
    assert ran.stderr.strip() == f"unjam: {NONE_ENTERED} --end 25260"
    assert not list(tmp_path.glob("runs/*"))


@pytest.mark.long
def test_the_proposed_begin_helps_also_in_python(tmp_path: Path) -> None:
    file, options = str(straight(tmp_path, LATE, step=0.5)), {"penetration_rate": 0.5}
    with pytest.raises(InputError, match=NONE_ENTERED):
        package.drive(file, "human", 1, scenario_options=options, workers=1)
    rows = package.drive(file, "human", 1, scenario_options={**options, "begin": 25200, "end": 25260}, workers=1).rows
    assert rows["human"][0]["vehicles"] >= 20


def test_vehicles_that_sumo_does_not_insert_are_reported_in_one_line(unjam: Run, tmp_path: Path) -> None:
    vehicle = '<vehicle id="v" type="car" route="along" depart="5"/>'
    straight(tmp_path, vehicle, end=20.0, options='<max-num-vehicles value="0"/>')
    ran = unjam("drive", "straight.sumocfg", "--penetration-rate", 0.5, "-d", "human", "-n", 1, "--no-report")
    assert ran.returncode == 2
    assert "unjam: no vehicle entered before 20 s, though the first departs at 5 s" in ran.stderr


@pytest.mark.long
def test_overlaps_at_junctions_that_sumo_ignores_do_not_end_the_baseline(unjam: Run, tmp_path: Path) -> None:
    crossing(tmp_path)
    found = [
        only_driver(unjam, "drive", "my.sumocfg", "--penetration-rate", share, "-d", "human", "-n", 1, "--no-report")
        for share in (0.01, 0.5)
    ]
    (few,), (half,) = (each["episodes"] for each in found)
    assert (few["status"], few["collisions"], few["steps"]) == ("completed", 0.0, 899)
    assert found[0]["early_ends"] == {}
    traffic = ("vehicles", "mean_speed", "travel_time", "outflow_veh_per_h", "fuel_ml_per_km")
    assert [few[name] for name in traffic] == [half[name] for name in traffic]


@pytest.mark.slow
def test_assess_refuses_a_baseline_that_a_limit_of_teleports_ends(unjam: Run, tmp_path: Path) -> None:
    options = TELEPORTS + '<max-num-teleports value="0"/>'
    straight(tmp_path, STANDING, end=120.0, step=0.5, options=options)
    drive = ("drive", "straight.sumocfg", "--penetration-rate", 0.5, "-d", "human", "-n", 2)
    ran = unjam(*drive, "--out", "out", pictures=False)
    assert f"note: human: 2 of 2 {STOPPED}; means are over complete episodes only" in ran.stderr
    assert STOPPED in (tmp_path / "out" / "report.html").read_text()
    found = only_driver(unjam, *drive, "--no-report")
    assert found["early_ends"] == {"more than 0 teleports (max-num-teleports)": 2}
    assert found["mean"]["travel_time"] is None
    assert {row["status"] for row in found["episodes"]} == {"teleports"}
    refused = unjam(
        "assess", "straight.sumocfg", "-d", "acc", "--penetration-rates", "0.5", "-n", 40, "--out", "answer"
    )
    assert refused.returncode == 2
    assert f"unjam: human: 3 of 3 {STOPPED}; allowed: 5 %" in refused.stderr
    assert not (tmp_path / "answer" / "assessment.json").exists()


@pytest.mark.slow
def test_contact_of_cavs_is_recorded_without_ending_the_episode(unjam: Run, tmp_path: Path) -> None:
    two_way(tmp_path)
    drive = ("drive", "my.sumocfg", "--penetration-rate", 0.9, "-d", "acc", "-n", 2, "--no-report")
    found = only_driver(unjam, *drive, "--set", "actuation=raw", "--set", "safety.active=false")
    rows = found["episodes"]
    assert {row["status"] for row in rows} == {"completed"}
    assert found["early_ends"] == {}
    assert sum(row["contacts"] for row in rows) > 0
    file, driver = str(tmp_path / "my.sumocfg"), make_driver("acc", 0.5)
    changes = {"penetration_rate": 0.9, "actuation": "raw", "safety.active": False}
    trained = run_episode(make_scenario(file, changes), driver, rows[0]["seed"])
    assert trained.status == "collision"
