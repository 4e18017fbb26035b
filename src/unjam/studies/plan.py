"""What studies train: a road, a variant of the method, a seed. Studies that want the same one share it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

from unjam.training.config import RunConfig, load_config

BUDGET = 300_000
"""actual steps of every learner"""
LONG_BUDGET = 4_000_000
"""the paper's own"""

ROADS: dict[str, dict[str, Any]] = {
    "ring": {"scenario": "ring"},
    "ring-jammed": {"scenario": "ring-jammed"},
    "ring-11": {"scenario": "ring", "road.vehicles": 11},
    "ring-5": {"scenario": "ring", "road.vehicles": 5},
    "figure-eight": {"scenario": "figure-eight"},
    "merge": {"scenario": "merge"},
}
PAPERS_ROADS = ("ring", "figure-eight", "merge")


@dataclass(frozen=True)
class Variant:
    """A way to learn, as changes to a preset."""

    label: str
    preset: str
    changes: dict[str, Any]
    steps: int | None = BUDGET
    """None: those of the preset"""


ALONE = {"expert": "none", "virtual.virtual_ratio": 0.0}
VARIANTS: dict[str, Variant] = {
    "trpo": Variant("TRPO", "paper", ALONE),
    "ppo": Variant("PPO", "paper", {"agent": "ppo", **ALONE}),
    "sac": Variant("SAC", "paper", {"agent": "sac", **ALONE}),
    "mb-trpo": Variant("MB-TRPO", "paper", {"expert": "none", "virtual.base": "none"}),
    "no-initial-policy": Variant("no initial policy", "paper", {"expert": "none"}),
    "without-model": Variant("residual without model", "paper", {"virtual.virtual_ratio": 0.0}),
    "proposed": Variant("proposed", "paper", {}),
    "proposed-ppo": Variant("proposed with PPO", "paper", {"agent": "ppo"}),
    "proposed-sac": Variant("proposed with SAC", "paper", {"agent": "sac"}),
    "trpo-long": Variant("TRPO, 4 M steps", "paper", ALONE, LONG_BUDGET),
    "proposed-long": Variant("proposed, 4 M steps", "paper", {}, LONG_BUDGET),
    "ours": Variant("ours", "best", {}),
    "ours-without-model": Variant("ours without model", "best", {"virtual.virtual_ratio": 0.0}),
    "ours-with-model": Variant("ours with model", "best", {"virtual.virtual_ratio": 5.0}),
    "ours-on-pi": Variant("ours on PI", "best", {"expert": "pi"}),
    "best": Variant("ours, all its steps", "best", {}, None),
}
"""the paper's methods with the paper's settings, and what we make of them"""


@dataclass(frozen=True)
class PlannedRun:
    """A training that a study needs."""

    road: str
    variant: str
    seed: int

    @property
    def name(self) -> str:
        """Its place among all trainings of the studies."""
        return f"{self.road}/{self.variant}/{self.seed}"

    @cached_property
    def config(self) -> RunConfig:
        """Its configuration: one worker, judged without drivers that all trainings would share."""
        variant = VARIANTS[self.variant]
        changes = {
            **ROADS[self.road],
            "seed": self.seed,
            "workers": 1,
            "evaluation.baselines": [],
            **variant.changes,
        }
        if variant.steps is not None:
            changes["steps"] = variant.steps
        return load_config(preset=variant.preset, changes=changes)


def planned(roads: Iterable[str], variants: Sequence[str], seeds: int) -> list[PlannedRun]:
    """Return the runs of all variants on all roads: all of one seed first."""
    return [
        PlannedRun(road, variant, seed)
        for seed, road, variant in product(range(seeds), tuple(roads), variants)
    ]
