"""Roadside information: mean speeds by lane and section, and congestion, as delayed and smoothed I2V messages."""

from collections import deque
from collections.abc import Sequence
from math import exp, prod
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from unjam.drivers.local_state import ROAD_SECTION_LENGTH, SECTIONS_AHEAD
from unjam.parameters import STRICT, NonNegative, Positive, Subclassable, parameter_dataclass
from unjam.physics.arrays import Floats

SpeedSource = Literal["vehicles", "cavs", "detectors", "none"]


@parameter_dataclass(frozen=True, config=STRICT)
class RoadsideSettings(Subclassable):
    """What a message contains, and how it differs from the current measurement."""

    source: SpeedSource = "vehicles"
    """whose speeds are known: those of all vehicles now; of CAVs, which share theirs, in the last `averaging_time`; of
    vehicles that pass detectors in each lane, as means of the last `averaging_time` but one; or none"""
    averaging_time: Positive = 60.0
    """time over which the speeds of CAVs, or those at detectors, are averaged [s]"""
    detector_spacing: Annotated[float, Field(ge=1)] = 500.0
    """distance between two detectors; the first one is half of it downstream of the entrance [m]"""
    latency: NonNegative = 0.0
    """time from measurement to arrival [s]"""
    smoothing_time: NonNegative = 0.0
    """time constant of exponential smoothing [s]"""
    loss_rate: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """share of lost messages: the last received one is used instead"""

    @property
    def description(self) -> str:
        """What controllers know of the traffic ahead, in words."""
        known = {
            "vehicles": "the speeds of all vehicles",
            "cavs": f"the speeds of CAVs in the last {self.averaging_time:g} s",
            "detectors": f"means of {self.averaging_time:g} s at detectors every {self.detector_spacing:g} m",
            "none": "nothing",
        }[self.source]
        delays = (("late by", self.latency, "s"), ("smoothed over", self.smoothing_time, "s"))
        parts = [f"{words} {value:g} {unit}" for words, value, unit in delays if value]
        parts += [f"{100 * self.loss_rate:g} % of the messages lost"] if self.loss_rate else []
        return ", ".join([known, *(parts or ["without delay"])])


class RoadsideMessages:
    """The measurements of a road as received messages, one per control step."""

    def __init__(self, settings: RoadsideSettings, step: float, generator: np.random.Generator) -> None:
        """Start without a message; `step` is the control step [s]."""
        self._smoothing_factor = exp(-step / settings.smoothing_time) if settings.smoothing_time else 0.0
        self._delay_queue: deque[Floats] = deque(maxlen=1 + round(settings.latency / step))
        self._loss_rate, self._generator = settings.loss_rate, generator
        self._mean: Floats | None = None
        self.latest: Floats = np.zeros(0)
        """the last received message"""

    def send(self, measurement: Floats) -> None:
        """Send the current measurement, of the same shape each time."""
        if self._mean is not None:
            measurement = self._smoothing_factor * self._mean + (1.0 - self._smoothing_factor) * measurement
        self._mean = measurement
        self._delay_queue.append(measurement)
        if not self.latest.size or self._loss_rate == 0 or self._generator.random() >= self._loss_rate:
            self.latest = self._delay_queue[0]

    def replace_roads(self, roads: Sequence[int], source: "RoadsideMessages", source_roads: Sequence[int]) -> None:
        """Continue on some roads with the messages of other roads, to which only one was sent."""
        for values in (self._mean, *self._delay_queue):
            values[roads] = source.latest[source_roads]  # pyright: ignore[reportOptionalSubscript]


DENSITY_AVERAGING_TIME = 60.0
"""time constant of the mean flow and density of a section [s]; a wave passes 100 m in half a minute"""
JAM_ENTRY_SPEED_RATIO, JAM_EXIT_SPEED_RATIO = 0.8, 0.9
"""shares of the speed at highest flow: a section becomes congested below the first, and is free above the second"""


class CongestionMonitor:
    """Detects congestion: a section is denser and much slower than at the highest flow that it has carried so far.

    In free traffic, flow increases with density, even if all vehicles drive far below the speed limit. An episode that
    starts in a jam has no congestion before a higher flow.
    """

    def __init__(self, sections: int, step: float) -> None:
        """Start with empty sections; `step` is the time between two measurements [s]."""
        self._update_weight = 1.0 - exp(-step / DENSITY_AVERAGING_TIME)
        self._density, self._flow, self._critical_density, self._highest_flow = np.zeros((4, sections))
        self._is_congested = np.zeros(sections, bool)

    def update(self, counts: Floats, speed_sums: Floats) -> NDArray[np.bool_]:
        """Return which sections are congested, after the number of their vehicles and the sum of speeds [m/s]."""
        self._density += self._update_weight * (counts - self._density)
        self._flow += self._update_weight * (speed_sums - self._flow)
        higher = self._flow > self._highest_flow
        self._highest_flow = np.where(higher, self._flow, self._highest_flow)
        self._critical_density = np.where(higher, self._density, self._critical_density)
        ratio = np.where(self._is_congested, JAM_EXIT_SPEED_RATIO, JAM_ENTRY_SPEED_RATIO)
        # speed < ratio * speed at highest flow, without a division by empty sections
        slower = self._flow * self._critical_density < ratio * self._highest_flow * self._density
        self._is_congested = slower & (self._density > self._critical_density)
        return self._is_congested


class MeasuredVehicles(NamedTuple):
    """The vehicles on main roads and their ramps now; arrays of shape (vehicles,)."""

    lanes: NDArray[np.intp]
    """lane index; 0 is that of the ramps"""
    positions: Floats
    """along the road [m]"""
    speeds: Floats
    """mean speeds of the sections [m/s]"""
    are_cavs: NDArray[np.bool_]
    roads: Any = 0
    """index of the road"""

    def select(self, mask: NDArray[np.bool_]) -> "MeasuredVehicles":
        """Return some of the vehicles."""
        roads = np.broadcast_to(self.roads, mask.shape)[mask]
        return MeasuredVehicles(self.lanes[mask], self.positions[mask], self.speeds[mask], self.are_cavs[mask], roads)


class RoadSections:
    """The sections of main roads and their ramps, by lane."""

    def __init__(self, lane_count: int, length: float, road_count: int = 1) -> None:
        """Divide equal roads of a length [m] into sections; lane 0 is that of the ramp."""
        sections = int(np.ceil(length / ROAD_SECTION_LENGTH))
        self._shape, self.means_shape = (road_count, lane_count, sections), (road_count, lane_count + 1, sections)
        """`means_shape`: the shape of mean speeds: roads, lanes and all lanes of the main road, sections"""

    def totals(self, vehicles: MeasuredVehicles) -> Floats:
        """Return the number of vehicles and the sum of their speeds [m/s], shape (2, roads, lanes + 1, sections).

        The last lane stands for all lanes of the main road.
        """
        _, lane_count, sections = self._shape
        section = (vehicles.positions // ROAD_SECTION_LENGTH).astype(np.intp).clip(0, sections - 1)
        cell = (vehicles.roads * lane_count + vehicles.lanes) * sections + section
        counts = [np.bincount(cell, weight, prod(self._shape)) for weight in (None, vehicles.speeds)]
        totals = np.array(counts, np.float64).reshape(2, *self._shape)
        # The main road has the lanes from 1 on.
        return np.concatenate([totals, totals[:, :, 1:].sum(2, keepdims=True)], 2)

    def speeds_ahead(self, means: Floats, lanes: NDArray[np.intp], positions: Floats, roads: Any = 0) -> list[Floats]:
        """Return the means of the sections ahead, on the own lane and on the whole main road: (n, ahead)."""
        first = (positions // ROAD_SECTION_LENGTH).astype(np.intp).clip(0, self._shape[-1] - 1)
        columns = first[:, None] + np.arange(SECTIONS_AHEAD)
        road = np.broadcast_to(roads, lanes.shape)[:, None]
        return [means[road, lane, columns] for lane in (lanes[:, None], -1)]


class SpeedMeasurement:
    """The mean speeds of sections as their source knows them."""

    def __init__(self, settings: RoadsideSettings, sections: RoadSections, allowed_speed: float, step: float) -> None:
        """Start without measurements; `step` is the time between two of them [s]."""
        self._settings, self._sections, self._allowed_speed, self._step = settings, sections, allowed_speed, step
        self._window: deque[Floats] = deque(maxlen=max(1, round(settings.averaging_time / step)))
        self._published = self._next = np.full(sections.means_shape, allowed_speed)
        """means of the detectors' last interval but one, and of the last one"""

    def update(self, vehicles: MeasuredVehicles) -> Floats:
        """Return mean speeds by road, lane (as in `totals`) and section [m/s]; the allowed speed if unknown."""
        if self._settings.source == "vehicles":
            means = _means(self._sections.totals(vehicles), self._allowed_speed)
        elif self._settings.source == "cavs":
            self._window.append(self._sections.totals(vehicles.select(vehicles.are_cavs)))
            totals = np.sum(self._window, 0)
            means = _means(totals, _means(totals[:, :, -1:], self._allowed_speed))
        else:
            means = self._detector_means(vehicles)
        return np.pad(means, ((0, 0), (0, 0), (0, SECTIONS_AHEAD)), constant_values=self._allowed_speed)

    def clear_roads(self, roads: Sequence[int]) -> None:
        """Forget what CAVs have measured on some roads."""
        for totals in self._window:
            totals[:, roads] = 0.0

    def _detector_means(self, vehicles: MeasuredVehicles) -> Floats:
        spacing = self._settings.detector_spacing
        nearest = (vehicles.positions // spacing + 0.5) * spacing
        has_passed = (vehicles.positions >= nearest) & (vehicles.positions - vehicles.speeds * self._step < nearest)
        passing = vehicles._replace(positions=nearest).select(has_passed)
        self._window.append(self._sections.totals(passing))
        if len(self._window) == self._window.maxlen:
            self._published, self._next = self._next, _means(np.sum(self._window, 0), self._next)
            self._window.clear()
        centers = (np.arange(self._published.shape[-1]) + 0.5) * ROAD_SECTION_LENGTH
        detectors = (centers // spacing + 0.5) * spacing // ROAD_SECTION_LENGTH
        return self._published[:, :, detectors.astype(np.intp).clip(0, len(centers) - 1)]


def _means(totals: Floats, missing: Floats | float) -> Floats:
    count, total = totals
    return np.where(count > 0, total / count.clip(1), missing)
