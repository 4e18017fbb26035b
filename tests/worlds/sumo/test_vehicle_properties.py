"""A CAV keeps all properties of the vehicle that it replaces, except the car-following model."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.worlds.sumo.user_networks import SPARSE, network, straight
from unjam.controller import make_driver
from unjam.drivers import Constant, Human
from unjam.drivers.command import Command
from unjam.drivers.user_driver import DriverLike
from unjam.scenarios import make_scenario
from unjam.scenarios.user_network import ACC_SETTINGS
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode
from unjam.worlds.sumo.backend import SumoBackend, make_traffic
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.user_network import UserNetworkTraffic

LAW = 'carFollowModel="IDM" tau="1.1" minGap="2"'
"""the law of a CAV's own ACC, so that nothing at all may change"""
ACCS = {**ACC_SETTINGS, "penetration_rate": 1.0, "end": 60.0}


def drive(simulation: Simulation, file: str, driver: DriverLike, **changes: Any) -> Episode:
    scenario = make_scenario(file, {**ACCS, **changes})
    return run_episode(scenario, driver, (3,), record_details=True, backend=SumoBackend(simulation))


BUS_STOPS = (
    '<busStop id="s1" lane="road_0" startPos="50" endPos="100"/>'
    '<busStop id="s2" lane="road_0" startPos="200" endPos="250"/>'
)
PASSENGERS = (
    '<vType id="own" vClass="bus" personCapacity="30" boardingDuration="0.2" {law}/>'
    '<vehicle id="bus" type="own" depart="2" route="along" line="L">'
    '<stop busStop="s1" duration="2"/><stop busStop="s2" duration="2"/></vehicle>'
    '<personFlow id="p" begin="0" end="1" number="50"><stop busStop="s1" duration="0"/>'
    '<ride busStop="s2" lines="L"/></personFlow>'
)
"""more passengers wait than the bus has places"""
CALIBRATOR = (
    f'<vType id="own" {LAW}/><route id="again" edges="road"/>'
    '<calibrator id="c" edge="road" pos="300" freq="20" vTypes="own">'
    '<flow begin="0" end="50" vehsPerHour="900" route="again" type="own" speed="20"/></calibrator>'
)
"""counts vehicles of a type, and adds those that are missing"""


@pytest.mark.parametrize(
    ("demand", "more", "options"),
    [
        ('<vType id="own" {law}/>' + SPARSE, "", ""),
        ('<vType id="own" {law} speedFactor="normc(0.9,0.2,0.5,1.5)"/>' + SPARSE, "", ""),
        ('<vType id="own" {law}/><vehicle id="v" type="own" route="along" depart="0" speedFactor="0.7"/>', "", ""),
        ('<vType id="own" vClass="truck" accel="0.5" decel="4" length="12" maxSpeed="18" {law}/>' + SPARSE, "", ""),
        ('<vType id="own" accel="2" emergencyDecel="5" jmTimegapMinor="3" impatience="0.5" {law}/>' + SPARSE, "", ""),
        ('<vType id="own" actionStepLength="0.7" {law}/>' + SPARSE, "", '<step-method.ballistic value="true"/>'),
        (
            '<vType id="own" laneChangeModel="SL2015" latAlignment="arbitrary" minGapLat="0.1" width="0.8" '
            'maxSpeedLat="2" lcPushy="1" {law}/><vType id="slow" vClass="bicycle" maxSpeed="4" width="0.6" '
            'latAlignment="right"/>'
            + SPARSE
            + '<flow id="s" type="slow" route="along" begin="0" end="50" period="9"/>',
            "",
            '<lateral-resolution value="0.4"/>',
        ),
        (PASSENGERS, BUS_STOPS, ""),
        ('<vType id="own" {law}><carFollowing-IDM tau="1.1" minGap="2" accel="0.8"/></vType>' + SPARSE, "", ""),
        (
            '<vTypeDistribution id="mix"><vType id="own" accel="0.6" probability="0.5" {law}/>'
            '<vType id="other" maxSpeed="12" probability="0.5" {law}/></vTypeDistribution>'
            + SPARSE.replace('"own"', '"mix"'),
            "",
            "",
        ),
        (SPARSE, CALIBRATOR, ""),
    ],
    ids=[
        "drawn",
        "distribution",
        "vehicle",
        "truck",
        "limits",
        "action",
        "lateral",
        "bus",
        "nested",
        "mix",
        "calibrator",
    ],
)
def test_acc_vehicles_with_the_model_of_their_vehicles_change_nothing(
    demand: str, more: str, options: str, tmp_path: Path, simulation: Simulation
) -> None:
    file = network(tmp_path, demand.replace("{law}", LAW), more, options)
    changes = {"cav_classes": ["passenger", "truck", "bus"]}
    human = drive(simulation, file, Human(), **changes)
    acc = drive(simulation, file, make_driver("cruise", 0.1), **changes)
    assert len(acc.cav_ids) >= 1
    np.testing.assert_array_equal(acc.speeds, human.speeds)


@pytest.mark.parametrize(
    "changes",
    [{}, {"actuation": "shielded"}, {"actuation": "raw"}, {"actuation": "flow"}, {"population": "unjam:ngsim"}],
    ids=["cruise", "shielded", "raw", "flow", "calibrated"],
)
def test_each_vehicle_keeps_its_speed_factor_and_others_draw_the_same(
    changes: dict[str, Any], tmp_path: Path, simulation: Simulation
) -> None:
    own = '<vehicle id="it" type="own" route="along" depart="1" speedFactor="1.3"/>'
    file = network(tmp_path, '<vType id="own" speedDev="0.3"/>' + SPARSE.replace('period="4"', 'period="3"') + own)

    def factors(share: float) -> dict[str, float]:
        scenario = make_scenario(file, {**ACCS, **changes, "penetration_rate": share, "cavs": 9})
        traffic = make_traffic(scenario, (3,), simulation)
        traffic.start(is_controlled=share == 1.0)
        found: dict[str, float] = {}
        while not traffic.has_ended:
            traffic.advance(Command(np.zeros(len(traffic.cav_ids))))
            names = [name for name in simulation.departed_vehicles() if name not in found]
            found |= zip(names, (factor for factor, _ in simulation.desired_speeds(names)), strict=True)
            last = [name for name in traffic.cav_ids if name in found]
            found |= zip(last, (factor for factor, _ in simulation.desired_speeds(last)), strict=True)
        return found

    human, cavs = factors(1e-12), factors(1.0)  # which may end early: a CAV without brakes
    assert cavs == {name: human[name] for name in cavs}
    assert cavs["it"] == 1.3
    assert len(set(cavs.values())) == len(cavs) > 5


TRUCK = '<vType id="own" vClass="truck" accel="0.5" emergencyDecel="3" decel="2.5" length="12"/>'
ONE = '<vehicle id="v" type="own" route="along" depart="0" departSpeed="5"/>'
CAR = '<vType id="own"/>'


@pytest.mark.parametrize("actuation", ["shielded", "raw"])
def test_commands_cannot_exceed_the_limits_of_the_vehicle(
    actuation: str, tmp_path: Path, simulation: Simulation
) -> None:
    file = network(tmp_path, TRUCK + ONE)
    asked = {"actuation": actuation, "cav_classes": ["truck"], "action_limit": 9.0, "horizon": 30}
    for wanted, possible in ((1.0, 0.5), (0.3, 0.3), (-9.0, -3.0), (-1.0, -1.0)):
        (trip,) = drive(simulation, file, Constant(wanted), **asked).trajectories
        steps = np.diff(trip.states.speed)[:10]
        np.testing.assert_allclose(steps, 0.1 * possible, atol=1e-9)
        assert not (trip.shield_braking > 1e-9).any()
        np.testing.assert_allclose(trip.applied_acceleration[:10], possible)


@pytest.mark.parametrize(
    ("vehicle", "most"),
    [
        (TRUCK, 0.5),
        (CAR, 2.6),
        ('<vType id="own" carFollowModel="W99" accel="1"/>', 2.0),
        ('<vType id="own" carFollowModel="W99" cc8="3"/>', 3.0),
    ],
)
def test_a_set_speed_makes_a_vehicle_accelerate_as_commanded_within_its_limits(
    vehicle: str, most: float, tmp_path: Path, simulation: Simulation
) -> None:
    file = network(tmp_path, vehicle + ONE)
    for wanted in (0.2, 0.4):
        (trip,) = drive(simulation, file, Constant(wanted), cav_classes=["passenger", "truck"], horizon=20).trajectories
        np.testing.assert_allclose(np.diff(trip.states.speed)[1:], 0.1 * wanted, rtol=0.06)
    free = drive(simulation, file, make_driver("cruise", 0.1), cav_classes=["passenger", "truck"], horizon=20)
    assert np.diff(free.trajectories[0].states.speed).max() == pytest.approx(0.1 * most, rel=0.03)


@pytest.mark.parametrize(("set_to", "found"), [({}, 0.5), ({"cruise.acceleration": 1.5}, 1.5)])
def test_the_acc_has_another_acceleration_only_if_configured(
    set_to: dict[str, float], found: float, tmp_path: Path, simulation: Simulation
) -> None:
    file = network(tmp_path, TRUCK + ONE)
    changes = {"cav_classes": ["truck"], "horizon": 20, **set_to}
    episode = drive(simulation, file, make_driver("cruise", 0.1), **changes)
    assert np.diff(episode.trajectories[0].states.speed).max() == pytest.approx(0.1 * found, rel=0.03)


def test_brakes_are_those_of_the_filter_or_of_the_vehicle_if_these_are_weaker(
    tmp_path: Path, simulation: Simulation
) -> None:
    other = '<vType id="car"/><vehicle id="w" type="car" route="along" depart="2"/>'
    file = network(tmp_path, TRUCK + ONE + other)
    changes = {"penetration_rate": 1.0, "cav_classes": ["truck", "passenger"], "horizon": 50}
    traffic = make_traffic(make_scenario(file, changes), (0,), simulation)
    assert isinstance(traffic, UserNetworkTraffic)
    traffic.start(is_controlled=True)
    for _ in range(40):
        traffic.advance(Command(np.zeros(len(traffic.cav_ids))))
    limits = {kind: simulation.type_limits(f"cav_of_{kind}") for kind in ("own", "car")}
    assert (limits["own"].acceleration, limits["own"].emergency_deceleration) == (0.5, 3.0)
    assert (limits["car"].acceleration, limits["car"].emergency_deceleration) == (2.6, 6.0)


@pytest.mark.long
def test_set_speed_caps_count_as_delay(tmp_path: Path, simulation: Simulation) -> None:
    file = network(tmp_path, CAR + SPARSE)
    free = drive(simulation, file, make_driver("cruise", 0.1), end=150.0)
    slow = drive(simulation, file, lambda state: 0.5 * (10.0 - state.speed), end=150.0)
    compared = free.trips.has_arrived & slow.trips.has_arrived
    assert compared.sum() > 3
    difference = slow.trips.travel_time - free.trips.travel_time
    assert difference[compared].min() > 5.0
    np.testing.assert_allclose((slow.trips.delay - free.trips.delay)[compared], difference[compared], atol=0.3)
    assert slow.limit_speed == pytest.approx(free.limit_speed, rel=0.15)


@pytest.mark.long
def test_cars_parked_off_the_road_have_no_allowed_speed(tmp_path: Path, sumo: SumoBackend) -> None:
    stop = '<stop lane="road_0" endPos="300" duration="30" parking="true"/>'
    cars = f'<vehicle id="parked" type="car" route="along" depart="0">{stop}</vehicle>'
    path = straight(tmp_path, cars + '<vehicle id="other" type="car" route="along" depart="2"/>')
    episode = run_episode(
        make_scenario(str(path), {"penetration_rate": 0.5}), Human(), 1, record_details=True, backend=sumo
    )
    assert episode.limit_speed == pytest.approx(20.0)
