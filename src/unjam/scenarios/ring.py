"""The ring road: one lane, closed, and too full for people to drive without waves."""

from dataclasses import replace
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from unjam.parameters import STRICT, Count
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
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario

EDGES = 4


@dataclass(frozen=True, config=STRICT)
class Ring(Scenario):
    """Vehicles on a circle, evenly spaced and standing at the start; the length is new in each episode.

    The paper's ring has 22 vehicles, one of them a CAV, on 220 to 270 m. At that density the IDM's own
    steady flow is unstable, and the humans' noise grows into a wave.
    """

    title: ClassVar[str] = "ring"
    reward: ClassVar[str] = "released"

    length: tuple[Annotated[int, Field(ge=10)], Annotated[int, Field(ge=10)]] = (220, 270)
    """shortest and longest ring, drawn uniformly among the integers between them [m]"""
    vehicles: Annotated[int, Field(ge=2)] = 22
    """on the ring, CAVs among them"""
    cavs: Count = 1
    """vehicles that are CAVs, evenly spread"""

    @model_validator(mode="after")
    def _fits(self) -> "Ring":
        check_counts("length", self.length, self.vehicles, self.cavs)
        shortest = self.length[0]
        needed = self.vehicles * (VEHICLE_LENGTH + self.humans.minimum_gap)
        if shortest < needed:
            raise ValueError(
                f"length: {shortest} m is not allowed for {self.vehicles} vehicles; allowed: >= {needed:g} m"
            )
        return self

    def draw(self, generator: np.random.Generator) -> ClosedRoad:
        """Return a ring of random length with its vehicles."""
        length = float(generator.integers(self.length[0], self.length[1], endpoint=True))
        ids = vehicle_names(self.vehicles, self.cavs)
        positions = np.arange(self.vehicles, dtype=np.float64) * (length / self.vehicles)
        people = self.draw_people(ids, generator)
        each = length / EDGES
        places = [Place(f"edge_{index}", index * each, each) for index in range(EDGES)]
        routes, entries = loop_entries(places, ids, positions, self.seconds, self.top_speed)
        return ClosedRoad(
            network=_network(length, self.top_speed),
            routes=routes,
            entries=entries,
            vehicle_ids=ids,
            cav_ids=cavs_among(ids),
            start_positions=positions,
            loop_length=length,
            crossings=(),
            limit_speed=equilibrium_speed(length / self.vehicles - VEHICLE_LENGTH, self.humans),
            outline=_outline(length),
            drawn={"length": length},
            people=people,
        )

    @property
    def drawn_ranges(self) -> dict[str, tuple[float, float]]:
        """The ring's length."""
        return {"length": self.length}

    def part(self, index: int, count: int) -> "Ring":
        """Return this ring with one of `count` equal parts of its lengths."""
        return replace(self, length=part_of_range(self.length, index, count))

    def possible_cavs(self) -> tuple[str, ...]:
        """Return the ids of the CAVs."""
        return cavs_among(vehicle_names(self.vehicles, self.cavs))

    def facts(self) -> list[tuple[str, str]]:
        """Return the ring's own facts for `unjam scenarios`."""
        return [
            ("road", f"ring of {words_of_range(self.length)} m"),
            ("vehicles", f"{self.vehicles} ({self.cavs} CAV)"),
            ("limit", f"{self._limits()} m/s"),
            ("limit is", "the IDM's equilibrium speed, at which all vehicles could drive alike for ever"),
        ]

    def _limits(self) -> str:
        speeds = [
            f"{equilibrium_speed(length / self.vehicles - VEHICLE_LENGTH, self.humans):.2f}"
            for length in dict.fromkeys(self.length)
        ]
        return "-".join(speeds)


def _on_circle(angles: np.ndarray, length: float) -> np.ndarray:
    return length / (2 * np.pi) * np.column_stack([np.cos(angles), np.sin(angles)])


def _network(length: float, speed: float) -> Network:
    """Return a circle of equal edges."""
    corners = _on_circle(2 * np.pi * np.arange(EDGES) / EDGES, length)
    nodes = tuple(Node(f"node_{index}", x, y, priority=True) for index, (x, y) in enumerate(corners.tolist()))
    edges = []
    for index in range(EDGES):
        line = _on_circle(2 * np.pi * (index + np.linspace(0, 1, 41)) / EDGES, length)
        begin, end = nodes[index].name, nodes[(index + 1) % EDGES].name
        edges.append(
            Edge(f"edge_{index}", begin, end, length / EDGES, shape=tuple(map(tuple, line.tolist())))
        )
    return Network(nodes, tuple(edges), speed, links=False)


def _outline(length: float) -> np.ndarray:
    coordinates = np.linspace(0, length, 161)
    return np.column_stack([coordinates, _on_circle(2 * np.pi * coordinates / length, length)])
