"""The figure eight: a closed road that crosses itself, where one direction must yield to the other."""

from math import pi
from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from unjam.parameters import STRICT, NonNegative, NumberOrRange, PositiveInt, parameter_dataclass
from unjam.physics.arrays import Array, Floats
from unjam.physics.idm import equilibrium_speed
from unjam.scenarios.ring import EdgeSpan, LoopScenario
from unjam.scenarios.road import ClosedRoad, Connection, Edge, Node, Polyline, RoadNetwork, to_polyline
from unjam.scenarios.scenario import VEHICLE_LENGTH, Horizon, HumanControl

Radius = Annotated[int, Field(ge=15, le=10_000_000)]
"""radius of a figure eight [m]"""
CROSSING_RADIUS = 3.1
"""radius of the node at the crossing [m], as in Flow"""
CROSSING_LINK = 9.4
"""length of a lane across the junction [m], as netconvert makes it from that radius"""
INNER_LINK, OUTER_LINK = 0.222837, 0.1
"""lengths of the links at both ends of the upper and of the lower arc [m], as netconvert makes them for lanes on the
right side of the line of an edge"""
UPPER_ARC, LOWER_ARC = (1.0, pi, -pi / 2), (-1.0, pi / 2, 2 * pi)
"""arcs of a figure eight: x = y of the center [radii], first and last angle [rad]"""
ARC_POINTS = 61
"""points of each arc; the lengths of the links depend on it"""
MAJOR_PRIORITY, MINOR_PRIORITY = 78, 46
"""priorities of the direction with the right of way (bottom to top) and of the crossing direction, as in Flow"""


def figure_eight_length(radius: float) -> float:
    """Return the length of a lap of the figure eight [m], links across the junctions included."""
    return _edge_length(radius) + 2 * (CROSSING_LINK + INNER_LINK + OUTER_LINK)


def figure_eight_radius(length: Array) -> Array:
    """Return the radius of figure eights with laps of a given length [m]; the inverse of `figure_eight_length`."""
    return (length - 2 * (CROSSING_LINK + INNER_LINK + OUTER_LINK)) / (4 + 3 * pi)


def lane_lengths(radius: Array) -> tuple[Array, ...]:
    """Return the lengths of all lanes in driving order [m]: an edge, the link after it, and so on."""
    arc = 1.5 * pi * radius
    upper = radius, CROSSING_LINK, radius, INNER_LINK, arc, INNER_LINK
    return *upper, radius, CROSSING_LINK, radius, OUTER_LINK, arc, OUTER_LINK


@parameter_dataclass(frozen=True, config=STRICT)
class FigureEight(LoopScenario):
    """Two loops of equal radius that cross at a junction without signals; each episode draws the radius.

    The paper's figure eight has 14 vehicles, one of them a CAV, and radii of 32 to 35 m; Flow's benchmark 30 m.
    Vehicles pass the crossing twice a lap, and vehicles from the right yield to vehicles from below. A queue longer
    than half a lap meets its own tail at the crossing, and all vehicles stop and start.
    """

    title: ClassVar[str] = "figure-eight"
    reward: ClassVar[str] = "released"
    size_parameter: ClassVar[str] = "radius"
    is_first_leading: ClassVar[bool] = True
    description: ClassVar[str] = "figure eight with radius {} m"
    limit_description: ClassVar = "the speed at which the queue of all vehicles just clears the crossing in half a lap"

    radius: Annotated[tuple[Radius, Radius], NumberOrRange] = (32, 35)
    """range of the radius, drawn uniformly among its integers; or a single radius [m]"""
    vehicles: Annotated[int, Field(ge=2)] = 14
    cavs: PositiveInt = 1
    """number of CAVs, evenly spread; the first CAV leads the queue"""
    free_length: NonNegative = 50.0
    """length of free road ahead of the first vehicle at the start [m]; `bunching` in Flow"""
    horizon: Horizon = 1500
    """control steps in an episode"""
    human_control: HumanControl = "commanded"
    impatience: Annotated[float, Field(ge=0, le=1)] = 0.5

    @model_validator(mode="after")
    def _check_length(self) -> Self:
        length = _edge_length(self.radius[0]) - self.free_length
        if length < self._min_length:
            raise ValueError(
                f"radius: {self.radius[0]} m is not allowed for {self.vehicles} vehicles: they need "
                f"{self._min_length:g} m of road, but {length:.0f} m are available"
            )
        return self

    def build(self, size: float) -> ClosedRoad:
        """Return the figure eight of a given radius [m] with its vehicles."""
        spans = _edge_spans(size)
        # As in Flow, vehicles start on the edges only, not on the links across the junctions.
        spacing = (_edge_length(size) - self.free_length) / self.vehicles
        positions = np.arange(self.vehicles, dtype=np.float64) * spacing
        edges = np.searchsorted([span.start for span in spans], positions, side="right") - 1
        positions_on_edges = np.minimum(positions, np.array([span.end for span in spans])[edges])
        bottom, top, upper, right, left, lower = spans
        upper_arc, lower_arc = _arc_points(size, *UPPER_ARC), _arc_points(size, *LOWER_ARC)
        center_line_parts = [
            [(bottom.start, 0.0, -size), (top.end, 0.0, size)],
            np.column_stack([np.linspace(upper.start, upper.end, ARC_POINTS), upper_arc]),
            [(right.start, size, 0.0), (left.end, -size, 0.0)],
            np.column_stack([np.linspace(lower.start, lower.end, ARC_POINTS), lower_arc]),
            [(figure_eight_length(size), 0.0, -size)],
        ]
        return self._closed_road(
            size,
            spans,
            positions_on_edges,
            loop_length=figure_eight_length(size),
            network=_figure_eight_network(size, to_polyline(upper_arc), to_polyline(lower_arc), self.top_speed),
            center_line=np.vstack(center_line_parts),
            crossings=((bottom.end, top.start), (right.end, left.start)),
        )

    def limit_speed(self, size: float) -> float:
        """Return the speed at which a queue at equilibrium just clears the crossing before its head returns [m/s].

        The queue and the crossing fill half a lap; vehicles that must yield need more time, so the real limit is lower.
        """
        queue = _edge_length(size) / 2 - CROSSING_LINK
        return equilibrium_speed(queue / self.vehicles - VEHICLE_LENGTH, self.humans)


def _edge_length(radius: float) -> float:
    return 4 * radius + 3 * pi * radius


def _edge_spans(radius: float) -> list[EdgeSpan]:
    """Return the edges in driving order; gaps between edges are the links of the junctions."""
    lengths = lane_lengths(radius)
    spans, start = [], 0.0
    for index, name in enumerate(("bottom", "top", "upper_ring", "right", "left", "lower_ring")):
        length, link = lengths[2 * index : 2 * index + 2]
        spans.append(EdgeSpan(name, start, length))
        start += length + link
    return spans


def _arc_points(radius: float, center: float, first_angle: float, last_angle: float) -> Floats:
    angles = np.linspace(first_angle, last_angle, ARC_POINTS)
    return radius * np.column_stack([np.cos(angles) + center, np.sin(angles) + center])


def _figure_eight_network(radius: float, upper: Polyline, lower: Polyline, speed: float) -> RoadNetwork:
    ends = {"right": (radius, 0.0), "top": (0.0, radius), "left": (-radius, 0.0), "bottom": (0.0, -radius)}
    center = Node("center", 0.0, 0.0, has_priority=True, radius=CROSSING_RADIUS)
    nodes = (center, *(Node(f"at_{name}", x, y, has_priority=True) for name, (x, y) in ends.items()))
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
