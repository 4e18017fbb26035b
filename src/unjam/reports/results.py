"""What a folder of results says: reports read folders, and nothing else."""

import json
import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file

from unjam.errors import InputError

Floats = NDArray[np.float32]


EVALUATION_FILE = "evaluation.json"
"""what was measured of each driver"""
MODEL_FILE = "model.json"
"""what there is to see of a run's virtual environment"""
PICTURED = ("speeds", "positions", "gaps", "outline", "waiting", "lines", "places")
"""arrays of an episode that pictures are made of"""


@dataclass(frozen=True)
class Shown:
    """The episode of one driver that pictures show; T decisions, N vehicles. All share one seed."""

    driver: str
    step: float
    """time between two decisions [s]"""
    loop_length: float
    crossings: list[list[float]]
    """where along the road it crosses itself [m]"""
    limit_speed: float
    drawn: dict[str, float]
    vehicle_ids: list[str]
    cav_ids: list[str]
    speeds: Floats
    """[m/s], shape (T + 1, N); NaN where a vehicle is not on the road"""
    positions: Floats
    """along the route, not wrapped [m], shape (T + 1, N)"""
    gaps: Floats
    """to the vehicle ahead [m], shape (T + 1, N)"""
    outline: Floats
    """a closed road's centre line: rows (coordinate along the route, x, y) [m]"""
    branches: list[str]
    """where each vehicle of a merging road came from"""
    waiting: Floats
    """vehicles that want to enter and cannot, shape (T + 1,); empty of a closed road"""
    lines: Floats
    """lanes of a road with ends: rows (x, y) [m], a row of NaN between two"""
    places: Floats
    """(x, y, heading) of vehicles on a road with ends [m, rad], shape (T + 1, N, 3)"""

    @property
    def closed(self) -> bool:
        """Whether the road is a loop."""
        return len(self.outline) > 0

    @property
    def times(self) -> NDArray[np.float64]:
        """[s], shape (T + 1,)."""
        return np.arange(len(self.speeds), dtype=np.float64) * self.step

    @property
    def cavs(self) -> list[int]:
        """Columns of the CAVs."""
        column = {name: index for index, name in enumerate(self.vehicle_ids)}
        return [column[name] for name in self.cav_ids]


@dataclass(frozen=True)
class Results:
    """The content of a run folder, or of one that `unjam drive` wrote."""

    folder: Path
    about: dict[str, Any]
    """scenario, reward, expert, label of the trained controller, manifest"""
    rows: dict[str, list[dict[str, Any]]]
    """by driver: a row of metrics per episode"""
    shown: dict[str, Shown]
    """by driver"""
    progress: list[dict[str, Any]] = field(default_factory=list)
    """a row per iteration of training; empty without one"""
    config: str = ""
    """the run's configuration, as TOML"""
    model: dict[str, Any] | None = None
    """what there is to see of the virtual environment; None without one"""

    @property
    def trained(self) -> str | None:
        """Label of the trained controller, if there is one."""
        return self.about.get("trained")


def read_results(folder: Path) -> Results:
    """Return what a folder of results says.

    Raises:
        InputError: it is not such a folder, or not finished.
    """
    path = folder / EVALUATION_FILE
    if not path.is_file():
        hint = "; go on with: unjam train --resume" if (folder / "config.toml").exists() else ""
        raise InputError(f"report: {str(folder)!r} has no {EVALUATION_FILE}{hint}")
    try:
        return _results(folder, json.loads(path.read_text()), load_file(folder / "shown.safetensors"))
    except (OSError, ValueError, LookupError, TypeError, AttributeError, SafetensorError) as error:
        raise InputError(f"report: {str(folder)!r} cannot be read: {type(error).__name__}: {error}") from None


def _results(folder: Path, about: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Results:
    rows = rows_by_driver(about.pop("rows"))
    shown = {}
    for number, entry in enumerate(about.pop("shown")):
        values: dict[str, Any] = {key: _nan(value) for key, value in entry.items() if key != "seed"}
        values |= {name: arrays[f"{number}.{name}"] for name in PICTURED}
        shown[entry["driver"]] = Shown(**values)
    config = _text(folder / "config.toml")
    return Results(folder, about, rows, shown, read_progress(folder), config, read_model(folder))


def rows_by_driver(rows: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of an `evaluation.json` by driver, NaN where it has null."""
    found: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        found.setdefault(row["driver"], []).append({key: _nan(value) for key, value in row.items()})
    return found


def read_rows(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of metrics of a folder of results, by driver."""
    return rows_by_driver(json.loads((folder / EVALUATION_FILE).read_text())["rows"])


def read_progress(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of a run's progress; a last line cut short by a crash is left out."""
    rows = []
    for line in _text(folder / "progress.jsonl").splitlines():
        try:
            rows.append(json.loads(line))
        except ValueError:
            break
    return rows


def read_model(folder: Path) -> dict[str, Any] | None:
    """Return what a run's `model.json` says; None where there is none, or none that can be read."""
    try:
        found = json.loads(_text(folder / MODEL_FILE))
    except ValueError:
        return None
    return found if isinstance(found, dict) else None


def _text(path: Path) -> str:
    return path.read_text() if path.exists() else ""


def _nan(value: Any) -> Any:
    """JSON has no NaN; null stands for it."""
    return float("nan") if value is None else value


def command_to_repeat(results: Results) -> str:
    """Return the command line that made a folder."""
    command = results.about.get("manifest", {}).get("command", [])
    return shlex.join(str(word) for word in command)
