"""Open roads of the study `do-no-harm`, as SUMO networks of a user's own: what they are, and their files."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate, product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from unjam.physics.idm import IDMParameters, equilibrium_gap
from unjam.worlds.sumo.networks import run_netconvert, xml_element

CAR_LENGTH, TRUCK_LENGTH = 4.8, 12.0
"""lengths of vehicles [m]"""
TRUCK_SPEED = 24.0
"""[m/s]"""
EPISODE_SECONDS = 900.0
"""of an episode"""
HARM_SIMULATION_STEP = 0.5
"""of the simulation [s]"""
CROSSING_SHARE = 0.05
"""of the demand of the main road, on each road that crosses at a signal"""
NETCONVERT_OPTIONS = ["--junctions.limit-turn-speed=-1", "--no-turnarounds=true"]
"""of netconvert: curves are as fast as the definition says"""


class RoadSection(NamedTuple):
    """A part of a road with the same lanes and limit; further lanes begin, and end, on the right."""

    length: float
    """[m]"""
    lanes: int
    speed: float
    """limit [m/s]"""
    turn: float = 0.0
    """by how much the direction changes at its start [degrees]"""
    ramp_flow: float = 0.0
    """share of all vehicles that enters at its start, from a ramp onto its rightmost lane"""
    has_signal: bool = False
    """whether there is a signal at its end"""


SIDE_ROAD_SECTION = RoadSection(0.0, 1, 20.0)
"""lanes and limit of ramps and of roads that cross"""


USUAL_HUMANS = IDMParameters(
    desired_speed=60.0, time_headway=1.4, max_acceleration=1.3, comfortable_deceleration=2.0, minimum_gap=2.2
)
"""human drivers who are as fast as a road allows"""
CALM_HUMANS = IDMParameters(
    desired_speed=35.5, time_headway=1.66, max_acceleration=2.37, comfortable_deceleration=3.2, minimum_gap=2.94
)
"""human drivers whose flow near capacity is far slower than a limit of 40 m/s"""


@dataclass(frozen=True)
class OpenTestRoad:
    """A road and its demand."""

    sections: tuple[RoadSection, ...]
    demand: tuple[float, ...]
    """share of the capacity of the narrowest stretch, in parts of the episode that are equally long"""
    trucks: float = 0.0
    """share of the vehicles"""
    model: str = "EIDM"
    """car-following model of human drivers, in SUMO's words"""
    humans: IDMParameters = USUAL_HUMANS
    """its parameters; their desired speed is a limit in addition to that of the road"""
    speed_spread: float = 0.1
    """standard deviation of the factor by which drivers exceed the limit"""
    entry_speed: str = "avg"
    """speed at which vehicles enter, in SUMO's words or [m/s]"""

    @property
    def has_signals(self) -> bool:
        """Whether there is a signal."""
        return any(stretch.has_signal for stretch in self.sections)

    def free_speed(self, begin: float, end: float) -> float:
        """Return how fast cars drive alone on the slowest stretch between two places along the road [m/s]."""
        ends = accumulate(stretch.length for stretch in self.sections)
        limits = [
            stretch.speed
            for stretch, last in zip(self.sections, ends, strict=True)
            if last > begin and last - stretch.length < end
        ]
        return min(*limits, self.humans.desired_speed)

    @property
    def capacity(self) -> float:
        """The highest flow at which cars can follow each other evenly, on the narrowest stretch [veh/h]."""
        return 3600.0 * min(each.lanes * self._highest_flow(each.speed) for each in self.sections)

    def _highest_flow(self, limit: float) -> float:
        fastest = min(limit, self.humans.desired_speed)
        humans = IDMParameters(fastest, self.humans.time_headway, minimum_gap=self.humans.minimum_gap)
        speeds = np.arange(1.0, fastest, 0.25).tolist()
        return max(speed / (CAR_LENGTH + equilibrium_gap(speed, humans)) for speed in speeds)


def _make_road(
    demand: float | tuple[float, ...], *sections: RoadSection, **changes: float | str | IDMParameters
) -> OpenTestRoad:
    """Return a road from its stretches, with one demand or several."""
    return OpenTestRoad(sections, demand if isinstance(demand, tuple) else (demand,), **changes)  # pyright: ignore[reportArgumentType]


OVERLOAD_DEMAND = (1.1, 1.1, 1.1, 0.5)
"""demand that no bottleneck carries, and less in the end"""
OPEN_TEST_ROADS: dict[str, OpenTestRoad] = {
    "limit far above the flow": _make_road(
        1.0, RoadSection(5000, 3, 40), model="IDM", humans=CALM_HUMANS, speed_spread=0.0, entry_speed="24"
    ),
    "the same, demand that rises": _make_road((0.4, 0.95), RoadSection(4000, 3, 40), model="IDM", humans=CALM_HUMANS),
    "a calm two-lane road": _make_road(0.3, RoadSection(4000, 2, 25)),
    "one lane, calm": _make_road(0.5, RoadSection(4000, 1, 28)),
    "one lane, nearly full": _make_road(0.9, RoadSection(4000, 1, 33)),
    "five lanes": _make_road(0.85, RoadSection(3500, 5, 36)),
    "no need of the limit": _make_road(0.7, RoadSection(4000, 3, 45)),
    "trucks": _make_road(0.75, RoadSection(4000, 2, 36), trucks=0.25),
    "curves": _make_road(
        0.8,
        *(
            RoadSection(1300, 2, 36),
            RoadSection(500, 2, 22, 35),
            RoadSection(900, 2, 36, 35),
            RoadSection(500, 2, 25, -40),
        ),
        RoadSection(1000, 2, 36, -40),
    ),
    "a lower limit ahead": _make_road(0.95, RoadSection(2500, 3, 40), RoadSection(1500, 3, 25)),
    "on-ramp with reserve": _make_road(
        0.7, RoadSection(2500, 3, 36), RoadSection(300, 4, 36, ramp_flow=0.15), RoadSection(1200, 3, 36)
    ),
    "on-ramp, overloaded": _make_road(
        OVERLOAD_DEMAND, RoadSection(3000, 2, 33), RoadSection(300, 3, 33, ramp_flow=0.25), RoadSection(1200, 2, 33)
    ),
    "lane drop with reserve": _make_road(0.7, RoadSection(2500, 4, 33), RoadSection(1500, 3, 33)),
    "lane drop, overloaded": _make_road(OVERLOAD_DEMAND, RoadSection(3000, 3, 33), RoadSection(1000, 2, 33)),
    "arterial with signals": _make_road(
        0.35, *(RoadSection(700, 2, 25, has_signal=True) for _ in range(4)), RoadSection(700, 2, 25)
    ),
}
"""by name"""


def write_road_files(road: OpenTestRoad, folder: Path) -> Path:
    """Write the files of a road into a folder, and return its configuration."""
    main = [f"main{number}" for number in range(len(road.sections))]
    routes = {"main": (main, 1.0 - sum(stretch.ramp_flow for stretch in road.sections))}
    nodes, edges, links, flows = list[str](), list[str](), list[str](), list[tuple[float, str]]()
    x = y = heading = 0.0
    for number, stretch in enumerate(road.sections):
        before = road.sections[number - 1] if number else None
        signal = before is not None and before.has_signal
        nodes.append(_node_element(f"n{number}", x, y, "traffic_light" if signal else "priority"))
        edges.append(_edge_element(main[number], f"n{number}", f"n{number + 1}", stretch))
        if before:
            more = stretch.lanes - before.lanes
            pairs = [(lane, lane + more) for lane in range(before.lanes) if lane + more >= 0]
            links += [_connection_element(main[number - 1], main[number], lane, other) for lane, other in pairs]
        if signal:
            nodes += [_node_element(f"south{number}", x, y - 300.0), _node_element(f"north{number}", x, y + 300.0)]
            crossing = [f"in{number}", f"out{number}"]
            edges.append(_edge_element(crossing[0], f"south{number}", f"n{number}", SIDE_ROAD_SECTION))
            edges.append(_edge_element(crossing[1], f"n{number}", f"north{number}", SIDE_ROAD_SECTION))
            links.append(_connection_element(crossing[0], crossing[1], 0, 0))
            routes[f"crossing{number}"] = (crossing, CROSSING_SHARE)
        if stretch.ramp_flow:
            nodes.append(_node_element(f"ramp{number}", x - 400.0, y - 80.0))
            edges.append(_edge_element(f"ramp{number}", f"ramp{number}", f"n{number}", SIDE_ROAD_SECTION))
            links.append(_connection_element(f"ramp{number}", main[number], 0, 0))
            routes[f"ramp{number}"] = ([f"ramp{number}", *main[number:]], stretch.ramp_flow)
        heading += math.radians(stretch.turn)
        x, y = x + stretch.length * math.cos(heading), y + stretch.length * math.sin(heading)
    nodes.append(_node_element(f"n{len(main)}", x, y))
    parts, shares = len(road.demand), {"car": 1.0 - road.trucks, "truck": road.trucks}
    for (name, (_, share)), part, kind in product(routes.items(), range(parts), shares):
        begin, end = EPISODE_SECONDS * part / parts, EPISODE_SECONDS * (part + 1) / parts
        flow = road.demand[part] * road.capacity * share * shares[kind]
        if flow:
            about = {"id": f"{name}.{part}.{kind}", "type": kind, "route": name, "begin": begin, "end": end}
            enters = {"departLane": "best", "departSpeed": road.entry_speed}
            flows.append((begin, xml_element("flow", **about, vehsPerHour=round(flow, 1), **enters)))
    inputs = {
        ("--node-files", "road.nod.xml"): _xml_document("nodes", nodes),
        ("--edge-files", "road.edg.xml"): _xml_document("edges", edges),
        ("--connection-files", "road.con.xml"): _xml_document("connections", links),
    }
    network = run_netconvert(inputs, NETCONVERT_OPTIONS, folder)
    ways = [xml_element("route", id=name, edges=" ".join(way)) for name, (way, _) in routes.items()]
    traffic = [*_vehicle_types(road), *ways, *(flow for _, flow in sorted(flows))]
    (folder / "road.rou.xml").write_text(_xml_document("routes", traffic))
    path = folder / "road.sumocfg"
    options = {
        "net-file": network.name,
        "route-files": "road.rou.xml",
        "end": EPISODE_SECONDS,
        "step-length": HARM_SIMULATION_STEP,
    }
    lines = [xml_element(name, value=value) for name, value in options.items()]
    path.write_text(_xml_document("configuration", lines))
    return path


def _xml_document(root: str, elements: Sequence[str]) -> str:
    return f"<{root}>{''.join(elements)}</{root}>"


def _node_element(name: str, x: float, y: float, kind: str = "priority") -> str:
    return xml_element("node", id=name, x=round(x, 2), y=round(y, 2), type=kind)


def _edge_element(name: str, start: str, end: str, section: RoadSection) -> str:
    ends = {"from": start, "to": end}
    return xml_element("edge", id=name, **ends, numLanes=section.lanes, speed=section.speed, priority=3)


def _connection_element(start: str, end: str, lane: int, next_lane: int) -> str:
    return xml_element("connection", **{"from": start, "to": end}, fromLane=lane, toLane=next_lane)


def _vehicle_types(road: OpenTestRoad) -> Iterator[str]:
    """Yield the vehicle types: trucks follow as cars do, and are longer and slower."""
    humans = road.humans
    shared = {
        "carFollowModel": road.model,
        "tau": humans.time_headway,
        "minGap": humans.minimum_gap,
        "decel": humans.comfortable_deceleration,
        "speedDev": road.speed_spread,
    }
    fast = {"accel": humans.max_acceleration, "maxSpeed": humans.desired_speed}
    slow = {"accel": humans.max_acceleration / 2.0, "maxSpeed": TRUCK_SPEED, "vClass": "truck"}
    yield xml_element("vType", id="car", length=CAR_LENGTH, **shared, **fast)
    yield xml_element("vType", id="truck", length=TRUCK_LENGTH, **shared, **slow)
