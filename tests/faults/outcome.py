"""Injected faults, and their outcomes."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np


@dataclass
class Outcome:
    """Outcomes of injected faults; a fault with a harmful outcome raises an AssertionError."""

    happened: Counter[str] = field(default_factory=Counter)
    """number of faults by outcome"""
    facts: dict[str, Any] = field(default_factory=dict)
    """other measured quantities"""

    @property
    def injected(self) -> int:
        """Number of injected faults."""
        return self.happened.total()


FaultInjector = Callable[[int, Path, np.random.Generator], Outcome]
"""injects a number of faults in an empty folder, with random numbers of a generator, and returns their outcomes"""


@dataclass(frozen=True)
class Fault:
    """One kind of fault."""

    description: str
    """description of the fault"""
    inject: FaultInjector
    quick_count: int
    """number of faults in the tests"""
    long_count: int
    """number of faults in a soak test"""
    is_slow: bool = False
    """whether even a few faults take minutes"""


def one_line(error: Exception) -> str:
    """Return the message of an error, which must be one line."""
    message = str(error)
    assert message, type(error).__name__
    assert "\n" not in message, message
    return message
