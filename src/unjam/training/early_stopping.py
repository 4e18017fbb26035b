"""Early end of a training, before its steps are done."""

from collections.abc import Sequence
from typing import Any

from unjam.training.config import RunConfig


def has_converged(config: RunConfig, progress: Sequence[dict[str, Any]]) -> bool:
    """Return whether the last `evaluation.convergence_window` iterations were not better than those before."""
    window = config.evaluation.convergence_window
    if not window or len(progress) % window or len(progress) < 2 * window:
        return False
    returns = [row["return_mean"] for row in progress[-2 * window :]]
    return sum(returns[window:]) <= sum(returns[:window])


def is_out_of_patience(config: RunConfig, progress: Sequence[dict[str, Any]]) -> bool:
    """Return whether `evaluation.patience` validations in a row had no new best return."""
    interval = config.evaluation.validation_interval
    scheduled = [row for row in progress if interval and row["iteration"] % interval == 0]  # without that at the end
    returns = [value for row in scheduled if (value := row.get("return_validation")) is not None]
    if not config.evaluation.patience or not returns:
        return False
    best = max(range(len(returns)), key=returns.__getitem__)
    since = len(returns) - 1 - best if returns[best] > progress[0]["return_expert"] else len(returns)
    return since >= config.evaluation.patience


def should_stop_early(config: RunConfig, progress: Sequence[dict[str, Any]]) -> bool:
    """Return whether a training ends before its steps are done."""
    return is_out_of_patience(config, progress) or has_converged(config, progress)
