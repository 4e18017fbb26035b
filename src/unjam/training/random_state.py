"""Random state and torch defaults of a training, separated from those of the program that runs the training."""

import random
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import numpy as np
import torch

from unjam.errors import UnjamError

_training_lock = threading.Lock()


@contextmanager
def torch_defaults() -> Iterator[None]:
    """Set the defaults of torch in the block: single precision, the CPU, gradients, no automatic precision."""
    dtype, cpu = torch.get_default_dtype(), torch.device("cpu")
    # `cpu` as a context makes each operation slower.
    on_cpu = nullcontext() if torch.get_default_device() == cpu else cpu
    with torch.inference_mode(False), torch.enable_grad(), torch.autocast("cpu", enabled=False), on_cpu:
        torch.set_default_dtype(torch.float32)
        try:
            yield
        finally:
            torch.set_default_dtype(dtype)


@contextmanager
def exclusive_random_state() -> Iterator[None]:
    """Restore the global generators of Python, NumPy and torch after the block, and the number of torch's threads.

    In the block, torch has `torch_defaults` and one thread. Raise `UnjamError` if another thread is in such a block.
    """
    if not _training_lock.acquire(blocking=False):
        raise UnjamError("train: another training runs in this process; allowed: one, or a process for each")
    try:
        threads = torch.get_num_threads()
        python_state, numpy_state = random.getstate(), np.random.get_state()
        gpus = range(torch.cuda.device_count()) if torch.cuda.is_initialized() else ()
        with torch.random.fork_rng(gpus), torch_defaults():
            torch.set_num_threads(1)  # more threads would compete with the workers for the cores
            try:
                yield
            finally:
                torch.set_num_threads(threads)
                np.random.set_state(numpy_state)
                random.setstate(python_state)
    finally:
        _training_lock.release()
