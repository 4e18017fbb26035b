"""Do the sections of a user's network say how fast the lanes ahead are?"""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.worlds.sumo.own_roads import straight
from unjam.drivers.command import Command
from unjam.drivers.local_state import SECTIONS_AHEAD, LocalState
from unjam.drivers.road_experts import Cruise, JamAhead
from unjam.drivers.roadside import Roadside
from unjam.scenarios import make_scenario
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo import make_traffic
from unjam.worlds.sumo.own import OwnTraffic
from unjam.worlds.sumo.sections import NOWHERE, LaneSections
from unjam.worlds.sumo.simulation import NetworkLane, Simulation

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


def numbered(sections: LaneSections) -> dict[int, str]:
    """The lane of each section."""
    cells = [lane for lane in LANES for _ in range(int(np.ceil(lane.length / 100)))]
    assert len(cells) == len(sections.allowed)
    return {number: lane.name for number, lane in enumerate(cells)} | {NOWHERE: ""}


def test_the_mean_of_each_section_is_of_those_in_it_and_junctions_are_none(sections: LaneSections) -> None:
    places = [("a_0", 0.0), ("a_0", 99.0), ("a_0", 100.0), ("b_1", 330.0), (":node_0", 3.0), ("", 0.0)]
    means = sections.means(places, np.array([4.0, 6.0, 9.0, 2.0, 1.0, 1.0]))
    assert means.tolist() == [5.0, 9.0, 20.0, *[20.0] * 3, *[25.0] * 4, *[25.0] * 3, 2.0, 10.0]


def test_the_sections_ahead_follow_the_lanes_that_lead_along_the_route(sections: LaneSections) -> None:
    names = numbered(sections)
    ahead = sections.ahead("a_1", 20.0, ("a", "b"))
    assert [names[each] for each in ahead] == ["a_1"] * 2 + ["b_1"] * 4 + [""] * (SECTIONS_AHEAD - 6)
    assert len(set(ahead)) == 7
    assert [names[each] for each in sections.ahead("a_0", 240.0, ("a", "ramp"))][:3] == ["a_0", "ramp_0", ""]


def test_who_must_change_lanes_is_told_of_the_lane_beside(sections: LaneSections) -> None:
    names = numbered(sections)
    assert [names[each] for each in sections.ahead("a_1", 240.0, ("a", "ramp"))][:2] == ["a_1", "ramp_0"]


@pytest.fixture
def jammed(tmp_path: Path) -> Any:
    changes = {"cav_types": ("car",), "horizon": 50, "actuation": "cruise", "safety.active": False}
    return make_scenario(str(straight(tmp_path, JAM)), changes)


def told(scenario: Any, simulation: Simulation) -> tuple[OwnTraffic, Any]:
    traffic = make_traffic(scenario, (1,), simulation, asked=JamAhead().asks)
    assert isinstance(traffic, OwnTraffic)
    traffic.start(controlled=True)
    return traffic, traffic.perceive()


def test_a_cav_is_told_how_fast_its_lane_is_ahead(jammed: Any, simulation: Simulation) -> None:
    _, state = told(jammed, simulation)
    own, van, other = simulation.speeds(["0", "1", "2"])
    expected = [own, 20.0, 20.0, 20.0, (van + other) / 2, *[20.0] * 6]
    assert state.lane_speeds[0].tolist() == pytest.approx(expected)
    assert (state.allowed_speed[0], state.cav_share[0]) == (20.0, pytest.approx(1 / 3))
    assert state.leader_gap[0] == 100.0, "nobody is near: only the message tells of the jam"


def test_who_is_held_back_knows_what_is_allowed_all_the_same(jammed: Any, simulation: Simulation) -> None:
    traffic, _ = told(jammed, simulation)
    simulation.set_fastest("0", 6.0)
    assert traffic._states(["0"]).allowed_speed.tolist() == [20.0]


def test_who_does_not_ask_is_told_nothing(jammed: Any, simulation: Simulation) -> None:
    traffic = make_traffic(jammed, (1,), simulation)
    traffic.start(controlled=True)
    assert traffic.perceive().lane_speeds is None


def test_a_function_of_ones_own_is_told_too(jammed: Any, simulation: Simulation) -> None:
    def steady(state: LocalState) -> Any:
        return 0.2 * (state.lane_speeds[:, 4] - state.speed)

    episode = run_episode(jammed, steady, (1,), simulation=simulation)
    assert episode.trajectories[0].states.speed[-1] < 8.0


def test_a_cav_slows_down_for_a_jam_that_it_cannot_see(jammed: Any, simulation: Simulation) -> None:
    careful, free = (
        run_episode(jammed, driver, (1,), simulation=simulation)
        for driver in (JamAhead(first=4, last=4, margin=0.0, margin_by_share=0.0), Cruise())
    )
    seen = careful.trajectories[0].states
    assert seen.leader_gap.min() == 100.0
    assert seen.speed[-1] == pytest.approx(6.0, abs=0.5)
    assert free.trajectories[0].states.speed[-1] > 12.0


def test_a_message_of_ones_own_road_is_late_as_asked(jammed: Any, simulation: Simulation) -> None:
    traffic, first = told(replace(jammed, roadside=Roadside(age=2.0)), simulation)
    for _ in range(10):
        traffic.advance(Command(np.zeros(1)))
    assert traffic.perceive().lane_speeds.tolist() == first.lane_speeds.tolist()
