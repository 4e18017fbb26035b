"""The ring road: one lane, closed, and too full for people to drive without waves."""

from dataclasses import replace
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from unjam.parameters import STRICT, Count
from unjam.physics.idm import equilibrium_speed
from unjam.scenarios.closed_road import (
    Edge,
    cavs_among,
    check_counts,
    loop_traffic,
    part_of_range,
    vehicle_names,
    words_of_range,
)
from unjam.scenarios.road import ClosedRoad, PlainNetwork
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
        return ClosedRoad(
            network=PlainNetwork(
                _nodes(length),
                _edges(length, self.top_speed),
                ("--no-internal-links", "true", "--no-turnarounds", "true"),
            ),
            traffic=loop_traffic(self, _loop(length), ids, positions, people),
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


def _point(angle: float, radius: float) -> tuple[float, float]:
    return radius * float(np.cos(angle)), radius * float(np.sin(angle))


def _nodes(length: float) -> str:
    radius = length / (2 * np.pi)
    lines = ["<nodes>"]
    for index in range(EDGES):
        x, y = _point(2 * np.pi * index / EDGES, radius)
        lines.append(f'<node id="node_{index}" x="{x:.6f}" y="{y:.6f}" type="priority"/>')
    return "\n".join([*lines, "</nodes>"])


def _loop(length: float) -> list[Edge]:
    each = length / EDGES
    return [Edge(f"edge_{index}", index * each, each) for index in range(EDGES)]


def _edges(length: float, speed: float) -> str:
    radius = length / (2 * np.pi)
    lines = ["<edges>"]
    for index in range(EDGES):
        angles = 2 * np.pi * (index + np.linspace(0, 1, 41)) / EDGES
        shape = " ".join(f"{x:.6f},{y:.6f}" for x, y in (_point(angle, radius) for angle in angles))
        lines.append(
            f'<edge id="edge_{index}" from="node_{index}" to="node_{(index + 1) % EDGES}" numLanes="1" '
            f'speed="{speed}" length="{length / EDGES!r}" shape="{shape}"/>'
        )
    return "\n".join([*lines, "</edges>"])


def _outline(length: float) -> np.ndarray:
    coordinates = np.linspace(0, length, 161)
    angles = 2 * np.pi * coordinates / length
    radius = length / (2 * np.pi)
    return np.column_stack([coordinates, radius * np.cos(angles), radius * np.sin(angles)])
