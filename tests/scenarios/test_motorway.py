"""Is a motorway drawn as it is specified: people, demand, and who is automated?"""

from dataclasses import replace

import numpy as np
import pytest

from unjam.errors import InputError
from unjam.scenarios import Motorway, Ramp, make_scenario
from unjam.scenarios.motorway import ON_RAMP
from unjam.scenarios.motorway_road import MotorwayRoad

ROAD = ON_RAMP


def make_motorway(name: str) -> Motorway:
    scenario = make_scenario(name)
    assert isinstance(scenario, Motorway)
    return scenario


def drawn(scenario: Motorway = ROAD, seed: int = 0) -> MotorwayRoad:
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
    one = make_motorway("on-ramp-1")
    assert {entry.lane for entry in drawn(one).entries} == {0}
    assert {name for name, *_ in drawn(one).geometry.edge_lanes} >= {"motorway_0", "merging_1", "after_0"}
    assert make_motorway("on-ramp-steady").peak == (300.0, 2400.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"penetration_rate": 1.2}, "penetration_rate: 1.2"),
        ({"lanes": 6}, "lanes: 6"),
        ({"time_headways": [1.8, 1.0]}, r"time_headways: \(1.8, 1\) is not allowed; allowed: 0 < low <= high"),
        ({"inflow": 9000}, "inflow: 9000 is not allowed; allowed: < 6545, by min_entry_headway"),
        ({"ramps.0.inflow": 1800}, "ramps.0.inflow: 1800 is not allowed; allowed: < 1800"),
        ({"ramps.1.inflow": 300}, "ramps.1: unknown entry; allowed: 0 to 0"),
        ({"ramps.0.color": 1}, "ramps.0.color: unknown name"),
        ({"ramps.0.position": 390}, r"ramps.0.position: 390 is not allowed; allowed: >= 400, its length downstream"),
        ({"ramps.0.position": 2700}, r"ramps.0.position: 2700 is not allowed; allowed: <= 2650, upstream of the end"),
        ({"ramps.0.entry_speed": 18}, r"ramps.0.entry_speed: 18 is not allowed; allowed: <= 17.776"),
        ({"ramps": [{"position": 800}, {"position": 1499}]}, "ramps.1.position: 1499 is not allowed; allowed: >= 1500"),
        ({"human_control": "commanded"}, "human_control: 'commanded' is not allowed on a motorway"),
        ({"roadside.loss_rate": 1.0}, "roadside.loss_rate: 1.0"),
    ],
)
def test_invalid_values_are_reported_in_one_line(changes: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_scenario("on-ramp", changes)


def test_sections_of_a_road_with_two_ramps_belong_to_the_next_ramp() -> None:
    geometry = make_motorway("two-ramps").geometry
    lane = np.array([1, 2, 1, 2, 1, 2, 0, 0, 0])
    position = np.array([0.0, 1999.0, 2100.0, 2300.0, 3600.0, 4000.0, 1700.0, 2300.5, 3200.0])
    sections = geometry.sections(lane, position)
    np.testing.assert_array_equal(sections.ramp, [0, 0, 0, 1, 1, 1, 0, 0, 1])
    np.testing.assert_array_equal(sections.start, [0, 0, 2000, 2300, 3500, 3800, 0, 2300, 2300])
    np.testing.assert_array_equal(sections.is_merging, [0, 0, 1, 0, 1, 0, 0, 0, 0])
    distance = geometry.distance_to_merge(lane, position)
    np.testing.assert_array_equal(distance, [2000, 1, -100, 1200, -100, -500, 300, -300.5, 300])
    limits = geometry.speed_limits(lane, sections)
    assert set(limits[[6, 8]]) == {22.22}
    assert set(limits[[0, 1, 2, 3, 4, 5, 7]]) == {27.78}


def test_each_ramp_has_its_own_demand_and_route() -> None:
    two = replace(make_motorway("two-ramps"), ramps=(Ramp(position=2000, inflow=200), Ramp(position=3500, inflow=800)))
    road = drawn(two)
    peak = [entry for entry in road.entries if two.peak[0] <= entry.time < two.peak[1]]
    first, second = (sum(entry.route == route for entry in peak) for route in ("ramp", "ramp2"))
    assert second == pytest.approx(4 * first, rel=0.25)
    assert [route.edges for route in road.routes] == [
        ("motorway", "merging", "after", "merging2", "after2"),
        ("ramp", "merging", "after", "merging2", "after2"),
        ("ramp2", "merging2", "after2"),
    ]


def test_a_road_without_ramps_has_no_merge() -> None:
    road = Motorway(lanes=3)
    assert "distance_to_merge" not in road.provided_fields
    assert drawn(road).geometry.lane_names == ("right lane", "middle lane", "left lane")
    assert {entry.route for entry in drawn(road).entries} == {"motorway"}


def test_free_flow_times_are_measured_or_those_at_the_speed_limits() -> None:
    assert ROAD.free_flow_time == 106.6
    assert Motorway(length=2778.0).free_flow_time == pytest.approx(100.0)
    ramp = Ramp(position=1389.0, length=444.4, off_peak_inflow=600.0)
    assert Motorway(length=2778.0, ramps=(ramp,)).free_flow_time == pytest.approx((1800 * 100 + 600 * 70) / 2400)
