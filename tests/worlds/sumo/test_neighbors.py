import libsumo
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unjam.drivers.command import Command
from unjam.drivers.local_state import COMMON_FIELDS
from unjam.scenarios import Ring
from unjam.worlds.ordered_road import loop_neighbors, loop_state
from unjam.worlds.sumo.backend import make_traffic
from unjam.worlds.sumo.ordered_road import OrderedTraffic
from unjam.worlds.sumo.simulation import Simulation

CAR = 5.0


@st.composite
def vehicles_on_a_loop(draw: st.DrawFn) -> tuple[list[float], list[float], float]:
    """Speeds and positions of vehicles in road order, and the length of their loop."""
    gaps = draw(st.lists(st.floats(0.01, 60.0), min_size=2, max_size=12))
    first = draw(st.floats(0.0, 1000.0))
    positions, front = [], first
    for gap in gaps:
        positions.append(front)
        front += gap + CAR
    loop = front - first
    laps = draw(st.lists(st.integers(0, 40), min_size=len(gaps), max_size=len(gaps)))
    positions = [position + lap * loop for position, lap in zip(positions, laps, strict=True)]
    speeds = draw(st.lists(st.floats(0, 30), min_size=len(gaps), max_size=len(gaps), unique=True))
    return speeds, positions, loop


def search(place: int, positions: list[float], loop: float) -> tuple[int, float, int, float]:
    """Leader and follower of a vehicle with their gaps, by a search among all others."""
    others = [other for other in range(len(positions)) if other != place]
    ahead = {other: (positions[other] - positions[place]) % loop for other in others}
    behind = {other: (positions[place] - positions[other]) % loop for other in others}
    leader, follower = min(others, key=ahead.__getitem__), min(others, key=behind.__getitem__)
    return leader, ahead[leader] - CAR, follower, behind[follower] - CAR


@given(vehicles_on_a_loop())
def test_neighbors_and_gaps_agree_with_a_search(traffic: tuple[list[float], list[float], float]) -> None:
    speeds, positions, loop = traffic
    everyone = loop_neighbors(np.arange(len(speeds)), len(speeds))
    states = loop_state(np.array(speeds), np.array(positions), everyone, loop)
    for place in range(len(speeds)):
        leader, gap, follower, gap_behind = search(place, positions, loop)
        assert (everyone.leader[place], everyone.follower[place]) == (leader, follower)
        assert states.speed[place] == speeds[place]
        assert states.leader_speed[place] == speeds[leader]
        assert states.follower_speed[place] == speeds[follower]
        assert states.leader_gap[place] == pytest.approx(gap, abs=1e-9)
        assert states.follower_gap[place] == pytest.approx(gap_behind, abs=1e-9)
        assert 0.0 <= states.route_position[place] < loop
        assert states.loop_length[place] == loop


@given(vehicles_on_a_loop())
def test_the_state_of_one_vehicle_is_the_same_in_floats_and_arrays(
    traffic: tuple[list[float], list[float], float],
) -> None:
    speeds, positions, loop = traffic
    for place in range(len(speeds)):
        alone = loop_state(speeds, positions, loop_neighbors(place, len(speeds)), loop)
        row = loop_neighbors(np.array([place]), len(speeds))
        among = loop_state(np.array(speeds), np.array(positions), row, loop)
        assert all(type(value) is float for value in alone[: len(COMMON_FIELDS)])
        assert alone == among.select(0)


def test_several_moments_equal_single_moments() -> None:
    generator = np.random.default_rng(0)
    positions = np.array([[0.0], [20.0], [50.0]]) + generator.uniform(0, 5, (3, 7)).cumsum(1)
    speeds = generator.uniform(0, 10, (3, 7))
    near = loop_neighbors(np.array([2, 0]), 3)
    together = loop_state(speeds, positions, near, 90.0)
    assert together.speed.shape == (2, 7)
    for moment in range(7):
        alone = loop_state(speeds[:, moment], positions[:, moment], near, 90.0)
        together.map(lambda values, one: np.testing.assert_array_equal(values[:, moment], one), alone)  # noqa: B023


@pytest.mark.parametrize(("vehicles", "cavs", "length"), [(22, 3, 221), (11, 1, 128), (2, 1, 47), (44, 1, 520)])
def test_leaders_and_gaps_in_running_traffic_are_sumos(
    vehicles: int, cavs: int, length: int, simulation: Simulation
) -> None:
    steps = 300
    ring = Ring(length=(length, length), vehicles=vehicles, cavs=cavs, warmup=40, horizon=steps)
    traffic = make_traffic(ring, (3,), simulation)
    assert isinstance(traffic, OrderedTraffic)
    traffic.start(is_controlled=True)
    pushes = np.random.default_rng(0).uniform(-0.6, 1.0, (steps, cavs))
    names, seen = traffic.road.vehicle_ids, []
    for push in pushes:
        traffic.advance(Command(push))
        leaders = [libsumo.vehicle.getLeader(name, 600.0) or ("", np.nan) for name in names]
        # SUMO takes the gap that a vehicle likes to keep off what it calls the gap.
        kept = [libsumo.vehicle.getMinGap(name) for name in names]
        seen.append([(leader, gap + keep) for (leader, gap), keep in zip(leaders, kept, strict=True)])
        gaps = [seen[-1][names.index(name)][1] for name in traffic.road.cav_ids]
        np.testing.assert_allclose(traffic.local_state().leader_gap, gaps, rtol=0, atol=1e-6)
    everybody = loop_neighbors(np.arange(vehicles), vehicles)
    states = loop_state(*traffic.speeds_and_positions(), everybody, traffic.road.loop_length)
    for place, name in enumerate(names):
        assert {leaders[place][0] for leaders in seen} == {names[(place + 1) % vehicles]}, name
        gaps = [leaders[place][1] for leaders in seen]
        np.testing.assert_allclose(states.leader_gap[place, 1:], gaps, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(np.roll(states.follower_gap, -1, 0), states.leader_gap)
    assert np.ptp(states.leader_gap) > 1.0


def test_positions_are_sumos_own_along_the_road(simulation: Simulation) -> None:
    ring = Ring(length=(222, 222), warmup=30, horizon=400)
    traffic = make_traffic(ring, (1,), simulation)
    assert isinstance(traffic, OrderedTraffic)
    traffic.start(is_controlled=False)
    for _ in range(400):
        traffic.advance(None)
    _, positions = traffic.speeds_and_positions()
    for place, name in enumerate(traffic.road.vehicle_ids):
        edge = int(libsumo.vehicle.getRoadID(name).removeprefix("edge_"))
        along = edge * 222 / 4 + libsumo.vehicle.getLanePosition(name)
        assert positions[place, -1] % 222 == pytest.approx(along, abs=1e-6)
