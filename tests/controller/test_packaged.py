"""The controllers that are part of the package."""

import json
from functools import cache
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest

import unjam
from unjam.controller import PACKAGED_PREFIX, load_controller, make_driver, packaged_file, packaged_names
from unjam.controller.file import CERTIFICATE_PART, read_controller
from unjam.controller.verify import verify_controller_file
from unjam.drivers import ResidualDriver
from unjam.drivers.registry import driver_recipe
from unjam.drivers.wrappers import FilteredDriver, RoadTypeSwitch
from unjam.errors import InputError
from unjam.measures.effect import compute_effect
from unjam.measures.feasibility import FEASIBLE, overall_feasibility
from unjam.measures.metrics import measure
from unjam.measures.statistics import paired_difference
from unjam.scenarios import FigureEight, Ring
from unjam.training.presets import all_presets, preset_values
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.simulation import Simulation

IDEAL_BEST = ("ring-best-ideal", "ring-jammed-best-ideal", "figure-eight-best-ideal")
"""controllers that were trained for vehicles that obey at once"""
SINGLE_ROADS = ("ring-best", "ring-jammed-best", "figure-eight-best", *IDEAL_BEST)
"""controllers that are verified in make test-all alone, as each takes seconds"""
CERTIFIED = Path(__file__).parents[2] / "results/all-roads-controllers.zip"


@pytest.mark.long
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SINGLE_ROADS)) for name in packaged_names()]
)
def test_each_is_whole_and_says_what_it_was_trained_on(name: str) -> None:
    verify_controller_file(packaged_file(name))
    driver = make_driver(f"{PACKAGED_PREFIX}{name}", 0.1)
    driver = driver.driver if isinstance(driver, FilteredDriver) else driver
    assert isinstance(driver, ResidualDriver) == ("-best" in name)


def test_there_is_one_for_each_preset_that_is_known_to_reach_furthest() -> None:
    best = {f"{scenario}-best" for scenario in {*all_presets()["best"]["on"]} - {"merge"}}  # where nothing is drivable
    assert {name for name in packaged_names() if "-tuned" not in name} == {"best", *best, *IDEAL_BEST}


@pytest.mark.parametrize("name", ["nothing", "", "../ring-best", "ring-best.unjam"])
def test_another_name_lists_those_that_there_are(name: str) -> None:
    with pytest.raises(InputError, match="allowed: unjam:best, unjam:figure-eight-best, unjam:figure-eight-best-ideal"):
        make_driver(f"{PACKAGED_PREFIX}{name}", 0.1)


@pytest.mark.long
def test_the_rings_earns_more_than_its_expert_on_every_seed() -> None:
    found = unjam.drive("ring", ["unjam:ring-gap-tuned", "unjam:ring-best"], episodes=2, workers=1)
    gain = paired_difference(found.rows["unjam:ring-best"], found.rows["unjam:ring-gap-tuned"], "return")
    assert gain.smallest > 5
    assert {found.document()["drivers"][number]["feasibility"] for number in (0, 1)} == {FEASIBLE}


@pytest.mark.slow
def test_the_tuned_expert_earns_more_than_the_papers_on_ring_and_jammed_ring() -> None:
    for road in ("ring", "ring-jammed"):
        found = unjam.drive(road, ["pi", "unjam:ring-jammed-tuned"], episodes=2, workers=1)
        gain = paired_difference(found.rows["unjam:ring-jammed-tuned"], found.rows["pi"], "return")
        assert gain.smallest > 50


@pytest.mark.slow
def test_the_jammed_rings_earns_more_than_its_expert_and_ends_the_wave_sooner_than_pi() -> None:
    expert, trained = "unjam:ring-jammed-tuned", "unjam:ring-jammed-best"
    found = unjam.drive("ring-jammed", ["pi", expert, trained], episodes=2, workers=1)
    assert paired_difference(found.rows[trained], found.rows[expert], "return").smallest > 5
    assert paired_difference(found.rows["pi"], found.rows[trained], "time_to_dissolve").smallest > 5


@pytest.mark.slow
def test_the_on_ramps_adds_to_its_expert_where_a_ramp_joins_and_drives_nowhere_else() -> None:
    expert, trained = "unjam:on-ramp-tuned", "unjam:on-ramp-best"
    road = {"peak": [0, 300], "horizon": 400, "penetration_rate": 0.05}
    found = unjam.drive("on-ramp", ["human", expert, trained], episodes=2, scenario_options=road, workers=2)
    of_expert, of_trained = (compute_effect(found.rows[name], found.rows["human"]) for name in (expert, trained))
    assert of_trained.travel_time != of_expert.travel_time
    assert of_trained.feasibility == FEASIBLE
    with pytest.raises(InputError, match="is not allowed on ring: it needs distance_to_merge"):
        run_episode(Ring(horizon=10), make_driver(trained, 0.1), 1)


@pytest.mark.slow
def test_the_figure_eights_is_faster_than_its_expert_over_the_radii() -> None:
    expert, trained = preset_values("best", "figure-eight")["expert"], "unjam:figure-eight-best"
    found = unjam.drive("figure-eight", [expert, trained], episodes=8, scenario_options={"radius": [32, 35]}, workers=2)
    assert paired_difference(found.rows[trained], found.rows[expert], "mean_speed").low > 0.0


RINGS = [
    Ring(vehicles=vehicles, cavs=cavs, length=(length, length), warmup=warmup, horizon=600)
    for vehicles, cavs, length, warmups in (
        (5, 1, 50, [1500]),
        (22, 1, 180, [0, 1500]),
        (22, 3, 240, [1500]),
        (22, 2, 330, [0]),
        (44, 3, 480, [0]),
    )
    for warmup in warmups
]
"""from a standstill, and out of a wave"""
EIGHTS = [FigureEight(radius=(radius, radius), vehicles=count, horizon=600) for radius, count in ((26, 9), (42, 14))]


@cache
def row_of(name: str, road: Ring | FigureEight, simulation: Simulation) -> dict[str, Any]:
    """Metrics of an episode; those of human-only traffic are shared by all controllers."""
    return measure(run_episode(road, make_driver(name, 0.1), (11,), backend=SumoBackend(simulation)))


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted({*packaged_names()} - {"on-ramp-best"}))  # it must know a ramp
def test_none_is_undrivable_on_roads_it_was_never_trained_on(name: str, simulation: Simulation) -> None:
    for road in [*RINGS, *EIGHTS]:
        driven, alone = (row_of(each, road, simulation) for each in (f"{PACKAGED_PREFIX}{name}", "human"))
        assert overall_feasibility([driven], [alone]) == FEASIBLE, road


@pytest.mark.parametrize("kind", ["loop", "shared_loop", "crossing_loop"])
def test_each_law_of_the_controller_for_all_closed_roads_is_certified(kind: str, tmp_path: Path) -> None:
    best = load_controller(packaged_file("best"))
    assert isinstance(best, RoadTypeSwitch)
    controller = read_controller(Path(ZipFile(CERTIFIED).extract(f"{kind.removesuffix('_loop')}.unjam", tmp_path)))
    assert isinstance(controller.driver, FilteredDriver)
    assert controller.driver.safety == Ring().safety, "the filter that every road has, too"
    (recipe, arrays), (other, others) = driver_recipe(best.inner_drivers[kind]), driver_recipe(controller.driver.driver)
    assert recipe == other
    assert arrays.keys() == others.keys()
    assert all(np.array_equal(array, others[name]) for name, array in arrays.items())
    found = json.loads(controller.parts[CERTIFICATE_PART])
    assert found["worst_cases"]["contacts"] == 0
    assert found["worst_cases"]["steps"] > 1_000_000
