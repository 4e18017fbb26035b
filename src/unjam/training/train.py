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
from unjam.files import append_line, make_folder, to_json, write_whole
from unjam.kernels import child_would_be_pinned
from unjam.learners.algorithm_1 import Collected, Iteration, Validated, algorithm_1, begin_training
from unjam.learners.imagination import full_policy
from unjam.measures.metrics import measure
from unjam.measures.statistics import Estimate
from unjam.processes import owned
from unjam.reports.html import write_report
from unjam.reports.results import read_progress
from unjam.training.belonging import belonging
from unjam.training.config import RunConfig, to_toml
from unjam.training.evaluate import Progress, Rows, gain_of, judge, raise_failure
from unjam.training.executors import OnIteration, train_apart
from unjam.training.export import KeptControllers
from unjam.training.folder import (
    PROGRESS,
    check_possible,
    continue_folder,
    last_state,
    make_new_folder,
    note_lineage,
    origin,
    read_config,
    save_checkpoint,
    start_folder,
)
from unjam.training.generators import exclusive_generators
from unjam.training.model_facts import why_no_facts, write_model_facts
from unjam.training.sampling import Sampler, episodes_of, iterations_ahead
from unjam.training.seeds import VALIDATE
from unjam.training.stopping import ends_early
from unjam.trust import expecting_code
from unjam.worlds.batch.run import run_where_possible
from unjam.worlds.workers import Workers

MEANS = (
    *("mean_speed", "speed_std_fleet", "cav_mean_speed", "speed_std_cav", "mean_abs_accel"),
    "shield_override_share",
)
"""metrics whose means over an iteration's episodes are in progress"""
RETURNS = ("return_mean", "return_expert", "return_validation")


@dataclass(frozen=True)
class TrainResult:
    """A finished training run; of several roads, each has its own result in `roads`, and no other."""

    folder: Path
    rows: Rows
    """by driver: a row of metrics per held-out episode"""
    gain: Estimate | None
    """return of the trained controller beyond its expert's, same seeds paired; None without an expert"""
    roads: dict[str, "TrainResult"] = field(default_factory=dict)
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
    on_iteration: OnIteration | None = None,
    progress: Progress | None = None,
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
    train_it = train_apart if child_would_be_pinned() else train_here
    rows = train_it(config, folder, resume, on_iteration, progress)
    results = {
        name: TrainResult(folder / name, rows[name], gain_of(road, rows[name]))
        for name, road in config.roads().items()
    }
    return TrainResult(folder, {}, None, results) if config.tasks else results[""]


@exclusive_generators()
def train_here(
    config: RunConfig,
    folder: Path,
    resume: bool = False,
    on_iteration: OnIteration | None = None,
    progress: Progress | None = None,
) -> dict[str, Rows]:
    """Train in this process, as `train` does; return the rows of the judgement, by road and driver."""
    check_possible(config)  # what is wrong is said before anything is written
    if resume:
        read_config(folder)
    else:
        make_new_folder(folder, f", or --resume {folder}")
    with expecting_code(), owned(folder):
        return _train_owned(config, folder, resume, on_iteration, progress)


def _train_owned(
    config: RunConfig,
    folder: Path,
    resume: bool,
    on_iteration: OnIteration | None,
    progress: Progress | None,
) -> dict[str, Rows]:
    """Train into a folder that no other process writes."""
    (continue_folder if resume else start_folder)(folder, config)
    with ExitStack() as held, Workers(config.workers) as workers:
        for place in [folder / name for name in config.roads() if name]:  # others may evaluate one alone
            make_folder(place)
            held.enter_context(owned(place))
        Trainer(folder, config, workers, on_iteration).train()
        rows: dict[str, Rows] = {}
        for name, road in config.roads().items():
            of_road = partial(_on_road, progress, name) if progress else None
            rows[name] = judge(folder / name, road, workers, progress=of_road).rows
    if not why_no_facts(config):
        write_model_facts(folder, config)
    write_report([folder / name for name in rows], folder / "report.html")
    return rows


def _on_road(progress: Progress, name: str, episode: tuple[str, int], steps: int) -> None:
    """Tell how far an episode is; those of another road are others."""
    driver, number = episode
    progress((f"{name} {driver}".strip(), number), steps)


class Trainer:
    """What Algorithm 1 needs around it: episodes from the workers, validation, and the run's folder.

    Of several roads each has a folder of its own in the run's, with controller and progress. Returns of
    the whole run are then means over the roads by weight, and so is what chooses the controllers.
    """

    def __init__(
        self, folder: Path, config: RunConfig, workers: Workers, on_iteration: OnIteration | None = None
    ) -> None:
        """Prepare a run, from its newest checkpoint if it has one."""
        self.folder, self.config, self.workers = folder, config, workers
        self.tasks = config.make_tasks()
        self.folders = [folder / task.name for task in self.tasks]
        self.training = begin_training(self.tasks, config.policy, config.learner, config.virtual, config.seed)
        self._on_iteration = on_iteration or (lambda row: None)
        self._validation_best, self._expert_returns = -np.inf, [float("nan")] * len(self.tasks)
        self._sampler = Sampler(self.tasks, config.sampling, self._expert_returns)
        self._controllers = KeptControllers(self.folders)
        self._belongs = belonging(config)
        if checkpoint := last_state(folder, {folder, *self.folders}, self._belongs):
            state, tensors = checkpoint
            ended = state["actual_steps"] >= config.steps or ends_early(config, read_progress(folder))
            self._controllers.restore(tensors, ended)
            self.training.restore(state, tensors)
            self._validation_best = state["validation_best"]
            self._expert_returns = state["expert_returns"]
            self._sampler.restore(state.get("sampler", {"reached": self._expert_returns}))
            note_lineage(folder, state["iteration"])

    def train(self) -> None:
        """Learn until the configured number of actual steps; a stop loses at most the running iteration."""
        if self.config.tasks:
            for place, road in zip(self.folders, self.config.roads().values(), strict=True):
                make_folder(place)
                write_whole(place / "config.toml", to_toml(road))
        if self.training.iteration == 0:
            self._expert_returns = self.returns_of([task.expert for task in self.tasks])
            self._sampler.reached = self._expert_returns
            self._keep_controllers(self.training.learner.network(), best=True)
            self._validation_best = self._sampler.mean(self._expert_returns)
        if not ends_early(self.config, read_progress(self.folder)):
            algorithm_1(self.training, self.config.steps, self.collect, self.validate, self.write)

    def drivers(self, network: Network) -> list[Driver]:
        """Return the full policy on each road: its expert plus this residual."""
        return [full_policy(task, self.config.policy, network) for task in self.tasks]

    def collect(self, network: Network, iteration: int) -> Collected:
        """Return the episodes of an iteration, at least one of each road, as many as the sampler asks for."""
        steps, left = self.config.learner.batch_steps, self.config.steps - self.training.actual_steps
        counts = self._sampler.episodes(steps)
        ahead = iterations_ahead(iteration, left, steps, self.tasks, counts)
        seeds = ((self.config.seed, each) for each in ahead)
        return self._drive(self.drivers(network), counts, self.config.policy.explores, *seeds)

    def validate(self, iteration: Iteration, ended: bool = False) -> Validated:
        """Now and then, and at the end, drive the validation seeds, and keep the best controller."""
        started, found = time.perf_counter(), None
        network, every = self.training.learner.network(), self.config.evaluation.every
        last = ended or iteration.actual_steps >= self.config.steps
        scheduled = every > 0 and iteration.number % every == 0
        if scheduled or (every and last):
            found = self.returns_of(self.drivers(network))
            if self._sampler.mean(found) > self._validation_best:
                self._keep_controllers(network, scheduled)
                if scheduled:  # a longer run would not have looked here, and may go on from this checkpoint
                    self._validation_best = self._sampler.mean(found)
            if scheduled:
                self._sampler.follow(found)
        elif last:
            self._keep_controllers(network, best=False)
        iteration.seconds["validation"] = time.perf_counter() - started
        return found

    def write(self, iteration: Iteration, validated: Validated) -> bool:
        """Write a row of progress, of the whole run and of each road, and a checkpoint.

        Return whether it is time to stop: the user says so, or `ends_early`.
        """
        whole, *roads = self._rows(iteration, validated)
        early = ends_early(self.config, [*read_progress(self.folder), whole])
        if early and validated is None:
            whole, *roads = self._rows(iteration, self.validate(iteration, ended=True))
        for place, row in zip(self.folders, roads, strict=False):
            append_line(place / PROGRESS, to_json(row))
        append_line(self.folder / PROGRESS, to_json(whole))
        counters, tensors = self.training.state()
        state = {**counters, "belongs": self._belongs, "sampler": self._sampler.state()}
        state |= {"validation_best": self._validation_best, "expert_returns": self._expert_returns}
        save_checkpoint(self.folder / "checkpoint", state, {**tensors, **self._controllers.tensors()})
        stopped = self._on_iteration(whole) is False
        if stopped and validated is None and not early:
            self.validate(iteration, ended=True)
        return stopped or early

    def returns_of(self, drivers: Sequence[Driver]) -> list[float]:
        """Return the mean return on the validation seeds, by road, each driven by its own of `drivers`."""
        counts = [self.config.evaluation.validation_episodes] * len(self.tasks)
        episodes = self._drive(drivers, counts, [0.0], (VALIDATE,))
        return [float(np.mean([measure(episode)["return"] for episode in driven])) for driven in episodes]

    def _drive(
        self, drivers: Sequence[Driver], counts: Sequence[int], noise: list[float], *seeds: tuple[int, ...]
    ) -> Collected:
        """Run `counts` episodes of the first seed, road by road; those of the others are to come."""
        all_of = partial(episodes_of, self.tasks, drivers, counts, spread=self.config.spread, explore=noise)
        now, *coming = map(all_of, seeds)
        alone, later = not self.config.tasks, list(chain(*coming))
        at_once = partial(run_where_possible, run=self.workers.run, coming=later, statistical=alone)
        episodes = (at_once if self.config.world == "batch" else self.workers.run)(now)
        raise_failure([measure(episode) for episode in episodes if not episode.ok])
        return [episodes[end - count : end] for end, count in zip(np.cumsum(counts), counts, strict=True)]

    def _rows(self, iteration: Iteration, validated: Validated) -> list[dict[str, Any]]:
        """Return the row of progress of the whole run, then those of its roads, where it has several."""
        rows = [self._row(iteration, validated, index) for index in range(len(self.tasks))]
        if not self.config.tasks:
            return rows
        names = [*RETURNS, *MEANS] if validated else [*RETURNS[:-1], *MEANS]
        whole = {
            **rows[0],
            **{name: self._sampler.mean([row[name] for row in rows]) for name in names},
            **{"k_star": None, "eps_m": None, "virtual": {}},
            **{name: sum(row[name] for row in rows) for name in ("collisions", "episodes")},
            "tasks": {
                task.name: {name: row[name] for name in (*RETURNS, "episodes", "k_star", "eps_m")}
                for task, row in zip(self.tasks, rows, strict=True)
            },
        }
        return [whole, *rows]

    def _row(self, iteration: Iteration, validated: Validated, index: int) -> dict[str, Any]:
        """Return the row of progress of one road."""
        measured = [measure(episode) for episode in iteration.episodes[index]]
        virtual = iteration.virtual[index] if iteration.virtual else {}
        means = {name: float(np.mean([row[name] for row in measured])) for name in ("return", *MEANS)}
        return {
            "iteration": iteration.number,
            "actual_steps": iteration.actual_steps,
            "episodes": len(measured),
            "virtual_steps": iteration.virtual_steps,
            "k_star": virtual.get("k_star"),
            "eps_m": virtual.get("eps_m"),
            "return_mean": means.pop("return"),
            "return_expert": self._expert_returns[index],
            "return_validation": validated[index] if validated else None,
            **means,
            "collisions": sum(row["collisions"] for row in measured),
            "learner": iteration.log,
            "virtual": virtual,
            "seconds": iteration.seconds,
        }

    def _keep_controllers(self, network: Network, best: bool) -> None:
        done = {"iteration": self.training.iteration, "actual_steps": self.training.actual_steps}
        contents = [
            controller_bytes(driver, {**origin(task.scenario, task.expert), **done})
            for task, driver in zip(self.tasks, self.drivers(network), strict=True)
        ]
        self._controllers.keep(contents, best)
