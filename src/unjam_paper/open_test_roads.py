"""Files of small SUMO networks, as a user would write them, and the open roads of the study `do-no-harm`."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from unjam.physics.idm import IDMParameters, equilibrium_gap
from unjam.scenarios.road import Connection
from unjam.worlds.sumo.networks import run_netconvert, xml_document, xml_element

EPISODE_SECONDS, ROAD_SIMULATION_STEP = 900.0, 0.5
"""duration of an episode, and simulation step [s]"""
CAR_LENGTH, TRUCK_LENGTH, TRUCK_SPEED = 4.8, 12.0, 24.0
"""lengths of vehicles [m]; speed limit of trucks [m/s]"""
CROSSING_SHARE = 0.05
"""demand on each crossing road, as a share of the demand on the main road"""
SIDE_ROAD = (1, 20.0)
"""lanes and speed limit [m/s] of ramps and of crossing roads"""
RoadNode = tuple[str, float, float, str]
"""name, position (x, y) [m] and SUMO's type"""
RoadEdge = tuple[str, str, str, int, float]
"""name, both nodes, lanes, and speed limit [m/s]"""


class RoadSection(NamedTuple):
    """A section of a road with constant lanes and speed limit; lanes begin and end on the right."""

    length: float
    """[m]"""
    lanes: int
    speed: float
    """speed limit [m/s]"""
    turn: float = 0.0
    """change of direction at the start of the section [degrees]"""
    ramp_flow: float = 0.0
    """share of all vehicles that enter from a ramp onto the rightmost lane, at the start of the section"""
    has_signal: bool = False
    """whether there is a signal at the end of the section"""


USUAL_HUMANS = IDMParameters(
    desired_speed=60.0, time_headway=1.4, max_acceleration=1.3, comfortable_deceleration=2.0, minimum_gap=2.2
)
"""human drivers that drive at the speed limit of each road"""
CALM_HUMANS = IDMParameters(
    desired_speed=35.5, time_headway=1.66, max_acceleration=2.37, comfortable_deceleration=3.2, minimum_gap=2.94
)
"""human drivers that drive far below a limit of 40 m/s if the flow is near capacity"""


@dataclass(frozen=True)
class OpenTestRoad:
    """A road and its demand."""

    sections: tuple[RoadSection, ...]
    demand: tuple[float, ...]
    """shares of the capacity of the narrowest section, in equal periods of the episode"""
    trucks: float = 0.0
    """share of trucks among the vehicles"""
    model: str = "EIDM"
    """car-following model of human drivers (SUMO's name)"""
    humans: IDMParameters = USUAL_HUMANS
    """parameters of the human drivers; the desired speed is a limit in addition to that of the road"""
    speed_spread: float = 0.1
    """standard deviation of the speed factor of drivers"""
    entry_speed: str = "avg"
    """departSpeed of SUMO: a name or a speed [m/s]"""

    @property
    def has_signals(self) -> bool:
        """Whether the road has a traffic signal."""
        return any(section.has_signal for section in self.sections)

    def free_speed(self, begin: float, end: float) -> float:
        """Return the free-flow speed of cars on the slowest section between two positions [m/s]."""
        ends = accumulate(section.length for section in self.sections)
        limits = [
            section.speed
            for section, section_end in zip(self.sections, ends, strict=True)
            if section_end > begin and section_end - section.length < end
        ]
        return min(*limits, self.humans.desired_speed)

    @property
    def capacity(self) -> float:
        """The maximum steady flow of equally spaced cars, on the narrowest section [veh/h]."""
        return 3600.0 * min(section.lanes * self._highest_flow(section.speed) for section in self.sections)

    def _highest_flow(self, limit: float) -> float:
        """Return the maximum steady flow of a lane with a speed limit [veh/s]."""
        max_speed = min(limit, self.humans.desired_speed)
        humans = IDMParameters(max_speed, self.humans.time_headway, minimum_gap=self.humans.minimum_gap)
        speeds = np.arange(1.0, max_speed, 0.25).tolist()
        return max(speed / (CAR_LENGTH + equilibrium_gap(speed, humans)) for speed in speeds)


def _make_road(demand: float | tuple[float, ...], *sections: RoadSection, **changes: Any) -> OpenTestRoad:
    return OpenTestRoad(sections, demand if isinstance(demand, tuple) else (demand,), **changes)


OVERLOAD_DEMAND = (1.1, 1.1, 1.1, 0.5)
"""demand above the capacity, with a lower demand at the end"""
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
        *(0.8, RoadSection(1300, 2, 36), RoadSection(500, 2, 22, 35), RoadSection(900, 2, 36, 35)),
        *(RoadSection(500, 2, 25, -40), RoadSection(1000, 2, 36, -40)),
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


def write_road_files(road: OpenTestRoad, folder: Path) -> Path:
    """Write the files of a road into a folder, and return the path of its configuration."""
    main = [f"main{number}" for number in range(len(road.sections))]
    routes = {"main": (main, 1.0 - sum(section.ramp_flow for section in road.sections))}
    nodes, edges, links = list[RoadNode](), list[RoadEdge](), list[Connection]()
    x = y = heading = 0.0
    for number, section in enumerate(road.sections):
        previous = road.sections[number - 1] if number else None
        has_signal = previous is not None and previous.has_signal
        nodes.append((f"n{number}", round(x, 2), round(y, 2), "traffic_light" if has_signal else "priority"))
        edges.append((main[number], f"n{number}", f"n{number + 1}", section.lanes, section.speed))
        if previous:
            added = section.lanes - previous.lanes
            pairs = [(lane, lane + added) for lane in range(previous.lanes) if lane + added >= 0]
            links += [Connection(main[number - 1], main[number], *lanes) for lanes in pairs]
        if has_signal:
            nodes.append((f"south{number}", round(x, 2), round(y - 300.0, 2), "priority"))
            nodes.append((f"north{number}", round(x, 2), round(y + 300.0, 2), "priority"))
            crossing = [f"in{number}", f"out{number}"]
            edges.append((crossing[0], f"south{number}", f"n{number}", *SIDE_ROAD))
            edges.append((crossing[1], f"n{number}", f"north{number}", *SIDE_ROAD))
            links.append(Connection(crossing[0], crossing[1], 0, 0))
            routes[f"crossing{number}"] = (crossing, CROSSING_SHARE)
        if section.ramp_flow:
            ramp = f"ramp{number}"
            nodes.append((ramp, round(x - 400.0, 2), round(y - 80.0, 2), "priority"))
            edges.append((ramp, ramp, f"n{number}", *SIDE_ROAD))
            links.append(Connection(ramp, main[number], 0, 0))
            routes[ramp] = ([ramp, *main[number:]], section.ramp_flow)
        heading += math.radians(section.turn)
        x, y = x + section.length * math.cos(heading), y + section.length * math.sin(heading)
    nodes.append((f"n{len(main)}", round(x, 2), round(y, 2), "priority"))
    route_elements = [xml_element("route", id=name, edges=" ".join(route)) for name, (route, _) in routes.items()]
    shares = {name: share for name, (_, share) in routes.items()}
    traffic = [*_vehicle_types(road), *route_elements, *_flow_elements(road, shares)]
    # netconvert does not reduce the speed limits of curves.
    return write_network(folder, nodes, edges, links, traffic, "--junctions.limit-turn-speed=-1")


def _flow_elements(road: OpenTestRoad, shares: Mapping[str, float]) -> list[str]:
    """Return the flows of each route, period and vehicle type in the order of their begin."""
    type_shares, periods = {"car": 1.0 - road.trucks, "truck": road.trucks}, len(road.demand)
    flows = list[tuple[float, str]]()
    for (route, share), period, vehicle_type in product(shares.items(), range(periods), type_shares):
        begin, end = EPISODE_SECONDS * period / periods, EPISODE_SECONDS * (period + 1) / periods
        flow = road.demand[period] * road.capacity * share * type_shares[vehicle_type]
        if flow:
            attributes = {"id": f"{route}.{period}.{vehicle_type}", "type": vehicle_type, "route": route}
            attributes |= {"begin": begin, "end": end, "vehsPerHour": round(flow, 1)}
            attributes |= {"departLane": "best", "departSpeed": road.entry_speed}
            flows.append((begin, xml_element("flow", **attributes)))
    return [element for _, element in sorted(flows)]


def _vehicle_types(road: OpenTestRoad) -> Iterator[str]:
    """Yield the vehicle types; trucks have the following parameters of cars, and are longer and slower."""
    humans = road.humans
    shared = {"carFollowModel": road.model, "tau": humans.time_headway, "minGap": humans.minimum_gap}
    shared |= {"decel": humans.comfortable_deceleration, "speedDev": road.speed_spread}
    car_limits = {"accel": humans.max_acceleration, "maxSpeed": humans.desired_speed}
    truck_limits = {"accel": humans.max_acceleration / 2.0, "maxSpeed": TRUCK_SPEED, "vClass": "truck"}
    yield xml_element("vType", id="car", length=CAR_LENGTH, **shared, **car_limits)
    yield xml_element("vType", id="truck", length=TRUCK_LENGTH, **shared, **truck_limits)


def write_network(
    folder: Path,
    nodes: Sequence[RoadNode],
    edges: Sequence[RoadEdge],
    connections: Sequence[Connection],
    traffic: Sequence[str],
    *options: str,
) -> Path:
    """Write a network, made with options of netconvert, and its traffic; return the path of the configuration."""
    tables = (
        ("node", "nod", ("id", "x", "y", "type"), nodes),
        ("edge", "edg", ("id", "from", "to", "numLanes", "speed", "priority"), [(*edge, 3) for edge in edges]),
        ("connection", "con", ("from", "to", "fromLane", "toLane"), connections),
    )
    inputs = {
        (f"--{tag}-files", f"road.{suffix}.xml"): xml_document(
            f"{tag}s", tag, [dict(zip(names, row, strict=True)) for row in rows]
        )
        for tag, suffix, names, rows in tables
        if rows
    }
    run_netconvert(inputs, ["--no-turnarounds=true", *options], folder)
    routes = f"<routes>{''.join(traffic)}</routes>"
    (folder / "road.rou.xml").write_text(routes)
    return write_configuration(folder, {})


def write_configuration(folder: Path, options: Mapping[str, str]) -> Path:
    """Write the SUMO configuration of `road.net.xml` and `road.rou.xml`, and return its path."""
    files = {"net-file": "road.net.xml", "route-files": "road.rou.xml"}
    values = {**files, "end": EPISODE_SECONDS, "step-length": ROAD_SIMULATION_STEP, **options}
    path = folder / "road.sumocfg"
    lines = "".join(xml_element(name, value=value) for name, value in values.items())
    path.write_text(f"<configuration>{lines}</configuration>")
    return path
