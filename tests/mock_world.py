"""A world without a simulator: vehicles behind leaders of constant speed, for tests of drivers."""

from typing import Any

import numpy as np

from unjam.drivers import LocalState
from unjam.drivers.command import Command, Limits
from unjam.worlds.world import Driven, OnProgress


class MockWorld:
    """`rows` CAVs, each behind a leader at 4 m/s; with `turnover`, the first one leaves now and then."""

    def __init__(self, rows: int = 3, decisions: int = 40, single: bool = False, turnover: int = 0) -> None:
        self.rows, self.entered, self.single, self.limits = rows, rows, single, Limits(-1.0, 1.0)
        self.kept: Any = None
        self.applied: list[Any] = []
        self._decisions, self._turnover = decisions, turnover
        self._speed, self._gap = np.zeros(rows), np.linspace(8.0, 20.0, rows)
        self._generator = np.random.default_rng(0)

    def start(self, controlled: bool, on_progress: OnProgress | None = None) -> LocalState | None:
        return None

    @property
    def ended(self) -> bool:
        return len(self.applied) >= self._decisions

    def perceive(self) -> LocalState:
        speed, gap = self._speed, self._gap
        state = LocalState(speed, speed * 0.0 + 4.0, gap, speed, gap, speed * 0.0, speed * 0.0 + 230.0)
        return state.each(lambda values: float(values[0])) if self.single else state

    def advance(self, command: Command | None) -> None:
        told = np.zeros(self.rows) if command is None else np.atleast_1d(command.acceleration)
        self.applied.append(self.limits.keep(told))
        self._speed = np.maximum(self._speed + 0.1 * self.applied[-1], 0.0)
        self._gap = self._gap + 0.1 * (4.0 - self._speed)
        self.kept = None
        if self._turnover and len(self.applied) % self._turnover == 0:  # the first leaves, another one enters
            self.kept, self.entered = list(range(1, self.rows)), self.entered + 1
            self._speed, self._gap = (np.append(each[1:], 9.0) for each in (self._speed, self._gap))

    def noise(self, lasting: int = 0) -> Any:
        if lasting:
            same = np.random.default_rng(1).standard_normal(lasting)
            return same if self.single else np.tile(same, (self.rows, 1))
        drawn = self._generator.standard_normal(self.rows)
        return float(drawn[0]) if self.single else drawn

    def record(self, driven: Driven) -> tuple[np.ndarray, Driven]:
        return np.array(self.applied), driven
