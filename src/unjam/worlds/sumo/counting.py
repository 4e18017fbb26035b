"""Several confined simulations at once, of people alone on a network of the user's own, with detectors."""

import queue
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Self

from unjam.errors import EpisodeError, LostError
from unjam.scenarios.own_network import OwnNetwork
from unjam.tree import unpack
from unjam.worlds.sumo.apart import SimulationApart
from unjam.worlds.sumo.detectors import Loop, Passage, load_with_loops

ATTEMPTS = 3
"""processes that may be lost on the same simulation"""


class Counting:
    """A fixed number of confined SUMO processes, started when first needed, that count who passes loops.

    What they count depends on scenario, seed and loops alone, not on how many there are.
    """

    def __init__(self, count: int = 1) -> None:
        """Prepare `count` processes; nothing is started yet."""
        self._threads = ThreadPoolExecutor(count, thread_name_prefix="unjam-counting")
        self._idle: queue.SimpleQueue[SimulationApart | None] = queue.SimpleQueue()
        self._open: set[SimulationApart] = set()
        for _ in range(count):
            self._idle.put(None)

    def run(
        self, scenario: OwnNetwork, seeds: Sequence[tuple[int, ...]], loops: Sequence[Loop]
    ) -> list[list[Passage]]:
        """Return who passed the loops in the traffic of each seed, in the order of the seeds.

        Raises:
            EpisodeError: SUMO cannot run the scenario.
            LostError: its process was lost, again and again.
        """
        futures = [self._threads.submit(self._run_again, scenario, seed, loops) for seed in seeds]
        try:
            return [future.result() for future in futures]
        except BaseException:
            for future in futures:
                future.cancel()
            raise

    def _run_again(self, scenario: OwnNetwork, seed: tuple[int, ...], loops: Sequence[Loop]) -> list[Passage]:
        """Return who passed, in another process where one was lost."""
        for _ in range(ATTEMPTS - 1):
            with suppress(LostError):
                return self._run_one(scenario, seed, loops)
        return self._run_one(scenario, seed, loops)

    def _run_one(self, scenario: OwnNetwork, seed: tuple[int, ...], loops: Sequence[Loop]) -> list[Passage]:
        simulation = self._idle.get()
        try:
            if simulation is None:
                simulation = SimulationApart()
                self._open.add(simulation)
            load_with_loops(simulation, scenario, seed, loops)  # pyright: ignore[reportArgumentType]
            steps = scenario.horizon * scenario.steps_per_decision
            return unpack(list[Passage], simulation.passages(loops, steps), {})
        except EpisodeError:
            if simulation is not None:  # it may be lost: another one goes on
                simulation.close()
                self._open.discard(simulation)
            simulation = None
            raise
        finally:
            self._idle.put(simulation)

    def close(self) -> None:
        """End all processes; may be called twice."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        for simulation in list(self._open):  # who waits for one is told that it was lost
            simulation.close()
        self._threads.shutdown()
        for simulation in list(self._open):
            simulation.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
