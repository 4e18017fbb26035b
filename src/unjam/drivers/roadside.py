"""What a roadside or cloud service tells of the road: mean speeds by lane and section, late and smoothed."""

from collections import deque
from math import exp, prod
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass

from unjam.drivers.local_state import SECTION, SECTIONS_AHEAD
from unjam.parameters import STRICT, NotNegative
from unjam.physics.arrays import Floats


@dataclass(frozen=True, config=STRICT)
class Roadside:
    """How a message differs from what is there now."""

    age: NotNegative = 0.0
    """time from measurement to arrival [s]"""
    smoothing: NotNegative = 0.0
    """time constant of exponential smoothing [s]"""
    loss: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """share of messages that are lost: the last one that came is used"""


class Messages:
    """What was measured all along the road, as it arrives decision by decision."""

    def __init__(self, roadside: Roadside, step: float, generator: np.random.Generator) -> None:
        """Begin without a message; `step` is the time between two decisions [s]."""
        self._kept = exp(-step / roadside.smoothing) if roadside.smoothing else 0.0
        self._late: deque[Floats] = deque(maxlen=1 + round(roadside.age / step))
        self._loss, self._generator = roadside.loss, generator
        self._smooth: Floats | None = None
        self.arrived: Floats = np.zeros(0)
        """the last message that came"""

    def send(self, measured: Floats) -> None:
        """Take what is measured now, of the same shape each time."""
        if self._smooth is not None:
            measured = self._kept * self._smooth + (1.0 - self._kept) * measured
        self._smooth = measured
        self._late.append(measured)
        if not self.arrived.size or self._loss == 0 or self._generator.random() >= self._loss:
            self.arrived = self._late[0]


AVERAGING = 60.0
"""time constant of the mean flow and density of a section [s]; a wave passes 100 m in half a minute"""
JAM_ENTRY, JAM_EXIT = 0.8, 0.9
"""shares of the speed at highest flow: below the first a section becomes congested, up to the second it
remains so"""


class CongestionMonitor:
    """Tells congestion from free flow in each section, by the highest flow that the section has carried.

    While traffic flows freely, flow rises with density, also where all drive far below the speed limit. A
    section is congested once it is denser and much slower than it was at its highest flow. Where an episode
    begins in a jam, the jam has the highest flow, and nothing is congested before more flow is seen.
    """

    def __init__(self, sections: int, step: float) -> None:
        """Begin with empty sections; `step` is the time between two measurements [s]."""
        self._new = 1.0 - exp(-step / AVERAGING)
        self._density, self._flow, self._critical_density, self._highest_flow = np.zeros((4, sections))
        self._congested = np.zeros(sections, bool)

    def update(self, counts: Floats, speed_sums: Floats) -> NDArray[np.bool_]:
        """Return which sections are congested, after one more measurement of their vehicles.

        Densities are in vehicles of a section, and flows their speeds' sums [m/s]: only ratios matter.
        """
        self._density += self._new * (counts - self._density)
        self._flow += self._new * (speed_sums - self._flow)
        higher = self._flow > self._highest_flow
        self._highest_flow = np.where(higher, self._flow, self._highest_flow)
        self._critical_density = np.where(higher, self._density, self._critical_density)
        share = np.where(self._congested, JAM_EXIT, JAM_ENTRY)
        # speed < share * speed at highest flow, without a division by empty sections
        slower = self._flow * self._critical_density < share * self._highest_flow * self._density
        self._congested = slower & (self._density > self._critical_density)
        return self._congested


class MainRoad:
    """The sections of a main road and of its ramps by way, and which of them lie ahead."""

    def __init__(self, ways: int, length: float, roads: int = 1) -> None:
        """Cut roads that are alike, of a length [m], into sections; way 0 is the ramp's."""
        self._shape = roads, ways, int(np.ceil(length / SECTION))

    def means(
        self, ways: NDArray[np.intp], places: Floats, speeds: Floats, allowed: float, roads: Any = 0
    ) -> Floats:
        """Return mean speeds by road, way and section, in the last row of all ways of a main road [m/s].

        A section where nobody is counts as `allowed`, and so do those behind the end. Arrays of shape
        (vehicles,): the way that each is on, its place along the road [m], its speed, and which road it is.
        """
        _, rows, sections = self._shape
        section = (places // SECTION).astype(np.intp).clip(0, sections - 1)
        cell = (roads * rows + ways) * sections + section
        count, total = (np.bincount(cell, weight, prod(self._shape)) for weight in (None, speeds))
        # the last row is of all ways of the main road, which are those from 1 on
        count, total = (each.reshape(self._shape).astype(np.float64) for each in (count, total))
        count, total = (np.hstack([each, each[:, 1:].sum(1, keepdims=True)]) for each in (count, total))
        mean = np.where(count > 0, total / count.clip(1), allowed)
        return np.pad(mean, ((0, 0), (0, 0), (0, SECTIONS_AHEAD)), constant_values=allowed)

    def ahead(
        self, means: Floats, ways: NDArray[np.intp], places: Floats, roads: Any = 0
    ) -> tuple[Floats, Floats]:
        """Return the means of the sections ahead, on the own way and on the whole main road: (n, ahead)."""
        first = (places // SECTION).astype(np.intp).clip(0, self._shape[-1] - 1)
        columns = first[:, None] + np.arange(SECTIONS_AHEAD)
        road = np.broadcast_to(roads, ways.shape)[:, None]
        return means[road, ways[:, None], columns], means[road, -1, columns]
