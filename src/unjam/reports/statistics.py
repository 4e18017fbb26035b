"""Means over seeds, and how far to trust them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import bootstrap

from unjam.reports.metrics import METRICS

CONFIDENCE = 0.95
RESAMPLES = 2000


@dataclass(frozen=True)
class Estimate:
    """A mean over seeds with its bootstrap interval; NaN where there is nothing to average."""

    mean: float
    low: float
    high: float
    count: int
    """values that it is the mean of"""


def estimate(values: Sequence[float]) -> Estimate:
    """Return the mean of `values` and its 95 % percentile bootstrap interval; NaN values are left out.

    The interval is deterministic: its resamples come from a fixed seed. Of one value it is NaN.
    """
    finite = np.array([value for value in values if np.isfinite(value)], float)
    if len(finite) == 0:
        return Estimate(float("nan"), float("nan"), float("nan"), 0)
    mean = float(finite.mean())
    if len(finite) == 1:
        return Estimate(mean, float("nan"), float("nan"), 1)
    if np.ptp(finite) == 0:
        return Estimate(mean, mean, mean, len(finite))
    found = bootstrap(
        (finite,), np.mean, confidence_level=CONFIDENCE, n_resamples=RESAMPLES, method="percentile", rng=0
    )
    low, high = found.confidence_interval
    return Estimate(mean, float(low), float(high), len(finite))


def summarise(rows: Sequence[dict[str, Any]]) -> dict[str, Estimate]:
    """Return the estimate of every metric over the rows of `measure`."""
    return {name: estimate([row[name] for row in rows]) for name in METRICS}


def paired_difference(
    rows: Sequence[dict[str, Any]], others: Sequence[dict[str, Any]], name: str
) -> Estimate:
    """Return the estimate of the difference, same seeds paired, of a metric between two sets of rows."""
    other = {str(row["seed"]): row[name] for row in others}
    return estimate([row[name] - other[str(row["seed"])] for row in rows if str(row["seed"]) in other])
