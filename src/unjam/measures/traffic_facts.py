"""Macroscopic facts of motorway traffic: breakdown, capacity and its drop, waves, time gaps, lane changes.

The methods are those for detectors and aerial recordings of real motorways, so that simulated traffic can be compared
with real traffic. Positions are relative to the point `MERGING_LENGTH` upstream of the end of the merging section, or
to its start if the section is shorter.
"""

from dataclasses import dataclass
from math import nan

import numpy as np
from numpy.typing import NDArray

from unjam.physics.arrays import Floats
from unjam.scenarios.motorway import Motorway
from unjam.worlds.record import Episode

MERGING_LENGTH = 300.0  # length of the bottleneck, the downstream end of a longer merging section [m]
INTERVAL = 60.0  # counting interval of detectors [s]
BREAKDOWN_MINUTES = 5
"""number of intervals in which traffic must stay slow, and over which flow is averaged before and after a breakdown"""
BREAKDOWN_SPEED_RATIO = 0.65  # speed / limit below which traffic is congested: 65 km/h at a limit of 100 km/h
UPSTREAM_DETECTOR, DOWNSTREAM_DISTANCE = -200.0, 300.0
"""position of the detector for breakdowns, and distance of the detector for the discharge downstream of the merging
section [m]"""
CELL = 100.0  # length of the cells over which speeds are averaged [m]
WAVE_DISTANCE = 400.0  # distance between two compared series of speeds [m]: waves pass it in 90 s
WAVE_SMOOTHING, MAX_WAVE_LAG = (
    20.0,
    240.0,
)  # averaging time of these series, and maximum time of a wave for the distance [s]
APPROACH = (-1700.0, UPSTREAM_DETECTOR)
"""range in which time gaps are measured, upstream of disturbances by the merging section [m]"""
LANE_CHANGE_RANGE = (-1700.0, -500.0)  # range in which lane changes are counted, without those due to the ramp [m]
FOLLOWING_TIME_GAP = 4.0  # time gap below which a vehicle counts as following [s]
DENSE_MINUTES = 10  # number of intervals before a breakdown in which free traffic is dense
FREE_SPEED_RATIO, CONGESTED_SPEEDS = 0.7, (2.0, 12.0)
"""minimum speed / limit of free traffic, and range of speeds in congestion [m/s]"""
MERGE_DETECTOR = 1.0  # position of the detectors on the lane of the ramp and on the right lane [m]
NEAR_MERGE, BRAKING_QUANTILE = -500.0, 0.999
"""start of the range up to the end of the merging section in which braking is measured [m], and its quantile"""
MIN_SAMPLES = 100  # minimum number of values of a median or quantile, exclusive


@dataclass(frozen=True)
class TrafficFacts:
    """Facts of the traffic of one episode; NaN if they cannot be measured."""

    breakdown_time: float = (
        nan  # time at which traffic upstream of the merging section becomes slow for several minutes [s]
    )
    flow_before: float = nan  # flow downstream in the minutes before the breakdown [veh/h per lane]
    highest_flow: float = nan  # highest mean downstream flow of 5 minutes before a breakdown, if any [veh/h per lane]
    discharge: float = nan  # downstream flow in congestion, without the first minutes [veh/h per lane]
    congested_speed: float = nan  # mean speed at the upstream detector in the same period [m/s]
    wave_speed: float = nan  # speed of stop-and-go waves; negative upstream [m/s]
    merge_ratio: float = nan  # flow of the ramp / flow of the right lane, in the same period
    free_time_gap: float = nan  # median net time gap of followers in the free traffic before a breakdown [s]
    congested_time_gap: float = nan  # median net time gap of followers in congestion [s]
    lane_changes_per_km: float = nan  # lane changes per vehicle and km before a breakdown, far from the ramp
    hardest_braking: float = nan
    """99.9 % quantile of decelerations from 500 m upstream to the end of the merging section [m/s2]"""

    @property
    def capacity_drop(self) -> float:
        """Decrease of flow from before the breakdown to the discharge, relative to the flow before."""
        return 1.0 - self.discharge / self.flow_before


def measure_traffic(episode: Episode, scenario: Motorway, ramp_index: int = 0) -> TrafficFacts:
    """Return the facts of the traffic of an episode near one of the merging sections of a motorway."""
    ramp, lanes = scenario.ramps[ramp_index], scenario.lanes
    stride, step = episode.snapshot_stride, episode.control_step * episode.snapshot_stride
    merging_length = min(ramp.merging_length, MERGING_LENGTH)
    merge_end = ramp.position + ramp.merging_length - scenario.geometry.origin
    positions, lane_indices = episode.positions - (merge_end - merging_length), episode.lane_indices
    speeds = episode.speeds[::stride][: len(positions)]
    per_interval = round(INTERVAL / step)

    def detect(position: float, lane: int | None = None) -> tuple[Floats, Floats]:
        """Return flow [veh/h] and mean speed [m/s] of each interval at a detector on one lane, by default on all."""
        with np.errstate(invalid="ignore"):
            has_passed = (positions[:-1] <= position) & (positions[1:] > position)
        if lane is not None:
            has_passed &= lane_indices[1:] == lane
        steps = len(has_passed) // per_interval * per_interval  # steps in whole intervals
        has_passed = has_passed[:steps].reshape(-1, per_interval, positions.shape[1])
        passing_speeds = np.where(has_passed, speeds[1 : steps + 1].reshape(has_passed.shape), 0.0)
        counts = has_passed.sum((1, 2))
        mean = np.where(counts > 0, passing_speeds.sum((1, 2)) / counts.clip(1), np.nan)
        return counts * 3600.0 / INTERVAL, mean

    flow = detect(merging_length + DOWNSTREAM_DISTANCE)[0] / lanes
    upstream_speed = detect(UPSTREAM_DETECTOR)[1]
    is_slow = np.nan_to_num(upstream_speed, nan=np.inf) < BREAKDOWN_SPEED_RATIO * scenario.speed_limit
    begin, end = _first_congestion(is_slow)
    moving_flow = np.convolve(flow, np.ones(BREAKDOWN_MINUTES) / BREAKDOWN_MINUTES, "valid")
    facts = {"highest_flow": float(moving_flow[: max(begin - BREAKDOWN_MINUTES, 0) + 1].max())}
    if begin < len(is_slow):
        facts["breakdown_time"] = begin * INTERVAL
        facts["flow_before"] = float(flow[max(begin - BREAKDOWN_MINUTES, 0) : max(begin, 1)].mean())
        steady = slice(begin + BREAKDOWN_MINUTES, end)
        if end - steady.start >= BREAKDOWN_MINUTES:
            facts["discharge"] = float(flow[steady].mean())
            facts["congested_speed"] = float(np.nanmean(upstream_speed[steady]))
            on_ramp, on_right_lane = (detect(MERGE_DETECTOR, lane)[0][steady].sum() for lane in (lanes, lanes - 1))
            facts["merge_ratio"] = float(on_ramp / on_right_lane) if on_right_lane else nan
        congested = slice(begin * per_interval, end * per_interval)
        main_road_positions = np.where(lane_indices < lanes, positions, np.nan)[congested]
        facts["wave_speed"] = wave_speed(main_road_positions, speeds[congested], step)
    free = slice(max(begin - DENSE_MINUTES, 0) * per_interval, begin * per_interval)
    with np.errstate(invalid="ignore", divide="ignore"):
        is_on_approach = (positions > APPROACH[0]) & (positions < APPROACH[1])
        time_gaps = np.where(is_on_approach, episode.gaps / speeds, np.nan)
        is_free = speeds[free] > FREE_SPEED_RATIO * scenario.speed_limit
        is_congested = (speeds > CONGESTED_SPEEDS[0]) & (speeds < CONGESTED_SPEEDS[1])
        facts["free_time_gap"] = _following_median(time_gaps[free][is_free])
        facts["congested_time_gap"] = _following_median(time_gaps[is_congested])
        previous_positions, next_positions = positions[free], positions[1:][free]
        is_in_range = (previous_positions > LANE_CHANGE_RANGE[0]) & (next_positions < LANE_CHANGE_RANGE[1])
        has_changed_lane = is_in_range & (lane_indices[free] != lane_indices[1:][free])
        distance = np.where(is_in_range, next_positions - previous_positions, 0.0).sum()
        facts["lane_changes_per_km"] = float(1000.0 * has_changed_lane.sum() / distance) if distance else nan
        is_near_merge = (positions[:-1] > NEAR_MERGE) & (positions[:-1] < merging_length)
        braking = (speeds[:-1] - speeds[1:])[is_near_merge & np.isfinite(speeds[1:])] / step
    if len(braking) > MIN_SAMPLES:
        facts["hardest_braking"] = float(np.quantile(braking, BRAKING_QUANTILE))
    return TrafficFacts(**facts)


def _first_congestion(is_slow: NDArray[np.bool_]) -> tuple[int, int]:
    """Return begin and end of the first `BREAKDOWN_MINUTES` or more slow intervals, the number of intervals if none."""
    for begin in range(len(is_slow) - BREAKDOWN_MINUTES + 1):
        if is_slow[begin : begin + BREAKDOWN_MINUTES].all():
            faster = np.flatnonzero(~is_slow[begin:])
            return begin, begin + int(faster[0]) if len(faster) else len(is_slow)
    return len(is_slow), len(is_slow)


def _following_median(time_gaps: Floats) -> float:
    """Return the median time gap of followers [s]; NaN with too few values."""
    following = time_gaps[time_gaps < FOLLOWING_TIME_GAP]
    return float(np.median(following)) if len(following) > MIN_SAMPLES else nan


def wave_speed(positions: Floats, speeds: Floats, step: float) -> float:
    """Return the speed of waves on the approach [m/s], negative upstream; NaN without waves.

    It follows from the time lag with the highest mean correlation between speeds in cells that are `WAVE_DISTANCE`
    apart. Both arrays have the shape (snapshots, vehicles); `step` is the time between two snapshots [s].
    """
    first_cell, last_cell = (round(position / CELL) for position in (APPROACH[0], 0.0))
    window = max(1, round(WAVE_SMOOTHING / step))
    if len(speeds) * step < 2 * MAX_WAVE_LAG:
        return nan
    series = np.array([_cell_speeds(positions, speeds, CELL * cell, window) for cell in range(first_cell, last_cell)])
    offset, lags = round(WAVE_DISTANCE / CELL), np.arange(1, round(MAX_WAVE_LAG / step))
    correlation = np.zeros(len(lags))
    for upstream, downstream in zip(series[:-offset], series[offset:], strict=True):
        if max(upstream.std(), downstream.std()) and np.isfinite(upstream + downstream).all():
            upstream, downstream = (
                (speeds - speeds.mean()) / max(speeds.std(), 1e-9) for speeds in (upstream, downstream)
            )
            correlation += [np.mean(downstream[:-lag] * upstream[lag:]) for lag in lags]
    return -WAVE_DISTANCE / (lags[correlation.argmax()] * step) if correlation.max() > 0 else nan


def _cell_speeds(positions: Floats, speeds: Floats, start: float, window: int) -> Floats:
    """Return the smoothed mean speed in a cell, interpolated while the cell is empty; NaN if it is always empty."""
    with np.errstate(invalid="ignore"):
        is_inside = (positions >= start) & (positions < start + CELL)
    counts, snapshots = is_inside.sum(1), np.arange(len(positions))
    occupied = np.flatnonzero(counts)
    if not len(occupied):
        return np.full(len(positions), nan)
    means = np.where(is_inside, speeds, 0.0).sum(1)[occupied] / counts[occupied]
    interpolated: Floats = np.asarray(np.interp(snapshots, occupied, means), np.float64)
    return np.convolve(interpolated, np.ones(window) / window, "valid")
