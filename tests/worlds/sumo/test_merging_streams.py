"""Order and neighbors on a merging road, compared with a second, plain implementation and with SUMO."""

from dataclasses import dataclass

import libsumo
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unjam.drivers.command import Command
from unjam.errors import EpisodeError
from unjam.scenarios import Merge
from unjam.scenarios.road import Origin
from unjam.scenarios.scenario import MIN_CAV_GAP
from unjam.worlds.sumo.backend import make_traffic
from unjam.worlds.sumo.merge_road import ABSENT_LEADER_GAP, MergingStreams, MergingTraffic
from unjam.worlds.sumo.simulation import Simulation

WAYS = (24.0, 23.0)


@dataclass
class Vehicle:
    """A vehicle of the second implementation."""

    name: str
    branch: int
    position: float
    speed: float


def leader_of(vehicle: Vehicle, others: list[Vehicle]) -> Vehicle | None:
    """The nearest ahead on the way that it takes: its own branch, and all beyond the meeting place."""
    ahead = [
        other
        for other in others
        if other.position > vehicle.position
        and (other.position >= 0 or (vehicle.position < 0 and other.branch == vehicle.branch))
    ]
    return min(ahead, key=lambda other: other.position, default=None)


def follower_of(vehicle: Vehicle, others: list[Vehicle]) -> Vehicle | None:
    """The nearest of the vehicles that follow it."""
    behind = [other for other in others if leader_of(other, others) is vehicle]
    return max(behind, key=lambda other: other.position, default=None)


def drive(vehicles: list[Vehicle], wanted: list[float], step: float) -> None:
    """Move all by desired speeds, from front to back, but none past its leader."""
    for vehicle, speed in zip(sorted(vehicles, key=lambda each: -each.position), wanted, strict=False):
        leader = leader_of(vehicle, vehicles)
        room = np.inf if leader is None else max(leader.position - vehicle.position - 0.01, 0.0)
        vehicle.speed = min(speed, room / step)
        vehicle.position += vehicle.speed * step


def same(streams: MergingStreams, vehicles: list[Vehicle]) -> None:
    by_name = {vehicle.name: vehicle for vehicle in vehicles}
    assert sorted(streams.vehicle_ids) == sorted(by_name)
    leaders, states, on_junction = streams.leaders(), streams.states(), streams.is_on_junction(WAYS)
    gaps = streams.gaps(leaders)
    for row, name in enumerate(streams.vehicle_ids):
        own = by_name[name]
        assert streams.positions[row] == pytest.approx(own.position, abs=1e-9)
        assert streams.speeds[row] == own.speed
        leader, follower = leader_of(own, vehicles), follower_of(own, vehicles)
        assert (streams.vehicle_ids[leaders[row]] if leaders[row] >= 0 else None) == (leader and leader.name)
        gap = ABSENT_LEADER_GAP if leader is None else leader.position - own.position - 5.0
        assert gaps[row] == pytest.approx(gap, abs=1e-9)
        near = leader is not None and gap < 100.0
        assert states.leader_gap[row] == pytest.approx(gap if near else 100.0, abs=1e-9)
        assert states.leader_speed[row] == (leader.speed if leader and near else own.speed)
        gap = ABSENT_LEADER_GAP if follower is None else own.position - follower.position - 5.0
        near = follower is not None and gap < 100.0
        assert states.follower_gap[row] == pytest.approx(gap if near else 100.0, abs=1e-9)
        assert states.follower_speed[row] == (follower.speed if follower and near else own.speed)
        assert (states.speed[row], states.route_position[row]) == (own.speed, streams.positions[row])
        assert on_junction[row] == (-WAYS[own.branch] <= streams.positions[row] < 0)


@given(st.data())
def test_order_and_neighbors_agree_with_a_plain_search(data: st.DataObject) -> None:
    streams, vehicles, step = MergingStreams(), [], 1.0
    speeds = st.floats(0.0, 30.0).map(lambda speed: round(speed, 3))
    for number in range(data.draw(st.integers(1, 14), "moments")):
        front = sorted((each for each in vehicles if each.position >= 100), key=lambda each: -each.position)
        left = front[: data.draw(st.integers(0, len(front)), "leaving")]
        vehicles = [each for each in vehicles if each not in left]
        streams.leave([each.name for each in left])
        drive(vehicles, [data.draw(speeds) for _ in vehicles], step)
        now = {each.name: each.speed for each in vehicles}
        streams.move([now[name] for name in streams.vehicle_ids], step)
        for branch in data.draw(st.sets(st.integers(0, 1)), "entering"):
            last = min((each.position for each in vehicles if each.branch == branch), default=0.0)
            place = min(-60.0, last) - data.draw(st.sampled_from([0.5, 8.0, 40.0]), "place")
            newcomer = Vehicle(f"{branch}_{number}", branch, place, data.draw(speeds))
            vehicles.append(newcomer)
            streams.enter(newcomer.name, Origin(branch, place), newcomer.speed)
        same(streams, vehicles)


def standing(*positions: tuple[int, float]) -> MergingStreams:
    """Vehicles `a`, `b`, ... on (branch, position)."""
    streams = MergingStreams()
    for name, (branch, position) in zip("abcdef", positions, strict=False):
        streams.enter(name, Origin(branch, position), 0.0)
    return streams


def test_of_two_vehicles_that_merge_in_one_step_the_one_further_ahead_leads() -> None:
    streams = standing((0, -6.0), (1, -0.5))
    streams.move([30.5, 32.0], 0.2)  # to 0.1 and 5.9
    assert streams.vehicle_ids == ["b", "a"]
    assert streams.gaps(streams.leaders()).tolist() == pytest.approx([ABSENT_LEADER_GAP, 0.8])


def test_the_first_vehicles_of_both_branches_follow_the_last_one_past_the_merge_point() -> None:
    streams = standing((0, 40.0), (0, 5.0), (0, -10.0), (0, -30.0), (1, -20.0))
    assert streams.vehicle_ids == list("abcde")
    assert streams.leaders().tolist() == [-1, 0, 1, 2, 1]
    states = streams.states()
    np.testing.assert_allclose(states.leader_gap, [100.0, 30.0, 10.0, 15.0, 20.0])
    # Of b's two followers c is the nearer one.
    np.testing.assert_allclose(states.follower_gap, [30.0, 10.0, 15.0, 100.0, 100.0])


def test_a_vehicle_may_enter_past_the_merge_point() -> None:
    streams = standing((0, -10.0), (1, -10.0))
    streams.enter("x", Origin(0, 50.0), 3.0)
    assert streams.vehicle_ids == ["x", "a", "b"]
    assert streams.leaders().tolist() == [-1, 0, 0]


def test_an_empty_road_has_no_vehicles() -> None:
    streams = MergingStreams()
    streams.move([], 0.2)
    assert {values.shape for values in streams.states() if values is not None} == {(0,)}
    assert streams.is_on_junction(WAYS).shape == (0,)


def test_leaving_from_behind_another_vehicle_is_an_error() -> None:
    streams = standing((0, 90.0), (0, 50.0), (0, 10.0))
    streams.leave(["b", "a"])
    assert streams.vehicle_ids == ["c"]
    with pytest.raises(EpisodeError, match="b left the road from behind another vehicle"):
        standing((0, 90.0), (0, 50.0)).leave(["b"])


PLACES = {"inflow_highway": -624.625483, "highway": -524.525483, "after": 0.0}
"""where the edges of the highway begin [m]"""
PLACES |= {"inflow_ramp": -223.370389, "ramp": -123.270389}


def test_positions_are_those_of_sumo(simulation: Simulation) -> None:
    traffic = merging(simulation)
    compared = 0
    for _ in range(60):
        traffic.advance(Command(np.zeros(len(traffic.cav_ids))))
        streams = traffic._streams
        assert sorted(streams.vehicle_ids) == sorted(libsumo.vehicle.getIDList())
        for name, position in zip(streams.vehicle_ids, streams.positions, strict=True):
            edge = libsumo.vehicle.getRoadID(name)
            if edge in PLACES:
                along = PLACES[edge] + libsumo.vehicle.getLanePosition(name)
                assert position == pytest.approx(along, abs=1e-6)
                compared += 1
    assert compared > 500


def test_leaders_on_the_same_lane_are_those_of_sumo(simulation: Simulation) -> None:
    """Compared are leaders on the vehicle's own lane.

    Left out is what SUMO says of others: before the junction it also names vehicles of the other branch that
    are on or near it, of which two streams know nothing until both ways have met.
    """
    traffic = merging(simulation)
    compared = 0
    for _ in range(100):
        traffic.advance(Command(np.zeros(len(traffic.cav_ids))))
        streams = traffic._streams
        leaders = streams.leaders()
        gaps = streams.gaps(leaders)
        for row, name in enumerate(streams.vehicle_ids):
            found = libsumo.vehicle.getLeader(name, 200.0)
            if not found or libsumo.vehicle.getLaneID(found[0]) != libsumo.vehicle.getLaneID(name):
                continue
            assert streams.vehicle_ids[leaders[row]] == found[0]
            kept = MIN_CAV_GAP if name in traffic.cav_ids else 2.5
            assert gaps[row] == pytest.approx(found[1] + kept, abs=1e-6)
            compared += 1
    assert compared > 1500


def merging(simulation: Simulation) -> MergingTraffic:
    traffic = make_traffic(Merge(penetration_rate=0.3), (3,), simulation)
    assert isinstance(traffic, MergingTraffic)
    traffic.start(is_controlled=True)
    return traffic
