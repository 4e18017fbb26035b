"""Lists of vehicle types in users' files select the types that replace them, too."""

from pathlib import Path
from typing import Any

import pytest

from tests.worlds.sumo.user_networks import built
from unjam.controller import make_driver
from unjam.scenarios import make_scenario
from unjam.scenarios.user_network import ACC_SETTINGS
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend

NODES = "".join(
    f'<node id="{name}" x="{x}" y="{y}"{kind}/>'
    for name, x, y, kind in (
        *(("c", 0, 0, ' type="traffic_light"'), ("w", -300, 0, ""), ("v", -400, 0, ""), ("e", 200, 0, "")),
        *(("n", 0, 300, ""), ("m", 0, 400, ""), ("s", 0, -200, "")),
    )
)
EDGES = "".join(
    f'<edge id="{start}{end}" from="{start}" to="{end}" numLanes="1" speed="14"/>'
    for start, end in ("vw", "wc", "ce", "mn", "nc", "cs")
)
TRAFFIC = """<vType id="car"/><flow id="a" type="car" from="vw" to="ce" begin="0" end="240" vehsPerHour="700"/>
<flow id="b" type="car" from="mn" to="cs" begin="0" end="240" vehsPerHour="150"/>"""
SIGNAL = '<tlLogic id="c" '
LIST = '<param key="vTypes" value="car"/>'
REROUTER = """<rerouter id="r" edges="wc"{types}>
<interval begin="0" end="900"><destProbReroute id="wc" probability="1"/></interval></rerouter>"""


def travel_time(path: Path, sumo: SumoBackend, **changes: Any) -> float:
    road = make_scenario(str(path), {**ACC_SETTINGS, "penetration_rate": 1.0, **changes})
    episode = run_episode(road, make_driver("cruise", road.control_step), seed=1, backend=sumo)
    assert episode.status == "completed"
    return float(episode.trips.travel_time.mean())


def test_detectors_of_signals_for_a_type_see_its_cavs(tmp_path: Path, sumo: SumoBackend) -> None:
    path = built(tmp_path, NODES, EDGES, TRAFFIC, '<end value="240"/>', "--tls.default-type", "actuated")
    network = tmp_path / "road.net.xml"
    before = travel_time(path, sumo)
    head, _, tail = network.read_text().partition(SIGNAL)
    first, _, rest = tail.partition(">")
    network.write_text(f"{head}{SIGNAL}{first}>{LIST}{rest}")
    assert travel_time(path, sumo) == before


@pytest.mark.parametrize("changes", [{}, {"population": "unjam:ngsim"}, {"population": "unjam:ngsim", "cavs": 1}])
def test_rerouters_for_a_type_reroute_its_cavs_and_calibrated_drivers(
    changes: dict[str, Any], tmp_path: Path, sumo: SumoBackend
) -> None:
    path = built(tmp_path, NODES, EDGES, TRAFFIC, '<additional-files value="r.add.xml"/><end value="240"/>')
    times = []
    for rerouter in ("", REROUTER.format(types=""), REROUTER.format(types=' vTypes="car"')):
        (tmp_path / "r.add.xml").write_text(f"<additional>{rerouter}</additional>")
        times.append(travel_time(path, sumo, **changes))
    assert times[0] != times[1] == times[2]
