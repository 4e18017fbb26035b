"""Vehicles that SUMO lifts off a road where they stand for long, and puts back further on."""

import re
import subprocess
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import libsumo
import numpy as np
import pytest

import unjam
from tests.worlds.sumo.user_networks import built, grid, straight
from unjam.controller import make_driver
from unjam.drivers import Human
from unjam.drivers.car_following import Constant
from unjam.drivers.command import Command
from unjam.measures.metrics import measure
from unjam.scenarios import make_scenario
from unjam.scenarios.scenario import sumo_seed
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode
from unjam.worlds.sumo.backend import SumoBackend, make_traffic
from unjam.worlds.sumo.networks import sumo_program
from unjam.worlds.sumo.open_road import ActiveVehicles, OpenTraffic
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.world import DriverLog


@pytest.fixture(scope="module")
def blocked_network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A van stops at the end of an edge, and others fill the next one; vehicles are teleported after 5 s."""
    folder = tmp_path_factory.mktemp("blocked")
    places = {"a": 0, "b": 200, "c": 240, "d": 540}
    nodes = "".join(f'<node id="{name}" x="{x}" y="0"/>' for name, x in places.items())
    edges = "".join(
        f'<edge id="{begin}{end}" from="{begin}" to="{end}" numLanes="1" speed="15"/>'
        for begin, end in ("ab", "bc", "cd")
    )
    standing = "".join(
        f'<vehicle id="van_{place}" type="van" depart="0" departPos="{place}"><route edges="bc cd"/>'
        f'<stop lane="bc_0" endPos="{place + 1}" duration="60"/></vehicle>'
        for place in (37, 28, 19, 10)
    )
    (folder / "nodes.xml").write_text(f"<nodes>{nodes}</nodes>")
    (folder / "edges.xml").write_text(f"<edges>{edges}</edges>")
    (folder / "demand.rou.xml").write_text(
        '<routes><vType id="car" speedDev="0"/><vType id="van" speedDev="0" length="6"/>'
        f'<route id="along" edges="ab bc cd"/>{standing}'
        '<vehicle id="first" type="van" route="along" depart="0">'
        '<stop lane="ab_0" endPos="190" duration="60"/></vehicle>'
        '<flow id="f" type="car" route="along" begin="2" end="42" period="4"/></routes>'
    )
    command = [sumo_program("netconvert"), "-n", "nodes.xml", "-e", "edges.xml", "-o", "road.net.xml"]
    subprocess.run(command, check=True, capture_output=True, cwd=folder)
    path = folder / "blocked.sumocfg"
    path.write_text(
        '<configuration><net-file value="road.net.xml"/><route-files value="demand.rou.xml"/>'
        '<end value="200"/><step-length value="0.5"/><time-to-teleport value="5"/></configuration>'
    )
    return path


def drive_network(simulation: Simulation, file: Path, share: float) -> tuple[Episode, int]:
    """Drive CAVs with 0.3 m/s2 until all have left; the record, and how many SUMO had there in all steps."""
    scenario = make_scenario(str(file), {"penetration_rate": share, "horizon": 400})
    traffic = make_traffic(scenario, (0,), simulation)
    assert isinstance(traffic, OpenTraffic)
    traffic.start(is_controlled=True)
    count = 0
    while not traffic.is_finished:
        traffic.advance(Command(np.full(len(traffic.cav_ids), 0.3)))
        count += libsumo.vehicle.getIDCount()
    return traffic.record(DriverLog()), count


@pytest.mark.parametrize("share", [1e-9, 1.0])
def test_teleported_vehicles_count_in_the_backlog_until_they_arrive(
    share: float, blocked_network: Path, simulation: Simulation
) -> None:
    episode, count = drive_network(simulation, blocked_network, share)
    assert episode.teleports >= 4
    assert (~np.isnan(episode.speeds[1:])).sum() == count
    assert episode.arrivals == len(episode.vehicle_ids) == 15
    assert episode.backlog.max() >= 2, "vehicles that SUMO cannot reinsert wait"
    assert episode.backlog[-1] == 0
    assert measure(episode)["teleports"] == episode.teleports


def test_a_reinserted_cav_is_driven_again(blocked_network: Path, simulation: Simulation) -> None:
    episode, _ = drive_network(simulation, blocked_network, 1.0)
    stays = Counter(each.vehicle for each in episode.trajectories)
    again = [name for name, count in stays.items() if count > 1]
    assert again
    starts = [each.start_step for each in episode.trajectories]
    assert starts == sorted(starts), "in order of entry, as drivers' memories are"
    is_commanded = list[bool]()
    for name in again:
        first, *_, last = (each for each in episode.trajectories if each.vehicle == name)
        assert first.start_step + len(first.applied_acceleration) < last.start_step
        is_commanded += np.isclose(np.diff(last.states.speed), 0.15).tolist()
    assert sum(is_commanded) > 100, "with 0.3 m/s2 for half a second, without a leader"


@pytest.mark.parametrize("driver", ["human", "acc"])
def test_vehicles_that_sumo_removes_from_a_jam_have_not_arrived(
    driver: str, blocked_network: Path, tmp_path: Path, simulation: Simulation
) -> None:
    option = '<time-to-teleport value="5"/>'
    removing = blocked_network.with_name("removing.sumocfg")
    text = blocked_network.read_text().replace(option, f'{option}<time-to-teleport.remove value="true"/>')
    removing.write_text(text.replace("</configuration>", '<max-num-teleports value="100"/></configuration>'))
    scenario = make_scenario(str(removing), {"penetration_rate": 1e-9 if driver == "human" else 1.0})
    episode = run_episode(scenario, make_driver(driver, 0.5), 1, backend=SumoBackend(simulation))
    trips = tmp_path / "trips.xml"
    command = [sumo_program("sumo"), "-c", str(removing), "--tripinfo-output", str(trips)]
    subprocess.run([*command, "--tripinfo-output.write-unfinished"], check=True, capture_output=True)
    reasons = Counter(trip.get("vaporized", "") for trip in ElementTree.parse(trips).iter("tripinfo"))
    if driver == "human":
        assert episode.teleports == reasons["teleport"] > 3
    assert episode.teleports > 3
    assert episode.arrivals == episode.trips.has_arrived.sum() == len(episode.vehicle_ids) - episode.teleports
    whole, _ = drive_network(simulation, blocked_network, 1e-9)
    assert measure(episode)["outflow_veh_per_h"] < measure(whole)["outflow_veh_per_h"]
    removing.write_text(text.replace("</configuration>", '<max-num-teleports value="2"/></configuration>'))
    stopped = run_episode(scenario, make_driver(driver, 0.5), 1, backend=SumoBackend(simulation))
    assert (stopped.status, stopped.teleports) == ("teleports", 3)


def with_options(path: Path, **options: str) -> Path:
    """Set options of a configuration, and return it."""
    text = path.read_text()
    for name, value in options.items():
        text = re.sub(rf'<{name} value="[^"]*"/>', "", text)
        text = text.replace("</configuration>", f'<{name} value="{value}"/></configuration>')
    path.write_text(text)
    return path


@pytest.mark.parametrize(("cause", "driver"), [("calibrator", "human"), ("calibrator", "acc"), ("collision", "human")])
def test_vehicles_that_sumo_is_removing_have_no_speed(
    cause: str, driver: str, tmp_path: Path, simulation: Simulation
) -> None:
    if cause == "collision":
        path = with_options(grid(tmp_path), **{"collision.action": "remove", "collision.mingap-factor": "2"})
    else:
        edges = "".join(f'<edge id="{each}" from="{each[0]}" to="{each[1]}" speed="14"/>' for each in ("ab", "bc"))
        places = {"a": 0, "b": 500, "c": 1000}
        nodes = "".join(f'<node id="{name}" x="{x}" y="0"/>' for name, x in places.items())
        flow = '<flow id="f" route="along" begin="0" end="150" vehsPerHour="1200" departSpeed="max"/>'
        inputs = '<additional-files value="calibrator.add.xml"/><end value="200"/>'
        path = built(tmp_path, nodes, edges, f'<route id="along" edges="ab bc"/>{flow}', inputs)
        (tmp_path / "calibrator.add.xml").write_text(
            '<additional><route id="last" edges="bc"/><calibrator id="c" edge="bc" pos="0" freq="30">'
            '<flow begin="0" end="150" vehsPerHour="400" route="last"/></calibrator></additional>'
        )
    changes = {"penetration_rate": 1e-9 if driver == "human" else 0.3, "actuation": "cruise", "safety.active": False}
    scenario, removed = make_scenario(str(path), changes), list[str]()
    take_off_road = ActiveVehicles.take_off_road

    def record_removed(vehicles: ActiveVehicles, names: Sequence[str]) -> None:
        removed.extend(names)
        take_off_road(vehicles, names)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ActiveVehicles, "take_off_road", record_removed)
        episode = run_episode(scenario, make_driver(driver, scenario.control_step), 3, backend=SumoBackend(simulation))
    assert removed
    assert np.nanmin(episode.speeds) >= 0.0
    metrics = measure(episode)
    assert 0.0 < metrics["mean_speed"] < 20.0
    assert metrics["human_max_braking"] < 20.0
    assert episode.arrivals == episode.trips.has_arrived.sum()
    assert cause == "calibrator" or episode.teleports == episode.collisions > 10


def test_vehicles_that_sumo_teleports_to_the_end_of_their_route_have_arrived(
    tmp_path: Path, simulation: Simulation
) -> None:
    path = with_options(grid(tmp_path), **{"step-length": "2", "time-to-teleport": "10"})
    scenario = make_scenario(str(path), {"penetration_rate": 1e-9})
    episode = run_episode(scenario, Human(), 3, backend=SumoBackend(simulation))
    trips, (_, *words) = tmp_path / "trips.xml", scenario.plain_sumo_command(sumo_seed((3,))).split()
    command = [sumo_program("sumo"), *(str(trips) if word == trips.name else word for word in words)]
    subprocess.run(command, check=True, capture_output=True)
    plain = [each.attrib for each in ElementTree.parse(trips).iter("tripinfo")]
    assert any(each["vaporized"] == "teleport" for each in plain)
    durations = dict(zip(episode.trips.vehicle_ids, episode.trips.duration.tolist(), strict=True))
    assert durations == {each["id"]: float(each["duration"]) for each in plain}
    assert episode.trips.has_arrived.sum() == sum(float(each["arrival"]) >= 0.0 for each in plain) == episode.arrivals


@pytest.mark.parametrize("removes", [False, True])
def test_jumps_from_stop_to_stop_are_neither_teleports_nor_arrivals(
    removes: bool, tmp_path: Path, simulation: Simulation
) -> None:
    stops = '<stop lane="road_0" endPos="100" duration="1" jump="1"/><stop lane="road_0" endPos="600" duration="1"/>'
    vehicles = "".join(
        f'<vehicle id="{number}" type="car" route="along" depart="{10 * number}">{stops}</vehicle>'
        for number in range(5)
    )
    options = f'<time-to-teleport value="50"/><time-to-teleport.remove value="{str(removes).lower()}"/>'
    path = straight(tmp_path, vehicles, end=300.0, step=0.5, options=options)
    scenario = make_scenario(str(path), {"penetration_rate": 0.5})
    episode = run_episode(scenario, Human(), 1, backend=SumoBackend(simulation))
    assert (episode.arrivals, episode.teleports, episode.removed) == (5, 0, 0)
    assert measure(episode)["travel_time"] < 60.0


def test_a_driver_that_lets_sumo_remove_all_vehicles_has_a_worse_travel_time_and_return(
    tmp_path: Path, simulation: Simulation
) -> None:
    flow = '<flow id="f" type="car" route="along" begin="0" number="8" period="4"/>'
    options = '<time-to-teleport value="5"/><time-to-teleport.remove value="true"/>'
    path = straight(tmp_path, flow, end=200.0, step=0.5, options=options)
    human, stop = (
        run_episode(
            make_scenario(str(path), {"penetration_rate": 1.0, "safety.active": False}),
            driver,
            1,
            backend=SumoBackend(simulation),
        )
        for driver in (Human(), Constant(-1.0))
    )
    assert human.arrivals == len(human.vehicle_ids) == 8
    assert stop.arrivals == 0
    assert stop.removed == stop.teleports >= 1
    found, expected = measure(stop), measure(human)
    assert found["travel_time"] > expected["travel_time"] + 50.0
    assert found["delay"] > expected["delay"] + 50.0
    assert found["return"] < expected["return"]
    assert found["mean_speed"] < expected["mean_speed"]
    assert stop.control_steps * 0.5 == pytest.approx(200.0, abs=1.0)


def test_teleports_are_reported(blocked_network: Path, tmp_path: Path) -> None:
    (note,) = unjam.drive(
        str(blocked_network),
        ["human"],
        scenario_options={"horizon": 400, "penetration_rate": 0.5},
        workers=1,
        out=tmp_path / "out",
    ).notes
    assert re.fullmatch(r"human: SUMO teleported or removed \d+ vehicles?, which had waited .*", note)
