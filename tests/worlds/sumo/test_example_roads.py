"""Example networks are whole, can be driven, and can be made again after an edit."""

import shlex
import subprocess
from pathlib import Path

import pytest

from unjam.controller import make_driver
from unjam.errors import InputError
from unjam.scenarios import make_scenario
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.example_roads import EXAMPLE_ROADS, write_example_road
from unjam.worlds.sumo.networks import sumo_program


@pytest.mark.parametrize("name", EXAMPLE_ROADS)
def test_a_road_can_be_driven(name: str, tmp_path: Path) -> None:
    configuration = write_example_road(name, tmp_path)
    scenario = make_scenario(str(configuration), {"penetration_rate": 0.2, "horizon": 120})
    episode = run_episode(scenario, make_driver("human", scenario.control_step), 1)
    assert (episode.status, episode.warnings) == ("completed", ())
    assert len(episode.vehicle_ids) > 30


@pytest.mark.parametrize("name", EXAMPLE_ROADS)
def test_the_readme_makes_the_same_network(name: str, tmp_path: Path) -> None:
    write_example_road(name, tmp_path)
    network = tmp_path / f"{name}.net.xml"
    lanes = [line for line in network.read_text().splitlines() if "<lane " in line]
    network.unlink()
    (line,) = (line for line in (tmp_path / "README.md").read_text().splitlines() if "netconvert" in line)
    program, *arguments = shlex.split(line)
    subprocess.run([sumo_program(program), *arguments], cwd=tmp_path, check=True, capture_output=True)
    made = [line for line in network.read_text().splitlines() if "<lane " in line]
    assert [line.split('"')[1] for line in made] == [line.split('"')[1] for line in lanes]


def test_an_unknown_road_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="road: 'ring' is not allowed; allowed: on-ramp"):
        write_example_road("ring", tmp_path)
    assert not [*tmp_path.iterdir()]
