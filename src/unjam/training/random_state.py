"""Exclusive use of the global random generators by one training at a time."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

from unjam.errors import UnjamError

_lock = threading.Lock()


@contextmanager
def exclusive_random_state() -> Iterator[None]:
    """Lend the global generators of NumPy and torch to the block, with one thread for torch's operations.

    Generators and threads are restored at the end. Raise `UnjamError` if another thread is in such a block.
    """
    if not _lock.acquire(blocking=False):
        raise UnjamError("train: another training runs in this process; allowed: one, or a process for each")
    try:
        threads, numpy_state = torch.get_num_threads(), np.random.get_state()
        gpus = range(torch.cuda.device_count()) if torch.cuda.is_initialized() else ()
        with torch.random.fork_rng(gpus):
            torch.set_num_threads(1)  # more threads would compete with the workers for the cores
            try:
                yield
            finally:
                torch.set_num_threads(threads)
                np.random.set_state(numpy_state)
    finally:
        _lock.release()
