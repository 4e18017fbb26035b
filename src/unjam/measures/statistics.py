"""Means over seeds and over trainings, with confidence intervals (CI) that have the stated coverage.

CIs are those of Student's t, with a coverage of 95 % for three values or more; a percentile bootstrap of five values
has a coverage of 84 %. If no CI has the stated coverage, texts show the range of the values instead.
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
MIN_INTERVAL_VALUES = 3  # minimum number of values of a CI; with two, its width is 13 times their distance

METRICS_DEFINED_AT_EARLY_END = {
    *("collisions", "min_ttc", "min_time_gap", "cav_min_ttc", "max_drac", "max_jerk", "shield_max_braking"),
    *("cav_max_braking", "cut_in_max_braking", "human_max_braking"),
}  # metrics of conflicts, which are also defined for episodes that ended early
RETURN_METRICS = {"return", "return_eq16"}
"""metrics that are also defined for episodes with a collision, because the reward includes collisions"""
MIN_VERDICT_TRAININGS = 10
"""minimum number of trainings for a verdict on a method instead of a verdict on these trainings"""


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
    """largest value; `smallest` and `largest` are shown if there is no CI"""

    @property
    def half_width(self) -> float:
        """Half the width of the CI; NaN without a CI."""
        return (self.high - self.low) / 2.0


def estimate(
    values: Sequence[float], confidence: float = CONFIDENCE, trim: float = 0.0, bounds: tuple[float, float] = UNBOUNDED
) -> Estimate:
    """Return the mean of independent `values` with its CI; values that are not finite are left out.

    Fewer than `MIN_INTERVAL_VALUES` values have no CI; the CI of equal values has no width.

    Args:
        confidence: coverage of the CI.
        trim: share of the values that is left out at either end, 0.25 for the interquartile mean. The CI of a trimmed
            mean follows from the winsorized variance (Tukey and McLaughlin 1963, Sankhya A 25).
        bounds: smallest and largest possible mean; the CI is clipped to this range.
    """
    finite = np.array([value for value in values if np.isfinite(value)], float)
    if not len(finite):
        return Estimate(nan, nan, nan, 0)
    max_cut = max(0, (len(finite) - MIN_INTERVAL_VALUES) // 2)  # at least MIN_INTERVAL_VALUES remain
    cut, ordered = min(int(trim * len(finite)), max_cut), np.sort(finite)
    trimmed = ordered[cut : len(finite) - cut] if cut else finite
    without_ci = Estimate(float(trimmed.mean()), nan, nan, len(finite), float(ordered[0]), float(ordered[-1]))
    if len(finite) < MIN_INTERVAL_VALUES or (
        trimmed.min() == trimmed.max() and without_ci.smallest < without_ci.largest
    ):
        return without_ci
    # The computed variance of equal values may be a rounding error.
    winsorized = np.clip(finite, trimmed.min(), trimmed.max())
    variance = float(winsorized.var()) * len(finite) if without_ci.smallest < without_ci.largest else 0.0
    half_width = _student_t(len(trimmed) - 1, confidence) * sqrt(variance / (len(trimmed) * (len(trimmed) - 1)))
    low, high = max(without_ci.mean - half_width, bounds[0]), min(without_ci.mean + half_width, bounds[1])
    return replace(without_ci, low=low, high=high)


def _student_t(degrees: float, confidence: float = CONFIDENCE) -> float:
    """Return the two-sided quantile of Student's distribution."""
    from scipy.special import stdtrit  # imported late: it takes a third of the start of a command

    return float(stdtrit(degrees, 0.5 + confidence / 2))


def display_digits(value: Estimate, digits: int) -> int:
    """Return the number of decimal places of an estimate in texts: two more if the mean would be rounded to zero."""
    return digits + 2 if value.mean and not round(value.mean, digits) else digits


def count_teleports(rows: EpisodeRows) -> int:
    """Return the number of vehicles that SUMO teleported or removed in all episodes together."""
    return sum(row.get("teleports", 0) for row in rows)


def has_ended_early(row: dict[str, Any]) -> bool:
    """Return whether an episode ran but ended early, given its row of `measure`."""
    return row.get("status", "completed") not in ("completed", "failed")


def metric_value(row: dict[str, Any], name: str) -> float:
    """Return a metric from a row of `measure`; NaN if it is undefined because the episode ended early."""
    is_defined = not has_ended_early(row) or name in METRICS_DEFINED_AT_EARLY_END
    return row[name] if is_defined or (name in RETURN_METRICS and row["status"] == "collision") else nan


def metric_estimate(rows: EpisodeRows, name: str) -> Estimate:
    """Return the estimate of a metric over the rows of `measure`."""
    return estimate([metric_value(row, name) for row in rows], bounds=METRICS[name].bounds)


def summarize(rows: EpisodeRows) -> dict[str, Estimate]:
    """Return the estimate of every metric over the rows of `measure`."""
    return {name: metric_estimate(rows, name) for name in METRICS}


def pair_rows(rows: EpisodeRows, baseline: EpisodeRows) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Return the pairs of rows with equal seeds."""
    baseline_by_seed = {str(row["seed"]): row for row in baseline}
    return [(row, baseline_by_seed[str(row["seed"])]) for row in rows if str(row["seed"]) in baseline_by_seed]


def _group_pairs(rows: EpisodeRows, baseline: EpisodeRows) -> list[list[tuple[dict[str, Any], dict[str, Any]]]]:
    """Return the pairs of rows in groups with the same recording, or else in groups of one pair.

    Episodes behind one recording count as one, because they differ only in the noise of human drivers.
    """
    groups = defaultdict[Hashable, list[tuple[dict[str, Any], dict[str, Any]]]](list)
    for index, pair in enumerate(pair_rows(rows, baseline)):
        groups[(pair[0]["file"], pair[0]["part"]) if "part" in pair[0] else index].append(pair)
    return [*groups.values()]


def count_units(rows: EpisodeRows, baseline: EpisodeRows) -> int:
    """Return the largest possible count of a paired difference: the number of pairs, or of their recordings."""
    return len(_group_pairs(rows, baseline))


def format_units(rows: EpisodeRows, count: int, noun: str) -> str:
    """Return a count of paired differences with `noun`, or with `recording` behind recorded vehicles."""
    return format_count(count, "recording" if any("part" in row for row in rows) else noun)


def _paired_values(rows: EpisodeRows, baseline: EpisodeRows, name: str) -> Any:
    """Return the means of a metric over the pairs of each group, for rows and baseline, shape (groups, 2)."""
    groups = (
        [values for pair in pairs if np.isfinite(values := [metric_value(row, name) for row in pair]).all()]
        for pairs in _group_pairs(rows, baseline)
    )
    return np.array([np.mean(values, axis=0) for values in groups if values], float).reshape(-1, 2)


def paired_difference(rows: EpisodeRows, baseline: EpisodeRows, name: str, confidence: float = CONFIDENCE) -> Estimate:
    """Return the estimate of the paired difference of a metric to the baseline; a recording is one value."""
    values = _paired_values(rows, baseline, name)
    return estimate((values[:, 0] - values[:, 1]).tolist(), confidence=confidence)


def linearized_ratio(numerators: Any, denominators: Any) -> Any:
    """Return values for each seed with the mean and the CI of the ratio of two means (delta method).

    Numerators and denominators are measured on the same seeds, so their errors are correlated; shape (seeds,).
    Source: Cochran 1977, Sampling Techniques, section 6.3.
    """
    ratio = np.mean(numerators) / np.mean(denominators)
    return ratio + (numerators - ratio * denominators) / np.mean(denominators)


def relative_difference(rows: EpisodeRows, baseline: EpisodeRows, name: str) -> Estimate:
    """Return the estimate of the paired difference of a metric, relative to the mean of the baseline.

    Only seeds with both values are used. The estimate is unknown if all values of the baseline are zero.
    """
    values = _paired_values(rows, baseline, name)
    if not values[:, 1].any():
        return estimate([])
    return estimate(linearized_ratio(values[:, 0] - values[:, 1], values[:, 1]).tolist())


def regress(predictors: Any, values: Any) -> list[Estimate]:
    """Return the change of values with one standard deviation of each predictor, by linear regression with 95 % CIs.

    Predictors have the shape (values, predictors). CIs assume independent errors of equal variance. They are unknown if
    a predictor is constant or a linear combination of others.
    """
    table, responses = np.asarray(predictors, np.float64), np.asarray(values, np.float64)
    stds = table.std(0)
    design = np.column_stack([np.ones(len(table)), (table - table.mean(0)) / np.where(stds > 0, stds, 1.0)])
    coefficients, _, rank, _ = np.linalg.lstsq(design, responses, rcond=None)
    degrees = len(responses) - rank
    if rank < design.shape[1] or degrees < 1:
        return [Estimate(float(coefficient), nan, nan, len(responses)) for coefficient in coefficients[1:]]
    variance = float(np.sum((responses - design @ coefficients) ** 2)) / degrees
    half_widths = _student_t(float(degrees)) * np.sqrt(variance * np.diag(np.linalg.inv(design.T @ design)))
    pairs = zip(coefficients[1:].tolist(), half_widths[1:].tolist(), strict=True)
    return [Estimate(mean, mean - half_width, mean + half_width, len(responses)) for mean, half_width in pairs]


def format_difference(difference: Estimate, digits: int = 0) -> str:
    """Return a difference as text, with its sign and with its CI or else the range of the values."""
    if not difference.count:
        return "–"
    interval = format_ci(difference, f"+.{digits}f")
    return f"{difference.mean:+.{digits}f}{' ' if interval else ''}{interval}"


def format_share(share: Estimate) -> str:
    """Return an estimated share in percent as text, with its CI if there is one."""
    interval = "" if isnan(share.low) else f" [{100 * share.low:.0f}, {100 * share.high:.0f}]"
    return f"{100 * share.mean:.0f} %{interval}"


def format_percent(share: float) -> str:
    """Return a share in percent as text."""
    return f"{100 * share:g} %"


def format_ci(value: Estimate, format_spec: str) -> str:
    """Return the CI or else the range of the values as text; empty for a single value."""
    if not isnan(value.low):
        return f"[{value.low:{format_spec}}, {value.high:{format_spec}}]"
    if value.count < 2 or isnan(value.smallest):
        return ""
    return f"({value.smallest:{format_spec}} to {value.largest:{format_spec}})"


def is_expert_unchanged(gain: Estimate) -> bool:
    """Return whether a controller has the returns of its expert on all seeds, as without any trained network."""
    return gain.low == gain.high == 0


def gain_verdict(gain: Estimate) -> str:
    """Return a sentence on the difference between the returns of one training and of its expert."""
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
    with_ci = estimate(values, trim=trim, bounds=bounds)
    return replace(with_ci, low=nan, high=nan) if is_bimodal(values) else with_ci


def paired_differences(runs: Sequence[EpisodeRows], baseline: EpisodeRows, name: str) -> Any:
    """Return the differences of a metric to the baseline on the common seeds, shape (trainings, seeds)."""
    tables = [{str(row["seed"]): metric_value(row, name) for row in rows} for rows in (baseline, *runs)]
    seeds = [seed for seed in tables[0] if all(np.isfinite(table.get(seed, nan)) for table in tables)]
    baseline_values, *values = ([table[seed] for seed in seeds] for table in tables)
    return np.array(values, np.float64).reshape(len(runs), len(seeds)) - np.array(baseline_values)


def probability_of_improvement(differences: Any) -> Estimate:
    """Return the share of seeds on which a driver is better than another driver; a tie counts half.

    Differences have the shape (trainings, seeds), and are positive if the driver is better. The CI is Wilson's, which
    stays within [0, 1] and has the stated coverage near the ends; with several trainings, it is computed for the number
    of independent episodes with the same variance. Sources: Wilson 1927, Journal of the American Statistical
    Association 22; Korn and Graubard 1998, Survey Methodology 24.
    """
    scores = (differences > 0) + 0.5 * (differences == 0)
    trainings, seeds = scores.shape
    count = seeds if trainings == 1 else trainings
    if not scores.size or min(seeds, count) < MIN_INTERVAL_VALUES:
        return Estimate(float(scores.mean()) if scores.size else nan, nan, nan, count if scores.size else 0)
    share, episodes, z = float(scores.mean()), float(seeds), NormalDist().inv_cdf(0.5 + CONFIDENCE / 2)
    if trainings > 1:
        variance, degrees = _crossed_variance(scores)
        episodes = share * (1 - share) / variance if variance else min(scores.shape)
        z = _student_t(degrees)
    center = share + z**2 / (2 * episodes)
    half_width = z * sqrt(share * (1 - share) / episodes + (z / episodes) ** 2 / 4)
    low, high = ((center + sign * half_width) / (1 + z**2 / episodes) for sign in (-1, 1))
    return Estimate(share, min(max(low, 0.0), share), max(min(high, 1.0), share), count)


def is_bimodal(values: Sequence[float]) -> bool:
    """Return whether values form two groups of at least two values with a significant gap between them.

    The mean of bimodal values describes no training. The gap must exceed the range times 1/3 + 2/n, which is true for
    fewer than 3 % of normal samples; three values are never bimodal.
    """
    ordered = np.sort(values)
    gaps = np.diff(ordered)[1:-1]
    return len(gaps) > 0 and gaps.max() > (1 / 3 + 2 / len(ordered)) * (ordered[-1] - ordered[0])


def estimate_crossed(values: Any, allows_bimodal: bool = False) -> Estimate:
    """Return the mean over trainings, or roads, that were evaluated on shared seeds, with its 95 % CI.

    Values have the shape (trainings, seeds), with two-way random effects without repetition. The CI is Student's t
    with Satterthwaite's degrees of freedom. There is no CI, but the range of the means, with fewer than
    `MIN_INTERVAL_VALUES` trainings or seeds, and with bimodal trainings unless `allows_bimodal`. Sources: Satterthwaite
    1946, Biometrics Bulletin 2; Searle, Casella, McCulloch 1992, Variance Components.
    """
    table = np.asarray(values, np.float64)
    if not table.size:
        return Estimate(nan, nan, nan, 0)
    mean, means = float(table.mean()), table.mean(1)
    without_ci = Estimate(mean, nan, nan, len(table), float(means.min()), float(means.max()))
    if min(table.shape) < MIN_INTERVAL_VALUES or (is_bimodal(means) and not allows_bimodal):
        return without_ci
    variance, degrees = _crossed_variance(table)
    half_width = _student_t(degrees) * sqrt(variance)
    return replace(without_ci, low=mean - half_width, high=mean + half_width)


def estimate_on_shared_seeds(values: Any) -> Estimate:
    """Return `estimate_crossed` of several trainings, or `estimate` of a single driver; shape (drivers, seeds)."""
    return estimate_crossed(values) if len(values) > 1 else estimate(values[0].tolist())


def _crossed_variance(table: Any) -> tuple[float, float]:
    """Return the variance of the mean, (MS_T + MS_S - MS_R) / (T S), and its degrees of freedom."""
    trainings, seeds = table.shape
    rows, columns = table.mean(1) - table.mean(), table.mean(0) - table.mean()
    residuals = table - table.mean() - rows[:, None] - columns
    degrees = np.array([trainings - 1.0, seeds - 1.0, (trainings - 1.0) * (seeds - 1.0)])
    squares = np.array([seeds * (rows**2).sum(), trainings * (columns**2).sum(), (residuals**2).sum()]) / degrees
    # At least the variance of one effect, because the estimated sum may be too small by chance.
    variance = float(max(squares[0] + squares[1] - squares[2], squares[0], squares[1]))
    if variance == 0:
        return 0.0, min(degrees)
    return variance / table.size, float(variance**2 / (squares**2 / degrees).sum())
