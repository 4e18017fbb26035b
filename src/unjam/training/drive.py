"""`unjam drive`: any drivers on any seeds, with the result as tables and figures, also in notebooks."""

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from html import escape
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from unjam.controller import make_driver
from unjam.controller.domain import controller_notes
from unjam.drivers.driver import Driver
from unjam.drivers.registry import driver_names, unique_label
from unjam.drivers.user_driver import DriverLike, as_driver
from unjam.errors import InputError, invalid_value, unknown_name
from unjam.manifest import manifest
from unjam.measures.effect import effects_by_driver
from unjam.measures.feasibility import feasibility_by_driver
from unjam.measures.metric_table import choose_baseline, order_by_rank
from unjam.measures.metrics import METRICS
from unjam.measures.notes import count_early_ends, episode_notes
from unjam.measures.statistics import Estimate, paired_difference
from unjam.measures.verdict import metric_frame, short_table_metrics, verdicts
from unjam.parameters import check_integer
from unjam.reports.results import to_plot_episode
from unjam.scenarios import make_scenario, scenario_recipe
from unjam.scenarios.scenario import Scenario
from unjam.seeds import TRAINING_SEED_LIMIT, held_out_seeds
from unjam.training.evaluate import Evaluation, controller_hashes, evaluate, rows_to_frame, save_evaluation
from unjam.training.run_folder import check_controllers, lock_new_folder
from unjam.worlds.backend import BackendLike, backend_notes, check_support, open_backend
from unjam.worlds.checked_world import backend_label
from unjam.worlds.episode import check_can_drive
from unjam.worlds.reward import RewardLike, make_reward, reward_label
from unjam.worlds.worker_pool import WorkerPool

if TYPE_CHECKING:  # imported late, so that commands start quickly
    import pandas as pd
    from matplotlib.figure import Figure

EFFECT_ENTRIES = ("travel_time", "delay_reduction", "speed", "flow", "fuel", "hard_braking")
MISSING_ACC_NOTE = "limits the ACC of a CAV, but CAVs have none: --set actuation=cruise --set safety.active=false"


@dataclass(frozen=True)
class DriveResult(Evaluation):
    """Episodes of one or several drivers in the same traffic, and the folder with their files."""

    scenario: str = ""
    backend: str = "sumo"
    folder: Path | None = None
    report: Path | None = None
    notes: list[str] = field(default_factory=list)
    """caveats, such as a controller on a road for which it was not made"""
    baseline: str = ""
    """label of the driver with which the others are compared; empty: human drivers, or else the best expert"""
    first_driver: str = ""
    """label of the first driver in the call; empty: the driver of the first rows"""

    @property
    def mean(self) -> dict[str, float]:
        """Mean of every metric over the episodes of the first driver."""
        return self.means()[self.first_driver or next(iter(self.rows))]

    def table(self, brief: bool = False) -> "pd.DataFrame":
        """Return a row per metric, or with `brief` per important metric, with mean and 95 % CI limits of each driver.

        `result.table().loc["mean_speed", ("pi", "mean")]` is one number.
        """
        import pandas as pd

        names = short_table_metrics(self.rows) if brief else tuple(METRICS)
        summaries = {label: self.summary(label) for label in self.rows}
        columns = {
            (label, statistic): [getattr(summary[name], statistic) for name in names]
            for label, summary in summaries.items()
            for statistic in ("mean", "low", "high")
        }
        frame = pd.DataFrame(columns, index=pd.Index(names, name="metric"))
        return frame.rename_axis(columns=("driver", None))

    def episodes(self) -> "pd.DataFrame":
        """Return a row per episode and driver, with seed, status and every metric."""
        return rows_to_frame(self.rows)

    def __str__(self) -> str:
        """Return the verdicts and the table of the important metrics, for `print`."""
        lines = (line for verdict in verdicts(self.rows, self.baseline) for line in verdict.lines)
        return "\n".join([*lines, metric_frame(self.rows).to_string(index=False)])

    def _repr_html_(self) -> str:
        """Return the verdicts, the important metrics, and the trajectories of all vehicles, for notebooks."""
        from unjam.reports.figures import data_uri

        paragraphs = ("<br>".join(map(escape, verdict.lines)) for verdict in verdicts(self.rows, self.baseline))
        page = "".join(f"<p>{text}</p>" for text in paragraphs) + metric_frame(self.rows).to_html(index=False, border=0)
        if not self.plot_episodes:
            return page
        attributes = 'style="max-width: 100%" alt="every vehicle over time, dark is slow"'
        return f'{page}<img {attributes} src="{data_uri(self.plot())}">'

    def plot(self, kind: Literal["space-time", "time-series"] = "space-time") -> "Figure":
        """Return a figure of an episode of each driver: positions and speeds of all vehicles, or quantities over time.

        Raise `InputError` if all episodes failed, or for another `kind`.
        """
        from unjam.reports.figures import time_series_figure
        from unjam.reports.space_time import space_time_figure

        figures = {"space-time": space_time_figure, "time-series": time_series_figure}
        if kind not in figures:
            raise unknown_name("kind", kind, figures)
        if not self.plot_episodes:
            raise InputError("plot: all episodes failed; allowed: results with an episode")
        return figures[kind]([to_plot_episode(label, episode) for label, episode in self.plot_episodes.items()])

    def document(self) -> dict[str, Any]:
        """Return the result as `unjam drive --json` prints it, with a list of documents, one for each driver."""
        feasibility, effects = feasibility_by_driver(self.rows), effects_by_driver(self.rows)
        baseline, documents = choose_baseline(self.rows, self.baseline), list[dict[str, Any]]()
        for driver, rows in self.rows.items():
            summary, effect, differences = self.summary(driver), effects.get(driver), None
            if baseline and driver != baseline:
                paired = {name: paired_difference(rows, self.rows[baseline], name) for name in METRICS}
                differences = {name: _mean_and_limits(difference) for name, difference in paired.items()}
            effect_entries = {name: _mean_and_limits(getattr(effect, name)) for name in EFFECT_ENTRIES if effect}
            documents.append(
                {
                    "scenario": self.scenario,
                    "backend": self.backend,
                    "driver": driver,
                    "feasibility": feasibility[driver],
                    "episodes": rows,
                    "mean": {name: summary[name].mean for name in METRICS},
                    "ci95": {name: [summary[name].low, summary[name].high] for name in METRICS},
                    "effect": effect_entries or None,
                    "early_ends": count_early_ends(rows),
                    "notes": self.notes,
                    "folder": str(self.folder) if self.folder else None,
                    "report": str(self.report) if self.report else None,
                    "baseline": baseline or None,
                    "difference_to_baseline": differences,
                }
            )
        return {"scenario": self.scenario, "drivers": documents}


def _mean_and_limits(estimate: Estimate) -> list[float]:
    return [estimate.mean, estimate.low, estimate.high]


def _lacks_acc(driver: Driver, scenario: Scenario) -> bool:
    """Return whether a driver limits the ACC of CAVs by the speeds ahead, on a road where CAVs have no ACC."""
    road = scenario.interface
    uses_lane_speeds = "lane_speeds" in driver.requirements(road).input_fields and "lane_speeds" in road.provided_fields
    return uses_lane_speeds and scenario.actuation != "cruise"


def _set_speed_notes(drivers: Mapping[str, Driver], scenario: Scenario) -> list[str]:
    """Return a note for each driver with a set speed below recorded speeds, which saves fuel by falling behind."""
    recorded_speed = scenario.max_leader_speed
    suggested_speed = max(scenario.humans.desired_speed, ceil(recorded_speed))
    return [
        f"{label}: its set speed of {set_speed:g} m/s is below the recorded {recorded_speed:.1f} m/s: name another, "
        f"as in {driver.describe().partition(':')[0]}:set_speed={suggested_speed:g}"
        for label, driver in drivers.items()
        if isinstance(set_speed := getattr(driver, "set_speed", None), int | float) and set_speed < recorded_speed
    ]


def drive(
    scenario: str = "ring",
    driver: str | DriverLike | Sequence[str | DriverLike] = "pi",
    episodes: int = 5,
    seed: int = 0,
    scenario_options: dict[str, Any] | None = None,
    reward: RewardLike = "",
    workers: int | None = None,
    out: Path | str | None = None,
    progress: Callable[[Any, int], None] | None = None,
    test_seeds: bool = False,
    backend: BackendLike = "sumo",
    baseline: str = "",
) -> DriveResult:
    """Run episodes and measure them.

    Args:
        scenario: name of the scenario.
        driver: a name (`pi`), with parameters (`pi:window=30`), your own (`path.py:name`), a run folder, a `.unjam`
            file; a driver, a function of the state, an object with `act` and `initial_memory` or a class of such
            objects, which run in this process; or a list of them, to be compared in the same traffic.
        episodes: number for each driver; their seeds are `seed`, `seed + 1`, ...
        seed: seed of the first episode.
        scenario_options: changes to the scenario, e.g. `{"length": 230}` or `{"length": (220, 270)}`.
        reward: a name or `path.py:name`; a function of an `Outcome`, with which all episodes run in this process;
            empty: the reward of the scenario.
        workers: number of processes, by default that of the cores; the result does not depend on it.
        out: folder for the results and a report.html; None: nothing is written.
        progress: called repeatedly with ((driver, episode), control steps so far).
        test_seeds: whether to use the test seeds instead of `seed` and the following ones.
        backend: the simulator: `sumo`, `batch`, `path.py:name`, or an object, with which all episodes run in this
            process.
        baseline: label of the driver with which the others are compared; empty: human drivers, or else the best expert.

    Raises:
        InputError: an argument is wrong; no episode was started.
    """
    integers = ("episodes", episodes, 1), ("seed", seed, 0), ("workers", 1 if workers is None else workers, 1)
    for name, value, minimum in integers:
        check_integer(name, value, minimum)
    if seed + episodes > TRAINING_SEED_LIMIT:
        raise invalid_value("seed", seed, f"<= {TRAINING_SEED_LIMIT - episodes}: larger ones are reserved")
    if test_seeds and seed:
        raise invalid_value("seed", seed, "none with test seeds")
    road = make_scenario(scenario, scenario_options)
    drivers: dict[str, Driver] = {}
    for entry in [driver] if isinstance(driver, str) or not isinstance(driver, Sequence) else driver:
        if isinstance(entry, str):
            drivers[entry] = make_driver(entry, road.control_step)
            check_controllers(entry, "drive")
        else:
            user_driver = as_driver(entry, road.control_step)
            drivers[unique_label(user_driver, drivers)] = user_driver
    hashes = controller_hashes({label: label for label in drivers})  # before the episodes: files may change meanwhile
    for label, labeled_driver in drivers.items():
        check_can_drive(labeled_driver, road, f"driver {label}")
    if not drivers:
        raise invalid_value("driver", driver, driver_names())
    if baseline and baseline not in drivers:
        raise unknown_name("baseline", baseline, drivers)
    make_reward(reward or road.reward)
    with open_backend(backend) as simulator:
        check_support(simulator, road)
    folder, report = Path(out) if out is not None else None, None
    seeds = held_out_seeds(episodes) if test_seeds else [(seed + index,) for index in range(episodes)]
    pool = WorkerPool(min(workers or os.cpu_count() or 1, episodes * len(drivers)))
    with lock_new_folder(folder) if folder is not None else nullcontext(), pool:
        evaluation = evaluate(road, order_by_rank(drivers), seeds, pool, reward, progress, backend)
        notes = [
            *episode_notes(evaluation.rows),
            *controller_notes(scenario_recipe(road), drivers, evaluation.plot_episodes),
            *(f"{label} {MISSING_ACC_NOTE}" for label in drivers if _lacks_acc(drivers[label], road)),
            *_set_speed_notes(drivers, road),
            *backend_notes(backend, road),
            *road.notes,
        ]
        has_results = any(row["status"] != "failed" for rows in evaluation.rows.values() for row in rows)
        if folder is not None and has_results:
            labels = {"reward": reward_label(reward or road.reward), "backend": backend_label(backend)}
            metadata = {"scenario": Path(scenario).name, **labels, "manifest": manifest(), "controllers": hashes}
            save_evaluation(folder, evaluation, {**metadata, "notes": notes, "baseline": baseline})
            from unjam.reports.html import write_report_page  # imported late: it draws

            report = write_report_page([folder], folder / "report.html")
    return DriveResult(
        evaluation.rows,
        evaluation.plot_episodes,
        scenario=scenario,
        backend=backend_label(backend),
        folder=folder if has_results else None,
        report=report,
        notes=notes,
        baseline=baseline,
        first_driver=next(iter(drivers)),
    )
