"""Who drives ahead and who behind on a closed road with one lane, and where on the plane that is."""

from typing import Any, NamedTuple

import numpy as np

from unjam.drivers.local_state import LocalState
from unjam.physics.kinematics import gap_on_loop
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.record import Floats


class Neighbours(NamedTuple):
    """Places of some vehicles and of those around them, in road order: integers, or arrays of them."""

    own: Any
    ahead: Any
    behind: Any


def loop_neighbours(chosen: Any, vehicles: int) -> Neighbours:
    """Return the neighbours of the `chosen` places among `vehicles` on a loop with one lane.

    Nobody overtakes there: each vehicle keeps the neighbours that it starts with.
    """
    return Neighbours(chosen, (chosen + 1) % vehicles, (chosen - 1) % vehicles)


def loop_state(
    speeds: Any,
    positions: Any,
    near: Neighbours,
    loop_length: float,
    crossings: tuple[tuple[float, float], ...] = (),
) -> LocalState:
    """Return what the vehicles `near.own` perceive on a closed road.

    Args:
        speeds: [m/s], by place in road order: an array, (vehicles,) or (vehicles, moments), or a list.
        positions: of the front bumpers along the road, not wrapped [m]; likewise.
        near: whose surroundings; integers give a state of plain numbers.
        loop_length: [m].
        crossings: where the road crosses itself, from and to [m].
    """
    own, ahead, behind = near
    speed, position = speeds[own], positions[own]
    state = LocalState(  # names would cost as much as all the rest, in every step of a simulator
        speed,
        speeds[ahead],
        gap_on_loop(position, positions[ahead], loop_length, VEHICLE_LENGTH),
        speeds[behind],
        gap_on_loop(positions[behind], position, loop_length, VEHICLE_LENGTH),
        position % loop_length,
        loop_length if type(position) is float else np.full(position.shape, loop_length),
    )
    if not crossings:
        return state
    ways = [(start - position) % loop_length for start, _ in crossings]
    nearest = min(ways) if type(position) is float else np.minimum.reduce(ways)
    return state._replace(to_crossing=nearest)


def places_along(outline: Floats, positions: Floats, loop_length: float) -> Floats:
    """Return rows (x, y, heading) of vehicles whose front bumpers are at `positions` along a closed road.

    Args:
        outline: rows (coordinate along the road, x, y) [m].
        positions: not wrapped [m], any shape.
        loop_length: [m].

    Returns:
        Shape (..., 3): [m], and [rad] against the x axis; a vehicle lies between the places of its bumpers.
    """
    (x, y), (rear_x, rear_y) = (
        [np.interp(along % loop_length, outline[:, 0], outline[:, axis]) for axis in (1, 2)]
        for along in (positions, positions - VEHICLE_LENGTH)
    )
    return np.stack([x, y, np.arctan2(y - rear_y, x - rear_x)], axis=-1)
