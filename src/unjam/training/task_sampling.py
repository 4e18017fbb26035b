"""How the episodes of an iteration are shared among the roads of a training."""

from collections.abc import Sequence
from math import ceil
from typing import Literal

from unjam.drivers.driver import Driver
from unjam.scenarios.ring import Ring
from unjam.worlds.batch.ring.warm_up import MAX_CACHED_CAVS
from unjam.worlds.episode import Task
from unjam.worlds.worker_pool import EpisodeTask

TaskSampling = Literal["weights", "regret"]
REGRET_FRACTION = 0.5
"""part of the actual steps that regret shares out; weights share the rest, so that no road is forgotten"""
MAX_WARM_UP_ITERATIONS = 8
"""iterations whose rings are warmed up at once: a few rings cost nearly as much as many"""


class TaskSampler:
    """How many episodes each task has now; with `regret`, each validation changes it."""

    def __init__(self, tasks: Sequence[Task], kind: TaskSampling, best_returns: Sequence[float]) -> None:
        """Begin with what weights say; `reached` is the best return of each task so far."""
        self._tasks, self._kind, self.best_returns = tasks, kind, list(best_returns)
        self._shares = self._weight_shares = weight_shares(tasks)

    def update(self, returns: Sequence[float]) -> None:
        """Note what a validation has found, task by task."""
        self.best_returns = [max(pair) for pair in zip(self.best_returns, returns, strict=True)]
        if self._kind == "regret":
            self._shares = regret_shares(self._weight_shares, self.best_returns, returns)

    def episode_counts(self, steps: int) -> list[int]:
        """Return how many episodes each task has in an iteration of so many actual steps."""
        return count_episodes(self._tasks, steps, self._shares)

    def state(self) -> dict[str, list[float]]:
        """Return all that is needed to go on."""
        return {"best_returns": self.best_returns, "shares": self._shares}

    def restore(self, state: dict[str, list[float]]) -> None:
        """Go on from what `state` returned; without `penetration_rates`, of a checkpoint of before, as weights say."""
        self.best_returns, self._shares = state["best_returns"], state.get("shares", self._weight_shares)

    def weighted_mean(self, values: Sequence[float]) -> float:
        """Return the mean of what each task has, by weight."""
        return sum(share * value for share, value in zip(self._weight_shares, values, strict=True))


def weight_shares(tasks: Sequence[Task]) -> list[float]:
    """Return each task's share of the actual steps, as its weight says."""
    total = sum(task.weight for task in tasks)
    return [task.weight / total for task in tasks]


def regret_shares(shares: Sequence[float], best_returns: Sequence[float], returns: Sequence[float]) -> list[float]:
    """Return each task's share where half of all follows what the policy lacks.

    What it lacks on a road is by how much its return in validation is below the best that was seen there, by
    itself before or by its expert: there is something to gain that is known to be possible. A level-based
    sampling in the manner of prioritised level replay (Jiang et al. 2021, arXiv:2010.03934), with a regret
    that is measured instead of guessed from the critic.

    Args:
        by_weight: shares without regard to it; they sum to one.
        reached: best return of each task so far.
        now: return of each task, as the policy is now; the returns of all tasks must be of the same size.
    """
    lacks = [share * max(best - here, 0.0) for share, best, here in zip(shares, best_returns, returns, strict=True)]
    total = sum(lacks)
    if total == 0.0:
        return list(shares)
    return [
        (1.0 - REGRET_FRACTION) * share + REGRET_FRACTION * lack / total
        for share, lack in zip(shares, lacks, strict=True)
    ]


def count_episodes(tasks: Sequence[Task], steps: int, shares: Sequence[float]) -> list[int]:
    """Return how many episodes an iteration of so many actual steps has on each road, at least one."""
    return [
        max(1, ceil(round(share * steps / task.scenario.horizon, 9))) for task, share in zip(tasks, shares, strict=True)
    ]


def make_episodes(
    tasks: Sequence[Task],
    drivers: Sequence[Driver],
    counts: Sequence[int],
    seed: tuple[int, ...],
    *,
    stratified: bool,
    exploration_scales: Sequence[float],
) -> list[EpisodeTask]:
    """Return `counts` episodes of each task, one after the other; each has a number behind the seed.

    With `spread` those of a road cover the range of what its scenario draws. As many as `explore` says by how
    much exploration counts, in turn, are alike but for that.
    """
    wanted: list[EpisodeTask] = []
    for task, driver, count in zip(tasks, drivers, counts, strict=True):
        for part in range(count):
            turn = part % len(exploration_scales)
            together = part // len(exploration_scales), ceil(count / len(exploration_scales))
            scenario = task.scenario.stratum(*together) if stratified else task.scenario
            own = (*seed, len(wanted) - turn)
            wanted.append(EpisodeTask(scenario, driver, own, task.reward, exploration_scales[turn]))
    return wanted


def warm_up_iterations(
    iteration: int, remaining_steps: int, steps_per_iteration: int, tasks: Sequence[Task], counts: Sequence[int]
) -> range:
    """Return an iteration and those that follow whose rings are warmed up along with its own.

    Args:
        iteration: number of this one.
        left: actual steps that are left, this iteration's among them.
        steps: of an iteration.
        tasks: roads.
        counts: episodes of each in an iteration; so many that the next ones' would not be kept warm up alone.
    """
    roads = zip((task.scenario for task in tasks), counts, strict=True)
    cavs = sum(count * road.cavs for road, count in roads if isinstance(road, Ring))
    together = min(
        MAX_WARM_UP_ITERATIONS, MAX_CACHED_CAVS // (2 * max(cavs, 1)), ceil(remaining_steps / steps_per_iteration)
    )
    return range(iteration, iteration + max(together, 1))
