"""Is the on-ramp drawn as it is specified: people, demand, and who is automated?"""

from dataclasses import replace

import numpy as np
import pytest

from unjam.errors import InputError
from unjam.scenarios import OnRamp, make_scenario
from unjam.scenarios.road import MotorwayRoad

ROAD = OnRamp()


def drawn(scenario: OnRamp = ROAD, seed: int = 0) -> MotorwayRoad:
    return scenario.draw(np.random.default_rng(seed))


def test_a_larger_penetration_rate_only_adds_cavs() -> None:
    few, many = drawn(replace(ROAD, penetration_rate=0.05)), drawn(replace(ROAD, penetration_rate=0.2))
    assert few.cav_ids < many.cav_ids
    assert few.entries == many.entries
    assert few.vehicle_types == many.vehicle_types
    share = len(many.cav_ids) / len(many.entries)
    assert share == pytest.approx(0.2, abs=0.03)
    assert any(entry.route == "ramp" for entry in many.entries if entry.name in many.cav_ids)


def test_entries_follow_the_demand() -> None:
    begin, end = ROAD.peak
    flows: dict[tuple[str, bool], list[float]] = {}
    for seed in range(5):
        entries = drawn(seed=seed).entries
        for route in ("motorway", "ramp"):
            times = np.array([entry.time for entry in entries if entry.route == route])
            assert (np.diff(times) >= 0).all()
            peak = (times >= begin) & (times < end)
            flows.setdefault((route, True), []).append(3600 * peak.sum() / (end - begin))
            flows.setdefault((route, False), []).append(3600 * (~peak).sum() / (2400 - (end - begin)))
    expected = {("motorway", True): 3200, ("ramp", True): 500, ("motorway", False): 1800, ("ramp", False): 250}
    for key, flow in expected.items():
        assert np.mean(flows[key]) == pytest.approx(flow, rel=0.05), key


def test_entry_headways_are_at_least_the_smallest_one() -> None:
    by_lane: dict[tuple[str, int], list[float]] = {}
    for entry in drawn().entries:
        by_lane.setdefault((entry.route, entry.lane), []).append(entry.time)
    assert set(by_lane) == {("motorway", 0), ("motorway", 1), ("ramp", 0)}
    for (route, _), times in by_lane.items():
        smallest = 2.0 if route == "ramp" else 1.1
        within = np.diff(times)
        assert (np.sort(within)[4:] >= smallest - 0.011).all()  # a period begins anew


def test_human_drivers_differ_within_their_ranges() -> None:
    people = list(drawn().vehicle_types.values())
    assert len(people) == 200
    for values, (low, high) in (
        ([person.time_headway for person in people], (1.0, 1.8)),
        ([person.acceleration for person in people], (1.0, 1.5)),
        ([person.deceleration for person in people], (1.5, 2.0)),
        ([person.minimum_gap for person in people], (2.0, 2.5)),
        ([person.speed_factor for person in people], (0.8, 1.2)),
    ):
        assert low <= min(values) < max(values) <= high
    assert np.std([person.speed_factor for person in people]) == pytest.approx(0.1, abs=0.02)


def test_variants_with_one_lane_and_with_a_steady_peak_have_names() -> None:
    one = make_scenario("on-ramp-1")
    assert isinstance(one, OnRamp)
    assert {entry.lane for entry in drawn(one).entries} == {0}
    assert {lane.name for lane in drawn(one).edge_lanes} >= {"motorway_0", "merging_1", "after_0"}
    steady = make_scenario("on-ramp-steady")
    assert isinstance(steady, OnRamp)
    assert steady.peak == (300.0, 2400.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"penetration_rate": 1.2}, "penetration_rate: 1.2"),
        ({"lanes": 3}, "lanes: 3"),
        ({"time_headways": [1.8, 1.0]}, r"time_headways: \(1.8, 1\) is not allowed; allowed: 0 < low <= high"),
        ({"inflow": 9000}, "inflow: 9000 is not allowed; allowed: < 6545, by min_entry_headway"),
        ({"ramp_flow": 1800}, "ramp_flow: 1800 is not allowed; allowed: < 1800"),
        ({"human_control": "commanded"}, "human_control: 'commanded' is not allowed on the on-ramp"),
        ({"roadside.loss_rate": 1.0}, "roadside.loss_rate: 1.0"),
    ],
)
def test_invalid_values_are_reported_in_one_line(changes: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_scenario("on-ramp", changes)
