"""Checks of the roads that classes of users draw: finite numbers, existing names and consistent lengths."""

from collections.abc import Collection
from itertools import pairwise
from typing import Any

import numpy as np

from unjam.errors import InputError
from unjam.physics.arrays import Floats
from unjam.physics.kinematics import gap_on_loop
from unjam.scenarios.road import BuiltRoad, ClosedRoad, Edge, Road
from unjam.text import format_count, shorten_list, to_one_line
from unjam.tree import named_parts

LENGTH_TOLERANCES = 1.0, 0.02
"""tolerances of lengths for rounding: absolute [m], and relative"""
JUNCTION_SHARE = 0.1
"""largest share of the length of a loop that its lanes across junctions can have"""


def check_road(road: object, vehicle_length: float, context: str) -> None:
    """Raise `InputError` unless `road` is a consistent `Road`; `context` begins the message, the length is in m."""
    if not isinstance(road, Road):
        raise InputError(f"{context}: draw() returns {type(road).__name__}; allowed: a Road")
    try:
        if isinstance(road, BuiltRoad):
            _check_network(road)
        if isinstance(road, ClosedRoad):
            _check_loop(road, vehicle_length)
    except ValueError as error:
        raise InputError(f"{context}: road.{error}") from None


def check_repeated_road(road: Road, repeated_road: Road, context: str) -> None:
    """Raise `InputError` unless two roads that were drawn from one seed have equal numbers and texts.

    Otherwise different drivers of a comparison would drive on different roads.
    """
    if difference := _first_difference(road, repeated_road):
        raise InputError(
            f"{context}: draw() returns another road for the same seed: {difference}; allowed: equal roads"
        )


def _first_difference(value: object, repeated_value: object, name: str = "road") -> str:
    """Return the name of the first part of two trees with other numbers or texts, and both values; empty: none."""
    parts, repeated_parts = (_parts(tree) for tree in (value, repeated_value))
    if type(value) is not type(repeated_value) or parts.keys() != repeated_parts.keys():
        return f"{name} has other parts"
    for key, part in parts.items():
        if difference := _first_difference(part, repeated_parts[key], f"{name}.{key}"):
            return difference
    is_plain = isinstance(value, bool | int | float | str | np.generic | np.ndarray)
    if not is_plain or np.array_equal(np.array(value).astype(str), np.array(repeated_value).astype(str)):
        return ""
    return f"{name} is {to_one_line(value, 60)} and {to_one_line(repeated_value, 60)}"


def _parts(value: object) -> dict[Any, Any]:
    """Return the parts of a record, dict, list or tuple by name or index."""
    return (dict(enumerate(value)) if isinstance(value, list | tuple) else None) or named_parts(value) or {}


def _refuse(field: str, value: object, allowed: str) -> None:
    raise ValueError(f"{field}: {value} is not allowed; allowed: {allowed}")


def _check_length(
    field: str, length: float, expected: float, meaning: str, tolerance: float = LENGTH_TOLERANCES[1]
) -> None:
    if not (np.isfinite(length) and length > 0):
        _refuse(field, f"{length:g} m", "> 0 m")
    if abs(length - expected) > LENGTH_TOLERANCES[0] + tolerance * expected:
        _refuse(field, f"{length:.1f} m", f"{expected:.1f} m, {meaning}")


def _check_name(field: str, name: str, names: Collection[str]) -> None:
    if name not in names:
        _refuse(field, repr(name), shorten_list(names))


def _line_length(points: Floats) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _check_network(road: BuiltRoad) -> None:
    """Raise `ValueError` if edges, routes or entries do not fit together."""
    nodes, edges = {node.name: node for node in road.network.nodes}, {edge.name: edge for edge in road.network.edges}
    routes = {route.name: route for route in road.routes}
    for name, edge in edges.items():
        for field in ("from_node", "to_node"):
            _check_name(f"edges.{name}.{field}", getattr(edge, field), nodes)
        ends = [(nodes[node].x, nodes[node].y) for node in (edge.from_node, edge.to_node)]
        _check_length(f"edges.{name}.length", edge.length, _line_length(np.array(edge.shape or ends)), "its line")
    for name, route in routes.items():
        for edge_name in route.edges:
            _check_name(f"routes.{name}.edges", edge_name, edges)
        for edge_name, next_name in pairwise(route.edges):
            if edges[edge_name].to_node != edges[next_name].from_node:
                _refuse(f"routes.{name}.edges", f"{next_name} after {edge_name}", "edges that meet at a node")
    for entry in road.entries:
        _check_name(f"entries.{entry.name}.route", entry.route, routes)
        length = edges[routes[entry.route].edges[0]].length
        if not 0 <= entry.position <= length:
            _refuse(f"entries.{entry.name}.position", f"{entry.position:g} m", f"0 to {length:g} m, on its first edge")


def _check_loop(road: ClosedRoad, vehicle_length: float) -> None:
    """Raise `ValueError` if the lengths or the vehicles of a closed road contradict each other."""
    edges = {edge.name: edge for edge in road.network.edges}
    loop, tolerance = road.loop_length, JUNCTION_SHARE if road.network.has_internal_links else LENGTH_TOLERANCES[1]
    lap = [edges[name] for name in road.routes[0].edges]
    _check_length("loop_length", loop, sum(edge.length for edge in lap), "the sum of its edges", tolerance)
    line = np.asarray(road.center_line, np.float64)
    if line.ndim != 2 or line.shape[1] != 3 or not np.isfinite(line).all():
        _refuse("center_line", f"an array of shape {line.shape}", "finite rows (position, x, y)")
    _check_length("center_line", _line_length(line[:, 1:]), loop, "the length of the loop", tolerance)
    _check_length("center_line", float(line[-1, 0] - line[0, 0]), loop, "the length of the loop")
    ids, positions = road.vehicle_ids, np.asarray(road.start_positions, np.float64)
    for name in road.cav_ids:
        _check_name("cav_ids", name, ids)
    if positions.shape != (len(ids),) or not np.isfinite(positions).all():
        _refuse("start_positions", f"an array of shape {positions.shape}", format_count(len(ids), "finite position"))
    gaps = gap_on_loop(positions, np.roll(positions, -1), loop, vehicle_length)
    if len(ids) > 1 and (gaps.min() < 0 or gaps.sum() > loop):
        row = int(gaps.argmin())
        _refuse("start_positions", f"{positions[row]:.1f} m of {ids[row]}", "vehicles in their order, without contact")
    if not road.network.has_internal_links:
        _check_entries(road, lap)


def _check_entries(road: ClosedRoad, lap: list[Edge]) -> None:
    """Raise `ValueError` unless vehicles enter a closed road at their start positions; `lap` has its edges in order."""
    edge_starts = dict(zip([edge.name for edge in lap], np.cumsum([0.0, *(edge.length for edge in lap)]), strict=False))
    starts = dict(zip(road.vehicle_ids, road.start_positions, strict=True))
    routes = {route.name: route for route in road.routes}
    for entry in road.entries:
        _check_name("entries", entry.name, starts)
        position, start = edge_starts[routes[entry.route].edges[0]] + entry.position, starts[entry.name]
        offset = (position - start) % road.loop_length
        if min(offset, road.loop_length - offset) > LENGTH_TOLERANCES[0]:
            _refuse(f"entries.{entry.name}", f"{position:.1f} m on the loop", f"{start:.1f} m, as in start_positions")
