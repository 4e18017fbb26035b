"""What is varied: ranges and choices by name, as a user asks for them or around an expert's parameters."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin, get_type_hints

from unjam.drivers.registry import DRIVERS, named_driver
from unjam.errors import InputError, wrong, wrong_name
from unjam.parameters import parse_value

if TYPE_CHECKING:
    from optuna.trial import Trial as OptunaTrial

WIDTH = 4.0
"""a parameter is varied from its default over this to its default times this"""
TO_ONE = 1.0
"""upper end for a parameter that is zero by default"""


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

    def suggest(self, trial: "OptunaTrial", key: str) -> None:
        """Let Optuna choose one."""
        if self.whole:
            trial.suggest_int(key, int(self.low), int(self.high), log=self.log)
        else:
            trial.suggest_float(key, self.low, self.high, log=self.log)


@dataclass(frozen=True)
class Choice:
    """One of several values."""

    ends: tuple[Any, ...]

    def suggest(self, trial: "OptunaTrial", key: str) -> None:
        """Let Optuna choose one."""
        trial.suggest_categorical(key, self.ends)


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
        if ".." in values:
            space[key] = _range(text, values)
        else:
            space[key] = Choice(tuple(parse_value(value.strip()) for value in values.split(",")))
    if not space:
        raise InputError("vary: at least one key is needed: --vary trpo.target_kl=0.003..0.1:log")
    return space


def _range(text: str, values: str) -> Range:
    values, log = values.removesuffix(":log"), values.endswith(":log")
    low, high, *more = (parse_value(end.strip()) for end in values.split(".."))
    numbers = all(isinstance(end, int | float) and not isinstance(end, bool) for end in (low, high))
    if more or not numbers or not low < high or not math.isfinite(high - low) or (log and low <= 0):
        raise wrong("vary", text, "low < high, with :log low > 0")
    return Range(low, high, log)


def space_around(expert: str, time_step: float) -> Space:
    """Return the ranges around an expert's parameters: four times less and more, all words, both truths.

    Raises:
        InputError: there is no such expert, or nothing of it can be varied.
    """
    known = [name for name, kind in DRIVERS.items() if not kind.native]
    if expert not in known:
        raise wrong_name("expert", expert, known)
    default = named_driver(expert, time_step)
    space: Space = {}
    hints = get_type_hints(type(default))
    for field in fields(default):  # pyright: ignore[reportArgumentType]
        around = _around(getattr(default, field.name), hints[field.name])
        if around is not None and field.name != "time_step":
            space[field.name] = around
    if not space:
        raise InputError(f"expert: {expert!r} has nothing to tune")
    return space


def space_asked(texts: Sequence[str], around: Space) -> Space:
    """Return what a user wants to vary of an expert; whole ends of a parameter that is none are no integers.

    Args:
        texts: as `search.space_of` reads them.
        around: of `space_around`.

    Raises:
        InputError: a text is wrong.
    """
    space = space_of(texts)
    for name, values in space.items():
        default = around.get(name)
        if isinstance(values, Range) and isinstance(default, Range) and not default.whole:
            space[name] = Range(float(values.low), float(values.high), values.log)
    return space


def _around(value: Any, hint: Any) -> Range | Choice | None:
    """Return what is tried of a parameter; None where nothing is near, as for a list."""
    if isinstance(value, bool):
        return Choice((False, True))
    if get_origin(hint) is Literal:
        return Choice(get_args(hint))
    if not isinstance(value, int | float):
        return None
    if value == 0:
        return Range(0, round(WIDTH)) if isinstance(value, int) else Range(0.0, TO_ONE)
    if isinstance(value, int):
        return Range(max(1, round(value / WIDTH)), round(value * WIDTH), log=True)
    ends = sorted((float(value) / WIDTH, float(value) * WIDTH))
    return Range(*ends, log=value > 0)
