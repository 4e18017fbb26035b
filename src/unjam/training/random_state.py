"""Training draws from the generators of the whole process: one training at a time, and no trace of it."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

from unjam.errors import UnjamError

_lock = threading.Lock()


@contextmanager
def exclusive_random_state() -> Iterator[None]:
    """Give the block the global generators of NumPy and torch, and one thread for torch's operations.

    The caller's generators and threads are restored at the end.

    Raises:
        UnjamError: another thread of this process is in such a block.
    """
    if not _lock.acquire(blocking=False):
        raise UnjamError("train: another training runs in this process; allowed: one, or a process for each")
    try:
        threads, drawn = torch.get_num_threads(), np.random.get_state()
        graphics_cards = range(torch.cuda.device_count()) if torch.cuda.is_initialized() else ()
        with torch.random.fork_rng(graphics_cards):
            torch.set_num_threads(1)  # more threads would fight with the workers for the cores
            try:
                yield
            finally:
                torch.set_num_threads(threads)
                np.random.set_state(drawn)
    finally:
        _lock.release()
