"""Macroscopic facts of motorway traffic: breakdown, capacity and its drop, waves, time gaps, lane changes.

They are measured as detectors and aerial recordings of real motorways are evaluated, so that simulated traffic can be
compared with them. All positions are relative to where the last `MERGING_LENGTH` of the merging section begin.
"""

from dataclasses import dataclass
from math import nan

import numpy as np
from numpy.typing import NDArray

from unjam.physics.arrays import Floats
from unjam.scenarios.motorway import Motorway
from unjam.worlds.record import Episode

MERGING_LENGTH = 300.0  # maximum length of a bottleneck: of a longer merging section the downstream end [m]
INTERVAL = 60.0  # time over which detectors count [s]
BREAKDOWN_MINUTES = 5
"""number of intervals for which traffic must stay slow, and over which the flow before and after it is averaged"""
BREAKDOWN_SPEED_RATIO = 0.65  # share of the limit below which traffic is congested: 65 km/h at a limit of 100 km/h
UPSTREAM_DETECTOR, DOWNSTREAM_DISTANCE = -200.0, 300.0
"""position of the detector that sees the breakdown [m], and distance of the one that measures the discharge downstream
of the merging section [m]"""
CELL = 100.0  # length of the cells in which speeds are averaged [m]
WAVE_DISTANCE = 400.0  # distance between two compared speed series [m]: a wave needs a minute and a half for it
WAVE_SMOOTHING, MAX_WAVE_LAG = 20.0, 240.0  # averaging time of these series, and longest time that a wave may need [s]
APPROACH = (-1700.0, UPSTREAM_DETECTOR)
"""range in which time gaps are measured, upstream of the disturbance by the merging section [m]"""
LANE_CHANGE_RANGE = (-1700.0, -500.0)  # range in which lane changes are counted: not those because of the ramp [m]
FOLLOWING_TIME_GAP = 4.0  # time gap below which a vehicle counts as following [s]
DENSE_MINUTES = 10  # number of intervals before a breakdown in which free traffic is dense
FREE_SPEED_RATIO, CONGESTED_SPEEDS = 0.7, (2.0, 12.0)
"""smallest speed of free traffic as a share of the limit, and range of speeds in congestion [m/s]"""
MERGE_DETECTOR = 1.0  # position of the detectors on the ramp's lane and the right lane next to it [m]
NEAR_MERGE, BRAKING_QUANTILE = -500.0, 0.999
"""position from which, to the end of the merging section, braking is measured [m], and the quantile"""
MIN_SAMPLES = 100  # number of values from which a median or quantile is meaningful


@dataclass(frozen=True)
class TrafficFacts:
    """Facts of one episode; NaN where the episode does not show them."""

    breakdown_time: float = nan  # when traffic upstream of the merging section becomes slow for several minutes [s]
    flow_before: float = nan  # flow downstream in the minutes before the breakdown [veh/h per lane]
    highest_flow: float = nan  # highest downstream flow in as many minutes, before a breakdown or ever [veh/h per lane]
    discharge: float = nan  # downstream flow while upstream is congested, without the first minutes [veh/h per lane]
    congested_speed: float = nan  # mean speed at the detector upstream in the same time [m/s]
    wave_speed: float = nan  # speed of stop-and-go waves; negative upstream [m/s]
    merge_ratio: float = nan  # flow of the ramp over that of the right lane, while traffic upstream is congested
    free_time_gap: float = nan  # median net time gap of followers in the free traffic before a breakdown [s]
    congested_time_gap: float = nan  # median net time gap of followers in congestion [s]
    lane_changes_per_km: float = nan  # lane changes per vehicle and km before a breakdown, far from the ramp
    hardest_braking: float = nan
    """99.9 % quantile of decelerations from 500 m upstream to the end of the merging section [m/s2]"""

    @property
    def capacity_drop(self) -> float:
        """Share by which the discharge is below the flow before the breakdown."""
        return 1.0 - self.discharge / self.flow_before


def measure_traffic(episode: Episode, scenario: Motorway, ramp_number: int = 0) -> TrafficFacts:
    """Return the facts of an episode of a motorway, around one of its merging sections."""
    ramp, lanes = scenario.ramps[ramp_number], scenario.lanes
    stride, step = episode.snapshot_stride, episode.control_step * episode.snapshot_stride
    merging_length = min(ramp.merging_length, MERGING_LENGTH)
    merge_end = ramp.position + ramp.merging_length - scenario.geometry.origin
    positions, lane_indices = episode.positions - (merge_end - merging_length), episode.lane_indices
    speeds = episode.speeds[::stride][: len(positions)]
    per_interval = round(INTERVAL / step)

    def detect(position: float, lane: int | None = None) -> tuple[Floats, Floats]:
        """Return flow [veh/h] and mean speed [m/s] of each interval at a detector across one lane or all."""
        with np.errstate(invalid="ignore"):
            passes = (positions[:-1] <= position) & (positions[1:] > position)
        if lane is not None:
            passes &= lane_indices[1:] == lane
        whole = len(passes) // per_interval * per_interval
        passes = passes[:whole].reshape(-1, per_interval, positions.shape[1])
        passing_speeds = np.where(passes, speeds[1 : whole + 1].reshape(passes.shape), 0.0)
        counts = passes.sum((1, 2))
        mean = np.where(counts > 0, passing_speeds.sum((1, 2)) / counts.clip(1), np.nan)
        return counts * 3600.0 / INTERVAL, mean

    flow = detect(merging_length + DOWNSTREAM_DISTANCE)[0] / lanes
    upstream_speed = detect(UPSTREAM_DETECTOR)[1]
    slow = np.nan_to_num(upstream_speed, nan=np.inf) < BREAKDOWN_SPEED_RATIO * scenario.speed_limit
    begin, end = _first_run(slow)
    moving_flow = np.convolve(flow, np.ones(BREAKDOWN_MINUTES) / BREAKDOWN_MINUTES, "valid")
    facts = {"highest_flow": float(moving_flow[: max(begin - BREAKDOWN_MINUTES, 0) + 1].max())}
    if begin < len(slow):
        facts["breakdown_time"] = begin * INTERVAL
        facts["flow_before"] = float(flow[max(begin - BREAKDOWN_MINUTES, 0) : max(begin, 1)].mean())
        steady = slice(begin + BREAKDOWN_MINUTES, end)
        if end - steady.start >= BREAKDOWN_MINUTES:
            facts["discharge"] = float(flow[steady].mean())
            facts["congested_speed"] = float(np.nanmean(upstream_speed[steady]))
            on_ramp, on_right_lane = (detect(MERGE_DETECTOR, lane)[0][steady].sum() for lane in (lanes, lanes - 1))
            facts["merge_ratio"] = float(on_ramp / on_right_lane) if on_right_lane else nan
        moments = slice(begin * per_interval, end * per_interval)
        on_main_road = np.where(lane_indices < lanes, positions, np.nan)[moments]
        facts["wave_speed"] = wave_speed(on_main_road, speeds[moments], step)
    free = slice(max(begin - DENSE_MINUTES, 0) * per_interval, begin * per_interval)
    with np.errstate(invalid="ignore", divide="ignore"):
        on_approach = (positions > APPROACH[0]) & (positions < APPROACH[1])
        time_gaps = np.where(on_approach, episode.gaps / speeds, np.nan)
        is_free = speeds[free] > FREE_SPEED_RATIO * scenario.speed_limit
        is_congested = (speeds > CONGESTED_SPEEDS[0]) & (speeds < CONGESTED_SPEEDS[1])
        facts["free_time_gap"] = _following_median(time_gaps[free][is_free])
        facts["congested_time_gap"] = _following_median(time_gaps[is_congested])
        before, after = positions[free], positions[1:][free]
        in_range = (before > LANE_CHANGE_RANGE[0]) & (after < LANE_CHANGE_RANGE[1])
        changes = in_range & (lane_indices[free] != lane_indices[1:][free])
        driven = np.where(in_range, after - before, 0.0).sum()
        facts["lane_changes_per_km"] = float(1000.0 * changes.sum() / driven) if driven else nan
        near = (positions[:-1] > NEAR_MERGE) & (positions[:-1] < merging_length)
        braking = (speeds[:-1] - speeds[1:])[near & np.isfinite(speeds[1:])] / step
    if len(braking) > MIN_SAMPLES:
        facts["hardest_braking"] = float(np.quantile(braking, BRAKING_QUANTILE))
    return TrafficFacts(**facts)


def _first_run(slow: NDArray[np.bool_]) -> tuple[int, int]:
    """Return begin and end of the first run of enough slow intervals; twice their number if there is none."""
    for begin in range(len(slow) - BREAKDOWN_MINUTES + 1):
        if slow[begin : begin + BREAKDOWN_MINUTES].all():
            later = np.flatnonzero(~slow[begin:])
            return begin, begin + int(later[0]) if len(later) else len(slow)
    return len(slow), len(slow)


def _following_median(time_gaps: Floats) -> float:
    following = time_gaps[time_gaps < FOLLOWING_TIME_GAP]
    return float(np.median(following)) if len(following) > MIN_SAMPLES else nan


def wave_speed(positions: Floats, speeds: Floats, step: float) -> float:
    """Return the speed at which slow traffic moves along an approach [m/s], negative upstream; NaN without waves.

    It is the lag with the highest mean correlation between the speeds in cells `WAVE_DISTANCE` apart. Both arrays have
    the shape (moments, vehicles); `step` is the time between two moments [s].
    """
    first, last = (round(position / CELL) for position in (APPROACH[0], 0.0))
    window = max(1, round(WAVE_SMOOTHING / step))
    if len(speeds) * step < 2 * MAX_WAVE_LAG:
        return nan
    series = np.array([_cell_speeds(positions, speeds, CELL * cell, window) for cell in range(first, last)])
    apart, lags = round(WAVE_DISTANCE / CELL), np.arange(1, round(MAX_WAVE_LAG / step))
    correlation = np.zeros(len(lags))
    for upstream, downstream in zip(series[:-apart], series[apart:], strict=True):
        if max(upstream.std(), downstream.std()) and np.isfinite(upstream + downstream).all():
            upstream, downstream = (
                (series - series.mean()) / max(series.std(), 1e-9) for series in (upstream, downstream)
            )
            correlation += [np.mean(downstream[:-lag] * upstream[lag:]) for lag in lags]
    return -WAVE_DISTANCE / (lags[correlation.argmax()] * step) if correlation.max() > 0 else nan


def _cell_speeds(positions: Floats, speeds: Floats, start: float, window: int) -> Floats:
    """Return the mean speed in a cell at each moment, interpolated where it is empty and smoothed; NaN if always."""
    with np.errstate(invalid="ignore"):
        inside = (positions >= start) & (positions < start + CELL)
    counts, moments = inside.sum(1), np.arange(len(positions))
    known = np.flatnonzero(counts)
    if not len(known):
        return np.full(len(positions), nan)
    means = np.where(inside, speeds, 0.0).sum(1)[known] / counts[known]
    interpolated: Floats = np.asarray(np.interp(moments, known, means), np.float64)
    return np.convolve(interpolated, np.ones(window) / window, "valid")
