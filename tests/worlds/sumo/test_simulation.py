from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from tests.worlds.sumo.user_networks import straight
from tests.worlds.test_record import fingerprint
from unjam.drivers import IDM, PISaturation
from unjam.errors import EpisodeError, InputError, UnjamError
from unjam.scenarios import Ring, make_scenario
from unjam.scenarios.road import Connection
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend, make_traffic, sumo_inputs
from unjam.worlds.sumo.inputs import SumoInputs
from unjam.worlds.sumo.networks import network_file
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.transports import Transport

RING = Ring(horizon=100, length=(230, 230))


@pytest.fixture
def road(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SumoInputs:
    monkeypatch.setenv("UNJAM_CACHE", str(tmp_path))
    return sumo_inputs(RING, RING.draw(np.random.default_rng(0)))


def test_a_second_simulation_in_one_process_is_refused(simulation: Simulation) -> None:
    with pytest.raises(UnjamError, match="already open in this process"):
        Simulation()
    assert run_episode(RING, IDM(), (0,), backend=SumoBackend(simulation)).status == "completed"


def test_a_refused_simulation_does_not_release_libsumo(simulation: Simulation) -> None:
    for _ in range(2):
        with pytest.raises(UnjamError):
            Simulation()


def test_simulations_over_traci_do_not_disturb_it(simulation: Simulation) -> None:
    expected = run_episode(RING, IDM(), (0,), backend=SumoBackend(simulation))
    with Simulation("traci") as first, Simulation("traci") as second:
        traffics = [make_traffic(RING, (0,), each) for each in (simulation, first, second)]
        for traffic in traffics:
            traffic.start(is_controlled=False)
        for _ in range(50):
            for traffic in traffics:
                traffic.advance(None)
    assert traffics[0].speeds == traffics[1].speeds == traffics[2].speeds
    again = run_episode(RING, IDM(), (0,), backend=SumoBackend(simulation))
    np.testing.assert_array_equal(again.speeds, expected.speeds)


def test_closing_twice_releases_libsumo(road: SumoInputs) -> None:
    first = Simulation()
    first.load(road, 0.1, 0)
    first.close()
    first.close()
    with Simulation() as second:
        first.close()
        second.load(road, 0.1, 0)
        assert second.vehicle_count() == 22
        with pytest.raises(UnjamError, match="already open"):
            Simulation()


def test_an_unused_simulation_can_be_closed() -> None:
    Simulation().close()
    Simulation().close()


def test_closing_removes_its_files(road: SumoInputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with Simulation() as simulation:
        simulation.load(road, 0.1, 0)
        assert list(tmp_path.glob("unjam-*/traffic.rou.xml"))
    assert not list(tmp_path.glob("unjam-*"))


def test_an_error_inside_the_block_closes_it(road: SumoInputs) -> None:
    def fail() -> None:
        with Simulation() as simulation:
            simulation.load(road, 0.1, 0)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    Simulation().close()


def test_loading_inserts_every_vehicle_at_rest(road: SumoInputs, simulation: Simulation) -> None:
    simulation.load(road, 0.1, 0)
    assert simulation.vehicle_count() == 22
    ids = RING.draw(np.random.default_rng(0)).vehicle_ids
    assert simulation.speeds(ids) == [0.0] * 22
    assert simulation.distances(ids) == [0.0] * 22
    assert not simulation.colliding_vehicles()


BROKEN_TRAFFIC = {
    '<routes><vehicle id="a" depart="0" route="nowhere"/></routes>': "The route 'nowhere' for vehicle 'a'",
    '<routes><vehicle id="a" route="nowhere"/></routes>': "Attribute 'depart' is missing",
    '<routes><vType id="x" carFollowModel="Magic"/></routes>': "Unknown car following model 'Magic'",
    '<routes><route id="r" edges="elsewhere"/></routes>': "The edge 'elsewhere' within the route 'r'",
    "<routes": "unexpected end of input",
}


@pytest.mark.long
@pytest.mark.parametrize("loaded_before", [False, True])
@pytest.mark.parametrize(("traffic", "words"), BROKEN_TRAFFIC.items())
def test_sumos_message_about_broken_traffic_is_reported_in_one_line(
    loaded_before: bool, traffic: str, words: str, road: SumoInputs, simulation: Simulation
) -> None:
    if loaded_before:
        simulation.load(road, 0.1, 0)
    with pytest.raises(EpisodeError) as caught:
        simulation.load(road._replace(traffic_xml=traffic), 0.1, 0)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_sumos_message_is_reported_over_traci_too(road: SumoInputs) -> None:
    for traffic, words in list(BROKEN_TRAFFIC.items())[:2]:
        with Simulation("traci") as simulation, pytest.raises(EpisodeError) as caught:
            simulation.load(road._replace(traffic_xml=traffic), 0.1, 0)
        assert words in str(caught.value)


BROKEN_ROADS = {
    ("nodes", ()): "No nodes loaded",
    ("edges", ()): "No edges loaded",
    ("connections", (Connection("edge_0", "elsewhere"),)): "elsewhere",
}


@pytest.mark.parametrize(("change", "words"), BROKEN_ROADS.items())
def test_netconverts_message_about_a_broken_road_is_reported_in_one_line(
    change: tuple[str, Any], words: str, road: SumoInputs
) -> None:
    with pytest.raises(EpisodeError) as caught:
        network_file(replace(RING.draw(np.random.default_rng(0)).network, **dict([change])))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_error_has_its_own_reason_and_not_an_earlier_one(road: SumoInputs, simulation: Simulation) -> None:
    for traffic, words in BROKEN_TRAFFIC.items():
        with pytest.raises(EpisodeError) as caught:
            simulation.load(road._replace(traffic_xml=traffic), 0.1, 0)
        others = [other for other in BROKEN_TRAFFIC.values() if other != words]
        assert not any(other in str(caught.value) for other in others)


@pytest.mark.parametrize("backend", ["libsumo", pytest.param("traci", marks=pytest.mark.slow)])
def test_after_a_refused_road_the_next_one_runs_as_in_a_new_simulation(backend: Transport, road: SumoInputs) -> None:
    expected = run_episode(RING, IDM(), (0,))
    first, second, *_ = BROKEN_TRAFFIC
    with Simulation(backend) as simulation:
        with pytest.raises(EpisodeError):
            simulation.load(road._replace(traffic_xml=first), 0.1, 0)
        simulation.load(road, 0.1, 0)
        with pytest.raises(EpisodeError):
            simulation.load(road._replace(traffic_xml=second), 0.1, 0)
        assert fingerprint(run_episode(RING, IDM(), (0,), backend=SumoBackend(simulation))) == fingerprint(expected)


def test_an_unknown_emission_class_is_reported_with_sumos_message(sumo: SumoBackend) -> None:
    with pytest.raises(EpisodeError, match="emissionClass with name 'coal' doesn't exist"):
        run_episode(replace(RING, emission_class="coal"), IDM(), (0,), backend=sumo)


def test_libsumo_and_traci_give_identical_episodes() -> None:
    found = []
    for backend in ("libsumo", "traci"):
        with Simulation(backend) as simulation:
            episode = run_episode(RING, PISaturation(), (5,), record_details=True, backend=SumoBackend(simulation))
        found.append(fingerprint(episode))
    assert found[0] == found[1]


FLOW = '<flow id="f" route="along" end="9" number="3"/>'


def write_broken_network(folder: Path, network: str, vehicles: str) -> Path:
    """A road with a complete network, or without any edge."""
    path = straight(folder, vehicles)
    if network == "hollow":
        (folder / "road.net.xml").write_text('<net version="1.20"></net>')
    return path


@pytest.mark.parametrize(
    ("network", "vehicles", "words"),
    [
        ("hollow", FLOW, "SUMO cannot start"),
        ("whole", '<vehicle id="v" type="ghost" route="along" depart="0"/>', "ghost"),
        ("whole", '<vehicle id="v" route="nowhere" depart="0"/>', "nowhere"),
        ("whole", '<vehicle id="v" depart="0"><route edges="moon"/></vehicle>', "moon"),
    ],
)
def test_sumos_refusal_of_a_users_network_is_reported_in_one_line_and_the_next_episode_runs(
    network: str, vehicles: str, words: str, tmp_path: Path, sumo: SumoBackend
) -> None:
    scenario = make_scenario(str(write_broken_network(tmp_path, network, vehicles)), {"penetration_rate": 1.0})
    with pytest.raises(EpisodeError, match=words) as caught:
        run_episode(scenario, IDM(), (0,), backend=sumo)
    assert caught.value.exit_code == 2
    assert "\n" not in str(caught.value)
    assert run_episode(RING, IDM(), (0,), backend=sumo).status == "completed"


def test_sumo_over_traci_does_not_accept_connections_from_other_machines(road: SumoInputs) -> None:
    """SUMO has no option to listen on loopback alone: it must stop to listen once its one client is there."""
    with Simulation("traci") as simulation:
        simulation.load(road, 0.1, 1)
        (sumo,) = [child for child in psutil.Process().children() if "sumo" in child.name()]
        connections = sumo.net_connections("tcp")
    assert [each.raddr.ip for each in connections] == ["127.0.0.1"]
    assert all(each.status != psutil.CONN_LISTEN for each in connections)


def test_a_temporary_folder_with_a_comma_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "a,b"))
    with pytest.raises(InputError, match=r"TMPDIR: .*a,b' is not allowed; allowed: a folder without ,"):
        Simulation()
    monkeypatch.undo()
    Simulation().close()
