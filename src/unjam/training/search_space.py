"""What is varied: ranges and choices by name, as a user asks for them or around an expert's parameters."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin, get_type_hints

from unjam.drivers.registry import DRIVERS, driver_from_name
from unjam.errors import InputError, invalid_value, unknown_name
from unjam.parameters import parse_value

if TYPE_CHECKING:
    from optuna.trial import Trial as OptunaTrial

RANGE_FACTOR = 4.0
"""a parameter is varied from its default over this to its default times this"""
ZERO_DEFAULT_HIGH = 1.0
"""upper end for a parameter that is zero by default"""


@dataclass(frozen=True)
class NumericRange:
    """Numbers between two, both included."""

    low: float
    high: float
    log: bool = False
    """whether as many are tried between 0.01 and 0.1 as between 0.1 and 1"""

    @property
    def is_integer(self) -> bool:
        """Whether they are integers."""
        return isinstance(self.low, int) and isinstance(self.high, int)

    @property
    def boundary_values(self) -> tuple[Any, ...]:
        """What is checked before the search: if these can be, those between can."""
        return self.low, self.high

    def suggest(self, trial: "OptunaTrial", key: str) -> None:
        """Let Optuna choose one."""
        if self.is_integer:
            trial.suggest_int(key, int(self.low), int(self.high), log=self.log)
        else:
            trial.suggest_float(key, self.low, self.high, log=self.log)


@dataclass(frozen=True)
class Categorical:
    """One of several values."""

    boundary_values: tuple[Any, ...]

    def suggest(self, trial: "OptunaTrial", key: str) -> None:
        """Let Optuna choose one."""
        trial.suggest_categorical(key, self.boundary_values)


SearchSpace = dict[str, NumericRange | Categorical]


def parse_search_space(texts: Sequence[str]) -> SearchSpace:
    """Return what is varied, from texts `key=low..high`, `key=low..high:log` or `key=a,b,c`.

    Raises:
        InputError: a text is none of these, or the range is empty.
    """
    space: SearchSpace = {}
    for text in texts:
        key, equals, values = (part.strip() for part in text.partition("="))
        if not (key and equals and values):
            raise invalid_value("vary", text, "key=low..high, key=low..high:log or key=a,b,c")
        if ".." in values:
            space[key] = _parse_range(text, values)
        else:
            space[key] = Categorical(tuple(parse_value(value.strip()) for value in values.split(",")))
    if not space:
        raise InputError("vary: at least one key is needed: --vary trpo.target_kl=0.003..0.1:log")
    return space


def _parse_range(text: str, values: str) -> NumericRange:
    values, log = values.removesuffix(":log"), values.endswith(":log")
    low, high, *more = (parse_value(end.strip()) for end in values.split(".."))
    numbers = all(isinstance(end, int | float) and not isinstance(end, bool) for end in (low, high))
    if more or not numbers or not low < high or not math.isfinite(high - low) or (log and low <= 0):
        raise invalid_value("vary", text, "low < high, with :log low > 0")
    return NumericRange(low, high, log)


def default_search_space(expert: str, time_step: float) -> SearchSpace:
    """Return the ranges around an expert's parameters: four times less and more, all words, both truths.

    Raises:
        InputError: there is no such expert, or nothing of it can be varied.
    """
    known = [name for name, kind in DRIVERS.items() if not kind.is_native]
    if expert not in known:
        raise unknown_name("expert", expert, known)
    default = driver_from_name(expert, time_step)
    space: SearchSpace = {}
    hints = get_type_hints(type(default))
    for field in fields(default):  # pyright: ignore[reportArgumentType]
        around = _default_range(getattr(default, field.name), hints[field.name])
        if around is not None and field.name != "time_step":
            space[field.name] = around
    if not space:
        raise InputError(f"expert: {expert!r} has nothing to tune")
    return space


def expert_search_space(texts: Sequence[str], defaults: SearchSpace) -> SearchSpace:
    """Return what a user wants to vary of an expert; whole ends of a parameter that is none are no integers.

    Args:
        texts: as `search.parse_search_space` reads them.
        around: of `default_search_space`.

    Raises:
        InputError: a text is wrong.
    """
    space = parse_search_space(texts)
    for name, values in space.items():
        default = defaults.get(name)
        if isinstance(values, NumericRange) and isinstance(default, NumericRange) and not default.is_integer:
            space[name] = NumericRange(float(values.low), float(values.high), values.log)
    return space


def _default_range(value: Any, hint: Any) -> NumericRange | Categorical | None:
    """Return what is tried of a parameter; None where nothing is near, as for a list."""
    if isinstance(value, bool):
        return Categorical((False, True))
    if get_origin(hint) is Literal:
        return Categorical(get_args(hint))
    if not isinstance(value, int | float):
        return None
    if value == 0:
        return NumericRange(0, round(RANGE_FACTOR)) if isinstance(value, int) else NumericRange(0.0, ZERO_DEFAULT_HIGH)
    if isinstance(value, int):
        return NumericRange(max(1, round(value / RANGE_FACTOR)), round(value * RANGE_FACTOR), log=True)
    ends = sorted((float(value) / RANGE_FACTOR, float(value) * RANGE_FACTOR))
    return NumericRange(*ends, log=value > 0)
