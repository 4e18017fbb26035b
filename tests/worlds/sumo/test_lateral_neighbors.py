"""Neighbors of CAVs where vehicles drive side by side, or overtake on the opposite lane."""

from pathlib import Path

import libsumo
import numpy as np
import pytest

from tests.worlds.sumo.user_networks import built, two_way
from unjam.drivers.command import Command
from unjam.drivers.local_state import MAX_OBSERVED_GAP
from unjam.scenarios.user_network import load_user_network
from unjam.worlds.sumo.backend import make_traffic
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.user_network import UserNetworkTraffic

LATERAL_TOLERANCE = 1e-3
"""vehicles that nearly touch overlap or not, depending on rounding [m]"""
JUNCTION_LENGTH = 0.11
"""length that SUMO gives to a junction without extent [m], with rounding"""


def sublane_road(folder: Path) -> Path:
    """A straight road of two edges along the x axis, on which cars, motorcycles and mopeds share two lanes."""
    kinds = {"car": ("passenger", 20, "arbitrary", 1000), "moto": ("motorcycle", 9, "arbitrary", 500)}
    kinds |= {"moped": ("moped", 5, "right", 200)}
    types = "".join(
        f'<vType id="{name}" vClass="{vehicle_class}" maxSpeed="{speed}" latAlignment="{alignment}"/>'
        for name, (vehicle_class, speed, alignment, _) in kinds.items()
    )
    flows = "".join(
        f'<flow id="{name}" type="{name}" route="r" begin="0" end="200" vehsPerHour="{flow}" departLane="random" '
        'departPosLat="random"/>'
        for name, (*_, flow) in kinds.items()
    )
    nodes = "".join(f'<node id="{name}" x="{x}" y="0"/>' for name, x in (("a", 0), ("b", 300), ("c", 600)))
    edges = "".join(f'<edge id="{a}{b}" from="{a}" to="{b}" numLanes="2" speed="14"/>' for a, b in ("ab", "bc"))
    end = '<end value="150"/><step-length value="0.5"/><lateral-resolution value="0.4"/>'
    return built(folder, nodes, edges, f'{types}<route id="r" edges="ab bc"/>{flows}', end)


def controlled_traffic(
    path: Path, simulation: Simulation, classes: tuple[str, ...] = ("passenger",)
) -> UserNetworkTraffic:
    road = load_user_network(str(path), {"penetration_rate": 1.0, "cav_classes": classes})
    traffic = make_traffic(road, (1,), simulation)
    assert isinstance(traffic, UserNetworkTraffic)
    traffic.start(is_controlled=True)
    return traffic


def find_leader(name: str, direction: float) -> tuple[float, float, bool]:
    """Gap and speed of the vehicle ahead that overlaps laterally, from positions alone, and whether it is clear."""
    vehicle = libsumo.vehicle
    x, y = vehicle.getPosition(name)
    best, is_clear = (MAX_OBSERVED_GAP, vehicle.getSpeed(name)), True
    for other in vehicle.getIDList():
        other_x, other_y = vehicle.getPosition(other)
        overlap = (vehicle.getWidth(name) + vehicle.getWidth(other)) / 2.0 - abs(other_y - y)
        is_clear &= abs(overlap) > LATERAL_TOLERANCE
        distance = direction * (other_x - x)
        if overlap > 0.0 and distance > 0.0:
            best = min(best, (max(distance - vehicle.getLength(other), 0.0), vehicle.getSpeed(other)))
    return *best, is_clear


def test_the_leader_in_the_sublane_model_is_the_vehicle_ahead_that_overlaps(
    tmp_path: Path, simulation: Simulation
) -> None:
    traffic = controlled_traffic(sublane_road(tmp_path), simulation, ("passenger", "motorcycle"))
    generator = np.random.default_rng(0)
    compared, differs_from_sumo = 0, 0
    for _ in range(160):
        if traffic.is_finished:
            break
        traffic.advance(Command(generator.uniform(-1.0, 1.5, len(traffic.cav_ids))))
        state = traffic.local_state()
        for name, gap, speed in zip(traffic.cav_ids, state.leader_gap, state.leader_speed, strict=True):
            expected_gap, expected_speed, is_clear = find_leader(name, 1.0)
            if not is_clear or abs(expected_gap - MAX_OBSERVED_GAP) < 1.0:
                continue
            assert (gap, speed) == (pytest.approx(expected_gap, abs=JUNCTION_LENGTH), expected_speed)
            compared += 1
            found = libsumo.vehicle.getLeader(name, MAX_OBSERVED_GAP) or ("", 0.0)
            differs_from_sumo += abs(found[1] + libsumo.vehicle.getMinGap(name) - gap) > 1.0 if found[0] else False
    assert compared > 500
    assert differs_from_sumo > 50


def test_a_cav_that_overtakes_on_the_opposite_lane_has_no_leader_behind_it(
    tmp_path: Path, simulation: Simulation
) -> None:
    traffic = controlled_traffic(two_way(tmp_path), simulation)
    overtaking, reported_behind = 0, 0
    for _ in range(300):
        traffic.advance(Command(np.full(len(traffic.cav_ids), 0.5)))
        state = traffic.local_state()
        for name, gap in zip(traffic.cav_ids, state.leader_gap, strict=True):
            if libsumo.vehicle.getRoadID(name) == libsumo.vehicle.getRoute(name)[0]:
                continue
            overtaking += 1
            reported_behind += bool((libsumo.vehicle.getLeader(name, 50.0) or ("",))[0])
            assert gap == MAX_OBSERVED_GAP
    assert overtaking > 20
    assert reported_behind
