"""How the episodes of an iteration are shared among the roads of a training."""

from collections.abc import Sequence
from math import ceil
from typing import Literal

from unjam.drivers.driver import Driver
from unjam.scenarios.ring import Ring
from unjam.worlds.batch.begun import MOST_KEPT
from unjam.worlds.episode import Task
from unjam.worlds.workers import EpisodeTask

Sampling = Literal["weights", "regret"]
FOLLOWING = 0.5
"""part of the actual steps that regret shares out; weights share the rest, so that no road is forgotten"""
WARMED_UP_TOGETHER = 8
"""iterations whose rings are warmed up at once: a few rings cost nearly as much as many"""


class Sampler:
    """How many episodes each task has now; with `regret`, each validation changes it."""

    def __init__(self, tasks: Sequence[Task], kind: Sampling, reached: Sequence[float]) -> None:
        """Begin with what weights say; `reached` is the best return of each task so far."""
        self._tasks, self._kind, self.reached = tasks, kind, list(reached)
        self._shares = self._by_weight = shares_by_weight(tasks)

    def follow(self, found: Sequence[float]) -> None:
        """Note what a validation has found, task by task."""
        self.reached = [max(pair) for pair in zip(self.reached, found, strict=True)]
        if self._kind == "regret":
            self._shares = shares_by_regret(self._by_weight, self.reached, found)

    def episodes(self, steps: int) -> list[int]:
        """Return how many episodes each task has in an iteration of so many actual steps."""
        return episodes_of_iteration(self._tasks, steps, self._shares)

    def state(self) -> dict[str, list[float]]:
        """Return all that is needed to go on."""
        return {"reached": self.reached, "shares": self._shares}

    def restore(self, state: dict[str, list[float]]) -> None:
        """Go on from what `state` returned; without `shares`, of a checkpoint of before, as weights say."""
        self.reached, self._shares = state["reached"], state.get("shares", self._by_weight)

    def mean(self, values: Sequence[float]) -> float:
        """Return the mean of what each task has, by weight."""
        return sum(share * value for share, value in zip(self._by_weight, values, strict=True))


def shares_by_weight(tasks: Sequence[Task]) -> list[float]:
    """Return each task's share of the actual steps, as its weight says."""
    total = sum(task.weight for task in tasks)
    return [task.weight / total for task in tasks]


def shares_by_regret(
    by_weight: Sequence[float], reached: Sequence[float], now: Sequence[float]
) -> list[float]:
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
    lacks = [share * max(best - here, 0.0) for share, best, here in zip(by_weight, reached, now, strict=True)]
    total = sum(lacks)
    if total == 0.0:
        return list(by_weight)
    return [
        (1.0 - FOLLOWING) * share + FOLLOWING * lack / total
        for share, lack in zip(by_weight, lacks, strict=True)
    ]


def episodes_of_iteration(tasks: Sequence[Task], steps: int, shares: Sequence[float]) -> list[int]:
    """Return how many episodes an iteration of so many actual steps has on each road, at least one."""
    return [
        max(1, ceil(round(share * steps / task.scenario.horizon, 9)))
        for task, share in zip(tasks, shares, strict=True)
    ]


def episodes_of(
    tasks: Sequence[Task],
    drivers: Sequence[Driver],
    counts: Sequence[int],
    seed: tuple[int, ...],
    *,
    spread: bool,
    explore: Sequence[float],
) -> list[EpisodeTask]:
    """Return `counts` episodes of each task, one after the other; each has a number behind the seed.

    With `spread` those of a road cover the range of what its scenario draws. As many as `explore` says by how
    much exploration counts, in turn, are alike but for that.
    """
    wanted: list[EpisodeTask] = []
    for task, driver, count in zip(tasks, drivers, counts, strict=True):
        for part in range(count):
            turn = part % len(explore)
            together = part // len(explore), ceil(count / len(explore))
            scenario = task.scenario.part(*together) if spread else task.scenario
            own = (*seed, len(wanted) - turn)
            wanted.append(EpisodeTask(scenario, driver, own, task.reward, explore[turn]))
    return wanted


def iterations_ahead(
    iteration: int, left: int, steps: int, tasks: Sequence[Task], counts: Sequence[int]
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
    together = min(WARMED_UP_TOGETHER, MOST_KEPT // (2 * max(cavs, 1)), ceil(left / steps))
    return range(iteration, iteration + max(together, 1))
