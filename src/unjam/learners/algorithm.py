"""The protocol of algorithms: what a training runs, iteration by iteration."""

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
    """What an iteration of an algorithm reports for the rows of progress; all of it may be empty."""

    values: Mapping[str, float] = field(default_factory=dict)
    """of its updates, by name"""
    model_steps: int = 0
    """control steps in learned models, of all iterations so far"""
    model: Sequence[dict[str, Any]] = ()
    """facts about the model of each task"""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """wall time of its parts; that of episodes is measured in any case"""


class Collector:
    """Runs the episodes of an iteration, in the workers of a training, and counts their control steps."""

    def __init__(self, run: Callable[[Network, int], TaskEpisodes]) -> None:
        self._run = run
        self.iteration = 0
        """number of the present iteration, from 1"""
        self.environment_steps = 0
        """of all iterations so far"""
        self.episodes: list[list[Episode]] = []
        """of the present iteration, by task"""
        self.seconds = 0.0
        """wall time of these episodes"""

    def start_iteration(self) -> None:
        """Count the next iteration, without episodes."""
        self.iteration += 1
        self.episodes, self.seconds = [], 0.0

    def __call__(self, network: Network) -> TaskEpisodes:
        """Return episodes of each task, driven by its expert plus the residual of `network`, with exploration.

        Further calls in an iteration run the same roads and vehicles again.
        """
        start = time.perf_counter()
        found = self._run(network, self.iteration)
        self.seconds += time.perf_counter() - start
        self.environment_steps += sum(episode.control_steps for each in found for episode in each)
        before = self.episodes or [[] for _ in found]
        self.episodes = [[*earlier, *each] for earlier, each in zip(before, found, strict=True)]
        return found


class Agent(Protocol):
    """What a training learns with: a policy, and all that is needed to resume."""

    def network(self) -> Network:
        """Return the present policy: a NumPy network, which workers and exported controllers drive without torch."""
        ...

    def state(self) -> tuple[dict[str, Any], Tensors]:
        """Return all that is needed to resume exactly: values for JSON, and tensors."""
        ...

    def restore(self, values: dict[str, Any], tensors: Tensors) -> None:
        """Resume, made with the same configuration, from what `state` returned."""
        ...


class Algorithm(Agent, Protocol):
    """What a training runs: it learns in iterations from the episodes that it collects.

    A class of the user's own, `--agent path.py:Class`, is made with an `AgentSpec`, and with `user.options` as keyword
    arguments. The training runs episodes, validates, keeps the best policy, writes progress and checkpoints, and ends.
    Before each iteration, the global generators of NumPy and torch are seeded by run and iteration.
    """

    def iterate(self, collect: Collector) -> IterationLog:
        """Collect episodes, at least once, and learn from them."""
        ...


def run_iterations(
    algorithm: Algorithm,
    collect: Collector,
    max_environment_steps: int,
    seed: int,
    on_iteration: Callable[[IterationLog], object],
) -> None:
    """Continue up to `max_environment_steps`, those of earlier iterations included, or until `on_iteration` is true.

    Raise `UnjamError` if an iteration runs no episodes.
    """
    while collect.environment_steps < max_environment_steps:
        collect.start_iteration()
        seed_iteration(seed, collect.iteration)
        log: Any = algorithm.iterate(collect)
        if not isinstance(log, IterationLog):
            raise UnjamError(f"algorithm: iterate() returns {type(log).__name__}; allowed: an IterationLog")
        if not collect.episodes:
            allowed = "allowed: at least one collect()"
            raise UnjamError(f"algorithm: iteration {collect.iteration} runs no episodes; {allowed}")
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


def seed_iteration(run_seed: int, iteration: int, part: int | None = None) -> None:
    """Seed the global generators by run, iteration and part: a resumed run draws the same random numbers."""
    key = (1,) if part is None else (1, 1 + part)  # a trailing zero would change nothing
    torch_seed, numpy_seed = np.random.SeedSequence([run_seed, iteration, *key]).generate_state(2)
    torch.manual_seed(int(torch_seed))
    np.random.seed(int(numpy_seed))


def tensors_with_prefix(prefix: str, tensors: Tensors) -> Tensors:
    """Return copies of the tensors with names that begin with `prefix`, without it."""
    return {name: tensor.clone() for name, tensor in select_prefix(prefix, tensors).items()}
