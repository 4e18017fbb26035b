"""Whom SUMO's people follow on a ring of four lanes, one behind the other: the last car of each they see.

On their own lane it is the car ahead. On a lane beyond it is the last car there; where the car ahead is still
on their own lane that is another one, and if it is much slower, it is what they brake for. The next lane is
always seen, others as far as it takes to stop, but 25 m of lanes at least.
Source: SUMO's MSVehicle (`planMoveInternal`), MSCFModel (`brakeGap`).
"""

from collections.abc import Iterator
from typing import NamedTuple

from unjam.physics.arrays import Array, clamp_max, clamp_min, namespace
from unjam.physics.idm import IDMArrays, IDMParameters
from unjam.physics.kinematics import stopping_distance
from unjam.scenarios.ring import RING_EDGES
from unjam.scenarios.scenario import VEHICLE_LENGTH

MIN_LOOK_AHEAD = 5 * VEHICLE_LENGTH
"""lanes beyond the own one that are seen at least: SUMO's CRLL_LOOK_AHEAD lengths of a vehicle [m]"""
CONTACT_GAP = -1e-3
"""gap below which SUMO says that vehicles collide: its NUMERICAL_EPS [m]"""
FREE_GAP = 1e6
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
    leader: Leader,
    loop_length: Array,
    parameters: IDMParameters | IDMArrays,
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
    xp, lane_length, place = namespace(speed), loop_length / RING_EDGES, position % loop_length
    lane = xp.floor(place / lane_length)
    seen = (lane + 1.0) * lane_length - place

    def leader_if_present(is_present: Array, leader_speed: Array, gap: Array) -> Leader:
        return Leader(xp.where(is_present, leader_speed, parameters.desired_speed), xp.where(is_present, gap, FREE_GAP))

    yield leader_if_present(leader.gap <= seen, *leader)
    fastest = clamp_max(speed + parameters.max_acceleration * step, parameters.desired_speed)
    braking, headway = parameters.comfortable_deceleration, parameters.time_headway
    farthest = look_ahead_distance(fastest, headway, braking, step)
    # A remainder takes longer than all else here; that of less than a loop is known.
    beyond = xp.stack([place - edge * lane_length for edge in range(RING_EDGES)])
    beyond = xp.where(beyond < 0.0, beyond + loop_length, beyond)
    last, columns = beyond.argmin(1), xp.arange(speed.shape[1])
    first, speeds = beyond[xp.arange(RING_EDGES)[:, None], last, columns], speed[last, columns]
    sees, looked_at = seen > 0.0, 0.0 * loop_length
    while bool(sees.any()):
        lane = xp.where(lane == RING_EDGES - 1.0, 0.0, lane + 1.0)
        number = xp.asarray(lane, dtype=xp.int64)
        front, there = first[number, columns], speeds[number, columns]
        # Whoever's rear bumper is still on a lane is there too.
        occupied = sees & (front < lane_length + VEHICLE_LENGTH)
        yield leader_if_present(occupied, there, seen + front - VEHICLE_LENGTH)
        looked_at = looked_at + lane_length
        seen = seen + lane_length
        sees = sees & ((seen <= farthest) | (looked_at <= MIN_LOOK_AHEAD))


def look_ahead_distance(max_speed: Array, time_headway: Array, braking: Array, step: float) -> Array:
    """Return how far vehicles look ahead that may be so fast after this step: to stand after a headway [m].

    Shapes: any, broadcast together. Units: m/s, s, m/s2, s.
    """
    return max_speed * (step + time_headway) + stopping_distance(max_speed, braking, step)


def lane_end_leader(speed: Array, position: Array, loop_length: Array, parameters: IDMParameters | IDMArrays) -> Leader:
    """Return whom people follow who drive faster than they want: the end of their lane, as if it stood there.

    Shapes as in `leaders`. The gap is at least what SUMO's `getSecureGap` says of the desired speed.
    """
    lane_length = loop_length / RING_EDGES
    wanted = parameters.desired_speed
    secure = wanted * (parameters.time_headway + wanted / parameters.interaction_scale)
    return Leader(0.0 * speed, clamp_min(lane_length - position % lane_length, secure))


def ring_contacts(position: Array, gap: Array, loop_length: Array) -> Array:
    """Return which vehicles touch the one ahead as SUMO sees it: where both fronts are on the same lane.

    Args:
        position: front bumpers along the ring [m], shape (vehicles, ...).
        gap: to the vehicle ahead [m], likewise.
        loop: length of the ring [m].
    """
    xp = namespace(position)
    lane = xp.floor(position % loop_length / (loop_length / RING_EDGES))
    return (gap < CONTACT_GAP) & (lane == xp.concatenate([lane[1:], lane[:1]]))
