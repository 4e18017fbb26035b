"""The leaders of human drivers on SUMO's rings, which have four lanes in a row: the last vehicle on each visible lane.

On a driver's own lane, the leader is the vehicle ahead. On a lane further ahead, it is the last vehicle on that lane.
If the vehicle ahead is still on the own lane, this is another vehicle, and drivers brake for it if it is much slower.
Drivers always see the next lane, and further lanes as far as they need to stop, but at least 25 m of lanes.
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
"""minimum length of visible lanes beyond the own one: SUMO's CRLL_LOOK_AHEAD vehicle lengths [m]"""
CONTACT_GAP = -1e-3
"""gap below which SUMO reports a collision: its NUMERICAL_EPS [m]"""
FREE_GAP = 1e6
"""gap in SUMO's `freeSpeed` without a leader; the leader then drives at the desired speed [m]"""


HumanParameters = IDMParameters | IDMArrays
"""of all human drivers, or of each"""


class Leader(NamedTuple):
    """Leaders of drivers: speed [m/s] and gap [m], arrays of shape (vehicles, W)."""

    speed: Array
    gap: Array


def leaders(
    speed: Array, position: Array, leader: Leader, loop_length: Array, parameters: HumanParameters, step: float
) -> Iterator[Leader]:
    """Yield the leader of each vehicle on its own lane, on the next one, and so on as far as any driver sees.

    Shapes: (vehicles, W); `loop_length` (W,). Units: m/s, m, m, s. Positions are those of front bumpers, wrapped or
    not; `leader` is the vehicle ahead.
    """
    xp, lane_length, place = namespace(speed), loop_length / RING_EDGES, position % loop_length
    lane = xp.floor(place / lane_length)
    distance = (lane + 1.0) * lane_length - place  # to the end of the lanes seen so far

    def leader_if_present(is_present: Array, leader_speed: Array, gap: Array) -> Leader:
        return Leader(xp.where(is_present, leader_speed, parameters.desired_speed), xp.where(is_present, gap, FREE_GAP))

    yield leader_if_present(leader.gap <= distance, *leader)
    max_speed = clamp_max(speed + parameters.max_acceleration * step, parameters.desired_speed)
    braking, time_headway = parameters.comfortable_deceleration, parameters.time_headway
    look_ahead = look_ahead_distance(max_speed, time_headway, braking, step)
    # A remainder takes longer than everything else here; the remainder of less than one loop needs no division.
    offsets = xp.stack([place - edge * lane_length for edge in range(RING_EDGES)])
    offsets = xp.where(offsets < 0.0, offsets + loop_length, offsets)
    last, columns = offsets.argmin(1), xp.arange(speed.shape[1])
    fronts, speeds = offsets[xp.arange(RING_EDGES)[:, None], last, columns], speed[last, columns]
    sees, seen_length = distance > 0.0, 0.0 * loop_length
    while bool(sees.any()):
        lane = xp.where(lane == RING_EDGES - 1.0, 0.0, lane + 1.0)
        index = xp.asarray(lane, dtype=xp.int64)
        front, leader_speed = fronts[index, columns], speeds[index, columns]
        # A vehicle with its rear bumper on a lane is on that lane, too.
        is_occupied = sees & (front < lane_length + VEHICLE_LENGTH)
        yield leader_if_present(is_occupied, leader_speed, distance + front - VEHICLE_LENGTH)
        seen_length = seen_length + lane_length
        distance = distance + lane_length
        sees = sees & ((distance <= look_ahead) | (seen_length <= MIN_LOOK_AHEAD))


def look_ahead_distance(max_speed: Array, time_headway: Array, braking: Array, step: float) -> Array:
    """Return how far drivers look ahead: far enough to stop after a headway at the maximum speed of this step [m].

    Shapes: any, broadcast together. Units: m/s, s, m/s2, s.
    """
    return max_speed * (step + time_headway) + stopping_distance(max_speed, braking, step)


def lane_end_leader(speed: Array, position: Array, loop_length: Array, parameters: HumanParameters) -> Leader:
    """Return the leader of drivers above their desired speed: the end of their lane, as a standing vehicle.

    Arguments as of `leaders`. The gap is at least that of SUMO's `getSecureGap` at the desired speed.
    """
    lane_length, desired = loop_length / RING_EDGES, parameters.desired_speed
    secure_gap = desired * (parameters.time_headway + desired / parameters.interaction_scale)
    return Leader(0.0 * speed, clamp_min(lane_length - position % lane_length, secure_gap))


def ring_contacts(position: Array, gap: Array, loop_length: Array) -> Array:
    """Return which vehicles touch the vehicle ahead according to SUMO, which requires both fronts on the same lane.

    Shapes: (vehicles, ...); `loop_length` broadcasts with them. Units: m.
    """
    xp = namespace(position)
    lane = xp.floor(position % loop_length / (loop_length / RING_EDGES))
    return (gap < CONTACT_GAP) & (lane == xp.concatenate([lane[1:], lane[:1]]))
