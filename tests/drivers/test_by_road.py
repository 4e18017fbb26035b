"""Does each road get the law that was made for it, from one file?"""

from pathlib import Path

import numpy as np
import pytest

from unjam.controller import load_controller
from unjam.controller.file import controller_bytes
from unjam.drivers import Constant, PISaturation
from unjam.drivers.by_road import KINDS_OF_ROAD, ByRoad
from unjam.drivers.check import check_driver
from unjam.drivers.local_state import EVERYWHERE, LocalState, like_ones
from unjam.drivers.registry import driver_from_recipe, recipe_of
from unjam.scenarios import make_scenario
from unjam.worlds.episode import run_episode

EACH = ByRoad(*(Constant(acceleration=0.1 * number) for number in range(len(KINDS_OF_ROAD))))


def near(**more: object) -> LocalState:
    return like_ones(EVERYWHERE, np.ones, rows=3)._replace(**more)


@pytest.mark.parametrize(
    ("state", "kind"),
    [
        (near(lane_speeds=np.ones((3, 11))), "motorway"),
        (near(to_crossing=np.ones(3)), "crossing"),
        (near(), "loop"),
        (near(loop_length=np.full(3, np.nan)), "elsewhere"),
        (near().each(lambda values: float(values[0])), "loop"),
        (near(cav_share=np.full(3, 0.05)), "loop"),
        (near(cav_share=np.full(3, 0.06)), "shared"),
        (near(cav_share=np.full(3, 0.2)).each(lambda values: float(values[0])), "shared"),
        (near(cav_share=np.full(3, 0.2), to_crossing=np.ones(3)), "crossing"),
        (near().each(lambda values: values[:0])._replace(loop_length=np.full(0, np.nan)), "elsewhere"),
    ],
)
def test_what_a_car_can_know_of_the_road_chooses_its_law(state: LocalState, kind: str) -> None:
    rows = 1 if isinstance(state.speed, float) else len(state.speed)
    wanted, _ = EACH.act(state, EACH.initial_memory(rows))
    assert np.all(wanted == 0.1 * KINDS_OF_ROAD.index(kind))


def test_only_the_law_that_drives_remembers() -> None:
    driver = ByRoad(*(PISaturation() for _ in KINDS_OF_ROAD))
    before = driver.initial_memory(3)
    _, after = driver.act(near(), before)
    assert after["crossing"] is before["crossing"]
    assert np.all(after["loop"]["seen"] == 1.0)


def test_where_nobody_is_for_shared_roads_they_are_as_others() -> None:
    four = ByRoad(*(Constant(acceleration=0.1 * number) for number in range(4)))
    wanted, _ = four.act(near(cav_share=np.full(3, 0.2)), four.initial_memory(3))
    assert np.all(wanted == 0.1 * KINDS_OF_ROAD.index("loop"))
    assert driver_from_recipe(*recipe_of(four)) == four


def test_it_is_made_again_from_its_recipe_and_from_its_file(tmp_path: Path) -> None:
    assert driver_from_recipe(*recipe_of(EACH)) == EACH
    (tmp_path / "each.unjam").write_bytes(controller_bytes(EACH, {}))
    assert load_controller(tmp_path / "each.unjam") == EACH
    check_driver(EACH)


@pytest.mark.parametrize(
    ("road", "changes", "right"),
    [("ring", {}, "loop"), ("ring", {"cavs": 2}, "shared"), ("figure-eight", {}, "crossing")],
)
def test_closed_roads_are_told_apart_by_what_a_map_and_a_service_say(
    road: str, changes: dict[str, int], right: str
) -> None:
    held = {kind: Constant(acceleration=0.5 if kind == right else 0.0) for kind in KINDS_OF_ROAD}
    episode = run_episode(make_scenario(road, {"horizon": 3, **changes}), ByRoad(**held), 1)
    assert np.allclose(episode.trajectories[0].applied, 0.5)
