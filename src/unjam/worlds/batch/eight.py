"""Where the lanes of W figures eight are, as SUMO has them; arrays have shape (W,) or (vehicles, W)."""

from collections.abc import Sequence
from math import pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.physics.arrays import Array, namespace
from unjam.scenarios.figure_eight import CROSSING_LINK, INNER_LINK, OUTER_LINK, lane_lengths, radius_of
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.batch.lanes import CONTACT
from unjam.worlds.batch.noise import Numbers

DIGITS = 6
"""of the lengths of lanes in SUMO's networks [m]"""
CAR_WIDTH = 1.8
"""[m], of every vehicle"""


class Side(NamedTuple):
    """One of the two ways across."""

    start: Array
    """where it begins [m], shape (W,)"""
    lane: Array
    """length of the lane before it [m], likewise"""
    seen: Array
    """way before it from which SUMO expects vehicles there [m], likewise"""


class Eights(NamedTuple):
    """W figures eight."""

    major: Side
    """the way that goes first"""
    minor: Side
    """the way that yields"""
    loop: Array
    """length of a lap [m]"""
    shift: Array
    """where SUMO has each vehicle more than the road as it is drawn [m], shape (vehicles, W)"""

    def beyond(self, position: Array) -> list[Array]:
        """Return how far each is beyond the beginning of both ways across [m]: a lap less, before it."""
        place = position + self.shift
        return [(place - side.start) % self.loop for side in (self.major, self.minor)]


def eights_of(roads: Sequence[ClosedRoad], numbers: Numbers) -> Eights:
    """Return figures eight, with lengths of as many digits as SUMO reads."""
    radius = np.array([road.drawn["radius"] for road in roads])
    begun = np.stack([road.start_positions for road in roads], 1)
    exact = 1.5 * pi * radius
    arc = exact.round(DIGITS)
    before = 2 * radius + CROSSING_LINK + 2 * INNER_LINK
    major, minor = (
        Side(numbers(start), numbers(radius), numbers(radius + link + arc))
        for start, link in ((radius, OUTER_LINK), (before + arc + radius, INNER_LINK))
    )
    return Eights(
        major=major,
        minor=minor,
        loop=numbers(2 * (2 * radius + CROSSING_LINK + INNER_LINK + OUTER_LINK + arc)),
        shift=numbers(np.where(begun >= before + exact, arc - exact, 0.0)),
    )


def touching_across(position: Array, gap: Array, loop: Array) -> Array:
    """Return which vehicles touch the one ahead on the same lane, or cover the crossing as another one does.

    Args:
        position: front bumpers along the road [m], shape (vehicles, ...).
        gap: to the vehicle ahead [m], likewise.
        loop: length of the road [m].
    """
    xp, place = namespace(position), position % loop
    lanes, found = lane_lengths(radius_of(loop)), gap < CONTACT
    if bool(found.any()):
        lane, end = 0.0 * place, 0.0
        for length in lanes[:-1]:
            end = end + length
            lane = lane + (place > end)
        found = found & (lane == xp.concatenate([lane[1:], lane[:1]]))
    covers = [
        (fronts > CROSSING_LINK / 2 - CAR_WIDTH / 2)
        & (fronts < CROSSING_LINK / 2 + CAR_WIDTH / 2 + VEHICLE_LENGTH)
        for start in (lanes[0], sum(lanes[:7]))
        for fronts in [(place - start) % loop]
    ]
    both = covers[0].any(0) & covers[1].any(0)
    return found | ((covers[0] | covers[1]) & both)


def beginnings(roads: Sequence[ClosedRoad]) -> NDArray[np.float64]:
    """Return where roads cross themselves, shape (crossings, W) [m]."""
    return np.array([[start for start, _ in road.crossings] for road in roads]).T
