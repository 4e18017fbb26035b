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
"""a default range is from the default value divided by this factor to the default value multiplied by it"""
ZERO_DEFAULT_HIGH = 1.0
"""upper end of the range of a parameter that is zero by default"""

Distribution = FloatDistribution | IntDistribution | CategoricalDistribution
SearchSpace = dict[str, Distribution]


def boundary_values(distribution: Distribution) -> Sequence[Any]:
    """Return all choices, or the ends of a range: if they are valid, all values are."""
    is_categorical = isinstance(distribution, CategoricalDistribution)
    return distribution.choices if is_categorical else (distribution.low, distribution.high)


def parse_search_space(texts: Sequence[str]) -> SearchSpace:
    """Return a search space from texts `key=low..high`, `key=low..high:log` or `key=a,b,c`; or raise `InputError`."""
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
    limits, is_log = values.removesuffix(":log"), values.endswith(":log")
    low, high, *others = (parse_value(limit.strip()) for limit in limits.split(".."))
    are_numbers = all(isinstance(limit, int | float) and not isinstance(limit, bool) for limit in (low, high))
    if others or not are_numbers or not low < high or not math.isfinite(high - low) or (is_log and low <= 0):
        raise invalid_value("vary", text, "low < high, with :log low > 0")
    distribution_class = IntDistribution if isinstance(low, int) and isinstance(high, int) else FloatDistribution
    return distribution_class(low, high, log=is_log)


def float_range(distribution: Distribution) -> Distribution:
    """Return a range of integers as a range of floating-point numbers, and other distributions unchanged."""
    if not isinstance(distribution, IntDistribution):
        return distribution
    return FloatDistribution(distribution.low, distribution.high, distribution.log)


def default_search_space(expert: str, time_step: float) -> SearchSpace:
    """Return the default ranges of an expert's parameters: numbers within a factor of four, all words, both booleans.

    Raise `InputError` if there is no such expert, or if it has no tunable parameters.
    """
    parameters = tunable_parameters(expert, time_step)
    ranges = {name: _default_range(value, type_hint) for name, (value, type_hint) in parameters.items()}
    space: SearchSpace = {name: distribution for name, distribution in ranges.items() if distribution is not None}
    if not space:
        raise InputError(f"expert: {expert!r} has nothing to tune")
    return space


def tunable_parameters(expert: str, time_step: float) -> dict[str, tuple[Any, Any]]:
    """Return default value and type hint of an expert's parameters by name, also of a class `path.py:name`.

    Raise `InputError` if there is no such expert.
    """
    if is_file_reference(expert):
        user_object = FileReference.parse(expert).load_object()
        arguments = signature(user_object).parameters if isclass(user_object) else {}
        driver_from_name(expert, time_step)  # reports an error of the class before all trials
        defaults = {name: argument for name, argument in arguments.items() if argument.default is not argument.empty}
        parameters = {name: (argument.default, argument.annotation) for name, argument in defaults.items()}
        for name, (value, type_hint) in parameters.items():
            if type(value) is int and type_hint not in (int, "int"):  # without `int`, a default of 2 may mean 2.0
                parameters[name] = float(value), type_hint
    else:
        names = [name for name, driver_class in DRIVERS.items() if not driver_class.is_driven_by_simulator]
        if expert not in names:
            raise unknown_name("expert", expert, names)
        values = named_parts(driver_from_name(expert, time_step)) or {}
        type_hints = get_type_hints(DRIVERS[expert])
        parameters = {name: (value, type_hints[name]) for name, value in values.items()}
    return {name: parameter for name, parameter in parameters.items() if name != "time_step"}


def expert_search_space(texts: Sequence[str], defaults: SearchSpace) -> SearchSpace:
    """Return the search space of texts; ranges of integers become ranges of floats where the defaults are."""
    space = parse_search_space(texts)
    is_float = {name: isinstance(defaults.get(name), FloatDistribution) for name in space}
    return {name: float_range(distribution) if is_float[name] else distribution for name, distribution in space.items()}


def _default_range(value: Any, type_hint: Any) -> Distribution | None:
    """Return the default range of a parameter, or None for types without a default range, such as lists."""
    if isinstance(value, bool):
        return CategoricalDistribution((False, True))
    if get_origin(type_hint) is Literal:
        return CategoricalDistribution(get_args(type_hint))
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
