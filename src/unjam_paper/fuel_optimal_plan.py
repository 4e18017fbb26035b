"""Fuel-optimal speeds of a vehicle that knows the whole recording of its leader: how much any controller could save.

The speeds at knots are optimized by gradient descent on the fuel per distance, with penalties for gaps and
accelerations out of their limits. The problem is not convex: this is a reference, not a proven bound.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.physics.arrays import Array, Floats
from unjam.physics.fuel import fuel_rate

KNOT_SECONDS, GRID_SECONDS = 1.0, 0.5
"""times between knots, and between the moments at which fuel and limits are computed [s]"""
OPTIMIZER_OPTIONS = {"maxiter": 1500, "maxfun": 2000, "maxcor": 30, "ftol": 1e-12, "gtol": 1e-9}
PENALTY = 3.0
"""fuel [ml/km] for each squared meter beyond a limit, as a mean over time; 0.1 m/s2 count as a meter"""
PLAN_STEP_KEY = "step"


@dataclass(frozen=True)
class PlanLimits:
    """Limits of a plan: the gaps are those of the published controller of the I-24 experiment."""

    largest_gap: float = 105.0
    """[m]"""
    largest_mean_gap: float = 73.0
    """of all recordings together [m]"""
    time_gap: float = 1.0
    """smallest time gap beyond the standstill gap [s]"""
    standstill_gap: float = 1.0
    """[m]"""
    braking: float = 3.0
    """[m/s2]"""
    acceleration: float = 1.5
    """[m/s2]"""


def plan_speeds(leader_speeds: Sequence[Floats], start_gaps: Sequence[float], step: float, limits: PlanLimits) -> Any:
    """Return the planned speeds behind each of n leaders, with their speeds at both ends [m/s], shapes (T,)."""
    counts, knot_steps = [len(each) for each in leader_speeds], round(KNOT_SECONDS / step)
    longest = knot_steps * (max(counts) // knot_steps + 1) + 1
    padded = np.stack([np.pad(each, (0, longest - len(each)), "edge") for each in leader_speeds], 1)
    stride = round(GRID_SECONDS / step)
    grid = torch.arange(0, longest, stride)
    ahead = torch.tensor(np.array(start_gaps) + step * (padded.cumsum(0) - padded[0])[::stride])
    ends = torch.tensor(counts) // knot_steps
    is_counted = ((grid[:, None] < torch.tensor(counts)) & (grid[:, None] > 0)).double()
    knots = torch.tensor(padded[::knot_steps])
    numbers = torch.arange(len(knots))[:, None]
    is_free = (numbers > 0) & (numbers < ends)
    weights = _interpolation(longest, knot_steps)
    grid_weights = weights[grid].to_sparse()

    def loss(changes: Floats) -> tuple[float, Floats]:
        change = torch.tensor(changes.reshape(knots.shape), requires_grad=True)
        speed = torch.sparse.mm(grid_weights, knots + change * is_free).clip(0.0, None)
        value = _loss(speed, ahead, is_counted, step * stride, limits)
        value.backward()
        assert change.grad is not None
        return value.item(), change.grad.numpy().ravel()

    found = minimize(loss, np.zeros(knots.numel()), jac=True, method="L-BFGS-B", options=OPTIMIZER_OPTIONS)
    speeds = (weights @ (knots + torch.tensor(found.x.reshape(knots.shape)) * is_free)).clip(0.0, None).numpy()
    return [speeds[:count, number] for number, count in enumerate(counts)]


def _loss(speed: Tensor, ahead: Tensor, is_counted: Tensor, step: float, limits: PlanLimits) -> Tensor:
    """Return the mean fuel per distance [ml/km] with penalties; arrays of shape (times, n), one `step` [s] apart."""
    acceleration = torch.diff(speed, dim=0, prepend=speed[:1]) / step
    mean = speed - 0.5 * step * acceleration  # of a step
    driven = step * (mean.cumsum(0) - mean[0])
    gap, steps = ahead - driven, is_counted.sum(0)
    fuel = 1000.0 * (fuel_rate(mean, acceleration) * is_counted).sum(0) / (mean * is_counted).sum(0)
    violations = (
        (gap - limits.largest_gap).clip(0.0),
        (limits.standstill_gap + limits.time_gap * speed - gap).clip(0.0),
        10.0 * (acceleration - limits.acceleration).clip(0.0),
        10.0 * (-limits.braking - acceleration).clip(0.0),
    )
    penalty = sum(((each**2 * is_counted).sum(0) / steps).mean() for each in violations)
    excess = ((gap * is_counted).sum() / steps.sum() - limits.largest_mean_gap).clip(0.0)
    return fuel.mean() + PENALTY * (penalty + excess**2)


def _interpolation(count: int, knot_steps: int) -> Tensor:
    numbers, knots = np.arange(count) / knot_steps, np.arange((count - 1) // knot_steps + 1)
    return torch.tensor(np.maximum(1.0 - np.abs(numbers[:, None] - knots), 0.0))


@dataclass(frozen=True, eq=False)
class PlannedDriver(Driver):
    """Drives each CAV, on a road of its own, as planned; for vehicles without delay."""

    speeds: tuple[Floats, ...] = field(repr=False)
    time_step: float = 0.1
    """control step [s]"""

    def initial_memory(self, n: int) -> Memory:
        """Return the first step."""
        return {PLAN_STEP_KEY: np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the accelerations to the planned speeds, and the next step."""
        after = [int(step) + 1 for step in memory[PLAN_STEP_KEY]]
        planned = [each[min(step, len(each) - 1)] for each, step in zip(self.speeds, after, strict=True)]
        return (np.array(planned) - state.speed) / self.time_step, {PLAN_STEP_KEY: memory[PLAN_STEP_KEY] + 1.0}
