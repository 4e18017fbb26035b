"""What Optuna remembers of a search, in a file of its own format; import it where Optuna is installed."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from optuna.storages.journal import BaseJournalBackend

from unjam.files import append_line, read_lines, write_whole


class Journal(BaseJournalBackend):
    """Optuna's log of a study, which one process writes at a time: the one that holds the search's folder.

    Optuna's own class writes through links, and leaves a link as its lock.
    """

    def __init__(self, path: Path) -> None:
        """Take the file, which may be missing; a line that a crash has cut short is left out."""
        self._path = path
        if path.is_file():
            write_whole(path, "".join(f"{line}\n" for line in map(_as_line, read_lines(path))))

    def read_logs(self, log_number_from: int) -> Iterable[dict[str, Any]]:
        """Return the entries of the log from a number on."""
        return read_lines(self._path)[log_number_from:]

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        """Add entries to the log; they are on the disk when this returns."""
        append_line(self._path, "\n".join(map(_as_line, logs)))


def _as_line(entry: dict[str, Any]) -> str:
    return json.dumps(entry, separators=(",", ":"))
