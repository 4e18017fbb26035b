"""Building blocks of studies: planned and finished runs, the folder that holds them, and the table of drivers."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields
from functools import cached_property
from itertools import product
from math import ceil, inf, nan
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from unjam.controller import make_driver
from unjam.drivers.driver import Driver
from unjam.errors import InputError, raise_failure
from unjam.files import atomic_write, make_folder, read_json_object, remove
from unjam.manifest import manifest, strip_folders
from unjam.measures.feasibility import FEASIBLE, feasibility_by_driver
from unjam.measures.metric_table import estimate_cell, use_no_break_spaces
from unjam.measures.metrics import measure
from unjam.measures.statistics import Estimate, estimate, estimate_on_shared_seeds, estimate_over_trainings, format_ci
from unjam.reports.results import CONTROLLER_FILE, EVALUATION_FILE, is_outdated, read_evaluation, read_rows
from unjam.road_family import NO_LATENCY
from unjam.scenarios.scenario import Scenario
from unjam.seeds import held_out_seeds
from unjam.training.config import RunConfig, load_config
from unjam.training.evaluate import TRAINED_LABEL, evaluate, raise_failures
from unjam.training.run_folder import check_controller, read_complete_progress, read_config
from unjam.worlds.batch.run import run_batches
from unjam.worlds.record import Episode, Floats
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool
from unjam_paper.results_file import CONTROLLERS, StudyPart, measure_parts, write_figure, write_part
from unjam_paper.variants import VARIANTS

IDEAL_CAVS: dict[str, Any] = {"scenario_options.actuator": NO_LATENCY}
"""as in the paper, CAVs obey at once"""
STUDY_ROADS: dict[str, dict[str, Any]] = {
    **{name: {"scenario": name, **IDEAL_CAVS} for name in ("ring", "ring-jammed", "figure-eight", "merge")},
    "on-ramp": {"scenario": "on-ramp", "scenario_options.penetration_rate": 0.05},
    **{f"{name}-usual-car": {"scenario": name} for name in ("ring", "ring-jammed", "figure-eight")},
    **{name: {"scenario": "ring"} for name in ("rings", "shared-rings", "all-roads")},
    "ring-11": {"scenario": "ring", "scenario_options.vehicles": 11, **IDEAL_CAVS},
    "ring-5": {"scenario": "ring", "scenario_options.vehicles": 5, **IDEAL_CAVS},
}
UNFILTERED_ROADS = {road: f"{road}-unfiltered" for road in ("ring", "figure-eight", "ring-11", "ring-5")}
"""roads as in the paper, without the safety filter, by the road with it; the merge never has one"""
UNSCALED_NOISE_ROAD = "ring-unfiltered-unscaled-noise"
"""... and with the noise of Table B1 in each step, not times the square root of the step as in Flow"""
NO_FILTER = {"scenario_options.safety.active": False}
STUDY_ROADS |= {name: STUDY_ROADS[road] | NO_FILTER for road, name in UNFILTERED_ROADS.items()}
STUDY_ROADS[UNSCALED_NOISE_ROAD] = {**STUDY_ROADS[UNFILTERED_ROADS["ring"]], "scenario_options.noise_scaling": "none"}
ORIGINAL_ROADS = {**{each: road for road, each in UNFILTERED_ROADS.items()}, UNSCALED_NOISE_ROAD: "ring"}
"""the road with the filter, by its version without"""
PAPER_ROADS = ("ring", "figure-eight", "merge")
FINAL_SHARE = 0.1
"""share of the iterations at the end of a training, over which the convention of the paper averages"""
NO_VALUE_TEXT = "–"

Table = list[dict[str, Any]]
"""rows of results, or of the metrics of episodes"""
DriverSource = str | Path | Callable[[Any], Driver]
"""name of a driver, folder of a training, or a function that makes a driver for a scenario"""


@dataclass(frozen=True)
class PlannedRun:
    """A training that a study needs."""

    road: str
    """a name in `STUDY_ROADS`"""
    variant: str
    """a name in `VARIANTS`"""
    seed: int

    @property
    def name(self) -> str:
        """Path of the training, relative to the folder of all trainings."""
        return f"{self.road}/{self.variant}/{self.seed}"

    @cached_property
    def config(self) -> RunConfig:
        """Configuration with one worker and without baselines, which would be the same in all trainings."""
        variant = VARIANTS[self.variant]
        changes = {**STUDY_ROADS[self.road], "seed": self.seed, "workers": 1, "evaluation.baselines": []}
        steps = {} if variant.steps is None else {"steps": variant.steps}
        return load_config(preset=variant.preset, changes={**changes, **variant.changes, **steps})


def planned_runs(roads: Iterable[str], variants: Sequence[str], seeds: int) -> list[PlannedRun]:
    """Return the runs of all variants on all roads, ordered by seed."""
    return [PlannedRun(road, variant, seed) for seed, road, variant in product(range(seeds), tuple(roads), variants)]


@dataclass(frozen=True)
class TrainedRun:
    """A finished training."""

    run: PlannedRun
    progress: Table
    rows: Table
    """metrics of the trained controller, deterministic, on test seeds"""

    def final_training_mean(self, name: str) -> float:
        """Return the mean of a number of the training batches, exploration included, over the last tenth of them."""
        last = self.progress[-ceil(FINAL_SHARE * len(self.progress)) :]
        return float(np.mean([row[name] for row in last]))

    @property
    def seconds(self) -> float:
        """Wall time of all iterations [s]."""
        return float(sum(sum(row["seconds"].values()) for row in self.progress))


@dataclass(frozen=True)
class StudyFolder:
    """The folder with the trainings and reference evaluations of all studies; it need not exist yet."""

    folder: Path

    def run_folder(self, run: PlannedRun) -> Path:
        """Return the folder of a training."""
        return self.folder / "runs" / run.name

    def controller_folder(self, run: PlannedRun) -> Path:
        """Return the folder of its controller: that of the first road where one network drives several."""
        return self.run_folder(run) / next(iter(run.config.task_configs()))

    def copy_controllers(self, runs: Iterable[PlannedRun], study: Path) -> None:
        """Copy the controllers of trainings into the folder of a study, as controllers/VARIANT-SEED.unjam."""
        controllers = {f"{run.variant}-{run.seed}.unjam": self.controller_folder(run) / CONTROLLER_FILE for run in runs}
        make_folder(study / CONTROLLERS)
        for file in (study / CONTROLLERS).glob("*.unjam"):
            if file.name not in controllers:  # more trainings were in the study before
                remove(file)
        for name, controller in controllers.items():
            atomic_write(study / CONTROLLERS / name, controller.read_bytes())

    def reference_folder(self, road: str) -> Path:
        """Return the folder with the evaluation of the reference drivers on a road."""
        return self.folder / "references" / road

    def is_finished(self, run: PlannedRun) -> bool:
        """Return whether a training with these settings is finished, and its controller is evaluated.

        Raise `InputError` if its progress is cut, or if a controller is not the one that it trained.
        """
        folder = self.run_folder(run)
        evaluated = [folder / road for road in run.config.task_configs()]
        if not all((part / EVALUATION_FILE).is_file() for part in evaluated) or read_config(folder) != run.config:
            return False
        for part in evaluated:
            check_controller(part, "reproduce")
        return bool(read_complete_progress(folder)) and all(_has_evaluation(part, run.config) for part in evaluated)

    def trained_runs(self, road: str, variants: Iterable[str], seeds: int) -> dict[str, list[TrainedRun]]:
        """Return the finished trainings on a road by variant, one for each seed."""
        runs: dict[str, list[TrainedRun]] = {variant: [] for variant in variants}
        for run in planned_runs([road], tuple(runs), seeds):
            folder = self.run_folder(run)
            runs[run.variant].append(TrainedRun(run, read_complete_progress(folder), read_rows(folder)[TRAINED_LABEL]))
        return runs

    def reference_rows(self, road: str) -> dict[str, Table]:
        """Return the rows of the reference drivers on the test seeds, by label."""
        return read_rows(self.reference_folder(road))


@dataclass(frozen=True)
class Study:
    """A study: which trainings it needs, what it measures and writes, and the tables of its page."""

    title: str
    make_runs: Callable[[int], list[PlannedRun]] = lambda seeds: []
    """returns the trainings for a number of seeds"""
    make_parts: Callable[[StudyFolder, int], dict[str, StudyPart]] = lambda study_folder, seeds: {}
    """returns what can be measured with the results so far, by name of the part, or as PART/ENTRY; arguments: folder of
    all studies, seeds"""
    write: Callable[[StudyFolder, int, Path], None] = lambda study_folder, seeds, folder: None
    """writes parts that need no measurement, and figures of trainings; the last argument is the folder of this study"""
    roads: tuple[str, ...] = ()
    """roads on which the reference drivers are evaluated"""
    minutes: float = 0.0
    """duration of `run` on two cores"""
    tables: Mapping[str, Callable[[Path], pd.DataFrame]] = field(default_factory=dict)
    """tables of its page by name, made from its results"""
    figures: Mapping[str, Callable[[Path], Figure]] = field(default_factory=dict)
    """figures of its page by name, made from its results"""

    def run(self, study_folder: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
        """Measure parts without current results until there are no more, and write everything into `folder`."""
        parts: dict[str, StudyPart] = {}
        while (planned := self.make_parts(study_folder, seeds)) != parts:
            parts = planned
            for name, part in measure_parts(folder / "parts", parts, workers).items():
                write_part(folder, name, part)
        self.write(study_folder, seeds, folder)
        for name, table in self.tables.items():
            atomic_write(folder / f"{name}.csv", table(folder).to_csv(index=False))
        for name, draw in self.figures.items():
            write_figure(folder, name, draw(folder))


def _has_evaluation(folder: Path, config: RunConfig) -> bool:
    """Return whether a folder has an evaluation of the controller in it with the episodes of the configuration."""
    with suppress(InputError):  # it is damaged
        metadata, rows = read_evaluation(folder)
        episodes = len(rows.get(TRAINED_LABEL, ()))
        return episodes == config.evaluation.episodes and not is_outdated(folder, metadata)
    return False


def write_manifest(folder: Path, **metadata: Any) -> None:
    """Write the manifest of a study: that of its first call with this `metadata`, and all resumptions."""
    make_folder(folder)
    about, file = manifest(), folder / "manifest.json"
    about["command"] = strip_folders(about["command"])
    if file.is_file():
        resumption = {name: about[name] for name in ("commit", "started")}
        about = read_json_object(file)
        about["resumptions"] = [*about.get("resumptions", []), resumption]
    write_part(folder, "manifest", {**about, **metadata})


def measure_tasks(
    tasks: Sequence[EpisodeTask], workers: int, make_row: Callable[[int, Episode, dict[str, Any]], dict[str, Any]]
) -> Table:
    """Return a row for each task, made from its number, episode and metrics; raise the first failure."""

    def measured_row(number: int, episode: Episode) -> dict[str, Any]:
        metrics = measure(episode)
        raise_failure([metrics])
        return make_row(number, episode, metrics)

    with WorkerPool(workers) as pool:
        return pool.run_and_map(tasks, measured_row)


def evaluate_drivers(
    scenario: Scenario, drivers: Mapping[str, DriverSource], seeds: int, workers: int
) -> dict[str, Table]:
    """Return the rows of drivers on the same test seeds, by label."""
    with WorkerPool(workers) as pool:
        evaluation = evaluate(scenario, make_drivers(scenario, drivers), held_out_seeds(seeds), pool)
    raise_failures(evaluation)
    return evaluation.rows


def make_drivers(scenario: Scenario, drivers: Mapping[str, DriverSource]) -> dict[str, Driver]:
    """Return the drivers for a scenario, by label."""
    return {
        label: source(scenario) if callable(source) else make_driver(str(source), scenario.control_step)
        for label, source in drivers.items()
    }


def evaluate_metrics(
    scenario: Scenario, drivers: Mapping[str, DriverSource], seeds: int, metrics: Sequence[str], workers: int
) -> dict[str, Any]:
    """Return the verdict on each driver, relative to `human`, and these metrics of its episodes on test seeds."""
    return _metrics_of(evaluate_drivers(scenario, drivers, seeds, workers), metrics)


def evaluate_in_batches(
    scenario: Scenario, drivers: Mapping[str, DriverSource], seeds: int, metrics: Sequence[str], workers: int
) -> dict[str, Any]:
    """Return the result of `evaluate_metrics` without fuel, from batches: their episodes equal those of SUMO."""
    test_seeds = held_out_seeds(seeds)
    rows = {
        label: [*map(measure, run_batches([EpisodeTask(scenario, driver, seed) for seed in test_seeds]))]
        for label, driver in make_drivers(scenario, drivers).items()
    }
    return _metrics_of(rows, metrics)


def _metrics_of(rows: dict[str, Table], metrics: Sequence[str]) -> dict[str, Any]:
    verdicts = feasibility_by_driver(rows)
    return {
        label: {"feasibility": verdicts[label], "episodes": [{name: row[name] for name in metrics} for row in own]}
        for label, own in rows.items()
    }


@dataclass(frozen=True)
class DriverComparison:
    """What `evaluate_metrics` returned for the same drivers on one or several roads."""

    roads: Sequence[Mapping[str, Any]]

    def groups(self, trainings: Mapping[str, str]) -> dict[str, list[str]]:
        """Return the drivers of each row of a table: all `trainings`, PREFIX SEED, in one with a name, others alone."""
        groups = {label: [label] for label in self.roads[0] if label.rpartition(" ")[0] not in trainings}
        for prefix, name in trainings.items():
            own = [label for label in self.roads[0] if label.rpartition(" ")[0] == prefix]
            groups |= {f"{name}, {len(own)} trainings": own} if own else {}
        return groups

    def values(self, labels: Sequence[str], metric: str) -> Floats:
        """Return a metric of drivers, shape (roads, drivers, seeds)."""
        rows = [[[row[metric] for row in road[label]["episodes"]] for label in labels] for road in self.roads]
        return np.array(rows, np.float64)

    def mean(self, labels: Sequence[str], metric: str, digits: int) -> str:
        """Return the mean over all episodes as text; a dash if no episode has the metric."""
        values = self.values(labels, metric)
        return NO_VALUE_TEXT if np.isnan(values).all() else f"{np.nanmean(values):.{digits}f}"

    def difference(self, labels: Sequence[str], baseline: str, metric: str, digits: int) -> str:
        """Return the paired difference to another driver, averaged over the roads, with its 95 % CI."""
        if list(labels) == [baseline]:
            return NO_VALUE_TEXT
        values = (self.values(labels, metric) - self.values([baseline], metric)).mean(0)
        return estimate_text(estimate_on_shared_seeds(values), digits, "+")

    def min_time_gap(self, labels: Sequence[str]) -> str:
        """Return the minimum time gap of all episodes; a dash if no vehicle was faster than 1 m/s."""
        minimum = np.nanmin(self.values(labels, "min_time_gap"), initial=inf)
        return NO_VALUE_TEXT if minimum == inf else f"{minimum:.2f}"

    def verdicts(self, labels: Sequence[str]) -> list[str]:
        """Return the verdicts on drivers on all roads."""
        return [road[label]["feasibility"] for label in labels for road in self.roads]

    def feasibility(self, labels: Sequence[str]) -> str:
        """Return `yes` if drivers are feasible on all roads, else the first reason against it."""
        reasons = (verdict for verdict in self.verdicts(labels) if verdict != FEASIBLE)
        return next((reason or NO_VALUE_TEXT for reason in reasons), "yes")


def group_rows(rows: Table, name: str) -> dict[Any, Table]:
    """Return the rows by the value of an entry."""
    groups: dict[Any, Table] = {}
    for row in rows:
        groups.setdefault(row[name], []).append(row)
    return groups


def estimate_text(found: Estimate | None, digits: int, sign: str = "") -> str:
    """Return a mean with its 95 % CI or range; a dash without values."""
    return NO_VALUE_TEXT if found is None else str(estimate_cell(found, digits, sign=sign))


def mean_text(values: Sequence[float] | Floats, digits: int, sign: str = "") -> str:
    """Return the mean of independent values with its 95 % CI."""
    return estimate_text(estimate(np.ravel(values).tolist()), digits, sign)


def trainings_text(values: Sequence[float] | Floats, digits: int, sign: str = "") -> str:
    """Return the mean of one number per training with its 95 % CI or range; a dash without values."""
    return estimate_text(estimate_over_trainings(list(values)), digits, sign)


def number_text(value: float | None, digits: int, sign: str = "") -> str:
    """Return a number as pages show it; a dash where there is none."""
    return NO_VALUE_TEXT if value is None else f"{value:{sign}.{digits}f}"


def interval_text(entries: Mapping[str, Any], digits: int, sign: str = "") -> str:
    """Return an estimate of a results file as pages show it: with its 95 % CI, else with the range if it is known."""
    values: dict[str, Any] = {name: nan if value is None else value for name, value in entries.items()}
    known = Estimate(**{each.name: values[each.name] for each in fields(Estimate) if each.name in values})
    ci = format_ci(known, f"{sign}.{digits}f")
    return use_no_break_spaces(f"{number_text(known.mean, digits, sign)} {ci}".strip())
