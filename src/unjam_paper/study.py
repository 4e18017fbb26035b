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
"""settings of CAVs that carry out commands at once, as in the paper"""
STUDY_ROADS: dict[str, dict[str, Any]] = {
    **{name: {"scenario": name, **IDEAL_CAVS} for name in ("ring", "ring-jammed", "figure-eight", "merge")},
    "on-ramp": {"scenario": "on-ramp", "scenario_options.penetration_rate": 0.05},
    **{f"{name}-usual-car": {"scenario": name} for name in ("ring", "ring-jammed", "figure-eight")},
    **{name: {"scenario": "ring"} for name in ("rings", "shared-rings", "all-roads")},
    "ring-11": {"scenario": "ring", "scenario_options.vehicles": 11, **IDEAL_CAVS},
    "ring-5": {"scenario": "ring", "scenario_options.vehicles": 5, **IDEAL_CAVS},
}
"""changes to the default run configuration, by name of the road"""
UNFILTERED_ROADS = {road: f"{road}-unfiltered" for road in ("ring", "figure-eight", "ring-11", "ring-5")}
"""roads without the safety filter, as in the paper, by the name of the road with it; the merge has no filter"""
UNSCALED_NOISE_ROAD = "ring-unfiltered-unscaled-noise"
"""the same ring with the noise of Table B1 in each step; Flow multiplies it by the square root of the step"""
NO_FILTER = {"scenario_options.safety.active": False}
STUDY_ROADS |= {name: STUDY_ROADS[road] | NO_FILTER for road, name in UNFILTERED_ROADS.items()}
STUDY_ROADS[UNSCALED_NOISE_ROAD] = {**STUDY_ROADS[UNFILTERED_ROADS["ring"]], "scenario_options.noise_scaling": "none"}
FILTERED_ROADS = {**{unfiltered: road for road, unfiltered in UNFILTERED_ROADS.items()}, UNSCALED_NOISE_ROAD: "ring"}
"""roads with the safety filter, by the name of the road without it"""
PAPER_ROADS = ("ring", "figure-eight", "merge")
FINAL_SHARE = 0.1
"""share of the iterations, at the end of a training, over which the paper averages"""
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
        """Run configuration with one worker, without baselines: these would be the same in all trainings."""
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
        """Return the mean of an entry of the progress, with exploration, over the last tenth of the iterations."""
        last_rows = self.progress[-ceil(FINAL_SHARE * len(self.progress)) :]
        return float(np.mean([row[name] for row in last_rows]))

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
        """Return the folder of the controller of a training, or of its controller for the first of several roads."""
        return self.run_folder(run) / next(iter(run.config.task_configs()))

    def copy_controllers(self, runs: Iterable[PlannedRun], folder: Path) -> None:
        """Copy the controllers of trainings into the folder of a study, as controllers/VARIANT-SEED.unjam."""
        controllers = {f"{run.variant}-{run.seed}.unjam": self.controller_folder(run) / CONTROLLER_FILE for run in runs}
        make_folder(folder / CONTROLLERS)
        for file in (folder / CONTROLLERS).glob("*.unjam"):
            if file.name not in controllers:  # more trainings were in the study before
                remove(file)
        for name, controller in controllers.items():
            atomic_write(folder / CONTROLLERS / name, controller.read_bytes())

    def reference_folder(self, road: str) -> Path:
        """Return the folder with the evaluation of the reference drivers on a road."""
        return self.folder / "references" / road

    def is_finished(self, run: PlannedRun) -> bool:
        """Return whether a training with these settings is finished, and its controller is evaluated.

        Raise `InputError` if its progress has missing rows, or if a controller is not the one that it trained.
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
    """A study: the trainings that it needs, the parts that it measures, and the tables and figures of its page."""

    title: str
    make_runs: Callable[[int], list[PlannedRun]] = lambda seeds: []
    """returns the trainings for a number of seeds"""
    make_parts: Callable[[StudyFolder, int], dict[str, StudyPart]] = lambda study_folder, seeds: {}
    """returns the parts that can be measured with the results so far, by their name PART or PART/ENTRY; arguments:
    folder of all studies, number of seeds"""
    write: Callable[[StudyFolder, int, Path], None] = lambda study_folder, seeds, folder: None
    """writes parts that need no measurement, and figures of trainings; the last argument is the folder of the study"""
    roads: tuple[str, ...] = ()
    """roads on which the reference drivers are evaluated"""
    minutes: float = 0.0
    """duration of `run` on two cores [min]"""
    tables: Mapping[str, Callable[[Path], pd.DataFrame]] = field(default_factory=dict)
    """tables of its page by name, made from its results"""
    figures: Mapping[str, Callable[[Path], Figure]] = field(default_factory=dict)
    """figures of its page by name, made from its results"""

    def run(self, study_folder: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
        """Measure all parts without current results, some after others, and write parts, tables and figures."""
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
    """Write the manifest of a study with `metadata`; later calls keep the first manifest and add a resumption."""
    make_folder(folder)
    content, file = manifest(), folder / "manifest.json"
    content["command"] = strip_folders(content["command"])
    if file.is_file():
        resumption = {key: content[key] for key in ("commit", "started")}
        content = read_json_object(file)
        content["resumptions"] = [*content.get("resumptions", []), resumption]
    write_part(folder, "manifest", {**content, **metadata})


def measure_tasks(
    tasks: Sequence[EpisodeTask], workers: int, make_row: Callable[[int, Episode, dict[str, Any]], dict[str, Any]]
) -> Table:
    """Return a row for each task, made from its index, episode and metrics; raise the error of the first failed one."""

    def measure_row(index: int, episode: Episode) -> dict[str, Any]:
        metrics = measure(episode)
        raise_failure([metrics])
        return make_row(index, episode, metrics)

    with WorkerPool(workers) as pool:
        return pool.run_and_map(tasks, measure_row)


def evaluate_drivers(
    scenario: Scenario, drivers: Mapping[str, DriverSource], seeds: int, workers: int
) -> dict[str, Table]:
    """Return the metrics of drivers on the same test seeds, by label."""
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
    """Return the feasibility of each driver, relative to `human`, and metrics of its episodes on test seeds."""
    return _results_by_driver(evaluate_drivers(scenario, drivers, seeds, workers), metrics)


def evaluate_in_batches(
    scenario: Scenario, drivers: Mapping[str, DriverSource], seeds: int, metrics: Sequence[str], workers: int
) -> dict[str, Any]:
    """Return the same as `evaluate_metrics`, except fuel, from batches: their episodes equal those of SUMO."""
    test_seeds = held_out_seeds(seeds)
    rows = {
        label: [*map(measure, run_batches([EpisodeTask(scenario, driver, seed) for seed in test_seeds]))]
        for label, driver in make_drivers(scenario, drivers).items()
    }
    return _results_by_driver(rows, metrics)


def _results_by_driver(rows: dict[str, Table], metrics: Sequence[str]) -> dict[str, Any]:
    verdicts = feasibility_by_driver(rows)
    return {
        label: {"feasibility": verdicts[label], "episodes": [{name: row[name] for name in metrics} for row in episodes]}
        for label, episodes in rows.items()
    }


@dataclass(frozen=True)
class DriverComparison:
    """Results of the same drivers on one or several roads, each as `evaluate_metrics` returns them."""

    roads: Sequence[Mapping[str, Any]]

    def groups(self, trainings: Mapping[str, str]) -> dict[str, list[str]]:
        """Return the drivers by table row: drivers PREFIX SEED share one, which `trainings` names by the prefix."""
        groups = {label: [label] for label in self.roads[0] if label.rpartition(" ")[0] not in trainings}
        for prefix, name in trainings.items():
            labels = [label for label in self.roads[0] if label.rpartition(" ")[0] == prefix]
            groups |= {f"{name}, {len(labels)} trainings": labels} if labels else {}
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
        """Return the minimum time gap of all episodes as text; a dash if no vehicle was faster than 1 m/s."""
        minimum = np.nanmin(self.values(labels, "min_time_gap"), initial=inf)
        return NO_VALUE_TEXT if minimum == inf else f"{minimum:.2f}"

    def verdicts(self, labels: Sequence[str]) -> list[str]:
        """Return the feasibility of drivers on all roads."""
        return [road[label]["feasibility"] for label in labels for road in self.roads]

    def feasibility(self, labels: Sequence[str]) -> str:
        """Return `yes` if drivers are feasible on all roads, else the first reason against it."""
        reasons = (verdict for verdict in self.verdicts(labels) if verdict != FEASIBLE)
        return next((reason or NO_VALUE_TEXT for reason in reasons), "yes")


def group_rows(rows: Table, name: str) -> dict[Any, Table]:
    """Return the rows grouped by the value of their entry `name`."""
    groups: dict[Any, Table] = {}
    for row in rows:
        groups.setdefault(row[name], []).append(row)
    return groups


def estimate_text(value: Estimate | None, digits: int, sign: str = "") -> str:
    """Return a mean with its 95 % CI or range as text; a dash for None."""
    return NO_VALUE_TEXT if value is None else str(estimate_cell(value, digits, sign=sign))


def mean_text(values: Sequence[float] | Floats, digits: int, sign: str = "") -> str:
    """Return the mean of independent values with its 95 % CI as text."""
    return estimate_text(estimate(np.ravel(values).tolist()), digits, sign)


def trainings_text(values: Sequence[float] | Floats, digits: int, sign: str = "") -> str:
    """Return the mean of one value per training with its 95 % CI or range as text; a dash without values."""
    return estimate_text(estimate_over_trainings(list(values)), digits, sign)


def number_text(value: float | None, digits: int, sign: str = "") -> str:
    """Return a number as text; a dash for None."""
    return NO_VALUE_TEXT if value is None else f"{value:{sign}.{digits}f}"


def interval_text(entries: Mapping[str, Any], digits: int, sign: str = "") -> str:
    """Return a stored estimate as text, with its 95 % CI, or with its range if it has no CI."""
    values: dict[str, Any] = {name: nan if value is None else value for name, value in entries.items()}
    stored = Estimate(**{field.name: values[field.name] for field in fields(Estimate) if field.name in values})
    ci = format_ci(stored, f"{sign}.{digits}f")
    return use_no_break_spaces(f"{number_text(stored.mean, digits, sign)} {ci}".strip())
