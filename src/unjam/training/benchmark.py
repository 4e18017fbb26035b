"""How fast episodes run on this machine, beside what bounds them: bare SUMO, and the same over TraCI.

Machines differ, and one machine differs from minute to minute: what counts are ratios within one run, with
their parts measured in turn.
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
from unjam.models.dynamics import ModelDynamics
from unjam.models.ensemble import torch_generator
from unjam.models.environment_data import EnvironmentData
from unjam.models.rollouts import draw_starts, prepare_starts, roll_out
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
"""vehicles on the ring, one CAV in 22, and decisions driven"""
ROLLOUT_SIZES = {"long": (2000, 50), "short": (1200, 10)}
"""virtual rows, and decisions of each: a model that is trusted for long; one that is not, as in an iteration
of training on the ring"""
BATCH_VEHICLES = 90_112
"""vehicles on all rings of a batch together: 4,096 rings of 22"""
OTHER_SCENARIOS = ("figure-eight", "merge")
"""roads beside the ring on which `run_episode` is compared with SUMO alone"""

RatesByPart = dict[str, list[float]]
"""steps per second, by what was measured, of each round"""


def benchmark_episodes(
    rounds: int = BENCHMARK_ROUNDS, on_message: MessageCallback = lambda line: None
) -> dict[str, Any]:
    """Return steps per second, ratios, and the cost of a vehicle-step by size; on one core.

    `over_bare`: steps/s of `run_episode` (loading and recording included) over those of SUMO alone, with the
    residual driver that training makes by default, whose network chooses once a second.
    `over_bare_every_step`: the same with a network that chooses in every step.
    `over_traci`: steps/s of the same driving loop with libsumo over those through TraCI.
    `batch_size`: steps/s of whole rings in a batch, in single precision and with noise that is drawn quickly, with
    the driver of `over_bare`, over those of SUMO alone; and the cost of a vehicle-step by size of the rings.
    `virtual`: decisions/s of virtual rollouts, with the default ensemble and beginning them included, over
    those of `run_episode`.
    `over_unfiltered`: steps/s of `run_episode` over those without the safety filter.
    `audit_share`: share of an episode's time that its audit takes.
    `roads`: `over_bare` on other roads.
    `growth`: the largest cost of a vehicle-step over that of the smallest road.
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
    driver, every_step = (
        make_benchmark_driver(PolicySettings().action_repeat(ring.control_step)),
        make_benchmark_driver(1),
    )
    roads: dict[str, RatesByPart] = {name: {"sumo": [], "episode": []} for name in ("ring", *OTHER_SCENARIOS)}
    rates: RatesByPart = {name: [] for name in ("every_step", "unfiltered", "audit", "loop", "traci", *ROLLOUT_SIZES)}
    torch.set_num_threads(1)
    batches = {vehicles: start_batch(BATCH_VEHICLES // vehicles, vehicles, driver) for vehicles in RING_SIZES}
    rates |= {f"batch {vehicles}": [] for vehicles in batches}
    with Simulation() as simulation:
        for name in OTHER_SCENARIOS:  # networks made, caches warm
            run_episode(SCENARIOS[name], driver, (0,), explore=True, simulation=simulation)
        driven = run_episode(ring, driver, (0,), explore=True, simulation=simulation)
    for number in range(1, rounds + 1):
        on_message(f"round {number} of {rounds}")
        with Simulation() as simulation:
            for name, found in roads.items():
                road = SCENARIOS[name]
                make_traffic(road, (number,), simulation)
                steps = road.horizon * road.steps_per_control_step
                found["sumo"].append(steps_per_second(partial(_step_sumo, simulation, steps), road.horizon))
                found["episode"].append(_episode_rate(road, driver, number, simulation))
            rates["every_step"].append(_episode_rate(ring, every_step, number, simulation))
            bare = replace(ring, safety=replace(ring.safety, active=False))
            rates["unfiltered"].append(_episode_rate(bare, driver, number, simulation))
            rates["audit"].append(steps_per_second(partial(_repeat_audit, driven), ring.horizon))
            for name, (rows, decisions) in ROLLOUT_SIZES.items():
                rates[name].append(_rollout_rate(driven, ring, driver, rows, decisions))
            for vehicles, batch in batches.items():
                rates[f"batch {vehicles}"].append(ring_steps_per_second(batch, BATCH_VEHICLES // vehicles))
            rates["loop"].append(_loop_rate(ring, driver, simulation))
        with Simulation("traci") as simulation:
            rates["traci"].append(_loop_rate(replace(ring, horizon=TRACI_STEPS), driver, simulation))
    on_message("larger roads")
    scaling = _scaling_costs(driver, max(1, rounds // 2))
    costs = [entry["us_per_vehicle_step"] for entry in scaling]
    on_ring = roads.pop("ring")
    in_batch = {vehicles: rates[f"batch {vehicles}"] for vehicles in batches}
    batch_costs = {size: 1e6 / median(found) / size for size, found in in_batch.items()}
    smallest = min(batch_costs)
    return {
        **_scenario_result(on_ring),
        "traci_steps_per_s": median(rates["traci"]),
        "every_step_steps_per_s": median(rates["every_step"]),
        "relative_to_sumo_every_step": _median_ratio(rates["every_step"], on_ring["sumo"]),
        "relative_to_unfiltered": _median_ratio(on_ring["episode"], rates["unfiltered"]),
        "audit_share": _median_ratio(on_ring["episode"], rates["audit"]),
        "relative_to_traci": _median_ratio(rates["loop"], rates["traci"]),
        "batch": {
            "rings": BATCH_VEHICLES // smallest,
            "steps_per_s": median(in_batch[smallest]),
            "relative_to_sumo": _median_ratio(in_batch[smallest], on_ring["sumo"]),
            "scaling": [{"vehicles": size, "us_per_vehicle_step": cost} for size, cost in batch_costs.items()],
            "cost_growth": max(batch_costs.values()) / batch_costs[smallest],
        },
        "model": {
            name: {
                "rows": rows,
                "control_steps": decisions,
                "steps_per_s": median(rates[name]),
                "relative_to_environment": _median_ratio(rates[name], on_ring["episode"]),
            }
            for name, (rows, decisions) in ROLLOUT_SIZES.items()
        },
        "scenarios": {name: _scenario_result(found) for name, found in roads.items()},
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
    """Return the cost of a vehicle-step on rings of the same density, measured in turn."""
    costs: dict[int, list[float]] = {vehicles: [] for vehicles in RING_SIZES}
    for _ in range(rounds):
        for vehicles, horizon in RING_SIZES.items():
            ring = make_benchmark_ring(vehicles, horizon)
            with Simulation() as simulation:
                costs[vehicles].append(1e6 / _loop_rate(ring, driver, simulation) / vehicles)
    return [{"vehicles": vehicles, "us_per_vehicle_step": median(found)} for vehicles, found in costs.items()]


def _episode_rate(scenario: Scenario, driver: ResidualDriver, seed: int, simulation: Simulation) -> float:
    run = partial(run_episode, scenario, driver, (seed,), explore=True, simulation=simulation)
    return steps_per_second(run, scenario.horizon)


def _loop_rate(scenario: Scenario, driver: ResidualDriver, simulation: Simulation) -> float:
    """Return decisions per second of the driving loop alone."""
    traffic = make_traffic(scenario, (1,), simulation, driver.accepts_floats)
    return steps_per_second(lambda: deque(DriveLoop(traffic, driver, explore=True), maxlen=0), scenario.horizon)


def _rollout_rate(episode: Episode, scenario: Scenario, driver: ResidualDriver, rows: int, steps: int) -> float:
    """Return virtual decisions per second of rollouts from an actual episode."""
    data = EnvironmentData(episode.control_steps)
    data.add([episode], scenario)
    model = RowModel(ModelSettings(), len(scenario.drawn_ranges), (0,))
    generator = torch_generator((0,), "cpu")
    world = ModelDynamics(model, scenario, "", generator)
    starts = draw_starts(data, rows, 1, (0,))

    return steps_per_second(
        lambda: roll_out(driver, world, prepare_starts(data, starts, driver.expert, "cpu"), steps, generator),
        rows * steps,
    )


def _repeat_audit(episode: Episode) -> None:
    """Do what an audit does with an episode's speeds and gaps."""
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
