"""Means over seeds, and how far to trust them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import bootstrap, trim_mean
from scipy.stats import t as student

from unjam.measures.metrics import METRICS

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


def estimate(
    values: Sequence[float], statistic: Callable[..., Any] = np.mean, confidence: float = CONFIDENCE
) -> Estimate:
    """Return the mean of `values` and its 95 % percentile bootstrap interval; NaN values are left out.

    The interval is deterministic: its resamples come from a fixed seed. Of one value it is NaN. Another
    `statistic` than the mean takes the values and an axis, like NumPy's; another `confidence` is that of the
    interval.
    """
    finite = np.array([value for value in values if np.isfinite(value)], float)
    mean = float(statistic(finite, axis=0)) if len(finite) else float("nan")
    if len(finite) < 2 or np.ptp(finite) == 0:
        end = mean if len(finite) > 1 else float("nan")
        return Estimate(mean, end, end, len(finite))
    found = bootstrap(
        (finite,), statistic, confidence_level=confidence, n_resamples=RESAMPLES, method="percentile", rng=0
    )
    low, high = found.confidence_interval
    return Estimate(mean, float(low), float(high), len(finite))


def digits_of(found: Estimate, digits: int) -> int:
    """Return with how many digits to show an estimate: two more where a mean would be rounded to zero."""
    return digits + 2 if found.mean and not round(found.mean, digits) else digits


def estimate_of(rows: Sequence[dict[str, Any]], name: str) -> Estimate:
    """Return the estimate of a metric over the rows of `measure`."""
    return estimate([row[name] for row in rows])


def summarise(rows: Sequence[dict[str, Any]]) -> dict[str, Estimate]:
    """Return the estimate of every metric over the rows of `measure`."""
    return {name: estimate_of(rows, name) for name in METRICS}


def paired_difference(
    rows: Sequence[dict[str, Any]],
    others: Sequence[dict[str, Any]],
    name: str,
    confidence: float = CONFIDENCE,
) -> Estimate:
    """Return the estimate of the difference, same seeds paired, of a metric between two sets of rows."""
    other = {str(row["seed"]): row[name] for row in others}
    differences = [row[name] - other[str(row["seed"])] for row in rows if str(row["seed"]) in other]
    return estimate(differences, confidence=confidence)


def signed(gain: Estimate, digits: int = 0) -> str:
    """Return a difference with its sign and, where it has one, its interval."""
    if not gain.count:
        return "–"
    interval = "" if np.isnan(gain.low) else f" [{gain.low:+.{digits}f}, {gain.high:+.{digits}f}]"
    return f"{gain.mean:+.{digits}f}{interval}"


def interquartile_mean(values: Any, axis: int = -1) -> Any:
    """Return the mean of the middle half of values; Agarwal et al. 2021, `Deep RL at the edge of the
    statistical precipice`.
    """
    return trim_mean(values, 0.25, axis=axis)


def probability_of_improvement(
    runs: Sequence[Sequence[dict[str, Any]]], others: Sequence[dict[str, Any]], name: str
) -> Estimate:
    """Return how often a trained controller is better than another driver on the same seed.

    Args:
        runs: rows of metrics of each training, on the same held-out seeds.
        others: rows of the other driver.
        name: of the metric; larger is better, and a tie counts half.

    Returns:
        The mean over trainings of the share of episodes, with its bootstrap interval over trainings.
    """
    other = {str(row["seed"]): row[name] for row in others}
    shares = []
    for rows in runs:
        differences = np.array([row[name] - other[str(row["seed"])] for row in rows])
        shares.append(float(np.mean((differences > 0) + 0.5 * (differences == 0))))
    return estimate(shares)


def crossed_estimate(values: Any) -> Estimate:
    """Return the mean over trainings that were judged on shared seeds, with its 95 % interval.

    Both trainings and seeds are drawn at random, and every training meets every seed: two-way random effects
    without repetition. The variance of the mean is (MS_T + MS_S - MS_R) / (T S), and the interval that of
    Student's t with Satterthwaite's degrees of freedom.

    Args:
        values: of each training on each seed, shape (T, S), both at least 2.

    Source: Satterthwaite 1946, Biometrics Bulletin 2; Searle, Casella, McCulloch 1992, Variance Components.
    """
    table = np.asarray(values, np.float64)
    trainings, seeds = table.shape
    mean = float(table.mean())
    rows, columns = table.mean(1) - mean, table.mean(0) - mean
    rest = table - mean - rows[:, None] - columns
    freedom = np.array([trainings - 1.0, seeds - 1.0, (trainings - 1.0) * (seeds - 1.0)])
    squares = np.array([seeds * (rows**2).sum(), trainings * (columns**2).sum(), (rest**2).sum()]) / freedom
    # Never below what one of both alone would give: estimated by chance, the difference may be negative.
    spread = max(squares[0] + squares[1] - squares[2], squares[0], squares[1])
    if spread == 0:
        return Estimate(mean, mean, mean, trainings)
    degrees = spread**2 / (squares**2 / freedom).sum()
    half = float(student.ppf(0.5 + CONFIDENCE / 2, degrees) * np.sqrt(spread / table.size))
    return Estimate(mean, mean - half, mean + half, trainings)
