"""Names of files in a configuration: `path.py:name`, `runs/ring-001`, and several joined by +."""

import os
import re
from pathlib import Path
from typing import Any

from unjam.errors import InputError, one_line

_SEPARATOR = re.compile(r"\+(?=[^\W\d]|[./~])")
"""+ between two names, but not that in 1e+5"""
_MAX_LENGTH = 4096
"""letters of a path, the limit of Linux"""
MAX_NAMES = 100
"""maximum number of names that are joined"""
_PATH_END = re.compile(rf":|$|{_SEPARATOR.pattern}")


def split_names(text: str, folder: Path = Path()) -> list[str]:
    """Return the names that are joined by +, which paths of existing files in `folder` may contain, too.

    Raise `InputError` for more than `MAX_NAMES`.
    """
    names = list[str]()
    while separator := _SEPARATOR.search(text, len(_existing_path(text, folder))):
        if len(names) == MAX_NAMES - 1:
            raise InputError(f"names: {one_line(text, 60)!r} and those before it; allowed: at most {MAX_NAMES} names")
        names.append(text[: separator.start()])
        text = text[separator.end() :]
    return [*names, text]


def absolute_names(values: Any, folder: Path) -> Any:
    """Return a configuration in which names of existing files and folders, relative to `folder`, are absolute.

    Only those with a dot or a slash are changed: `ring` is a scenario, whatever the folder contains.
    """
    if isinstance(values, dict):
        return {key: absolute_names(value, folder) for key, value in values.items()}
    if isinstance(values, list):
        return [absolute_names(value, folder) for value in values]
    if not isinstance(values, str):
        return values
    return "+".join(_absolute_name(name, folder) for name in split_names(values, folder))


def _absolute_name(name: str, folder: Path) -> str:
    path = _existing_path(name, folder)
    return f"{folder / path}{name[len(path) :]}" if "." in path or os.sep in path else name


def _existing_path(text: str, folder: Path) -> str:
    """Return the longest path of an existing file or folder with which a text begins; empty: none."""
    paths = [text[: end.start()] for end in _PATH_END.finditer(text[:_MAX_LENGTH])]
    return next((path for path in reversed(paths) if path and os.path.exists(folder / path)), "")
