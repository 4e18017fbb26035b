"""The protocol of algorithms, and the loop in which a training runs the iterations of one."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from unjam.drivers.network import Network
from unjam.errors import UnjamError
from unjam.tree import select_prefix
from unjam.worlds.record import Episode

Tensors = dict[str, Tensor]
TaskEpisodes = Sequence[Sequence[Episode]]


@dataclass(frozen=True)
class IterationLog:
    """Report of one iteration for the rows of progress; all entries are optional."""

    values: Mapping[str, float] = field(default_factory=dict)
    """numbers about the updates, by name"""
    model_steps: int = 0
    """control steps in learned models, of all iterations so far"""
    model: Sequence[dict[str, Any]] = ()
    """facts about the model of each task"""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """wall time of each stage by name [s], without the episodes, which the training measures"""


class Collector:
    """Runs the episodes of iterations in the workers of a training, and counts their control steps."""

    def __init__(self, run: Callable[[Network, int], TaskEpisodes]) -> None:
        self._run = run
        self.iteration = 0
        """index of the current iteration, from 1"""
        self.environment_steps = 0
        """environment steps of all iterations so far"""
        self.episodes: list[list[Episode]] = []
        """episodes of the current iteration, by task"""
        self.seconds = 0.0
        """wall time of these episodes [s]"""

    def start_iteration(self) -> None:
        """Begin the next iteration, which has no episodes yet."""
        self.iteration += 1
        self.episodes, self.seconds = [], 0.0

    def __call__(self, network: Network) -> TaskEpisodes:
        """Return episodes of each task, driven by its expert plus the residual of `network`, with exploration.

        Further calls in an iteration run the same roads and vehicles again.
        """
        start_time = time.perf_counter()
        new_episodes = self._run(network, self.iteration)
        self.seconds += time.perf_counter() - start_time
        self.environment_steps += sum(episode.control_steps for episodes in new_episodes for episode in episodes)
        earlier_episodes = self.episodes or [[] for _ in new_episodes]
        self.episodes = [[*earlier, *new] for earlier, new in zip(earlier_episodes, new_episodes, strict=True)]
        return new_episodes


class Agent(Protocol):
    """A policy that learns; the common part of the protocols `Algorithm` and `Learner`."""

    def network(self) -> Network:
        """Return the current policy as a NumPy network: workers and exported controllers need no torch for it."""
        ...

    def state(self) -> tuple[dict[str, Any], Tensors]:
        """Return values for JSON and tensors, with which an agent of the same configuration resumes exactly."""
        ...

    def restore(self, values: dict[str, Any], tensors: Tensors) -> None:
        """Resume from the values and tensors that `state` returned."""
        ...


class Algorithm(Agent, Protocol):
    """An agent that decides itself which episodes it collects in an iteration, and learns from them.

    A class of the user, `--agent path.py:Class`, is made with an `AgentSpec`, and with `user.options` as keyword
    arguments. The training runs the episodes, validates, saves the best policy, writes progress and checkpoints, and
    ends. Before each iteration, the global generators of NumPy and torch are seeded by run and iteration.
    """

    def iterate(self, collect: Collector) -> IterationLog:
        """Call `collect` at least once, and learn from the episodes that it returns."""
        ...


def run_iterations(
    algorithm: Algorithm,
    collect: Collector,
    max_environment_steps: int,
    seed: int,
    on_iteration: Callable[[IterationLog], object],
) -> None:
    """Run iterations until `on_iteration` returns true, or all iterations have `max_environment_steps` together.

    Raise `UnjamError` if an iteration runs no episodes, or returns a log with other values than numbers.
    """
    while collect.environment_steps < max_environment_steps:
        collect.start_iteration()
        seed_iteration(seed, collect.iteration)
        log: Any = algorithm.iterate(collect)
        if not isinstance(log, IterationLog):
            raise UnjamError(f"algorithm: iterate() returns {type(log).__name__}; allowed: an IterationLog")
        if not collect.episodes:
            raise UnjamError(
                f"algorithm: iteration {collect.iteration} runs no episodes; allowed: at least one collect()"
            )
        _check_numbers({**log.values, **log.seconds})
        if on_iteration(log):
            return


def _check_numbers(values: Mapping[str, Any]) -> None:
    """Raise `UnjamError` if one of the values of a log is not a number."""
    for name, value in values.items():
        try:
            float(value)
        except (TypeError, ValueError):
            raise UnjamError(f"algorithm: {name} of the log is {value!r}; allowed: a number") from None


def seed_iteration(run_seed: int, iteration: int, update: int | None = None) -> None:
    """Seed the global generators by run, iteration and update, so that a resumed run draws the same random numbers."""
    key = (1,) if update is None else (1, 1 + update)  # NumPy ignores a trailing zero
    torch_seed, numpy_seed = np.random.SeedSequence([run_seed, iteration, *key]).generate_state(2)
    torch.manual_seed(int(torch_seed))
    np.random.seed(int(numpy_seed))


def tensors_with_prefix(prefix: str, tensors: Tensors) -> Tensors:
    """Return copies of the tensors with names that begin with `prefix`, by the rest of the name."""
    return {name: tensor.clone() for name, tensor in select_prefix(prefix, tensors).items()}
