"""Verdicts on claims: values of trainings compared with 95 % intervals, and their texts."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from math import inf, isnan, nan
from typing import Any

import numpy as np

from unjam.measures.statistics import Estimate, estimate_over_trainings, is_bimodal
from unjam_paper.study import interval_text, number_text

HELD, NOT_HELD, UNDECIDED, INCONSISTENT = "held", "not held", "undecided", "inconsistent with its Table 1"
Finding = tuple[str, str]
"""verdict and numbers"""
Values = dict[str, np.ndarray]
"""one value per training, by label"""


def judge(differences: Sequence[Estimate], larger: bool = True) -> str:
    """Return whether all differences are above zero (or below), where none may be on the other side."""
    margins = [_margin(each, larger) for each in differences]
    if all(low > 0 for low, _ in margins):
        return HELD
    return NOT_HELD if any(high < 0 for _, high in margins) else UNDECIDED


def _margin(difference: Estimate, larger: bool) -> tuple[float, float]:
    """Return the ends of the interval in the direction of a claim; of a difference without interval, from below."""
    low, high = (difference.low, difference.high) if larger else (-difference.high, -difference.low)
    return (-inf, inf) if isnan(low) else (low, high)


def compare(
    values: Values,
    label: str,
    *others: str,
    larger: bool = True,
    digits: int = 0,
    unit: str = "trainings",
    resolution: float = 0.0,
) -> Finding:
    """Judge whether the values of a label are larger (or smaller) than those of all others, paired in their order.

    Intervals are widened by the `resolution` of the values: equal differences of coarse values have no spread. A
    difference with both signs has no interval if what is compared forms two groups. The numbers are the means of all,
    and the difference that decides: that to the other which contradicts most.
    """
    others = others or tuple(each for each in values if each != label)
    count = min(len(values[each]) for each in (label, *others))
    differences = dict[str, Estimate]()
    for other in others:
        own, found = values[label][:count], values[other][:count]
        difference = estimate_over_trainings((own - found).tolist())
        has_groups = is_bimodal(own.tolist()) or is_bimodal(found.tolist())
        if has_groups and difference.smallest < 0.0 < difference.largest:
            difference = replace(difference, low=nan, high=nan)
        differences[other] = replace(difference, low=difference.low - resolution, high=difference.high + resolution)
    verdict, margins = judge(list(differences.values()), larger), {}
    for other, difference in differences.items():
        low, high = _margin(difference, larger)
        margins[other] = high if verdict == NOT_HELD else low
    if verdict == UNDECIDED:  # a difference without interval decides only if none has one that includes zero
        margins = {other: low for other, low in margins.items() if -inf < low <= 0.0} or margins
    decisive = min(margins, key=margins.__getitem__)
    means = list_values({each: float(found.mean()) for each, found in values.items()}, digits)
    difference = interval_text(asdict(differences[decisive]), digits, "+,")
    to = f" to {decisive}" if len(others) > 1 else ""
    return f"{verdict} ({count} {unit})", f"{means}; difference{to} {difference}"


def worst(findings: Sequence[Finding]) -> Finding:
    """Return the finding on all parts of a claim: it holds where each part holds, and fails where one fails."""
    verdicts = [verdict for verdict, _ in findings]
    found = (each for word in (NOT_HELD, UNDECIDED) for each in verdicts if each.startswith(word))
    return next(found, verdicts[0]), ". ".join(numbers for _, numbers in findings)


def list_values(values: dict[str, Any], digits: int = 0) -> str:
    """Return labels and values as text."""
    return ", ".join(f"{label} {number_text(value, digits, ',')}" for label, value in values.items())
