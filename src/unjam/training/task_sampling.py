"""Distribution of the episodes of an iteration among the tasks of a training."""

from collections.abc import Sequence
from math import ceil
from typing import Literal

from unjam.drivers.driver import Driver
from unjam.worlds.batch.run import MAX_CACHED_CAVS
from unjam.worlds.episode import Task
from unjam.worlds.worker_pool import EpisodeTask

TaskSampling = Literal["weights", "regret"]
REGRET_FRACTION = 0.5
"""part of the environment steps that is distributed by regret; the rest is distributed by weights to all tasks"""
MAX_WARM_UP_ITERATIONS = 8
"""maximum number of iterations with a common warm-up of their rings: few rings take nearly as long as many"""


class TaskSampler:
    """The share of each task in the environment steps; with `regret`, it changes at each validation."""

    def __init__(self, tasks: Sequence[Task], kind: TaskSampling, best_returns: Sequence[float]) -> None:
        """Start with shares by weight, and with the returns of the experts as the best returns."""
        self._tasks, self._kind, self.best_returns = tasks, kind, list(best_returns)
        self._shares = self._weight_shares = weight_shares(tasks)

    def update(self, returns: Sequence[float]) -> None:
        """Update the best returns, and with `regret` the shares, by the return of each task in a validation."""
        self.best_returns = [max(pair) for pair in zip(self.best_returns, returns, strict=True)]
        if self._kind == "regret":
            self._shares = regret_shares(self._weight_shares, self.best_returns, returns)

    def episode_counts(self, steps: int) -> list[int]:
        """Return the number of episodes of each task in an iteration with a number of environment steps."""
        return count_episodes(self._tasks, steps, self._shares)

    def state(self) -> dict[str, list[float]]:
        """Return the state for a checkpoint."""
        return {"best_returns": self.best_returns, "shares": self._shares}

    def restore(self, state: dict[str, list[float]]) -> None:
        """Resume from a state that `state` returned."""
        self.best_returns, self._shares = state["best_returns"], state["shares"]

    def weighted_mean(self, values: Sequence[float]) -> float:
        """Return the mean over the tasks, weighted by their weights."""
        return sum(share * value for share, value in zip(self._weight_shares, values, strict=True))


def weight_shares(tasks: Sequence[Task]) -> list[float]:
    """Return the share of each task in the environment steps by weight."""
    total = sum(task.weight for task in tasks)
    return [task.weight / total for task in tasks]


def regret_shares(shares: Sequence[float], best_returns: Sequence[float], returns: Sequence[float]) -> list[float]:
    """Return the share of each task in the environment steps; `REGRET_FRACTION` of the steps follows the regret.

    The regret of a task is the best validation return so far, of the policy or the expert, minus the current return;
    the returns of all tasks must be of similar size. This resembles prioritized level replay (Jiang et al. 2021,
    arXiv:2010.03934), with a measured regret.
    """
    triples = zip(shares, best_returns, returns, strict=True)
    regrets = [share * max(best_return - current_return, 0.0) for share, best_return, current_return in triples]
    total = sum(regrets)
    if total == 0.0:
        return list(shares)
    pairs = zip(shares, regrets, strict=True)
    return [(1.0 - REGRET_FRACTION) * share + REGRET_FRACTION * regret / total for share, regret in pairs]


def count_episodes(tasks: Sequence[Task], steps: int, shares: Sequence[float]) -> list[int]:
    """Return the number of episodes of each task, at least one, in an iteration with a number of environment steps."""
    pairs = zip(tasks, shares, strict=True)
    return [max(1, ceil(round(share * steps / task.scenario.max_episode_steps, 9))) for task, share in pairs]


def make_episodes(
    tasks: Sequence[Task],
    drivers: Sequence[Driver],
    counts: Sequence[int],
    seed: tuple[int, ...],
    *,
    stratified: bool,
    exploration_scales: Sequence[float],
) -> list[EpisodeTask]:
    """Return `counts` episodes of each task, which cover the range of drawn values evenly if `stratified`.

    Consecutive episodes with the different `exploration_scales` form a group, and have the same seed and vehicles.
    """
    episodes: list[EpisodeTask] = []
    for task, driver, count in zip(tasks, drivers, counts, strict=True):
        group_count = ceil(count / len(exploration_scales))
        for index in range(count):
            group, member = divmod(index, len(exploration_scales))
            scenario = task.scenario.stratum(group, group_count) if stratified else task.scenario
            episode_seed = (*seed, len(episodes) - member)
            episodes.append(EpisodeTask(scenario, driver, episode_seed, task.reward, exploration_scales[member]))
    return episodes


def warm_up_iterations(
    iteration: int, remaining_steps: int, steps_per_iteration: int, tasks: Sequence[Task], counts: Sequence[int]
) -> range:
    """Return `iteration` and the next iterations that have a common warm-up of their rings.

    Their number is limited by the cache of warm-up states, and by the `remaining_steps`, with those of `iteration`.
    """
    pairs = zip((task.scenario for task in tasks), counts, strict=True)
    cav_count = sum(count * len(scenario.possible_cav_ids()) for scenario, count in pairs if scenario.is_closed)
    cached_count = MAX_CACHED_CAVS // (2 * max(cav_count, 1))
    count = min(MAX_WARM_UP_ITERATIONS, cached_count, ceil(remaining_steps / steps_per_iteration))
    return range(iteration, iteration + max(count, 1))
