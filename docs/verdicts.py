"""Verdicts on claims from differences between trainings with 95 % confidence intervals, and their texts."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from math import inf, isnan, nan
from typing import Any

import numpy as np

from unjam.measures.statistics import Estimate, estimate_over_trainings, is_bimodal
from unjam_paper.study import interval_text, number_text

HELD, NOT_HELD, UNDECIDED, INCONSISTENT = "held", "not held", "undecided", "inconsistent with its Table 1"
Finding = tuple[str, str]
"""verdict and the numbers that it follows from, as texts"""
Values = dict[str, np.ndarray]
"""one value per training, by label"""


def judge_differences(differences: Sequence[Estimate], larger: bool = True) -> str:
    """Return whether the intervals of all differences are above zero, or below zero if not `larger`.

    The verdict is `NOT_HELD` if one of them is on the other side.
    """
    margins = [_margin(difference, larger) for difference in differences]
    if all(low > 0 for low, _ in margins):
        return HELD
    return NOT_HELD if any(high < 0 for _, high in margins) else UNDECIDED


def _margin(difference: Estimate, larger: bool) -> tuple[float, float]:
    """Return the ends of an interval in the direction of a claim, the lower one first; infinities without interval."""
    low, high = (difference.low, difference.high) if larger else (-difference.high, -difference.low)
    return (-inf, inf) if isnan(low) else (low, high)


def compare_values(
    values: Values,
    label: str,
    *others: str,
    larger: bool = True,
    digits: int = 0,
    unit: str = "trainings",
    resolution: float = 0.0,
) -> Finding:
    """Judge whether the values of a label are larger (or smaller) than the values of other labels, paired by order.

    Intervals are widened by the `resolution` of the values, since equal differences of coarse values have no spread. A
    difference with both signs has no interval if one of the compared series forms two groups. The numbers are the means
    of all labels, and the difference that contradicts the claim most.
    """
    others = others or tuple(other for other in values if other != label)
    count = min(len(values[name]) for name in (label, *others))
    differences = dict[str, Estimate]()
    for other in others:
        own_values, other_values = values[label][:count], values[other][:count]
        difference = estimate_over_trainings((own_values - other_values).tolist())
        has_groups = is_bimodal(own_values.tolist()) or is_bimodal(other_values.tolist())
        if has_groups and difference.smallest < 0.0 < difference.largest:
            difference = replace(difference, low=nan, high=nan)
        differences[other] = replace(difference, low=difference.low - resolution, high=difference.high + resolution)
    verdict, margins = judge_differences(list(differences.values()), larger), {}
    for other, difference in differences.items():
        low, high = _margin(difference, larger)
        margins[other] = high if verdict == NOT_HELD else low
    if verdict == UNDECIDED:  # a difference without interval decides only if none has one that includes zero
        margins = {other: low for other, low in margins.items() if -inf < low <= 0.0} or margins
    decisive = min(margins, key=margins.__getitem__)
    means = list_values({name: float(series.mean()) for name, series in values.items()}, digits)
    difference = interval_text(asdict(differences[decisive]), digits, "+,")
    baseline = f" to {decisive}" if len(others) > 1 else ""
    return f"{verdict} ({count} {unit})", f"{means}; difference{baseline} {difference}"


def combine_findings(findings: Sequence[Finding]) -> Finding:
    """Return the finding on a claim with several parts: it holds if all parts hold, and does not if one does not."""
    verdicts = [verdict for verdict, _ in findings]
    open_verdicts = (each for word in (NOT_HELD, UNDECIDED) for each in verdicts if each.startswith(word))
    return next(open_verdicts, verdicts[0]), ". ".join(numbers for _, numbers in findings)


def list_values(values: dict[str, Any], digits: int = 0) -> str:
    """Return labels and values as text."""
    return ", ".join(f"{label} {number_text(value, digits, ',')}" for label, value in values.items())
