"""Optuna's log of a search in a file; import this module only if Optuna is installed."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from optuna.storages.journal import BaseJournalBackend

from unjam.files import append_line, atomic_write, read_json_lines


class Journal(BaseJournalBackend):
    """Optuna's log of a study, which is written only by the process that has locked the search's folder.

    Optuna's own class follows symbolic links, and leaves one as its lock.
    """

    def __init__(self, path: Path) -> None:
        """Read the file, which may be missing; an incomplete line of a crash is left out."""
        self._path, self._lines = path, list(map(_json_line, read_json_lines(path)))
        if path.is_file():
            atomic_write(path, "".join(f"{line}\n" for line in self._lines))

    def read_logs(self, log_number_from: int) -> Iterable[dict[str, Any]]:
        """Return the entries of the log from a number on."""
        return map(json.loads, self._lines[log_number_from:])

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        """Add entries to the log; they are on the disk when this returns."""
        lines = list(map(_json_line, logs))
        append_line(self._path, "\n".join(lines))
        self._lines += lines


def _json_line(entry: dict[str, Any]) -> str:
    return json.dumps(entry, separators=(",", ":"))
