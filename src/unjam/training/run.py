"""The loop of a training run: collect, learn, validate, keep checkpoints."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unjam.controller import controller_bytes
from unjam.drivers.driver import Driver
from unjam.drivers.network import Network
from unjam.drivers.observation import observation_size
from unjam.drivers.residual import ResidualDriver
from unjam.files import append_line, to_json, write_whole
from unjam.learners.algorithms import LEARNERS
from unjam.learners.episodic import Iteration, Training
from unjam.learners.imagination import Imagination
from unjam.learners.state import learner_state, restore_learner
from unjam.measures.metrics import measure
from unjam.reports.results import read_progress
from unjam.training.config import RunConfig
from unjam.training.evaluate import VALIDATION, raise_failure
from unjam.training.folder import load_checkpoint, origin, save_checkpoint
from unjam.worlds.record import Episode
from unjam.worlds.workers import EpisodeTask, Workers

Told = Callable[[dict[str, Any]], None]
"""told each row of progress as it is written"""


class Run:
    """One training run in its folder: collects, learns, validates, keeps checkpoints."""

    def __init__(self, folder: Path, config: RunConfig, workers: Workers, told: Told | None = None) -> None:
        """Prepare a run, from its newest checkpoint if it has one."""
        self.folder = folder
        self.config = config
        self.workers = workers
        self.scenario = config.make_scenario()
        self.expert = config.make_expert()
        self._told = told
        self._validation_best = -np.inf
        self._expert_return = float("nan")
        settings = config.policy
        imagination = None
        if config.virtual.virtual_ratio > 0:
            imagination = Imagination(
                config.virtual, self.scenario, config.reward, self.expert, settings, config.seed
            )
        training = Training(
            observation_size(settings.observe, self.expert),
            self.scenario,
            settings,
            config.seed,
            self._collect,
            self._after_iteration,
            imagination,
        )
        self.learner = LEARNERS[config.agent](training, config.learner)
        checkpoint = load_checkpoint(folder / "checkpoint")
        if checkpoint is not None:
            state, tensors = checkpoint
            restore_learner(self.learner, state, tensors)
            self._validation_best = state["validation_best"]
            self._expert_return = state["expert_return"]
            self._forget_progress_after(state["iteration"])

    def train(self) -> None:
        """Learn until the configured number of actual steps; a stop loses at most the running iteration."""
        if self.learner.iteration == 0:
            self._expert_return = self._validate(self.expert)
            self._keep_controller(self.learner.network())
            self._validation_best = self._expert_return
        if self.learner.num_timesteps < self.config.steps:
            self.learner.run(self.config.steps)

    def driver(self, network: Network) -> ResidualDriver:
        """Return the full policy: the expert plus this residual."""
        policy, limit = self.config.policy, self.scenario.action_limit
        hold = policy.decisions_held(self.scenario.decision_step)
        return ResidualDriver(self.expert, network, limit, policy.observe, hold)

    def _collect(self, network: Network, iteration: int) -> Sequence[Episode]:
        count = -(-self.config.learner.batch_steps // self.scenario.horizon)
        return self._run_spread(self.driver(network), count, (self.config.seed, iteration), explore=True)

    def _validate(self, driver: Driver) -> float:
        episodes = self._run_spread(driver, self.config.evaluation.validation_episodes, (VALIDATION,))
        return float(np.mean([measure(episode)["return"] for episode in episodes]))

    def _run_spread(
        self, driver: Driver, count: int, seed: tuple[int, ...], explore: bool = False
    ) -> list[Episode]:
        """Run `count` episodes that cover the range of what the scenario draws; raise where one failed."""
        scenario, spread = self.scenario, self.config.spread
        episodes = self.workers.run(
            [
                EpisodeTask(
                    scenario.part(index, count) if spread else scenario,
                    driver,
                    (*seed, index),
                    self.config.reward,
                    explore,
                )
                for index in range(count)
            ]
        )
        raise_failure([measure(episode) for episode in episodes if not episode.ok])
        return episodes

    def _after_iteration(self, iteration: Iteration) -> None:
        """Validate now and then, and write progress and checkpoint."""
        started = time.perf_counter()
        validation, every = None, self.config.evaluation.every
        last = iteration.actual_steps >= self.config.steps
        if every and (iteration.number % every == 0 or last):
            network = self.learner.network()
            validation = self._validate(self.driver(network))
            if validation > self._validation_best:
                self._validation_best = validation
                self._keep_controller(network)
        elif not every and last:
            self._keep_controller(self.learner.network())
        seconds = {**iteration.seconds, "validation": time.perf_counter() - started}
        row = self._row(iteration, validation, seconds)
        append_line(self.folder / "progress.jsonl", to_json(row))
        counters, tensors = learner_state(self.learner)
        state = {
            **counters,
            "validation_best": self._validation_best,
            "expert_return": self._expert_return,
        }
        save_checkpoint(self.folder / "checkpoint", state, tensors)
        if self._told is not None:
            self._told(row)

    def _row(
        self, iteration: Iteration, validation: float | None, seconds: dict[str, float]
    ) -> dict[str, Any]:
        measured = [measure(episode) for episode in iteration.episodes]

        def mean(name: str) -> float:
            return float(np.mean([row[name] for row in measured]))

        return {
            "iteration": iteration.number,
            "actual_steps": iteration.actual_steps,
            "virtual_steps": iteration.virtual_steps,
            "k_star": iteration.virtual.get("k_star"),
            "eps_m": iteration.virtual.get("eps_m"),
            "return_mean": mean("return"),
            "return_expert": self._expert_return,
            "return_validation": validation,
            "mean_speed": mean("mean_speed"),
            "speed_std_fleet": mean("speed_std_fleet"),
            "cav_mean_speed": mean("cav_mean_speed"),
            "speed_std_cav": mean("speed_std_cav"),
            "mean_abs_accel": mean("mean_abs_accel"),
            "shield_override_share": mean("shield_override_share"),
            "collisions": sum(row["collisions"] for row in measured),
            "learner": iteration.log,
            "virtual": iteration.virtual,
            "seconds": seconds,
        }

    def _keep_controller(self, network: Network) -> None:
        about = {
            **origin(self.scenario, self.expert),
            "iteration": self.learner.iteration,
            "actual_steps": self.learner.num_timesteps,
        }
        write_whole(self.folder / "controller.unjam", controller_bytes(self.driver(network), about))

    def _forget_progress_after(self, iteration: int) -> None:
        """Remove rows of iterations that the checkpoint does not know: they will be made again."""
        path = self.folder / "progress.jsonl"
        rows = read_progress(self.folder)
        kept = [to_json(row) + "\n" for row in rows if row["iteration"] <= iteration]
        write_whole(path, "".join(kept))
