"""What a tuning has tried, kept in its folder, so that after a stop it goes on where it was."""

import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from unjam.errors import InputError
from unjam.files import append_line, read_lines, to_json, write_whole
from unjam.manifest import manifest
from unjam.training.folder import make_new_folder

ASKED, TRIED = "asked.json", "tried.jsonl"

Verdict = tuple[float | None, str]
"""score and why; no score where it does not count"""


@dataclass(frozen=True)
class Setting:
    """Parameters of an expert that were tried."""

    driver: str
    """as `--driver` takes it"""
    values: dict[str, Any]
    score: float | None
    """mean return, on several roads the mean gain; None where no car could drive so"""
    verdict: str


class Tried:
    """Verdicts on settings by the first of their seeds; those of an earlier call are known."""

    def __init__(self, folder: Path, asked: dict[str, Any]) -> None:
        """Begin in a new folder, or go on in that of the same tuning.

        Raises:
            InputError: the folder holds something else, or another tuning.
        """
        asked, path, starts = json.loads(to_json(asked)), folder / ASKED, list[dict[str, Any]]()
        if path.is_file():
            before = {}
            with suppress(ValueError, RecursionError, OSError):
                before = json.loads(path.read_text(encoding="utf-8"))
            if not isinstance(before, dict) or before.get("asked") != asked:
                raise InputError(f"out: {str(folder)!r} was made with other settings; allowed: a new folder")
            starts = before.get("starts", [])
        else:
            make_new_folder(folder, ", or that of this tuning")
        about = manifest()
        self.starts = [*starts, {"commit": about["commit"], "started": about["started"]}]
        """when it began and went on, and by which commit"""
        write_whole(path, to_json({"asked": asked, "starts": self.starts}, indent=1))
        self._path = folder / TRIED
        self.known: dict[tuple[int, str], Verdict] = {}
        """by first seed and driver; what is damaged is tried again"""
        rows = read_lines(self._path)
        for row in rows:
            with suppress(KeyError, TypeError):
                self.known[row["first"], row["driver"]] = row["score"], row["verdict"]
        if self._path.is_file():  # else the next row would be written onto one that was cut short
            write_whole(self._path, "".join(f"{to_json(row)}\n" for row in rows))

    def keep(self, first: int, driver: str, found: Verdict) -> None:
        """Keep a verdict; it is on the disk when this returns."""
        self.known[first, driver] = found
        row = {"first": first, "driver": driver, "score": found[0], "verdict": found[1]}
        append_line(self._path, to_json(row))
