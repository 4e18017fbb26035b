"""Check the values of unjam's frozen dataclasses: types, ranges, unknown names."""

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
"""configuration of parameter dataclasses, of which `unjam drivers` and the documentation show the texts under fields"""
Number = Annotated[float, Strict()]  # a number, not a text that contains one
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
PositiveInt = Annotated[int, Field(ge=1)]
IntAboveOne = Annotated[int, Field(ge=2)]
NonNegativeInt = Annotated[int, Field(ge=0)]


def as_range(value: Any) -> Any:
    """Return the range (230, 230) for the number 230, and other values unchanged."""
    if isinstance(value, str):
        raise ValueError("a number, or two like [220, 270]")
    return (value, value) if isinstance(value, int | float) else value


def check_integer(field: str, value: Any, minimum: int, maximum: float = inf) -> int:
    """Return an integer argument; raise `InputError` if it has another type, such as bool, or is out of range."""
    try:
        if not isinstance(value, bool) and minimum <= (number := operator.index(value)) <= maximum:
            return number
    except TypeError:
        pass
    allowed = f">= {minimum}" if maximum == inf else f"from {minimum:,} to {maximum:,}"
    raise invalid_value(field, value, f"an integer {allowed}")


def _without_tuples(options: dict[str, Any]) -> dict[str, Any]:
    """Return options as a TOML file gives them back, so that a stored configuration equals the original."""
    return {key: list(value) if isinstance(value, tuple) else value for key, value in options.items()}


Options = Annotated[dict[str, Any], AfterValidator(_without_tuples)]  # arguments of a class, by name
NumberOrRange = BeforeValidator(as_range)  # allows a single number for a parameter that is a range
MAX_INTEGER_BITS, MAX_KEY_PARTS = 63, 100  # of an absolute value, and of a key between its dots
CERTAIN_SIMILARITY = 0.8  # from which on a name in the body of a class is taken for a misspelt field
_KEY_PART = r"""(?:[\w-]++|"(?:[^"\\\n]++|\\.)*+"|'[^'\n]*+')"""
_DEEP_KEY = re.compile(rf"(?<![\w\\-])(?:{_KEY_PART}[ \t]*+\.[ \t]*+){{{MAX_KEY_PARTS}}}")
"""without backtracking, and not from within a word, so that the time is proportional to the length of a text"""

DataclassT = TypeVar("DataclassT")


class Subclassable:
    """Base of dataclasses that users derive from: values in the body of a class are its defaults, decorated or not.

    Without it, a class without a decorator would inherit `__init__` and with it the defaults of its base.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        """Give values that replace inherited defaults the types of their fields; refuse a field's misspelt name."""
        super().__init_subclass__(**options)
        for base in reversed(cls.__mro__[1:]):
            _apply_decorator(base)
        if not is_dataclass(cls):
            return
        inherited, replaced = {entry.name: entry.type for entry in fields(cls)}, dict[str, Any]()
        first = next(base for base in cls.__mro__[1:] if is_dataclass(base))
        for base in cls.__mro__[: cls.__mro__.index(first)]:  # itself, and plain classes that precede the first one
            own = get_annotations(base)
            for name, value in list(vars(base).items()):
                if name in inherited and name not in replaced and not hasattr(value, "__get__"):  # but no properties
                    replaced[name] = own.get(name, inherited[name])
                    setattr(cls, name, value)
                elif name in own or name.startswith("_") or hasattr(first, name) or hasattr(value, "__get__"):
                    continue
                elif hint := spelling_hint(name, inherited, CERTAIN_SIMILARITY):
                    raise InputError(f"class {cls.__name__}: {name}: unknown name{hint}")
        if replaced:
            cls.__annotations__ = replaced | get_annotations(cls)

    def __new__(cls, *_: Any, **__: Any) -> Self:
        """Make an instance of a class that is a dataclass itself."""
        _apply_decorator(cls)
        return super().__new__(cls)


@cache
def changed_members(kind: type[Any], base: type[Any]) -> list[str]:
    """Return the members of a class that differ from those of its base, other than values of the base's fields."""
    kinds, values, missing = kind.__mro__, {entry.name for entry in fields(base)}, object()
    changed = list[str]()
    for name in sorted({name for each in kinds[: kinds.index(base)] for name in (*get_annotations(each), *vars(each))}):
        own, inherited = (getattr_static(each, name, missing) for each in (kind, base))
        is_value = name in values and not hasattr(own, "__get__")
        is_same = own is not missing and (own is inherited or own == inherited)
        if not (is_value or is_same or name.startswith("__")):
            changed.append(name)
    return changed


def replaced_member(kind: type[Any], base: type[Any], ignored: Collection[str]) -> str:
    """Return a member of a base that a class derived from it replaces, other than by values of fields; empty: none."""
    return next((name for name in changed_members(kind, base) if hasattr(base, name) and name not in ignored), "")


def _apply_decorator(cls: type[Any]) -> None:
    """Make a class with fields a dataclass of parameters, as its bases are, unless it is one or has an `__init__`."""
    is_complete = not get_annotations(cls) or not {"__dataclass_fields__", "__init__"}.isdisjoint(vars(cls))
    if is_dataclass(cls) and issubclass(cls, Subclassable) and not is_complete:
        config: ConfigDict = {**STRICT, "validate_default": True, "arbitrary_types_allowed": True}
        try:
            parameter_dataclass(frozen=True, config=config)(cls)
        except (TypeError, ValueError, PydanticUserError) as error:
            raise InputError(f"class {cls.__name__}: {to_one_line(error)}") from error


def is_packaged(kind: type[Any]) -> bool:
    """Return whether a class is part of unjam, not the user's own."""
    return kind.__module__.partition(".")[0] == "unjam"


def check_part(name: str, part: Any) -> None:
    """Raise `InputError` if a part of a record has a user's class with code or further fields, which records lose."""
    known = next(filter(is_packaged, type(part).__mro__), None) if isinstance(part, Subclassable) else None
    if known and (members := changed_members(type(part), known)):
        allowed = f"{known.__name__}, or a class of other values for its fields"
        label = f"the class {type(part).__name__} with its {members[0]!r}"
        raise InputError(f"{name}: {label} is not allowed; allowed: {allowed}")


def build_dataclass(kind: type[DataclassT], values: dict[str, Any], field: str) -> DataclassT:
    """Return `kind(**values)`; raise `InputError`, which begins with the `field`, for the first invalid value."""
    check_values(values, field)
    _apply_decorator(kind)
    try:
        return TypeAdapter(kind).validate_python(values)
    except ValidationError as error:
        raise InputError(validation_message(error, field, kind)) from None


@dataclass_transform(field_specifiers=(field, Field))
def parameter_dataclass(label: str | None = None, **options: Any) -> Callable[[type[DataclassT]], type[DataclassT]]:
    """Decorate as pydantic's `dataclass`; an invalid value is an `InputError` that begins with `label` or the class."""

    def decorate(kind: type[DataclassT]) -> type[DataclassT]:
        made: Any = dataclass(**options)(kind)
        make = made.__init__

        @wraps(make)
        def init(self: Any, *args: Any, **kwargs: Any) -> None:
            try:
                make(self, *args, **kwargs)
            except ValidationError as error:
                raise InputError(validation_message(error, made.__name__ if label is None else label, made)) from None

        made.__init__ = init
        return made

    return decorate


def check_values(value: Any, name: str) -> None:
    """Raise `InputError` for an integer that fits into no array, or a text with NUL, which no file name has."""
    if isinstance(value, dict):
        for key, inner in value.items():
            check_values(inner, f"{name}.{key}".strip("."))
    elif isinstance(value, list | tuple):
        for inner in value:
            check_values(inner, name)
    elif isinstance(value, int) and value.bit_length() > MAX_INTEGER_BITS:
        bits = f"{value.bit_length()} bits is not allowed; allowed: at most {MAX_INTEGER_BITS}"
        raise InputError(f"{name}: a number of {bits}")
    elif isinstance(value, str) and "\0" in value:
        raise invalid_value(name, value, "a text without NUL")


def validation_message(error: ValidationError, field: str, kind: Any = None) -> str:
    """Return the first problem of a pydantic error as `field.name: value is not allowed; allowed: ...`."""
    problem = error.errors()[0]
    positional = {str(index): each for index, each in enumerate(_field_names(kind, ()))}
    path = [str(part) for part in problem["loc"]]
    name = ".".join([field, *(positional.get(part, part) for part in path[:1]), *path[1:]]).strip(".")
    if problem["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
        *path, last = path
        names = _field_names(kind, path)
        allowed = f"; allowed: {', '.join(sorted(names))}" if names else ""
        return f"{name}: unknown name{spelling_hint(last, names) or allowed}"
    if problem["type"] == "missing":
        return f"{name}: missing"
    names_itself = not problem["loc"] or " is not allowed; allowed: " in problem["msg"]
    if problem["type"] == "value_error" and names_itself:  # a check across fields
        return f"{name}.{problem['msg'].removeprefix('Value error, ')}".removeprefix(".")
    allowed = problem["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    if problem["type"] == "tuple_type":
        allowed = 'a list: [1, 2], ["local"]'
    return f"{name}: {problem['input']!r} is not allowed; allowed: {allowed}"


def _field_names(kind: Any, path: Sequence[object]) -> list[str]:
    """Return the parameter names of a dataclass, or of the nested one at the end of a path."""
    for part in path:
        kind = getattr(getattr(kind, "__pydantic_fields__", {}).get(part), "annotation", None)
    return list(getattr(kind, "__pydantic_fields__", {}))


def parse_toml(text: str) -> dict[str, Any]:
    """Return the content of a text in TOML; raise `ValueError` or `RecursionError` unless it is, and not too deep."""
    import tomllib

    if _DEEP_KEY.search(text):  # it would take memory as the square of the number of its parts
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
    except (ValueError, RecursionError) as error:  # also for too long numbers and NUL in the path
        raise InputError(f"{context} {path}: not TOML: {error}") from None


def parse_value(text: str) -> Any:
    """Return `text` as a TOML value (number, boolean, list), or itself if it is none."""
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
    # Commas in brackets do not separate: `gaps=[1,2,3],window=38`.
    commas = [index for index, depth in enumerate(depths) if tail[index] == "," and not depth]
    parts = [tail[before + 1 : end] for before, end in pairwise([-1, *commas, len(tail)])]
    return head, parse_assignments(parts, "driver")


def merge_changes(values: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Return `values` with `changes`; tables are merged key by key, and entries of a list by their number, from 0."""
    merged = dict(values)
    for key, value in changes.items():
        known = merged.get(key)
        if isinstance(value, dict) and isinstance(known, list | tuple):
            entries = merge_changes({str(number): entry for number, entry in enumerate(known)}, value)
            if unknown := entries.keys() - set(map(str, range(len(known)))):
                allowed = f"allowed: 0 to {len(known) - 1}" if known else "it has no entries"
                raise InputError(f"{key}.{min(unknown)}: unknown entry; {allowed}")
            value = [*entries.values()]
        elif isinstance(value, dict) and isinstance(known, dict):
            value = merge_changes(known, value)
        merged[key] = value
    return merged


def nest_keys(changes: dict[str, Any]) -> dict[str, Any]:
    """Return changes with dotted keys as nested tables: `trpo.gamma` becomes `gamma` of the table `trpo`."""
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
