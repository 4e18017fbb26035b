"""Train: from a configuration to a folder with everything about the run. `unjam train`, `unjam.train`."""

import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from unjam.controller import controller_bytes
from unjam.drivers.driver import Driver
from unjam.drivers.network import Network
from unjam.files import append_line, atomic_write, make_folder, to_json
from unjam.kernels import needs_new_process
from unjam.learners.algorithm_1 import Iteration, TaskEpisodes, ValidationReturns, algorithm_1, start_training
from unjam.learners.model_rollouts import full_policy
from unjam.measures.metrics import measure
from unjam.measures.statistics import Estimate
from unjam.processes import lock_folder
from unjam.reports.html import write_report_page
from unjam.reports.results import read_progress
from unjam.training.config import RunConfig, to_toml
from unjam.training.early_stopping import should_stop_early
from unjam.training.evaluate import EvaluationProgress, RowsByDriver, evaluate_run, raise_failure, gain_over_expert
from unjam.training.executors import IterationCallback, train_in_subprocess
from unjam.training.export import ControllerStore
from unjam.training.fingerprint import fingerprint
from unjam.training.model_facts import no_facts_reason, write_model_facts
from unjam.training.random_state import exclusive_random_state
from unjam.training.run_folder import (
    PROGRESS_FILE,
    append_lineage,
    check_config,
    controller_origin,
    create_run_folder,
    make_new_folder,
    read_config,
    restore_newest_checkpoint,
    resume_run_folder,
    save_checkpoint,
)
from unjam.training.seeds import VALIDATION_SEED
from unjam.training.task_sampling import TaskSampler, make_episodes, warm_up_iterations
from unjam.trust import expecting_code
from unjam.worlds.batch.run import run_batched_if_supported
from unjam.worlds.worker_pool import WorkerPool

PROGRESS_METRICS = (
    *("mean_speed", "speed_std_fleet", "cav_mean_speed", "speed_std_cav", "mean_abs_accel"),
    "shield_override_share",
)
"""metrics whose means over an iteration's episodes are in progress"""
PROGRESS_RETURNS = ("return_mean", "return_expert", "return_validation")


@dataclass(frozen=True)
class TrainResult:
    """A finished training run; of several roads, each has its own result in `roads`, and no other."""

    folder: Path
    rows: RowsByDriver
    """by driver: a row of metrics per held-out episode"""
    gain: Estimate | None
    """return of the trained controller beyond its expert's, same seeds paired; None without an expert"""
    tasks: dict[str, "TrainResult"] = field(default_factory=dict)
    """by task, each in a folder of its own; empty where there is one road alone"""

    @property
    def controller(self) -> Path:
        """The trained controller: the best on the validation seeds."""
        return self.folder / "controller.unjam"

    @property
    def report(self) -> Path:
        """The page that shows what happened."""
        return self.folder / "report.html"


def train(
    config: RunConfig,
    folder: Path | str,
    resume: bool = False,
    on_iteration: IterationCallback | None = None,
    progress: EvaluationProgress | None = None,
) -> TrainResult:
    """Train as `config` says into `folder`, judge the controller on held-out seeds, and write the report.

    A run that was stopped goes on where it was with `resume`; one that ended goes on if `config.steps` is
    larger than before. It then ends with the same parameters as if it had never stopped. A run of several
    roads (`config.tasks`) is judged on each of them, in a folder with the road's name.

    Where NumPy was imported before unjam, it trains in a process of its own, so that the result is the same:
    see `unjam.kernels`. Elsewhere it uses the global generators of NumPy and torch, and restores them.

    Args:
        config: what to do; see `unjam.load_config`.
        folder: new, or the run's.
        resume: whether to go on with the run in `folder`.
        on_iteration: called with a row of progress after each iteration; where it returns False the training
            ends there, as if its steps were made, and can go on with `resume`.
        progress: called with how far the final evaluation is: ((driver, episode), decisions).

    Raises:
        InputError: the folder holds something else, another process trains into it, or the driver or reward
            are at fault.
        UnjamError: another training runs in this process.
        DiskError: the disk is full; the last checkpoint is whole.
    """
    folder = Path(folder)
    train_it = train_in_subprocess if needs_new_process() else train_in_process
    rows = train_it(config, folder, resume, on_iteration, progress)
    results = {
        name: TrainResult(folder / name, rows[name], gain_over_expert(road, rows[name]))
        for name, road in config.task_configs().items()
    }
    return TrainResult(folder, {}, None, results) if config.tasks else results[""]


@exclusive_random_state()
def train_in_process(
    config: RunConfig,
    folder: Path,
    resume: bool = False,
    on_iteration: IterationCallback | None = None,
    progress: EvaluationProgress | None = None,
) -> dict[str, RowsByDriver]:
    """Train in this process, as `train` does; return the rows of the judgement, by road and driver."""
    check_config(config)  # what is wrong is said before anything is written
    if resume:
        read_config(folder)
    else:
        make_new_folder(folder, f", or --resume {folder}")
    with expecting_code(), lock_folder(folder):
        return _train_in_folder(config, folder, resume, on_iteration, progress)


def _train_in_folder(
    config: RunConfig,
    folder: Path,
    resume: bool,
    on_iteration: IterationCallback | None,
    progress: EvaluationProgress | None,
) -> dict[str, RowsByDriver]:
    """Train into a folder that no other process writes."""
    (resume_run_folder if resume else create_run_folder)(folder, config)
    with ExitStack() as held, WorkerPool(config.workers) as workers:
        for place in [folder / name for name in config.task_configs() if name]:  # others may evaluate one alone
            make_folder(place)
            held.enter_context(lock_folder(place))
        Trainer(folder, config, workers, on_iteration).train()
        rows: dict[str, RowsByDriver] = {}
        for name, road in config.task_configs().items():
            of_road = partial(_report_task_progress, progress, name) if progress else None
            rows[name] = evaluate_run(folder / name, road, workers, progress=of_road).rows
    if not no_facts_reason(config):
        write_model_facts(folder, config)
    write_report_page([folder / name for name in rows], folder / "report.html")
    return rows


def _report_task_progress(progress: EvaluationProgress, name: str, episode: tuple[str, int], steps: int) -> None:
    """Tell how far an episode is; those of another road are others."""
    driver, number = episode
    progress((f"{name} {driver}".strip(), number), steps)


class Trainer:
    """What Algorithm 1 needs around it: episodes from the workers, validation, and the run's folder.

    Of several roads each has a folder of its own in the run's, with controller and progress. Returns of
    the whole run are then means over the roads by weight, and so is what chooses the controllers.
    """

    def __init__(
        self, folder: Path, config: RunConfig, workers: WorkerPool, on_iteration: IterationCallback | None = None
    ) -> None:
        """Prepare a run, from its newest checkpoint if it has one."""
        self.folder, self.config, self.workers = folder, config, workers
        self.tasks = config.make_tasks()
        self.folders = [folder / task.name for task in self.tasks]
        self.training = start_training(self.tasks, config.policy, config.learner, config.model, config.seed)
        self._on_iteration = on_iteration or (lambda row: None)
        self._best_validation, self._expert_returns = -np.inf, [float("nan")] * len(self.tasks)
        self._sampler = TaskSampler(self.tasks, config.task_sampling, self._expert_returns)
        self._controllers = ControllerStore(self.folders)
        self._fingerprint = fingerprint(config)
        if checkpoint := restore_newest_checkpoint(folder, {folder, *self.folders}, self._fingerprint):
            state, tensors = checkpoint
            ended = state["environment_steps"] >= config.steps or should_stop_early(config, read_progress(folder))
            self._controllers.restore(tensors, ended)
            self.training.restore(state, tensors)
            self._best_validation = state["best_validation"]
            self._expert_returns = state["expert_returns"]
            self._sampler.restore(state.get("sampler", {"best_returns": self._expert_returns}))
            append_lineage(folder, state["iteration"])

    def train(self) -> None:
        """Learn until the configured number of actual steps; a stop loses at most the running iteration."""
        if self.config.tasks:
            for place, road in zip(self.folders, self.config.task_configs().values(), strict=True):
                make_folder(place)
                atomic_write(place / "config.toml", to_toml(road))
        if self.training.iteration == 0:
            self._expert_returns = self.validation_returns([task.expert for task in self.tasks])
            self._sampler.best_returns = self._expert_returns
            self._save_controllers(self.training.learner.network(), is_best=True)
            self._best_validation = self._sampler.weighted_mean(self._expert_returns)
        if not should_stop_early(self.config, read_progress(self.folder)):
            algorithm_1(self.training, self.config.steps, self.collect, self.validate, self.write_progress)

    def make_drivers(self, network: Network) -> list[Driver]:
        """Return the full policy on each road: its expert plus this residual."""
        return [full_policy(task, self.config.policy, network) for task in self.tasks]

    def collect(self, network: Network, iteration: int) -> TaskEpisodes:
        """Return the episodes of an iteration, at least one of each road, as many as the sampler asks for."""
        steps, left = self.config.learner.steps_per_iteration, self.config.steps - self.training.environment_steps
        counts = self._sampler.episode_counts(steps)
        ahead = warm_up_iterations(iteration, left, steps, self.tasks, counts)
        seeds = ((self.config.seed, each) for each in ahead)
        return self._run_episodes(self.make_drivers(network), counts, self.config.policy.exploration_signs, *seeds)

    def validate(self, iteration: Iteration, has_ended: bool = False) -> ValidationReturns:
        """Now and then, and at the end, drive the validation seeds, and keep the best controller."""
        started, found = time.perf_counter(), None
        network, every = self.training.learner.network(), self.config.evaluation.validation_interval
        last = has_ended or iteration.environment_steps >= self.config.steps
        scheduled = every > 0 and iteration.number % every == 0
        if scheduled or (every and last):
            found = self.validation_returns(self.make_drivers(network))
            if self._sampler.weighted_mean(found) > self._best_validation:
                self._save_controllers(network, scheduled)
                if scheduled:  # a longer run would not have looked here, and may go on from this checkpoint
                    self._best_validation = self._sampler.weighted_mean(found)
            if scheduled:
                self._sampler.update(found)
        elif last:
            self._save_controllers(network, is_best=False)
        iteration.seconds["validation"] = time.perf_counter() - started
        return found

    def write_progress(self, iteration: Iteration, validation: ValidationReturns) -> bool:
        """Write a row of progress, of the whole run and of each road, and a checkpoint.

        Return whether it is time to stop: the user says so, or `should_stop_early`.
        """
        whole, *roads = self._progress_rows(iteration, validation)
        early = should_stop_early(self.config, [*read_progress(self.folder), whole])
        if early and validation is None:
            whole, *roads = self._progress_rows(iteration, self.validate(iteration, has_ended=True))
        for place, row in zip(self.folders, roads, strict=False):
            append_line(place / PROGRESS_FILE, to_json(row))
        append_line(self.folder / PROGRESS_FILE, to_json(whole))
        counters, tensors = self.training.state()
        state = {**counters, "fingerprint": self._fingerprint, "sampler": self._sampler.state()}
        state |= {"best_validation": self._best_validation, "expert_returns": self._expert_returns}
        save_checkpoint(self.folder / "checkpoint", state, {**tensors, **self._controllers.tensors()})
        stopped = self._on_iteration(whole) is False
        if stopped and validation is None and not early:
            self.validate(iteration, has_ended=True)
        return stopped or early

    def validation_returns(self, drivers: Sequence[Driver]) -> list[float]:
        """Return the mean return on the validation seeds, by road, each driven by its own of `drivers`."""
        counts = [self.config.evaluation.validation_episodes] * len(self.tasks)
        episodes = self._run_episodes(drivers, counts, [0.0], (VALIDATION_SEED,))
        return [float(np.mean([measure(episode)["return"] for episode in driven])) for driven in episodes]

    def _run_episodes(
        self, drivers: Sequence[Driver], counts: Sequence[int], exploration_scales: list[float], *seeds: tuple[int, ...]
    ) -> TaskEpisodes:
        """Run `counts` episodes of the first seed, road by road; those of the others are to come."""
        all_of = partial(
            make_episodes,
            self.tasks,
            drivers,
            counts,
            stratified=self.config.stratified,
            exploration_scales=exploration_scales,
        )
        now, *coming = map(all_of, seeds)
        alone, later = not self.config.tasks, list(chain(*coming))
        at_once = partial(
            run_batched_if_supported, run_unsupported=self.workers.run, upcoming=later, allow_statistical=alone
        )
        episodes = (at_once if self.config.simulator == "batch" else self.workers.run)(now)
        raise_failure([measure(episode) for episode in episodes if not episode.has_run])
        return [episodes[end - count : end] for end, count in zip(np.cumsum(counts), counts, strict=True)]

    def _progress_rows(self, iteration: Iteration, validation: ValidationReturns) -> list[dict[str, Any]]:
        """Return the row of progress of the whole run, then those of its roads, where it has several."""
        rows = [self._progress_row(iteration, validation, index) for index in range(len(self.tasks))]
        if not self.config.tasks:
            return rows
        names = [*PROGRESS_RETURNS, *PROGRESS_METRICS] if validation else [*PROGRESS_RETURNS[:-1], *PROGRESS_METRICS]
        whole = {
            **rows[0],
            **{name: self._sampler.weighted_mean([row[name] for row in rows]) for name in names},
            **{"k_star": None, "eps_m": None, "model": {}},
            **{name: sum(row[name] for row in rows) for name in ("collisions", "episodes")},
            "tasks": {
                task.name: {name: row[name] for name in (*PROGRESS_RETURNS, "episodes", "k_star", "eps_m")}
                for task, row in zip(self.tasks, rows, strict=True)
            },
        }
        return [whole, *rows]

    def _progress_row(self, iteration: Iteration, validation: ValidationReturns, index: int) -> dict[str, Any]:
        """Return the row of progress of one road."""
        measured = [measure(episode) for episode in iteration.episodes[index]]
        model = iteration.model[index] if iteration.model else {}
        means = {name: float(np.mean([row[name] for row in measured])) for name in ("return", *PROGRESS_METRICS)}
        return {
            "iteration": iteration.number,
            "environment_steps": iteration.environment_steps,
            "episodes": len(measured),
            "model_steps": iteration.model_steps,
            "k_star": model.get("k_star"),
            "eps_m": model.get("eps_m"),
            "return_mean": means.pop("return"),
            "return_expert": self._expert_returns[index],
            "return_validation": validation[index] if validation else None,
            **means,
            "collisions": sum(row["collisions"] for row in measured),
            "learner": iteration.log,
            "model": model,
            "seconds": iteration.seconds,
        }

    def _save_controllers(self, network: Network, is_best: bool) -> None:
        done = {"iteration": self.training.iteration, "environment_steps": self.training.environment_steps}
        contents = [
            controller_bytes(driver, {**controller_origin(task.scenario, task.expert), **done})
            for task, driver in zip(self.tasks, self.make_drivers(network), strict=True)
        ]
        self._controllers.save(contents, is_best)
