"""Search spaces of searches, tunings and calibrations: Optuna's distributions by name."""

import math
from collections.abc import Sequence
from inspect import isclass, signature
from typing import Any, Literal, get_args, get_origin, get_type_hints

import optuna
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from unjam.drivers.registry import DRIVERS, driver_from_name
from unjam.drivers.user_driver import FileReference, is_file_reference
from unjam.errors import InputError, invalid_value, unknown_name
from unjam.parameters import parse_value
from unjam.tree import named_parts

optuna.logging.set_verbosity(optuna.logging.WARNING)

RANGE_FACTOR = 4.0
"""default ranges go from the default value divided by this factor to its product with it"""
ZERO_DEFAULT_HIGH = 1.0
"""upper end of the range of a parameter that is zero by default"""

Distribution = FloatDistribution | IntDistribution | CategoricalDistribution
SearchSpace = dict[str, Distribution]


def boundary_values(values: Distribution) -> Sequence[Any]:
    """Return the values to check before a search; if they are valid, so are those between."""
    return values.choices if isinstance(values, CategoricalDistribution) else (values.low, values.high)


def parse_search_space(texts: Sequence[str]) -> SearchSpace:
    """Return a search space from texts `key=low..high`, `key=low..high:log` or `key=a,b,c`; else `InputError`."""
    space: SearchSpace = {}
    for text in texts:
        key, equals, values = (part.strip() for part in text.partition("="))
        if not (key and equals and values):
            raise invalid_value("vary", text, "key=low..high, key=low..high:log or key=a,b,c")
        if ".." in values:
            space[key] = _parse_range(text, values)
        else:
            space[key] = CategoricalDistribution([parse_value(value.strip()) for value in values.split(",")])
    if not space:
        raise InputError("vary: at least one key is needed: --vary trpo.target_kl=0.003..0.1:log")
    return space


def _parse_range(text: str, values: str) -> Distribution:
    values, log = values.removesuffix(":log"), values.endswith(":log")
    low, high, *rest = (parse_value(limit.strip()) for limit in values.split(".."))
    are_numbers = all(isinstance(limit, int | float) and not isinstance(limit, bool) for limit in (low, high))
    if rest or not are_numbers or not low < high or not math.isfinite(high - low) or (log and low <= 0):
        raise invalid_value("vary", text, "low < high, with :log low > 0")
    kind = IntDistribution if isinstance(low, int) and isinstance(high, int) else FloatDistribution
    return kind(low, high, log=log)


def float_range(values: Distribution) -> Distribution:
    """Return a range of integers as one of numbers, and other values unchanged."""
    return FloatDistribution(values.low, values.high, values.log) if isinstance(values, IntDistribution) else values


def default_search_space(expert: str, time_step: float) -> SearchSpace:
    """Return the default ranges of an expert's parameters: numbers within a factor of four, all words, both booleans.

    Raise `InputError` if there is no such expert, or if it has nothing to vary.
    """
    parameters = tunable_parameters(expert, time_step)
    ranges = {name: _default_range(value, hint) for name, (value, hint) in parameters.items()}
    space: SearchSpace = {name: values for name, values in ranges.items() if values is not None}
    if not space:
        raise InputError(f"expert: {expert!r} has nothing to tune")
    return space


def tunable_parameters(expert: str, time_step: float) -> dict[str, tuple[Any, Any]]:
    """Return default value and type of an expert's parameters by name, also of a class `path.py:name`.

    Raise `InputError` if there is no such expert.
    """
    if is_file_reference(expert):
        kind = FileReference.parse(expert).load_object()
        parameters = signature(kind).parameters.values() if isclass(kind) else ()
        driver_from_name(expert, time_step)  # an error of the class is reported here, and not in each trial
        found = {each.name: (each.default, each.annotation) for each in parameters if each.default is not each.empty}
        for name, (value, hint) in found.items():
            if type(value) is int and hint not in (int, "int"):  # a number as most people write it
                found[name] = float(value), hint
    else:
        names = [name for name, kind in DRIVERS.items() if not kind.is_native]
        if expert not in names:
            raise unknown_name("expert", expert, names)
        values = named_parts(driver_from_name(expert, time_step)) or {}
        hints = get_type_hints(DRIVERS[expert])
        found = {name: (value, hints[name]) for name, value in values.items()}
    return {name: each for name, each in found.items() if name != "time_step"}


def expert_search_space(texts: Sequence[str], defaults: SearchSpace) -> SearchSpace:
    """Return the search space of texts; integer limits are numbers where `defaults`, the expert's, are."""
    space = parse_search_space(texts)
    is_float = {name: isinstance(defaults.get(name), FloatDistribution) for name in space}
    return {name: float_range(values) if is_float[name] else values for name, values in space.items()}


def _default_range(value: Any, hint: Any) -> Distribution | None:
    """Return the default range of a parameter; None for types without one, as lists."""
    if isinstance(value, bool):
        return CategoricalDistribution((False, True))
    if get_origin(hint) is Literal:
        return CategoricalDistribution(get_args(hint))
    if isinstance(value, int):
        if value == 0:
            return IntDistribution(0, round(RANGE_FACTOR))
        low, high = sorted((round(value / RANGE_FACTOR), round(value * RANGE_FACTOR)))
        return IntDistribution(max(1, low), high, log=True) if value > 0 else IntDistribution(low, min(-1, high))
    if not isinstance(value, float) or not math.isfinite(value * RANGE_FACTOR):
        return None
    if value == 0:
        return FloatDistribution(0.0, ZERO_DEFAULT_HIGH)
    low, high = sorted((value / RANGE_FACTOR, value * RANGE_FACTOR))
    return FloatDistribution(low, high, log=value > 0)
