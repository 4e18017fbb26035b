"""The human baseline on a network of the user's own is the traffic of plain SUMO, trip by trip."""

import os
import subprocess
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sumo
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from tests.worlds.sumo.user_networks import game, straight
from unjam.drivers import Human
from unjam.measures.metrics import measure
from unjam.scenarios import make_scenario
from unjam.scenarios.scenario import sumo_seed
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode, Trips
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.networks import sumo_program
from unjam.worlds.sumo.outputs import read_trips, trip_options
from unjam.worlds.sumo.simulation import Simulation

TYPES = """<vType id="car" sigma="0.6"/><vType id="truck" vClass="truck" accel="0.8" maxSpeed="22"/>
<vType id="bus" vClass="bus" personCapacity="40"/>
<vTypeDistribution id="mix" vTypes="car truck bus" probabilities="0.8 0.15 0.05"/>"""
CLASSES = defaultdict(lambda: "passenger", truck="truck", bus="bus")
END = 150


def random_network(folder: Path, seed: int, lanes: int, junctions: str, period: float, step: float) -> Path:
    """Return the configuration of a random network with random trips of cars, trucks and buses."""
    network, trips, path = folder / "net.net.xml", folder / "trips.rou.xml", folder / "random.sumocfg"
    generate = [sumo_program("netgenerate"), "--rand", "--rand.iterations", "12", "--seed", str(seed)]
    generate += ["--default.lanenumber", str(lanes), "--default-junction-type", junctions, "-o", str(network)]
    draw = [sys.executable, str(Path(sumo.SUMO_HOME) / "tools" / "randomTrips.py"), "-n", str(network)]
    draw += ["-o", str(trips), "-e", str(END), "-p", str(period), "--seed", str(seed)]
    draw += ["--trip-attributes", 'type="mix" departLane="best" departSpeed="max"']
    for command in (generate, draw):
        environment = {**os.environ, "SUMO_HOME": str(sumo.SUMO_HOME)}
        subprocess.run(command, check=True, capture_output=True, cwd=folder, env=environment)
    (folder / "types.add.xml").write_text(f"<additional>{TYPES}</additional>")
    path.write_text(
        f'<configuration><net-file value="{network.name}"/><additional-files value="types.add.xml"/>'
        f'<route-files value="{trips.name}"/><end value="{END}"/><step-length value="{step}"/>'
        "</configuration>"
    )
    return path


def trips_of_plain_sumo(path: Path, seed: int, end: float) -> Trips:
    """Return the trips of `sumo -c` itself."""
    out = path.with_name("plain.xml")
    command = [sumo_program("sumo"), "-c", str(path), "--seed", str(seed), "--end", str(end)]
    subprocess.run([*command, *trip_options(out)], check=True, capture_output=True, cwd=path.parent)
    return read_trips(out, CLASSES, 0.0)


def human_baseline(path: Path, simulation: Simulation, **changes: float) -> tuple[Episode, int]:
    """Return the human baseline, and the seed that SUMO had."""
    scenario = make_scenario(str(path), {"penetration_rate": 0.2, **changes})
    return run_episode(scenario, Human(), 5, backend=SumoBackend(simulation)), sumo_seed((5,))


def check_same_trips(found: Trips, plain: Trips) -> None:
    """Assert that two sets of trips are equal to the last digit, whatever their order."""
    assert sorted(found.vehicle_ids) == sorted(plain.vehicle_ids)
    of_plain = {name: number for number, name in enumerate(plain.vehicle_ids)}
    order = [of_plain[name] for name in found.vehicle_ids]
    for name in ("depart_delay", "duration", "time_loss", "has_arrived"):
        np.testing.assert_array_equal(getattr(found, name), getattr(plain, name)[order], name)


@pytest.mark.long
@settings(
    max_examples=6,
    deadline=None,
    phases=(Phase.explicit, Phase.reuse, Phase.generate),  # a smaller network is no clearer
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    seed=st.integers(0, 10**6),
    lanes=st.integers(1, 3),
    junctions=st.sampled_from(("priority", "traffic_light", "right_before_left")),
    period=st.floats(0.4, 3.0),
    step=st.sampled_from((0.1, 0.5, 1.0)),
)
def test_the_human_baseline_has_the_trips_of_plain_sumo(
    seed: int,
    lanes: int,
    junctions: str,
    period: float,
    step: float,
    tmp_path_factory: pytest.TempPathFactory,
    simulation: Simulation,
) -> None:
    path = random_network(tmp_path_factory.mktemp("random"), seed, lanes, junctions, round(period, 2), step)
    episode, sumo_seed = human_baseline(path, simulation)
    plain = trips_of_plain_sumo(path, sumo_seed, END)
    assert len(plain.vehicle_ids) > 20
    check_same_trips(episode.trips, plain)


def test_the_human_baseline_of_a_motorway_has_the_trips_of_plain_sumo(tmp_path: Path, simulation: Simulation) -> None:
    path = game(tmp_path, "ramp")
    episode, sumo_seed = human_baseline(path, simulation, end=60.0)
    check_same_trips(episode.trips, trips_of_plain_sumo(path, sumo_seed, 60.0))


def test_files_beside_a_link_are_those_that_plain_sumo_reads(tmp_path: Path, simulation: Simulation) -> None:
    roads = list[Path]()
    for count in (1, 9):
        (folder := tmp_path / str(count)).mkdir()
        flow = f'<flow id="f" type="car" route="along" begin="0" number="{count}" period="5"/>'
        roads.append(straight(folder, flow))
    one, many = roads
    one.unlink()
    one.symlink_to(many)
    episode, sumo_seed = human_baseline(one, simulation, end=100.0)
    assert episode.trips.vehicle_ids == ("f.0",)
    check_same_trips(episode.trips, trips_of_plain_sumo(one, sumo_seed, 100.0))


def test_flows_without_an_end_have_as_many_vehicles_as_in_plain_sumo(tmp_path: Path, simulation: Simulation) -> None:
    flow = '<flow id="f" type="car" route="along" begin="0" number="40" departSpeed="max"/>'
    path = straight(tmp_path, flow, end=120.0, step=0.5)
    command = [sumo_program("sumo"), "-c", str(path), *trip_options(tmp_path / "plain.xml")]
    subprocess.run(command, check=True, capture_output=True, cwd=tmp_path)
    plain = read_trips(tmp_path / "plain.xml", CLASSES, 0.0)
    for end, count in {120.0: 40, 60.0: 20, 240.0: 40}.items():
        episode, _ = human_baseline(path, simulation, end=end)
        assert len(episode.trips.vehicle_ids) == count
        scenario = make_scenario(str(path), {"penetration_rate": 0.2, "end": end})
        notes = [note for note in scenario.notes if "flows with a number of vehicles" in note]
        assert len(notes) == (end != 120.0)
        command = scenario.plain_sumo_command(1)
        assert (end == 60.0) == (command == ""), "plain SUMO would spread all 40 over 60 s"
        assert end != 240.0 or "until 240 s, the end of the episode" in notes[0]
    assert len(plain.vehicle_ids) == 40


@pytest.mark.parametrize(("step", "end"), [(0.3, 50.0), (0.7, 41.0), (0.4, 40.0)])
def test_the_last_step_is_that_of_plain_sumo(step: float, end: float, tmp_path: Path, simulation: Simulation) -> None:
    path = straight(tmp_path, '<flow id="f" type="car" route="along" period="3" end="40"/>', end=end, step=step)
    episode, sumo_seed = human_baseline(path, simulation)
    check_same_trips(episode.trips, trips_of_plain_sumo(path, sumo_seed, end))
    scenario = make_scenario(str(path), {"penetration_rate": 0.2})
    assert "--end" not in scenario.plain_sumo_command(1)
    longer = replace(scenario, steps_per_control_step=4, horizon=scenario.horizon // 4)
    assert "--end" in longer.plain_sumo_command(1)


def test_vehicles_that_wait_for_persons_who_never_come_wait_until_the_end(
    tmp_path: Path, simulation: Simulation
) -> None:
    waiting = '<vehicle id="waiting" type="car" route="along" depart="triggered"/>'
    flow = '<flow id="f" type="car" route="along" period="5" number="3"/>'
    path = straight(tmp_path, flow + waiting, end=300.0, step=0.5)
    episode, sumo_seed = human_baseline(path, simulation)
    assert episode.control_steps < 300
    plain = trips_of_plain_sumo(path, sumo_seed, 300.0)
    check_same_trips(episode.trips, plain)
    assert plain.depart_delay.max() == 300.0


STOP = '<stop lane="road_0" startPos="300" endPos="320" parking="true" {}/>'
STOPPED = '<vehicle id="stopped" type="car" route="along" depart="0">{}</vehicle>'
TAXI_TYPE = '<vType id="cab" vClass="taxi"><param key="has.taxi.device" value="true"/></vType>'
TAXI = f'{TAXI_TYPE}<vehicle id="taxi" type="cab" depart="0" departPos="200"><route edges="road"/></vehicle>'
VEHICLES_WITHOUT_EXPECTATION = {
    "idle taxi": TAXI,
    "taxi after its ride": f'{TAXI}<person id="p" depart="60" departPos="400"><ride from="road" to="road" '
    'arrivalPos="700" lines="taxi"/></person>',
    "no passenger": STOPPED.format(STOP.format('triggered="true"')),
    "no vehicle to join": STOPPED.format(STOP.format('triggered="join" join="other"')),
}


@pytest.mark.parametrize("name", VEHICLES_WITHOUT_EXPECTATION)
def test_vehicles_that_sumo_does_not_expect_are_simulated_until_the_end(
    name: str, tmp_path: Path, simulation: Simulation
) -> None:
    flow = '<flow id="f" type="car" route="along" begin="1" period="5" number="3"/>'
    path = straight(tmp_path, VEHICLES_WITHOUT_EXPECTATION[name] + flow, end=600.0, step=0.5)
    episode, sumo_seed = human_baseline(path, simulation)
    plain = trips_of_plain_sumo(path, sumo_seed, 600.0)
    check_same_trips(episode.trips, plain)
    assert plain.duration.max() == 600.0
    assert episode.control_steps == 1199


def test_trips_of_any_type_have_its_class(tmp_path: Path, simulation: Simulation) -> None:
    vehicles = "".join(
        f'<vType id="{kind}" vClass="{name}"/><vehicle id="{kind}-v@1" type="{kind}" route="along" depart="{n}"/>'
        for n, (kind, name) in enumerate(
            {"a@b": "passenger", "bus": "passenger", "bus_of_driver_a": "bus", "x_of_driver_3": "truck"}.items()
        )
    )
    episode, _ = human_baseline(straight(tmp_path, vehicles, step=0.5), simulation)
    assert episode.trips.vehicle_classes == ("passenger", "passenger", "bus", "truck")


def test_a_vehicle_type_cannot_exclude_its_vehicles_from_the_trips(tmp_path: Path, simulation: Simulation) -> None:
    kind = '<vType id="hidden"><param key="has.tripinfo.device" value="false"/></vType>'
    vehicles = kind + '<vehicle id="v" type="hidden" route="along" depart="0"/>'
    episode, _ = human_baseline(straight(tmp_path, vehicles, step=0.5), simulation)
    assert episode.trips.vehicle_ids == ("v",)


def test_delay_and_travel_time_by_vehicle_class_are_those_of_the_trips(tmp_path: Path, simulation: Simulation) -> None:
    vehicles = '<vType id="lorry" vClass="truck" maxSpeed="8" speedDev="0"/>'
    vehicles += '<vehicle id="slow" type="lorry" route="along" depart="0" departSpeed="max"/>'
    vehicles += '<vehicle id="fast" type="car" route="along" depart="4" departSpeed="max"/>'
    path = straight(tmp_path, vehicles, length=400.0, end=120.0)
    episode, _ = human_baseline(path, simulation)
    row = measure(episode)
    free = 400.0 / 20.0
    assert row["travel_time_trucks"] == pytest.approx(400.0 / 8.0, abs=1.5)
    assert row["travel_time_cars"] > 1.8 * free  # it cannot overtake
    assert np.isnan(row["travel_time_buses"])
    assert row["travel_time"] == pytest.approx((row["travel_time_trucks"] + row["travel_time_cars"]) / 2)
    lost = row["travel_time_cars"] - free
    assert row["delay"] == pytest.approx(lost / 2.0, abs=1.5)
