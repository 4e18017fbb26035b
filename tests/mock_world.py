"""A world without a simulator: vehicles behind leaders of constant speed, for tests of drivers."""

from typing import Any

import numpy as np

from unjam.drivers import LocalState
from unjam.drivers.command import Command, Limits
from unjam.worlds.world import DriverLog, ProgressCallback


class MockWorld:
    """`rows` CAVs, each behind a leader at 4 m/s; with `turnover`, the first one leaves now and then."""

    def __init__(self, rows: int = 3, decisions: int = 40, single: bool = False, turnover: int = 0) -> None:
        self.cav_count, self.entered_count, self.is_scalar, self.limits = rows, rows, single, Limits(-1.0, 1.0)
        self.remaining_rows: Any = None
        self.applied: list[Any] = []
        self._decisions, self._turnover = decisions, turnover
        self._speed, self._gap = np.zeros(rows), np.linspace(8.0, 20.0, rows)
        self._generator = np.random.default_rng(0)

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> LocalState | None:
        return None

    @property
    def has_ended(self) -> bool:
        return len(self.applied) >= self._decisions

    def local_state(self) -> LocalState:
        speed, gap = self._speed, self._gap
        state = LocalState(speed, speed * 0.0 + 4.0, gap, speed, gap, speed * 0.0, speed * 0.0 + 230.0)
        return state.map(lambda values: float(values[0])) if self.is_scalar else state

    def advance(self, command: Command | None) -> None:
        acceleration = np.zeros(self.cav_count) if command is None else np.atleast_1d(command.acceleration)
        self.applied.append(self.limits.clip(acceleration))
        self._speed = np.maximum(self._speed + 0.1 * self.applied[-1], 0.0)
        self._gap = self._gap + 0.1 * (4.0 - self._speed)
        self.remaining_rows = None
        if self._turnover and len(self.applied) % self._turnover == 0:  # the first leaves, another one enters
            self.remaining_rows, self.entered_count = list(range(1, self.cav_count)), self.entered_count + 1
            self._speed, self._gap = (np.append(each[1:], 9.0) for each in (self._speed, self._gap))

    def noise(self, episode_noise_size: int = 0) -> Any:
        if episode_noise_size:
            same = np.random.default_rng(1).standard_normal(episode_noise_size)
            return same if self.is_scalar else np.tile(same, (self.cav_count, 1))
        drawn = self._generator.standard_normal(self.cav_count)
        return float(drawn[0]) if self.is_scalar else drawn

    def record(self, driver_log: DriverLog) -> tuple[np.ndarray, DriverLog]:
        return np.array(self.applied), driver_log
