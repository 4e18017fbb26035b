"""Any record as JSON and arrays, and back: what files and messages to workers are made of.

A tree is made of dataclasses, named tuples, dicts, tuples and lists; its leaves are arrays and plain values.
`pack` takes it apart, `unpack` puts it together again by the types that its records declare. Nothing is ever
executed, and what does not fit the declared types is refused.
"""

from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

Arrays = dict[str, np.ndarray]
"""by their path in the tree: `trajectories.0.states.speed`"""
ARRAY = "array"
"""key of the JSON object that stands for an array; its value is the path"""


def pack(tree: Any, path: str = "") -> tuple[Any, Arrays]:
    """Return a tree as JSON and arrays; `unpack` undoes it exactly."""
    arrays: Arrays = {}

    def taken_apart(value: Any, path: str) -> Any:
        if isinstance(value, np.ndarray):
            arrays[path] = value
            return {ARRAY: path}
        inner = _named(value)
        if inner is not None:
            return {name: taken_apart(part, _joined(path, name)) for name, part in inner.items()}
        if isinstance(value, (tuple, list)):
            return [taken_apart(part, _joined(path, str(index))) for index, part in enumerate(value)]
        return value.item() if isinstance(value, np.generic) else value

    return taken_apart(tree, path), arrays


def unpack(kind: Any, facts: Any, arrays: Arrays) -> Any:
    """Return the tree of type `kind` that `pack` took apart.

    Raises:
        ValueError: it is not one: a name, a type or an array is missing, unknown or wrong.
    """
    if isinstance(facts, dict) and facts.keys() == {ARRAY} and isinstance(facts[ARRAY], str):
        if facts[ARRAY] not in arrays or not (kind is Any or _is_array(kind)):
            raise ValueError(f"array {facts[ARRAY]!r} is missing, or has no place")
        return arrays[facts[ARRAY]]
    if kind is Any:
        if not isinstance(facts, dict):
            return facts
        return {name: unpack(Any, part, arrays) for name, part in facts.items()}
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        if facts is None and NoneType in inner:
            return None
        (kind,) = (one for one in inner if one is not NoneType)
        return unpack(kind, facts, arrays)
    types = _types_of(kind)
    if types is not None:
        _expect(dict, facts, kind)
        unknown, missing = facts.keys() - types.keys(), types.keys() - facts.keys()
        if unknown or missing:
            raise ValueError(
                f"{kind.__name__}: {min(unknown | missing)!r} is {'unknown' if unknown else 'missing'}"
            )
        return kind(**{name: unpack(types[name], part, arrays) for name, part in facts.items()})
    if origin is dict:
        _expect(dict, facts, kind)
        return {name: unpack(inner[1], part, arrays) for name, part in facts.items()}
    if origin in (tuple, list):
        _expect(list, facts, kind)
        ends = (inner[0],) * len(facts) if origin is list or inner[1:] == (...,) else inner
        if len(ends) != len(facts):
            raise ValueError(f"{len(facts)} values are not allowed; allowed: {len(ends)}")
        return origin(unpack(one, part, arrays) for one, part in zip(ends, facts, strict=True))
    if kind is float and (facts is None or type(facts) is int):
        return float("nan") if facts is None else float(facts)
    if isinstance(kind, type):
        _expect(kind, facts, kind)
    return facts


def leaves(tree: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each leaf of nested dicts with its path, the names joined by dots."""
    if isinstance(tree, dict):
        for name, part in tree.items():
            yield from leaves(part, _joined(path, name))
    else:
        yield path, tree


def mapped(function: Callable[..., Any], tree: Any, *others: Any) -> Any:
    """Return nested dicts with `function` of each leaf, and of the same leaf of the other trees."""
    if isinstance(tree, dict):
        return {
            name: mapped(function, part, *(other[name] for other in others)) for name, part in tree.items()
        }
    return function(tree, *others)


def rebuilt(tree: Any, values: dict[str, Any], path: str = "") -> Any:
    """Return nested dicts like `tree` with the `values` that `leaves` would name."""
    if isinstance(tree, dict):
        return {name: rebuilt(part, values, _joined(path, name)) for name, part in tree.items()}
    return values[path]


def _joined(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _named(value: Any) -> dict[str, Any] | None:
    """Return the parts of a value that has names for them."""
    if isinstance(value, dict):
        return value
    if hasattr(value, "_asdict"):
        return value._asdict()
    if not is_dataclass(value) or isinstance(value, type):
        return None
    return {field.name: getattr(value, field.name) for field in fields(value) if field.init}


@cache
def _types_of(kind: Any) -> dict[str, Any] | None:
    """Return the declared types of a record's parts; None of what is no record."""
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        return {field.name: hints[field.name] for field in fields(kind) if field.init}
    if isinstance(kind, type) and hasattr(kind, "_fields"):
        return get_type_hints(kind)
    return None


def _is_array(kind: Any) -> bool:
    return get_origin(kind) is np.ndarray or kind is np.ndarray


def _expect(kind: type, facts: Any, wanted: Any) -> None:
    if not isinstance(facts, kind):
        raise ValueError(f"{facts!r:.60} is not allowed; allowed: {getattr(wanted, '__name__', wanted)}")
