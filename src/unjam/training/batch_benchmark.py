"""Speed of batches of rings on a CPU or a GPU."""

import itertools
import time
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
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
from unjam.models.road_model import RoadModel, learned_human_model
from unjam.models.rollouts import check_device, to_device
from unjam.models.settings import Device, ModelSettings
from unjam.scenarios.ring import Ring
from unjam.scenarios.scenario import MAX_HORIZON
from unjam.training.executors import MessageCallback
from unjam.worlds.batch.human_idm import HumanSpeedModel
from unjam.worlds.batch.ring.world import RingBatch
from unjam.worlds.batch.run import start_batch_drive

STEPS_PER_ROUND = 100
METERS_PER_VEHICLE = 245 / 22
VEHICLES_PER_RING = 22
"""on each ring of `benchmark_batches`"""
BATCH_SIZES = {"cpu": (64, 256, 1024, 4096, 16_384), "cuda": (64, 256, 1024, 4096, 16_384, 65_536, 262_144)}
"""numbers of rings, by device"""
BENCHMARK_MODEL = ModelSettings(hidden=(32, 32))
"""the networks of human drivers"""


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
    _synchronize()
    started = time.perf_counter()
    run()
    _synchronize()
    return steps / (time.perf_counter() - started)


def _synchronize() -> None:
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()


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
    return {
        "device": torch.cuda.get_device_name() if device == "cuda" else "one core",
        "vehicles": VEHICLES_PER_RING,
        "batches": {
            name: _rates_by_batch_size(name, driver, device, human_model, on_message)
            for name, human_model in human_models.items()
        },
        "manifest": manifest(),
    }


def _rates_by_batch_size(
    name: str, driver: Driver, device: Device, human_drivers: HumanSpeedModel | None, on_message: MessageCallback
) -> list[dict[str, float]]:
    rates = []
    for rings in BATCH_SIZES[device]:
        on_message(f"{name}: {rings:,} rings of {VEHICLES_PER_RING} vehicles")
        batch = start_batch(rings, VEHICLES_PER_RING, driver, device, human_drivers)
        ring_steps_per_second(batch, rings)  # allocates buffers and fills caches
        steps = ring_steps_per_second(batch, rings)
        rates.append({"rings": rings, "steps_per_s": steps, "vehicle_steps_per_s": steps * VEHICLES_PER_RING})
    return rates
