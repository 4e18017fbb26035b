"""Human-only traffic on a user's network is that of plain SUMO; CAVs and SUMO's rules end episodes."""

import subprocess
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from tests.worlds.sumo.user_networks import STANDING, TELEPORTS, crossing, straight, two_way
from unjam.drivers import Constant, Human
from unjam.errors import EpisodeError
from unjam.scenarios import make_scenario
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.networks import sumo_program
from unjam.worlds.sumo.simulation import Simulation

WARN = '<collision.action value="warn"/>'
NONE = '<collision.action value="none"/>'


def human(file: Path, simulation: Simulation, share: float = 0.5) -> Episode:
    return run_episode(
        make_scenario(str(file), {"penetration_rate": share}), Human(), (0,), backend=SumoBackend(simulation)
    )


def trips_of_plain_sumo(file: Path) -> tuple[int, int, float]:
    """How many vehicles enter and arrive in plain SUMO with the seed of episode 0, and their seconds."""
    _, seeds = make_scenario(str(file), {"penetration_rate": 0.5}).draw_from_seed((0,))
    seed = int(seeds[2].generate_state(1)[0]) % 2**31
    command = [sumo_program("sumo"), "-c", file.name, "--seed", str(seed), "--tripinfo-output", "trips.xml"]
    command += ["--tripinfo-output.write-unfinished", "true", "--no-warnings"]
    subprocess.run(command, check=True, capture_output=True, cwd=file.parent)
    trips = list(ElementTree.parse(file.parent / "trips.xml").getroot())
    arrived = sum(float(trip.get("arrival", "-1")) >= 0 for trip in trips)
    return len(trips), arrived, sum(float(trip.get("duration", "nan")) for trip in trips)


def trips_of(episode: Episode) -> tuple[int, int, float]:
    """The same of an episode."""
    seconds = float((~np.isnan(episode.speeds)).sum() * episode.control_step)
    return len(episode.vehicle_ids), episode.arrivals, seconds


def standing(folder: Path, configuration: str = "") -> Path:
    """Cars that are teleported from behind a van that stops."""
    return straight(folder, STANDING, end=120.0, step=0.5, options=TELEPORTS + configuration)


@pytest.mark.parametrize(
    ("network", "settings"),
    [(standing, ""), pytest.param(crossing, "", marks=pytest.mark.long), (two_way, ""), (two_way, WARN)],
)
def test_human_only_traffic_is_that_of_plain_sumo_whatever_the_penetration_rate(
    network: Callable[[Path, str], Path], settings: str, tmp_path: Path, simulation: Simulation
) -> None:
    file = network(tmp_path, settings)
    few, every = human(file, simulation, 0.01), human(file, simulation, 1.0)
    assert few.status == every.status == "completed"
    assert trips_of(few) == trips_of(every) == trips_of_plain_sumo(file)
    assert few.vehicle_ids == every.vehicle_ids
    assert np.array_equal(np.sort(few.speeds), np.sort(every.speeds)[:, : few.speeds.shape[1]], equal_nan=True)
    assert few.collisions == every.collisions
    assert (few.collisions > 0) == (network is two_way)


@pytest.mark.long
def test_junctions_are_checked_if_configured(tmp_path: Path, simulation: Simulation) -> None:
    episode = human(crossing(tmp_path, WARN + '<collision.check-junctions value="true"/>'), simulation)
    assert episode.status == "completed"
    assert episode.collisions > 0


def test_vehicles_that_are_removed_after_a_collision_have_not_arrived(tmp_path: Path, simulation: Simulation) -> None:
    episode = human(two_way(tmp_path, '<collision.action value="remove"/>'), simulation)
    still_there = int((~np.isnan(episode.speeds[-1])).sum())
    assert episode.teleports == episode.collisions > 0
    assert episode.arrivals == len(episode.vehicle_ids) - still_there - episode.teleports


@pytest.mark.parametrize("settings", ["", *(pytest.param(each, marks=pytest.mark.long) for each in (WARN, NONE))])
def test_a_collision_of_a_cav_ends_the_episode_even_if_sumo_counts_none(
    settings: str, tmp_path: Path, sumo: SumoBackend
) -> None:
    vehicles = (
        '<vehicle id="van" type="van" route="along" depart="0" departPos="400" departSpeed="0">'
        '<stop lane="road_0" endPos="400" duration="300"/></vehicle>'
        '<vehicle id="ego" type="car" route="along" depart="0" departPos="100" departSpeed="20"/>'
    )
    file = straight(tmp_path, vehicles, options=settings)
    changes = {"cav_types": ["car"], "actuation": "raw", "safety.active": False}
    episode = run_episode(make_scenario(str(file), changes), Constant(0.5), (0,), backend=sumo)
    assert episode.status == "collision"
    assert episode.collisions == 2
    assert episode.control_steps < 300
    human = run_episode(make_scenario(str(file), changes), Human(), (0,), backend=sumo)
    assert (human.status, human.collisions) == ("completed", 0)


@pytest.mark.parametrize("most", [0, 1, 100])
def test_an_episode_ends_beyond_the_configured_number_of_teleports(
    most: int, tmp_path: Path, simulation: Simulation
) -> None:
    file = standing(tmp_path, f'<max-num-teleports value="{most}"/>')
    episode = human(file, simulation)
    if most == 100:
        assert (episode.status, episode.reason) == ("completed", "")
        return
    assert episode.teleports == most + 1
    assert (episode.status, episode.reason) == ("teleports", f"more than {most} teleports (max-num-teleports)")
    assert episode.control_steps < 240
    with pytest.raises(EpisodeError, match=f"more than {most} teleports .* of the all-human warm-up"):
        run_episode(
            make_scenario(str(file), {"penetration_rate": 0.5, "warmup": 200, "horizon": 10}),
            *(Human(), (0,)),
            backend=SumoBackend(simulation),
        )
