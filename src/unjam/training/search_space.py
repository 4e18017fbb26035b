"""Search spaces of searches, tunings and calibrations: ranges and choices by name."""

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
"""default ranges go from the default value divided by this factor to its product with it"""
ZERO_DEFAULT_HIGH = 1.0
"""upper end of the range of a parameter that is zero by default"""


@dataclass(frozen=True)
class NumericRange:
    """Numbers between two limits, both included."""

    low: float
    high: float
    log: bool = False
    """whether values are proposed on a logarithmic scale"""

    @property
    def is_integer(self) -> bool:
        """Whether the values are integers."""
        return isinstance(self.low, int) and isinstance(self.high, int)

    @property
    def boundary_values(self) -> tuple[Any, ...]:
        """The values to check before a search; if they are valid, so are those between."""
        return self.low, self.high

    def suggest(self, trial: "OptunaTrial", key: str) -> None:
        """Let Optuna propose a value."""
        if self.is_integer:
            trial.suggest_int(key, int(self.low), int(self.high), log=self.log)
        else:
            trial.suggest_float(key, self.low, self.high, log=self.log)


@dataclass(frozen=True)
class Categorical:
    """One of several values."""

    boundary_values: tuple[Any, ...]

    def suggest(self, trial: "OptunaTrial", key: str) -> None:
        """Let Optuna propose a value."""
        trial.suggest_categorical(key, self.boundary_values)


SearchSpace = dict[str, NumericRange | Categorical]


def suggest_values(trial: "OptunaTrial", space: SearchSpace) -> dict[str, Any]:
    """Let Optuna propose a value for each name, and return them."""
    for key, values in space.items():
        values.suggest(trial, key)
    return {key: trial.params[key] for key in space}


def parse_search_space(texts: Sequence[str]) -> SearchSpace:
    """Return a search space from texts `key=low..high`, `key=low..high:log` or `key=a,b,c`.

    Raise `InputError` for other texts and empty ranges.
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
    low, high, *rest = (parse_value(limit.strip()) for limit in values.split(".."))
    are_numbers = all(isinstance(limit, int | float) and not isinstance(limit, bool) for limit in (low, high))
    if rest or not are_numbers or not low < high or not math.isfinite(high - low) or (log and low <= 0):
        raise invalid_value("vary", text, "low < high, with :log low > 0")
    return NumericRange(low, high, log)


def default_search_space(expert: str, time_step: float) -> SearchSpace:
    """Return the default ranges of an expert's parameters: numbers within a factor of four, all words, both booleans.

    Raise `InputError` if there is no such expert, or if it has nothing to vary.
    """
    names = [name for name, kind in DRIVERS.items() if not kind.is_native]
    if expert not in names:
        raise unknown_name("expert", expert, names)
    default = driver_from_name(expert, time_step)
    hints = get_type_hints(type(default))
    ranges = {
        field.name: _default_range(getattr(default, field.name), hints[field.name])
        for field in fields(default)  # pyright: ignore[reportArgumentType]
        if field.name != "time_step"
    }
    space: SearchSpace = {name: values for name, values in ranges.items() if values is not None}
    if not space:
        raise InputError(f"expert: {expert!r} has nothing to tune")
    return space


def expert_search_space(texts: Sequence[str], defaults: SearchSpace) -> SearchSpace:
    """Return the search space of an expert from texts as in `parse_search_space`.

    A range with integer limits is still one of numbers if that of `defaults` (`default_search_space`) is.
    """
    space = parse_search_space(texts)
    for name, values in space.items():
        default = defaults.get(name)
        if isinstance(values, NumericRange) and isinstance(default, NumericRange) and not default.is_integer:
            space[name] = NumericRange(float(values.low), float(values.high), values.log)
    return space


def _default_range(value: Any, hint: Any) -> NumericRange | Categorical | None:
    """Return the default range of a parameter; None for types without one, as lists."""
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
    limits = sorted((float(value) / RANGE_FACTOR, float(value) * RANGE_FACTOR))
    return NumericRange(*limits, log=value > 0)
