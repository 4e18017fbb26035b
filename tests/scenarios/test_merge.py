import re
import xml.etree.ElementTree as ElementTree
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unjam.errors import InputError
from unjam.scenarios import Merge, make_scenario, scenario_from_recipe, scenario_recipe
from unjam.scenarios.merge import ENTRANCE_LENGTH, JUNCTION_LENGTHS
from unjam.scenarios.road import MergeRoad
from unjam.worlds.sumo.backend import sumo_inputs
from unjam.worlds.sumo.networks import network_file


def draw_road(seed: int = 0, **changes: Any) -> MergeRoad:
    return Merge(**changes).draw(np.random.default_rng(seed))


def entries(road: MergeRoad) -> list[dict[str, str]]:
    """Return the attributes of the vehicles in SUMO's file, in their order."""
    written = ElementTree.fromstring(sumo_inputs(Merge(), road).traffic_xml)
    return [vehicle.attrib for vehicle in written.iter("vehicle")]


def cav_numbers(road: MergeRoad) -> list[int]:
    """Return the numbers of the highway's vehicles that are CAVs, sorted."""
    return sorted(int(name.removeprefix("cav_")) for name in road.cav_ids)


def times_of(road: MergeRoad, pattern: str) -> list[float]:
    return [float(entry["depart"]) for entry in entries(road) if re.fullmatch(pattern, entry["id"])]


def test_entries_are_evenly_spaced_according_to_the_flows() -> None:
    road = draw_road()
    highway, ramp = times_of(road, r"(human|cav)_\d+"), times_of(road, r"human_r\d+")
    assert (len(highway), len(ramp)) == (333, 16)  # 2,000 and 100 an hour, in 600 s
    np.testing.assert_allclose(highway, np.arange(333) * 1.8, atol=0.006)
    np.testing.assert_allclose(ramp, np.arange(16) * 36.0, atol=0.006)
    assert times_of(road, r"human_s\d+") == [0.0] * 5


def test_the_file_lists_vehicles_by_entry_time() -> None:
    road = draw_road(warmup=100)
    times = [float(entry["depart"]) for entry in entries(road)]
    assert times == sorted(times)
    assert {entry["id"] for entry in entries(road)} == set(road.origins)
    assert road.cav_ids <= set(road.origins)
    assert {entry["type"] for entry in entries(road)} == {"human"}  # until the driver takes over


def test_vehicles_enter_during_the_warm_up_too() -> None:
    assert len(times_of(draw_road(warmup=500, horizon=100), r"(human|cav)_\d+")) == 200 * 2000 // 3600


def test_vehicles_enter_at_their_origin() -> None:
    road = draw_road(standing_vehicles=3)
    highway, ramp = JUNCTION_LENGTHS
    starts = {"from_inflow_highway": -(600.1 + highway), "from_highway": -(500 + highway)}
    starts |= {"from_inflow_ramp": -(200.1 + ramp)}
    for entry in entries(road):
        place = starts[entry["route"]] + float(entry["departPos"])
        assert road.origins[entry["id"]] == (entry["route"] == "from_inflow_ramp", pytest.approx(place))
    standing = [road.origins[f"human_s{index}"].position for index in range(3)]
    np.testing.assert_allclose(np.diff(standing), 200.0, atol=0.11)


def test_without_standing_vehicles_the_road_is_empty() -> None:
    assert times_of(draw_road(standing_vehicles=0), r"human_s\d+") == []


@given(st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_cavs_are_drawn_independently(seed: int, cav_share: float) -> None:
    count = len(cav_numbers(draw_road(seed, penetration_rate=cav_share)))
    spread = np.sqrt(333 * cav_share * (1 - cav_share))
    assert abs(count - 333 * cav_share) <= 5.5 * spread + 1e-9


@pytest.mark.parametrize("spacing", ["random", "even"])
def test_none_or_all_of_the_highways_vehicles_are_cavs(spacing: str) -> None:
    assert cav_numbers(draw_road(penetration_rate=0.0, cav_spacing=spacing)) == []
    assert cav_numbers(draw_road(penetration_rate=1.0, cav_spacing=spacing)) == list(range(333))


def test_even_spacing_is_each_tenth_vehicle_in_every_episode() -> None:
    for seed in range(3):
        assert cav_numbers(draw_road(seed, cav_spacing="even")) == list(range(0, 333, 10))


@given(st.floats(0, 1))
def test_even_spacing_spreads_cavs_evenly(cav_share: float) -> None:
    found = cav_numbers(draw_road(penetration_rate=cav_share, cav_spacing="even"))
    assert abs(len(found) - 333 * cav_share) <= 1.0
    assert len(np.unique(np.diff(found))) <= 2


def test_random_cavs_differ_from_episode_to_episode() -> None:
    found = [tuple(cav_numbers(draw_road(seed))) for seed in range(6)]
    assert len(set(found)) == 6
    assert found[0] == tuple(cav_numbers(draw_road(0)))


@given(st.integers(0, 2**32 - 1), st.integers(1, 166))
def test_the_set_number_of_cavs_enters_in_the_first_half(seed: int, count: int) -> None:
    road = draw_road(seed, cavs=count)
    assert len(cav_numbers(road)) == count
    assert max(cav_numbers(road)) * 1.8 < 300.0


def test_cav_ids_are_among_the_possible_ones() -> None:
    all_changes: list[dict[str, Any]] = [{}, {"cavs": 5}, {"penetration_rate": 1.0}, {"inflow": 700.0}]
    for changes in all_changes:
        assert draw_road(**changes).cav_ids <= set(Merge(**changes).possible_cav_ids())


def test_lanes_across_the_junction_are_those_of_the_network_file() -> None:
    tree = ElementTree.parse(network_file(draw_road().network))
    lanes = {lane.get("id"): float(lane.get("length", "nan")) for lane in tree.iter("lane")}
    via = {
        link.get("from"): lanes[link.get("via")]
        for link in tree.iter("connection")
        if link.get("to") == "after" and link.get("via")
    }
    np.testing.assert_allclose((via["highway"], via["ramp"]), JUNCTION_LENGTHS, atol=1e-6)
    assert draw_road().junction_lengths == JUNCTION_LENGTHS
    assert lanes[":highway_begin_0_0"] == lanes[":ramp_begin_0_0"] == ENTRANCE_LENGTH
    edges = [lanes[f"{name}_0"] for name in ("inflow_highway", "highway", "after", "inflow_ramp", "ramp")]
    np.testing.assert_allclose(edges, [100.0, 500.0, 100.0, 100.0, 100.0], atol=1e-6)


def plain_highway(flow: float, vehicles: int = 120, step: float = 0.2) -> float:
    """Return the mean speed of the last of many human drivers on the highway, by Eq. 5-6 [m/s]."""
    length, entry_interval = 700.1 + JUNCTION_LENGTHS[0], round(3600.0 / flow / step)
    position, speed, travel_time = (np.full(vehicles, value) for value in (np.nan, 10.0, 0.0))
    step_number = 0
    while not position[-1] >= length:
        has_entered = np.arange(vehicles) * entry_interval <= step_number
        position[has_entered & np.isnan(position)] = 0.0
        leader = np.where(position[:-1] >= length, np.inf, position[:-1])  # a vehicle that has left is no leader
        gap = np.append(np.inf, leader - position[1:] - 5.0)
        closing = np.append(0.0, speed[1:] - speed[:-1])
        desired_gap = 2.0 + np.maximum(speed + speed * closing / (2 * np.sqrt(1.5)), 0.0)
        next_speed = np.maximum(speed + step * (1.0 - (speed / 30.0) ** 4 - (desired_gap / gap) ** 2), 0.0)
        speed[has_entered] = next_speed[has_entered]
        travel_time[has_entered & (position < length)] += step
        position[has_entered] += step * speed[has_entered]
        step_number += 1
    return length / travel_time[-1]


@pytest.mark.parametrize("flow", [1200.0, 2000.0])
def test_limit_is_the_speed_of_undisturbed_human_drivers(flow: float) -> None:
    assert draw_road(inflow=flow).limit_speed == pytest.approx(plain_highway(flow), rel=1e-9)


def test_limit_is_about_twenty_and_falls_with_the_flow() -> None:
    limits = [Merge(inflow=flow).limit_speed() for flow in (200.0, 1000.0, 2000.0)]
    assert limits == sorted(limits, reverse=True)
    assert 20.0 < limits[-1] < limits[0] < 30.0


def test_a_recipe_restores_the_scenario() -> None:
    scenario = Merge(cavs=3, cav_spacing="even", inflow=1500.0)
    assert scenario_from_recipe(scenario_recipe(scenario)) == scenario
    assert scenario.stratum(1, 3) == scenario


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"standing_vehicles": 81}, "standing_vehicles: 81 is not allowed; allowed: <= 80"),
        ({"standing_vehicles": -1}, "standing_vehicles"),
        ({"cavs": 167}, "cavs: 167 is not allowed; allowed: <= 166, the vehicles of the first half"),
        ({"cavs": 0}, "cavs"),
        ({"penetration_rate": 1.1}, "penetration_rate: 1.1"),
        ({"penetration_rate": -0.1}, "penetration_rate: -0.1"),
        ({"inflow": 0}, "inflow: 0"),
        ({"ramp_flow": -5}, "ramp_flow: -5"),
        ({"cav_spacing": "odd"}, "'random' or 'even'"),
        ({"human_control": "native"}, "human_control: 'native' is not allowed on the merge; allowed: 'commanded'"),
        ({"length": (230, 230)}, "length: unknown name"),
    ],
)
def test_invalid_values_are_reported_in_one_line(changes: Any, words: str) -> None:
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        make_scenario("merge", changes)
    assert "\n" not in str(caught.value)
