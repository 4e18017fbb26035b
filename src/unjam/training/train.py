"""Training from a configuration into a run folder (`unjam train`, `unjam.train`)."""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unjam.controller import controller_bytes
from unjam.drivers.driver import Driver
from unjam.drivers.network import Network
from unjam.drivers.user_driver import is_file_reference
from unjam.errors import InputError, invalid_value, raise_failure
from unjam.files import UNREADABLE_ERRORS, append_line, atomic_write, make_folder, to_json
from unjam.kernels import needs_new_process
from unjam.learners.agent import AgentSpec, check_network, check_state, convert_user_errors, learner_class
from unjam.learners.algorithm import (
    Collector,
    IterationLog,
    TaskEpisodes,
    Tensors,
    run_iterations,
    seed_iteration,
    tensors_with_prefix,
)
from unjam.learners.algorithm_1 import make_algorithm
from unjam.learners.model_rollouts import full_policy
from unjam.measures.metrics import measure
from unjam.measures.statistics import Estimate, format_ci
from unjam.measures.verdict import metric_frame
from unjam.processes import lock_folder
from unjam.reports.html import write_report_page
from unjam.reports.results import CONTROLLER_FILE, read_progress
from unjam.scenarios.file_watch import watch_files
from unjam.seeds import VALIDATION_SEED
from unjam.text import to_one_line
from unjam.training import run_folder
from unjam.training.config import CONFIG_FILE, RunConfig, to_toml
from unjam.training.evaluate import DriverAndEpisode, EvaluationProgress, RowsByDriver, evaluate_run, gain_over_expert
from unjam.training.executors import IterationCallback, train_in_subprocess
from unjam.training.export import ControllerStore
from unjam.training.fingerprint import check_file_hashes, code_names, file_hashes, fingerprint
from unjam.training.model_facts import no_facts_reason, write_model_facts
from unjam.training.random_state import exclusive_random_state
from unjam.training.string_limit import find_operating_points
from unjam.training.task_sampling import TaskSampler, make_episodes, warm_up_iterations
from unjam.tree import unpack
from unjam.trust import forget_expected_code
from unjam.worlds.batch.run import run_batched_if_supported
from unjam.worlds.worker_pool import WorkerPool

if TYPE_CHECKING:  # imported late, so that commands start quickly
    from matplotlib.figure import Figure

PROGRESS_METRICS = (
    *("mean_speed", "speed_std_fleet", "cav_mean_speed", "speed_std_cav", "mean_abs_accel"),
    "shield_override_share",
)
"""metrics in rows of progress, as means over the episodes of an iteration"""
PROGRESS_RETURNS = ("return_mean", "return_expert", "return_validation")
ALGORITHM_PREFIX = "algorithm/"
ValidationReturns = Sequence[float] | None
"""mean return of each task on the validation seeds; None without a validation"""


@dataclass(frozen=True)
class TrainResult:
    """A finished training run; with several tasks, the results are only in `tasks`."""

    folder: Path
    rows: RowsByDriver
    """rows of metrics by driver, one for each test episode"""
    gain: Estimate | None
    """paired difference of return between the trained controller and its expert; None without an expert"""
    tasks: dict[str, "TrainResult"] = field(default_factory=dict)
    """results by task, each in its own folder; empty for a single road"""

    def __str__(self) -> str:
        if self.tasks:
            return "\n\n".join(f"{name}: {result}" for name, result in self.tasks.items())
        table = metric_frame(self.rows)
        lines = [f"training run {self.folder}", table.to_string(index=False)]
        if self.gain:
            gain = f"{self.gain.mean:+.1f} {format_ci(self.gain, '.1f')}".strip()
            lines.append(f"return compared with the expert: {gain}")
        return "\n".join([*lines, f"controller: {self.controller}"])

    @property
    def controller(self) -> Path:
        """The trained controller with the best validation return."""
        return self.folder / CONTROLLER_FILE

    @property
    def report(self) -> Path:
        """The HTML page with the results."""
        return self.folder / "report.html"

    def plot(self) -> "Figure":
        """Return a figure of the learning curve: the returns in training and validation over environment steps."""
        from unjam.reports.figures import learning_curve_figure

        return learning_curve_figure({"": read_progress(self.folder)}, {}, {})


def train(
    config: RunConfig,
    folder: Path | str,
    resume: bool = False,
    on_iteration: IterationCallback | None = None,
    progress: EvaluationProgress | None = None,
) -> TrainResult:
    """Train into `folder`, evaluate the controller on test seeds, and write the report.

    With `resume`, a stopped run continues, and a finished run if `config.steps` is larger than before; the result is
    the same as without interruption. A run of several tasks (`config.tasks`) is evaluated on each task, in a folder
    with the name of the task.

    If NumPy was imported before unjam, the training runs in another process, so that the result is the same: see
    `unjam.kernels`. Otherwise, it uses the global generators of NumPy and torch, and restores their state.

    Args:
        config: the configuration; see `unjam.load_config`.
        folder: a new folder, or the folder of the run to resume.
        resume: whether to resume the run in `folder`.
        on_iteration: called with a row of progress after each iteration; if it returns False, the training ends as if
            all steps were made, and can be resumed.
        progress: called during the final evaluation with ((driver, episode), control steps).

    Raises:
        InputError: the folder is not empty, another process trains into it, or the driver or reward is invalid.
        UnjamError: another training runs in this process.
        DiskError: the disk is full; the last checkpoint is complete.
    """
    folder = Path(folder)
    train_in = train_in_subprocess if needs_new_process() else train_in_process
    rows = train_in(config, folder, resume, on_iteration, progress)
    results = {
        name: TrainResult(folder / name, rows[name], gain_over_expert(task, rows[name]))
        for name, task in config.task_configs().items()
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
    """Train in this process, as `train` does; return the rows of the evaluation by task and driver."""
    run_folder.check_config(config)  # before anything is written
    if not is_file_reference(config.agent):
        learner_class(config.learner)  # reports a missing package before anything is written
    if resume:
        run_folder.read_config(folder)
    else:
        run_folder.make_new_folder(folder, f", or --resume {folder}")
    with run_folder.removing_if_empty(folder), forget_expected_code(), lock_folder(folder):
        (run_folder.resume_run_folder if resume else run_folder.create_run_folder)(folder, config)
        refusals = nullcontext() if resume else run_folder.empty_if_refused(folder)
        with refusals, ExitStack() as locks, WorkerPool(config.workers) as workers:
            for task_folder in [folder / name for name in config.task_configs() if name]:
                make_folder(task_folder)
                locks.enter_context(lock_folder(task_folder))
            trainer = Trainer(folder, config, workers, on_iteration)
            trainer.train()
            rows: dict[str, RowsByDriver] = {}
            for name, task in config.task_configs().items():
                task_progress = partial(_report_task_progress, progress, name) if progress else None
                rows[name] = evaluate_run(folder / name, task, workers, task_progress, watch=trainer.watch).rows
        if not no_facts_reason(folder, config):
            write_model_facts(folder, config)
        write_report_page([folder / name for name in rows], folder / "report.html")
    return rows


def _report_task_progress(progress: EvaluationProgress, task: str, episode: DriverAndEpisode, steps: int) -> None:
    driver, index = episode
    progress((f"{task} {driver}".strip(), index), steps)


class Trainer:
    """Trains: runs an algorithm with episodes from the workers, validates, and writes the run's folder.

    Each of several tasks has a folder with controller and progress; returns of the run are weighted means over tasks.
    """

    def __init__(
        self, folder: Path, config: RunConfig, workers: WorkerPool, on_iteration: IterationCallback | None = None
    ) -> None:
        self.folder, self.config, self.workers = folder, config, workers
        self.tasks = config.make_tasks()
        self.watch = watch_files((task.scenario for task in self.tasks), *code_names(config))
        self.folders = [folder / task.name for task in self.tasks]
        string_gain = self._string_gain_function() if config.policy.max_string_gain else None
        self.spec = AgentSpec(self.tasks, config.policy, config.model, config.learner.gamma, config.seed, string_gain)
        self.collector = Collector(self.collect)
        seed_iteration(config.seed, 0)
        with convert_user_errors(config.agent):
            self.algorithm = make_algorithm(config.agent, config.learner, self.spec)
        self._on_iteration = on_iteration or (lambda row: None)
        self._best_validation, self._expert_returns = -np.inf, [float("nan")] * len(self.tasks)
        self._sampler = TaskSampler(self.tasks, config.task_sampling, self._expert_returns)
        self._controllers = ControllerStore(self.folders)
        self._fingerprint = fingerprint(config)
        if checkpoint := run_folder.restore_newest_checkpoint(folder, {folder, *self.folders}, self._fingerprint):
            try:
                self._restore(*checkpoint)
            except UNREADABLE_ERRORS as error:
                reason = f"is none of this run: {type(error).__name__}: {to_one_line(error)}"
                raise InputError(f"checkpoint: that of {str(folder)!r} {reason}; allowed: remove it") from None
            run_folder.append_lineage(folder, self.collector.iteration)

    def _restore(self, values: dict[str, Any], tensors: Tensors) -> None:
        """Resume from a checkpoint; raise one of `UNREADABLE_ERRORS` if it is not a checkpoint of this run."""
        state = unpack(run_folder.CheckpointValues, values, {})
        returns = [state.best_validation, *state.expert_returns]
        is_consistent = 0 < state.iteration <= state.environment_steps and len(returns) == 1 + len(self.tasks)
        if not is_consistent or not all(isinstance(value, float) for value in returns):
            raise ValueError("its numbers contradict each other")
        is_stopped = self.config.evaluation.should_stop_early(read_progress(self.folder))
        self._controllers.restore(tensors, is_stopped or state.environment_steps >= self.config.steps)
        self.collector.iteration, self.collector.environment_steps = state.iteration, state.environment_steps
        with convert_user_errors(self.config.agent):
            self.algorithm.restore(state.algorithm, tensors_with_prefix(ALGORITHM_PREFIX, tensors))
        self._best_validation, self._expert_returns = state.best_validation, state.expert_returns
        self._sampler.restore(state.sampler)

    def _string_gain_function(self) -> Callable[[Network], float]:
        """Return a function that measures the largest string gain of the full policy over all closed roads."""
        points = find_operating_points({task.name: task.scenario for task in self.tasks}, self.workers)
        if not points:
            allowed = f"none on {self.config.scenario}: it is no closed road"
            raise invalid_value("policy.max_string_gain", self.config.policy.max_string_gain, allowed)

        def string_gain(network: Network) -> float:
            pairs = zip(self.tasks, self.make_drivers(network), strict=True)
            return max(points[task.name].string_gain(driver) for task, driver in pairs if task.name in points)

        return string_gain

    def train(self) -> None:
        """Run iterations up to the configured steps; an interruption loses at most the current iteration."""
        if self.config.tasks:
            for folder, task in zip(self.folders, self.config.task_configs().values(), strict=True):
                make_folder(folder)
                atomic_write(folder / CONFIG_FILE, to_toml(task))
        if self.collector.iteration == 0:
            self._expert_returns = self.validation_returns([task.expert for task in self.tasks])
            self._sampler.best_returns = self._expert_returns
            self._save_controllers(self.network(), is_scheduled=True)
            self._best_validation = self._sampler.weighted_mean(self._expert_returns)
        if not self.config.evaluation.should_stop_early(read_progress(self.folder)):
            config = self.config
            with convert_user_errors(config.agent):
                run_iterations(self.algorithm, self.collector, config.steps, config.seed, self.finish_iteration)

    def network(self) -> Network:
        """Return the current policy."""
        with convert_user_errors(self.config.agent):
            return check_network(self.config.agent, self.algorithm.network(), self.spec)

    def make_drivers(self, network: Network) -> list[Driver]:
        """Return the full policy of each task: its expert plus the residual of `network`."""
        return [full_policy(task, self.config.policy, network) for task in self.tasks]

    def collect(self, network: Network, iteration: int) -> TaskEpisodes:
        """Run the episodes of an iteration, at least one of each task, with counts from the sampler."""
        check_network(self.config.agent, network, self.spec)
        steps = self.config.learner.steps_per_iteration
        remaining = self.config.steps - self.collector.environment_steps
        counts = self._sampler.episode_counts(steps)
        iterations = warm_up_iterations(iteration, remaining, steps, self.tasks, counts)
        seeds = ((self.config.seed, number) for number in iterations)
        return self._run_episodes(self.make_drivers(network), counts, self.config.policy.exploration_signs, *seeds)

    def validate(self, has_ended: bool = False) -> ValidationReturns:
        """Validate if scheduled or at the end, and save a controller with a new best return; return the returns."""
        returns: ValidationReturns = None
        network, interval = self.network(), self.config.evaluation.validation_interval
        is_last = has_ended or self.collector.environment_steps >= self.config.steps
        is_scheduled = interval > 0 and self.collector.iteration % interval == 0
        if is_scheduled or (interval and is_last):
            returns = self.validation_returns(self.make_drivers(network))
            mean = self._sampler.weighted_mean(returns)
            if mean > self._best_validation:
                self._save_controllers(network, is_scheduled)
                if is_scheduled:  # a longer run that resumes here must not depend on an unscheduled one
                    self._best_validation = mean
            if is_scheduled:
                self._sampler.update(returns)
        elif is_last:
            self._save_controllers(network, is_scheduled=False)
        return returns

    def finish_iteration(self, log: IterationLog) -> bool:
        """Validate if scheduled, write progress and a checkpoint, and return whether to stop."""
        start_time, validation = time.perf_counter(), self.validate()
        seconds = {"collect": self.collector.seconds, **log.seconds, "validation": time.perf_counter() - start_time}
        log = replace(log, seconds=seconds)
        run_row, *task_rows = self._progress_rows(log, validation)
        stops_early = self.config.evaluation.should_stop_early([*read_progress(self.folder), run_row])
        if stops_early and validation is None:
            start_time, validation = time.perf_counter(), self.validate(has_ended=True)
            seconds["validation"] += time.perf_counter() - start_time
            run_row, *task_rows = self._progress_rows(log, validation)
        file_hashes_now = self._fingerprint["files"] | file_hashes(code_names(self.config))
        check_file_hashes(self._fingerprint, {"files": file_hashes_now}, "train")  # before the iteration is stored
        self.watch.check()
        for folder, row in [*zip(self.folders, task_rows, strict=False), (self.folder, run_row)]:
            append_line(folder / run_folder.PROGRESS_FILE, to_json(row))
        self._save_checkpoint()
        is_stopped = self._on_iteration(run_row) is False
        if is_stopped and validation is None and not stops_early:
            self.validate(has_ended=True)
            self._save_checkpoint()  # again, with the controller that `validate` may have saved
        return is_stopped or stops_early

    def _save_checkpoint(self) -> None:
        values, tensors = check_state(self.config.agent, self.algorithm.state())
        state = run_folder.CheckpointValues(
            **self._counters,
            algorithm=values,
            fingerprint=self._fingerprint,
            sampler=self._sampler.state(),
            best_validation=self._best_validation,
            expert_returns=self._expert_returns,
        )._asdict()
        algorithm_tensors = {f"{ALGORITHM_PREFIX}{name}": tensor for name, tensor in tensors.items()}
        run_folder.save_checkpoint(self.folder / "checkpoint", state, algorithm_tensors | self._controllers.tensors())

    @property
    def _counters(self) -> dict[str, int]:
        return {"iteration": self.collector.iteration, "environment_steps": self.collector.environment_steps}

    def validation_returns(self, drivers: Sequence[Driver]) -> list[float]:
        """Return the mean validation return of each task; `drivers` has the driver of each task."""
        counts = [self.config.evaluation.validation_episodes] * len(self.tasks)
        episodes = self._run_episodes(drivers, counts, [0.0], (VALIDATION_SEED,))
        return [float(np.mean([measure(episode)["return"] for episode in task_episodes])) for task_episodes in episodes]

    def _run_episodes(
        self, drivers: Sequence[Driver], counts: Sequence[int], exploration_scales: list[float], *seeds: tuple[int, ...]
    ) -> TaskEpisodes:
        """Run `counts` episodes of each task with the first seed; those with the other seeds are expected to follow."""
        stratified = self.config.stratified
        tasks, *upcoming_tasks = (
            make_episodes(
                self.tasks, drivers, counts, seed, stratified=stratified, exploration_scales=exploration_scales
            )
            for seed in seeds
        )
        if self.config.backend == "batch":
            upcoming, is_single = list(chain(*upcoming_tasks)), not self.config.tasks
            episodes = run_batched_if_supported(tasks, self.workers.run, upcoming, allow_statistical=is_single)
        else:
            episodes = self.workers.run([replace(task, backend=self.config.backend) for task in tasks])
        raise_failure([measure(episode) for episode in episodes if not episode.has_run])
        return [episodes[end - count : end] for end, count in zip(np.cumsum(counts), counts, strict=True)]

    def _progress_rows(self, log: IterationLog, validation: ValidationReturns) -> list[dict[str, Any]]:
        """Return the row of progress of the run, and with several tasks the row of each task."""
        rows = [self._progress_row(log, validation, index) for index in range(len(self.tasks))]
        if not self.config.tasks:
            return rows
        names = [*PROGRESS_RETURNS, *PROGRESS_METRICS] if validation else [*PROGRESS_RETURNS[:-1], *PROGRESS_METRICS]
        run_row = {
            **rows[0],
            **{name: self._sampler.weighted_mean([row[name] for row in rows]) for name in names},
            **{"k_star": None, "eps_m": None, "model": {}},
            **{name: sum(row[name] for row in rows) for name in ("collisions", "episodes")},
            "tasks": {
                task.name: {name: row[name] for name in (*PROGRESS_RETURNS, "episodes", "k_star", "eps_m")}
                for task, row in zip(self.tasks, rows, strict=True)
            },
        }
        return [run_row, *rows]

    def _progress_row(self, log: IterationLog, validation: ValidationReturns, index: int) -> dict[str, Any]:
        measured = [measure(episode) for episode in self.collector.episodes[index]]
        model = log.model[index] if log.model else {}
        means = {name: float(np.mean([row[name] for row in measured])) for name in ("return", *PROGRESS_METRICS)}
        return {
            **self._counters,
            "episodes": len(measured),
            "model_steps": log.model_steps,
            "k_star": model.get("k_star"),
            "eps_m": model.get("eps_m"),
            "return_mean": means.pop("return"),
            "return_expert": self._expert_returns[index],
            "return_validation": validation[index] if validation else None,
            **means,
            "collisions": sum(row["collisions"] for row in measured),
            "learner": {name: float(value) for name, value in log.values.items()},
            "model": model,
            "seconds": log.seconds,
        }

    def _save_controllers(self, network: Network, is_scheduled: bool) -> None:
        contents = [
            controller_bytes(driver, {**run_folder.controller_origin(task.scenario, task.expert), **self._counters})
            for task, driver in zip(self.tasks, self.make_drivers(network), strict=True)
        ]
        self._controllers.save(contents, is_scheduled)
