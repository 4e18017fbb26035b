"""The mean speed over a time window, as explicit memory: a sliding window for each row."""

from array import array
from dataclasses import dataclass
from typing import Any

import numpy as np

from unjam.errors import invalid_value
from unjam.physics.arrays import Array, clip, namespace, replace_columns

SpeedWindow = dict[str, Any]

MIN_SPARE_STEPS = 64
"""minimum number of steps between two copies of a buffer"""
MAX_WINDOW_STEPS = 1_000_000
"""steps of a window: longer ones would make the memory of one vehicle too large"""


@dataclass
class _SpeedBuffer:
    """Speeds of rows over time; consecutive memories share one buffer."""

    speeds: Array
    """speeds of the last steps [m/s], shape (steps, n)"""
    filled_steps: int


@dataclass(frozen=True)
class BufferedWindow:
    """A window of torch rows, oldest speed first: a part of a buffer, behind which a slide writes the newest speed.

    Nothing is copied, until the buffer is full or another memory that started from the same window has written there.
    """

    buffer: _SpeedBuffer
    start: int
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
        buffer, end = self.buffer, self.start + self.steps
        if buffer.filled_steps != end or end == len(buffer.speeds):
            return BufferedWindow.from_speeds(buffer.speeds[self.start : end]).slide(speed)
        buffer.speeds[end] = speed
        buffer.filled_steps += 1
        return BufferedWindow(buffer, self.start + 1, self.steps), buffer.speeds[self.start]

    def replace_rows(self, rows: Any, source: "BufferedWindow", source_rows: Any) -> "BufferedWindow":
        """Return a window, in a new buffer, in which some rows are those of another window of as many steps."""
        own, other = (
            history.buffer.speeds[history.start : history.start + history.steps] for history in (self, source)
        )
        return BufferedWindow.from_speeds(replace_columns(own, rows, other, source_rows))

    def detach(self) -> "BufferedWindow":
        """Return a copy without gradients."""
        return BufferedWindow.from_speeds(self.buffer.speeds[self.start : self.start + self.steps].detach())


@dataclass(frozen=True)
class CircularWindow:
    """A window of torch rows in the order of `empty_window`: a pure function, as the graph of a controller requires."""

    rows: Array
    """speeds of the last steps [m/s], shape (n, steps)"""
    count: Array
    """number of speeds since the start, shape (n,)"""

    @property
    def steps(self) -> int:
        """Steps of the window."""
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

    `window` (n, steps): the speeds of the last `window` seconds, the newest in place of the oldest, zeros before the
    first; `total` (n,): their sum; `count` (n,): number of speeds since the start.
    """
    if window / time_step > MAX_WINDOW_STEPS:
        raise invalid_value("window", window, f"at most {MAX_WINDOW_STEPS:,} steps of {time_step:g} s")
    steps = max(1, round(window / time_step))
    return {"window": np.zeros((n, steps)), "total": np.zeros(n), "count": np.zeros(n)}


def slide_window(memory: SpeedWindow, speed: Array) -> SpeedWindow:
    """Return the window one step later, with `speed` [m/s] of shape (n,) as the newest; the old one is not changed."""
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
    """Return the mean of the speeds so far [m/s], shape (n,); zero before the first."""
    window = memory["window"]
    if isinstance(window, array):
        steps = len(window)
    else:
        steps = window.steps if isinstance(window, (BufferedWindow, CircularWindow)) else window.shape[-1]
    return memory["total"] / clip(memory["count"], 1.0, float(steps))


def fill_window(memory: SpeedWindow, speeds: Array) -> SpeedWindow:
    """Return an empty window after `speeds`, shape (n, any number of steps), oldest first."""
    window = memory["window"].copy()
    last = speeds[:, -window.shape[1] :]
    window[:, : last.shape[1]] = last
    return {"window": window, "total": window.sum(1), "count": memory["count"] + last.shape[1]}
