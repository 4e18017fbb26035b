"""Ways to reduce delays at bottlenecks of motorways, with the candidates among which each of them is tuned.

All have the same budget: `CANDIDATES_PER_METHOD` sets of parameters, drawn at random before anything is evaluated.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unjam.parameters import split_parameters

CANDIDATES_PER_METHOD, CANDIDATE_SEED = 18, 20261129
Range = tuple[float, float] | Sequence[Any]
"""a range of numbers, or a list of values"""


@dataclass(frozen=True)
class Candidate:
    """What drives the CAVs, and what else is changed on the road."""

    driver: str
    settings: Mapping[str, Any]
    """settings of the scenario"""

    @property
    def numbers(self) -> dict[str, float]:
        """All parameters as numbers: a way to change lanes is 1 if it is set, a choice 1 if it is true."""
        _, parameters = split_parameters(self.driver)
        values = {**parameters, **self.settings}
        kept = {name: each for name, each in values.items() if not name.endswith(".active")}
        return {name: float(each is not None if name in LANE_CHANGING else each) for name, each in kept.items()}


@dataclass(frozen=True)
class Method:
    """A way to reduce delays, and the ranges of its parameters."""

    description: str
    """what it does; its candidates are drawn from this text: another text is another tuning"""
    driver: str
    driver_ranges: Mapping[str, Range] = field(default_factory=dict)
    """ranges of parameters of the driver"""
    setting_ranges: Mapping[str, Range] = field(default_factory=dict)
    """ranges of settings of the scenario"""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """settings of the scenario that all candidates have"""

    def candidate(self, number: int) -> Candidate:
        """Return a candidate; the first one has the default parameters."""
        generator = np.random.default_rng([CANDIDATE_SEED, number, *self.description.encode()])
        if number == 0:
            return Candidate(self.driver, self.settings)
        values = {name: _draw(generator, each) for name, each in self.driver_ranges.items()}
        settings = {name: _draw(generator, each) for name, each in self.setting_ranges.items()}
        parameters = ",".join(f"{name}={value}" for name, value in values.items())
        driver = f"{self.driver}:{parameters}" if parameters else self.driver
        return Candidate(driver, {**self.settings, **settings})


def _draw(generator: np.random.Generator, values: Range) -> Any:
    if isinstance(values, tuple):
        low, high = values
        return float(f"{generator.uniform(low, high):.3g}")
    return values[int(generator.integers(len(values)))]


LANE_CHANGING: dict[str, Range] = {"cruise.cooperation": [1.0, 1.0, None], "cruise.speed_gain": [0.0, None]}
"""how CAVs change lanes; two in three candidates cooperate"""
METHODS = {
    "ACC": Method(
        "the ACC alone",
        "cruise",
        setting_ranges={"cruise.time_gap": (1.1, 2.2), "cruise.acceleration": (1.0, 2.5), **LANE_CHANGING},
    ),
    "jam-ahead": Method(
        "CAVs near the mean speed ahead",
        "jam-ahead",
        {
            "first_section": [0, 1, 2, 3, 4],
            "last_section": [4, 6, 8, 10],
            "speed_margin": (-3.0, 4.0),
            "margin_by_penetration": [0.0, 20.0],
            "min_speed": (5.0, 18.0),
            "all_lanes": ["false", "true"],
            "free_speed_ratio": (0.5, 1.0),
        },
        {"cruise.time_gap": (1.1, 1.4), **LANE_CHANGING},
    ),
    "advisory speed": Method(
        "CAVs at a fixed speed upstream",
        "advisory-speed",
        {"advised_speed": (11.0, 25.0), "first_distance": (500.0, 3000.0), "last_distance": (0.0, 400.0)},
        LANE_CHANGING,
    ),
    "speed limit": Method(
        "a variable speed limit for all vehicles",
        "cruise",
        setting_ranges={
            "speed_limit_control.target_density": (16.0, 34.0),
            "speed_limit_control.gain": (0.005, 0.04),
            "speed_limit_control.min_limit": (11.2, 20.0),
            "speed_limit_control.length": (800.0, 2400.0),
            "speed_limit_control.acceleration_length": (200.0, 700.0),
            **LANE_CHANGING,
        },
        settings={"speed_limit_control.active": True},
    ),
    "ramp meter": Method(
        "ramp meters",
        "cruise",
        setting_ranges={"ramp_meter.target_density": (18.0, 40.0), "ramp_meter.gain": (10.0, 70.0), **LANE_CHANGING},
        settings={"ramp_meter.active": True},
    ),
}
"""the methods that are compared; all but `jam-ahead` are its opponents"""
