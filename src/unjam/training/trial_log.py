"""Logs with which a search, tuning, calibration or assessment resumes after an interruption."""

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
FILES_PREFIX = "files."  # of the keys of hashes of files in a flat request
VERSIONED_PACKAGES = ("eclipse-sumo", "libsumo")
"""packages of which, as of unjam, all rows of a log have the same version"""

TrialScore = tuple[float | None, str]
"""score and reason; no score if the trial does not count"""


@dataclass(frozen=True)
class TuningTrial:
    """A trial of parameters of an expert."""

    driver: str
    values: dict[str, Any]
    score: float | None
    """mean return, on several roads the mean gain; None if the driver is infeasible"""
    verdict: str


class RowLog:
    """Rows in the folder of a request, including those of earlier calls."""

    def __init__(self, folder: Path, request: dict[str, Any], file_name: str) -> None:
        """Begin in a new folder, or resume in that of the same request; raise `InputError` for other folders.

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
            if (before := stored.get("request")) != request:
                reason = f" ({_first_change(before, request)})" if isinstance(before, dict) else ""
                raise InputError(f"out: {str(folder)!r} was made with other settings{reason}; allowed: a new folder")
            starts = stored.get("starts")
            if not isinstance(starts, list) or not all(isinstance(each, dict) for each in starts):
                raise InputError(f"out: {REQUEST_FILE} in {str(folder)!r} is damaged; allowed: a new folder")
        else:
            make_new_folder(folder, ", or that of the same request")
        self.starts = [*starts, {"commit": current["commit"], "started": current["started"]}]
        atomic_write(path, to_json({"request": request, "starts": self.starts}, indent=1))
        self._path = folder / file_name
        self.rows = read_json_lines(self._path)
        if self._path.is_file():  # this removes an incomplete last row
            atomic_write(self._path, "".join(f"{to_json(row)}\n" for row in self.rows))

    def append(self, row: dict[str, Any]) -> None:
        """Add a row; it is on the disk when this returns."""
        self.rows.append(row)
        append_line(self._path, to_json(row))


def _first_change(before: dict[str, Any], now: dict[str, Any]) -> str:
    """Return the first setting or file in which two requests differ, as a clause."""
    old, new = flatten_keys(before), flatten_keys(now)
    name = next(key for key in {**new, **old} if key not in old or key not in new or old[key] != new[key])
    if name.startswith(FILES_PREFIX):
        return f"{name.removeprefix(FILES_PREFIX)} has changed"
    return f"{name}: {short_repr(old.get(name))} there, {short_repr(new.get(name))} now"


class TrialLog(RowLog):
    """Rows about trials, and verdicts by the first of their seeds."""

    def __init__(self, folder: Path, request: dict[str, Any]) -> None:
        """Begin or resume as `RowLog`."""
        super().__init__(folder, request, TRIALS_FILE)
        self.verdicts: dict[tuple[int, str], TrialScore] = {}
        """verdicts by first seed and driver, without damaged rows"""
        for row in self.rows:
            with suppress(KeyError, TypeError):
                score, verdict = row["score"], row["verdict"]
                is_number = isinstance(score, int | float) and not isinstance(score, bool) and isfinite(score)
                if (score is None or is_number) and isinstance(verdict, str):
                    self.verdicts[row["first_seed"], row["driver"]] = score, verdict

    def add(self, first_seed: int, driver: str, verdict: TrialScore) -> None:
        """Add a verdict; it is on the disk when this returns."""
        self.verdicts[first_seed, driver] = verdict
        self.append({"first_seed": first_seed, "driver": driver, "score": verdict[0], "verdict": verdict[1]})
