"""What became of injected faults."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np


@dataclass
class Outcome:
    """How often a fault was injected, and what happened; a fault that does harm is an AssertionError."""

    happened: Counter[str] = field(default_factory=Counter)
    facts: dict[str, Any] = field(default_factory=dict)
    """what else was measured"""

    @property
    def injected(self) -> int:
        """How many faults there were."""
        return self.happened.total()


Inject = Callable[[int, Path, np.random.Generator], Outcome]
"""(how many, a folder of its own, where all chance comes from) -> what happened"""


@dataclass(frozen=True)
class Fault:
    """One kind of fault."""

    about: str
    """what is injected"""
    inject: Inject
    quick: int
    """how many in the tests"""
    long: int
    """how many in a soak"""
    slow: bool = False
    """whether even a few take long"""


def one_line(error: Exception) -> str:
    """Return an error's words, which must be one line."""
    words = str(error)
    assert words, type(error).__name__
    assert "\n" not in words, words
    return words
