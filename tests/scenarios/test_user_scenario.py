"""Scenarios in the user's Python and TOML files: built in any process, hashed, and refused with a reason."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from unjam.drivers import Human
from unjam.errors import InputError
from unjam.scenarios import SCENARIOS, Motorway, Ring, make_scenario, scenario_from_recipe, scenario_recipe
from unjam.scenarios.road import ClosedRoad, RoadNetwork
from unjam.scenarios.road_checks import check_repeated_road, check_road
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario
from unjam.worlds.batch.support import statistically_unsupported_reason
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

CODE = """
from unjam.scenarios import Motorway, Ramp, Ring

class LongRing(Ring):
    title = "long ring"
    def draw(self, generator):
        return Ring(length=(300, 300), vehicles=self.vehicles).draw(generator)

class ShortRing(Ring):
    length = 120
    vehicles = 11

class BrokenRing(Ring):
    def draw(self, generator):
        return 1 / 0

small = LongRing(vehicles=5, horizon=5)
wide = Motorway(lanes=3, ramps=(Ramp(position=900),))
number = 3

def make_small():
    return LongRing(vehicles=5, horizon=5)

def make_text():
    return "ring"

def fail(lanes):
    return wide
"""


@pytest.fixture
def roads(tmp_path: Path) -> Path:
    path = tmp_path / "roads.py"
    path.write_text(CODE)
    return path


def test_classes_instances_and_functions_of_a_file_are_driven_in_a_worker(roads: Path) -> None:
    scenarios = [make_scenario(f"{roads}:LongRing", {"vehicles": 5, "horizon": 5}), make_scenario(f"{roads}:small")]
    scenarios.append(make_scenario(f"{roads}:make_small"))
    assert scenarios[0] == scenarios[1] == scenarios[2]
    scenarios.append(make_scenario(f"{roads}:ShortRing", {"horizon": 5}))
    with WorkerPool(1) as workers:
        episodes = workers.run([EpisodeTask(scenario, Human(), (1,)) for scenario in scenarios])
    assert [episode.loop_length for episode in episodes] == [300.0, 300.0, 300.0, 120.0]
    assert statistically_unsupported_reason(scenarios[0])


def test_a_recipe_has_path_and_hash_and_builds_the_same_scenario(roads: Path) -> None:
    scenario = make_scenario(f"{roads}:LongRing", {"vehicles": 7})
    recipe = scenario_recipe(scenario)
    assert recipe["kind"] == "long ring"
    assert recipe["code"]["path"] == str(roads)
    assert scenario_from_recipe(recipe) == scenario
    roads.write_text(CODE + "# changed")
    with pytest.raises(InputError, match=r"roads.py:LongRing: its file has changed since"):
        scenario_from_recipe(recipe)


def test_an_instance_of_a_built_in_class_needs_no_file_in_a_worker(roads: Path) -> None:
    wide = make_scenario(f"{roads}:wide", {"ramps.0.inflow": 700})
    assert isinstance(wide, Motorway)
    assert (wide.lanes, wide.ramps[0].inflow) == (3, 700.0)
    assert "code" not in scenario_recipe(wide)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("number", r"roads.py:number: 3 is not allowed; allowed: a class or an instance of .*, or a function"),
        ("make_text", r"roads.py:make_text: 'ring' is not allowed; allowed: a class or an instance of "),
        ("fail", r"roads.py:fail: TypeError: .*'lanes'"),
        ("Missing", r"roads.py: has no 'Missing'"),
    ],
)
def test_names_that_are_no_scenarios_are_refused(roads: Path, name: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_scenario(f"{roads}:{name}")


def test_an_error_in_the_code_of_a_scenario_is_reported_with_its_line(roads: Path) -> None:
    with pytest.raises(InputError, match=r"BrokenRing: ZeroDivisionError: division by zero \(line 15\)"):
        make_scenario(f"{roads}:BrokenRing").draw_from_seed((0,))


def test_a_toml_file_describes_a_motorway(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("length = 2500\nlanes = 3\n[[ramps]]\nposition = 800\n[[ramps]]\nposition = 1800\ninflow = 100\n")
    scenario = make_scenario(str(path), {"ramps.1.inflow": 150})
    assert isinstance(scenario, Motorway)
    assert [ramp.position for ramp in scenario.ramps] == [800.0, 1800.0]
    assert scenario.ramps[1].inflow == 150.0
    path.write_text('kind = "ring"\nvehicles = 9\n')
    assert make_scenario(str(path)).title == "ring"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lanes = 9", "mine.toml.lanes: 9 is not allowed"),
        ("color = 1", "mine.toml.color: unknown name"),
        ("[[ramps]]\ninflow = 3", "mine.toml.ramps.0.position: missing"),
        ('kind = "user-network"', "kind: 'user-network' is not allowed; allowed: ring, figure-eight, merge, motorway"),
        ("lanes = ", "not TOML"),
    ],
)
def test_invalid_toml_is_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as refused:
        make_scenario(str(path))
    assert "\n" not in str(refused.value)


def changed_road(**fields: Any) -> Any:
    """Return a class whose road is that of a ring with other fields."""

    class Changed(Ring):
        def draw(self, generator: np.random.Generator) -> ClosedRoad:
            return replace(road := super().draw(generator), **{name: make(road) for name, make in fields.items()})

    return Changed


def with_edge(road: ClosedRoad, **fields: Any) -> RoadNetwork:
    first, *others = road.network.edges
    return replace(road.network, edges=(first._replace(**fields), *others))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"network": lambda road: with_edge(road, length=65.0)}, r"edges.edge_0.length: 65.0 m .*allowed: 55.0 m"),
        ({"network": lambda road: with_edge(road, length=np.nan)}, r"edges.edge_0.length: nan m .*allowed: > 0 m"),
        ({"network": lambda road: with_edge(road, to_node="nowhere")}, r"edges.edge_0.to_node: 'nowhere' .*node_0"),
        ({"loop_length": lambda road: 2 * road.loop_length}, r"loop_length: 440.0 m .*allowed: 220.0 m, the sum of"),
        ({"center_line": lambda road: 2 * road.center_line}, r"center_line: 440.0 m .*allowed: 220.0 m, the length"),
        ({"start_positions": lambda road: 0 * road.start_positions}, r"start_positions: 0.0 m of cav_0 .*without con"),
        ({"start_positions": lambda road: road.start_positions[::-1]}, r"start_positions: .* in their order"),
        ({"start_positions": lambda road: road.start_positions + 3.0}, r"entries.cav_0: 0.0 m .*allowed: 3.0 m, as in"),
        ({"cav_ids": lambda road: ("cav_9",)}, r"cav_ids: 'cav_9' .*allowed: cav_0, human_1"),
        ({"entries": lambda road: (road.entries[0]._replace(position=70.0),)}, r"entries.cav_0.position: 70 m .*55 m"),
        ({"routes": lambda road: (road.routes[0]._replace(edges=("edge_0", "edge_2")),)}, r"routes.from_edge_0.edges"),
    ],
)
def test_a_road_that_contradicts_itself_is_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=rf"^Changed: road\.{message}"):
        changed_road(**fields)(length=(220, 220)).draw_from_seed((0,))


def test_what_is_no_road_is_refused() -> None:
    nothing = type("Nothing", (Ring,), {"draw": lambda self, generator: None})()
    with pytest.raises(InputError, match=r"Nothing: draw\(\) returns NoneType; allowed: a Road"):
        nothing.draw_from_seed((0,))


@pytest.mark.parametrize("scenario", SCENARIOS.values(), ids=SCENARIOS)
def test_roads_of_the_package_do_not_contradict_themselves(scenario: Scenario) -> None:
    road, _ = scenario.draw_from_seed((3,))
    check_road(road, VEHICLE_LENGTH, "it")


UNREPEATABLE = """
import os
from unjam.scenarios import Ring

class FromSystem(Ring):
    def draw(self, generator):
        length = 230 + int.from_bytes(os.urandom(2), "big") % 50000
        return Ring(length=(length, length), vehicles=self.vehicles).draw(generator)

class FromCount(Ring):
    count = 0
    def draw(self, generator):
        FromCount.count += 1
        return Ring(vehicles=20 + FromCount.count % 2).draw(generator)
"""


@pytest.mark.parametrize("name", ["FromSystem", "FromCount"])
def test_a_road_that_differs_between_draws_of_one_seed_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "roads.py").write_text(UNREPEATABLE)
    scenario = make_scenario(f"{tmp_path / 'roads.py'}:{name}", {"horizon": 5})
    with pytest.raises(InputError, match=rf"{name}: draw\(\) returns another road for the same seed: road\.\S+ "):
        scenario.draw_from_seed((0,))


@pytest.mark.parametrize("name", SCENARIOS)
def test_all_built_in_roads_are_equal_in_two_draws(name: str) -> None:
    scenario = make_scenario(name)
    roads = [scenario.draw(np.random.default_rng(seed)) for seed in (0, 0, 1)]
    check_repeated_road(roads[0], roads[1], name)
    if name == "ring":
        with pytest.raises(InputError, match="ring: draw"):
            check_repeated_road(roads[0], roads[2], name)
