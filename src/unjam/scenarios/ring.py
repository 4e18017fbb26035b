"""Closed roads with one lane, among them the ring, which is too dense for stable traffic."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from unjam.drivers.safety import STANDARD_ACTUATOR, Actuator
from unjam.parameters import STRICT, NumberOrRange, PositiveInt, is_packaged, parameter_dataclass
from unjam.physics.arrays import Floats
from unjam.physics.idm import equilibrium_speed
from unjam.scenarios.road import ClosedRoad, Edge, Entry, Node, RoadNetwork, Route, to_polyline
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario

RING_EDGES = 4
"""number of edges of a ring"""
LoopSize = Annotated[int, Field(ge=10, le=10_000_000)]
"""length or radius of a closed road [m]"""
MAX_CACHED_ROADS = 256
"""maximum number of roads in the cache; the default ranges have fewer sizes"""


class EdgeSpan(NamedTuple):
    """An edge with its start and length along a closed road [m]."""

    name: str
    start: float
    length: float

    @property
    def end(self) -> float:
        """Position of the end [m]."""
        return self.start + self.length


@parameter_dataclass(frozen=True, config=STRICT)
class LoopScenario(Scenario):
    """A closed road; each episode draws its size."""

    size_parameter: ClassVar[str]
    """the parameter that is drawn, uniformly among the integers of its range [m]"""
    description: ClassVar[str]
    """format string that describes the road; `{}` stands for the size"""
    limit_description: ClassVar[str]
    """definition of the limit speed"""
    road_model: ClassVar[str] = "closed"
    is_first_leading: ClassVar[bool] = False
    """whether vehicle 0 is the first of the queue at the start; otherwise it is the last"""

    vehicles: Annotated[int, Field(ge=2)] = 22
    """number of vehicles, CAVs included"""
    cavs: PositiveInt = 1
    """number of CAVs, evenly spread"""
    actuator: Actuator = STANDARD_ACTUATOR
    """delay and lag of a CAV's response to commands, by default those of a usual car"""

    @model_validator(mode="after")
    def _check_counts(self) -> Self:
        low, high = self._size_range
        if high < low:
            raise ValueError(f"{self.size_parameter}: {high} m is not allowed as the largest; allowed: >= {low} m")
        if self.cavs > self.vehicles:
            raise ValueError(f"cavs: {self.cavs} is not allowed; allowed: <= vehicles, {self.vehicles}")
        if self.human_control == "native" and self.driver_population and self.driver_population.residual is not None:
            raise ValueError(
                "human_control: native is not allowed for a population with a residual network, which SUMO's own IDM "
                "cannot apply; allowed: commanded"
            )
        return self

    @property
    def max_vehicles(self) -> float:
        """Number of vehicles on the road."""
        return self.vehicles

    def build(self, size: float) -> ClosedRoad:
        """Return the road of a given size [m] with its vehicles."""
        raise NotImplementedError

    def limit_speed(self, size: float) -> float:
        """Return the speed that the traffic cannot exceed in the long run, on a road of a given size [m] [m/s]."""
        raise NotImplementedError

    def draw(self, generator: np.random.Generator) -> ClosedRoad:
        """Return a road of random size with its vehicles."""
        size = float(generator.integers(*self._size_range, endpoint=True))
        road = _packaged_road(self, size) if is_packaged(type(self)) else self.build(size)
        return replace(road, human_parameters=self.draw_humans(road.vehicle_ids, generator))

    def _closed_road(self, size: float, edges: Sequence[EdgeSpan], positions: Floats, **fields: Any) -> ClosedRoad:
        """Return a road of edges in driving order; positions of vehicles are from the last to the first [m]."""
        vehicle_ids, names = self._vehicle_ids(), [edge.name for edge in edges]
        laps = int(self.max_duration * self.top_speed / sum(edge.length for edge in edges)) + 2  # enough for an episode
        routes = [Route(f"from_{name}", (*names[index:], *names[:index]), laps) for index, name in enumerate(names)]
        entries = []
        for vehicle_id, position in zip(vehicle_ids, positions.tolist(), strict=True):
            edge = max((edge for edge in edges if edge.start <= position), key=lambda edge: edge.start)
            entries.append(Entry(vehicle_id, f"from_{edge.name}", min(position - edge.start, edge.length)))
        return ClosedRoad(
            routes=tuple(routes),
            entries=tuple(entries),
            vehicle_ids=vehicle_ids,
            cav_ids=self.possible_cav_ids(),
            start_positions=positions,
            limit_speed=self.limit_speed(size),
            drawn_values={self.size_parameter: size},
            **fields,
        )

    @property
    def provided_fields(self) -> tuple[str, ...]:
        """Optional fields of a `LocalState` that this road provides."""
        return ("penetration_rate",)

    @property
    def drawn_ranges(self) -> dict[str, tuple[float, float]]:
        """The range of the size."""
        return {self.size_parameter: self._size_range}

    def stratum(self, index: int, count: int) -> Self:
        """Return this road with part `index` of `count` equal parts of its range of sizes, both ends included."""
        low, high = self._size_range
        borders = np.linspace(low, high + 1, count + 1).astype(int)
        low, high = int(borders[index]), int(borders[index + 1]) - 1
        return replace(self, **{self.size_parameter: (low, max(low, high))})

    def possible_cav_ids(self) -> tuple[str, ...]:
        """Return the ids of the CAVs, in their order along the road."""
        return tuple(vehicle_id for vehicle_id in self._vehicle_ids() if vehicle_id.startswith("cav"))

    def _summary_texts(self) -> tuple[str, str, str, str]:
        sizes = dict.fromkeys(self._size_range)
        road = self.description.format("-".join(map(str, sizes)))
        speeds = "-".join(f"{self.limit_speed(size):.2f}" for size in sizes)
        return road, f"{self.vehicles} ({self.cavs} CAV)", f"{speeds} m/s", self.limit_description

    @property
    def _size_range(self) -> tuple[int, int]:
        return getattr(self, self.size_parameter)

    @property
    def _min_length(self) -> float:
        return self.vehicles * (VEHICLE_LENGTH + self.humans.minimum_gap)

    def _vehicle_ids(self) -> tuple[str, ...]:
        """Return all ids in their order along the road; vehicle 0 is a CAV, and CAVs are evenly spread."""
        cav_indices = {round(index * self.vehicles / self.cavs) for index in range(self.cavs)}
        ids = [f"{'cav' if index in cav_indices else 'human'}_{index}" for index in range(self.vehicles)]
        return tuple(reversed(ids) if self.is_first_leading else ids)


@lru_cache(maxsize=MAX_CACHED_ROADS)
def _packaged_road(scenario: LoopScenario, size: float) -> ClosedRoad:
    """Return `scenario.build(size)`, cached for other episodes of the same size."""
    return scenario.build(size)


@parameter_dataclass(frozen=True, config=STRICT)
class Ring(LoopScenario):
    """A ring on which vehicles stand evenly spaced at the start; each episode draws its length.

    The paper's ring has 22 vehicles, one of them a CAV, on 220 to 270 m. At that density the steady flow of the IDM
    is unstable, and the noise of the human drivers grows into a wave.
    """

    title: ClassVar[str] = "ring"
    reward: ClassVar[str] = "released"
    size_parameter: ClassVar[str] = "length"
    description: ClassVar[str] = "ring of {} m"
    limit_description: ClassVar[str] = "the IDM's equilibrium speed, which all vehicles could keep forever"

    length: Annotated[tuple[LoopSize, LoopSize], NumberOrRange] = (220, 270)
    """range of the length, drawn uniformly among its integers; or a single length [m]"""

    @model_validator(mode="after")
    def _check_length(self) -> Self:
        length = self.length[0]
        if length < self._min_length:
            raise ValueError(
                f"length: {length} m is not allowed for {self.vehicles} vehicles; allowed: >= {self._min_length:g} m"
            )
        return self

    def build(self, size: float) -> ClosedRoad:
        """Return the ring of a given length [m], with edges of equal length, and its vehicles."""
        edge_length = size / RING_EDGES
        positions = np.linspace(0, size, 161)
        return self._closed_road(
            size,
            [EdgeSpan(f"edge_{index}", index * edge_length, edge_length) for index in range(RING_EDGES)],
            np.arange(self.vehicles, dtype=np.float64) * (size / self.vehicles),
            loop_length=size,
            network=_circle_network(size, self.top_speed),
            center_line=np.column_stack([positions, _circle_points(2 * np.pi * positions / size, size)]),
        )

    def limit_speed(self, size: float) -> float:
        """Return the IDM's equilibrium speed on a ring of a given length [m/s]."""
        return equilibrium_speed(size / self.vehicles - VEHICLE_LENGTH, self.humans)


def _circle_points(angles: Floats, length: float) -> Floats:
    return length / (2 * np.pi) * np.column_stack([np.cos(angles), np.sin(angles)])


def _circle_network(length: float, speed: float) -> RoadNetwork:
    corners = _circle_points(2 * np.pi * np.arange(RING_EDGES) / RING_EDGES, length)
    nodes = tuple(Node(f"node_{index}", x, y, has_priority=True) for index, (x, y) in enumerate(corners.tolist()))
    edges = []
    for index in range(RING_EDGES):
        arc = _circle_points(2 * np.pi * (index + np.linspace(0, 1, 41)) / RING_EDGES, length)
        ends = nodes[index].name, nodes[(index + 1) % RING_EDGES].name
        edges.append(Edge(f"edge_{index}", *ends, length / RING_EDGES, shape=to_polyline(arc)))
    return RoadNetwork(nodes, tuple(edges), speed, has_internal_links=False)
