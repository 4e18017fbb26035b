"""The motorway benchmark: candidates of methods, how they are compared, and in which order parts are measured."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from unjam.controller import make_driver
from unjam.worlds.episode import can_drive
from unjam_paper.motorway_benchmark import (
    FINAL_PART,
    FINALISTS,
    HUMAN,
    HUMAN_PART,
    HUMAN_SEEDS,
    STUDY_NAME,
    TUNING_PART,
    delay_change,
    make_job_scenario,
    make_parts,
    rank_candidates,
    settings_with_breakdown,
)
from unjam_paper.motorway_ensemble import SETTINGS, SETTINGS_PER_HALF
from unjam_paper.motorway_methods import CANDIDATES, METHODS
from unjam_paper.results_file import write_part
from unjam_paper.study import StudyFolder


def human_rows(delay: float = 100.0) -> list[dict[str, Any]]:
    """Return human traffic that breaks down on even settings only."""
    return [
        {
            "setting": each.number,
            "seed": seed,
            "travel_time": each.free_flow_time + delay,
            "breakdown_time": None if each.number % 2 else 600.0,
        }
        for each in SETTINGS[:SETTINGS_PER_HALF]
        for seed in range(HUMAN_SEEDS)
    ]


def candidate_rows(gain: float) -> list[dict[str, Any]]:
    return [{**row, "travel_time": row["travel_time"] - gain} for row in human_rows()[:4]]


@pytest.mark.parametrize("name", METHODS)
def test_all_candidates_drive_on_motorways_of_the_ensemble(name: str) -> None:
    candidates = [METHODS[name].candidate(number) for number in range(CANDIDATES)]
    assert len({repr(each) for each in candidates}) == CANDIDATES
    assert [METHODS[name].candidate(number) for number in range(CANDIDATES)] == candidates
    for number, candidate in enumerate(candidates):
        scenario = make_job_scenario(SETTINGS[number % len(SETTINGS)], candidate, 0.05)
        assert can_drive(make_driver(candidate.driver, scenario.control_step), scenario)
        assert scenario.roadside.source == "cavs"


def test_a_lane_that_closes_has_no_meter() -> None:
    (number, *_) = (each.number for each in SETTINGS if each.road == "lane drop")
    metered = METHODS["ramp meter"].candidate(3)
    unmetered = make_job_scenario(SETTINGS[number], metered, 0.05).ramp_meter
    assert replace(unmetered, active=True) == make_job_scenario(SETTINGS[0], metered, 0.05).ramp_meter
    assert not unmetered.active


def test_the_change_of_delay_is_relative_to_all_delays_of_human_traffic() -> None:
    assert delay_change(candidate_rows(25.0), human_rows()) == pytest.approx(-0.25)
    mixed = [*candidate_rows(50.0)[:1], *candidate_rows(-10.0)[1:2]]
    assert delay_change(mixed, human_rows()) == pytest.approx(-0.2)


def test_candidates_with_larger_reductions_come_first() -> None:
    rows = [{"method": "ACC", "candidate": number, "episodes": candidate_rows(10.0 * number)} for number in range(3)]
    assert rank_candidates(rows, human_rows(), "ACC") == [2, 1, 0]


def test_parts_follow_from_the_results_of_earlier_parts(tmp_path: Path) -> None:
    folder, study = StudyFolder(tmp_path), tmp_path / STUDY_NAME
    names = [*make_parts(folder, 1)]
    assert {name.partition("/")[0] for name in names} == {HUMAN_PART}
    assert settings_with_breakdown(human_rows()) == [0, 2, 4, 6, 8, 10]
    study.mkdir()
    write_part(study, HUMAN_PART, human_rows())
    parts = make_parts(folder, 1)
    assert sum(name.startswith(TUNING_PART) for name in parts) == CANDIDATES * len(METHODS)
    assert all(arguments[-1] == [0, 2, 4, 6, 8, 10] for _, arguments in parts.values() if len(arguments) > 1)
    rows = [
        {"method": method, "candidate": number, "episodes": candidate_rows(float(number))}
        for method in METHODS
        for number in range(CANDIDATES)
    ]
    write_part(study, TUNING_PART, rows)
    finalists = [name for name in make_parts(folder, 1) if name.startswith(FINAL_PART)]
    assert len(finalists) == FINALISTS * len(METHODS)
    assert all(int(name.rpartition(" ")[2]) >= CANDIDATES - FINALISTS for name in finalists)


def test_human_traffic_does_not_depend_on_methods() -> None:
    scenario = make_job_scenario(SETTINGS[0], HUMAN, 0.0)
    assert not scenario.speed_limit_control.active
    assert not scenario.ramp_meter.active
