"""What Optuna remembers of a search, in a file of its own format; import it where Optuna is installed."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from optuna.storages.journal import BaseJournalBackend

from unjam.files import append_line, atomic_write, read_json_lines


class Journal(BaseJournalBackend):
    """Optuna's log of a study, which one process writes at a time: the one that holds the search's folder.

    Optuna's own class writes through links, and leaves a link as its lock.
    """

    def __init__(self, path: Path) -> None:
        """Take the file, which may be missing; a line that a crash has cut short is left out."""
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
