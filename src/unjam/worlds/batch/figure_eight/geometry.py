"""Where the lanes of W figures eight are, as SUMO has them; arrays have shape (W,) or (vehicles, W)."""

from collections.abc import Sequence
from math import pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.physics.arrays import Array, namespace
from unjam.scenarios.figure_eight import CROSSING_LINK, INNER_LINK, OUTER_LINK, figure_eight_radius, lane_lengths
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.batch.leaders import CONTACT_GAP
from unjam.worlds.batch.noise import ArrayFactory

LANE_LENGTH_DIGITS = 6
"""of the lengths of lanes in SUMO's networks [m]"""
CAR_WIDTH = 1.8
"""[m], of every vehicle"""


class CrossingSide(NamedTuple):
    """One of the two ways across."""

    start: Array
    """where it begins [m], shape (W,)"""
    lane_length: Array
    """length of the lane before it [m], likewise"""
    approach_distance: Array
    """way before it from which SUMO expects vehicles there [m], likewise"""


class FigureEights(NamedTuple):
    """W figures eight."""

    major: CrossingSide
    """the way that goes first"""
    minor: CrossingSide
    """the way that yields"""
    loop_length: Array
    """length of a lap [m]"""
    position_offset: Array
    """where SUMO has each vehicle more than the road as it is drawn [m], shape (vehicles, W)"""

    def distances_past(self, position: Array) -> list[Array]:
        """Return how far each is beyond the beginning of both ways across [m]: a lap less, before it."""
        place = position + self.position_offset
        return [(place - side.start) % self.loop_length for side in (self.major, self.minor)]


def make_figure_eights(roads: Sequence[ClosedRoad], to_array: ArrayFactory) -> FigureEights:
    """Return figures eight, with lengths of as many digits as SUMO reads."""
    radius = np.array([road.drawn_values["radius"] for road in roads])
    begun = np.stack([road.start_positions for road in roads], 1)
    exact = 1.5 * pi * radius
    arc = exact.round(LANE_LENGTH_DIGITS)
    before = 2 * radius + CROSSING_LINK + 2 * INNER_LINK
    major, minor = (
        CrossingSide(to_array(start), to_array(radius), to_array(radius + link + arc))
        for start, link in ((radius, OUTER_LINK), (before + arc + radius, INNER_LINK))
    )
    return FigureEights(
        major=major,
        minor=minor,
        loop_length=to_array(2 * (2 * radius + CROSSING_LINK + INNER_LINK + OUTER_LINK + arc)),
        position_offset=to_array(np.where(begun >= before + exact, arc - exact, 0.0)),
    )


def figure_eight_contacts(position: Array, gap: Array, loop_length: Array) -> Array:
    """Return which vehicles touch the one ahead on the same lane, or cover the crossing as another one does.

    Args:
        position: front bumpers along the road [m], shape (vehicles, ...).
        gap: to the vehicle ahead [m], likewise.
        loop: length of the road [m].
    """
    xp, place = namespace(position), position % loop_length
    lanes, found = lane_lengths(figure_eight_radius(loop_length)), gap < CONTACT_GAP
    if bool(found.any()):
        lane, end = 0.0 * place, 0.0
        for length in lanes[:-1]:
            end = end + length
            lane = lane + (place > end)
        found = found & (lane == xp.concatenate([lane[1:], lane[:1]]))
    covers = [
        (fronts > CROSSING_LINK / 2 - CAR_WIDTH / 2) & (fronts < CROSSING_LINK / 2 + CAR_WIDTH / 2 + VEHICLE_LENGTH)
        for start in (lanes[0], sum(lanes[:7]))
        for fronts in [(place - start) % loop_length]
    ]
    both = covers[0].any(0) & covers[1].any(0)
    return found | ((covers[0] | covers[1]) & both)


def crossing_starts(roads: Sequence[ClosedRoad]) -> NDArray[np.float64]:
    """Return where roads cross themselves, shape (crossings, W) [m]."""
    return np.array([[start for start, _ in road.crossings] for road in roads]).T
