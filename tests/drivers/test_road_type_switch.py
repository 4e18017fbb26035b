"""Each type of road gets its own driver from one file."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from unjam.controller import load_controller
from unjam.controller.file import controller_bytes
from unjam.drivers import Constant, PISaturation
from unjam.drivers.check import check_driver
from unjam.drivers.local_state import COMMON_FIELDS, LocalState, state_of_ones
from unjam.drivers.registry import driver_from_recipe, driver_recipe
from unjam.drivers.wrappers import RoadTypeSwitch
from unjam.scenarios import make_scenario
from unjam.worlds.episode import run_episode

ROAD_TYPES = tuple(field.name for field in fields(RoadTypeSwitch))
EACH = RoadTypeSwitch(*(Constant(acceleration=0.1 * number) for number in range(len(ROAD_TYPES))))


def near(**more: object) -> LocalState:
    return state_of_ones(COMMON_FIELDS, np.ones, rows=3)._replace(**more)


@pytest.mark.parametrize(
    ("state", "kind"),
    [
        (near(lane_speeds=np.ones((3, 11))), "motorway"),
        (near(distance_to_crossing=np.ones(3)), "crossing_loop"),
        (near(), "loop"),
        (near(loop_length=np.full(3, np.nan)), "open_road"),
        (near().map(lambda values: float(values[0])), "loop"),
        (near(penetration_rate=np.full(3, 0.05)), "loop"),
        (near(penetration_rate=np.full(3, 0.06)), "shared_loop"),
        (near(penetration_rate=np.full(3, 0.2)).map(lambda values: float(values[0])), "shared_loop"),
        (near(penetration_rate=np.full(3, 0.2), distance_to_crossing=np.ones(3)), "crossing_loop"),
        (near().map(lambda values: values[:0])._replace(loop_length=np.full(0, np.nan)), "open_road"),
    ],
)
def test_what_a_car_can_know_of_the_road_chooses_its_law(state: LocalState, kind: str) -> None:
    rows = 1 if isinstance(state.speed, float) else len(state.speed)
    wanted, _ = EACH.act(state, EACH.initial_memory(rows))
    assert np.all(wanted == 0.1 * ROAD_TYPES.index(kind))


def test_only_the_law_that_drives_remembers() -> None:
    driver = RoadTypeSwitch(*(PISaturation() for _ in ROAD_TYPES))
    before = driver.initial_memory(3)
    _, after = driver.act(near(), before)
    assert after["crossing_loop"] is before["crossing_loop"]
    assert np.all(after["loop"]["count"] == 1.0)


def test_where_nobody_is_for_shared_roads_they_are_as_others() -> None:
    four = RoadTypeSwitch(*(Constant(acceleration=0.1 * number) for number in range(4)))
    wanted, _ = four.act(near(penetration_rate=np.full(3, 0.2)), four.initial_memory(3))
    assert np.all(wanted == 0.1 * ROAD_TYPES.index("loop"))
    assert driver_from_recipe(*driver_recipe(four)) == four


def test_it_is_made_again_from_its_recipe_and_from_its_file(tmp_path: Path) -> None:
    assert driver_from_recipe(*driver_recipe(EACH)) == EACH
    (tmp_path / "each.unjam").write_bytes(controller_bytes(EACH, {}))
    assert load_controller(tmp_path / "each.unjam") == EACH
    check_driver(EACH)


@pytest.mark.parametrize(
    ("road", "changes", "right"),
    [("ring", {}, "loop"), ("ring", {"cavs": 2}, "shared_loop"), ("figure-eight", {}, "crossing_loop")],
)
def test_closed_roads_are_told_apart_by_what_a_map_and_a_service_say(
    road: str, changes: dict[str, int], right: str
) -> None:
    held = {kind: Constant(acceleration=0.5 if kind == right else 0.0) for kind in ROAD_TYPES}
    episode = run_episode(make_scenario(road, {"horizon": 3, **changes}), RoadTypeSwitch(**held), 1)
    assert np.allclose(episode.trajectories[0].applied_acceleration, 0.5)
