"""What roads without ends have in common: a fixed number of vehicles, and what is drawn for each episode."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.physics.idm import IDMParameters
from unjam.scenarios.scenario import Scenario, cav_type, human_type_of, human_types


class Edge(NamedTuple):
    """An edge of a closed road."""

    name: str
    start: float
    """where along the road it begins [m]"""
    length: float
    """[m]"""


def vehicle_names(vehicles: int, cavs: int) -> tuple[str, ...]:
    """Return the ids of all vehicles in road order; CAVs are evenly spread, the first is one of them."""
    chosen = {round(index * vehicles / cavs) for index in range(cavs)}
    return tuple(f"{'cav' if index in chosen else 'human'}_{index}" for index in range(vehicles))


def cavs_among(ids: Sequence[str]) -> tuple[str, ...]:
    """Return the ids of the CAVs."""
    return tuple(name for name in ids if name.startswith("cav"))


def check_counts(name: str, drawn: tuple[int, int], vehicles: int, cavs: int) -> None:
    """Raise `ValueError` where a range is the wrong way round, or there are more CAVs than vehicles."""
    low, high = drawn
    if high < low:
        raise ValueError(f"{name}: {high} m is not allowed as the largest; allowed: >= {low} m")
    if cavs > vehicles:
        raise ValueError(f"cavs: {cavs} is not allowed; allowed: <= vehicles, {vehicles}")


def part_of_range(whole: tuple[int, int], index: int, count: int) -> tuple[int, int]:
    """Return one of `count` equal parts of a range of integers, both ends included."""
    low, high = whole
    borders = np.linspace(low, high + 1, count + 1).astype(int)
    first, last = int(borders[index]), int(borders[index + 1]) - 1
    return first, max(first, last)


def words_of_range(whole: tuple[int, int]) -> str:
    """Return `220-270`, or `230` where both ends are the same."""
    return "-".join(str(end) for end in dict.fromkeys(whole))


def loop_traffic(
    scenario: Scenario,
    edges: Sequence[Edge],
    ids: Sequence[str],
    positions: NDArray[np.float64],
    people: dict[str, IDMParameters],
) -> str:
    """Return the XML of types, routes and vehicles that stand at `positions` along a closed road."""
    seconds = scenario.simulation_step * (scenario.warmup + scenario.horizon * scenario.steps_per_decision)
    length = sum(edge.length for edge in edges)
    laps = int(seconds * scenario.top_speed / length) + 2
    lines = ["<routes>", *human_types(scenario, people), cav_type(scenario)]
    for first, edge in enumerate(edges):
        names = " ".join(other.name for other in [*edges[first:], *edges[:first]])
        lines.append(f'<route id="from_{edge.name}" edges="{names}" repeat="{laps}"/>')
    for name, position in zip(ids, positions, strict=True):
        edge = max((edge for edge in edges if edge.start <= position), key=lambda edge: edge.start)
        place = min(float(position) - edge.start, edge.length)
        lines.append(
            f'<vehicle id="{name}" {human_type_of(name, scenario, people)} route="from_{edge.name}" '
            f'depart="0" departSpeed="0" departLane="0" departPos="{place!r}"/>'
        )
    return "\n".join([*lines, "</routes>"])
