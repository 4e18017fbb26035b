"""Whom SUMO's people follow on a ring of four lanes, one behind the other: the last car of each they see.

On their own lane it is the car ahead. On a lane beyond it is the last car there; where the car ahead is still
on their own lane that is another one, and if it is much slower, it is what they brake for. The next lane is
always seen, others as far as it takes to stop, but 25 m of lanes at least.
Source: SUMO's MSVehicle (`planMoveInternal`), MSCFModel (`brakeGap`).
"""

from collections.abc import Iterator
from typing import NamedTuple

from unjam.physics.arrays import Array, at_least, at_most, namespace
from unjam.physics.idm import IDMParameters, IDMRows
from unjam.physics.kinematics import stopping_distance
from unjam.scenarios.ring import EDGES
from unjam.scenarios.scenario import VEHICLE_LENGTH

LOOK_AHEAD = 5 * VEHICLE_LENGTH
"""lanes beyond the own one that are seen at least: SUMO's CRLL_LOOK_AHEAD lengths of a vehicle [m]"""
CONTACT = -1e-3
"""gap below which SUMO says that vehicles collide: its NUMERICAL_EPS [m]"""
NOBODY = 1e6
"""gap that SUMO's `freeSpeed` takes where nobody is ahead, behind who drives as fast as is wanted [m]"""


class Leader(NamedTuple):
    """Whom people follow; arrays of shape (vehicles, W)."""

    speed: Array
    """[m/s]"""
    gap: Array
    """[m]"""


def leaders(
    speed: Array,
    position: Array,
    ahead: Leader,
    loop: Array,
    people: IDMParameters | IDMRows,
    step: float,
) -> Iterator[Leader]:
    """Yield whom each vehicle follows on its own lane, on the next one, and so on as far as anybody sees.

    Args:
        speed: [m/s], shape (vehicles, W).
        position: front bumpers along the ring, wrapped or not [m], shape (vehicles, W).
        ahead: the vehicle ahead of each.
        loop: lengths of the rings [m], shape (W,).
        people: how they drive.
        step: of simulation [s].
    """
    xp, lane_length, place = namespace(speed), loop / EDGES, position % loop
    lane = xp.floor(place / lane_length)
    seen = (lane + 1.0) * lane_length - place

    def where(there: Array, leader: Array, gap: Array) -> Leader:
        return Leader(xp.where(there, leader, people.desired_speed), xp.where(there, gap, NOBODY))

    yield where(ahead.gap <= seen, *ahead)
    fastest = at_most(speed + people.max_acceleration * step, people.desired_speed)
    braking, headway = people.comfortable_deceleration, people.time_headway
    farthest = sight(fastest, headway, braking, step)
    # A remainder takes longer than all else here; that of less than a loop is known.
    beyond = xp.stack([place - edge * lane_length for edge in range(EDGES)])
    beyond = xp.where(beyond < 0.0, beyond + loop, beyond)
    last, columns = beyond.argmin(1), xp.arange(speed.shape[1])
    first, speeds = beyond[xp.arange(EDGES)[:, None], last, columns], speed[last, columns]
    sees, looked_at = seen > 0.0, 0.0 * loop
    while bool(sees.any()):
        lane = xp.where(lane == EDGES - 1.0, 0.0, lane + 1.0)
        number = xp.asarray(lane, dtype=xp.int64)
        front, there = first[number, columns], speeds[number, columns]
        # Whoever's rear bumper is still on a lane is there too.
        occupied = sees & (front < lane_length + VEHICLE_LENGTH)
        yield where(occupied, there, seen + front - VEHICLE_LENGTH)
        looked_at = looked_at + lane_length
        seen = seen + lane_length
        sees = sees & ((seen <= farthest) | (looked_at <= LOOK_AHEAD))


def sight(fastest: Array, headway: Array, braking: Array, step: float) -> Array:
    """Return how far vehicles look ahead that may be so fast after this step: to stand after a headway [m].

    Shapes: any, broadcast together. Units: m/s, s, m/s2, s.
    """
    return fastest * (step + headway) + stopping_distance(fastest, braking, step)


def end_of_lane(speed: Array, position: Array, loop: Array, people: IDMParameters | IDMRows) -> Leader:
    """Return whom people follow who drive faster than they want: the end of their lane, as if it stood there.

    Shapes as in `leaders`. The gap is at least what SUMO's `getSecureGap` says of the desired speed.
    """
    lane_length = loop / EDGES
    wanted = people.desired_speed
    secure = wanted * (people.time_headway + wanted / people.braking)
    return Leader(0.0 * speed, at_least(lane_length - position % lane_length, secure))


def touching(position: Array, gap: Array, loop: Array) -> Array:
    """Return which vehicles touch the one ahead as SUMO sees it: where both fronts are on the same lane.

    Args:
        position: front bumpers along the ring [m], shape (vehicles, ...).
        gap: to the vehicle ahead [m], likewise.
        loop: length of the ring [m].
    """
    xp = namespace(position)
    lane = xp.floor(position % loop / (loop / EDGES))
    return (gap < CONTACT) & (lane == xp.concatenate([lane[1:], lane[:1]]))
