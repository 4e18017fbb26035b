"""Write small SUMO networks, as a user would: XML elements, the network and the configuration."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from unjam.worlds.sumo.networks import run_netconvert, xml_element

EPISODE_SECONDS, ROAD_SIMULATION_STEP = 900.0, 0.5
"""length of an episode, and simulation step [s]"""


def element_document(root: str, elements: Sequence[str]) -> str:
    """Return an XML document with these elements below its root."""
    return f"<{root}>{''.join(elements)}</{root}>"


def node_element(name: str, x: float, y: float, kind: str = "priority") -> str:
    """Return a node at a position [m]."""
    return xml_element("node", id=name, x=round(x, 2), y=round(y, 2), type=kind)


def edge_element(name: str, start: str, end: str, lanes: int, speed: float) -> str:
    """Return an edge between two nodes with a speed limit [m/s]."""
    return xml_element("edge", id=name, **{"from": start, "to": end}, numLanes=lanes, speed=speed, priority=3)


def connection_element(start: str, end: str, lane: int, next_lane: int) -> str:
    """Return a connection between lanes of two edges."""
    return xml_element("connection", **{"from": start, "to": end}, fromLane=lane, toLane=next_lane)


def write_network(
    folder: Path,
    nodes: Sequence[str],
    edges: Sequence[str],
    connections: Sequence[str],
    traffic: Sequence[str],
    *options: str,
) -> Path:
    """Write a network and its traffic with options of netconvert, and return the SUMO configuration."""
    parts = {"node": ("nod", nodes), "edge": ("edg", edges), "connection": ("con", connections)}
    inputs = {
        (f"--{name}-files", f"road.{suffix}.xml"): element_document(f"{name}s", elements)
        for name, (suffix, elements) in parts.items()
        if elements
    }
    run_netconvert(inputs, ["--no-turnarounds=true", *options], folder)
    (folder / "road.rou.xml").write_text(element_document("routes", traffic))
    return write_configuration(folder, {})


def write_configuration(folder: Path, options: Mapping[str, str]) -> Path:
    """Write and return the SUMO configuration of `road.net.xml` and `road.rou.xml`."""
    files = {"net-file": "road.net.xml", "route-files": "road.rou.xml"}
    values = {**files, "end": EPISODE_SECONDS, "step-length": ROAD_SIMULATION_STEP, **options}
    path = folder / "road.sumocfg"
    lines = [xml_element(name, value=value) for name, value in values.items()]
    path.write_text(element_document("configuration", lines))
    return path
