"""What a driver gains on a road of many: 0 is people alone, 1 the best that is known there.

So roads can be compared and averaged whose numbers are not alike: speed on closed roads, travel time on those
with ends.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from unjam.measures.effect import FLOW_METRIC, MAX_FLOW_LOSS
from unjam.measures.feasibility import FEASIBLE, overall_feasibility
from unjam.measures.statistics import Estimate, estimate, linearized_ratio, paired_difference
from unjam.worlds.record import Floats

MIN_GAIN, MAX_GAIN = -1.0, 1.5
"""between which a gain counts"""
MIN_REFERENCE_GAIN = 0.03
"""share of people's own number by which the best must be better: else there is only to lose"""
MEAN_GAIN = "mean gain"
"""what an expert is tuned for on several roads"""

EpisodeRows = Sequence[dict[str, Any]]


def performance(row: dict[str, Any]) -> float:
    """Return what a road is judged by, larger being better, from a row of `measure`.

    Minus the travel time, waiting included [s], on roads with ends; the mean speed of all in the second half
    of the episode [m/s] on closed ones.
    """
    return -row["travel_time"] if np.isfinite(row["travel_time"]) else row["mean_speed_second_half"]


def performance_bound(row: dict[str, Any]) -> float:
    """Return what nobody can be better than in the long run: that of a free road, or of one without waves."""
    if np.isfinite(row["travel_time"]):
        return row["delay"] - row["travel_time"]
    return row["mean_speed"] / row["speed_limit_ratio"]


def is_gain_negligible(baseline: EpisodeRows, reference: Sequence[float]) -> bool:
    """Return whether the best is hardly better than people, so that only what is lost counts."""
    before = float(np.mean([performance(row) for row in baseline]))
    return float(np.mean(reference)) - before < MIN_REFERENCE_GAIN * abs(before)


def normalized_differences(rows: EpisodeRows, baseline: EpisodeRows, reference: Sequence[float]) -> Floats:
    """Return by how much a driver is better than people on each seed, over what the best is, around the mean.

    Where the best is better by less than `LEAST`, over that; nothing where it could not drive at all.
    Arguments as `gain` takes them.
    """
    alone = {str(row["seed"]): (performance(row), most) for row, most in zip(baseline, reference, strict=True)}
    before, most = np.array([alone[str(row["seed"])] for row in rows]).T
    scales = np.abs(before) * MIN_REFERENCE_GAIN if is_gain_negligible(baseline, reference) else most - before
    return linearized_ratio(np.nan_to_num(np.array([performance(row) for row in rows]) - before, nan=0.0), scales)


def is_gain_capped(rows: EpisodeRows, baseline: EpisodeRows, reference: Sequence[float]) -> bool:
    """Return whether only what is lost counts: no car could drive so, flow falls, or nothing is to be gained.

    Arguments as `gain` takes them.
    """
    flow = paired_difference(rows, baseline, FLOW_METRIC)
    slower = flow.high < -MAX_FLOW_LOSS * float(np.mean([row[FLOW_METRIC] for row in baseline]))
    return is_gain_negligible(baseline, reference) or slower or overall_feasibility(rows, baseline) != FEASIBLE


def normalized_gain(rows: EpisodeRows, baseline: EpisodeRows, reference: Sequence[float]) -> Estimate:
    """Return what a driver gains on one road beside people alone, the same seeds paired.

    `best` is what the best is worth on each of people's seeds, or what can be reached there. A driver that no
    car could drive, or that is shown to lower flow by more than 1 %, gains nothing: what it loses counts.
    Where the best is hardly better than people, what is not lost is all that counts.
    """
    found = estimate(normalized_differences(rows, baseline, reference).tolist())
    mean, low, high = (float(np.clip(each, MIN_GAIN, MAX_GAIN)) for each in (found.mean, found.low, found.high))
    if is_gain_capped(rows, baseline, reference):
        mean, low, high = min(mean, 0.0), min(low, 0.0), min(high, 0.0)
    return Estimate(mean, low, high, found.count)


def gain_by_seed(rows: EpisodeRows, baseline: EpisodeRows, reference: Sequence[float]) -> Floats:
    """Return the gain on one road, seed by seed around its mean; where a rule fixes it, losses alone differ.

    So means over roads that were driven on the same seeds have an interval over seeds: one may be kind to a
    driver on many roads. Arguments as `gain` takes them.
    """
    most = 0.0 if is_gain_capped(rows, baseline, reference) else MAX_GAIN
    values, mean = (
        np.clip(normalized_differences(rows, baseline, reference), MIN_GAIN, most),
        normalized_gain(rows, baseline, reference).mean,
    )
    return mean + (values - values.mean())
