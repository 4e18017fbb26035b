"""Fuel-optimal speeds of a vehicle that knows the whole recording of its leader, as a reference for controllers.

The speeds at knots are optimized by gradient descent on the fuel per distance, with penalties for gaps and
accelerations beyond their limits. The problem is not convex, so the fuel of a plan is not a proven lower bound.
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
"""times between knots, and between the points of the grid on which fuel and limits are evaluated [s]"""
OPTIMIZER_OPTIONS = {"maxiter": 1500, "maxfun": 2000, "maxcor": 30, "ftol": 1e-12, "gtol": 1e-9}
PENALTY = 3.0
"""fuel [ml/km] for each squared meter beyond a limit, averaged over time; 0.1 m/s2 count as a meter"""
PLAN_STEP_KEY = "step"


@dataclass(frozen=True)
class PlanLimits:
    """Limits of a plan; the gaps are those of the published controller of the I-24 experiment."""

    largest_gap: float = 105.0
    """[m]"""
    largest_mean_gap: float = 73.0
    """mean over all recordings [m]"""
    time_gap: float = 1.0
    """smallest time gap beyond the standstill gap [s]"""
    standstill_gap: float = 1.0
    """[m]"""
    braking: float = 3.0
    """[m/s2]"""
    acceleration: float = 1.5
    """[m/s2]"""


def plan_speeds(leader_speeds: Sequence[Floats], start_gaps: Sequence[float], step: float, limits: PlanLimits) -> Any:
    """Return the planned speeds behind each leader, shape (steps,) [m/s]; both ends equal those of the leader."""
    counts, knot_steps = [len(speeds) for speeds in leader_speeds], round(KNOT_SECONDS / step)
    longest = knot_steps * (max(counts) // knot_steps + 1) + 1
    padded = np.stack([np.pad(speeds, (0, longest - len(speeds)), "edge") for speeds in leader_speeds], 1)
    stride = round(GRID_SECONDS / step)
    grid = torch.arange(0, longest, stride)
    leader_distance = torch.tensor(np.array(start_gaps) + step * (padded.cumsum(0) - padded[0])[::stride])
    last_knots = torch.tensor(counts) // knot_steps
    is_counted = ((grid[:, None] < torch.tensor(counts)) & (grid[:, None] > 0)).double()
    knots = torch.tensor(padded[::knot_steps])
    knot_indices = torch.arange(len(knots))[:, None]
    is_free = (knot_indices > 0) & (knot_indices < last_knots)
    weights = _interpolation_weights(longest, knot_steps)
    grid_weights = weights[grid].to_sparse()

    def loss_and_gradient(changes: Floats) -> tuple[float, Floats]:
        change = torch.tensor(changes.reshape(knots.shape), requires_grad=True)
        speed = torch.sparse.mm(grid_weights, knots + change * is_free).clip(0.0, None)
        value = _penalized_fuel(speed, leader_distance, is_counted, step * stride, limits)
        value.backward()
        assert change.grad is not None
        return value.item(), change.grad.numpy().ravel()

    start = np.zeros(knots.numel())
    result = minimize(loss_and_gradient, start, jac=True, method="L-BFGS-B", options=OPTIMIZER_OPTIONS)
    planned = (weights @ (knots + torch.tensor(result.x.reshape(knots.shape)) * is_free)).clip(0.0, None).numpy()
    return [planned[:count, index] for index, count in enumerate(counts)]


def _penalized_fuel(
    speed: Tensor, leader_distance: Tensor, is_counted: Tensor, step: float, limits: PlanLimits
) -> Tensor:
    """Return the mean fuel per distance with penalties [ml/km]; tensors have shape (times, n) and a time step [s]."""
    acceleration = torch.diff(speed, dim=0, prepend=speed[:1]) / step
    step_speed = speed - 0.5 * step * acceleration
    distance = step * (step_speed.cumsum(0) - step_speed[0])
    gap, steps = leader_distance - distance, is_counted.sum(0)
    fuel = 1000.0 * (fuel_rate(step_speed, acceleration) * is_counted).sum(0) / (step_speed * is_counted).sum(0)
    violations = (
        (gap - limits.largest_gap).clip(0.0),
        (limits.standstill_gap + limits.time_gap * speed - gap).clip(0.0),
        10.0 * (acceleration - limits.acceleration).clip(0.0),
        10.0 * (-limits.braking - acceleration).clip(0.0),
    )
    penalty = sum(((violation**2 * is_counted).sum(0) / steps).mean() for violation in violations)
    excess = ((gap * is_counted).sum() / steps.sum() - limits.largest_mean_gap).clip(0.0)
    return fuel.mean() + PENALTY * (penalty + excess**2)


def _interpolation_weights(count: int, knot_steps: int) -> Tensor:
    """Return the weights of the knots in a linear interpolation, shape (steps, knots)."""
    positions, knots = np.arange(count) / knot_steps, np.arange((count - 1) // knot_steps + 1)
    return torch.tensor(np.maximum(1.0 - np.abs(positions[:, None] - knots), 0.0))


@dataclass(frozen=True, eq=False)
class PlannedDriver(Driver):
    """Drives the CAV of each road with its planned speeds; for vehicles without delay."""

    speeds: tuple[Floats, ...] = field(repr=False)
    time_step: float = 0.1
    """control step [s]"""

    def initial_memory(self, n: int) -> Memory:
        """Return the index of the first step."""
        return {PLAN_STEP_KEY: np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the accelerations to the planned speeds, and the index of the next step."""
        next_steps = [int(step) + 1 for step in memory[PLAN_STEP_KEY]]
        planned = [speeds[min(step, len(speeds) - 1)] for speeds, step in zip(self.speeds, next_steps, strict=True)]
        return (np.array(planned) - state.speed) / self.time_step, {PLAN_STEP_KEY: memory[PLAN_STEP_KEY] + 1.0}
