"""What a tuning has tried, kept in its folder, so that after a stop it goes on where it was."""

import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from unjam.errors import InputError
from unjam.files import append_line, atomic_write, read_json_lines, to_json
from unjam.manifest import manifest
from unjam.training.run_folder import make_new_folder

REQUEST_FILE, TRIALS_FILE = "request.json", "trials.jsonl"

TrialVerdict = tuple[float | None, str]
"""score and why; no score where it does not count"""


@dataclass(frozen=True)
class TuningTrial:
    """Parameters of an expert that were tried."""

    driver: str
    """as `--driver` takes it"""
    values: dict[str, Any]
    score: float | None
    """mean return, on several roads the mean gain; None where no car could drive so"""
    verdict: str


class TrialLog:
    """Verdicts on settings by the first of their seeds; those of an earlier call are known."""

    def __init__(self, folder: Path, request: dict[str, Any]) -> None:
        """Begin in a new folder, or go on in that of the same tuning.

        Raises:
            InputError: the folder holds something else, or another tuning.
        """
        request, path, starts = json.loads(to_json(request)), folder / REQUEST_FILE, list[dict[str, Any]]()
        if path.is_file():
            before = {}
            with suppress(ValueError, RecursionError, OSError):
                before = json.loads(path.read_text(encoding="utf-8"))
            if not isinstance(before, dict) or before.get("request") != request:
                raise InputError(f"out: {str(folder)!r} was made with other settings; allowed: a new folder")
            starts = before.get("starts", [])
        else:
            make_new_folder(folder, ", or that of this tuning")
        about = manifest()
        self.starts = [*starts, {"commit": about["commit"], "started": about["started"]}]
        """when it began and went on, and by which commit"""
        atomic_write(path, to_json({"request": request, "starts": self.starts}, indent=1))
        self._path = folder / TRIALS_FILE
        self.verdicts: dict[tuple[int, str], TrialVerdict] = {}
        """by first seed and driver; what is damaged is tried again"""
        rows = read_json_lines(self._path)
        for row in rows:
            with suppress(KeyError, TypeError):
                self.verdicts[row["first_seed"], row["driver"]] = row["score"], row["verdict"]
        if self._path.is_file():  # else the next row would be written onto one that was cut short
            atomic_write(self._path, "".join(f"{to_json(row)}\n" for row in rows))

    def add(self, first_seed: int, driver: str, verdict: TrialVerdict) -> None:
        """Keep a verdict; it is on the disk when this returns."""
        self.verdicts[first_seed, driver] = verdict
        row = {"first_seed": first_seed, "driver": driver, "score": verdict[0], "verdict": verdict[1]}
        append_line(self._path, to_json(row))
