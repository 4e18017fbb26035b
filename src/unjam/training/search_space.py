"""What a search varies: ranges and choices of keys of a configuration."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from unjam.errors import InputError, wrong
from unjam.parameters import merge, nested, parse_value
from unjam.training.config import RunConfig, load_config
from unjam.training.folder import check_possible


@dataclass(frozen=True)
class Range:
    """Numbers between two, both included."""

    low: float
    high: float
    log: bool = False
    """whether as many are tried between 0.01 and 0.1 as between 0.1 and 1"""

    @property
    def whole(self) -> bool:
        """Whether they are integers."""
        return isinstance(self.low, int) and isinstance(self.high, int)

    @property
    def ends(self) -> tuple[Any, ...]:
        """What is checked before the search: if these can be, those between can."""
        return self.low, self.high


@dataclass(frozen=True)
class Choice:
    """One of several values."""

    ends: tuple[Any, ...]


Space = dict[str, Range | Choice]


def space_of(texts: Sequence[str]) -> Space:
    """Return what is varied, from texts `key=low..high`, `key=low..high:log` or `key=a,b,c`.

    Raises:
        InputError: a text is none of these, or the range is empty.
    """
    space: Space = {}
    for text in texts:
        key, equals, values = (part.strip() for part in text.partition("="))
        if not (key and equals and values):
            raise wrong("vary", text, "key=low..high, key=low..high:log or key=a,b,c")
        space[key] = _range(text, values) if ".." in values else Choice(_values(values))
    if not space:
        raise InputError("vary: at least one key is needed: --vary trpo.target_kl=0.003..0.1:log")
    return space


def _values(text: str) -> tuple[Any, ...]:
    return tuple(parse_value(value.strip()) for value in text.split(","))


def _range(text: str, values: str) -> Range:
    values, log = values.removesuffix(":log"), values.endswith(":log")
    low, high, *more = (parse_value(end.strip()) for end in values.split(".."))
    numbers = all(isinstance(end, int | float) and not isinstance(end, bool) for end in (low, high))
    if more or not numbers or not low < high or not math.isfinite(high) or (log and low <= 0):
        raise wrong("vary", text, "low < high, with :log low > 0")
    return Range(low, high, log)


def check_space(base: RunConfig, space: Space) -> None:
    """Raise `InputError` where a search cannot work: an unknown key, a value out of range, no validation."""
    if base.evaluation.every == 0:
        raise wrong("evaluation.every", 0, ">= 1: trials are judged by validations")
    for key, values in space.items():
        for end in values.ends:
            check_possible(trial_config(base, {key: end}))


def trial_config(base: RunConfig, values: dict[str, Any]) -> RunConfig:
    """Return a configuration with some values changed; keys may have dots."""
    return load_config(changes=merge(asdict(base), nested(values)))
