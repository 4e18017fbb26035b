"""What a folder of results says: reports read folders, and nothing else."""

import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file

from unjam.errors import InputError, resume_hint
from unjam.files import INVALID_DATA_ERRORS, read_json_lines
from unjam.measures.metrics import METRICS
from unjam.worlds.record import Episode

Float32s = NDArray[np.float32]

EVALUATION_FILE = "evaluation.json"
"""what was measured of each driver"""
MODEL_FILE = "model.json"
"""what there is to see of a run's virtual environment"""
PLOT_ARRAYS = ("speeds", "positions", "gaps", "outline", "waiting", "lines", "places", "lanes")
"""arrays of an episode that pictures are made of"""
VEHICLE_ARRAYS = ("speeds", "positions", "gaps", "places", "lanes")
"""those with a row per moment and a column per vehicle"""
FULL_RATE_ARRAYS = ("speeds", "waiting")
"""those of which an episode has more moments than are pictured"""
NO_LANE = -1
"""lanes are stored as small integers, which have no NaN"""
STORED_ARRAYS = (*PLOT_ARRAYS, "there")
EPISODE_ENTRIES = (
    *("step", "seed", "drawn", "loop_length", "crossings", "branches", "limit_speed"),
    *("vehicle_ids", "cav_ids", "columns", "lane_names"),
)
"""what is written of an episode that pictures show, beside its arrays"""


@dataclass(frozen=True)
class PlotEpisode(Episode):
    """What pictures show of one driver's episode; all drivers of a folder share one seed."""

    seed: tuple[int, ...] = ()
    status: str = ""
    driver: str = ""

    @property
    def is_closed(self) -> bool:
        """Whether the road is a loop."""
        return len(self.outline) > 0

    @property
    def times(self) -> NDArray[np.float64]:
        """[s], shape (T + 1,)."""
        return np.arange(len(self.speeds), dtype=np.float64) * self.control_step


def to_plot_episode(driver: str, episode: Episode) -> PlotEpisode:
    """Return what pictures show of an episode that was just driven."""
    shown = {name: getattr(episode, name) for name in (*EPISODE_ENTRIES, *PLOT_ARRAYS)}
    thinned = {name: shown[name][:: episode.snapshot_stride] for name in FULL_RATE_ARRAYS}
    return PlotEpisode(**{**shown, **thinned, "step": episode.control_step * episode.snapshot_stride}, driver=driver)


def pack_episode(episode: PlotEpisode) -> dict[str, Float32s]:
    """Return the arrays of pictures in single precision, where vehicles come and go without the gaps.

    On a road with ends each vehicle is there for a few of all moments: `is_present` says when, and the arrays
    that have a row per moment and a column per vehicle keep those entries alone.
    """
    arrays = {name: getattr(episode, name).astype(np.float32) for name in PLOT_ARRAYS}
    there = ~np.isnan(episode.speeds)
    if there.all():
        return arrays
    kept = {name: array[there] for name, array in arrays.items() if array.shape[:2] == there.shape}
    if "lanes" in kept:
        kept["lanes"] = np.nan_to_num(kept["lanes"], nan=NO_LANE).astype(np.int8)
    return {**arrays, **kept, "there": there}


def unpack_episode(arrays: dict[str, Any]) -> dict[str, Any]:
    """Return the arrays of pictures that `pack_episode` took apart, or older ones as they are."""
    there = arrays.pop("there", None)
    if there is None:
        return arrays
    whole = {}
    for name, array in arrays.items():
        if len(array) == there.sum() and name in VEHICLE_ARRAYS:
            whole[name] = np.full((*there.shape, *array.shape[1:]), np.nan, np.float32)
            whole[name][there] = np.where(array == NO_LANE, np.nan, array) if name == "lanes" else array
    return {**arrays, **whole}


@dataclass(frozen=True)
class Results:
    """The content of a run folder, or of one that `unjam drive` wrote."""

    folder: Path
    metadata: dict[str, Any]
    """scenario, reward, expert, label of the trained controller, manifest"""
    rows: dict[str, list[dict[str, Any]]]
    """by driver: a row of metrics per episode"""
    plot_episodes: dict[str, PlotEpisode]
    """by driver"""
    progress: list[dict[str, Any]] = field(default_factory=list)
    """a row per iteration of training; empty without one"""
    config: str = ""
    """the run's configuration, as TOML"""
    model: dict[str, Any] | None = None
    """what there is to see of the virtual environment; None without one"""

    @property
    def trained_label(self) -> str | None:
        """Label of the trained controller, if there is one."""
        return self.metadata.get("trained_label")


def read_results(folder: Path) -> Results:
    """Return what a folder of results says.

    Raises:
        InputError: it is not such a folder, or not finished.
    """
    path, recorded = (folder / name for name in (EVALUATION_FILE, "shown.safetensors"))
    for file in (path, recorded):
        if not file.is_file():
            hint = resume_hint(folder) if (folder / "config.toml").exists() else ""
            raise InputError(f"report: {str(folder)!r} has no {file.name}{hint}")
    try:
        about, arrays = json.loads(path.read_text()), load_file(recorded)
        rows, shown = rows_by_driver(about.pop("rows")), {}
        for number, entry in enumerate(about.pop("plot_episodes")):
            pictured = unpack_episode(
                {name: arrays[key] for name in STORED_ARRAYS if (key := f"{number}.{name}") in arrays}
            )
            shown[entry["driver"]] = PlotEpisode(**_replace_null(entry), **pictured)
        config = _read_text(folder / "config.toml")
        return Results(folder, about, rows, shown, read_progress(folder), config, read_model_facts(folder))
    except INVALID_DATA_ERRORS as error:
        raise damaged_results_error(folder, error) from None


def damaged_results_error(folder: Path, error: Exception) -> InputError:
    """Return the error for results that are not what unjam writes."""
    return InputError(f"report: {str(folder)!r} cannot be read: {type(error).__name__}: {error}")


def rows_by_driver(rows: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of an `evaluation.json` by driver, NaN where it has null or no such metric."""
    unknown = dict.fromkeys(METRICS, float("nan"))
    found: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        found.setdefault(row["driver"], []).append({**unknown, **_replace_null(row)})
    return found


def read_evaluation(folder: Path) -> tuple[dict[str, Any], dict[str, list[dict[str, Any]]]]:
    """Return what a folder of results is about, and its rows of metrics by driver."""
    try:
        about = json.loads((folder / EVALUATION_FILE).read_text())
        return about, rows_by_driver(about.pop("rows"))
    except INVALID_DATA_ERRORS as error:
        raise damaged_results_error(folder, error) from None


def read_rows(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of metrics of a folder of results, by driver."""
    return read_evaluation(folder)[1]


def read_progress(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of a run's progress; one that is damaged, or cut short by a crash, is left out."""
    return [row for row in read_json_lines(folder / "progress.jsonl") if isinstance(row.get("iteration"), int)]


def validation_gains(progress: Sequence[dict[str, Any]]) -> tuple[float, float] | None:
    """Return the best return and the last on the validation seeds, beyond the expert's; None without any.

    Where the best is not above zero the untrained network was kept, which earns what the expert does.
    """
    validated = [row["return_validation"] for row in progress if row["return_validation"] is not None]
    expert = progress[0]["return_expert"] or 0.0 if progress else 0.0
    return (max(validated) - expert, validated[-1] - expert) if validated else None


def seconds_by_part(progress: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Return the wall time of each part of training [s], over all rows of progress."""
    parts = dict.fromkeys(part for row in progress for part in row["seconds"])
    return {part: sum(row["seconds"].get(part, 0.0) for row in progress) for part in parts}


def read_model_facts(folder: Path) -> dict[str, Any] | None:
    """Return what a run's `model.json` says; None where there is none, or none that can be read."""
    try:
        found = json.loads(_read_text(folder / MODEL_FILE))
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def original_command(results: Results) -> str:
    """Return the command line that made a folder; of one that went on the first, with the last budget."""
    command = [str(word) for word in results.metadata.get("manifest", {}).get("command", [])]
    if results.trained_label is None or "--resume" not in command:
        return shlex.join(command)
    try:
        made = json.loads(_read_text(results.folder / "manifest.json"))
        first, *others = (each["command"] for each in (made, *made["lineage"]))
    except INVALID_DATA_ERRORS:
        return shlex.join(command)
    budgets = [["--steps", after] for each in others for word, after in pairwise(each) if word == "--steps"]
    return shlex.join([*first, *(budgets or [[]])[-1]])


def _read_text(path: Path) -> str:
    return path.read_text(errors="replace") if path.is_file() else ""


def _replace_null(entry: dict[str, Any]) -> dict[str, Any]:
    """JSON has no NaN; null stands for it."""
    return {key: float("nan") if value is None else value for key, value in entry.items()}
