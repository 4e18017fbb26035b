"""Scenarios in the user's Python and TOML files: built in any process, hashed, and refused with a reason."""

from pathlib import Path

import pytest

from unjam.drivers import Human
from unjam.errors import InputError
from unjam.scenarios import Motorway, make_scenario, scenario_from_recipe, scenario_recipe
from unjam.worlds.batch.support import statistically_unsupported_reason
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

CODE = """
from unjam.scenarios import Motorway, Ramp, Ring

class LongRing(Ring):
    title = "long ring"
    def draw(self, generator):
        return Ring(length=(300, 300), vehicles=self.vehicles).draw(generator)

class BrokenRing(Ring):
    def draw(self, generator):
        return 1 / 0

small = LongRing(vehicles=5, horizon=5)
wide = Motorway(lanes=3, ramps=(Ramp(position=900),))
number = 3
"""


@pytest.fixture
def roads(tmp_path: Path) -> Path:
    path = tmp_path / "roads.py"
    path.write_text(CODE)
    return path


def test_a_class_and_an_instance_of_a_file_are_driven_in_a_worker(roads: Path) -> None:
    scenarios = [make_scenario(f"{roads}:LongRing", {"vehicles": 5, "horizon": 5}), make_scenario(f"{roads}:small")]
    assert scenarios[0] == scenarios[1]
    with WorkerPool(1) as workers:
        episodes = workers.run([EpisodeTask(each, Human(), (1,)) for each in scenarios])
    assert [episode.loop_length for episode in episodes] == [300.0, 300.0]
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
        ("number", r"roads.py:number: is neither a class nor an instance of unjam.scenarios.Scenario"),
        ("Missing", r"roads.py: has no 'Missing'"),
    ],
)
def test_names_that_are_no_scenarios_are_refused(roads: Path, name: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_scenario(f"{roads}:{name}")


def test_an_error_in_the_code_of_a_scenario_is_reported_with_its_line(roads: Path) -> None:
    with pytest.raises(InputError, match=r"BrokenRing: ZeroDivisionError: division by zero \(line 11\)"):
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
