"""Check types, ranges and names of values for the frozen dataclasses of unjam."""

import operator
import os
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import field, fields, is_dataclass
from functools import cache, wraps
from inspect import get_annotations, getattr_static
from itertools import accumulate, pairwise
from math import inf
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar, dataclass_transform

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, Strict, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass
from pydantic.errors import PydanticUserError

from unjam.errors import InputError, invalid_value
from unjam.text import spelling_hint, to_one_line

STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)
"""configuration of parameter dataclasses; `unjam drivers` and the documentation show the texts below their fields"""
Number = Annotated[float, Strict()]  # a number, not a text like "1"
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
PositiveInt = Annotated[int, Field(ge=1)]
IntAboveOne = Annotated[int, Field(ge=2)]
NonNegativeInt = Annotated[int, Field(ge=0)]


def _to_range(value: Any) -> Any:
    """Return the range (230, 230) for the number 230, and other values unchanged."""
    if isinstance(value, str):
        raise ValueError("a number, or two like [220, 270]")
    return (value, value) if isinstance(value, int | float) else value


def check_integer(field: str, value: Any, minimum: int, maximum: float = inf) -> int:
    """Return an integer argument; raise `InputError` if it is no integer, is a bool, or is out of range."""
    try:
        if not isinstance(value, bool) and minimum <= (integer := operator.index(value)) <= maximum:
            return integer
    except TypeError:
        pass
    allowed = f">= {minimum}" if maximum == inf else f"from {minimum:,} to {maximum:,}"
    raise invalid_value(field, value, f"an integer {allowed}")


def _tuples_to_lists(options: dict[str, Any]) -> dict[str, Any]:
    """Replace tuples by lists as TOML does, so that a configuration read from a file equals the original."""
    return {key: list(value) if isinstance(value, tuple) else value for key, value in options.items()}


Options = Annotated[dict[str, Any], AfterValidator(_tuples_to_lists)]  # arguments of a class, by name
NumberOrRange = BeforeValidator(_to_range)  # allows a single number for a parameter that is a range
MAX_INTEGER_BITS, MAX_KEY_PARTS = 63, 100  # bits of an absolute value, and parts of a key between its dots
CERTAIN_SIMILARITY = 0.8  # least similarity at which a name in the body of a class counts as a misspelt field
_KEY_PART = r"""(?:[\w-]++|"(?:[^"\\\n]++|\\.)*+"|'[^'\n]*+')"""
_DEEP_KEY = re.compile(rf"(?<![\w\\-])(?:{_KEY_PART}[ \t]*+\.[ \t]*+){{{MAX_KEY_PARTS}}}")
"""without backtracking, and only at the beginning of a word: the time is proportional to the length of a text"""

DataclassT = TypeVar("DataclassT")


class Subclassable:
    """Base of dataclasses that users derive from: values in the body of a class are its defaults without a decorator.

    Otherwise a class without a decorator would inherit the defaults of its base with `__init__`.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        """Give values that replace inherited defaults the types of their fields; refuse misspelt names of fields."""
        super().__init_subclass__(**options)
        for base in reversed(cls.__mro__[1:]):
            _apply_decorator(base)
        if not is_dataclass(cls):
            return
        inherited, replaced = {entry.name: entry.type for entry in fields(cls)}, dict[str, Any]()
        first = next(base for base in cls.__mro__[1:] if is_dataclass(base))
        for base in cls.__mro__[: cls.__mro__.index(first)]:  # `cls`, and plain classes before the first dataclass
            annotations = get_annotations(base)
            for name, value in list(vars(base).items()):
                if name in inherited and name not in replaced and not hasattr(value, "__get__"):  # no properties
                    replaced[name] = annotations.get(name, inherited[name])
                    setattr(cls, name, value)
                elif name in annotations or name.startswith("_") or hasattr(first, name) or hasattr(value, "__get__"):
                    continue
                elif hint := spelling_hint(name, inherited, CERTAIN_SIMILARITY):
                    raise InputError(f"class {cls.__name__}: {name}: unknown name{hint}")
        if replaced:
            cls.__annotations__ = replaced | get_annotations(cls)

    def __new__(cls, *_: Any, **__: Any) -> Self:
        """Make an instance, after the class has become a dataclass."""
        _apply_decorator(cls)
        return super().__new__(cls)


@cache
def changed_members(kind: type[Any], base: type[Any]) -> list[str]:
    """Return the members of a class that differ from those of its base, except new values of fields of the base."""
    kinds, base_fields, missing = kind.__mro__, {entry.name for entry in fields(base)}, object()
    changed = list[str]()
    derived = kinds[: kinds.index(base)]
    for name in sorted({name for cls in derived for name in (*get_annotations(cls), *vars(cls))}):
        member, inherited = (getattr_static(cls, name, missing) for cls in (kind, base))
        is_value = name in base_fields and not hasattr(member, "__get__")
        is_same = member is not missing and (member is inherited or member == inherited)
        if not (is_value or is_same or name.startswith("__")):
            changed.append(name)
    return changed


def replaced_member(kind: type[Any], base: type[Any], ignored: Collection[str]) -> str:
    """Return the first member of a base that a derived class replaces, except values of fields; empty: none."""
    return next((name for name in changed_members(kind, base) if hasattr(base, name) and name not in ignored), "")


def _apply_decorator(cls: type[Any]) -> None:
    """Make a class with fields a parameter dataclass like its bases, unless it is one or has an `__init__`."""
    is_complete = not get_annotations(cls) or not {"__dataclass_fields__", "__init__"}.isdisjoint(vars(cls))
    if is_dataclass(cls) and issubclass(cls, Subclassable) and not is_complete:
        config: ConfigDict = {**STRICT, "validate_default": True, "arbitrary_types_allowed": True}
        try:
            parameter_dataclass(frozen=True, config=config)(cls)
        except (TypeError, ValueError, PydanticUserError) as error:
            raise InputError(f"class {cls.__name__}: {to_one_line(error)}") from error


def is_packaged(kind: type[Any]) -> bool:
    """Return whether a class is part of unjam, not of code of a user."""
    return kind.__module__.partition(".")[0] == "unjam"


def check_part(name: str, part: Any) -> None:
    """Raise `InputError` if the class of a part of a record adds code or fields, which a stored record would lose."""
    packaged = next(filter(is_packaged, type(part).__mro__), None) if isinstance(part, Subclassable) else None
    if packaged and (members := changed_members(type(part), packaged)):
        allowed = f"{packaged.__name__}, or a class of other values for its fields"
        label = f"the class {type(part).__name__} with its {members[0]!r}"
        raise InputError(f"{name}: {label} is not allowed; allowed: {allowed}")


def build_dataclass(kind: type[DataclassT], values: dict[str, Any], field: str) -> DataclassT:
    """Return `kind(**values)`; raise `InputError`, which begins with `field`, for the first invalid value."""
    check_values(values, field)
    _apply_decorator(kind)
    try:
        return TypeAdapter(kind).validate_python(values)
    except ValidationError as error:
        raise InputError(validation_message(error, field, kind)) from None


@dataclass_transform(field_specifiers=(field, Field))
def parameter_dataclass(label: str | None = None, **options: Any) -> Callable[[type[DataclassT]], type[DataclassT]]:
    """Decorate like `dataclass` of pydantic; errors are `InputError`, which begin with `label` or the class name."""

    def decorate(kind: type[DataclassT]) -> type[DataclassT]:
        decorated: Any = dataclass(**options)(kind)
        original_init = decorated.__init__

        @wraps(original_init)
        def init(self: Any, *args: Any, **kwargs: Any) -> None:
            try:
                original_init(self, *args, **kwargs)
            except ValidationError as error:
                prefix = decorated.__name__ if label is None else label
                raise InputError(validation_message(error, prefix, decorated)) from None

        decorated.__init__ = init
        return decorated

    return decorate


def check_values(value: Any, name: str) -> None:
    """Raise `InputError` for an integer of too many bits for an array, or a text with NUL."""
    if isinstance(value, dict):
        for key, entry in value.items():
            check_values(entry, f"{name}.{key}".strip("."))
    elif isinstance(value, list | tuple):
        for entry in value:
            check_values(entry, name)
    elif isinstance(value, int) and value.bit_length() > MAX_INTEGER_BITS:
        allowed = f"at most {MAX_INTEGER_BITS} bits"
        raise InputError(f"{name}: a number of {value.bit_length()} bits is not allowed; allowed: {allowed}")
    elif isinstance(value, str) and "\0" in value:
        raise invalid_value(name, value, "a text without NUL")


def validation_message(error: ValidationError, field: str, kind: Any = None) -> str:
    """Return the first problem of a pydantic error as `field.name: value is not allowed; allowed: ...`."""
    problem = error.errors()[0]
    names_by_position = {str(index): name for index, name in enumerate(_field_names(kind, ()))}
    path = [str(part) for part in problem["loc"]]
    name = ".".join([field, *(names_by_position.get(part, part) for part in path[:1]), *path[1:]]).strip(".")
    if problem["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
        *path, last = path
        names = _field_names(kind, path)
        allowed = f"; allowed: {', '.join(sorted(names))}" if names else ""
        return f"{name}: unknown name{spelling_hint(last, names) or allowed}"
    if problem["type"] == "missing":
        return f"{name}: missing"
    is_complete = not problem["loc"] or " is not allowed; allowed: " in problem["msg"]
    if problem["type"] == "value_error" and is_complete:  # from a check of several fields
        return f"{name}.{problem['msg'].removeprefix('Value error, ')}".removeprefix(".")
    allowed = problem["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    if problem["type"] == "tuple_type":
        allowed = 'a list: [1, 2], ["local"]'
    return f"{name}: {problem['input']!r} is not allowed; allowed: {allowed}"


def _field_names(kind: Any, path: Sequence[object]) -> list[str]:
    """Return the parameter names of a dataclass, or of the dataclass nested in it at the end of a path."""
    for part in path:
        kind = getattr(getattr(kind, "__pydantic_fields__", {}).get(part), "annotation", None)
    return list(getattr(kind, "__pydantic_fields__", {}))


def parse_toml(text: str) -> dict[str, Any]:
    """Parse a text in TOML; raise `ValueError` if it is not TOML or has too long keys, `RecursionError` if too deep."""
    import tomllib

    if _DEEP_KEY.search(text):  # its memory would grow with the square of the number of parts
        raise ValueError(f"a key of more than {MAX_KEY_PARTS} parts")
    return tomllib.loads(text)


def read_toml(path: Path, context: str = "config file") -> dict[str, Any]:
    """Return the content of a TOML file; raise `InputError` if it is missing or not TOML."""
    if os.path.exists(path) and not os.path.isfile(path):
        raise InputError(f"{context} {path}: not a file: a directory, a pipe or a device")
    try:
        return parse_toml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{context} {path}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:  # also for too long numbers, and NUL in a path
        raise InputError(f"{context} {path}: not TOML: {error}") from None


def parse_value(text: str) -> Any:
    """Return a text as a value of TOML (number, boolean, list), or the text itself if it is no such value."""
    try:
        return parse_toml(f"value = {text}")["value"]
    except (ValueError, RecursionError):  # also for a number with too many digits
        return text


def parse_assignments(texts: list[str], field: str) -> dict[str, Any]:
    """Return `{"key": value}` for texts `key=value`; raise `InputError` for a text without `=`."""
    values: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise InputError(f"{field}: {text!r} is not allowed; allowed: key=value")
        values[key.strip()] = parse_value(value.strip())
    return values


def split_parameters(text: str) -> tuple[str, dict[str, Any]]:
    """Split `name:key=value,key=value` (or `path.py:name:key=value`) into the name and the parameters."""
    head, _, tail = text.rpartition(":")
    if not head or "=" not in tail:
        return text, {}
    depths = accumulate((letter in "[(") - (letter in "])") for letter in tail)
    # Commas in brackets separate no parameters: `gaps=[1,2,3],window=38`.
    commas = [index for index, depth in enumerate(depths) if tail[index] == "," and not depth]
    parts = [tail[start + 1 : end] for start, end in pairwise([-1, *commas, len(tail)])]
    return head, parse_assignments(parts, "driver")


def merge_changes(values: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Return `values` with `changes`; tables are merged by key, and lists by the index of the entry."""
    merged = dict(values)
    for key, value in changes.items():
        previous = merged.get(key)
        if isinstance(value, dict) and isinstance(previous, list | tuple):
            entries = merge_changes({str(index): entry for index, entry in enumerate(previous)}, value)
            if unknown := entries.keys() - set(map(str, range(len(previous)))):
                allowed = f"allowed: 0 to {len(previous) - 1}" if previous else "it has no entries"
                raise InputError(f"{key}.{min(unknown)}: unknown entry; {allowed}")
            value = [*entries.values()]
        elif isinstance(value, dict) and isinstance(previous, dict):
            value = merge_changes(previous, value)
        merged[key] = value
    return merged


def nest_keys(changes: dict[str, Any]) -> dict[str, Any]:
    """Return changes with dotted keys as nested tables: `trpo.gamma` becomes `gamma` in the table `trpo`."""
    tables: dict[str, Any] = {}
    for key, value in changes.items():
        if not isinstance(key, str):
            raise invalid_value("key", key, "a text")
        for part in reversed(key.split(".")):
            value = {part: value}
        tables = merge_changes(tables, value)
    return tables


def flatten_keys(tables: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested tables as one table with dotted keys; the inverse of `nest_keys`."""
    flat: dict[str, Any] = {}
    for key, value in tables.items():
        name = f"{prefix}{key}"
        flat |= flatten_keys(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return flat
