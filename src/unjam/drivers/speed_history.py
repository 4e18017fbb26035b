"""The mean speed over a time window, as explicit memory: a sliding window for each row."""

from array import array
from dataclasses import dataclass
from typing import Any

import numpy as np

from unjam.errors import invalid_value
from unjam.physics.arrays import Array, clip, namespace, replace_columns

SpeedWindow = dict[str, Any]
"""memory of a sliding window: `window`, `total` and `count` as `empty_window` describes them"""

MIN_SPARE_STEPS = 64
"""minimum number of steps between two copies of a buffer"""
MAX_WINDOW_STEPS = 1_000_000
"""largest number of steps of a window, which limits the memory of one vehicle"""


@dataclass
class _SpeedBuffer:
    """Speeds of n rows over time; consecutive windows share one buffer."""

    speeds: Array
    """speeds of the last steps [m/s], shape (steps, n)"""
    filled_steps: int


@dataclass(frozen=True)
class BufferedWindow:
    """A window of torch rows, oldest speed first: a range of steps of a buffer, which `slide` extends by a newest step.

    `slide` copies speeds only if the buffer is full, or if another window has already extended the buffer.
    """

    buffer: _SpeedBuffer
    first_step: int
    steps: int

    @classmethod
    def from_speeds(cls, speeds: Array) -> "BufferedWindow":
        """Return the window of `speeds`, shape (steps, n), in a new buffer with spare steps."""
        steps, n = speeds.shape
        buffer = speeds.new_empty((steps + max(steps, MIN_SPARE_STEPS), n))
        buffer[:steps] = speeds
        return cls(_SpeedBuffer(buffer, steps), 0, steps)

    def slide(self, speed: Array) -> tuple["BufferedWindow", Array]:
        """Return the window one step later, and the speed that left it, shape (n,)."""
        buffer, end = self.buffer, self.first_step + self.steps
        if buffer.filled_steps != end or end == len(buffer.speeds):
            return BufferedWindow.from_speeds(self.speeds).slide(speed)
        buffer.speeds[end] = speed
        buffer.filled_steps += 1
        return BufferedWindow(buffer, self.first_step + 1, self.steps), buffer.speeds[self.first_step]

    @property
    def speeds(self) -> Array:
        """Speeds of the window [m/s], shape (steps, n)."""
        return self.buffer.speeds[self.first_step : self.first_step + self.steps]

    def replace_rows(self, rows: Any, source: "BufferedWindow", source_rows: Any) -> "BufferedWindow":
        """Return a window in a new buffer, with `source_rows` of an equally long window in place of `rows`."""
        return BufferedWindow.from_speeds(replace_columns(self.speeds, rows, source.speeds, source_rows))

    def detach(self) -> "BufferedWindow":
        """Return a copy without gradients."""
        return BufferedWindow.from_speeds(self.speeds.detach())


@dataclass(frozen=True)
class CircularWindow:
    """A window of torch rows in the order of `empty_window`: `slide` is a pure function, as exported graphs require."""

    rows: Array
    """speeds of the last steps [m/s], shape (n, steps)"""
    count: Array
    """number of speeds since the start, shape (n,)"""

    @property
    def steps(self) -> int:
        """Number of steps of the window."""
        return self.rows.shape[1]

    def slide(self, speed: Array) -> tuple["CircularWindow", Array]:
        """Return the window one step later, and the speed that left it, shape (n,)."""
        position = (self.count % self.steps).long()[:, None]
        oldest = self.rows.gather(1, position)[:, 0]
        return CircularWindow(self.rows.scatter(1, position, speed[:, None]), self.count + 1.0), oldest


def _buffered_window(window: Array, count: Array) -> BufferedWindow:
    steps = window.shape[1]
    order = (count[:, None] + namespace(window).arange(steps, device=window.device)) % steps
    return BufferedWindow.from_speeds(window.take_along_dim(order.long(), 1).T)


def empty_window(n: int, window: float, time_step: float) -> SpeedWindow:
    """Return the memory of `n` vehicles before the first speed; raise `InputError` if the window has too many steps.

    `window` (n, steps): speeds of the last `window` seconds, zeros before the first speed; a new speed replaces the
    oldest one. `total` (n,): sum of these speeds. `count` (n,): number of speeds since the start.
    """
    if window / time_step > MAX_WINDOW_STEPS:
        raise invalid_value("window", window, f"at most {MAX_WINDOW_STEPS:,} steps of {time_step:g} s")
    steps = max(1, round(window / time_step))
    return {"window": np.zeros((n, steps)), "total": np.zeros(n), "count": np.zeros(n)}


def slide_window(memory: SpeedWindow, speed: Array) -> SpeedWindow:
    """Return a new window one step later, with `speed` [m/s] of shape (n,) as the newest speed."""
    window, count = memory["window"], memory["count"]
    if type(speed) is float:
        window = window[:]
        position = int(count) % len(window)
        oldest = window[position]
        window[position] = speed
    elif isinstance(speed, np.ndarray):
        window = window.copy()
        position = (np.arange(len(window)), (count % window.shape[1]).astype(np.int64))
        oldest = window[position]
        window[position] = speed
    else:
        is_window = isinstance(window, (BufferedWindow, CircularWindow))
        window, oldest = (window if is_window else _buffered_window(window, count)).slide(speed)
    return {"window": window, "total": memory["total"] + speed - oldest, "count": count + 1.0}


def window_mean_speed(memory: SpeedWindow) -> Array:
    """Return the mean of the speeds in the window [m/s], shape (n,); zero before the first speed."""
    window = memory["window"]
    if isinstance(window, array):
        steps = len(window)
    else:
        steps = window.steps if isinstance(window, (BufferedWindow, CircularWindow)) else window.shape[-1]
    return memory["total"] / clip(memory["count"], 1.0, float(steps))


def fill_window(memory: SpeedWindow, speeds: Array) -> SpeedWindow:
    """Return the empty window `memory` after `speeds` [m/s], oldest first, shape (n, any number of steps)."""
    window = memory["window"].copy()
    last_speeds = speeds[:, -window.shape[1] :]
    window[:, : last_speeds.shape[1]] = last_speeds
    return {"window": window, "total": window.sum(1), "count": memory["count"] + last_speeds.shape[1]}
