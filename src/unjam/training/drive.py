"""Drive: episodes of one or several drivers, measured, with a report. `unjam drive` and `unjam.drive`."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from unjam.controller import make_driver
from unjam.drivers.driver import Driver
from unjam.drivers.registry import driver_names, free_label
from unjam.errors import InputError, wrong
from unjam.files import make_folder
from unjam.manifest import manifest
from unjam.measures.metrics import METRICS
from unjam.measures.statistics import Estimate, summarise
from unjam.reports.html import write_report
from unjam.scenarios.registry import make_scenario
from unjam.training.evaluate import evaluate, held_out_seeds, raise_failure, save_evaluation
from unjam.worlds.reward import make_reward
from unjam.worlds.workers import Workers


@dataclass(frozen=True)
class DriveResult:
    """Episodes of one or several drivers on the same traffic."""

    scenario: str
    rows: dict[str, list[dict[str, Any]]]
    """by driver: a row of metrics per episode"""
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
        documents = []
        for driver, rows in self.rows.items():
            summary = self.summary(driver)
            documents.append(
                {
                    "scenario": self.scenario,
                    "driver": driver,
                    "episodes": rows,
                    "mean": {name: summary[name].mean for name in METRICS},
                    "interval": {name: [summary[name].low, summary[name].high] for name in METRICS},
                    "folder": str(self.folder) if self.folder else None,
                    "report": str(self.report) if self.report else None,
                }
            )
        return documents[0] if len(documents) == 1 else {"scenario": self.scenario, "drivers": documents}


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
    given = [driver] if isinstance(driver, (str, Driver)) else list(driver)
    drivers: dict[str, Driver] = {}
    for entry in given:
        if isinstance(entry, str):
            drivers[entry] = make_driver(entry, made.decision_step)
        else:
            drivers[free_label(entry, drivers)] = entry
    if not drivers:
        raise wrong("driver", driver, driver_names())
    make_reward(reward or made.reward)
    folder = Path(out) if out is not None else None
    if folder is not None and folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"out: {str(folder)!r} is not empty; allowed: a new folder")
    if folder is not None:
        make_folder(folder)

    seeds = held_out_seeds(episodes) if held_out else [(seed + index,) for index in range(episodes)]
    with Workers(min(workers or os.cpu_count() or 1, episodes * len(drivers))) as pool:
        found = evaluate(made, drivers, seeds, pool, reward, progress)
    report = None
    if folder is not None:
        about = {"scenario": Path(scenario).name, "reward": reward or made.reward, "manifest": manifest()}
        save_evaluation(folder, found, about)
        report = write_report([folder], folder / "report.html")
    return DriveResult(scenario, found.rows, folder, report)


def raise_failures(result: DriveResult) -> None:
    """Raise the first failure among the episodes of a result, if there is one."""
    raise_failure([row for rows in result.rows.values() for row in rows])
