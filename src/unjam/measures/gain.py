"""What a driver gains on a road of many: 0 is people alone, 1 the best that is known there.

So roads can be compared and averaged whose numbers are not alike: speed on closed roads, travel time on those
with ends.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from unjam.measures.drivable import DRIVABLE, drivable_in_all
from unjam.measures.effect import FLOW, FLOW_LOST
from unjam.measures.statistics import Estimate, around_ratio, estimate, paired_difference
from unjam.worlds.record import Floats

WORST, MOST = -1.0, 1.5
"""between which a gain counts"""
LEAST = 0.03
"""share of people's own number by which the best must be better: else there is only to lose"""
MEAN_GAIN = "mean gain"
"""what an expert is tuned for on several roads"""

Rows = Sequence[dict[str, Any]]


def worth(row: dict[str, Any]) -> float:
    """Return what a road is judged by, larger being better, from a row of `measure`.

    Minus the travel time, waiting included [s], on roads with ends; the mean speed of all in the second half
    of the episode [m/s] on closed ones.
    """
    return -row["travel_time"] if np.isfinite(row["travel_time"]) else row["mean_speed_second_half"]


def ceiling(row: dict[str, Any]) -> float:
    """Return what nobody can be better than in the long run: that of a free road, or of one without waves."""
    if np.isfinite(row["travel_time"]):
        return row["delay"] - row["travel_time"]
    return row["mean_speed"] / row["speed_limit_ratio"]


def nothing_to_gain(people: Rows, best: Sequence[float]) -> bool:
    """Return whether the best is hardly better than people, so that only what is lost counts."""
    before = float(np.mean([worth(row) for row in people]))
    return float(np.mean(best)) - before < LEAST * abs(before)


def scaled(rows: Rows, people: Rows, best: Sequence[float]) -> Floats:
    """Return by how much a driver is better than people on each seed, over what the best is, around the mean.

    Where the best is better by less than `LEAST`, over that; nothing where it could not drive at all.
    Arguments as `gain` takes them.
    """
    alone = {str(row["seed"]): (worth(row), most) for row, most in zip(people, best, strict=True)}
    before, most = np.array([alone[str(row["seed"])] for row in rows]).T
    scales = np.abs(before) * LEAST if nothing_to_gain(people, best) else most - before
    return around_ratio(np.nan_to_num(np.array([worth(row) for row in rows]) - before, nan=0.0), scales)


def fixed_by_rule(rows: Rows, people: Rows, best: Sequence[float]) -> bool:
    """Return whether only what is lost counts: no car could drive so, flow falls, or nothing is to be gained.

    Arguments as `gain` takes them.
    """
    flow = paired_difference(rows, people, FLOW)
    slower = flow.high < -FLOW_LOST * float(np.mean([row[FLOW] for row in people]))
    return nothing_to_gain(people, best) or slower or drivable_in_all(rows, people) != DRIVABLE


def gain(rows: Rows, people: Rows, best: Sequence[float]) -> Estimate:
    """Return what a driver gains on one road beside people alone, the same seeds paired.

    `best` is what the best is worth on each of people's seeds, or what can be reached there. A driver that no
    car could drive, or that is shown to lower flow by more than 1 %, gains nothing: what it loses counts.
    Where the best is hardly better than people, what is not lost is all that counts.
    """
    found = estimate(scaled(rows, people, best).tolist())
    mean, low, high = (float(np.clip(each, WORST, MOST)) for each in (found.mean, found.low, found.high))
    if fixed_by_rule(rows, people, best):
        mean, low, high = min(mean, 0.0), min(low, 0.0), min(high, 0.0)
    return Estimate(mean, low, high, found.count)


def gain_by_seed(rows: Rows, people: Rows, best: Sequence[float]) -> Floats:
    """Return the gain on one road, seed by seed around its mean; where a rule fixes it, losses alone differ.

    So means over roads that were driven on the same seeds have an interval over seeds: one may be kind to a
    driver on many roads. Arguments as `gain` takes them.
    """
    most = 0.0 if fixed_by_rule(rows, people, best) else MOST
    values, mean = np.clip(scaled(rows, people, best), WORST, most), gain(rows, people, best).mean
    return mean + (values - values.mean())
