"""Sections of a user's network measure the speeds of the lanes ahead."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.worlds.sumo.user_networks import grid, straight
from unjam.drivers.command import Command
from unjam.drivers.local_state import SECTIONS_AHEAD, LocalState
from unjam.drivers.road_experts import Cruise, JamAhead
from unjam.drivers.roadside import RoadsideSettings
from unjam.scenarios import make_scenario
from unjam.worlds.backend import WorldOptions
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend, make_traffic
from unjam.worlds.sumo.networks import NetworkLane
from unjam.worlds.sumo.sections import NO_SECTION, LaneSections
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.user_network import UserNetworkTraffic
from unjam_paper.open_test_roads import OPEN_TEST_ROADS, write_road_files

LANES = [
    NetworkLane("a_0", "a", 250.0, 20.0, ("b_0", "ramp_0")),
    NetworkLane("a_1", "a", 250.0, 20.0, ("b_1",)),
    NetworkLane("b_0", "b", 330.0, 25.0, ()),
    NetworkLane("b_1", "b", 330.0, 25.0, ()),
    NetworkLane("ramp_0", "ramp", 60.0, 10.0, ()),
]
JAM = (
    '<vType id="slow" maxSpeed="4" speedDev="0"/>'
    '<vehicle id="0" type="car" route="along" depart="0" departPos="100" departSpeed="10"/>'
    '<vehicle id="1" type="slow" route="along" depart="0" departPos="520" departSpeed="2"/>'
    '<vehicle id="2" type="slow" route="along" depart="0" departPos="560" departSpeed="4"/>'
)


@pytest.fixture
def sections() -> LaneSections:
    simulation: Any = SimpleNamespace(lanes=lambda: LANES)
    return LaneSections(simulation)


def section_numbers(sections: LaneSections) -> dict[int, str]:
    """The lane of each section."""
    cells = [lane for lane in LANES for _ in range(int(np.ceil(lane.length / 100)))]
    assert len(cells) == len(sections.speed_limits)
    return {number: lane.name for number, lane in enumerate(cells)} | {NO_SECTION: ""}


def test_vehicles_are_counted_in_the_sections_of_their_lanes_and_not_in_junctions(sections: LaneSections) -> None:
    places = [("a_0", 0.0), ("a_0", 99.0), ("a_0", 100.0), ("b_1", 330.0), (":node_0", 3.0), ("", 0.0)]
    counts, speed_sums = sections.measure(places, np.array([4.0, 6.0, 9.0, 2.0, 1.0, 1.0]))
    assert counts.tolist() == [2.0, 1.0, *[0.0] * 11, 1.0, 0.0]
    assert speed_sums.tolist() == [10.0, 9.0, *[0.0] * 11, 2.0, 0.0]
    assert sections.speed_limits.tolist() == [*[20.0] * 6, *[25.0] * 8, 10.0]


def test_the_sections_ahead_follow_the_lanes_of_the_route(sections: LaneSections) -> None:
    names = section_numbers(sections)
    ahead = sections.sections_ahead("a_1", 20.0, ("a", "b"))
    assert [names[each] for each in ahead] == ["a_1"] * 2 + ["b_1"] * 4 + [""] * (SECTIONS_AHEAD - 6)
    assert len(set(ahead)) == 7
    assert [names[each] for each in sections.sections_ahead("a_0", 240.0, ("a", "ramp"))][:3] == ["a_0", "ramp_0", ""]


def test_the_lanes_of_an_edge_share_their_cross_sections(sections: LaneSections) -> None:
    assert sections.cross_sections.tolist() == [0, 1, 2, 0, 1, 2, 3, 4, 5, 6, 3, 4, 5, 6, 7]


def congestion_states(length: float, *, stop_line: bool) -> list[bool]:
    """Of two lanes of 600 m and of a `length`, one after the other: which sections are monitored."""
    lanes = [NetworkLane("a_0", "a", 600.0, 20.0, ("b_0",)), NetworkLane("b_0", "b", length, 20.0, (), stop_line)]
    simulation: Any = SimpleNamespace(lanes=lambda: lanes)
    return LaneSections(simulation).is_monitored.tolist()


def test_no_congestion_is_reported_within_queue_length_of_a_stop_line() -> None:
    assert congestion_states(600.0, stop_line=False) == [True] * 12
    assert congestion_states(600.0, stop_line=True) == [True] * 2 + [False] * 10
    assert congestion_states(1200.0, stop_line=True) == [True] * 8 + [False] * 10


def test_no_congestion_is_reported_of_a_short_section() -> None:
    assert congestion_states(649.0, stop_line=False) == [True] * 12 + [False]
    assert congestion_states(651.0, stop_line=False) == [True] * 13


@pytest.mark.parametrize("kind", ["traffic_light", "priority", "right_before_left"])
def test_queues_at_junctions_are_not_congestion(kind: str, tmp_path: Path, simulation: Simulation) -> None:
    scenario = make_scenario(str(grid(tmp_path, kind)), {"penetration_rate": 0.3})
    make_traffic(scenario, (1,), simulation)
    assert not LaneSections(simulation).is_monitored.any()


def test_a_motorway_is_monitored_where_ramps_join_and_leave(tmp_path: Path, simulation: Simulation) -> None:
    file = write_road_files(OPEN_TEST_ROADS["on-ramp with reserve"], tmp_path)
    make_traffic(make_scenario(str(file), {"penetration_rate": 0.1}), (1,), simulation)
    assert LaneSections(simulation).is_monitored.mean() > 0.95, "all but pieces of a few meters"


def test_sections_ahead_switch_to_the_adjacent_lane_of_the_route(sections: LaneSections) -> None:
    names = section_numbers(sections)
    assert [names[each] for each in sections.sections_ahead("a_1", 240.0, ("a", "ramp"))][:2] == ["a_1", "ramp_0"]


@pytest.fixture
def jammed_network(tmp_path: Path) -> Any:
    changes = {"cav_types": ("car",), "horizon": 50, "actuation": "cruise", "safety.active": False}
    return make_scenario(str(straight(tmp_path, JAM)), changes)


def roadside_state(scenario: Any, simulation: Simulation) -> tuple[UserNetworkTraffic, Any]:
    traffic = make_traffic(scenario, (1,), simulation, WorldOptions(JamAhead().requirements().measured_fields))
    assert isinstance(traffic, UserNetworkTraffic)
    traffic.start(is_controlled=True)
    return traffic, traffic.local_state()


def test_a_cav_observes_the_speed_of_its_lane_ahead(jammed_network: Any, simulation: Simulation) -> None:
    _, state = roadside_state(jammed_network, simulation)
    own, van, other = simulation.speeds(["0", "1", "2"])
    expected = [own, 20.0, 20.0, 20.0, (van + other) / 2, *[20.0] * 6]
    assert state.lane_speeds[0].tolist() == pytest.approx(expected)
    assert (state.allowed_speed[0], state.penetration_rate[0]) == (20.0, pytest.approx(1 / 3))
    assert state.leader_gap[0] == 100.0, "there is no leader: only the message reports the jam"


def test_a_set_speed_cap_does_not_change_the_observed_allowed_speed(
    jammed_network: Any, simulation: Simulation
) -> None:
    traffic, _ = roadside_state(jammed_network, simulation)
    simulation.set_max_speed("0", 6.0)
    assert traffic._local_states(["0"]).allowed_speed.tolist() == [20.0]


def test_roadside_information_is_only_provided_if_required(jammed_network: Any, simulation: Simulation) -> None:
    traffic = make_traffic(jammed_network, (1,), simulation)
    traffic.start(is_controlled=True)
    assert traffic.local_state().lane_speeds is None


def test_a_users_function_gets_roadside_information(jammed_network: Any, sumo: SumoBackend) -> None:
    def steady(state: LocalState) -> Any:
        return 0.2 * (state.lane_speeds[:, 4] - state.speed)

    episode = run_episode(jammed_network, steady, (1,), backend=sumo)
    assert episode.trajectories[0].states.speed[-1] < 8.0


QUEUE = (
    '<flow id="before" type="car" route="along" begin="0" end="200" period="3" departSpeed="15"/>'
    '<vehicle id="broken" type="car" route="along" depart="201" departSpeed="15">'
    '<stop lane="road_0" endPos="1900" duration="200"/></vehicle>'
    '<flow id="behind" type="car" route="along" begin="204" end="320" period="4" departSpeed="15"/>'
    '<vehicle id="cav" type="van" route="along" depart="400" departSpeed="15"/>'
)
"""free flow, then a vehicle that stands and a queue behind it, and a CAV that arrives"""


@pytest.mark.slow
def test_a_cav_slows_down_for_congestion_beyond_its_sensors(tmp_path: Path, sumo: SumoBackend) -> None:
    changes = {"cav_types": ("van",), "horizon": 5000, "actuation": "cruise", "safety.active": False}
    scenario = make_scenario(str(straight(tmp_path, QUEUE, 2500.0, 500.0)), changes)
    careful, free = (
        run_episode(scenario, driver, (1,), backend=sumo).trajectories[0].states
        for driver in (JamAhead(first_section=4, last_section=4, speed_margin=0.0, margin_by_penetration=0.0), Cruise())
    )
    slowest, of_acc = (states.speed[10:][states.leader_gap[10:] == 100.0].min() for states in (careful, free))
    assert careful.congestion.max() == 1.0
    assert slowest < 10.0
    assert of_acc > 14.0


def test_an_episode_that_starts_in_a_jam_has_no_cap(jammed_network: Any, sumo: SumoBackend) -> None:
    first, second = (
        run_episode(jammed_network, driver, (1,), backend=sumo).trajectories[0].states
        for driver in (JamAhead(first_section=4, last_section=4, speed_margin=0.0, margin_by_penetration=0.0), Cruise())
    )
    assert first.speed.tolist() == second.speed.tolist()


def test_roadside_messages_have_the_configured_latency(jammed_network: Any, simulation: Simulation) -> None:
    traffic, first = roadside_state(replace(jammed_network, roadside=RoadsideSettings(latency=2.0)), simulation)
    for _ in range(10):
        traffic.advance(Command(np.zeros(1)))
    assert traffic.local_state().lane_speeds.tolist() == first.lane_speeds.tolist()
