import json
from pathlib import Path

import numpy as np
import pytest

from unjam.cli.options import scenario_changes
from unjam.drivers.network import Network
from unjam.errors import InputError
from unjam.physics.idm import PAPER_IDM, IDMParameters
from unjam.scenarios import make_scenario, scenario_from_recipe, scenario_recipe
from unjam.scenarios.motorway_road import MotorwayRoad
from unjam.scenarios.population import Population, read_population, write_population
from unjam.scenarios.road import BuiltRoad
from unjam.worlds.sumo.backend import sumo_inputs

DRIVERS = (IDMParameters(time_headway=0.8, desired_speed=35.0), IDMParameters(time_headway=1.6, minimum_gap=4.0))
NETWORK = Network(((np.ones((3, 2)), np.zeros(2)), (np.full((2, 1), 0.01), np.zeros(1))), 0.5)


def written(folder: Path, residual: Network | None = None) -> Path:
    path = folder / "drivers.json"
    details = ({"name": "a"}, {"name": "b"})
    about = {"data": ["x.csv"]}
    write_population(path, Population(PAPER_IDM, DRIVERS, (-4.0, 2.0), residual, details, about))
    return path


@pytest.mark.parametrize("residual", [None, NETWORK])
def test_a_written_population_is_read_unchanged(tmp_path: Path, residual: Network | None) -> None:
    found = read_population(written(tmp_path, residual))
    assert (found.typical, found.drivers, found.limits) == (PAPER_IDM, DRIVERS, (-4.0, 2.0))
    assert [detail["name"] for detail in found.details] == ["a", "b"]
    assert found.metadata == {"data": ["x.csv"]}
    assert (found.max_desired_speed, found.min_time_headway) == (35.0, 0.8)
    seen = np.array([[5.0, 1.0, 9.0]])
    assert (found.residual is None) == (residual is None)
    if found.residual is not None:
        np.testing.assert_allclose(found.residual(seen), NETWORK(seen))


def test_a_changed_population_is_read_again(tmp_path: Path) -> None:
    path = written(tmp_path)
    assert len(read_population(path).drivers) == 2
    write_population(path, Population(PAPER_IDM, DRIVERS[:1], (-4.0, 2.0)))
    assert len(read_population(path).drivers) == 1


def damaged(path: Path, **changes: object) -> Path:
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))
    return path


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format": 7}, "format 7 is unknown"),
        ({"drivers": []}, "no drivers"),
        ({"drivers": [{"time_headway": 1.0}]}, "no 'desired_speed'"),
        ({"typical": {"time_headway": -1.0}}, r"population.typical.time_headway: -1.0 is not allowed"),
        ({"limits": [1.0]}, "not a population"),
        ({"limits": ["-4", 2.0]}, "limits: '-4' is not allowed; allowed: a finite number"),
        ({"limits": [-4.0, True]}, "limits: True is not allowed"),
        ({"residual": {"file": "../drivers.json", "sha256": "0", "authority": 1.0}}, "does not have the hash in"),
        ({"residual": {"file": "gone.safetensors", "sha256": "0", "authority": 1.0}}, "not a population"),
    ],
)
def test_a_damaged_file_is_refused_in_one_line(tmp_path: Path, changes: dict, words: str) -> None:
    with pytest.raises(InputError, match=words) as error:
        read_population(damaged(written(tmp_path, NETWORK), **changes))
    assert "\n" not in str(error.value)


def test_damaged_weights_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path, NETWORK)
    weights = path.with_suffix(".safetensors")
    content = bytearray(weights.read_bytes())
    content[-1] ^= 1
    weights.write_bytes(content)
    with pytest.raises(InputError, match="damaged"):
        read_population(path)


def test_other_files_are_not_populations(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text("[1, 2")
    with pytest.raises(InputError, match="not a population"):
        read_population(tmp_path / "x.json")
    with pytest.raises(InputError, match="does not exist"):
        read_population(tmp_path / "y.json")


@pytest.mark.parametrize("name", ["ring", "figure-eight", "merge"])
def test_a_road_draws_its_human_drivers_from_a_population(tmp_path: Path, name: str) -> None:
    scenario = make_scenario(name, {"population": str(written(tmp_path))})
    assert scenario_from_recipe(scenario_recipe(scenario)) == scenario
    assert scenario.humans == PAPER_IDM
    assert scenario.top_speed == 35.0
    roads = [scenario.draw(np.random.default_rng(seed)) for seed in (0, 0, 1)]
    assert set(roads[0].human_parameters.values()) == set(DRIVERS)
    assert roads[0].human_parameters == roads[1].human_parameters != roads[2].human_parameters
    assert isinstance(roads[0], BuiltRoad)
    own_types = sumo_inputs(scenario, roads[0]).traffic_xml.count('<vType id="of_')
    assert own_types == (22 if name == "ring" else 0)


@pytest.mark.parametrize(("name", "drivers"), [("unjam:ngsim", 100), ("unjam:astazero", 8)])
def test_recorded_human_drivers_are_part_of_the_package(name: str, drivers: int) -> None:
    found = read_population(name)
    assert len(found.drivers) == drivers
    assert {found.typical, *found.drivers} != {found.typical}
    assert scenario_changes(humans=name) == {"population": name}
    assert f"{drivers} calibrated drivers of {name}" in make_scenario("ring", {"population": name}).human_description


def test_an_unknown_packaged_population_is_refused_with_the_known_ones() -> None:
    with pytest.raises(InputError, match=r"'unjam:nobody' is not allowed; allowed: unjam:astazero, unjam:ngsim"):
        read_population("unjam:nobody")


def test_on_a_motorway_only_car_following_is_calibrated(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="population: a residual network is not allowed on a motorway"):
        make_scenario("on-ramp", {"population": str(written(tmp_path, NETWORK))})
    road = make_scenario("on-ramp", {"population": str(written(tmp_path))}).draw(np.random.default_rng(0))
    assert isinstance(road, MotorwayRoad)
    kinds = road.vehicle_types
    follows = {(one.time_headway, one.max_acceleration, one.comfortable_deceleration) for one in DRIVERS}
    assert {(kind.time_headway, kind.acceleration, kind.deceleration) for kind in kinds.values()} == follows
    assert {kind.model for kind in kinds.values()} == {"IDM"}
    assert all(0.8 <= kind.speed_factor <= 1.2 for kind in kinds.values())


def test_without_a_population_roads_are_unchanged() -> None:
    scenario = make_scenario("ring")
    road = scenario.draw(np.random.default_rng(0))
    assert road.human_parameters == {}
    assert isinstance(road, BuiltRoad)
    assert "insertionChecks" not in sumo_inputs(scenario, road).traffic_xml


def test_a_residual_is_commanded(tmp_path: Path) -> None:
    assert make_scenario("ring", {"population": str(written(tmp_path, NETWORK))}).human_control == "commanded"
    assert make_scenario("ring", {"population": str(written(tmp_path))}).human_control == "native"
