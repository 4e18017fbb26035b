"""The mean speed over a time window, as explicit memory: a sliding window for each row."""

from array import array
from dataclasses import dataclass
from typing import Any

import numpy as np

from unjam.errors import invalid_value
from unjam.physics.arrays import Array, clip, namespace

SpeedWindow = dict[str, Any]

MIN_SPARE_STEPS = 64
"""a tape is never written anew more often than after so many steps"""
MAX_WINDOW_STEPS = 1_000_000
"""steps of a window: beyond it the memory of one vehicle would fill that of a machine"""


@dataclass
class _SpeedBuffer:
    """Speeds of rows, step after step; memories that follow each other share one."""

    speeds: Array
    """[m/s], shape (steps, n)"""
    filled_steps: int
    """steps of it that have a speed"""


@dataclass(frozen=True)
class BufferedWindow:
    """A window of torch rows, oldest speed first: a stretch of a tape.

    To slide it, the newest speed is written behind it on the tape. So nothing is copied and the older
    window stays what it was, until the tape is full or its next place is taken by another memory that
    began from the same window.
    """

    buffer: _SpeedBuffer
    start: int
    steps: int

    @classmethod
    def from_speeds(cls, speeds: Array) -> "BufferedWindow":
        """Return the window of `speeds`, shape (steps, n), on a new tape that has room for more."""
        steps, n = speeds.shape
        tape = speeds.new_empty((steps + max(steps, MIN_SPARE_STEPS), n))
        tape[:steps] = speeds
        return cls(_SpeedBuffer(tape, steps), 0, steps)

    def slide(self, speed: Array) -> tuple["BufferedWindow", Array]:
        """Return the window moved on by one step, and the speed that it left behind, shape (n,)."""
        tape, end = self.buffer, self.start + self.steps
        if tape.filled_steps != end or end == len(tape.speeds):
            return BufferedWindow.from_speeds(tape.speeds[self.start : end]).slide(speed)
        tape.speeds[end] = speed
        tape.filled_steps += 1
        return BufferedWindow(tape, self.start + 1, self.steps), tape.speeds[self.start]


@dataclass(frozen=True)
class CircularWindow:
    """A window of torch rows in the order of `empty_window`, moved on without anything shared.

    Slower than a tape, but a pure function of its rows: what a graph of a whole controller needs.
    """

    rows: Array
    """[m/s], shape (n, steps)"""
    count: Array
    """how many speeds were seen since the beginning, shape (n,)"""

    @property
    def steps(self) -> int:
        """Steps of the window."""
        return self.rows.shape[1]

    def slide(self, speed: Array) -> tuple["CircularWindow", Array]:
        """Return the window moved on by one step, and the speed that it left behind, shape (n,)."""
        place = (self.count % self.steps).long()[:, None]
        oldest = self.rows.gather(1, place)[:, 0]
        return CircularWindow(self.rows.scatter(1, place, speed[:, None]), self.count + 1.0), oldest


def _buffered_window(window: Array, count: Array) -> BufferedWindow:
    """Return the window of torch rows, shape (n, steps) as `empty_window` makes it, oldest speed first."""
    xp = namespace(window)
    steps = window.shape[1]
    order = (count[:, None] + xp.arange(steps, device=window.device)) % steps
    return BufferedWindow.from_speeds(window.take_along_dim(order.long(), 1).T)


def empty_window(n: int, window: float, time_step: float) -> SpeedWindow:
    """Return the memory of `n` vehicles that have seen nothing yet, for a window of `window` seconds.

    Returns:
        `window` (n, steps): the last speeds, a new one in the place of the oldest, zeros where nothing was
        seen yet; `total` (n,): their sum; `seen` (n,): how many speeds were seen since the beginning.

    Raises:
        InputError: the window has too many steps.
    """
    if window / time_step > MAX_WINDOW_STEPS:
        raise invalid_value("window", window, f"at most {MAX_WINDOW_STEPS:,} steps of {time_step:g} s")
    steps = max(1, round(window / time_step))
    return {"window": np.zeros((n, steps)), "total": np.zeros(n), "count": np.zeros(n)}


def slide_window(memory: SpeedWindow, speed: Array) -> SpeedWindow:
    """Return the window moved on by one step, `speed` [m/s] of shape (n,) being the newest.

    The old window stays as it is; that of torch rows becomes `BufferedWindow`, unless it is `CircularWindow`.
    """
    window, seen = memory["window"], memory["count"]
    if type(speed) is float:
        window = window[:]
        place = int(seen) % len(window)
        oldest = window[place]
        window[place] = speed
    elif isinstance(speed, np.ndarray):
        window = window.copy()
        place = (np.arange(len(window)), (seen % window.shape[1]).astype(np.int64))
        oldest = window[place]
        window[place] = speed
    else:
        past = window if isinstance(window, (BufferedWindow, CircularWindow)) else _buffered_window(window, seen)
        window, oldest = past.slide(speed)
    return {"window": window, "total": memory["total"] + speed - oldest, "count": seen + 1.0}


def window_mean_speed(memory: SpeedWindow) -> Array:
    """Return the mean of what was seen [m/s], shape (n,); zero where nothing was."""
    window = memory["window"]
    if isinstance(window, array):
        steps = len(window)
    else:
        steps = window.steps if isinstance(window, (BufferedWindow, CircularWindow)) else window.shape[-1]
    return memory["total"] / clip(memory["count"], 1.0, float(steps))


def fill_window(memory: SpeedWindow, speeds: Array) -> SpeedWindow:
    """Return an empty window after watching `speeds`, shape (n, any number of steps), oldest first."""
    window = memory["window"].copy()
    watched = speeds[:, -window.shape[1] :]
    window[:, : watched.shape[1]] = watched
    return {"window": window, "total": window.sum(1), "count": memory["count"] + watched.shape[1]}
