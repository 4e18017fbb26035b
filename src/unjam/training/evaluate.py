"""Drivers on fixed seeds, several on the same traffic: driven, judged, saved for reports.

`unjam drive` takes any drivers and seeds; a run's controller is judged beside others on held-out seeds.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from safetensors.numpy import save

from unjam.controller import make_driver
from unjam.drivers.driver import Driver
from unjam.drivers.registry import driver_names, free_label
from unjam.errors import InputError, wrong
from unjam.files import make_folder, to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.drivable import verdicts
from unjam.measures.metrics import METRICS, measure
from unjam.measures.statistics import Estimate, summarise
from unjam.reports.html import write_report
from unjam.reports.results import PICTURED
from unjam.scenarios import make_scenario
from unjam.scenarios.scenario import Scenario
from unjam.training.config import RunConfig
from unjam.training.executors import error_named
from unjam.training.folder import make_new_folder
from unjam.training.seeds import held_out_seeds
from unjam.worlds.episode import can_drive
from unjam.worlds.record import Episode
from unjam.worlds.reward import make_reward
from unjam.worlds.workers import EpisodeTask, Workers

TRAINED = "trained"
"""label of the trained controller in tables and pictures"""
ABOUT_SHOWN = (
    *("step", "seed", "drawn", "loop_length", "crossings", "branches", "limit_speed"),
    *("vehicle_ids", "cav_ids"),
)
"""what is written of an episode that pictures show, beside its arrays"""

Progress = Callable[[tuple[str, int], int], None]
"""called now and then with (the driver's label, the index of its episode), and the decisions made so far"""
Rows = dict[str, list[dict[str, Any]]]
"""by driver: a row of metrics per episode, failed ones too"""


@dataclass(frozen=True)
class Evaluation:
    """Several drivers on the same episodes."""

    rows: Rows
    shown: dict[str, Episode] = field(repr=False)
    """by driver: the episode that pictures show, the same seed for all"""

    def means(self) -> dict[str, dict[str, float]]:
        """Return the mean of each metric, by driver."""
        return {
            label: {name: found.mean for name, found in summarise(rows).items()}
            for label, rows in self.rows.items()
        }


def evaluate(
    scenario: Scenario,
    drivers: dict[str, Driver],
    seeds: Sequence[tuple[int, ...]],
    workers: Workers,
    reward: str = "",
    progress: Progress | None = None,
) -> Evaluation:
    """Run every driver on every seed, and measure."""
    on_road = {label: (scenario, driver) for label, driver in drivers.items()}
    return evaluate_each(on_road, seeds, workers, reward, progress)


def evaluate_each(
    drivers: dict[str, tuple[Scenario, Driver]],
    seeds: Sequence[tuple[int, ...]],
    workers: Workers,
    reward: str = "",
    progress: Progress | None = None,
    pictured: bool = True,
) -> Evaluation:
    """Run every driver, each on a road of its own, on every seed, and measure.

    An episode of each is kept for pictures; not so where none are `pictured`, for it needs much memory.
    """
    pairs = [(label, index) for index in range(len(seeds)) for label in drivers]
    tasks = [EpisodeTask(*drivers[label], seeds[index], reward, full=True) for label, index in pairs]

    def on_progress(task: int, steps: int) -> None:
        if progress is not None:
            progress(pairs[task], steps)

    def measured(task: int, episode: Episode) -> tuple[dict[str, Any], Episode | None]:
        _, index = pairs[task]
        return measure(episode), episode if pictured and index == 0 and episode.ok else None

    rows: Rows = {label: [] for label in drivers}
    shown: dict[str, Episode] = {}
    for (label, _), (row, episode) in zip(pairs, workers.run_each(tasks, measured, on_progress), strict=True):
        rows[label].append(row)
        if episode is not None:
            shown[label] = episode
    return Evaluation(rows, shown)


def raise_failure(rows: Sequence[dict[str, Any]]) -> None:
    """Raise the first failure among the rows of episodes, as the error that it was."""
    for row in rows:
        if row["status"] == "failed":
            again = "" if row["error"] == InputError.__name__ else f" (seed {row['seed']})"
            raise error_named(row["error"], f"{row['reason']}{again}")


def raise_failures(result: "Evaluation | DriveResult") -> None:
    """Raise the first failure among the episodes of a result, if there is one."""
    raise_failure([row for rows in result.rows.values() for row in rows])


def save_evaluation(folder: Path, evaluation: Evaluation, about: dict[str, Any]) -> None:
    """Write an evaluation into a folder: what reports are made of.

    `evaluation.json` (rows, and `about`), `episodes.parquet` (the rows as a table), and
    `shown.safetensors` with the episode that pictures show.
    """
    make_folder(folder)
    rows = [{"driver": label, **row} for label, found in evaluation.rows.items() for row in found]
    frame = pd.DataFrame([{**row, "seed": str(row["seed"])} for row in rows])
    arrays = {
        f"{number}.{name}": getattr(episode, name).astype(np.float32)
        for number, episode in enumerate(evaluation.shown.values())
        for name in PICTURED
    }
    about_shown = [
        {"driver": label, **{name: getattr(episode, name) for name in ABOUT_SHOWN}}
        for label, episode in evaluation.shown.items()
    ]
    write_whole(folder / "shown.safetensors", save(arrays))
    write_whole(folder / "episodes.parquet", frame.to_parquet())
    write_whole(folder / "evaluation.json", to_json({**about, "rows": rows, "shown": about_shown}, indent=1))


def comparison(config: RunConfig, folder: Path, baselines: Sequence[str]) -> dict[str, Driver]:
    """Return the drivers to compare, by label: the baselines, the run's expert, its trained controller."""
    scenario = config.make_scenario()
    expert = {} if config.expert == "none" else {(made := config.make_expert()).describe(): made}
    drivers: dict[str, Driver] = {}
    for name in baselines:
        driver = make_driver(name, scenario.decision_step)
        if can_drive(driver, scenario):
            drivers[free_label(driver, {**expert, **drivers})] = driver
    return {**drivers, **expert, TRAINED: make_driver(str(folder), scenario.decision_step)}


def judge(
    folder: Path,
    config: RunConfig,
    workers: Workers,
    baselines: Sequence[str] | None = None,
    episodes: int | None = None,
    progress: Progress | None = None,
    out: Path | None = None,
) -> Evaluation:
    """Evaluate a run's controller beside others on the same held-out seeds, and save it all in its folder.

    `baselines` and `episodes` are the configuration's where they are not given; with `out` that is the folder
    where it is saved.
    """
    scenario = config.make_scenario()
    drivers = comparison(config, folder, config.evaluation.baselines if baselines is None else baselines)
    seeds = held_out_seeds(episodes or config.evaluation.episodes)
    found = evaluate(scenario, drivers, seeds, workers, config.reward, progress)
    about = {
        "scenario": Path(config.scenario).name,
        "reward": config.reward or scenario.reward,
        "trained": TRAINED,
        "expert": config.make_expert().describe() if config.expert != "none" else "none",
        "manifest": manifest(),
    }
    save_evaluation(out or folder, found, about)
    raise_failures(found)
    return found


@dataclass(frozen=True)
class DriveResult:
    """Episodes of one or several drivers on the same traffic."""

    scenario: str
    rows: Rows
    folder: Path | None = None
    """where everything was written"""
    report: Path | None = None

    @property
    def mean(self) -> dict[str, float]:
        """Mean of every metric over the episodes of the first driver."""
        return {name: found.mean for name, found in self.summary(next(iter(self.rows))).items()}

    def summary(self, driver: str) -> dict[str, Estimate]:
        """Return mean and 95 % bootstrap interval of every metric for a driver."""
        return summarise(self.rows[driver])

    def document(self) -> dict[str, Any]:
        """Return the result as `unjam drive --json` prints it; of several drivers, a list of such."""
        documents = [self._document(driver) for driver in self.rows]
        return documents[0] if len(documents) == 1 else {"scenario": self.scenario, "drivers": documents}

    def _document(self, driver: str) -> dict[str, Any]:
        summary = self.summary(driver)
        return {
            "scenario": self.scenario,
            "driver": driver,
            "drivable": verdicts(self.rows)[driver],
            "episodes": self.rows[driver],
            "mean": {name: summary[name].mean for name in METRICS},
            "interval": {name: [summary[name].low, summary[name].high] for name in METRICS},
            "folder": str(self.folder) if self.folder else None,
            "report": str(self.report) if self.report else None,
        }


def drive(
    scenario: str = "ring",
    driver: str | Driver | Sequence[str | Driver] = "pi",
    episodes: int = 5,
    seed: int = 0,
    road: dict[str, Any] | None = None,
    reward: str = "",
    workers: int | None = None,
    out: Path | str | None = None,
    progress: Callable[[Any, int], None] | None = None,
    held_out: bool = False,
) -> DriveResult:
    """Run episodes and measure them.

    Args:
        scenario: its name.
        driver: a name (`pi`), with parameters (`pi:window=30`), your own (`path.py:name`), a run folder, a
            `.unjam` file, or a driver; or several of them, to be compared on the same traffic.
        episodes: of each driver; they have the seeds `seed`, `seed + 1`, ...
        seed: of the first episode.
        road: changes to the scenario's parameters, e.g. `{"length": (230, 230)}`.
        reward: a name or `path.py:name`; empty: the scenario's own.
        workers: processes; all cores by default. The result does not depend on it.
        out: folder for the results and a report.html; None: nothing is written.
        progress: told now and then how many decisions an episode has made.
        held_out: on the seeds that judge trainings, instead of `seed` and those after it.

    Raises:
        InputError: something is wrong with the arguments; nothing was started.
    """
    for name, number, least in (("episodes", episodes, 1), ("seed", seed, 0), ("workers", workers, 1)):
        if number is not None and number < least:
            raise wrong(name, number, f">= {least}")
    if held_out and seed:
        raise wrong("seed", seed, "none with held-out seeds")
    made = make_scenario(scenario, road)
    drivers: dict[str, Driver] = {}
    for entry in [driver] if isinstance(driver, (str, Driver)) else driver:
        if isinstance(entry, str):
            drivers[entry] = make_driver(entry, made.decision_step)
        else:
            drivers[free_label(entry, drivers)] = entry
    if not drivers:
        raise wrong("driver", driver, driver_names())
    make_reward(reward or made.reward)
    folder = Path(out) if out is not None else None
    if folder is not None:
        make_new_folder(folder)

    seeds = held_out_seeds(episodes) if held_out else [(seed + index,) for index in range(episodes)]
    with Workers(min(workers or os.cpu_count() or 1, episodes * len(drivers))) as pool:
        found = evaluate(made, drivers, seeds, pool, reward, progress)
    report = None
    if folder is not None:
        about = {"scenario": Path(scenario).name, "reward": reward or made.reward, "manifest": manifest()}
        save_evaluation(folder, found, about)
        report = write_report([folder], folder / "report.html")
    return DriveResult(scenario, found.rows, folder, report)
