"""Methods that reduce delays at bottlenecks of motorways, and the candidates from which their parameters are selected.

Each method has `CANDIDATES_PER_METHOD` candidates: sets of parameters that are drawn at random before any evaluation.
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
    """A driver of the CAVs, and changes to the scenario."""

    driver: str
    settings: Mapping[str, Any]
    """changed settings of the scenario"""

    @property
    def numbers(self) -> dict[str, float]:
        """All parameters as numbers; settings of lane changing are 1 if they are set, and booleans if they are true."""
        _, parameters = split_parameters(self.driver)
        return {
            name: float(value is not None if name in LANE_CHANGING else value)
            for name, value in {**parameters, **self.settings}.items()
            if not name.endswith(".active")
        }


@dataclass(frozen=True)
class Method:
    """A method that reduces delays, and the ranges of its parameters."""

    description: str
    """what the method does; a part of the random seed of its candidates, so other words give other candidates"""
    driver: str
    driver_ranges: Mapping[str, Range] = field(default_factory=dict)
    """ranges of parameters of the driver"""
    setting_ranges: Mapping[str, Range] = field(default_factory=dict)
    """ranges of settings of the scenario"""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """settings of the scenario that all candidates have"""

    def candidate(self, number: int) -> Candidate:
        """Return a candidate by its number; candidate 0 has the default parameters."""
        generator = np.random.default_rng([CANDIDATE_SEED, number, *self.description.encode()])
        if number == 0:
            return Candidate(self.driver, self.settings)
        values = {name: _draw_value(generator, limits) for name, limits in self.driver_ranges.items()}
        settings = {name: _draw_value(generator, limits) for name, limits in self.setting_ranges.items()}
        parameters = ",".join(f"{name}={value}" for name, value in values.items())
        driver = f"{self.driver}:{parameters}" if parameters else self.driver
        return Candidate(driver, {**self.settings, **settings})


def _draw_value(generator: np.random.Generator, values: Range) -> Any:
    """Draw a number of three digits from a range, or a value of a list."""
    if isinstance(values, tuple):
        low, high = values
        return float(f"{generator.uniform(low, high):.3g}")
    return values[int(generator.integers(len(values)))]


LANE_CHANGING: dict[str, Range] = {"cruise.cooperation": [1.0, 1.0, None], "cruise.speed_gain": [0.0, None]}
"""settings of the lane changing of CAVs; two of three candidates cooperate"""
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
"""the compared methods: `jam-ahead` and its opponents"""
