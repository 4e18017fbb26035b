"""Speed of episodes on this machine, relative to plain SUMO and to TraCI, and of batches of rings on a CPU or a GPU.

Speed differs between machines and from minute to minute: ratios within one run count, with their parts measured
alternately.
"""

import itertools
import os
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from statistics import median
from typing import Any

import numpy as np
import torch

from unjam.drivers.driver import Driver
from unjam.drivers.network import Network
from unjam.drivers.pi_saturation import PISaturation
from unjam.drivers.residual import ResidualDriver
from unjam.learners.settings import PolicySettings
from unjam.manifest import manifest
from unjam.models.ensemble import torch_generator
from unjam.models.environment_data import EnvironmentData
from unjam.models.road_model import RoadModel, learned_human_model
from unjam.models.rollouts import ModelDynamics, check_device, draw_starts, prepare_starts, roll_out, to_device
from unjam.models.row_model import RowModel
from unjam.models.settings import Device, ModelSettings
from unjam.scenarios import SCENARIOS
from unjam.scenarios.ring import Ring
from unjam.scenarios.scenario import MAX_HORIZON, Scenario
from unjam.training.executors import MessageCallback
from unjam.worlds.audit import braking_statistics, following_statistics
from unjam.worlds.backend import WorldOptions
from unjam.worlds.batch.human_idm import HumanSpeedModel
from unjam.worlds.batch.ring.world import RingBatch
from unjam.worlds.batch.run import start_batch_drive
from unjam.worlds.drive import DriveLoop
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode
from unjam.worlds.sumo.backend import SumoBackend, make_traffic
from unjam.worlds.sumo.simulation import Simulation

TRACI_STEPS = 200
RING_SIZES = {22: 3000, 220: 800, 2200: 200}
"""vehicles on the ring, one in 22 a CAV, and control steps"""
ROLLOUT_SIZES = {"long": (2000, 50), "short": (1200, 10)}
"""rows and control steps of model rollouts: with an accurate model, and as in a training iteration on the ring"""
BATCH_VEHICLES = 90_112
"""vehicles of a batch: 4,096 rings of 22"""
OTHER_SCENARIOS = ("figure-eight", "merge")
"""scenarios besides the ring for the comparison with plain SUMO"""
STEPS_PER_ROUND = 100
METERS_PER_VEHICLE = 245 / 22
VEHICLES_PER_RING = 22
"""number of vehicles on each ring of `benchmark_batches`"""
BATCH_SIZES = {"cpu": (64, 256, 1024, 4096, 16_384), "cuda": (64, 256, 1024, 4096, 16_384, 65_536, 262_144)}
"""numbers of rings, by device"""
BENCHMARK_MODEL = ModelSettings(hidden=(32, 32))
"""the networks of human drivers"""


def benchmark_episodes(rounds: int, on_message: MessageCallback = lambda line: None) -> dict[str, Any]:
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
    unfiltered = replace(ring, safety=replace(ring.safety, active=False))
    rates: defaultdict[str, list[float]] = defaultdict(list)  # steps per second of each round, by measured part
    torch.set_num_threads(1)
    batches = {vehicles: start_batch(BATCH_VEHICLES // vehicles, vehicles, driver) for vehicles in RING_SIZES}
    with Simulation() as simulation:  # writes network files and fills caches
        for name in OTHER_SCENARIOS:
            run_episode(SCENARIOS[name], driver, (0,), explore=True, backend=SumoBackend(simulation))
        episode = run_episode(ring, driver, (0,), explore=True, backend=SumoBackend(simulation))
    for number in range(1, rounds + 1):
        on_message(f"round {number} of {rounds}")
        with Simulation() as simulation:
            for name in ("ring", *OTHER_SCENARIOS):
                scenario = SCENARIOS[name]
                make_traffic(scenario, (number,), simulation)
                steps = scenario.horizon * scenario.steps_per_control_step
                step_sumo = partial(_step_sumo, simulation, steps)
                rates[f"sumo {name}"].append(steps_per_second(step_sumo, scenario.horizon))
                rates[f"episode {name}"].append(_episode_rate(scenario, driver, number, simulation))
            rates["every_step"].append(_episode_rate(ring, every_step_driver, number, simulation))
            rates["unfiltered"].append(_episode_rate(unfiltered, driver, number, simulation))
            rates["audit"].append(steps_per_second(partial(_repeat_audit, episode), ring.horizon))
            for name, (rows, steps) in ROLLOUT_SIZES.items():
                rates[f"model {name}"].append(_rollout_rate(episode, ring, driver, rows, steps))
            for vehicles, batch in batches.items():
                rates[f"batch {vehicles}"].append(ring_steps_per_second(batch, BATCH_VEHICLES // vehicles))
            rates["loop"].append(_loop_rate(ring, driver, simulation))
        with Simulation("traci") as simulation:
            rates["traci"].append(_loop_rate(replace(ring, horizon=TRACI_STEPS), driver, simulation))
    on_message("larger roads")
    for _ in range(max(1, rounds // 2)):
        for vehicles, horizon in RING_SIZES.items():  # of the same density
            with Simulation() as simulation:
                loop_rate = _loop_rate(make_benchmark_ring(vehicles, horizon), driver, simulation)
            rates[f"loop {vehicles}"].append(loop_rate)
    medians = {part: median(each) for part, each in rates.items()}

    def ratio(numerator: str, denominator: str) -> float:
        return median(a / b for a, b in zip(rates[numerator], rates[denominator], strict=True))

    def scenario_result(name: str) -> dict[str, float]:
        sumo, own = f"sumo {name}", f"episode {name}"
        speeds = {"sumo_steps_per_s": medians[sumo], "episode_steps_per_s": medians[own]}
        return {**speeds, "relative_to_sumo": ratio(own, sumo)}

    def scaling_result(part: str) -> dict[str, Any]:
        costs = {vehicles: 1e6 / medians[f"{part} {vehicles}"] / vehicles for vehicles in RING_SIZES}
        scaling = [{"vehicles": vehicles, "us_per_vehicle_step": cost} for vehicles, cost in costs.items()]
        return {"scaling": scaling, "cost_growth": max(costs.values()) / costs[min(costs)]}

    smallest = min(RING_SIZES)
    return {
        **scenario_result("ring"),
        "traci_steps_per_s": medians["traci"],
        "every_step_steps_per_s": medians["every_step"],
        "relative_to_sumo_every_step": ratio("every_step", "sumo ring"),
        "relative_to_unfiltered": ratio("episode ring", "unfiltered"),
        "audit_share": ratio("episode ring", "audit"),
        "relative_to_traci": ratio("loop", "traci"),
        "batch": {
            "rings": BATCH_VEHICLES // smallest,
            "steps_per_s": medians[f"batch {smallest}"],
            "relative_to_sumo": ratio(f"batch {smallest}", "sumo ring"),
            **scaling_result("batch"),
        },
        "model": {
            name: {
                **{"rows": rows, "control_steps": steps, "steps_per_s": medians[f"model {name}"]},
                "relative_to_environment": ratio(f"model {name}", "episode ring"),
            }
            for name, (rows, steps) in ROLLOUT_SIZES.items()
        },
        "scenarios": {name: scenario_result(name) for name in OTHER_SCENARIOS},
        **scaling_result("loop"),
        "rounds": rounds,
    }


def _episode_rate(scenario: Scenario, driver: ResidualDriver, seed: int, simulation: Simulation) -> float:
    run = partial(run_episode, scenario, driver, (seed,), explore=True, backend=SumoBackend(simulation))
    return steps_per_second(run, scenario.horizon)


def _loop_rate(scenario: Scenario, driver: ResidualDriver, simulation: Simulation) -> float:
    """Return control steps per second of the driving loop alone."""
    options = WorldOptions(accepts_floats=not driver.requirements().needs_arrays)
    traffic = make_traffic(scenario, (1,), simulation, options)
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
    (cav,) = episode.trajectories
    speed, leader_speed, gap = (values[:, None] for values in cav.states[:3])
    braking_statistics(np.diff(episode.speeds, axis=0) / episode.control_step)
    following_statistics(speed, leader_speed, gap, episode.control_step)


def _step_sumo(simulation: Simulation, steps: int) -> None:
    step = simulation.step
    for _ in range(steps):
        step()


def make_benchmark_driver(action_repeat: int) -> ResidualDriver:
    """Return PI with a residual network of the paper's size that is evaluated every `action_repeat` control steps."""
    generator = np.random.default_rng(0)
    layers = tuple(
        (generator.normal(size=(inputs, outputs)) / 100, np.zeros(outputs))
        for inputs, outputs in itertools.pairwise([5, 64, 64, 1])
    )
    return ResidualDriver(PISaturation(), Network(layers, 1.0, 0.1), 1.0, action_repeat=action_repeat)


def make_benchmark_ring(vehicles: int, horizon: int) -> Ring:
    """Return a ring of the usual density with one CAV in 22 vehicles."""
    length = round(vehicles * METERS_PER_VEHICLE)
    return Ring(length=(length, length), vehicles=vehicles, cavs=vehicles // 22, horizon=horizon)


def start_batch(
    rings: int, vehicles: int, driver: Driver, device: Device = "cpu", human_drivers: HumanSpeedModel | None = None
) -> Iterator[object]:
    """Start a batch of rings with so many vehicles each, and return an iterator over its control steps.

    It uses single precision and a fast noise generator; by default human drivers follow SUMO's IDM.
    """
    generator, to_array = torch_generator((0,), device), partial(to_device, device=device)
    world = RingBatch(
        [make_benchmark_ring(vehicles, MAX_HORIZON)] * rings,
        [(number,) for number in range(rings)],
        to_array,
        keep_record=False,
        draw=lambda shape: torch.randn(shape, generator=generator, device=device),
        human_model=human_drivers,
    )
    return iter(start_batch_drive(world, driver, to_array, explore=True))


@torch.no_grad()
def ring_steps_per_second(batch: Iterator[object], rings: int) -> float:
    """Return steps of whole rings per second."""
    steps = itertools.islice(batch, STEPS_PER_ROUND)
    return steps_per_second(lambda: deque(steps, maxlen=0), rings * STEPS_PER_ROUND)


def steps_per_second(run: Callable[[], object], steps: int) -> float:
    """Return the steps per second of `run`, which makes so many steps; pending work of a GPU is included."""
    synchronize = torch.cuda.synchronize if torch.cuda.is_initialized() else lambda: None
    synchronize()
    started = time.perf_counter()
    run()
    synchronize()
    return steps / (time.perf_counter() - started)


def benchmark_batches(device: Device, on_message: MessageCallback = lambda line: None) -> dict[str, Any]:
    """Return the speed of batches of growing size with a residual driver, by model of the human drivers.

    The networks of human drivers are untrained: they are evaluated but add nothing. On a CPU one core is used. Raise
    `MissingPartError` if there is no such device.
    """
    check_device(device)
    torch.set_num_threads(1)
    ring = make_benchmark_ring(VEHICLES_PER_RING, 1)
    driver = make_benchmark_driver(PolicySettings().action_repeat(ring.control_step))
    model = RoadModel(BENCHMARK_MODEL, (0,)).to(device)
    model.output_mask.fill_(1.0)
    human_models = {
        "human drivers by IDM": None,
        "human drivers by IDM and networks": learned_human_model(model, ring, torch_generator((1,), device)),
    }
    batches: dict[str, list[dict[str, float]]] = {name: [] for name in human_models}
    for name, rings in itertools.product(human_models, BATCH_SIZES[device]):
        on_message(f"{name}: {rings:,} rings of {VEHICLES_PER_RING} vehicles")
        batch = start_batch(rings, VEHICLES_PER_RING, driver, device, human_models[name])
        ring_steps_per_second(batch, rings)  # allocates buffers and fills caches
        rate = ring_steps_per_second(batch, rings)
        batches[name].append({"rings": rings, "steps_per_s": rate, "vehicle_steps_per_s": rate * VEHICLES_PER_RING})
    device_name = torch.cuda.get_device_name() if device == "cuda" else "one core"
    return {"device": device_name, "vehicles": VEHICLES_PER_RING, "batches": batches, "manifest": manifest()}
