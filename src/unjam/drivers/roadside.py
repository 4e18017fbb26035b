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
    """source of the speeds: `vehicles` current speeds of all vehicles; `cavs` speeds that CAVs have shared in the last
    `averaging_time`; `detectors` in each lane, means of the last `averaging_time` but one; `none` no speeds"""
    averaging_time: Positive = 60.0
    """time over which the speeds of CAVs, or those at detectors, are averaged [s]"""
    detector_spacing: Annotated[float, Field(ge=1)] = 500.0
    """distance between two detectors; the first one is half of it downstream of the entrance [m]"""
    latency: NonNegative = 0.0
    """time from measurement to arrival [s]"""
    smoothing_time: NonNegative = 0.0
    """time constant of exponential smoothing [s]"""
    loss_rate: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """share of lost messages; the last received message remains in use"""

    @property
    def description(self) -> str:
        """Description of the information about the traffic ahead, for certificates."""
        known_speeds = {
            "vehicles": "the speeds of all vehicles",
            "cavs": f"the speeds of CAVs in the last {self.averaging_time:g} s",
            "detectors": f"means of {self.averaging_time:g} s at detectors every {self.detector_spacing:g} m",
            "none": "nothing",
        }[self.source]
        delays = (("late by", self.latency), ("smoothed over", self.smoothing_time))
        impairments = [f"{words} {time:g} s" for words, time in delays if time]
        impairments += [f"{100 * self.loss_rate:g} % of the messages lost"] if self.loss_rate else []
        return ", ".join([known_speeds, *(impairments or ["without delay"])])


class RoadsideMessages:
    """Sends measurements of roads as messages, one in each control step, and stores the last received one."""

    def __init__(self, settings: RoadsideSettings, step: float, generator: np.random.Generator) -> None:
        """Start without a message; `step` is the control step [s]."""
        self._smoothing_factor = exp(-step / settings.smoothing_time) if settings.smoothing_time else 0.0
        self._delay_queue: deque[Floats] = deque(maxlen=1 + round(settings.latency / step))
        self._loss_rate, self._generator = settings.loss_rate, generator
        self._mean: Floats | None = None
        self.latest: Floats = np.zeros(0)
        """the last received message"""

    def send(self, measurement: Floats) -> None:
        """Send the current measurement, which always has the same shape."""
        if self._mean is not None:
            measurement = self._smoothing_factor * self._mean + (1.0 - self._smoothing_factor) * measurement
        self._mean = measurement
        self._delay_queue.append(measurement)
        if not self.latest.size or self._loss_rate == 0 or self._generator.random() >= self._loss_rate:
            self.latest = self._delay_queue[0]

    def replace_roads(self, roads: Sequence[int], source: "RoadsideMessages", source_roads: Sequence[int]) -> None:
        """Continue on `roads` with the messages of `source_roads` of `source`, which has sent only one message."""
        for measurement in (self._mean, *self._delay_queue):
            measurement[roads] = source.latest[source_roads]  # pyright: ignore[reportOptionalSubscript]


DENSITY_AVERAGING_TIME = 60.0
"""time constant of the mean flow and density of a section [s]; a wave passes 100 m in half a minute"""
JAM_ENTRY_SPEED_RATIO, JAM_EXIT_SPEED_RATIO = 0.8, 0.9
"""shares of the speed at highest flow, below which a section becomes congested, and above which it becomes free"""


class CongestionMonitor:
    """Detects congestion: a section is denser and much slower than at the highest flow that it has carried so far.

    In free traffic, flow increases with density, even if all vehicles drive far below the speed limit. In an episode
    that starts in a jam, no section counts as congested before its flow was once higher.
    """

    def __init__(self, sections: int, step: float) -> None:
        """Start with empty sections; `step` is the time between two measurements [s]."""
        self._update_weight = 1.0 - exp(-step / DENSITY_AVERAGING_TIME)
        self._density, self._flow, self._critical_density, self._highest_flow = np.zeros((4, sections))
        self._is_congested = np.zeros(sections, bool)

    def update(self, counts: Floats, speed_sums: Floats) -> NDArray[np.bool_]:
        """Return which sections are congested, given the numbers of their vehicles and the sums of speeds [m/s]."""
        self._density += self._update_weight * (counts - self._density)
        self._flow += self._update_weight * (speed_sums - self._flow)
        is_highest = self._flow > self._highest_flow
        self._highest_flow = np.where(is_highest, self._flow, self._highest_flow)
        self._critical_density = np.where(is_highest, self._density, self._critical_density)
        ratio = np.where(self._is_congested, JAM_EXIT_SPEED_RATIO, JAM_ENTRY_SPEED_RATIO)
        # speed < ratio * speed at highest flow, without a division by the density of empty sections
        is_slow = self._flow * self._critical_density < ratio * self._highest_flow * self._density
        self._is_congested = is_slow & (self._density > self._critical_density)
        return self._is_congested


class MeasuredVehicles(NamedTuple):
    """The current vehicles on main roads and their ramps; arrays of shape (vehicles,)."""

    lanes: NDArray[np.intp]
    """indices of the lanes; 0 for all ramps"""
    positions: Floats
    """positions along the road [m]"""
    speeds: Floats
    """speeds of the vehicles [m/s]"""
    are_cavs: NDArray[np.bool_]
    roads: Any = 0
    """indices of the roads, or one index for all vehicles"""

    def select(self, mask: NDArray[np.bool_]) -> "MeasuredVehicles":
        """Return the vehicles with a true entry in `mask`."""
        roads = np.broadcast_to(self.roads, mask.shape)[mask]
        return MeasuredVehicles(self.lanes[mask], self.positions[mask], self.speeds[mask], self.are_cavs[mask], roads)


class RoadSections:
    """The sections of main roads and their ramps, by lane."""

    def __init__(self, lane_count: int, length: float, road_count: int = 1) -> None:
        """Divide equal roads of a length [m] into sections; lane 0 is the lane of the ramps."""
        sections = int(np.ceil(length / ROAD_SECTION_LENGTH))
        self._shape, self.means_shape = (road_count, lane_count, sections), (road_count, lane_count + 1, sections)
        """`means_shape`: shape of mean speeds (roads, lanes + 1, sections); the last lane as in `totals`"""

    def totals(self, vehicles: MeasuredVehicles) -> Floats:
        """Return the number of vehicles and the sum of their speeds [m/s], shape (2, roads, lanes + 1, sections).

        The last lane stands for all lanes of the main road.
        """
        _, lane_count, section_count = self._shape
        sections = (vehicles.positions // ROAD_SECTION_LENGTH).astype(np.intp).clip(0, section_count - 1)
        cells = (vehicles.roads * lane_count + vehicles.lanes) * section_count + sections
        sums = [np.bincount(cells, weights, prod(self._shape)) for weights in (None, vehicles.speeds)]
        totals = np.array(sums, np.float64).reshape(2, *self._shape)
        # The main road has the lanes from 1 on.
        return np.concatenate([totals, totals[:, :, 1:].sum(2, keepdims=True)], 2)

    def speeds_ahead(self, means: Floats, lanes: NDArray[np.intp], positions: Floats, roads: Any = 0) -> list[Floats]:
        """Return mean speeds ahead [m/s] on the own lane and on all main lanes, both of shape (n, SECTIONS_AHEAD)."""
        own_sections = (positions // ROAD_SECTION_LENGTH).astype(np.intp).clip(0, self._shape[-1] - 1)
        sections = own_sections[:, None] + np.arange(SECTIONS_AHEAD)
        road_column = np.broadcast_to(roads, lanes.shape)[:, None]
        return [means[road_column, lane, sections] for lane in (lanes[:, None], -1)]


class SpeedMeasurement:
    """Measures the mean speeds of sections from the source of the settings."""

    def __init__(self, settings: RoadsideSettings, sections: RoadSections, allowed_speed: float, step: float) -> None:
        """Start without measurements; `step` is the time between two of them [s]."""
        self._settings, self._sections, self._allowed_speed, self._step = settings, sections, allowed_speed, step
        self._window: deque[Floats] = deque(maxlen=max(1, round(settings.averaging_time / step)))
        self._published = self._next = np.full(sections.means_shape, allowed_speed)
        """mean speeds at detectors in the last averaging time but one, and in the last averaging time [m/s]"""

    def update(self, vehicles: MeasuredVehicles) -> Floats:
        """Return mean speeds by road, lane (as in `totals`) and section [m/s]; the allowed speed if unknown."""
        if self._settings.source == "vehicles":
            means = _mean_speeds(self._sections.totals(vehicles), self._allowed_speed)
        elif self._settings.source == "cavs":
            self._window.append(self._sections.totals(vehicles.select(vehicles.are_cavs)))
            totals = np.sum(self._window, 0)
            means = _mean_speeds(totals, _mean_speeds(totals[:, :, -1:], self._allowed_speed))
        else:
            means = self._detector_means(vehicles)
        return np.pad(means, ((0, 0), (0, 0), (0, SECTIONS_AHEAD)), constant_values=self._allowed_speed)

    def clear_roads(self, roads: Sequence[int]) -> None:
        """Delete the speeds that were measured on some roads in the last averaging time."""
        for totals in self._window:
            totals[:, roads] = 0.0

    def _detector_means(self, vehicles: MeasuredVehicles) -> Floats:
        spacing = self._settings.detector_spacing
        nearest = (vehicles.positions // spacing + 0.5) * spacing
        has_passed = (vehicles.positions >= nearest) & (vehicles.positions - vehicles.speeds * self._step < nearest)
        passing_vehicles = vehicles._replace(positions=nearest).select(has_passed)
        self._window.append(self._sections.totals(passing_vehicles))
        if len(self._window) == self._window.maxlen:
            self._published, self._next = self._next, _mean_speeds(np.sum(self._window, 0), self._next)
            self._window.clear()
        centers = (np.arange(self._published.shape[-1]) + 0.5) * ROAD_SECTION_LENGTH
        detector_sections = (centers // spacing + 0.5) * spacing // ROAD_SECTION_LENGTH
        return self._published[:, :, detector_sections.astype(np.intp).clip(0, len(centers) - 1)]


def _mean_speeds(totals: Floats, default_speed: Floats | float) -> Floats:
    """Return mean speeds [m/s]; the default speed where there is no vehicle."""
    counts, speed_sums = totals
    return np.where(counts > 0, speed_sums / counts.clip(1), default_speed)
