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
"""part of the environment steps that is distributed by regret; the rest by weights, so that no task is forgotten"""
MAX_WARM_UP_ITERATIONS = 8
"""iterations with a common warm-up of their rings: a few rings cost nearly as much as many"""


class TaskSampler:
    """The current number of episodes of each task; with `regret`, each validation changes it."""

    def __init__(self, tasks: Sequence[Task], kind: TaskSampling, best_returns: Sequence[float]) -> None:
        self._tasks, self._kind, self.best_returns = tasks, kind, list(best_returns)
        self._shares = self._weight_shares = weight_shares(tasks)

    def update(self, returns: Sequence[float]) -> None:
        """Take the returns of a validation into account, task by task."""
        self.best_returns = [max(pair) for pair in zip(self.best_returns, returns, strict=True)]
        if self._kind == "regret":
            self._shares = regret_shares(self._weight_shares, self.best_returns, returns)

    def episode_counts(self, steps: int) -> list[int]:
        """Return the number of episodes of each task in an iteration of so many environment steps."""
        return count_episodes(self._tasks, steps, self._shares)

    def state(self) -> dict[str, list[float]]:
        """Return the state for a checkpoint."""
        return {"best_returns": self.best_returns, "shares": self._shares}

    def restore(self, state: dict[str, list[float]]) -> None:
        """Continue from a value of `state`."""
        self.best_returns, self._shares = state["best_returns"], state["shares"]

    def weighted_mean(self, values: Sequence[float]) -> float:
        """Return the mean over the tasks by weight."""
        return sum(share * value for share, value in zip(self._weight_shares, values, strict=True))


def weight_shares(tasks: Sequence[Task]) -> list[float]:
    """Return each task's share of the environment steps by weight."""
    total = sum(task.weight for task in tasks)
    return [task.weight / total for task in tasks]


def regret_shares(shares: Sequence[float], best_returns: Sequence[float], returns: Sequence[float]) -> list[float]:
    """Return each task's share of the environment steps, `REGRET_FRACTION` of which follows the regret.

    The regret is the best validation return so far, of the policy or its expert, minus the current one; all tasks have
    returns of similar size. It is a level-based sampling like prioritized level replay (Jiang et al. 2021,
    arXiv:2010.03934), with a measured regret.
    """
    regrets = [share * max(best - now, 0.0) for share, best, now in zip(shares, best_returns, returns, strict=True)]
    total = sum(regrets)
    if total == 0.0:
        return list(shares)
    pairs = zip(shares, regrets, strict=True)
    return [(1.0 - REGRET_FRACTION) * share + REGRET_FRACTION * regret / total for share, regret in pairs]


def count_episodes(tasks: Sequence[Task], steps: int, shares: Sequence[float]) -> list[int]:
    """Return the number of episodes of each task in an iteration of so many environment steps, at least one."""
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
    """Return `counts` episodes of each task, which cover the range of drawn values if `stratified`.

    Each has its own seed, except for those that differ only in their scale, one of `exploration_scales`.
    """
    episodes: list[EpisodeTask] = []
    for task, driver, count in zip(tasks, drivers, counts, strict=True):
        for index in range(count):
            group, member = divmod(index, len(exploration_scales))
            groups = ceil(count / len(exploration_scales))
            scenario = task.scenario.stratum(group, groups) if stratified else task.scenario
            episode_seed = (*seed, len(episodes) - member)
            episodes.append(EpisodeTask(scenario, driver, episode_seed, task.reward, exploration_scales[member]))
    return episodes


def warm_up_iterations(
    iteration: int, remaining_steps: int, steps_per_iteration: int, tasks: Sequence[Task], counts: Sequence[int]
) -> range:
    """Return the iterations with a common warm-up of their rings: `iteration` and some that follow.

    Their number is limited by the `remaining_steps`, those of `iteration` included, and by the cache of warm-up states.
    """
    pairs = zip((task.scenario for task in tasks), counts, strict=True)
    cavs = sum(count * len(scenario.possible_cav_ids()) for scenario, count in pairs if scenario.is_closed)
    cached = MAX_CACHED_CAVS // (2 * max(cavs, 1))
    length = min(MAX_WARM_UP_ITERATIONS, cached, ceil(remaining_steps / steps_per_iteration))
    return range(iteration, iteration + max(length, 1))
