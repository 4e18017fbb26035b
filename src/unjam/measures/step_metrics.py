"""Metrics of episodes from sums over control steps, without the record of an episode."""

from collections import defaultdict

import numpy as np

from unjam.physics.arrays import Array, clamp_min, namespace, square_root
from unjam.worlds.reward import Outcome

BLOCK_STEPS = 256  # control steps that `StepMetricMeans` measures together: one by one they take a fifth of `env.step`


def step_metrics(outcome: Outcome) -> dict[str, Array]:
    """Return metrics of control steps by their names in `METRICS`, shape (rows,) each.

    Their means over an episode are its metrics on roads where all vehicles are present all the time. The variance is
    the mean square minus the square of the mean, without an array of deviations: it is exact to some 1e-7 of the mean
    square in single precision.
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
        """Add a control step, without the axis of rows, whose arrays never change; all steps have the same vehicles."""
        self._block.append(outcome)
        if len(self._block) == BLOCK_STEPS:
            self._add_block()

    def means(self) -> dict[str, float]:
        """Return the means by name; at least one control step has been added."""
        self._add_block()
        return {name: total / self._count for name, total in self._totals.items()}

    def _add_block(self) -> None:
        if rows := len(self._block):
            arrays = (np.array(values).reshape(rows, -1) for values in zip(*self._block, strict=True))
            for name, values in step_metrics(Outcome(*arrays)).items():
                self._totals[name] += float(values.sum())
            self._count += rows
            self._block.clear()


def open_road_sums(outcome: Outcome) -> dict[str, Array]:
    """Return what `open_road_metrics` needs of control steps: its sums over an episode, shape (rows,) each."""
    present = (~np.isnan(outcome.speeds)).sum(-1)
    return {"speeds": np.nansum(outcome.speeds, -1), "present": present, "under_way": present + outcome.backlog}


def open_road_metrics(
    sums: dict[str, Array], last: Outcome, entered: Array, remaining: Array, control_step: float
) -> dict[str, Array]:
    """Return metrics of episodes on roads with ends by their names in `METRICS`, shape (rows,) each.

    Args:
        sums: those of `open_road_sums`.
        last: the outcome of the last control step.
        entered: number of vehicles that have entered.
        remaining: planned control steps that were not made; after a collision, vehicles under way count in them.
        control_step: [s].
    """
    lost = open_road_sums(last)["under_way"] * remaining * last.has_crashed
    return {
        "mean_speed": sums["speeds"] / clamp_min(sums["present"], 1),
        "travel_time": (sums["under_way"] + lost) * control_step / clamp_min(entered + last.backlog, 1),
        "insertion_backlog_veh": last.backlog,
    }
