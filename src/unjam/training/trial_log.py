"""Logs from which a search, tuning, calibration or assessment resumes after an interruption."""

import json
from contextlib import suppress
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from reprlib import repr as short_repr
from typing import Any

from unjam.errors import InputError
from unjam.files import append_line, atomic_write, read_json_lines, to_json
from unjam.manifest import manifest
from unjam.parameters import flatten_keys
from unjam.training.run_folder import make_new_folder

REQUEST_FILE, TRIALS_FILE = "request.json", "trials.jsonl"
FILES_PREFIX = "files."
"""prefix of the keys of file hashes in a flat request"""
VERSIONED_PACKAGES = ("eclipse-sumo", "libsumo")
"""packages that, like unjam, must have the same version for all rows of a log"""

TrialScore = tuple[float | None, str]
"""score, None if the trial does not count, and a text such as the reason"""


@dataclass(frozen=True)
class TuningTrial:
    """Parameters of an expert and their score."""

    driver: str
    """name of the driver with these parameters"""
    values: dict[str, Any]
    score: float | None
    """mean return, or on several roads the mean gain; None if the driver is infeasible"""
    verdict: str


class RowLog:
    """Rows of the results of a request, including those of earlier calls, in a folder."""

    def __init__(self, folder: Path, request: dict[str, Any], file_name: str) -> None:
        """Begin in a new folder, or resume in the folder of the same request; raise `InputError` for other folders.

        Versions of unjam and SUMO are part of the request.
        """
        current = manifest()
        versions = {"unjam": current["unjam"], **{name: current["packages"][name] for name in VERSIONED_PACKAGES}}
        request, path = json.loads(to_json(request | {"versions": versions})), folder / REQUEST_FILE
        starts = list[dict[str, Any]]()
        if path.is_file():
            stored = {}
            with suppress(ValueError, RecursionError, OSError):
                stored = json.loads(path.read_text(encoding="utf-8"))
            stored = stored if isinstance(stored, dict) else {}
            if (stored_request := stored.get("request")) != request:
                is_valid = isinstance(stored_request, dict)
                reason = f" ({_first_change(stored_request, request)})" if is_valid else ""
                raise InputError(f"out: {str(folder)!r} was made with other settings{reason}; allowed: a new folder")
            starts = stored.get("starts")
            if not isinstance(starts, list) or not all(isinstance(start, dict) for start in starts):
                raise InputError(f"out: {REQUEST_FILE} in {str(folder)!r} is damaged; allowed: a new folder")
        else:
            make_new_folder(folder, ", or that of the same request")
        self.starts = [*starts, {"commit": current["commit"], "started": current["started"]}]
        """commit and time of each call"""
        atomic_write(path, to_json({"request": request, "starts": self.starts}, indent=1))
        self._path = folder / file_name
        self.rows = read_json_lines(self._path)
        if self._path.is_file():  # this removes an incomplete last row
            atomic_write(self._path, "".join(f"{to_json(row)}\n" for row in self.rows))

    def append(self, row: dict[str, Any]) -> None:
        """Add a row and write it to the disk."""
        self.rows.append(row)
        append_line(self._path, to_json(row))


def _first_change(old_request: dict[str, Any], new_request: dict[str, Any]) -> str:
    """Return a clause about the first setting or file in which two requests differ."""
    old, new = flatten_keys(old_request), flatten_keys(new_request)
    name = next(key for key in {**new, **old} if key not in old or key not in new or old[key] != new[key])
    if name.startswith(FILES_PREFIX):
        return f"{name.removeprefix(FILES_PREFIX)} has changed"
    values = old.get(name), new.get(name)
    old_text, new_text = map(short_repr, values)
    if old_text == new_text:  # long texts that differ in the middle, such as paths
        old_text, new_text = map(repr, values)
    return f"{name}: {old_text} there, {new_text} now"


class TrialLog(RowLog):
    """Rows of the trials of a search, tuning or calibration, and the verdicts of trials."""

    def __init__(self, folder: Path, request: dict[str, Any]) -> None:
        """Begin or resume as `RowLog` does."""
        super().__init__(folder, request, TRIALS_FILE)
        self.verdicts: dict[tuple[int, str], TrialScore] = {}
        """verdicts by first seed and driver (or factors), without damaged rows"""
        for row in self.rows:
            with suppress(KeyError, TypeError):
                score, verdict = row["score"], row["verdict"]
                is_number = isinstance(score, int | float) and not isinstance(score, bool) and isfinite(score)
                if (score is None or is_number) and isinstance(verdict, str):
                    self.verdicts[row["first_seed"], row["driver"]] = score, verdict

    def add(self, first_seed: int, driver: str, verdict: TrialScore) -> None:
        """Add a verdict and write it to the disk."""
        self.verdicts[first_seed, driver] = verdict
        self.append({"first_seed": first_seed, "driver": driver, "score": verdict[0], "verdict": verdict[1]})
