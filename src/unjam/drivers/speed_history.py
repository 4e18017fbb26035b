"""The mean speed over a time window, as explicit memory: a sliding window for each row."""

from array import array

import numpy as np

from unjam.physics.arrays import Array, clip, namespace

Window = dict[str, Array]


def empty_window(n: int, window: float, time_step: float) -> Window:
    """Return the memory of `n` vehicles that have seen nothing yet, for a window of `window` seconds.

    Returns:
        `window` (n, steps): the last speeds, a new one in the place of the oldest, zeros where nothing was
        seen yet; `total` (n,): their sum; `seen` (n,): how many speeds were seen since the beginning.
    """
    steps = max(1, round(window / time_step))
    return {"window": np.zeros((n, steps)), "total": np.zeros(n), "seen": np.zeros(n)}


def slide(memory: Window, speed: Array) -> Window:
    """Return the window moved on by one step, `speed` [m/s] of shape (n,) being the newest; new arrays."""
    seen = memory["seen"]
    if type(speed) is float:
        window = memory["window"][:]
        place = int(seen) % len(window)
        oldest = window[place]
    else:
        xp = namespace(speed)
        window = xp.asarray(memory["window"], copy=True)
        place = (xp.arange(len(window)), xp.asarray(seen % window.shape[1], dtype=xp.int64))
        oldest = window[place]
    window[place] = speed
    return {"window": window, "total": memory["total"] + speed - oldest, "seen": seen + 1.0}


def mean_speed(memory: Window) -> Array:
    """Return the mean of what was seen [m/s], shape (n,); zero where nothing was."""
    window = memory["window"]
    steps = len(window) if isinstance(window, array) else window.shape[-1]
    return memory["total"] / clip(memory["seen"], 1.0, float(steps))


def fill(memory: Window, speeds: Array) -> Window:
    """Return an empty window after watching `speeds`, shape (n, any number of steps), oldest first."""
    window = memory["window"].copy()
    watched = speeds[:, -window.shape[1] :]
    window[:, : watched.shape[1]] = watched
    return {"window": window, "total": window.sum(1), "seen": memory["seen"] + watched.shape[1]}
