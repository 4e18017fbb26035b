"""A driver whose sensors and actuator are worse than in training; given to workers as a file's driver."""

from pathlib import Path
from typing import Any

import numpy as np

from unjam.controller import make_driver
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.from_file import FileDriver
from unjam.drivers.local_state import LocalState
from unjam.physics.arrays import Array

INNER, AGE, SENT = "inner.", "age", "sent"


def impaired(driver: str, time_step: float, delay: float = 0.0, gap_noise: float = 0.0) -> Driver:
    """Return a driver that acts late, or sees its gaps inexactly.

    Args:
        driver: what `--driver` takes.
        time_step: time between two decisions [s].
        delay: time after which a command is carried out, rounded to whole decisions [s].
        gap_noise: standard deviation of both gaps, anew in every decision [m].
    """
    parameters = {"driver": driver, "delay": delay, "gap_noise": gap_noise}
    return FileDriver(Path(__file__), "Impaired", parameters, time_step)


class Impaired:
    """Passes what it sees, with noise, to another driver, and hands on what that one said a while ago."""

    def __init__(self, driver: str, delay: float, gap_noise: float, time_step: float) -> None:
        self._driver = make_driver(driver, time_step)
        self._late = round(delay / time_step)
        self._gap_noise = gap_noise

    def initial_memory(self, n: int) -> Memory:
        """Return that of the other driver, that nothing was said yet, and that no decision was made."""
        inner = {f"{INNER}{name}": value for name, value in self._driver.initial_memory(n).items()}
        return {**inner, AGE: np.zeros(n), SENT: np.zeros((n, self._late))}

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return what the other driver makes of the warm-up."""
        return {**memory, **_outer(self._driver.recall(_inner(memory), history))}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return what was said `delay` ago, and remember what is said now."""
        said, inner = self._driver.act(self._seen(state, memory[AGE]), _inner(memory))
        sent = np.concatenate([memory[SENT], np.asarray(said)[:, None]], axis=1)
        return sent[:, 0], {**_outer(inner), AGE: memory[AGE] + 1.0, SENT: sent[:, 1:]}

    def _seen(self, state: LocalState, age: Array) -> LocalState:
        if self._gap_noise == 0.0:
            return state
        # A driver's answer must not depend on who drives beside it: what it sees is the seed.
        rows = np.stack([age, state.speed, state.leader_gap, state.follower_gap], -1)
        noise = [np.random.default_rng(row.view(np.uint64).tolist()).normal(size=2) for row in rows]
        ahead, behind = self._gap_noise * np.array(noise).T
        return state._replace(
            leader_gap=np.maximum(state.leader_gap + ahead, 0.1),
            follower_gap=np.maximum(state.follower_gap + behind, 0.1),
        )


def _inner(memory: Memory) -> Memory:
    return {name.removeprefix(INNER): value for name, value in memory.items() if name.startswith(INNER)}


def _outer(memory: Memory) -> dict[str, Any]:
    return {f"{INNER}{name}": value for name, value in memory.items()}
