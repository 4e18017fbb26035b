"""Personal cars and vehicles of calibrators are demand, and can become CAVs."""

import json
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.networks import count_teleports
from tests.worlds.sumo.user_networks import STANDING, TELEPORTS, built, network, straight
from unjam import sumo_files
from unjam.drivers import IDM, Human
from unjam.errors import InputError, SumoInputError
from unjam.scenarios import make_scenario
from unjam.sumo_files import read_sumo_files
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.networks import sumo_program
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

PERSONS = '<personFlow id="p" begin="0" end="40" period="10"><personTrip from="ab" to="bc" {how}/></personFlow>'
CALIBRATOR = (
    '<calibrator id="c" edge="road" pos="0"><route id="all" edges="road"/>'
    '<flow begin="100" end="160" route="all" vehsPerHour="600" speed="15" type="slow"/></calibrator>'
)
"""that brings the first vehicle after 100 s"""
SPEEDS = '<calibrator id="c" edge="road" pos="0"><flow begin="0" end="60" speed="9"/></calibrator>'


def two_edges(folder: Path, demand: str) -> Path:
    """Write a road of two edges with a demand, and return its configuration."""
    nodes = "".join(f'<node id="{name}" x="{x}" y="0"/>' for name, x in (("a", 0), ("b", 300), ("c", 600)))
    edges = "".join(f'<edge id="{n}" from="{n[0]}" to="{n[1]}" numLanes="1" speed="15"/>' for n in ("ab", "bc"))
    return built(folder, nodes, edges, demand, '<end value="120"/><step-length value="0.5"/>')


@pytest.mark.parametrize(
    ("how", "kind"), [('modes="car"', "DEFAULT_VEHTYPE"), ('vTypes="own"', "own"), ('modes="car" vTypes="own"', "own")]
)
def test_personal_cars_are_demand_and_become_cavs(how: str, kind: str, tmp_path: Path, sumo: SumoBackend) -> None:
    file = two_edges(tmp_path, '<vType id="own" speedDev="0"/>' + PERSONS.format(how=how))
    assert read_sumo_files(file).used_types == {kind}
    scenario = make_scenario(str(file), {"penetration_rate": 1.0})
    episode = run_episode(scenario, IDM(), (1,), backend=sumo)
    assert len(episode.vehicle_ids) >= 3
    assert len(episode.cav_ids) >= 3


def test_persons_without_a_vehicle_are_not_demand(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="have no vehicle, trip, flow or personal car"):
        read_sumo_files(two_edges(tmp_path, PERSONS.format(how='modes="public"')))


@pytest.mark.long
def test_an_episode_waits_for_vehicles_of_calibrators_as_sumo_does(tmp_path: Path, sumo: SumoBackend) -> None:
    file = straight(tmp_path, "", end=300.0, step=0.5, options='<additional-files value="more.add.xml"/>')
    (tmp_path / "more.add.xml").write_text(f'<additional><vType id="slow" speedDev="0"/>{CALIBRATOR}</additional>')
    scenario = make_scenario(str(file), {"penetration_rate": 1.0})
    human = run_episode(scenario, Human(), (1,), backend=sumo)
    command = [sumo_program("sumo"), "-c", str(file), "--tripinfo-output", str(tmp_path / "trips.xml")]
    subprocess.run([*command, "--tripinfo-output.write-unfinished"], check=True, capture_output=True)
    alone = ElementTree.parse(tmp_path / "trips.xml").getroot().findall("tripinfo")
    assert 5 < len(human.vehicle_ids) == len(alone)
    assert human.control_steps * human.control_step < 300.0, "it ends once all have arrived and none can follow"
    assert len(run_episode(scenario, IDM(), (1,), backend=sumo).cav_ids) > 5


def test_a_calibrator_of_speeds_adds_no_vehicles(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="have no vehicle"):
        read_sumo_files(Path(network(tmp_path, "", SPEEDS)))


BROKEN = (
    '<flow id="f" type="car" from="road" to="road" begin="0" end="690" period="9"/>'
    '<trip id="w" type="car" from="road" to="road" depart="690"/>'
    '<trip id="v" type="car" from="road" to="road" depart="700" departPos="nowhere"/>'
)


@pytest.mark.long
def test_only_an_error_of_the_first_task_ends_a_run(tmp_path: Path) -> None:
    for name, demand in (("good", BROKEN.partition("<trip")[0]), ("bad", BROKEN)):
        (tmp_path / name).mkdir()
        straight(tmp_path / name, demand, end=1000.0, step=1.0)
    good, bad = (
        EpisodeTask(make_scenario(str(tmp_path / name / "straight.sumocfg"), {"penetration_rate": 0.5}), Human(), (0,))
        for name in ("good", "bad")
    )
    with WorkerPool(1) as workers:
        assert [each.status for each in workers.run([good, bad])] == ["completed", "failed"]
        assert [each.status for each in workers.run([bad])] == ["failed"]
    with WorkerPool(1) as workers, pytest.raises(SumoInputError, match="SUMO cannot go on: Invalid departPos"):
        workers.run([bad, good])


def test_workers_get_the_content_of_the_files(tmp_path: Path) -> None:
    file = straight(tmp_path, '<flow id="f" type="car" route="along" begin="0" end="50" period="9"/>')
    task = EpisodeTask(make_scenario(str(file), {"penetration_rate": 0.5}), Human(), (0,))
    answer = json.loads(json.dumps(sumo_files.stored_answer(str(file))))
    assert sumo_files.store_answer(str(file), answer) == read_sumo_files(file)
    answer["end"] = 30.0  # what no file says shows that the worker has not read them
    sumo_files.store_answer(str(file), answer)
    with WorkerPool(1) as workers:
        first, second = workers.run([task, task])
    assert first.status == second.status == "completed"


def test_teleports_of_plain_sumo_are_those_of_its_statistics(tmp_path: Path) -> None:
    file = straight(tmp_path, STANDING, end=200.0, options=TELEPORTS)
    written = tmp_path / "statistics.xml"
    command = [sumo_program("sumo"), "-c", str(file), "--statistic-output", str(written)]
    subprocess.run(command, check=True, capture_output=True)
    assert count_teleports(written) > 0
