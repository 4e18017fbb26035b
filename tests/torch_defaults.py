"""Other defaults of torch, which programs of users can set."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def other_default(value: torch.dtype | torch.device) -> Iterator[None]:
    """Make a type or a device the default in the block."""
    if isinstance(value, torch.dtype):
        torch.set_default_dtype(value)
    else:
        torch.set_default_device(value)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)
        torch.set_default_device(None)
