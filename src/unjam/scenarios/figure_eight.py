"""The figure eight: a closed road that crosses itself, where one direction yields to the other."""

from dataclasses import replace
from math import pi
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from unjam.parameters import STRICT, Count, NotNegative
from unjam.physics.idm import equilibrium_speed
from unjam.scenarios.road import (
    ClosedRoad,
    Edge,
    Network,
    Node,
    Place,
    cavs_among,
    check_counts,
    loop_entries,
    part_of_range,
    vehicle_names,
    words_of_range,
)
from unjam.scenarios.scenario import VEHICLE_LENGTH, Actuation, People, Scenario

CROSSING_RADIUS = 3.1
"""of the node where the ways cross [m], as Flow's"""
CROSSING_LINK = 9.4
"""length of a way across, as netconvert makes it from that radius [m]"""
INNER_LINK, OUTER_LINK = 0.222837, 0.1
"""lengths of the links at both ends of the upper and of the lower arc, as netconvert makes them [m]: the lane
lies to the right of the line"""
ARC_POINTS = 61
"""points of each arc; the lengths of the links depend on it"""
MAJOR, MINOR = 78, 46
"""priorities of the way that goes first (bottom to top) and of the one that yields, as Flow's"""


@dataclass(frozen=True, config=STRICT)
class FigureEight(Scenario):
    """Two loops of equal radius that cross at a junction without signals; the radius is new in each episode.

    The paper's has 14 vehicles, one of them a CAV, and radii of 32 to 35 m; Flow's benchmark 30 m. All pass
    the crossing twice a lap, and those from the right yield to those from below: a queue that is longer than
    half a lap meets its own tail there, and everybody stops and starts.
    """

    title: ClassVar[str] = "figure-eight"
    reward: ClassVar[str] = "released"

    radius: tuple[Annotated[int, Field(ge=15)], Annotated[int, Field(ge=15)]] = (32, 35)
    """smallest and largest radius, drawn uniformly among the integers between them [m]"""
    vehicles: Annotated[int, Field(ge=2)] = 14
    """on the road, CAVs among them"""
    cavs: Count = 1
    """vehicles that are CAVs, evenly spread; the first leads the queue"""
    free_ahead: NotNegative = 50.0
    """road left free ahead of the first vehicle at the start [m]; Flow's `bunching`"""
    horizon: Count = 1500
    """decisions in an episode"""
    actuation: Actuation = "flow"
    people: People = "commanded"
    impatience: Annotated[float, Field(ge=0, le=1)] = 0.5

    @model_validator(mode="after")
    def _fits(self) -> "FigureEight":
        check_counts("radius", self.radius, self.vehicles, self.cavs)
        room = _edge_length(self.radius[0]) - self.free_ahead
        needed = self.vehicles * (VEHICLE_LENGTH + self.humans.minimum_gap)
        if room < needed:
            raise ValueError(
                f"radius: {self.radius[0]} m is not allowed for {self.vehicles} vehicles: they need "
                f"{needed:g} m of road, there are {room:.0f} m"
            )
        return self

    def draw(self, generator: np.random.Generator) -> ClosedRoad:
        """Return a figure eight of random radius with its vehicles."""
        radius = int(generator.integers(self.radius[0], self.radius[1], endpoint=True))
        length = loop_length(radius)
        edges = _loop(radius)
        ids = vehicle_names(self.vehicles, self.cavs)[::-1]  # the first is in front
        # As in Flow, the ways across the junctions are left out of what is shared among the vehicles.
        spacing = (_edge_length(radius) - self.free_ahead) / self.vehicles
        positions = _on_edges(np.arange(self.vehicles, dtype=np.float64) * spacing, edges)
        bottom, top, _, right, left, _ = edges
        people = self.draw_people(ids, generator)
        routes, entries = loop_entries(edges, ids, positions, self.seconds, self.top_speed)
        return ClosedRoad(
            network=_network(radius, self.top_speed),
            routes=routes,
            entries=entries,
            vehicle_ids=ids,
            cav_ids=cavs_among(ids),
            start_positions=positions,
            loop_length=length,
            crossings=((bottom.start + bottom.length, top.start), (right.start + right.length, left.start)),
            limit_speed=self.limit(radius),
            outline=_outline(radius, edges),
            drawn={"radius": float(radius)},
            people=people,
        )

    def limit(self, radius: int) -> float:
        """Return the speed at which a queue at equilibrium just clears the crossing before its head is back.

        The queue of all vehicles at the IDM's equilibrium gaps and the crossing fill half a lap. Vehicles
        that yield want some seconds in hand, so that the real limit is lower.
        """
        queue = _edge_length(radius) / 2 - CROSSING_LINK
        return equilibrium_speed(queue / self.vehicles - VEHICLE_LENGTH, self.humans)

    @property
    def drawn_ranges(self) -> dict[str, tuple[float, float]]:
        """The radius."""
        return {"radius": self.radius}

    def part(self, index: int, count: int) -> "FigureEight":
        """Return this road with one of `count` equal parts of its radii."""
        return replace(self, radius=part_of_range(self.radius, index, count))

    def possible_cavs(self) -> tuple[str, ...]:
        """Return the ids of the CAVs, the first in front."""
        return cavs_among(vehicle_names(self.vehicles, self.cavs)[::-1])

    def facts(self) -> list[tuple[str, str]]:
        """Return the road's own facts for `unjam scenarios`."""
        limits = "-".join(f"{self.limit(radius):.2f}" for radius in dict.fromkeys(self.radius))
        return [
            ("road", f"figure eight with radius {words_of_range(self.radius)} m"),
            ("vehicles", f"{self.vehicles} ({self.cavs} CAV)"),
            ("limit", f"{limits} m/s"),
            (
                "limit is",
                "the speed at which the queue of all vehicles just clears the crossing in half a lap",
            ),
        ]


def loop_length(radius: float) -> float:
    """Return the length of a lap [m], ways across the junctions included."""
    return _edge_length(radius) + 2 * (CROSSING_LINK + INNER_LINK + OUTER_LINK)


def _edge_length(radius: float) -> float:
    return 4 * radius + 3 * pi * radius


def _loop(radius: float) -> list[Place]:
    """Return the edges in driving order; between them lie the links of the junctions."""
    arc = 1.5 * pi * radius
    edges, start = [], 0.0
    for name, length, link in (
        ("bottom", radius, CROSSING_LINK),
        ("top", radius, INNER_LINK),
        ("upper_ring", arc, INNER_LINK),
        ("right", radius, CROSSING_LINK),
        ("left", radius, OUTER_LINK),
        ("lower_ring", arc, OUTER_LINK),
    ):
        edges.append(Place(name, start, float(length)))
        start += length + link
    return edges


def _on_edges(positions: np.ndarray, edges: list[Place]) -> np.ndarray:
    """Return positions moved off the junctions' links, to the end of the edge before."""
    ends = np.array([edge.start + edge.length for edge in edges])
    starts = np.array([edge.start for edge in edges])
    edge = np.searchsorted(starts, positions, side="right") - 1
    return np.minimum(positions, ends[edge])


def _network(radius: float, speed: float) -> Network:
    places = {"right": (radius, 0.0), "top": (0.0, radius), "left": (-radius, 0.0), "bottom": (0.0, -radius)}
    center = Node("center", 0.0, 0.0, priority=True, radius=CROSSING_RADIUS)
    nodes = (center, *(Node(f"at_{name}", x, y, priority=True) for name, (x, y) in places.items()))
    arc = 1.5 * pi * radius
    edges = (
        Edge("bottom", "at_bottom", "center", float(radius), MAJOR),
        Edge("top", "center", "at_top", float(radius), MAJOR),
        Edge("right", "at_right", "center", float(radius), MINOR),
        Edge("left", "center", "at_left", float(radius), MINOR),
        Edge("upper_ring", "at_top", "at_right", arc, MAJOR, tuple(map(tuple, _upper_arc(radius).tolist()))),
        Edge(
            "lower_ring", "at_left", "at_bottom", arc, MAJOR, tuple(map(tuple, _lower_arc(radius).tolist()))
        ),
    )
    return Network(nodes, edges, speed, connections=(("bottom", "top"), ("right", "left")))


def _upper_arc(radius: float) -> np.ndarray:
    angles = np.linspace(pi, -pi / 2, ARC_POINTS)
    return radius * np.column_stack([1 + np.cos(angles), 1 + np.sin(angles)])


def _lower_arc(radius: float) -> np.ndarray:
    angles = np.linspace(pi / 2, 2 * pi, ARC_POINTS)
    return radius * np.column_stack([np.cos(angles) - 1, np.sin(angles) - 1])


def _outline(radius: float, edges: list[Place]) -> np.ndarray:
    """Return the centre line: rows (coordinate along the lap, x, y)."""
    bottom, top, upper, right, left, lower = edges
    rows = [
        (bottom.start, 0.0, -radius),
        (top.start + top.length, 0.0, radius),
        *zip(
            np.linspace(upper.start, upper.start + upper.length, ARC_POINTS),
            *_upper_arc(radius).T,
            strict=True,
        ),
        (right.start, radius, 0.0),
        (left.start + left.length, -radius, 0.0),
        *zip(
            np.linspace(lower.start, lower.start + lower.length, ARC_POINTS),
            *_lower_arc(radius).T,
            strict=True,
        ),
        (loop_length(radius), 0.0, -radius),
    ]
    return np.array(rows, dtype=np.float64)
