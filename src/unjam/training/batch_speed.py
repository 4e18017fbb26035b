"""How fast batches of rings are stepped, on a processor or on a graphics card."""

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
from unjam.scenarios.ring import Ring
from unjam.scenarios.scenario import LONGEST
from unjam.training.executors import OnLine
from unjam.virtual.ensemble import torch_generator
from unjam.virtual.roads import RoadModel, people_of
from unjam.virtual.settings import Device, VirtualSettings
from unjam.virtual.world import check_is_there, on_device
from unjam.worlds.batch.people import People
from unjam.worlds.batch.run import begin
from unjam.worlds.batch.world import RingBatch

DECISIONS = 100
"""driven in each round"""
METRES_PER_VEHICLE = 245 / 22
VEHICLES = 22
"""on each ring of `measure_batches`"""
RINGS = {
    "cpu": (64, 256, 1024, 4096, 16_384),
    "cuda": (64, 256, 1024, 4096, 16_384, 65_536, 262_144),
}
"""sizes of the batches that are measured"""
LEARNED = VirtualSettings(hidden=(32, 32))
"""the networks that people drive with where they have some"""


def neural_driver(hold: int) -> ResidualDriver:
    """Return PI with a residual network of the paper's size that chooses every `hold` decisions."""
    generator = np.random.default_rng(0)
    sizes = [5, 64, 64, 1]
    layers = tuple(
        (generator.normal(size=(inputs, outputs)) / 100, np.zeros(outputs))
        for inputs, outputs in itertools.pairwise(sizes)
    )
    return ResidualDriver(PISaturation(), Network(layers, 1.0, 0.1), 1.0, hold=hold)


def ring_of(vehicles: int, horizon: int) -> Ring:
    """Return a ring of the usual density, one CAV in 22."""
    length = round(vehicles * METRES_PER_VEHICLE)
    return Ring(length=(length, length), vehicles=vehicles, cavs=vehicles // 22, horizon=horizon)


def batch_of(
    rings: int, vehicles: int, driver: Driver, device: Device = "cpu", people: People | None = None
) -> Iterator[object]:
    """Begin a batch of rings of so many vehicles each, and return what drives on as far as it is asked.

    `people` drive as SUMO's IDM does, unless told otherwise. All is in single precision, and noise is drawn
    quickly.
    """
    generator, numbers = torch_generator((0,), device), partial(on_device, device=device)
    world = RingBatch(
        [ring_of(vehicles, LONGEST)] * rings,
        [(number,) for number in range(rings)],
        numbers,
        keep=False,
        draw=lambda shape: torch.randn(shape, generator=generator, device=device),
        people=people,
    )
    return iter(begin(world, driver, numbers, explore=True))


@torch.no_grad()
def batch_rate(driving: Iterator[object], rings: int) -> float:
    """Return steps of whole rings per second."""
    some = itertools.islice(driving, DECISIONS)
    return rate(lambda: deque(some, maxlen=0), rings * DECISIONS)


def rate(run: Callable[[], object], steps: int) -> float:
    """Return how many of so many steps `run` makes per second; work of graphics cards is waited for."""
    _wait()
    started = time.perf_counter()
    run()
    _wait()
    return steps / (time.perf_counter() - started)


def _wait() -> None:
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()


def measure_batches(device: Device, on_line: OnLine = lambda line: None) -> dict[str, Any]:
    """Return how fast batches of growing size are stepped with a residual driver: by how people drive.

    The networks that people have beside their IDM are as they begin: they are asked, and add nothing yet.
    On a processor one core drives.

    Raises:
        MissingPartError: there is no such device.
    """
    check_is_there(device)
    torch.set_num_threads(1)
    driver = neural_driver(PolicySettings().decisions_held(ring_of(VEHICLES, 1).decision_step))
    model = RoadModel(LEARNED, (0,)).to(device)
    model.learned.fill_(1.0)
    learned = people_of(model, ring_of(VEHICLES, 1), torch_generator((1,), device))
    batches = {"people by IDM": None, "by IDM and networks": learned}
    return {
        "device": torch.cuda.get_device_name() if device == "cuda" else "one core",
        "vehicles": VEHICLES,
        "batches": {name: _curve(name, driver, device, people, on_line) for name, people in batches.items()},
        "manifest": manifest(),
    }


def _curve(
    name: str, driver: Driver, device: Device, people: People | None, on_line: OnLine
) -> list[dict[str, float]]:
    found = []
    for rings in RINGS[device]:
        on_line(f"{name}: {rings:,} rings of {VEHICLES} vehicles")
        driving = batch_of(rings, VEHICLES, driver, device, people)
        batch_rate(driving, rings)  # buffers made, caches warm
        steps = batch_rate(driving, rings)
        found.append({"rings": rings, "steps_per_s": steps, "vehicle_steps_per_s": steps * VEHICLES})
    return found
