"""When a training ends before its steps are made, as its settings say."""

from collections.abc import Sequence
from typing import Any

from unjam.training.config import RunConfig


def has_converged(config: RunConfig, progress: Sequence[dict[str, Any]]) -> bool:
    """Return whether the newest `evaluation.convergence_window` iterations were no better than those before them."""
    span = config.evaluation.convergence_window
    if not span or len(progress) % span or len(progress) < 2 * span:
        return False
    returns = [row["return_mean"] for row in progress[-2 * span :]]
    return sum(returns[span:]) <= sum(returns[:span])


def is_out_of_patience(config: RunConfig, progress: Sequence[dict[str, Any]]) -> bool:
    """Return whether so many validations in a row found nothing better that `evaluation.patience` is over."""
    every = config.evaluation.validation_interval
    scheduled = [row for row in progress if every and row["iteration"] % every == 0]  # and none at an end
    found = [value for row in scheduled if (value := row.get("return_validation")) is not None]
    if not config.evaluation.patience or not found:
        return False
    best = max(range(len(found)), key=found.__getitem__)
    since = len(found) - 1 - best if found[best] > progress[0]["return_expert"] else len(found)
    return since >= config.evaluation.patience


def should_stop_early(config: RunConfig, progress: Sequence[dict[str, Any]]) -> bool:
    """Return whether a training ends before its steps are made, as its settings say."""
    return is_out_of_patience(config, progress) or has_converged(config, progress)
