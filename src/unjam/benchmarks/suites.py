"""Suites: named and versioned sets of roads with fixed test seeds, and the reference values of their best experts."""

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from unjam.errors import unknown_name
from unjam.road_family import FAMILY

DEFAULT_SUITE = "all-roads-v1"


@dataclass(frozen=True)
class Suite:
    """A set of roads of the family; the roads, test seeds and reference values of a suite never change."""

    name: str
    description: str
    roads: tuple[str, ...]


_SUITES = (
    Suite(DEFAULT_SUITE, "all 34 roads of the family: rings, figure eights, on-ramps", tuple(FAMILY)),
    Suite(
        "closed-roads-v1",
        "12 rings and figure eights, one for each property in which those of the family differ, all with a gain of the "
        "best expert of at least 3 %; six are training roads, six are unseen; minutes on one core",
        (
            *("ring-22-no-warm-up", "ring-33-growing-3-cavs", "ring-44-grown", "ring-22-aggressive"),
            *("ring-22-delayed", "figure-eight-14", "ring-66-growing-2-cavs", "ring-22-dense", "ring-44-grown-5-cavs"),
            *("ring-22-noisy-sensors", "ring-22-ngsim", "figure-eight-wide"),
        ),
    ),
    Suite(
        "motorways-v1",
        "the 5 on-ramps of the family where the best expert gains at least 3 %; two are training roads, three are "
        "unseen; an hour on one core",
        ("on-ramp-5", "on-ramp-20", "on-ramp-10", "on-ramp-10-more-demand", "one-lane-10"),
    ),
)
SUITES = {suite.name: suite for suite in _SUITES}


def find_suite(name: str) -> Suite:
    """Return the suite with this name; raise `InputError` if it does not exist."""
    if not isinstance(name, str) or name not in SUITES:
        raise unknown_name("suite", name, SUITES)
    return SUITES[name]


@cache
def load_references() -> dict[str, dict[str, Any]]:
    """Return the best tuned `expert` of each road, its `performance` and that of the `baseline` for each test seed."""
    return json.loads((files("unjam.benchmarks") / "references.json").read_text(encoding="utf-8"))["roads"]
