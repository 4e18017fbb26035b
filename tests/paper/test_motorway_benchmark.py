"""The motorway benchmark: candidates of methods, how they are compared, and in which order parts are measured."""

from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from unjam.controller import make_driver
from unjam.worlds.episode import can_drive
from unjam_paper.motorway_benchmark import (
    ACC_ALONE,
    CHANGED_SETTING,
    CHANGES,
    CONTROLLER,
    FINAL_PART,
    FINALISTS,
    HUMAN,
    HUMAN_PART,
    HUMAN_SEEDS,
    OPPONENT,
    PACKAGED_PART,
    SENSING_PART,
    SENSITIVITY_PART,
    STUDY_NAME,
    TEST_HUMAN_PART,
    TEST_PART,
    TUNING_PART,
    comparison_table,
    delay_change,
    make_job_scenario,
    make_parts,
    no_harm_table,
    packaged_table,
    parameter_effects_table,
    rank_candidates,
    sensing_table,
    sensitivity_table,
    settings_with_breakdown,
    summary_table,
)
from unjam_paper.motorway_ensemble import SETTINGS, SETTINGS_PER_HALF
from unjam_paper.motorway_methods import CANDIDATES_PER_METHOD, METHODS
from unjam_paper.results_file import write_part
from unjam_paper.study import StudyFolder


def human_rows(delay: float = 100.0) -> list[dict[str, Any]]:
    """Return episodes of human traffic that breaks down on settings with even numbers only."""
    return [
        {
            "setting": setting.number,
            "seed": seed,
            "travel_time": setting.free_flow_time + delay,
            "breakdown_time": None if setting.number % 2 else 600.0,
        }
        for setting in SETTINGS[:SETTINGS_PER_HALF]
        for seed in range(HUMAN_SEEDS)
    ]


def candidate_rows(gain: float) -> list[dict[str, Any]]:
    return [{**row, "travel_time": row["travel_time"] - gain} for row in human_rows()[:4]]


@pytest.mark.parametrize("name", METHODS)
def test_all_candidates_drive_on_motorways_of_the_ensemble(name: str) -> None:
    candidates = [METHODS[name].candidate(number) for number in range(CANDIDATES_PER_METHOD)]
    assert len({repr(each) for each in candidates}) == CANDIDATES_PER_METHOD
    assert [METHODS[name].candidate(number) for number in range(CANDIDATES_PER_METHOD)] == candidates
    for number, candidate in enumerate(candidates):
        scenario = make_job_scenario(SETTINGS[number % len(SETTINGS)], candidate, 0.05)
        assert can_drive(make_driver(candidate.driver, scenario.control_step), scenario)
        assert scenario.roadside.source == "cavs"


def test_candidates_stay_those_that_were_measured() -> None:
    """Stored parts of the study name candidates by method and number only."""
    candidates = [each.candidate(number) for each in METHODS.values() for number in range(CANDIDATES_PER_METHOD)]
    assert sha256(repr(candidates).encode()).hexdigest().startswith("08b06b4e8089")


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
    assert sum(name.startswith(TUNING_PART) for name in parts) == CANDIDATES_PER_METHOD * len(METHODS)
    assert all(arguments[-1] == [0, 2, 4, 6, 8, 10] for _, arguments in parts.values() if len(arguments) > 1)
    rows = [
        {"method": method, "candidate": number, "episodes": candidate_rows(float(number))}
        for method in METHODS
        for number in range(CANDIDATES_PER_METHOD)
    ]
    write_part(study, TUNING_PART, rows)
    finalists = [name for name in make_parts(folder, 1) if name.startswith(FINAL_PART)]
    assert len(finalists) == FINALISTS * len(METHODS)
    assert all(int(name.rpartition(" ")[2]) >= CANDIDATES_PER_METHOD - FINALISTS for name in finalists)


def test_effects_are_those_of_parameters_on_the_delay(tmp_path: Path) -> None:
    write_part(tmp_path, HUMAN_PART, human_rows())
    gaps = [
        METHODS["ACC"].candidate(number).regression_values["cruise.time_gap"]
        for number in range(1, CANDIDATES_PER_METHOD)
    ]
    rows = [
        {"method": "ACC", "candidate": 1 + index, "episodes": candidate_rows(-10.0 * gap)}
        for index, gap in enumerate(gaps)
    ]
    write_part(tmp_path, TUNING_PART, rows)
    write_part(tmp_path, FINAL_PART, [])
    table = parameter_effects_table(tmp_path).set_index("parameter")
    assert set(table["method"]) == {"ACC"}
    assert float(table.loc["cruise.time_gap", "delay"].split()[0]) == pytest.approx(10.0 * np.std(gaps), abs=0.5)
    assert float(table.loc["cruise.acceleration", "delay"].split()[0]) == pytest.approx(0.0, abs=0.1)


def test_human_traffic_does_not_depend_on_methods() -> None:
    scenario = make_job_scenario(SETTINGS[0], HUMAN, 0.0)
    assert not scenario.speed_limit_control.active
    assert not scenario.ramp_meter.active


def compared_rows(driver: str, number: int, delay: float, rate: float = 0.05) -> list[dict[str, Any]]:
    common = {"driver": driver, "setting": number, "penetration_rate": rate, "status": "completed", "collisions": 0}
    limits = {"min_time_gap": 1.2, "cav_min_ttc": 9.0, "cav_max_braking": 1.0, "override_share": 0.0, "has_lanes": True}
    braking = {"human_braking_beyond_4_5": 10.0, "share_short_time_gap": 0.0, "cut_in_max_braking": 0.0}
    flows = {"outflow_veh_per_h": 3000.0, "waiting_at_entrances": 0.0, "required_time_gap": 1.0}
    return [
        {
            **{**common, **limits, **braking, **flows},
            **{"seed": seed, "travel_time": SETTINGS[number].free_flow_time + delay + seed},
        }
        for seed in range(3)
    ]


def test_tables_compare_the_controller_with_all_others_on_the_same_seeds(tmp_path: Path) -> None:
    drivers = {ACC_ALONE: 90.0, CONTROLLER: 70.0, OPPONENT: 80.0}
    write_part(
        tmp_path, TEST_HUMAN_PART, [*compared_rows("human", 12, 10.0, 0.0), *compared_rows("human", 13, 99.0, 0.0)]
    )
    rows = [
        row for rate in (0.05, 0.1) for name, delay in drivers.items() for row in compared_rows(name, 13, delay, rate)
    ]
    rows += [
        row for rate in (0.05, 0.1) for name in (ACC_ALONE, CONTROLLER) for row in compared_rows(name, 12, 9.0, rate)
    ]
    write_part(tmp_path, TEST_PART, rows)
    comparison = comparison_table(tmp_path)
    assert comparison["motorway"].tolist() == [13, 13]
    assert comparison["delay, against human"].str.split().str[0].tolist() == ["-29", "-29"]
    assert comparison["delay, against ACC alone"].str.split().str[0].tolist() == ["-20", "-20"]
    assert comparison["feasible"].tolist() == ["feasible"] * 2
    summary = summary_table(tmp_path)
    assert summary["delay, against best opponent"].tolist() == ["-10 %", "-10 %"]
    assert summary["ACC alone, against human"].tolist() == ["-9 %", "-9 %"]
    assert no_harm_table(tmp_path)["travel time"].tolist() == ["0.0 [0.0, 0.0] %"] * 2


def test_sensing_is_compared_on_the_same_settings_and_seeds(tmp_path: Path) -> None:
    write_part(tmp_path, TEST_HUMAN_PART, compared_rows("human", 13, 99.0, 0.0))
    write_part(tmp_path, TEST_PART, [*compared_rows(CONTROLLER, 13, 49.0), *compared_rows(CONTROLLER, 13, 9.0, 0.1)])
    write_part(tmp_path, SENSING_PART, compared_rows("none", 13, 99.0)[:2])
    table = sensing_table(tmp_path)
    assert table["source"].tolist() == ["cavs", "none"]
    assert table["delay, against human"].tolist() == ["-50 %", "0 %"]


def test_each_changed_assumption_is_a_scenario_and_has_its_row(tmp_path: Path) -> None:
    for factor, changes in CHANGES.values():
        setting = replace(SETTINGS[CHANGED_SETTING], demand=factor * SETTINGS[CHANGED_SETTING].demand)
        changed = make_job_scenario(setting, replace(HUMAN, settings=changes), 0.0)
        assert changed.inflow == pytest.approx(factor * make_job_scenario(SETTINGS[18], HUMAN, 0.0).inflow, rel=1e-3)
        assert changed.control_step == 1.0
    rows = {name: {label: compared_rows(label, 13, 9.0) for label in ("human", CONTROLLER)} for name in CHANGES}
    write_part(tmp_path, SENSITIVITY_PART, rows)
    assert sensitivity_table(tmp_path)["changed"].tolist() == [*CHANGES]


def test_the_packaged_controller_is_compared_by_source_and_penetration_rate(tmp_path: Path) -> None:
    write_part(tmp_path, HUMAN_PART, compared_rows("human", 3, 99.0, 0.0))
    rows = [*compared_rows("cavs", 3, 109.0), *compared_rows("cavs", 3, 99.0, 0.1), *compared_rows("vehicles", 3, 49.0)]
    write_part(tmp_path, PACKAGED_PART, rows)
    table = packaged_table(tmp_path).set_index("source")
    assert table["delay, 5 % CAVs"].to_dict() == {"cavs": "+10 %", "vehicles": "-50 %"}
    assert table.loc["cavs", "delay, 10 % CAVs"] == "+0 %"


def test_tables_are_empty_before_the_test_half_has_been_driven(tmp_path: Path) -> None:
    write_part(tmp_path, HUMAN_PART, human_rows())
    for make_table in (
        comparison_table,
        summary_table,
        no_harm_table,
        sensing_table,
        sensitivity_table,
        packaged_table,
    ):
        assert make_table(tmp_path).empty
