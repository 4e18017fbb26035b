"""What a study is: which trainings it needs, and what is made of them."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from unjam.studies.plan import PlannedRun
from unjam.studies.pool import Pool


@dataclass(frozen=True)
class Study:
    """A table or a figure of the paper."""

    title: str
    runs: Callable[[int], list[PlannedRun]]
    """the trainings for a number of seeds"""
    write: Callable[[Pool, int, Path, int], None]
    """measures what else it needs, and writes numbers and pictures into a folder: (pool, seeds, folder,
    processes)"""
    roads: tuple[str, ...] = ()
    """where drivers that do not learn are driven beside them"""
    minutes: float = 0.0
    """what it takes beside trainings and drives, on two cores"""
