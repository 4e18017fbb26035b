"""Whom vehicles look at before they change lanes on a motorway that a ramp joins.

On each lane there is but one way to go: from the ramp's lane and the right one to the left, from the left one
to the right. Source: SUMO's MSLaneChanger (`getRealLeader`, `getRealFollower`, `checkChange`).
"""

from typing import NamedTuple

from unjam.physics.arrays import Array, at_least, namespace
from unjam.worlds.batch.vehicles import NOBODY, Drivers, Vehicles, around, chosen

FAR = 1e6
"""gap to nobody [m]"""


class Stretch(NamedTuple):
    """A motorway with a ramp: lengths along the road [m]."""

    merge: float
    """where the ramp's lane begins to run beside it"""
    closes: float
    """where that lane ends"""
    length: float
    limit: float
    """what it allows [m/s]"""
    ramp_limit: float
    """what the ramp allows [m/s]"""
    lanes: int
    """of the motorway"""
    vehicle_length: float


class Other(NamedTuple):
    """A vehicle beside or ahead of each."""

    row: Array
    there: Array
    """whether there is one that is near enough to count"""
    speed: Array
    gap: Array
    """beyond the smallest one of who is behind [m]"""


class Scene(NamedTuple):
    """What each vehicle looks at before it changes to the one lane it can change to."""

    drivers: Drivers
    target: Array
    """its way; `NOBODY` where it can go nowhere"""
    leader: Other
    ahead: Other
    """on the target lane"""
    behind: Other
    followers: Drivers
    """how those drive"""
    by_leader: Array
    """whether the one ahead on the target lane is in its way"""
    by_follower: Array
    step: float


def scene_of(vehicles: Vehicles, stretch: Stretch, step: float) -> Scene:
    """Return what each vehicle looks at, in a simulation of a `step` [s]."""
    xp, way, place, speed = namespace(vehicles.speed), vehicles.way, vehicles.place, vehicles.speed
    merging = (place >= stretch.merge) & (place < stretch.closes)
    target = xp.where((way == 0) & merging, 1, NOBODY)
    if stretch.lanes > 1:
        target = xp.where(way == 1, 2, xp.where(way == 2, 1, target))
    near = around(vehicles, stretch.lanes + 1)
    drivers, length = vehicles.drivers, stretch.vehicle_length
    section = 1.0 * (place >= stretch.merge) + 1.0 * (place >= stretch.closes)
    ends = xp.where(place < stretch.merge, stretch.merge, xp.where(merging, stretch.closes, stretch.length))
    sees = drivers.brake_gap(speed, step) + vehicles.gap >= ends - place

    def front(row: Array) -> Other:
        there = (row >= 0) & (sees | (section[row] == section) | (place[row] - length < ends))
        gap = xp.where(there, place[row] - length - place - vehicles.gap, FAR)
        return Other(row, there, speed[row], gap)

    leader, ahead = front(chosen(near.ahead, way)), front(chosen(near.ahead, target))
    row = chosen(near.behind, target)
    gap = xp.where(row >= 0, place - length - place[row] - vehicles.gap[row], FAR)
    behind, followers = Other(row, row >= 0, speed[row], gap), drivers.at(row)
    by_leader = ahead.there & (ahead.gap < at_least(drivers.secure_gap(speed, ahead.speed), 0.0))
    by_follower = behind.there & (behind.gap < at_least(followers.secure_gap(behind.speed, speed), 0.0))
    return Scene(drivers, target, leader, ahead, behind, followers, by_leader, by_follower, step)
