"""Speed of episodes on this machine, relative to plain SUMO and to TraCI.

Speed differs between machines and from minute to minute: ratios within one run count, with their parts measured
alternately.
"""

import os
from collections import deque
from dataclasses import replace
from functools import partial
from statistics import median
from typing import Any

import numpy as np
import torch

from unjam.drivers.residual import ResidualDriver
from unjam.learners.settings import PolicySettings
from unjam.models.ensemble import torch_generator
from unjam.models.environment_data import EnvironmentData
from unjam.models.rollouts import ModelDynamics, draw_starts, prepare_starts, roll_out
from unjam.models.row_model import RowModel
from unjam.models.settings import ModelSettings
from unjam.scenarios import SCENARIOS
from unjam.scenarios.scenario import Scenario
from unjam.training.batch_benchmark import (
    make_benchmark_driver,
    make_benchmark_ring,
    ring_steps_per_second,
    start_batch,
    steps_per_second,
)
from unjam.training.executors import MessageCallback
from unjam.worlds.audit import braking_statistics, following_statistics
from unjam.worlds.drive import DriveLoop
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode
from unjam.worlds.sumo import make_traffic
from unjam.worlds.sumo.simulation import Simulation

BENCHMARK_ROUNDS = 7
TRACI_STEPS = 200
RING_SIZES = {22: 3000, 220: 800, 2200: 200}
"""vehicles on the ring, one in 22 a CAV, and control steps"""
ROLLOUT_SIZES = {"long": (2000, 50), "short": (1200, 10)}
"""rows and control steps of model rollouts: with an accurate model, and as in a training iteration on the ring"""
BATCH_VEHICLES = 90_112
"""vehicles of a batch: 4,096 rings of 22"""
OTHER_SCENARIOS = ("figure-eight", "merge")
"""scenarios besides the ring for the comparison with plain SUMO"""

RatesByPart = dict[str, list[float]]
"""steps per second of each round, by measured part"""


def benchmark_episodes(
    rounds: int = BENCHMARK_ROUNDS, on_message: MessageCallback = lambda line: None
) -> dict[str, Any]:
    """Return steps per second, their ratios, and the cost of a vehicle-step by size of the road; on one core.

    `relative_to_sumo`: `run_episode` (with loading and recording) relative to plain SUMO, with the default residual
    driver of training, which has an action repeat of one second. `relative_to_sumo_every_step`: the same without action
    repeat. `relative_to_traci`: the driving loop with libsumo relative to TraCI. `batch`: rings in a batch, in single
    precision with fast noise, relative to plain SUMO, and the cost of a vehicle-step by size of the rings. `model`:
    model rollouts with the default ensemble, relative to `run_episode`. `relative_to_unfiltered`: `run_episode`
    relative to the same without safety filter. `audit_share`: share of the audit in the time of an episode.
    `scenarios`: `relative_to_sumo` for other scenarios. `cost_growth`: largest cost of a vehicle-step relative to that
    of the smallest road.
    """
    if not hasattr(os, "sched_setaffinity"):
        return _run_rounds(rounds, on_message)
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        return _run_rounds(rounds, on_message)
    finally:
        os.sched_setaffinity(0, cores)


def _run_rounds(rounds: int, on_message: MessageCallback) -> dict[str, Any]:
    ring = SCENARIOS["ring"]
    driver = make_benchmark_driver(PolicySettings().action_repeat(ring.control_step))
    every_step_driver = make_benchmark_driver(1)
    scenarios: dict[str, RatesByPart] = {name: {"sumo": [], "episode": []} for name in ("ring", *OTHER_SCENARIOS)}
    rates: RatesByPart = {name: [] for name in ("every_step", "unfiltered", "audit", "loop", "traci", *ROLLOUT_SIZES)}
    torch.set_num_threads(1)
    batches = {vehicles: start_batch(BATCH_VEHICLES // vehicles, vehicles, driver) for vehicles in RING_SIZES}
    rates |= {f"batch {vehicles}": [] for vehicles in batches}
    with Simulation() as simulation:  # writes network files and fills caches
        for name in OTHER_SCENARIOS:
            run_episode(SCENARIOS[name], driver, (0,), explore=True, simulation=simulation)
        episode = run_episode(ring, driver, (0,), explore=True, simulation=simulation)
    for number in range(1, rounds + 1):
        on_message(f"round {number} of {rounds}")
        with Simulation() as simulation:
            for name, parts in scenarios.items():
                scenario = SCENARIOS[name]
                make_traffic(scenario, (number,), simulation)
                steps = scenario.horizon * scenario.steps_per_control_step
                parts["sumo"].append(steps_per_second(partial(_step_sumo, simulation, steps), scenario.horizon))
                parts["episode"].append(_episode_rate(scenario, driver, number, simulation))
            rates["every_step"].append(_episode_rate(ring, every_step_driver, number, simulation))
            unfiltered = replace(ring, safety=replace(ring.safety, active=False))
            rates["unfiltered"].append(_episode_rate(unfiltered, driver, number, simulation))
            rates["audit"].append(steps_per_second(partial(_repeat_audit, episode), ring.horizon))
            for name, (rows, steps) in ROLLOUT_SIZES.items():
                rates[name].append(_rollout_rate(episode, ring, driver, rows, steps))
            for vehicles, batch in batches.items():
                rates[f"batch {vehicles}"].append(ring_steps_per_second(batch, BATCH_VEHICLES // vehicles))
            rates["loop"].append(_loop_rate(ring, driver, simulation))
        with Simulation("traci") as simulation:
            rates["traci"].append(_loop_rate(replace(ring, horizon=TRACI_STEPS), driver, simulation))
    on_message("larger roads")
    scaling = _scaling_costs(driver, max(1, rounds // 2))
    costs = [entry["us_per_vehicle_step"] for entry in scaling]
    ring_rates = scenarios.pop("ring")
    batch_rates = {vehicles: rates[f"batch {vehicles}"] for vehicles in batches}
    batch_costs = {vehicles: 1e6 / median(each) / vehicles for vehicles, each in batch_rates.items()}
    smallest = min(batch_costs)
    return {
        **_scenario_result(ring_rates),
        "traci_steps_per_s": median(rates["traci"]),
        "every_step_steps_per_s": median(rates["every_step"]),
        "relative_to_sumo_every_step": _median_ratio(rates["every_step"], ring_rates["sumo"]),
        "relative_to_unfiltered": _median_ratio(ring_rates["episode"], rates["unfiltered"]),
        "audit_share": _median_ratio(ring_rates["episode"], rates["audit"]),
        "relative_to_traci": _median_ratio(rates["loop"], rates["traci"]),
        "batch": {
            "rings": BATCH_VEHICLES // smallest,
            "steps_per_s": median(batch_rates[smallest]),
            "relative_to_sumo": _median_ratio(batch_rates[smallest], ring_rates["sumo"]),
            "scaling": [{"vehicles": size, "us_per_vehicle_step": cost} for size, cost in batch_costs.items()],
            "cost_growth": max(batch_costs.values()) / batch_costs[smallest],
        },
        "model": {
            name: {
                **{"rows": rows, "control_steps": steps, "steps_per_s": median(rates[name])},
                "relative_to_environment": _median_ratio(rates[name], ring_rates["episode"]),
            }
            for name, (rows, steps) in ROLLOUT_SIZES.items()
        },
        "scenarios": {name: _scenario_result(parts) for name, parts in scenarios.items()},
        "scaling": scaling,
        "cost_growth": max(costs) / costs[0],
        "rounds": rounds,
    }


def _scenario_result(rates: RatesByPart) -> dict[str, float]:
    return {
        "sumo_steps_per_s": median(rates["sumo"]),
        "episode_steps_per_s": median(rates["episode"]),
        "relative_to_sumo": _median_ratio(rates["episode"], rates["sumo"]),
    }


def _scaling_costs(driver: ResidualDriver, rounds: int) -> list[dict[str, float]]:
    """Return the cost of a vehicle-step on rings of the same density, measured alternately."""
    costs: dict[int, list[float]] = {vehicles: [] for vehicles in RING_SIZES}
    for _ in range(rounds):
        for vehicles, horizon in RING_SIZES.items():
            ring = make_benchmark_ring(vehicles, horizon)
            with Simulation() as simulation:
                costs[vehicles].append(1e6 / _loop_rate(ring, driver, simulation) / vehicles)
    return [{"vehicles": vehicles, "us_per_vehicle_step": median(each)} for vehicles, each in costs.items()]


def _episode_rate(scenario: Scenario, driver: ResidualDriver, seed: int, simulation: Simulation) -> float:
    run = partial(run_episode, scenario, driver, (seed,), explore=True, simulation=simulation)
    return steps_per_second(run, scenario.horizon)


def _loop_rate(scenario: Scenario, driver: ResidualDriver, simulation: Simulation) -> float:
    """Return control steps per second of the driving loop alone."""
    traffic = make_traffic(scenario, (1,), simulation, driver.accepts_floats)
    return steps_per_second(lambda: deque(DriveLoop(traffic, driver, explore=True), maxlen=0), scenario.horizon)


def _rollout_rate(episode: Episode, scenario: Scenario, driver: ResidualDriver, rows: int, steps: int) -> float:
    """Return model steps per second of rollouts from an episode of the environment."""
    data = EnvironmentData(episode.control_steps)
    data.add([episode], scenario)
    model = RowModel(ModelSettings(), len(scenario.drawn_ranges), (0,))
    generator = torch_generator((0,), "cpu")
    dynamics = ModelDynamics(model, scenario, "", generator)
    starts = draw_starts(data, rows, 1, (0,))

    return steps_per_second(
        lambda: roll_out(driver, dynamics, prepare_starts(data, starts, driver.expert, "cpu"), steps, generator),
        rows * steps,
    )


def _repeat_audit(episode: Episode) -> None:
    """Repeat the audit of an episode."""
    (cav,) = episode.trajectories
    speed, leader_speed, gap = (values[:, None] for values in cav.states[:3])
    braking_statistics(np.diff(episode.speeds, axis=0) / episode.control_step)
    following_statistics(speed, leader_speed, gap, episode.control_step)


def _step_sumo(simulation: Simulation, steps: int) -> None:
    step = simulation.step
    for _ in range(steps):
        step()


def _median_ratio(numerators: list[float], denominators: list[float]) -> float:
    return median(a / b for a, b in zip(numerators, denominators, strict=True))
