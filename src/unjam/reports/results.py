"""Read folders of results of `unjam train` and `unjam drive` for reports."""

import json
import shlex
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load

from unjam.errors import InputError, resume_hint
from unjam.files import INVALID_DATA_ERRORS, read_json_lines, sha256_of
from unjam.folders import reject_unsafe_files
from unjam.measures.metric_table import driver_rank
from unjam.measures.metrics import METRICS
from unjam.worlds.record import Episode

Float32s = NDArray[np.float32]

EVALUATION_FILE = "evaluation.json"  # metrics of each driver
CONTROLLER_FILE, _WEIGHTS_PART = "controller.unjam", "weights.safetensors"  # controller of a run, and its weights
PLOT_EPISODES_FILE = "plot_episodes.safetensors"  # arrays of the episodes in figures
PLOT_EPISODES_HASH = "plot_episodes_sha256"  # entry in the evaluation with the hash of `PLOT_EPISODES_FILE`
MODEL_FILE = "model.json"  # facts about the learned model of a run
VEHICLE_ARRAYS = ("speeds", "positions", "gaps", "poses", "lane_indices")  # arrays of shape (times, vehicles, ...)
PLOT_ARRAYS = (*VEHICLE_ARRAYS, "replayed_motion", "outline", "backlog", "lane_lines")  # arrays for figures
FULL_RATE_ARRAYS = ("speeds", "backlog")  # arrays with values for every control step, not only for snapshots
NO_LANE = -1  # stored for NaN, because lanes are stored as integers
EPISODE_ENTRIES = (
    *("control_step", "seed", "drawn_values", "loop_length", "crossings", "branches", "limit_speed", "merge_positions"),
    *("vehicle_ids", "cav_ids", "vehicle_columns", "lane_names"),
)  # other fields of an episode for figures


@dataclass(frozen=True)
class PlotEpisode(Episode):
    """Episode of a driver with data for figures; all drivers of a folder have the same seed."""

    seed: tuple[int, ...] = ()
    status: str = ""
    driver: str = ""

    @property
    def is_closed(self) -> bool:
        """Whether the road is a loop."""
        return len(self.outline) > 0

    @property
    def controlled_columns(self) -> list[int]:
        """Columns of the CAVs; none in the human baseline, where human drivers drive them."""
        return self.cav_columns if driver_rank(self.driver) else []

    @property
    def has_same_vehicles(self) -> bool:
        """Whether all vehicles are present from the beginning to the end."""
        return self.is_closed or self.has_recorded_leader

    @property
    def has_poses(self) -> bool:
        """Whether positions in the plane are known; some backends do not record them on open roads."""
        return self.is_closed or len(self.poses) > 0

    @property
    def times(self) -> NDArray[np.float64]:
        """Times of the snapshots [s], shape (T + 1,)."""
        return np.arange(len(self.speeds), dtype=np.float64) * self.control_step


def to_plot_episode(driver: str, episode: Episode) -> PlotEpisode:
    """Return the data of an episode for figures; the new `control_step` is the time between two snapshots."""
    values = {name: getattr(episode, name) for name in (*EPISODE_ENTRIES, *PLOT_ARRAYS)}
    values |= {name: values[name][:: episode.snapshot_stride] for name in FULL_RATE_ARRAYS}
    if episode.has_recorded_leader:  # the plane moves with the recorded vehicle, which is at its origin
        x = episode.positions - episode.replayed_motion[:, :1, 0]
        line = np.array([[x.min(), 0.0], [0.0, 0.0]])
        values |= {"poses": np.stack([x, 0.0 * x, 0.0 * x], -1), "lane_lines": line}
    return PlotEpisode(**{**values, "control_step": episode.control_step * episode.snapshot_stride}, driver=driver)


def pack_episode(episode: PlotEpisode) -> dict[str, Float32s]:
    """Return the arrays for figures in single precision, without entries of absent vehicles.

    On an open road most entries are of absent vehicles. `is_present` marks the other entries, and `VEHICLE_ARRAYS`
    contain only these.
    """
    arrays = {name: getattr(episode, name).astype(np.float32) for name in PLOT_ARRAYS}
    is_present = ~np.isnan(episode.speeds)
    if is_present.all():
        return arrays
    packed = {name: array[is_present] for name, array in arrays.items() if array.shape[:2] == is_present.shape}
    if "lane_indices" in packed:
        packed["lane_indices"] = np.nan_to_num(packed["lane_indices"], nan=NO_LANE).astype(np.int8)
    return {**arrays, **packed, "is_present": is_present}


def unpack_episode(arrays: dict[str, Any]) -> dict[str, Any]:
    """Return the arrays of an episode from the result of `pack_episode`, its inverse."""
    unpacked = dict(arrays)
    if (is_present := unpacked.pop("is_present", None)) is None:
        return unpacked
    for name in unpacked.keys() & set(VEHICLE_ARRAYS):
        if len(packed := arrays[name]) == is_present.sum():
            unpacked[name] = np.full((*is_present.shape, *packed.shape[1:]), np.nan, np.float32)
            values = np.where(packed == NO_LANE, np.nan, packed) if name == "lane_indices" else packed
            unpacked[name][is_present] = values
    return unpacked


@dataclass(frozen=True)
class Results:
    """The content of a run folder, or of a folder of `unjam drive`."""

    folder: Path
    metadata: dict[str, Any]  # such as scenario, reward, expert, label of the trained controller, manifest
    rows: dict[str, list[dict[str, Any]]]  # rows of metrics by driver, one for each episode
    plot_episodes: dict[str, PlotEpisode]  # episodes for figures, by driver
    progress: list[dict[str, Any]] = field(default_factory=list)  # a row for each iteration; empty without a training
    config: str = ""  # configuration of the run, as TOML
    model: dict[str, Any] | None = None  # facts about the learned model; None if there is none

    @property
    def trained_label(self) -> str | None:
        """Label of the trained controller; None for results without a training."""
        return self.metadata.get("trained")

    @property
    def baseline(self) -> str:
        """Label of the driver with which the others are compared; empty: human drivers."""
        baseline = self.metadata.get("baseline") or ""
        return baseline if baseline in self.rows else ""


def read_results(folder: Path) -> Results:
    """Return the content of a folder of results; raise `InputError` if a file is missing or damaged."""
    for name in (EVALUATION_FILE, PLOT_EPISODES_FILE):
        if not (folder / name).is_file():
            hint = resume_hint(folder) if (folder / "config.toml").exists() else ""
            raise InputError(f"report: {str(folder)!r} has no {name}{hint}")
    reject_unsafe_files(folder)
    metadata, rows = read_evaluation(folder)
    try:
        packed = (folder / PLOT_EPISODES_FILE).read_bytes()
        if metadata.pop(PLOT_EPISODES_HASH, None) not in (None, sha256_of(packed)):
            reason = f"{PLOT_EPISODES_FILE} does not belong to {EVALUATION_FILE}"
            raise InputError(f"report: {str(folder)!r}: {reason}; allowed: repeat the command that wrote them")
        stored, episodes = load(packed), {}
        for index, entry in enumerate(metadata.pop("plot_episodes")):
            names = (name for name in (*PLOT_ARRAYS, "is_present") if f"{index}.{name}" in stored)
            arrays = unpack_episode({name: stored[f"{index}.{name}"] for name in names})
            episodes[entry["driver"]] = PlotEpisode(**replace_null(entry), **arrays)
        config = _read_text(folder / "config.toml")
        return Results(folder, metadata, rows, episodes, read_progress(folder), config, read_model_facts(folder))
    except INVALID_DATA_ERRORS as error:
        raise damaged_results_error(folder, error) from None


def is_outdated(folder: Path, metadata: dict[str, Any]) -> bool:
    """Return whether the controller in a folder has other weights than the evaluated controller."""
    evaluated, current = metadata.get("weights"), weights_id(folder / CONTROLLER_FILE)
    return evaluated is not None and current is not None and current != evaluated


def weights_id(controller: Path) -> str | None:
    """Return checksum and size of the weights of a controller, which signing and certifying keep; None: no weights."""
    with suppress(BadZipFile, KeyError, OSError), ZipFile(controller) as archive:
        weights = archive.getinfo(_WEIGHTS_PART)
        return f"{weights.CRC:08x}-{weights.file_size}"
    return None


def damaged_results_error(folder: Path, error: Exception) -> InputError:
    """Return the error for results that unjam has not written."""
    return InputError(f"report: {str(folder)!r} cannot be read: {type(error).__name__}: {error}")


def rows_by_driver(rows: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of an `evaluation.json` by driver; null and missing metrics become NaN."""
    undefined = dict.fromkeys(METRICS, float("nan"))
    drivers: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        drivers.setdefault(row["driver"], []).append({**undefined, **replace_null(row)})
    return drivers


def read_evaluation(folder: Path) -> tuple[dict[str, Any], dict[str, list[dict[str, Any]]]]:
    """Return the metadata of a folder of results, and its rows of metrics by driver."""
    try:
        metadata = json.loads((folder / EVALUATION_FILE).read_text())
        return metadata, rows_by_driver(metadata.pop("rows"))
    except INVALID_DATA_ERRORS as error:
        raise damaged_results_error(folder, error) from None


def read_rows(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of metrics of a folder of results, by driver."""
    return read_evaluation(folder)[1]


def read_progress(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of progress of a run without damaged rows, such as a row that a crash truncated."""

    def is_progress(row: dict[str, Any]) -> bool:
        counts = row.get("iteration"), row.get("environment_steps", 0)
        returns = row.get("return_validation"), row.get("return_expert")
        return {*map(type, counts)} <= {int} and {*map(type, returns)} <= {int, float, type(None)}

    return list(filter(is_progress, read_json_lines(folder / "progress.jsonl")))


def validation_gains(progress: Sequence[dict[str, Any]]) -> tuple[float, float] | None:
    """Return the best and the last return on validation seeds minus that of the expert; None without a validation.

    If the best is not positive, the run kept the untrained network, which has the return of the expert.
    """
    expert = progress[0]["return_expert"] or 0.0 if progress else 0.0
    gains = [row["return_validation"] - expert for row in progress if row["return_validation"] is not None]
    return (max(gains), gains[-1]) if gains else None


def selected_row(progress: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """Return the row of progress of the best network in validation; None if no network was better than the expert."""
    expert = progress[0]["return_expert"] or 0.0 if progress else 0.0
    rows = [row for row in progress if row["return_validation"] is not None and row["return_validation"] > expert]
    return max(rows, key=lambda row: row["return_validation"], default=None)


def seconds_by_part(progress: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Return the total wall time of each part of a training [s]."""
    parts = dict.fromkeys(part for row in progress for part in row["seconds"])
    return {part: sum(row["seconds"].get(part, 0.0) for row in progress) for part in parts}


def read_model_facts(folder: Path) -> dict[str, Any] | None:
    """Return the content of the `model.json` of a run; None if it is missing or cannot be read."""
    try:
        facts = json.loads(_read_text(folder / MODEL_FILE))
    except (ValueError, RecursionError):
        return None
    return facts if isinstance(facts, dict) else None


def original_command(results: Results) -> str:
    """Return the command line that wrote a folder; for a resumed run the first command, with the last step budget."""
    command = [str(word) for word in results.metadata.get("manifest", {}).get("command", [])]
    if results.trained_label is None or "--resume" not in command:
        return shlex.join(command)
    try:
        manifest = json.loads(_read_text(results.folder / "manifest.json"))
        first_command, *resumptions = (record["command"] for record in (manifest, *manifest["lineage"]))
    except INVALID_DATA_ERRORS:
        return shlex.join(command)
    words = (pair for resumption in resumptions for pair in pairwise(resumption))
    budgets = [[option, value] for option, value in words if option == "--steps"]
    return shlex.join([*first_command, *(budgets or [[]])[-1]])


def _read_text(path: Path) -> str:
    """Return the text of a file; empty if the file is missing."""
    return path.read_text(errors="replace") if path.is_file() else ""


def replace_null(entry: dict[str, Any]) -> dict[str, Any]:
    """Return a JSON object with NaN for null, because JSON has no NaN."""
    return {key: float("nan") if value is None else value for key, value in entry.items()}
