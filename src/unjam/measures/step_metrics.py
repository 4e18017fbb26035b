"""Metrics of episodes that are computed from sums over control steps, without a record of the episode."""

from collections import defaultdict

import numpy as np

from unjam.physics.arrays import Array, clamp_min, namespace, square_root
from unjam.worlds.reward import Outcome

BLOCK_STEPS = 256  # control steps of a block in `StepMetricMeans`: without blocks, metrics take a fifth of `env.step`


def step_metrics(outcome: Outcome) -> dict[str, Array]:
    """Return metrics of a control step by their names in `METRICS`, shape (rows,) each.

    Means over an episode are the metrics of the episode on roads that vehicles neither enter nor leave. The variance is
    the mean square minus the square of the mean, which needs no array of deviations; in single precision its error is
    about 1e-7 of the mean square.
    """
    speeds, count = outcome.speeds, outcome.speeds.shape[-1]
    mean, mean_square = speeds.sum(-1) / count, namespace(speeds).einsum("rv,rv->r", speeds, speeds) / count
    return {
        "mean_speed": mean,
        "speed_std_fleet": square_root(clamp_min(mean_square - mean * mean, 0.0)),
        "cav_mean_speed": outcome.cav_speeds.sum(-1) / outcome.cav_speeds.shape[-1],
        "mean_abs_accel": abs(outcome.accelerations).sum(-1) / outcome.accelerations.shape[-1],
    }


class StepMetricMeans:
    """Means of `step_metrics` over control steps that are added one by one."""

    def __init__(self) -> None:
        """Start without control steps."""
        self._count, self._totals, self._block = 0, defaultdict[str, float](float), list[Outcome]()

    def add(self, outcome: Outcome) -> None:
        """Add a control step with the same vehicles as the others, without the axis of rows; arrays must not change."""
        self._block.append(outcome)
        if len(self._block) == BLOCK_STEPS:
            self._add_block()

    def means(self) -> dict[str, float]:
        """Return the means by name; at least one control step must have been added."""
        self._add_block()
        return {name: total / self._count for name, total in self._totals.items()}

    def _add_block(self) -> None:
        if steps := len(self._block):
            arrays = (np.array(values).reshape(steps, -1) for values in zip(*self._block, strict=True))
            for name, metric in step_metrics(Outcome(*arrays)).items():
                self._totals[name] += float(metric.sum())
            self._count += steps
            self._block.clear()


def open_road_sums(outcome: Outcome) -> dict[str, Array]:
    """Return the terms of a control step that `open_road_metrics` sums over an episode, shape (rows,) each."""
    present = (~np.isnan(outcome.speeds)).sum(-1)
    return {"speeds": np.nansum(outcome.speeds, -1), "present": present, "under_way": present + outcome.backlog}


def open_road_metrics(
    sums: dict[str, Array], last: Outcome, entered: Array, remaining: Array, control_step: float
) -> dict[str, Array]:
    """Return metrics of episodes on open roads by their names in `METRICS`, shape (rows,) each.

    Args:
        sums: sums of `open_road_sums` over the control steps of the episode.
        last: the outcome of the last control step.
        entered: number of vehicles that have entered.
        remaining: planned control steps after the end; vehicles under way at a collision count in them.
        control_step: duration of a control step [s].
    """
    lost_steps = open_road_sums(last)["under_way"] * remaining * last.has_crashed
    return {
        "mean_speed": sums["speeds"] / clamp_min(sums["present"], 1),
        "travel_time": (sums["under_way"] + lost_steps) * control_step / clamp_min(entered + last.backlog, 1),
        "insertion_backlog_veh": last.backlog,
    }
