"""Example networks are whole, can be driven, and can be made again after an edit."""

import shlex
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.worlds.sumo.user_networks import grid
from unjam.controller import make_driver
from unjam.errors import InputError
from unjam.measures.metrics import measure
from unjam.scenarios import make_scenario
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.example_roads import EXAMPLE_ROADS, write_example_road
from unjam.worlds.sumo.networks import network_geometry, sumo_program


@pytest.mark.parametrize("name", EXAMPLE_ROADS)
def test_a_road_can_be_driven(name: str, tmp_path: Path) -> None:
    configuration = write_example_road(name, tmp_path)
    scenario = make_scenario(str(configuration), {"penetration_rate": 0.2, "horizon": 120})
    episode = run_episode(scenario, make_driver("human", scenario.control_step), 1)
    assert (episode.status, episode.warnings) == ("completed", ())
    assert len(episode.vehicle_ids) > 30
    assert episode.slow_entrances == ()


@pytest.mark.long
@pytest.mark.parametrize("name", EXAMPLE_ROADS)
def test_a_whole_episode_of_a_road_has_its_metrics(name: str, tmp_path: Path) -> None:
    scenario = make_scenario(str(write_example_road(name, tmp_path)), {"penetration_rate": 0.1})
    row = measure(run_episode(scenario, make_driver("human", scenario.control_step), 1, record_details=True))
    assert row["status"] == "completed"
    assert min(row["travel_time"], row["fuel_by_power"], row["outflow_veh_per_h"]) > 0.0


def test_ramps_of_user_networks_are_marked_where_they_join(tmp_path: Path) -> None:
    configuration = write_example_road("on-ramp", tmp_path)
    scenario = make_scenario(str(configuration), {"penetration_rate": 0.2, "horizon": 300})
    episode = run_episode(scenario, make_driver("human", scenario.control_step), 1, record_details=True)
    lengths = network_geometry(tmp_path / "on-ramp.net.xml").edge_lengths
    assert episode.merge_positions == (lengths["upstream"],)


def test_crossings_with_signals_are_no_ramps(tmp_path: Path) -> None:
    scenario = make_scenario(str(grid(tmp_path)), {"penetration_rate": 0.2})
    episode = run_episode(scenario, make_driver("human", scenario.control_step), 1, record_details=True)
    assert np.isfinite(episode.positions).any()
    assert episode.merge_positions == ()


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
