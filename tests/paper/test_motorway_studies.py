"""Studies of motorways: candidates of human traffic, their deviation from facts, and the ensemble of settings."""

from collections import Counter
from dataclasses import fields, replace
from math import inf
from pathlib import Path

import pytest

from unjam.measures.traffic_facts import TrafficFacts
from unjam_paper.human_traffic import (
    CANDIDATES_PART,
    POPULATIONS,
    TARGETS,
    capacity_road,
    make_candidate,
    total_deviation,
)
from unjam_paper.motorway_ensemble import (
    CAPACITY_PART,
    FREE_FLOW_PART,
    LEVELS,
    SETTINGS,
    SETTINGS_PER_HALF,
    settings_table,
)
from unjam_paper.results_file import read_part

RESULTS = Path(__file__).parents[2] / "results"
AT_TARGET = {
    **{each.name: 1.0 for each in fields(TrafficFacts)},
    "highest_flow": 1950.0,
    "flow_before": 1900.0,
    "discharge": 1748.0,
    "wave_speed": -17.0 / 3.6,
    "free_time_gap": 1.3,
    "congested_time_gap": 1.65,
    "lane_changes_per_km": 0.4,
    "merge_ratio": 0.9,
    "hardest_braking": 3.0,
}


def test_traffic_at_its_targets_has_no_deviation_and_one_without_a_breakdown_an_infinite_one() -> None:
    row = {**AT_TARGET, "discharge": 1780.0, "flow_before": 1780.0 / 0.92}
    assert total_deviation([row, row]) == pytest.approx(0.0, abs=1e-9)
    assert total_deviation([{**row, "wave_speed": -20.0 / 3.6}]) == pytest.approx((1.0 / len(TARGETS)) ** 0.5)
    assert total_deviation([{**row, "discharge": None}]) == inf


def test_each_candidate_is_a_scenario_with_trucks() -> None:
    for number in range(20):
        scenario = capacity_road(make_candidate(number))
        assert scenario.trucks.share == 0.1
        assert scenario.peak_rise == scenario.peak[0]


def test_the_populations_are_the_candidates_with_the_smallest_deviations() -> None:
    candidates = read_part(RESULTS / "human-traffic.json", CANDIDATES_PART)
    best = sorted(candidates, key=lambda each: total_deviation(each["episodes"]))[: len(POPULATIONS)]
    for candidate, population in zip(best, POPULATIONS, strict=True):
        assert [*candidate["settings"]["time_headways"]] == [*population["time_headways"]]


def test_both_halves_of_the_ensemble_have_all_levels() -> None:
    assert len(SETTINGS) == 2 * SETTINGS_PER_HALF
    for is_test in (False, True):
        half = [each for each in SETTINGS if each.is_test is is_test]
        for name, levels in LEVELS.items():
            assert Counter(getattr(each, name) for each in half) == Counter(levels)


def test_capacities_and_free_travel_times_are_those_of_the_results() -> None:
    capacities = read_part(RESULTS / "motorway-ensemble.json", CAPACITY_PART)
    times = read_part(RESULTS / "motorway-ensemble.json", FREE_FLOW_PART)
    for setting in SETTINGS:
        flows = [row["highest_flow"] for row in capacities[str(setting.number)]["episodes"]]
        assert setting.capacity / setting.traffic["lanes"] == pytest.approx(sum(flows) / len(flows), abs=0.5)
        assert setting.free_flow_time == pytest.approx(times[str(setting.number)]["travel_time"], abs=0.05)


def test_waves_of_the_ensemble_travel_at_possible_speeds() -> None:
    table = settings_table(RESULTS / "motorway-ensemble.json")
    name = next(each for each in table.columns if each.startswith(TARGETS["wave_speed"].name))
    assert all(10.0 < float(each.split()[0]) < 30.0 for each in table[name])


def test_no_delay_is_unavoidable_below_capacity_and_more_the_higher_the_demand() -> None:
    delays = [replace(SETTINGS[0], demand=demand).unavoidable_delay for demand in (0.9, 1.0, 1.05, 1.15)]
    assert delays[:2] == pytest.approx([0.0, 0.0])
    # A queue of 5 % of the flow of 1,200 s grows to 60 s of flow, and dissolves with 40 % of it in 150 s.
    flow_seconds = 0.5 * 60.0 * (1200.0 + 150.0)
    vehicles_in_seconds_of_flow = 1.05 * 1200.0 + 0.6 * 1200.0
    assert delays[2] == pytest.approx(flow_seconds / vehicles_in_seconds_of_flow, rel=0.01)
    assert delays[3] > 3.0 * delays[2]


@pytest.mark.parametrize("number", range(2 * SETTINGS_PER_HALF))
def test_the_demand_of_a_setting_is_relative_to_its_capacity(number: int) -> None:
    setting = SETTINGS[number]
    scenario = setting.scenario(4000.0, setting.demand)
    total = scenario.inflow + sum(ramp.inflow for ramp in scenario.ramps)
    assert total == pytest.approx(4000.0 * setting.demand, abs=3.0)
    assert scenario.trucks.share == setting.trucks
