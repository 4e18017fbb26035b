"""Methods that reduce delays at bottlenecks of motorways, and the candidates from which their parameters are selected.

Each method has `CANDIDATES_PER_METHOD` candidates: its default parameters, and sets of parameters that are drawn at
random before any evaluation.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from unjam.parameters import split_parameters

CANDIDATES_PER_METHOD, CANDIDATE_SEED = 18, 20261129
Domain = tuple[float, float] | list[Any]
"""possible values of a parameter: a tuple is an interval, a list has the values"""
LANE_CHANGE_DOMAINS: dict[str, Domain] = {"cruise.cooperation": [1.0, 1.0, None], "cruise.speed_gain": [0.0, None]}
"""settings of the lane changing of CAVs; None: those of the replaced vehicle. Two of three values are cooperation"""


@dataclass(frozen=True)
class Candidate:
    """A driver of the CAVs, and changes to the scenario."""

    driver: str
    settings: Mapping[str, Any]
    """changed settings of the scenario"""

    @property
    def regression_values(self) -> dict[str, float]:
        """All parameters as numbers for a regression, without switches (`*.active`).

        True is 1; settings of lane changing are 1 unless they are None.
        """
        _, parameters = split_parameters(self.driver)
        return {
            name: float(value is not None if name in LANE_CHANGE_DOMAINS else value)
            for name, value in {**parameters, **self.settings}.items()
            if not name.endswith(".active")
        }


@dataclass(frozen=True)
class Method:
    """A method that reduces delays, and the possible values of its parameters."""

    description: str
    """what the method does; a part of the random seed of its candidates, so other words give other candidates"""
    driver: str
    driver_domains: Mapping[str, Domain] = field(default_factory=dict)
    """possible values of parameters of the driver"""
    setting_domains: Mapping[str, Domain] = field(default_factory=dict)
    """possible values of settings of the scenario"""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """settings of the scenario that all candidates have"""

    def candidate(self, number: int) -> Candidate:
        """Return a candidate by its number; candidate 0 has the default parameters."""
        generator = np.random.default_rng([CANDIDATE_SEED, number, *self.description.encode()])
        if number == 0:
            return Candidate(self.driver, self.settings)
        values = {name: _draw_value(generator, domain) for name, domain in self.driver_domains.items()}
        settings = {name: _draw_value(generator, domain) for name, domain in self.setting_domains.items()}
        parameters = ",".join(f"{name}={value}" for name, value in values.items())
        driver = f"{self.driver}:{parameters}" if parameters else self.driver
        return Candidate(driver, {**self.settings, **settings})


def _draw_value(generator: np.random.Generator, domain: Domain) -> Any:
    """Draw a number from an interval, rounded to three significant digits, or a value of a list."""
    if isinstance(domain, tuple):
        low, high = domain
        return float(f"{generator.uniform(low, high):.3g}")
    return domain[int(generator.integers(len(domain)))]


METHODS = {
    "ACC": Method(
        "the ACC alone",
        "cruise",
        setting_domains={"cruise.time_gap": (1.1, 2.2), "cruise.acceleration": (1.0, 2.5), **LANE_CHANGE_DOMAINS},
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
        {"cruise.time_gap": (1.1, 1.4), **LANE_CHANGE_DOMAINS},
    ),
    "advisory speed": Method(
        "CAVs at a fixed speed upstream",
        "advisory-speed",
        {"advised_speed": (11.0, 25.0), "first_distance": (500.0, 3000.0), "last_distance": (0.0, 400.0)},
        LANE_CHANGE_DOMAINS,
    ),
    "speed limit": Method(
        "a variable speed limit for all vehicles",
        "cruise",
        setting_domains={
            "speed_limit_control.target_density": (16.0, 34.0),
            "speed_limit_control.gain": (0.005, 0.04),
            "speed_limit_control.min_limit": (11.2, 20.0),
            "speed_limit_control.length": (800.0, 2400.0),
            "speed_limit_control.acceleration_length": (200.0, 700.0),
            **LANE_CHANGE_DOMAINS,
        },
        settings={"speed_limit_control.active": True},
    ),
    "ramp meter": Method(
        "ramp meters",
        "cruise",
        setting_domains={
            "ramp_meter.target_density": (18.0, 40.0),
            "ramp_meter.gain": (10.0, 70.0),
            **LANE_CHANGE_DOMAINS,
        },
        settings={"ramp_meter.active": True},
    ),
}
"""the compared methods: `jam-ahead`, and the methods that it is compared with. SI units; densities are in veh/km"""
