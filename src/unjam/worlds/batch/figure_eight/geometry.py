"""The lanes of W figure eights as in SUMO's networks; arrays have shape (W,) or (vehicles, W)."""

from collections.abc import Sequence
from math import pi
from typing import NamedTuple

import numpy as np

from unjam.physics.arrays import Array, namespace
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
    """Return figure eights with lane lengths rounded as in SUMO's networks."""
    radius = np.array([road.drawn_values["radius"] for road in roads])
    start = np.stack([road.start_positions for road in roads], 1)
    exact_arc = 1.5 * pi * radius
    arc = exact_arc.round(LANE_LENGTH_DIGITS)
    before = 2 * radius + CROSSING_LINK + 2 * INNER_LINK
    major, minor = (
        CrossingSide(*map(to_array, (side_start, radius, radius + link + arc)))
        for side_start, link in ((radius, OUTER_LINK), (before + arc + radius, INNER_LINK))
    )
    loop_length = 2 * (2 * radius + CROSSING_LINK + INNER_LINK + OUTER_LINK + arc)
    offset = np.where(start >= before + exact_arc, arc - exact_arc, 0.0)
    return FigureEights(major, minor, to_array(loop_length), to_array(offset))


def figure_eight_contacts(position: Array, gap: Array, loop_length: Array) -> Array:
    """Return which vehicles touch the leader on the same lane, or overlap on the crossing; see `ring_contacts`."""
    xp, place = namespace(position), position % loop_length
    lengths, touches = lane_lengths(figure_eight_radius(loop_length)), gap < CONTACT_GAP
    if bool(touches.any()):
        lane, end = 0.0 * place, 0.0
        for length in lengths[:-1]:
            end = end + length
            lane = lane + (place > end)
        touches = touches & (lane == xp.concatenate([lane[1:], lane[:1]]))
    low, high = CROSSING_LINK / 2 - CAR_WIDTH / 2, CROSSING_LINK / 2 + CAR_WIDTH / 2 + VEHICLE_LENGTH
    fronts = ((place - start) % loop_length for start in (lengths[0], sum(lengths[:7])))
    first, second = ((front > low) & (front < high) for front in fronts)
    return touches | ((first | second) & (first.any(0) & second.any(0)))
