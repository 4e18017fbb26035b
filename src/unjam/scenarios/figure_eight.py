"""The figure eight: a closed road that crosses itself, where one direction yields to the other."""

from math import pi
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from unjam.parameters import STRICT, NonNegative, NumberOrRange, PositiveInt
from unjam.physics.arrays import Array
from unjam.physics.idm import equilibrium_speed
from unjam.scenarios.ring import EdgeSpan, LoopLayout, LoopScenario
from unjam.scenarios.road import Connection, Edge, Node, Polyline, RoadNetwork, as_polyline
from unjam.scenarios.scenario import VEHICLE_LENGTH, HumanControl

CROSSING_RADIUS = 3.1
"""of the node where the ways of a figure eight cross [m], as Flow's"""
CROSSING_LINK = 9.4
"""length of a way across, as netconvert makes it from that radius [m]"""
INNER_LINK, OUTER_LINK = 0.222837, 0.1
"""lengths of the links at both ends of the upper and of the lower arc, as netconvert makes them [m]: the lane
lies to the right of the line"""
UPPER_ARC, LOWER_ARC = (1.0, pi, -pi / 2), (-1.0, pi / 2, 2 * pi)
"""of a figure eight: both coordinates of the centre [radii], first and last angle [rad]"""
ARC_POINTS = 61
"""points of each arc; the lengths of the links depend on it"""
MAJOR_PRIORITY, MINOR_PRIORITY = 78, 46
"""priorities of the way that goes first (bottom to top) and of the one that yields, as Flow's"""


def figure_eight_length(radius: float) -> float:
    """Return the length of a lap of the figure eight [m], ways across the junctions included."""
    return _edge_length(radius) + 2 * (CROSSING_LINK + INNER_LINK + OUTER_LINK)


def figure_eight_radius(length: Array) -> Array:
    """Return the radius of figures eight whose laps are so long [m]; the reverse of `loop_length`."""
    return (length - 2 * (CROSSING_LINK + INNER_LINK + OUTER_LINK)) / (4 + 3 * pi)


def lane_lengths(radius: Array) -> tuple[Array, ...]:
    """Return the lengths of all lanes in driving order [m]: an edge, the link behind it, and so on."""
    arc = 1.5 * pi * radius
    upper = radius, CROSSING_LINK, radius, INNER_LINK, arc, INNER_LINK
    return *upper, radius, CROSSING_LINK, radius, OUTER_LINK, arc, OUTER_LINK


@dataclass(frozen=True, config=STRICT)
class FigureEight(LoopScenario):
    """Two loops of equal radius that cross at a junction without signals; the radius is new in each episode.

    The paper's has 14 vehicles, one of them a CAV, and radii of 32 to 35 m; Flow's benchmark 30 m. All pass
    the crossing twice a lap, and those from the right yield to those from below: a queue that is longer than
    half a lap meets its own tail there, and everybody stops and starts.
    """

    title: ClassVar[str] = "figure-eight"
    reward: ClassVar[str] = "released"
    size_parameter: ClassVar[str] = "radius"
    is_first_leading: ClassVar[bool] = True
    description: ClassVar[str] = "figure eight with radius {} m"
    limit_description: ClassVar[str] = (
        "the speed at which the queue of all vehicles just clears the crossing in half a lap"
    )

    radius: Annotated[tuple[Annotated[int, Field(ge=15)], Annotated[int, Field(ge=15)]], NumberOrRange] = (32, 35)
    """smallest and largest radius, drawn uniformly among the integers between them; or one [m]"""
    vehicles: Annotated[int, Field(ge=2)] = 14
    cavs: PositiveInt = 1
    """vehicles that are CAVs, evenly spread; the first leads the queue"""
    free_length: NonNegative = 50.0
    """road left free ahead of the first vehicle at the start [m]; Flow's `bunching`"""
    horizon: PositiveInt = 1500
    """decisions in an episode"""
    human_control: HumanControl = "commanded"
    impatience: Annotated[float, Field(ge=0, le=1)] = 0.5

    @model_validator(mode="after")
    def _check_length(self) -> "FigureEight":
        room = _edge_length(self.radius[0]) - self.free_length
        if room < self._min_length:
            raise ValueError(
                f"radius: {self.radius[0]} m is not allowed for {self.vehicles} vehicles: they need "
                f"{self._min_length:g} m of road, there are {room:.0f} m"
            )
        return self

    def layout(self, size: float) -> LoopLayout:
        """Return the figure eight of a radius [m]."""
        places = _edge_spans(size)
        # As in Flow, the ways across the junctions are left out of what is shared among the vehicles.
        spacing = (_edge_length(size) - self.free_length) / self.vehicles
        positions = np.arange(self.vehicles, dtype=np.float64) * spacing
        edge = np.searchsorted([place.start for place in places], positions, side="right") - 1
        before_links = np.minimum(positions, np.array([place.end for place in places])[edge])
        bottom, top, upper, right, left, lower = places
        upper_arc, lower_arc = _arc_points(size, *UPPER_ARC), _arc_points(size, *LOWER_ARC)
        lines = [
            [(bottom.start, 0.0, -size), (top.end, 0.0, size)],
            np.column_stack([np.linspace(upper.start, upper.end, ARC_POINTS), upper_arc]),
            [(right.start, size, 0.0), (left.end, -size, 0.0)],
            np.column_stack([np.linspace(lower.start, lower.end, ARC_POINTS), lower_arc]),
            [(figure_eight_length(size), 0.0, -size)],
        ]
        return LoopLayout(
            places,
            figure_eight_length(size),
            before_links,
            _network(size, as_polyline(upper_arc), as_polyline(lower_arc), self.top_speed),
            np.vstack(lines),
            crossings=((bottom.end, top.start), (right.end, left.start)),
        )

    def limit_speed(self, size: float) -> float:
        """Return the speed at which a queue at equilibrium just clears the crossing before its head is back.

        The queue of all vehicles at the IDM's equilibrium gaps and the crossing fill half a lap. Vehicles
        that yield want some seconds in hand, so that the real limit is lower.
        """
        queue = _edge_length(size) / 2 - CROSSING_LINK
        return equilibrium_speed(queue / self.vehicles - VEHICLE_LENGTH, self.humans)


def _edge_length(radius: float) -> float:
    return 4 * radius + 3 * pi * radius


def _edge_spans(radius: float) -> list[EdgeSpan]:
    """Return the edges in driving order; between them lie the links of the junctions."""
    names = "bottom", "top", "upper_ring", "right", "left", "lower_ring"
    lengths = lane_lengths(radius)
    edges, start = [], 0.0
    for name, length, link in zip(names, lengths[::2], lengths[1::2], strict=True):
        edges.append(EdgeSpan(name, start, length))
        start += length + link
    return edges


def _arc_points(radius: float, center: float, first: float, last: float) -> NDArray[np.float64]:
    angles = np.linspace(first, last, ARC_POINTS)
    return radius * np.column_stack([np.cos(angles) + center, np.sin(angles) + center])


def _network(radius: float, upper: Polyline, lower: Polyline, speed: float) -> RoadNetwork:
    places = {"right": (radius, 0.0), "top": (0.0, radius), "left": (-radius, 0.0), "bottom": (0.0, -radius)}
    center = Node("center", 0.0, 0.0, has_priority=True, radius=CROSSING_RADIUS)
    nodes = (center, *(Node(f"at_{name}", x, y, has_priority=True) for name, (x, y) in places.items()))
    arc = 1.5 * pi * radius
    edges = (
        Edge("bottom", "at_bottom", "center", radius, MAJOR_PRIORITY),
        Edge("top", "center", "at_top", radius, MAJOR_PRIORITY),
        Edge("right", "at_right", "center", radius, MINOR_PRIORITY),
        Edge("left", "center", "at_left", radius, MINOR_PRIORITY),
        Edge("upper_ring", "at_top", "at_right", arc, MAJOR_PRIORITY, upper),
        Edge("lower_ring", "at_left", "at_bottom", arc, MAJOR_PRIORITY, lower),
    )
    return RoadNetwork(nodes, edges, speed, connections=(Connection("bottom", "top"), Connection("right", "left")))
