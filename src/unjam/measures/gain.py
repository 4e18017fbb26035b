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

MIN_GAIN, MAX_GAIN = -1.0, 1.5
"""range to which gains are clipped"""
MIN_REFERENCE_GAIN = 0.03
"""improvement by the reference, relative to the baseline's performance, below which there is nothing to gain"""
MEAN_GAIN_OBJECTIVE = "mean gain"
"""name of the objective of tuning on several roads"""


def performance(row: dict[str, Any]) -> float:
    """Return the performance from a row of `measure`; larger is better.

    On open roads, which have a finite travel time, it is minus the travel time with departure delay [s]. On closed
    roads it is the mean speed of all vehicles in the second half of the episode [m/s].
    """
    return -row["travel_time"] if np.isfinite(row["travel_time"]) else row["mean_speed_second_half"]


def performance_bound(row: dict[str, Any]) -> float:
    """Return an upper bound of performance: free flow on open roads, and the limit speed on closed roads.

    The limit speed is that of the road without waves, recovered from the ratio of the mean speed to it.
    """
    if np.isfinite(row["travel_time"]):
        return row["delay"] - row["travel_time"]
    return row["mean_speed"] / row["speed_limit_ratio"]


def is_gain_negligible(baseline: EpisodeRows, reference: Sequence[float]) -> bool:
    """Return whether the reference is so close to the human baseline that there is nothing to gain."""
    baseline_mean = float(np.mean([performance(row) for row in baseline]))
    return float(np.mean(reference)) - baseline_mean < MIN_REFERENCE_GAIN * abs(baseline_mean)


def unclipped_gains(rows: EpisodeRows, baseline: EpisodeRows, reference: Sequence[float]) -> Floats:
    """Return the normalized gain of each seed before clipping, shape (seeds,).

    The mean over seeds is the mean gain divided by the mean gain of the reference. A negligible gain of the reference
    is replaced by `MIN_REFERENCE_GAIN`. An episode that did not run counts as a difference of zero to the baseline.
    The arguments are those of `normalized_gain`.
    """
    pairs = {
        str(row["seed"]): (performance(row), reference_value)
        for row, reference_value in zip(baseline, reference, strict=True)
    }
    baseline_values, reference_values = np.array([pairs[str(row["seed"])] for row in rows]).T
    is_negligible = is_gain_negligible(baseline, reference)
    scales = np.abs(baseline_values) * MIN_REFERENCE_GAIN if is_negligible else reference_values - baseline_values
    differences = np.array([performance(row) for row in rows]) - baseline_values
    return linearized_ratio(np.nan_to_num(differences, nan=0.0), scales)


def is_positive_gain_excluded(rows: EpisodeRows, baseline: EpisodeRows, reference: Sequence[float]) -> bool:
    """Return whether positive gains count as zero: the driver is infeasible or lowers flow, or no gain is possible."""
    flow = paired_difference(rows, baseline, FLOW_METRIC)
    lowers_flow = flow.high < -MAX_FLOW_LOSS * float(np.mean([row[FLOW_METRIC] for row in baseline]))
    return is_gain_negligible(baseline, reference) or lowers_flow or overall_feasibility(rows, baseline) != FEASIBLE


def normalized_gain(rows: EpisodeRows, baseline: EpisodeRows, reference: Sequence[float]) -> Estimate:
    """Return the gain of a driver over the human baseline on one road, paired by seed.

    `reference` is the best known performance on each seed of the baseline, or an upper bound. The gain is at most zero
    if the driver is infeasible, if the whole CI shows a loss of flow above `MAX_FLOW_LOSS`, or if the gain of the
    reference is negligible.
    """
    gain = estimate(unclipped_gains(rows, baseline, reference).tolist())
    limit = 0.0 if is_positive_gain_excluded(rows, baseline, reference) else MAX_GAIN
    mean, low, high = (float(np.clip(value, MIN_GAIN, limit)) for value in (gain.mean, gain.low, gain.high))
    return Estimate(mean, low, high, gain.count)


def gain_by_seed(rows: EpisodeRows, baseline: EpisodeRows, reference: Sequence[float]) -> Floats:
    """Return the clipped gain for each seed, shifted so that the mean over seeds is that of `normalized_gain`.

    The CI of a mean over roads that share seeds is computed from these values, shape (seeds,). The arguments are those
    of `normalized_gain`.
    """
    limit = 0.0 if is_positive_gain_excluded(rows, baseline, reference) else MAX_GAIN
    gains = np.clip(unclipped_gains(rows, baseline, reference), MIN_GAIN, limit)
    return normalized_gain(rows, baseline, reference).mean + (gains - gains.mean())  # clipping of seeds moves the mean
