"""A world without a simulator, for tests of drivers: vehicles behind leaders of constant speed."""

from typing import Any

import numpy as np

from unjam.drivers import LocalState
from unjam.drivers.command import Command, Limits
from unjam.worlds.world import DriverLog, ProgressCallback


class MockWorld:
    """CAVs behind leaders at 4 m/s; after each `turnover` control steps the first CAV leaves and another one enters."""

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
        if self._turnover and len(self.applied) % self._turnover == 0:
            self.remaining_rows, self.entered_count = list(range(1, self.cav_count)), self.entered_count + 1
            self._speed, self._gap = (np.append(values[1:], 9.0) for values in (self._speed, self._gap))

    def noise(self, episode_noise_size: int = 0) -> Any:
        if episode_noise_size:
            noise = np.random.default_rng(1).standard_normal(episode_noise_size)
            return noise if self.is_scalar else np.tile(noise, (self.cav_count, 1))
        noise = self._generator.standard_normal(self.cav_count)
        return float(noise[0]) if self.is_scalar else noise

    def record(self, driver_log: DriverLog) -> tuple[np.ndarray, DriverLog]:
        return np.array(self.applied), driver_log
