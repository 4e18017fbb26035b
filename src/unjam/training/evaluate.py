"""Judging drivers: fixed seeds, deterministic policies, several drivers on the same traffic."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from safetensors.numpy import save

from unjam.drivers.driver import Driver
from unjam.errors import DiskError, EpisodeError, InputError, MissingPartError, UnjamError
from unjam.files import make_folder, to_json, write_whole
from unjam.measures.metrics import METRICS, measure
from unjam.measures.statistics import estimate
from unjam.reports.results import PICTURED
from unjam.scenarios.scenario import Scenario
from unjam.worlds.record import Episode
from unjam.worlds.workers import EpisodeTask, Workers

HELD_OUT = 1_000_003
"""first number of the seeds that judge; no training ever uses it"""
VALIDATION = 1_000_033
"""first number of the seeds that choose a controller"""


@dataclass(frozen=True)
class Evaluation:
    """Several drivers on the same episodes."""

    rows: dict[str, list[dict[str, Any]]]
    """by driver: a row per episode, failed ones too"""
    shown: dict[str, Episode] = field(repr=False)
    """by driver: the episode that pictures show, the same seed for all"""

    def means(self) -> dict[str, dict[str, float]]:
        """Return the mean of each metric, by driver."""
        return {
            label: {name: estimate([row[name] for row in rows]).mean for name in METRICS}
            for label, rows in self.rows.items()
        }


def held_out_seeds(count: int) -> list[tuple[int, ...]]:
    """Return the seeds of final evaluations."""
    return [(HELD_OUT, index) for index in range(count)]


def evaluate(
    scenario: Scenario,
    drivers: dict[str, Driver],
    seeds: Sequence[tuple[int, ...]],
    workers: Workers,
    reward: str = "",
    progress: Callable[[tuple[str, int], int], None] | None = None,
) -> Evaluation:
    """Run every driver on every seed, and measure.

    `progress` is called with (the driver's label, the index of its episode), and the decisions made so far.
    """
    pairs = [(label, index) for index in range(len(seeds)) for label in drivers]
    tasks = [EpisodeTask(scenario, drivers[label], seeds[index], reward, full=True) for label, index in pairs]

    def told(task: int, steps: int) -> None:
        if progress is not None:
            progress(pairs[task], steps)

    def measured(task: int, episode: Episode) -> tuple[dict[str, Any], Episode | None]:
        _, index = pairs[task]
        return measure(episode), episode if index == 0 and episode.ok else None

    rows: dict[str, list[dict[str, Any]]] = {label: [] for label in drivers}
    shown: dict[str, Episode] = {}
    for (label, _), (row, episode) in zip(pairs, workers.run_each(tasks, measured, told), strict=True):
        rows[label].append(row)
        if episode is not None:
            shown[label] = episode
    return Evaluation(rows, shown)


def raise_failure(rows: Sequence[dict[str, Any]]) -> None:
    """Raise the first failure among the rows of episodes, as the error that it was."""
    for row in rows:
        if row["status"] == "failed":
            kinds = {kind.__name__: kind for kind in (InputError, MissingPartError, DiskError, EpisodeError)}
            kind = kinds.get(row["error"], UnjamError)
            again = "" if kind is InputError else f" (seed {row['seed']})"
            raise kind(f"{row['reason']}{again}")


def save_evaluation(folder: Path, evaluation: Evaluation, about: dict[str, Any]) -> None:
    """Write an evaluation into a folder: what reports are made of.

    `evaluation.json` (rows, and `about`), `episodes.parquet` (the rows as a table), and
    `shown.safetensors` with the episode that pictures show.
    """
    make_folder(folder)
    rows = [{"driver": label, **row} for label, found in evaluation.rows.items() for row in found]
    frame = pd.DataFrame([{**row, "seed": str(row["seed"])} for row in rows])
    arrays = {}
    for number, episode in enumerate(evaluation.shown.values()):
        for name in PICTURED:
            arrays[f"{number}.{name}"] = getattr(episode, name).astype(np.float32)
    about_shown = [
        {
            "driver": label,
            "step": episode.step,
            "seed": list(episode.seed),
            "drawn": episode.drawn,
            "loop_length": episode.loop_length,
            "crossings": episode.crossings,
            "branches": episode.branches,
            "limit_speed": episode.limit_speed,
            "vehicle_ids": episode.vehicle_ids,
            "cav_ids": episode.cav_ids,
        }
        for label, episode in evaluation.shown.items()
    ]
    write_whole(folder / "shown.safetensors", save(arrays))
    write_whole(folder / "episodes.parquet", frame.to_parquet())
    write_whole(folder / "evaluation.json", to_json({**about, "rows": rows, "shown": about_shown}, indent=1))
