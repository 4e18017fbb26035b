"""Means over seeds and over trainings, with confidence intervals (CI) that have the stated coverage.

A CI is that of Student's t, which has a coverage of 95 % for three values or more; a percentile bootstrap of five
values has 84 %. Where no CI has the stated coverage, texts show the range of the values instead.
"""

from collections import defaultdict
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from math import isnan, nan, sqrt
from statistics import NormalDist
from typing import Any

import numpy as np

from unjam.measures.feasibility import EpisodeRows
from unjam.measures.metrics import METRICS, UNBOUNDED
from unjam.text import format_count

CONFIDENCE = 0.95
MIN_INTERVAL_VALUES = 3  # minimum number of values for a CI; that of two is thirteen times as wide as their distance

METRICS_DEFINED_AT_EARLY_END = {
    *("collisions", "min_ttc", "min_time_gap", "cav_min_ttc", "max_drac", "max_jerk", "shield_max_braking"),
    *("cav_max_braking", "cut_in_max_braking", "human_max_braking"),
}  # metrics of conflicts, which are also defined for episodes that ended early
RETURN_METRICS = {"return", "return_eq16"}
"""metrics that are also defined for episodes with a collision, because the reward contains it"""
MIN_VERDICT_TRAININGS = 10
"""minimum number of trainings for a verdict on a method; with fewer, the verdict is about these trainings"""


@dataclass(frozen=True)
class Estimate:
    """A mean with its confidence interval (CI); all numbers are NaN if there are no values."""

    mean: float
    low: float
    """lower end of the CI; NaN without a CI"""
    high: float
    """upper end of the CI; NaN without a CI"""
    count: int
    """number of values"""
    smallest: float = field(default=nan, compare=False)
    """smallest value"""
    largest: float = field(default=nan, compare=False)
    """largest value; with `smallest` the range to show if there is no CI"""

    @property
    def half_width(self) -> float:
        """Half the width of the CI; NaN without one."""
        return (self.high - self.low) / 2.0


def estimate(
    values: Sequence[float], confidence: float = CONFIDENCE, trim: float = 0.0, bounds: tuple[float, float] = UNBOUNDED
) -> Estimate:
    """Return the mean of independent `values` with its CI; values that are not finite are left out.

    Fewer than `MIN_INTERVAL_VALUES` values have no CI; the CI of equal values has no width.

    Args:
        confidence: coverage of the CI.
        trim: share of the values that is left out at either end, 0.25 for the interquartile mean. The CI is then that
            of the trimmed mean by winsorized variance (Tukey and McLaughlin 1963, Sankhya A 25).
        bounds: smallest and largest possible mean, at which the CI is clipped.
    """
    finite = np.array([value for value in values if np.isfinite(value)], float)
    if not len(finite):
        return Estimate(nan, nan, nan, 0)
    max_cut = max(0, (len(finite) - MIN_INTERVAL_VALUES) // 2)  # MIN_INTERVAL_VALUES remain at least
    cut, ordered = min(int(trim * len(finite)), max_cut), np.sort(finite)
    trimmed = ordered[cut : len(finite) - cut] if cut else finite
    point = Estimate(float(trimmed.mean()), nan, nan, len(finite), float(ordered[0]), float(ordered[-1]))
    if len(finite) < MIN_INTERVAL_VALUES or (trimmed.min() == trimmed.max() and point.smallest < point.largest):
        return point
    # The computed variance of equal values may be a rounding error.
    winsorized = np.clip(finite, trimmed.min(), trimmed.max())
    variance = float(winsorized.var()) * len(finite) if point.smallest < point.largest else 0.0
    half = _student_t(len(trimmed) - 1, confidence) * sqrt(variance / (len(trimmed) * (len(trimmed) - 1)))
    return replace(point, low=max(point.mean - half, bounds[0]), high=min(point.mean + half, bounds[1]))


def _student_t(degrees: float, confidence: float = CONFIDENCE) -> float:
    """Return the two-sided quantile of Student's distribution."""
    from scipy.special import stdtrit  # imported late: it takes a third of the start of a command

    return float(stdtrit(degrees, 0.5 + confidence / 2))


def display_digits(value: Estimate, digits: int) -> int:
    """Return the number of digits with which to show an estimate: two more if the mean would be rounded to zero."""
    return digits + 2 if value.mean and not round(value.mean, digits) else digits


def count_teleports(rows: EpisodeRows) -> int:
    """Return the number of vehicles that SUMO teleported or removed in all episodes together."""
    return sum(row.get("teleports", 0) for row in rows)


def has_ended_early(row: dict[str, Any]) -> bool:
    """Return whether an episode ran but ended early, from its row of `measure`."""
    return row.get("status", "completed") not in ("completed", "failed")


def metric_value(row: dict[str, Any], name: str) -> float:
    """Return a metric from a row of `measure`: NaN if the episode ended early and the metric is then not comparable."""
    counts = not has_ended_early(row) or name in METRICS_DEFINED_AT_EARLY_END
    return row[name] if counts or (name in RETURN_METRICS and row["status"] == "collision") else nan


def metric_estimate(rows: EpisodeRows, name: str) -> Estimate:
    """Return the estimate of a metric over the rows of `measure`."""
    return estimate([metric_value(row, name) for row in rows], bounds=METRICS[name].bounds)


def summarize(rows: EpisodeRows) -> dict[str, Estimate]:
    """Return the estimate of every metric over the rows of `measure`."""
    return {name: metric_estimate(rows, name) for name in METRICS}


def pair_rows(rows: EpisodeRows, others: EpisodeRows) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Return the pairs of rows with equal seeds."""
    by_seed = {str(row["seed"]): row for row in others}
    return [(row, by_seed[str(row["seed"])]) for row in rows if str(row["seed"]) in by_seed]


def _group_pairs(rows: EpisodeRows, others: EpisodeRows) -> list[list[tuple[dict[str, Any], dict[str, Any]]]]:
    """Return the pairs of rows by recording, or else one by one.

    Episodes behind one recording differ in the noise of human drivers alone, and count as one.
    """
    groups = defaultdict[Hashable, list[tuple[dict[str, Any], dict[str, Any]]]](list)
    for number, pair in enumerate(pair_rows(rows, others)):
        groups[(pair[0]["file"], pair[0]["part"]) if "part" in pair[0] else number].append(pair)
    return [*groups.values()]


def count_units(rows: EpisodeRows, others: EpisodeRows) -> int:
    """Return the largest possible count of a paired difference: the number of pairs, or that of their recordings."""
    return len(_group_pairs(rows, others))


def format_units(rows: EpisodeRows, count: int, noun: str) -> str:
    """Return a count of paired differences with its noun, which is `recording` behind recorded vehicles."""
    return format_count(count, "recording" if any("part" in row for row in rows) else noun)


def _paired_values(rows: EpisodeRows, others: EpisodeRows, name: str) -> Any:
    """Return a metric in both sets of rows, shape (units, 2): means over the pairs of each unit with both values."""
    groups = (
        [both for pair in pairs if np.isfinite(both := [metric_value(row, name) for row in pair]).all()]
        for pairs in _group_pairs(rows, others)
    )
    return np.array([np.mean(values, axis=0) for values in groups if values], float).reshape(-1, 2)


def paired_difference(rows: EpisodeRows, others: EpisodeRows, name: str, confidence: float = CONFIDENCE) -> Estimate:
    """Return the estimate of the paired difference of a metric between two sets of rows; a recording is one value."""
    values = _paired_values(rows, others, name)
    return estimate((values[:, 0] - values[:, 1]).tolist(), confidence=confidence)


def linearized_ratio(numerators: Any, denominators: Any) -> Any:
    """Return one value per seed, the mean and CI of which are those of the ratio of two means (delta method).

    Numerators and denominators are measured on the same seeds, so their errors are correlated; shape (seeds,).
    Source: Cochran 1977, Sampling Techniques, section 6.3.
    """
    ratio = np.mean(numerators) / np.mean(denominators)
    return ratio + (numerators - ratio * denominators) / np.mean(denominators)


def relative_difference(rows: EpisodeRows, others: EpisodeRows, name: str) -> Estimate:
    """Return the estimate of the paired difference of a metric, relative to its mean in the other rows.

    Only seeds with both values are used, as for the difference itself. It is unknown where all other values are zero.
    """
    values = _paired_values(rows, others, name)
    if not values[:, 1].any():
        return estimate([])
    return estimate(linearized_ratio(values[:, 0] - values[:, 1], values[:, 1]).tolist())


def regress(predictors: Any, values: Any) -> list[Estimate]:
    """Return the change of values with one standard deviation of each predictor, by linear regression with 95 % CIs.

    Predictors have the shape (values, predictors). The CIs assume independent errors of one variance; those of a
    predictor that is constant, or follows from others, are unknown.
    """
    table, result = np.asarray(predictors, np.float64), np.asarray(values, np.float64)
    spread = table.std(0)
    design = np.column_stack([np.ones(len(table)), (table - table.mean(0)) / np.where(spread > 0, spread, 1.0)])
    coefficients, _, rank, _ = np.linalg.lstsq(design, result, rcond=None)
    degrees = len(result) - rank
    if rank < design.shape[1] or degrees < 1:
        return [Estimate(float(coefficient), nan, nan, len(result)) for coefficient in coefficients[1:]]
    variance = float(np.sum((result - design @ coefficients) ** 2)) / degrees
    halves = _student_t(float(degrees)) * np.sqrt(variance * np.diag(np.linalg.inv(design.T @ design)))
    pairs = zip(coefficients[1:].tolist(), halves[1:].tolist(), strict=True)
    return [Estimate(mean, mean - half, mean + half, len(result)) for mean, half in pairs]


def format_difference(difference: Estimate, digits: int = 0) -> str:
    """Return a difference with its sign, and its CI or else the range of the values, as text."""
    if not difference.count:
        return "–"
    interval = format_ci(difference, f"+.{digits}f")
    return f"{difference.mean:+.{digits}f}{' ' if interval else ''}{interval}"


def format_share(share: Estimate) -> str:
    """Return a share in percent, with its CI if it has one."""
    interval = "" if isnan(share.low) else f" [{100 * share.low:.0f}, {100 * share.high:.0f}]"
    return f"{100 * share.mean:.0f} %{interval}"


def format_percent(share: float) -> str:
    """Return a share in percent."""
    return f"{100 * share:g} %"


def format_ci(value: Estimate, format_spec: str) -> str:
    """Return the CI, or else the range of the values, as text; empty for a single value."""
    if not isnan(value.low):
        return f"[{value.low:{format_spec}}, {value.high:{format_spec}}]"
    if value.count < 2 or isnan(value.smallest):
        return ""
    return f"({value.smallest:{format_spec}} to {value.largest:{format_spec}})"


def is_expert_unchanged(gain: Estimate) -> bool:
    """Return whether a controller has the returns of its expert on all seeds: validation kept no trained network."""
    return gain.low == gain.high == 0


def gain_verdict(gain: Estimate) -> str:
    """Return a verdict on the difference of the return of one training to that of its expert, as a sentence."""
    if isnan(gain.low):
        return "No conclusion: there is no confidence interval."
    if is_expert_unchanged(gain):
        return "The trained controller drives exactly as its expert: no network was better in validation."
    if gain.low <= 0 <= gain.high:
        return "No gain is shown: the confidence interval contains zero."
    change = "increases" if gain.low > 0 else "decreases"
    return f"The return {change} in one training; a verdict on the residual needs {MIN_VERDICT_TRAININGS} trainings."


def estimate_over_trainings(
    values: Sequence[float], trim: float = 0.0, bounds: tuple[float, float] = UNBOUNDED
) -> Estimate:
    """Return the estimate from one value per training; bimodal values have no CI."""
    result = estimate(values, trim=trim, bounds=bounds)
    return replace(result, low=nan, high=nan) if is_bimodal(values) else result


def paired_differences(runs: Sequence[EpisodeRows], others: EpisodeRows, name: str) -> Any:
    """Return the differences of a metric, shape (trainings, seeds), on the seeds that all have."""
    tables = [{str(row["seed"]): metric_value(row, name) for row in rows} for rows in (others, *runs)]
    seeds = [seed for seed in tables[0] if all(np.isfinite(table.get(seed, nan)) for table in tables)]
    other, *values = ([table[seed] for seed in seeds] for table in tables)
    return np.array(values, np.float64).reshape(len(runs), len(seeds)) - np.array(other)


def probability_of_improvement(differences: Any) -> Estimate:
    """Return the share of seeds on which a driver is better than another; a tie counts half.

    Differences have the shape (trainings, seeds); above zero is better. The CI is Wilson's, which stays within
    [0, 1] and also covers near its ends; with several trainings, for the number of independent episodes that
    would have the same variance. Sources: Wilson 1927, Journal of the American Statistical Association 22;
    Korn and Graubard 1998, Survey Methodology 24.
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
    center = share + z**2 / (2 * episodes)
    half = z * sqrt(share * (1 - share) / episodes + (z / episodes) ** 2 / 4)
    low, high = ((center + side * half) / (1 + z**2 / episodes) for side in (-1, 1))
    return Estimate(share, min(max(low, 0.0), share), max(min(high, 1.0), share), count)


def is_bimodal(values: Sequence[float]) -> bool:
    """Return whether values form two groups of at least two values with a significant gap between them.

    The mean then describes no training. The gap is wider than the range times 1/3 + 2/n, which fewer than 3 %
    of normal samples have; three values are never bimodal.
    """
    ordered = np.sort(values)
    gaps = np.diff(ordered)[1:-1]
    return len(gaps) > 0 and gaps.max() > (1 / 3 + 2 / len(ordered)) * (ordered[-1] - ordered[0])


def estimate_crossed(values: Any, allows_bimodal: bool = False) -> Estimate:
    """Return the mean over trainings, or roads, that were evaluated on shared seeds, with its 95 % CI.

    Values have the shape (trainings, seeds): two-way random effects without repetition. The CI is Student's t
    with Satterthwaite's degrees of freedom. Fewer than `MIN_INTERVAL_VALUES` trainings or seeds, and bimodal
    trainings unless `allows_bimodal`, have only the range of their means. Sources: Satterthwaite 1946, Biometrics
    Bulletin 2; Searle, Casella, McCulloch 1992, Variance Components.
    """
    table = np.asarray(values, np.float64)
    if not table.size:
        return Estimate(nan, nan, nan, 0)
    mean, means = float(table.mean()), table.mean(1)
    point = Estimate(mean, nan, nan, len(table), float(means.min()), float(means.max()))
    if min(table.shape) < MIN_INTERVAL_VALUES or (is_bimodal(means) and not allows_bimodal):
        return point
    variance, degrees = _crossed_variance(table)
    half = _student_t(degrees) * sqrt(variance)
    return replace(point, low=mean - half, high=mean + half)


def estimate_on_shared_seeds(values: Any) -> Estimate:
    """Return `estimate_crossed` of several trainings, `estimate` of a single driver; shape (drivers, seeds)."""
    return estimate_crossed(values) if len(values) > 1 else estimate(values[0].tolist())


def _crossed_variance(table: Any) -> tuple[float, float]:
    """Return the variance of the mean, (MS_T + MS_S - MS_R) / (T S), and its degrees of freedom."""
    trainings, seeds = table.shape
    rows, columns = table.mean(1) - table.mean(), table.mean(0) - table.mean()
    residuals = table - table.mean() - rows[:, None] - columns
    freedom = np.array([trainings - 1.0, seeds - 1.0, (trainings - 1.0) * (seeds - 1.0)])
    squares = np.array([seeds * (rows**2).sum(), trainings * (columns**2).sum(), (residuals**2).sum()]) / freedom
    # At least the variance of either effect alone: the estimated difference may be negative by chance.
    spread = float(max(squares[0] + squares[1] - squares[2], squares[0], squares[1]))
    if spread == 0:
        return 0.0, min(freedom)
    return spread / table.size, float(spread**2 / (squares**2 / freedom).sum())
