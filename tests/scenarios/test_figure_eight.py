import xml.etree.ElementTree as ElementTree
from math import pi

import numpy as np
import pytest

from unjam.errors import InputError
from unjam.scenarios import SCENARIOS, FigureEight, make_scenario, scenario_from_recipe, scenario_recipe
from unjam.scenarios.figure_eight import figure_eight_length
from unjam.scenarios.road import ClosedRoad
from unjam.worlds.sumo.networks import network_file

ORDER = ["bottom", "top", "upper_ring", "right", "left", "lower_ring"]


def draw_road(radius: int, **changes: object) -> ClosedRoad:
    scenario = make_scenario("figure-eight", {"radius": (radius, radius), **changes})
    road = scenario.draw(np.random.default_rng(0))
    assert isinstance(road, ClosedRoad)
    return road


@pytest.mark.parametrize("radius", [20, 30, 32, 35, 50])
def test_the_lap_length_is_that_of_the_network_file(radius: int) -> None:
    tree = ElementTree.parse(network_file(draw_road(radius).network))
    lanes = {lane.get("id"): float(lane.get("length", "nan")) for lane in tree.iter("lane")}
    links = {(link.get("from"), link.get("to")): link.get("via") for link in tree.iter("connection") if link.get("via")}
    length, crossings = 0.0, []
    for name, following in zip(ORDER, [*ORDER[1:], ORDER[0]], strict=True):
        length += lanes[f"{name}_0"]
        way_across = lanes[links[name, following]]
        if name in ("bottom", "right"):
            crossings.append((length, length + way_across))
        length += way_across
    assert draw_road(radius).loop_length == pytest.approx(length, abs=1e-4)
    np.testing.assert_allclose(draw_road(radius).crossings, crossings, atol=1e-4)


def test_edges_are_four_arms_and_two_arcs() -> None:
    assert figure_eight_length(30) == pytest.approx(4 * 30 + 3 * pi * 30 + 2 * 9.4, abs=0.7)


def test_radii_are_integers_from_the_whole_range() -> None:
    generator = np.random.default_rng(0)
    radii = {FigureEight().draw(generator).drawn_values["radius"] for _ in range(200)}
    assert radii == {32, 33, 34, 35}
    assert SCENARIOS["figure-eight-30"].drawn_ranges == {"radius": (30, 30)}


def test_the_first_cav_leads_a_queue_with_free_road_ahead() -> None:
    road = draw_road(32)
    assert road.cav_ids == (road.vehicle_ids[-1],)
    assert np.all(np.diff(road.start_positions) > 7)
    ahead = road.loop_length - road.start_positions[-1]
    assert ahead > 50 + np.diff(road.start_positions).mean()


def test_no_vehicle_starts_on_the_crossing() -> None:
    for radius in range(20, 51):
        road = draw_road(radius)
        for start, end in road.crossings:
            assert not np.any((road.start_positions > start) & (road.start_positions < end))


def test_the_outline_is_as_long_as_the_lap() -> None:
    road = draw_road(32)
    coordinates, places = road.center_line[:, 0], road.center_line[:, 1:]
    assert coordinates[0] == 0
    assert coordinates[-1] == road.loop_length
    assert np.all(np.diff(coordinates) > 0)
    np.testing.assert_allclose(places[0], places[-1])
    drawn_length = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
    assert drawn_length == pytest.approx(road.loop_length, rel=0.05)


@pytest.mark.parametrize(("radius", "limit"), [(32, 7.5), (33, 8.0), (34, 8.5), (35, 8.9)])
def test_limit_is_near_what_a_queue_of_half_a_lap_allows(radius: int, limit: float) -> None:
    assert FigureEight().limit_speed(radius) == pytest.approx(limit, rel=0.03)


def test_a_recipe_restores_the_scenario() -> None:
    scenario = FigureEight(radius=(30, 40), cavs=2)
    assert scenario_from_recipe(scenario_recipe(scenario)) == scenario


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"radius": (35, 32)}, "radius: 32 m is not allowed as the largest; allowed: >= 35 m"),
        ({"vehicles": 60}, "they need 420 m of road"),
        ({"cavs": 15}, "cavs: 15 is not allowed; allowed: <= vehicles, 14"),
        ({"radius": (5, 5)}, "radius"),
        ({"length": (230, 230)}, "length: unknown name"),
        ({"human_control": "wild"}, "human_control"),
    ],
)
def test_invalid_parameters_are_reported_in_one_line(changes: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words) as raised:
        make_scenario("figure-eight", changes)
    assert "\n" not in str(raised.value)
