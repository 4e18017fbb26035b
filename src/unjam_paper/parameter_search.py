"""Search for parameters of a controller on recorded roads by the cross-entropy method, with many candidates at once."""

from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any, NamedTuple

import numpy as np
from optuna.distributions import FloatDistribution

from unjam.drivers import Human
from unjam.drivers.driver import Driver
from unjam.physics.arrays import Floats
from unjam.physics.fuel import fuel_rate
from unjam.scenarios import Recorded
from unjam.worlds.batch.ring.recorded import RecordedBatch
from unjam.worlds.batch.run import start_batch_drive
from unjam_paper.fuel_optimal_plan import PlanLimits

ELITE_SHARE, SMOOTHING, MIN_PARAMETER_STD = 0.2, 0.3, 0.03
"""share of candidates that define the next generation; weight of the last distribution in the next one; smallest
standard deviation of a parameter, relative to its range"""
SEARCH_SEED = 0
LIMITS = PlanLimits()
"""default limits of a candidate"""
MEAN_GAP_PRICE, MAX_GAP_PRICE, TIME_GAP_PRICE = 0.3, 0.2, 20.0
"""penalties for each meter or second beyond a limit, as fuel [%]"""
MARGIN = 0.5
"""distance to the limits of gaps, from which on the search has penalties [m]"""


class SearchBudget(NamedTuple):
    """Size of a search."""

    generations: int = 20
    size: int = 32
    """candidates of a generation"""


class RowScores(NamedTuple):
    """Results of candidates on n roads; arrays of shape (candidates, n)."""

    fuel: Floats
    """fuel per distance of the CAV and the vehicles behind it, by power [ml/m]"""
    mean_gap: Floats
    """mean gap of the CAV [m]"""
    max_gap: Floats
    """largest gap of the CAV [m]"""
    min_time_gap: Floats
    """smallest time gap of the CAV while it is faster than 1 m/s [s]"""


def measure_candidates(
    scenarios: Sequence[Recorded], driver: Driver, parameters: Mapping[str, Floats] | None = None
) -> RowScores:
    """Return the scores of a driver with each set of parameters, or of the driver itself without `parameters`."""
    roads, candidates = len(scenarios), len(next(iter(parameters.values()))) if parameters else 1
    world = RecordedBatch(list(scenarios) * candidates, [(0,)] * (roads * candidates), keep_record=False)
    driver = copy(driver)
    for name, values in (parameters or {}).items():
        object.__setattr__(driver, name, np.repeat(values, roads))
    loop = start_batch_drive(world, driver)
    step, count = scenarios[0].control_step, 1 + scenarios[0].vehicle_kinds[::-1].index("cav")
    previous_speeds = world.speeds[:count]
    totals = np.zeros((4, roads * candidates))
    max_gap, min_time_gap = np.zeros(roads * candidates), np.full(roads * candidates, np.inf)
    is_running = np.array(world.is_running)
    for _ in loop:
        speeds, gap = world.speeds[:count], world.exact_state().leader_gap
        fuel = fuel_rate(speeds, (speeds - previous_speeds) / step).sum(0)
        totals += is_running * np.stack([fuel, speeds.sum(0), gap, np.ones_like(gap)])
        max_gap = np.maximum(max_gap, gap * is_running)
        cav_speed = speeds[-1]
        is_fast = (cav_speed > 1.0) & (is_running > 0.0)
        time_gap = np.where(is_fast, gap / np.maximum(cav_speed, 1.0), np.inf)
        min_time_gap = np.minimum(min_time_gap, time_gap)
        previous_speeds, is_running = speeds, np.array(world.is_running)
    fuel, distance, gaps, steps = totals
    scores = fuel / distance, gaps / steps, max_gap, min_time_gap
    return RowScores(*(values.reshape(candidates, roads) for values in scores))


def search_parameters(
    scenarios: Sequence[Recorded],
    driver: Driver,
    space: Mapping[str, FloatDistribution],
    budget: SearchBudget,
    limits: PlanLimits = LIMITS,
) -> list[dict[str, Any]]:
    """Return the best candidate after each generation: its parameters, fuel relative to human drivers [%], gaps."""
    human, generator = measure_candidates(scenarios, Human()), np.random.default_rng(SEARCH_SEED)
    mean, std = np.full(len(space), 0.5), np.full(len(space), 0.35)
    best: dict[str, Any] = {"score": np.inf}
    history = list[dict[str, Any]]()
    for generation in range(budget.generations):
        draw = generator.standard_normal if generation else generator.random
        points = draw((budget.size, len(space)))
        if generation:
            points = np.clip(mean + std * points, 0.0, 1.0)
        parameters = {name: _scale(column, space[name]) for name, column in zip(space, points.T, strict=True)}
        scores = measure_candidates(scenarios, driver, parameters)
        fuel = 100.0 * (scores.fuel / human.fuel - 1.0).mean(1)
        mean_gap, max_gap, time_gap = scores.mean_gap.mean(1), scores.max_gap.max(1), scores.min_time_gap.min(1)
        total = fuel + MEAN_GAP_PRICE * np.maximum(mean_gap - limits.largest_mean_gap + MARGIN, 0.0)
        total += MAX_GAP_PRICE * np.maximum(max_gap - limits.largest_gap + MARGIN, 0.0)
        total += TIME_GAP_PRICE * np.maximum(limits.time_gap - time_gap, 0.0)
        order = np.argsort(total)
        elite = points[order[: round(ELITE_SHARE * budget.size)]]
        weight = SMOOTHING if generation else 0.0
        mean = weight * mean + (1.0 - weight) * elite.mean(0)
        std = np.maximum(weight * std + (1.0 - weight) * elite.std(0), MIN_PARAMETER_STD)
        first = int(order[0])
        if total[first] < best["score"]:
            best_parameters = {name: round(float(values[first]), 4) for name, values in parameters.items()}
            metrics = {"fuel": fuel, "mean_gap": mean_gap, "max_gap": max_gap, "min_time_gap": time_gap}
            best = {"score": float(total[first]), "parameters": best_parameters}
            best |= {name: float(values[first]) for name, values in metrics.items()}
        history.append({"generation": generation, **best})
    return history


def _scale(points: Floats, distribution: FloatDistribution) -> Floats:
    """Return the values of a parameter at points between 0 and 1 of its range."""
    low, high = distribution.low, distribution.high
    return low * (high / low) ** points if distribution.log else low + (high - low) * points
