"""Induction loops on a user's network, which record the passages of vehicles in human-only traffic."""

import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, suppress
from typing import cast

from unjam.errors import EpisodeError, LostWorkerError
from unjam.scenarios.road import UserNetworkRoad
from unjam.scenarios.scenario import sumo_seed
from unjam.scenarios.user_network import UserNetwork
from unjam.worlds.sumo.inputs import user_network_inputs
from unjam.worlds.sumo.networks import xml_document
from unjam.worlds.sumo.sandboxed import SandboxedSimulation
from unjam.worlds.sumo.simulation import DetectorPassage, InductionLoop, Simulation, loop_name

MAX_DETECTOR_ATTEMPTS = 3
"""attempts to run a simulation, each of which may lose its process"""


def load_with_loops(
    simulation: Simulation, scenario: UserNetwork, seed: Sequence[int], loops: Sequence[InductionLoop]
) -> None:
    """Load human-only traffic of a scenario and seed with induction loops; `EpisodeError` if SUMO refuses the files."""
    road = cast(UserNetworkRoad, scenario.draw_from_seed(seed)[0])
    elements = [
        {"id": loop_name(index), "lane": loop.lane, "pos": loop.position, "period": 3600, "file": "NUL"}
        for index, loop in enumerate(loops)
    ]
    xml = xml_document("additional", "inductionLoop", elements)
    inputs = user_network_inputs(scenario, road)._replace(traffic_xml=xml)
    simulation.load(inputs, scenario.simulation_step, sumo_seed(seed))


class DetectorPool(AbstractContextManager["DetectorPool"]):
    """Sandboxed SUMO processes, which start when needed; their number `count` does not affect the passages."""

    def __init__(self, count: int = 1) -> None:
        self._thread_pool = ThreadPoolExecutor(count, thread_name_prefix="unjam-detectors")
        self._thread_data = threading.local()
        """attribute `simulation`: the simulation of the current thread, None after a failure"""
        self._open_simulations: set[SandboxedSimulation] = set()

    def run(
        self, scenario: UserNetwork, seeds: Sequence[tuple[int, ...]], loops: Sequence[InductionLoop]
    ) -> list[list[DetectorPassage]]:
        """Return the passages of each seed; raise `EpisodeError` if SUMO fails, or is lost repeatedly."""

        def run_with_retries(seed: tuple[int, ...]) -> list[DetectorPassage]:
            for _ in range(MAX_DETECTOR_ATTEMPTS - 1):
                with suppress(LostWorkerError):
                    return self._run_seed(scenario, seed, loops)
            return self._run_seed(scenario, seed, loops)

        return list(self._thread_pool.map(run_with_retries, seeds))

    def _run_seed(
        self, scenario: UserNetwork, seed: tuple[int, ...], loops: Sequence[InductionLoop]
    ) -> list[DetectorPassage]:
        simulation = getattr(self._thread_data, "simulation", None)
        if simulation is None:
            simulation = self._thread_data.simulation = SandboxedSimulation()
            self._open_simulations.add(simulation)
        try:
            load_with_loops(simulation, scenario, seed, loops)  # pyright: ignore[reportArgumentType]
            return simulation.passages(loops, scenario.horizon * scenario.steps_per_control_step)
        except EpisodeError:  # the process may be lost; the next run starts another process
            simulation.close()
            self._open_simulations.discard(simulation)
            self._thread_data.simulation = None
            raise

    def close(self) -> None:
        """End all processes; may be called twice."""
        self._thread_pool.shutdown(wait=False, cancel_futures=True)
        for simulation in list(self._open_simulations):  # a thread that waits for an answer gets a LostWorkerError
            simulation.close()
        self._thread_pool.shutdown()
        for simulation in list(self._open_simulations):
            simulation.close()

    def __exit__(self, *error: object) -> None:
        self.close()
