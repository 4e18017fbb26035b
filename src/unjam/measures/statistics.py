"""Means over seeds and over trainings, and how far to trust them: intervals that cover what they say.

An interval is Student's t: it covers 95 % from three values on; a percentile bootstrap of five covers 84 %.
Where none would cover there is none, and words show the range of the values instead.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import isnan, nan, sqrt
from statistics import NormalDist
from typing import Any

import numpy as np

from unjam.measures.metrics import METRICS, UNBOUNDED

CONFIDENCE = 0.95
MIN_INTERVAL_VALUES = 3
"""values without which there is no interval: that of two is thirteen times as wide as they are apart"""

METRICS_DEFINED_AT_EARLY_END = {
    *("collisions", "min_ttc", "min_time_gap", "cav_min_ttc", "max_drac", "max_jerk", "shield_max_braking"),
    *("cav_max_braking", "cut_in_max_braking", "human_max_braking"),
}
"""metrics that also count where an episode ended early: how near a collision was, and how many there were"""
RETURN_METRICS = {"return", "return_eq16"}
"""metrics whose value at a collision the reward defines"""
MIN_VERDICT_TRAININGS = 10
"""without which nothing is said of a way to learn, only of these trainings"""


@dataclass(frozen=True)
class Estimate:
    """A mean with its interval, NaN where there is none; all of it NaN where there is nothing to average."""

    mean: float
    low: float
    high: float
    count: int
    """values that it is the mean of"""
    smallest: float = field(default=nan, compare=False)
    largest: float = field(default=nan, compare=False)
    """of the values: what is said where there is no interval"""


def estimate(
    values: Sequence[float], confidence: float = CONFIDENCE, trim: float = 0.0, bounds: tuple[float, float] = UNBOUNDED
) -> Estimate:
    """Return the mean of `values` and its interval, Student's t; NaN values are left out.

    Of fewer than `LEAST` values there is no interval, and that of equal values has no width.

    Args:
        values: independent of each other.
        confidence: how often the interval shall hold the true mean.
        trim: share that is left out at either end, 0.25 for the interquartile mean; the interval is then that
            of the trimmed mean by winsorised variance: Tukey and McLaughlin 1963, Sankhya A 25.
        bounds: what the mean can be; the interval is cut there, which takes no true mean away.
    """
    finite = np.array([value for value in values if np.isfinite(value)], float)
    if not len(finite):
        return Estimate(nan, nan, nan, 0)
    most = max(0, (len(finite) - MIN_INTERVAL_VALUES) // 2)  # at least so many are kept
    cut, ordered = min(int(trim * len(finite)), most), np.sort(finite)
    kept = ordered[cut : len(finite) - cut] if cut else finite
    found = Estimate(float(kept.mean()), nan, nan, len(finite), float(ordered[0]), float(ordered[-1]))
    if len(finite) < MIN_INTERVAL_VALUES or (kept.min() == kept.max() and found.smallest < found.largest):
        return found
    # Of equal values the variance may be a rounding error.
    winsorised = np.clip(finite, kept.min(), kept.max())
    variance = float(winsorised.var()) * len(finite) if found.smallest < found.largest else 0.0
    error = sqrt(variance / (len(kept) * (len(kept) - 1)))
    half = _student_t(len(kept) - 1, confidence) * error
    return replace(found, low=max(found.mean - half, bounds[0]), high=min(found.mean + half, bounds[1]))


def _student_t(degrees: float, confidence: float = CONFIDENCE) -> float:
    """Return the t of Student's distribution within which, to both sides, `confidence` of it lies."""
    from scipy.special import stdtrit  # a third of what a command takes to start, and many have no interval

    return float(stdtrit(degrees, 0.5 + confidence / 2))


def display_digits(value: Estimate, digits: int) -> int:
    """Return with how many digits to show an estimate: two more where a mean would be rounded to zero."""
    return digits + 2 if value.mean and not round(value.mean, digits) else digits


def has_ended_early(row: dict[str, Any]) -> bool:
    """Return whether an episode ran, but ended early, from its row of `measure`."""
    return row.get("status", "completed") not in ("completed", "failed")


def metric_value(row: dict[str, Any], name: str) -> float:
    """Return a metric of a row of `measure` for statistics: NaN where an early end makes it meaningless.

    Early ends are not averaged with complete episodes: a metric of the first minutes is not one of an hour.
    """
    counts = not has_ended_early(row) or name in METRICS_DEFINED_AT_EARLY_END
    return row[name] if counts or (name in RETURN_METRICS and row["status"] == "collision") else nan


def metric_estimate(rows: Sequence[dict[str, Any]], name: str) -> Estimate:
    """Return the estimate of a metric over the rows of `measure`."""
    return estimate([metric_value(row, name) for row in rows], bounds=METRICS[name].bounds)


def summarize(rows: Sequence[dict[str, Any]]) -> dict[str, Estimate]:
    """Return the estimate of every metric over the rows of `measure`."""
    return {name: metric_estimate(rows, name) for name in METRICS}


def pair_rows(
    rows: Sequence[dict[str, Any]], others: Sequence[dict[str, Any]]
) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Return each row with the other of its seed, where there is one."""
    other = {str(row["seed"]): row for row in others}
    return [(row, other[str(row["seed"])]) for row in rows if str(row["seed"]) in other]


def paired_difference(
    rows: Sequence[dict[str, Any]], others: Sequence[dict[str, Any]], name: str, confidence: float = CONFIDENCE
) -> Estimate:
    """Return the estimate of the difference, same seeds paired, of a metric between two sets of rows."""
    differences = [metric_value(row, name) - metric_value(other, name) for row, other in pair_rows(rows, others)]
    return estimate(differences, confidence=confidence)


def linearized_ratio(numerators: Any, denominators: Any) -> Any:
    """Return numbers whose mean is mean(values) / mean(scales), and whose interval is that of this ratio.

    Each pair, of one seed, lies as far from the ratio as it moves it: the delta method, for a scale that is
    measured on the same seeds errs with what is measured by it. Both have the shape (seeds,).

    Source: Cochran 1977, Sampling Techniques, section 6.3.
    """
    ratio = np.mean(numerators) / np.mean(denominators)
    return ratio + (numerators - ratio * denominators) / np.mean(denominators)


def format_difference(difference: Estimate, digits: int = 0) -> str:
    """Return a difference with its sign and its interval; where it has none, the range of several values."""
    if not difference.count:
        return "–"
    interval = format_ci(difference, f"+.{digits}f")
    return f"{difference.mean:+.{digits}f}{' ' if interval else ''}{interval}"


def format_share(share: Estimate) -> str:
    """Return a share in per cent, with its interval, where it has one."""
    interval = "" if isnan(share.low) else f" [{100 * share.low:.0f}, {100 * share.high:.0f}]"
    return f"{100 * share.mean:.0f} %{interval}"


def format_ci(value: Estimate, format_spec: str) -> str:
    """Return the interval in words, where there is none the range; empty of a single value."""
    if not isnan(value.low):
        return f"[{value.low:{format_spec}}, {value.high:{format_spec}}]"
    if value.count < 2 or isnan(value.smallest):
        return ""
    return f"({value.smallest:{format_spec}} to {value.largest:{format_spec}})"


def gain_verdict(gain: Estimate, trainings: int = 1) -> str:
    """Return what may be said of a return beyond the expert's: that a residual pays needs ten trainings."""
    if isnan(gain.low):
        return "There is no interval: nothing is shown."
    if gain.low <= 0 <= gain.high:
        return "No gain is shown: the interval holds zero."
    if trainings < MIN_VERDICT_TRAININGS:
        who = "one training" if trainings == 1 else f"{trainings} trainings"
        more = "more" if gain.low > 0 else "less"
        return f"It earns {more}: that is {who}, and a residual pays where {MIN_VERDICT_TRAININGS} show it."
    return "The residual pays." if gain.low > 0 else "The residual makes it worse."


def estimate_over_trainings(
    values: Sequence[float], trim: float = 0.0, bounds: tuple[float, float] = UNBOUNDED
) -> Estimate:
    """Return the estimate of a number of each training: of two modes there is no interval, but the range."""
    found = estimate(values, trim=trim, bounds=bounds)
    return replace(found, low=nan, high=nan) if is_bimodal(values) else found


def paired_differences(runs: Sequence[Sequence[dict[str, Any]]], others: Sequence[dict[str, Any]], name: str) -> Any:
    """Return the differences of a metric, shape (trainings, seeds), on the seeds that all have driven."""
    tables = [{str(row["seed"]): metric_value(row, name) for row in rows} for rows in (others, *runs)]
    seeds = [seed for seed in tables[0] if all(np.isfinite(table.get(seed, nan)) for table in tables)]
    other, *found = ([table[seed] for seed in seeds] for table in tables)
    return np.array(found, np.float64).reshape(len(runs), len(seeds)) - np.array(other)


def probability_of_improvement(differences: Any) -> Estimate:
    """Return how often a driver is better than another on the same seed, a tie counting half.

    The interval is Wilson's, which stays possible and covers near 0 and 1, too; of several trainings with the
    number of independent episodes that would have their variance. Differences have the shape (trainings,
    seeds); above zero is better.

    Source: Wilson 1927, Journal of the American Statistical Association 22; Korn and Graubard 1998, Survey
    Methodology 24.
    """
    better = (differences > 0) + 0.5 * (differences == 0)
    trainings, seeds = better.shape
    count = seeds if trainings == 1 else trainings
    if not better.size or min(seeds, count) < MIN_INTERVAL_VALUES:
        return Estimate(float(better.mean()) if better.size else nan, nan, nan, count if better.size else 0)
    share, episodes, z = float(better.mean()), float(seeds), NormalDist().inv_cdf(0.5 + CONFIDENCE / 2)
    if trainings > 1:
        variance, degrees = _crossed_variance(better)
        episodes = share * (1 - share) / variance if variance else min(better.shape)
        z = _student_t(degrees)
    middle = share + z**2 / (2 * episodes)
    half = z * sqrt(share * (1 - share) / episodes + (z / episodes) ** 2 / 4)
    low, high = ((middle + side * half) / (1 + z**2 / episodes) for side in (-1, 1))
    return Estimate(share, min(max(low, 0.0), share), max(min(high, 1.0), share), count)


def is_bimodal(values: Sequence[float]) -> bool:
    """Return whether values fall into two groups of two at least, with a gap between that is no accident.

    The mean is then that of no training. The gap is wider than the range times 1/3 + 2/n, which fewer than
    three in a hundred normal samples have; that of three values cannot be told.
    """
    ordered = np.sort(values)
    gaps = np.diff(ordered)[1:-1]
    return len(gaps) > 0 and gaps.max() > (1 / 3 + 2 / len(ordered)) * (ordered[-1] - ordered[0])


def estimate_crossed(values: Any) -> Estimate:
    """Return the mean over trainings that were judged on shared seeds, with its 95 % interval.

    Both trainings and seeds are drawn at random, and every training meets every seed: two-way random effects
    without repetition. The interval is that of Student's t with Satterthwaite's degrees of freedom. Of fewer
    than `LEAST` trainings or seeds, and of trainings of two modes, there is none, but the range of means.
    Values have the shape (trainings, seeds).

    Source: Satterthwaite 1946, Biometrics Bulletin 2; Searle, Casella, McCulloch 1992, Variance Components.
    """
    table = np.asarray(values, np.float64)
    if not table.size:
        return Estimate(nan, nan, nan, 0)
    mean, means = float(table.mean()), table.mean(1)
    found = Estimate(mean, nan, nan, len(table), float(means.min()), float(means.max()))
    if min(table.shape) < MIN_INTERVAL_VALUES or is_bimodal(means):
        return found
    variance, degrees = _crossed_variance(table)
    half = _student_t(degrees) * sqrt(variance)
    return replace(found, low=mean - half, high=mean + half)


def estimate_on_shared_seeds(values: Any) -> Estimate:
    """Return `estimate_crossed` of several trainings, `estimate` of a single driver.

    Values have the shape (drivers, seeds).
    """
    return estimate_crossed(values) if len(values) > 1 else estimate(values[0].tolist())


def _crossed_variance(table: Any) -> tuple[float, float]:
    """Return the variance of the mean, (MS_T + MS_S - MS_R) / (T S), and its degrees of freedom."""
    trainings, seeds = table.shape
    rows, columns = table.mean(1) - table.mean(), table.mean(0) - table.mean()
    rest = table - table.mean() - rows[:, None] - columns
    freedom = np.array([trainings - 1.0, seeds - 1.0, (trainings - 1.0) * (seeds - 1.0)])
    squares = np.array([seeds * (rows**2).sum(), trainings * (columns**2).sum(), (rest**2).sum()]) / freedom
    # Never below what one of both alone would give: estimated by chance, the difference may be negative.
    spread = float(max(squares[0] + squares[1] - squares[2], squares[0], squares[1]))
    if spread == 0:
        return 0.0, min(freedom)
    return spread / table.size, float(spread**2 / (squares**2 / freedom).sum())
