"""The lanes of W figure eights as in SUMO's networks; arrays have shape (W,) or (vehicles, W)."""

from collections.abc import Sequence
from math import pi
from typing import NamedTuple

import numpy as np

from unjam.physics.arrays import Array, Floats, namespace
from unjam.scenarios.figure_eight import CROSSING_LINK, INNER_LINK, OUTER_LINK, figure_eight_radius, lane_lengths
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.batch.leaders import CONTACT_GAP
from unjam.worlds.batch.noise import ArrayFactory

LANE_LENGTH_DIGITS = 6
"""decimal places of lane lengths in SUMO's networks [m]"""
CAR_WIDTH = 1.8
"""[m]"""


class CrossingSide(NamedTuple):
    """One of the two directions across the crossing; shapes (W,)."""

    start: Array
    """position where the crossing starts [m]"""
    lane_length: Array
    """of the lane before it [m]"""
    approach_distance: Array
    """distance before it from which SUMO registers approaching vehicles [m]"""


class FigureEights(NamedTuple):
    """W figure eights."""

    major: CrossingSide
    """the direction with the right of way"""
    minor: CrossingSide
    """the direction that yields"""
    loop_length: Array
    """[m]"""
    position_offset: Array
    """SUMO's position of each vehicle minus that on the exact road [m], shape (vehicles, W)"""

    def distances_past(self, position: Array) -> list[Array]:
        """Return the distance of each vehicle past the start of the crossing, on both sides, wrapped to one lap [m]."""
        sumo_position = position + self.position_offset
        return [(sumo_position - side.start) % self.loop_length for side in (self.major, self.minor)]


def make_figure_eights(roads: Sequence[ClosedRoad], to_array: ArrayFactory) -> FigureEights:
    """Return figure eights whose lane lengths are rounded as in SUMO's networks."""
    radius = np.array([road.drawn_values["radius"] for road in roads])
    start = np.stack([road.start_positions for road in roads], 1)
    exact_arc = 1.5 * pi * radius
    arc = exact_arc.round(LANE_LENGTH_DIGITS)
    before = 2 * radius + CROSSING_LINK + 2 * INNER_LINK
    major, minor = (
        CrossingSide(to_array(side_start), to_array(radius), to_array(radius + link + arc))
        for side_start, link in ((radius, OUTER_LINK), (before + arc + radius, INNER_LINK))
    )
    return FigureEights(
        major=major,
        minor=minor,
        loop_length=to_array(2 * (2 * radius + CROSSING_LINK + INNER_LINK + OUTER_LINK + arc)),
        position_offset=to_array(np.where(start >= before + exact_arc, arc - exact_arc, 0.0)),
    )


def figure_eight_contacts(position: Array, gap: Array, loop_length: Array) -> Array:
    """Return which vehicles touch the vehicle ahead on the same lane, or overlap with another one on the crossing.

    Args:
        position: front bumpers along the road [m], shape (vehicles, ...).
        gap: to the vehicle ahead [m], likewise.
        loop_length: of the road [m].
    """
    xp, place = namespace(position), position % loop_length
    lengths, touches = lane_lengths(figure_eight_radius(loop_length)), gap < CONTACT_GAP
    if bool(touches.any()):
        lane, end = 0.0 * place, 0.0
        for length in lengths[:-1]:
            end = end + length
            lane = lane + (place > end)
        touches = touches & (lane == xp.concatenate([lane[1:], lane[:1]]))
    first, second = (
        (front > CROSSING_LINK / 2 - CAR_WIDTH / 2) & (front < CROSSING_LINK / 2 + CAR_WIDTH / 2 + VEHICLE_LENGTH)
        for front in ((place - start) % loop_length for start in (lengths[0], sum(lengths[:7])))
    )
    return touches | ((first | second) & (first.any(0) & second.any(0)))


def crossing_starts(roads: Sequence[ClosedRoad]) -> Floats:
    """Return the positions where roads cross themselves, shape (crossings, W) [m]."""
    return np.array([[start for start, _ in road.crossings] for road in roads]).T
