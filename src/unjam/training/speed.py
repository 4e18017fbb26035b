"""Speed of episodes on this machine, relative to plain SUMO and to TraCI, and of batches of rings on a CPU or a GPU.

Speed changes from minute to minute, so that only ratios of parts are reliable, which a run measures alternately.
"""

import itertools
import os
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from statistics import median
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch

from unjam.drivers.command import Command
from unjam.drivers.driver import Driver
from unjam.drivers.network import Network
from unjam.drivers.pi_saturation import PISaturation
from unjam.drivers.residual import ResidualDriver
from unjam.environments.pettingzoo_env import parallel_env
from unjam.environments.slotted_vector_env import SlottedRoadVectorEnv
from unjam.environments.vector_env import RoadVectorEnv
from unjam.learners.settings import PolicySettings
from unjam.manifest import manifest
from unjam.models.ensemble import torch_generator
from unjam.models.environment_data import EnvironmentData
from unjam.models.road_model import RoadEnsemble, learned_human_model
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
"""control steps of measurements over TraCI"""
RING_SIZES = {22: 3000, 220: 800, 2200: 200}
"""control steps by number of vehicles on the ring, of which one in 22 is a CAV"""
ROLLOUT_SIZES = ((2000, 50), (1200, 10))
"""rows and control steps of model rollouts: with an accurate model, and as in a training iteration on the ring"""
BATCH_VEHICLES = 90_112
"""vehicles on all rings of a batch"""
BENCHMARK_SCENARIOS = ("ring", "figure-eight", "merge")
VECTOR_ENVIRONMENTS = ((1024, False), (4096, False), (1024, True))
"""numbers of rings in vector environments, and whether they equal SUMO exactly"""
ASYNC_ENVIRONMENTS = 2
"""number of processes of Gymnasium's asynchronous vector environment"""
MOTORWAYS, FILLING_STEPS, MOTORWAY_STEPS = 256, 150, 20
"""number of motorways in a vector environment, and of control steps before the measurement and per round"""
BUSY_ON_RAMP: dict[str, Any] = {
    "scenario": "on-ramp",
    "slots": 8,
    "expert": "cruise",
    "peak": (0, 1200),
    "horizon": 1200,
}
"""arguments of environments of motorways: some 120 vehicles are on each after `FILLING_STEPS`"""
STEPS_PER_ROUND = 100
"""control steps of batches and vector environments in each round"""
METERS_PER_VEHICLE = 245 / 22
VEHICLES_PER_RING = 22
BATCH_SIZES = {"cpu": (64, 256, 1024, 4096, 16_384), "cuda": (64, 256, 1024, 4096, 16_384, 65_536, 262_144)}
BENCHMARK_MODEL = ModelSettings(hidden=(32, 32))
SUMO_PART, EPISODE_PART = "SUMO alone", "run_episode"
"""names of two reference parts, after the name of a scenario"""
ENVIRONMENT_PART = "ring: env.step"
"""reference part of vector environments: the Gymnasium environment in SUMO"""
SLOTS_PART = "on-ramp: env.step with slots"
"""reference part of vector environments of motorways: the PettingZoo environment in SUMO"""


class Part(NamedTuple):
    """A part of the benchmark, the speed of which is measured in each round."""

    name: str
    reference: str = ""
    """name of the part with which the speed is compared; empty: none"""
    vehicles: int = 0
    """number of vehicles on a road, if the time per vehicle and step is of interest, else 0"""


def benchmark_episodes(rounds: int, on_message: MessageCallback = lambda line: None) -> dict[str, Any]:
    """Return control steps per second, and their ratios, for each `Part`; on one core, medians over the rounds.

    Episodes have the default residual driver of training, and include loading, safety filter, audit and recording.
    Batches of rings have single precision and fast noise. Environments have no policy: actions are random in SUMO, and
    zero in batches.
    """
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_setaffinity") else None
    if cores is not None:
        os.sched_setaffinity(0, {min(cores)})
    try:
        torch.set_num_threads(1)
        driver = make_benchmark_driver(SCENARIOS["ring"].control_step)
        batches = {vehicles: start_batch(BATCH_VEHICLES // vehicles, vehicles, driver) for vehicles in RING_SIZES}
        motorways = [motorway_rates(MOTORWAYS, is_exact) for is_exact in (False, True)]
        vector_benchmarks = list(itertools.starmap(VectorBenchmark, VECTOR_ENVIRONMENTS))
        with Simulation() as simulation:  # writes network files and fills caches
            episode, *_ = [_run_episode(SCENARIOS[name], 0, simulation) for name in BENCHMARK_SCENARIOS]
        rates: defaultdict[Part, list[float]] = defaultdict(list)
        for round_number in range(1, rounds + 1):
            on_message(f"round {round_number} of {rounds}")
            vector_rates = itertools.chain.from_iterable(benchmark.measure() for benchmark in vector_benchmarks)
            sumo_rates = _measure_round(round_number, driver, episode, batches)
            for part, rate in itertools.chain(sumo_rates, vector_rates, map(next, motorways)):
                rates[part].append(rate)
    finally:
        if cores is not None:
            os.sched_setaffinity(0, cores)
    rates_by_name = {part.name: part_rates for part, part_rates in rates.items()}
    parts = []
    for part, part_rates in rates.items():
        pairs = zip(part_rates, rates_by_name.get(part.reference, ()), strict=False)
        ratios = [rate / reference_rate for rate, reference_rate in pairs]
        ratio = median(ratios) if ratios else None
        parts.append({**part._asdict(), "steps_per_s": median(part_rates), "ratio": ratio})
    return {"manifest": manifest(), "rounds": rounds, "parts": parts}


def _measure_round(
    seed: int, driver: ResidualDriver, episode: Episode, batches: Mapping[int, Iterator[object]]
) -> Iterator[tuple[Part, float]]:
    """Yield each part with its control steps per second, except vector environments."""
    ring = SCENARIOS["ring"]
    ring_sumo, ring_episode = f"ring: {SUMO_PART}", f"ring: {EPISODE_PART}"
    unfiltered = replace(ring, safety=replace(ring.safety, active=False))
    with Simulation() as simulation:
        for name in BENCHMARK_SCENARIOS:
            scenario, sumo_part = SCENARIOS[name], f"{name}: {SUMO_PART}"
            make_traffic(scenario, (seed,), simulation)
            step_sumo = partial(_step_sumo, simulation, scenario.horizon * scenario.steps_per_control_step)
            yield Part(sumo_part), steps_per_second(step_sumo, scenario.horizon)
            yield Part(f"{name}: {EPISODE_PART}", sumo_part), _episode_rate(scenario, seed, simulation)
        yield Part(f"{ring_episode}, network in every step", ring_sumo), _episode_rate(ring, seed, simulation, 0.0)
        yield Part(f"{ring_episode} without safety filter", ring_episode), _episode_rate(unfiltered, seed, simulation)
        yield Part(ENVIRONMENT_PART, ring_sumo), _environment_rate(ring.horizon, seed, simulation)
        yield Part(SLOTS_PART), _slots_rate(seed, simulation)
        audit_rate = steps_per_second(partial(_repeat_audit, episode), ring.horizon)
        yield Part("ring: audit of an episode", ring_episode), audit_rate
        for rows, steps in ROLLOUT_SIZES:
            name = f"learned model: {rows:,} rollouts of {steps} control steps"
            yield Part(name, ring_episode), _rollout_rate(episode, ring, driver, rows, steps)
        for vehicles, batch in batches.items():
            rings = BATCH_VEHICLES // vehicles
            name = f"batch of {rings:,} rings of {vehicles:,} vehicles"
            yield Part(name, ring_sumo, vehicles), ring_steps_per_second(batch, rings)
    for vehicles, horizon in RING_SIZES.items():  # of the same density
        with Simulation() as simulation:
            rate = _loop_rate(make_benchmark_ring(vehicles, horizon), driver, simulation)
            yield Part(f"driving loop, ring of {vehicles:,} vehicles", vehicles=vehicles), rate
    smallest = min(RING_SIZES)
    with Simulation("traci") as simulation:
        rate = _loop_rate(make_benchmark_ring(smallest, TRACI_STEPS), driver, simulation)
        yield Part("driving loop over TraCI", f"driving loop, ring of {smallest} vehicles"), rate
        rate = _environment_rate(TRACI_STEPS, seed, simulation)
        yield Part("ring: env.step over TraCI", ENVIRONMENT_PART), rate
    name = f"Gymnasium's async vector environment of {ASYNC_ENVIRONMENTS} rings in SUMO"
    yield Part(name, ENVIRONMENT_PART), _async_rate(seed)


class VectorBenchmark:
    """A vector environment of rings, and the same batch without the environment, with constant commands."""

    def __init__(self, rings: int, is_exact: bool) -> None:
        self.rings, self.is_exact = rings, is_exact
        self.name = f"vector environment of {rings:,} rings{', exact' * is_exact}"
        self._environment = RoadVectorEnv(rings, exact=is_exact, horizon=MAX_HORIZON)
        self._environment.reset(seed=0)
        self._batch = self._environment.make_batch(range(rings))
        self._batch.start(True)

    def measure(self) -> Iterator[tuple[Part, float]]:
        """Yield each part with its control steps per second, of all rings together."""
        actions, command = np.zeros((self.rings, 1), np.float32), Command(np.zeros(self.rings, np.float32))
        batch_part = f"{self.name}: batch alone"
        yield Part(batch_part), _repetition_rate(lambda: self._batch.advance(command), STEPS_PER_ROUND, self.rings)
        rate = _repetition_rate(lambda: self._environment.step(actions), STEPS_PER_ROUND, self.rings)
        yield Part(self.name, batch_part), rate
        yield Part(f"{self.name}, compared with SUMO", ENVIRONMENT_PART), rate


def motorway_rates(roads: int, is_exact: bool) -> Iterator[tuple[Part, float]]:
    """Yield endlessly the control steps per second, of all roads together, of a vector environment of busy on-ramps."""
    environment = SlottedRoadVectorEnv(roads, exact=is_exact, **BUSY_ON_RAMP)
    environment.reset(seed=0)
    step = partial(environment.step, np.zeros((roads, BUSY_ON_RAMP["slots"]), np.float32))
    _repetition_rate(step, FILLING_STEPS)
    while True:
        rate = _repetition_rate(step, MOTORWAY_STEPS, roads)
        yield Part(f"vector environment of {roads:,} on-ramps{', exact' * is_exact}", SLOTS_PART), rate


def _slots_rate(seed: int, simulation: Simulation) -> float:
    """Return control steps per second of one busy on-ramp in SUMO, after `FILLING_STEPS`."""
    environment = parallel_env(**BUSY_ON_RAMP, backend=SumoBackend(simulation))
    environment.reset(seed=seed)
    actions, world = dict.fromkeys(environment.agents, 0.0), environment._road.world
    while world.control_steps < FILLING_STEPS:
        environment.step(actions)
    return _repetition_rate(partial(environment.step, actions), FILLING_STEPS + STEPS_PER_ROUND - world.control_steps)


def _run_episode(scenario: Scenario, seed: int, simulation: Simulation, action_duration: float = 1.0) -> Episode:
    driver = make_benchmark_driver(scenario.control_step, action_duration)
    return run_episode(scenario, driver, (seed,), explore=True, backend=SumoBackend(simulation))


def _episode_rate(scenario: Scenario, seed: int, simulation: Simulation, action_duration: float = 1.0) -> float:
    return steps_per_second(partial(_run_episode, scenario, seed, simulation, action_duration), scenario.horizon)


def _loop_rate(scenario: Scenario, driver: ResidualDriver, simulation: Simulation) -> float:
    options = WorldOptions(accepts_floats=not driver.requirements().needs_arrays)
    traffic = make_traffic(scenario, (1,), simulation, options)
    return steps_per_second(lambda: deque(DriveLoop(traffic, driver, explore=True), maxlen=0), scenario.horizon)


def _environment_rate(steps: int, seed: int, simulation: Simulation) -> float:
    """Return control steps per second of the Gymnasium environment with random actions; the reset is not timed."""
    environment = gymnasium.make("unjam/Ring-v0", backend=SumoBackend(simulation))
    environment.reset(seed=seed)
    actions = np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, 1)).astype(np.float32)
    return steps_per_second(lambda: deque(map(environment.step, actions), maxlen=0), len(actions))


def _async_rate(seed: int) -> float:
    """Return control steps per second of all environments of Gymnasium's processes together, on the same core."""
    environment = gymnasium.make_vec("unjam/Ring-v0", ASYNC_ENVIRONMENTS, vectorization_mode="async")
    try:
        environment.reset(seed=seed)
        actions = np.zeros((ASYNC_ENVIRONMENTS, 1), np.float32)
        return _repetition_rate(partial(environment.step, actions), STEPS_PER_ROUND, ASYNC_ENVIRONMENTS)
    finally:
        environment.close()


def _rollout_rate(episode: Episode, scenario: Scenario, driver: ResidualDriver, rows: int, steps: int) -> float:
    """Return model steps per second of rollouts from an episode of the environment."""
    data = EnvironmentData(episode.control_steps, scenario.actuator, scenario.control_step)
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


def make_benchmark_driver(time_step: float, action_duration: float = 1.0) -> ResidualDriver:
    """Return PI with a residual network of the paper's size that acts every `action_duration` seconds."""
    generator = np.random.default_rng(0)
    layers = tuple(
        (generator.normal(size=(inputs, outputs)) / 100, np.zeros(outputs))
        for inputs, outputs in itertools.pairwise([5, 64, 64, 1])
    )
    expert, network = PISaturation(time_step=time_step), Network(layers, 1.0, 0.1)
    action_repeat = PolicySettings(action_duration=action_duration).action_repeat(time_step)
    return ResidualDriver(expert, network, 1.0, action_repeat=action_repeat)


def make_benchmark_ring(vehicles: int, horizon: int) -> Ring:
    """Return a ring of the usual density with one CAV in 22 vehicles."""
    length = round(vehicles * METERS_PER_VEHICLE)
    return Ring(length=(length, length), vehicles=vehicles, cavs=vehicles // 22, horizon=horizon)


def start_batch(
    rings: int, vehicles: int, driver: Driver, device: Device = "cpu", human_drivers: HumanSpeedModel | None = None
) -> Iterator[object]:
    """Return an iterator over control steps of new rings in single precision with fast noise, by default with IDM."""
    generator, to_array = torch_generator((0,), device), partial(to_device, device=device)
    world = RingBatch(
        [make_benchmark_ring(vehicles, MAX_HORIZON)] * rings,
        [(seed,) for seed in range(rings)],
        to_array,
        keep_record=False,
        draw=lambda shape: torch.randn(shape, generator=generator, device=device),
        human_model=human_drivers,
    )
    return iter(start_batch_drive(world, driver, to_array, explore=True))


@torch.no_grad()
def ring_steps_per_second(batch: Iterator[object], rings: int) -> float:
    """Return control steps per second of all rings together."""
    steps = itertools.islice(batch, STEPS_PER_ROUND)
    return steps_per_second(lambda: deque(steps, maxlen=0), rings * STEPS_PER_ROUND)


def _repetition_rate(step: Callable[[], object], count: int, roads: int = 1) -> float:
    """Return control steps per second of all roads together, while `step` is called `count` times."""
    return steps_per_second(lambda: deque((step() for _ in range(count)), 0), roads * count)


def steps_per_second(run: Callable[[], object], steps: int) -> float:
    """Return the steps per second of `run`, which makes a number of `steps`; pending work of a GPU is included."""
    synchronize = torch.cuda.synchronize if torch.cuda.is_initialized() else lambda: None
    synchronize()
    start_time = time.perf_counter()
    run()
    synchronize()
    return steps / (time.perf_counter() - start_time)


def benchmark_batches(device: Device, on_message: MessageCallback = lambda line: None) -> dict[str, Any]:
    """Return the speed of batches of increasing size with a residual driver, by model of the human drivers.

    The networks of human drivers have an output of zero. A CPU uses one core. Raise `MissingPartError` if there is no
    such device.
    """
    check_device(device)
    torch.set_num_threads(1)
    ring = make_benchmark_ring(VEHICLES_PER_RING, 1)
    driver = make_benchmark_driver(ring.control_step)
    model = RoadEnsemble(BENCHMARK_MODEL, (0,)).to(device)
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
    return {"manifest": manifest(), "device": device_name, "vehicles": VEHICLES_PER_RING, "batches": batches}
