"""Convert records to JSON and arrays, and back: the format of files and of messages to workers.

A tree consists of dataclasses, named tuples, dicts, tuples and lists; its leaves are arrays, paths and plain values.
`unpack` restores a tree by the declared types of its records. If a declared type is the base of several classes, the
name of the class is stored as `kind`. No code is executed, and values that do not fit the declared types are refused.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

ValueT = TypeVar("ValueT")
Arrays = dict[str, np.ndarray]  # arrays by path in the tree, such as `trajectories.0.states.speed`
ARRAY_KEY = "array"  # key of the JSON object that represents an array; its value is the path
KIND_KEY = "kind"  # key of the JSON object for the name of a class
ClassesByBase = Mapping[type, Mapping[str, type]]  # allowed classes of each base class, by name


def select_prefix(prefix: str, values: Mapping[str, ValueT]) -> dict[str, ValueT]:
    """Return the values with names that begin with `prefix`, by names without the prefix."""
    return {name.removeprefix(prefix): value for name, value in values.items() if name.startswith(prefix)}


def pack(tree: Any, path: str = "", classes: ClassesByBase = {}) -> tuple[Any, Arrays]:  # noqa: B006
    """Return a tree as JSON and arrays; `unpack` is the exact inverse."""
    arrays: Arrays = {}
    kinds = {cls: {KIND_KEY: name} for derived in classes.values() for name, cls in derived.items()}

    def pack_value(value: Any, path: str) -> Any:
        if isinstance(value, np.ndarray):
            arrays[path] = value
            return {ARRAY_KEY: path}
        parts = named_parts(value)
        if parts is not None:
            packed = {name: pack_value(part, _join_path(path, name)) for name, part in parts.items()}
            return kinds.get(type(value), {}) | packed
        if isinstance(value, (tuple, list)):
            return [pack_value(part, _join_path(path, str(index))) for index, part in enumerate(value)]
        if isinstance(value, Path):
            return str(value)
        return value.item() if isinstance(value, np.generic) else value

    return pack_value(tree, path), arrays


def unpack(kind: Any, packed: Any, arrays: Arrays, classes: ClassesByBase = {}) -> Any:  # noqa: B006
    """Return the tree of type `kind` that `pack` converted; raise `ValueError` for a wrong name, type or array."""
    if isinstance(packed, dict) and packed.keys() == {ARRAY_KEY} and isinstance(packed[ARRAY_KEY], str):
        if packed[ARRAY_KEY] not in arrays or not (kind is Any or np.ndarray in (kind, get_origin(kind))):
            raise ValueError(f"array {packed[ARRAY_KEY]!r} is missing, or has no place")
        return arrays[packed[ARRAY_KEY]]
    if kind is Any:
        is_table = isinstance(packed, dict)
        return {name: unpack(Any, part, arrays) for name, part in packed.items()} if is_table else packed
    if kind in classes:
        _check_type(dict, packed, kind)
        name, packed = packed.get(KIND_KEY), {key: part for key, part in packed.items() if key != KIND_KEY}
        if not isinstance(name, str) or name not in classes[kind]:
            raise ValueError(f"{KIND_KEY}: {name!r:.60} is not allowed; allowed: {', '.join(classes[kind])}")
        kind = classes[kind][name]
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        if packed is None and NoneType in arguments:
            return None
        (kind,) = (member for member in arguments if member is not NoneType)
        return unpack(kind, packed, arrays, classes)
    if (declared := _declared_parts(kind)) is not None:
        types, required = declared
        _check_type(dict, packed, kind)
        unknown, missing = packed.keys() - types.keys(), required - packed.keys()
        if unknown or missing:
            raise ValueError(f"{kind.__name__}: {min(unknown | missing)!r} is {'unknown' if unknown else 'missing'}")
        return kind(**{name: unpack(types[name], part, arrays, classes) for name, part in packed.items()})
    if origin is dict:
        _check_type(dict, packed, kind)
        return {name: unpack(arguments[1], part, arrays, classes) for name, part in packed.items()}
    if origin in (tuple, list):
        _check_type(list, packed, kind)
        kinds = (arguments[0],) * len(packed) if origin is list or arguments[1:] == (...,) else arguments
        if len(kinds) != len(packed):
            raise ValueError(f"{len(packed)} values are not allowed; allowed: {len(kinds)}")
        return origin(unpack(part_kind, part, arrays, classes) for part_kind, part in zip(kinds, packed, strict=True))
    if kind is float and (packed is None or type(packed) is int):
        return float("nan") if packed is None else float(packed)
    if kind is Path and isinstance(packed, str):
        return Path(packed)
    if isinstance(kind, type):
        _check_type(kind, packed, kind)
    return packed


def leaves(tree: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the path, names joined by dots, and the value of each leaf of nested dicts."""
    if isinstance(tree, dict):
        for name, part in tree.items():
            yield from leaves(part, _join_path(path, name))
    else:
        yield path, tree


def map_leaves(function: Callable[..., Any], tree: Any, *others: Any) -> Any:
    """Return nested dicts with the results of `function` for each leaf and the same leaf of the other trees."""
    if isinstance(tree, dict):
        return {name: map_leaves(function, part, *(other[name] for other in others)) for name, part in tree.items()}
    return function(tree, *others)


def replace_leaves(tree: Any, values: dict[str, Any], path: str = "") -> Any:
    """Return nested dicts like `tree` with new leaves; `values` has them by their path, as in `leaves`."""
    if isinstance(tree, dict):
        return {name: replace_leaves(part, values, _join_path(path, name)) for name, part in tree.items()}
    return values[path]


def _join_path(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def named_parts(value: Any) -> dict[str, Any] | None:
    """Return the parts of a dict or record by name; None for other values."""
    if isinstance(value, dict):
        return value
    if hasattr(value, "_asdict"):
        return value._asdict()
    if not is_dataclass(value) or isinstance(value, type):
        return None
    return {field.name: getattr(value, field.name) for field in fields(value) if field.init}


@cache
def _declared_parts(kind: Any) -> tuple[dict[str, Any], set[str]] | None:
    """Return the declared types of the parts of a record, and names of parts without a default; None: no record."""
    if is_dataclass(kind):
        hints, parts = get_type_hints(kind), [field for field in fields(kind) if field.init]
        required = {field.name for field in parts if (field.default, field.default_factory) == (MISSING, MISSING)}
        return {field.name: hints[field.name] for field in parts}, required
    if isinstance(kind, type) and hasattr(kind, "_fields"):
        return get_type_hints(kind), kind._fields - kind._field_defaults.keys()
    return None


def _check_type(kind: type, value: Any, declared: Any) -> None:
    if not isinstance(value, kind):
        raise ValueError(f"{value!r:.60} is not allowed; allowed: {getattr(declared, '__name__', declared)}")
