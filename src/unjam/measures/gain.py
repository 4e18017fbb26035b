"""Normalized gain of a driver on a road: 0 is the human baseline, 1 the best known driver.

The gain makes roads with different metrics comparable: speed on closed roads, travel time on open roads.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from unjam.measures.effect import FLOW_METRIC, MAX_FLOW_LOSS
from unjam.measures.feasibility import FEASIBLE, EpisodeRows, overall_feasibility
from unjam.measures.statistics import Estimate, estimate, linearized_ratio, paired_difference
from unjam.worlds.record import Floats

MIN_GAIN, MAX_GAIN = -1.0, 1.5  # range to which gains are clipped
MIN_REFERENCE_GAIN = 0.03
"""improvement by the reference, relative to the baseline's performance, below which there is nothing to gain"""
MEAN_GAIN = "mean gain"  # name of the objective of tuning on several roads


def performance(row: dict[str, Any]) -> float:
    """Return the performance from a row of `measure`; larger is better.

    It is minus the travel time on open roads, departure delay included [s], and the mean speed of all vehicles in the
    second half of the episode on closed roads [m/s].
    """
    return -row["travel_time"] if np.isfinite(row["travel_time"]) else row["mean_speed_second_half"]


def performance_bound(row: dict[str, Any]) -> float:
    """Return an upper bound of performance: that in free flow on open roads, and without waves on closed roads."""
    if np.isfinite(row["travel_time"]):
        return row["delay"] - row["travel_time"]
    return row["mean_speed"] / row["speed_limit_ratio"]


def is_gain_negligible(baseline: EpisodeRows, reference: Sequence[float]) -> bool:
    """Return whether the reference is so close to the human baseline that there is nothing to gain."""
    baseline_mean = float(np.mean([performance(row) for row in baseline]))
    return float(np.mean(reference)) - baseline_mean < MIN_REFERENCE_GAIN * abs(baseline_mean)


def normalized_differences(rows: EpisodeRows, baseline: EpisodeRows, reference: Sequence[float]) -> Floats:
    """Return the gain over the baseline for each seed, relative to the gain of the reference and linearized.

    A negligible gain of the reference is replaced by `MIN_REFERENCE_GAIN`. Episodes that did not run have a gain of
    zero. The arguments are those of `normalized_gain`.
    """
    pairs = {str(row["seed"]): (performance(row), best) for row, best in zip(baseline, reference, strict=True)}
    human, best = np.array([pairs[str(row["seed"])] for row in rows]).T
    scales = np.abs(human) * MIN_REFERENCE_GAIN if is_gain_negligible(baseline, reference) else best - human
    return linearized_ratio(np.nan_to_num(np.array([performance(row) for row in rows]) - human, nan=0.0), scales)


def is_gain_capped(rows: EpisodeRows, baseline: EpisodeRows, reference: Sequence[float]) -> bool:
    """Return whether positive gains count as zero: the driver is infeasible or lowers flow, or no gain is possible."""
    flow = paired_difference(rows, baseline, FLOW_METRIC)
    lowers_flow = flow.high < -MAX_FLOW_LOSS * float(np.mean([row[FLOW_METRIC] for row in baseline]))
    return is_gain_negligible(baseline, reference) or lowers_flow or overall_feasibility(rows, baseline) != FEASIBLE


def normalized_gain(rows: EpisodeRows, baseline: EpisodeRows, reference: Sequence[float]) -> Estimate:
    """Return the gain of a driver over the human baseline on one road, paired by seed.

    `reference` is the best known performance on each seed of the baseline, or an upper bound. The gain is at
    most zero where the driver is infeasible, where it is shown to lower flow by more than 1 %, and where the
    reference is hardly better than the baseline.
    """
    gain = estimate(normalized_differences(rows, baseline, reference).tolist())
    limit = 0.0 if is_gain_capped(rows, baseline, reference) else MAX_GAIN
    mean, low, high = (float(np.clip(value, MIN_GAIN, limit)) for value in (gain.mean, gain.low, gain.high))
    return Estimate(mean, low, high, gain.count)


def gain_by_seed(rows: EpisodeRows, baseline: EpisodeRows, reference: Sequence[float]) -> Floats:
    """Return the gain on one road for each seed; the mean over seeds is that of `normalized_gain`.

    The CI of a mean over roads that share seeds is computed from these values, shape (seeds,). The arguments are those
    of `normalized_gain`.
    """
    limit = 0.0 if is_gain_capped(rows, baseline, reference) else MAX_GAIN
    gains = np.clip(normalized_differences(rows, baseline, reference), MIN_GAIN, limit)
    return normalized_gain(rows, baseline, reference).mean + (gains - gains.mean())
