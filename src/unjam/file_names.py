"""Names of files in a configuration, such as `path.py:name` and `runs/ring-001`; + joins several names."""

import os
import re
from pathlib import Path
from typing import Any

from unjam.errors import InputError
from unjam.text import to_one_line

_SEPARATOR = re.compile(r"\+(?=[^\W\d]|[./~])")  # + between two names, but not the + in 1e+5
_MAX_LENGTH = 4096  # maximum length of a path in Linux [characters]
MAX_NAMES = 100  # joined by +
_PATH_END = re.compile(rf":|$|{_SEPARATOR.pattern}")


def split_names(text: str, folder: Path = Path()) -> list[str]:
    """Split names that + joins, but no existing path in `folder`; raise `InputError` above `MAX_NAMES`."""
    names = list[str]()
    while separator := _SEPARATOR.search(text, len(_existing_path(text, folder))):
        if len(names) == MAX_NAMES - 1:
            refused = f"names: {to_one_line(text, 60)!r} and the names before it are not allowed"
            raise InputError(f"{refused}; allowed: at most {MAX_NAMES} names")
        names.append(text[: separator.start()])
        text = text[separator.end() :]
    return [*names, text]


def absolute_names(values: Any, folder: Path) -> Any:
    """Return a configuration in which names of existing files in `folder` that have a dot or a slash are absolute."""
    if isinstance(values, dict):
        return {key: absolute_names(value, folder) for key, value in values.items()}
    if isinstance(values, list):
        return [absolute_names(value, folder) for value in values]
    if not isinstance(values, str):
        return values
    names = [(name, _existing_path(name, folder)) for name in split_names(values, folder)]
    return "+".join(
        f"{folder / path}{name[len(path) :]}" if "." in path or os.sep in path else name for name, path in names
    )


def _existing_path(text: str, folder: Path) -> str:
    """Return the longest path of an existing file or folder at the beginning of a text; empty: none."""
    paths = [text[: end.start()] for end in _PATH_END.finditer(text[:_MAX_LENGTH])]
    return next((path for path in reversed(paths) if path and os.path.exists(folder / path)), "")
