"""What a controller says of itself: what it observes and remembers, in which order, units and scales."""

from typing import Any

import numpy as np

from unjam.drivers.driver import Driver
from unjam.drivers.local_state import STATE_UNITS
from unjam.drivers.observation import observed
from unjam.drivers.residual import ResidualDriver
from unjam.drivers.wrappers import Mixed

FORMAT = 2
"""schema version of the manifest"""
READABLE = (1, FORMAT)
"""versions that can be read; the first had no description, sample or graph"""


def description(driver: Driver, action_limit: float | None = None) -> dict[str, Any]:
    """Return what whoever runs a controller must know beside the recipe of its driver, as JSON.

    Args:
        driver: the controller's.
        action_limit: of the road it is for [m/s2], where the driver has none of its own.

    Returns:
        `observation`: what it is given at each decision, in order, in SI units; `networks`: what each of its
        networks sees, in order, by the prefix of its weights: each number is divided by its scale;
        `memory`: what it remembers of each CAV, with its value before the first decision, null where that
        is NaN; `action`: the acceleration that it answers, clipped to these bounds; `hold`: decisions for
        which a residual is held.
    """
    limit = driver.action_limit if isinstance(driver, ResidualDriver) else action_limit
    return {
        "observation": [{"name": name, "unit": unit} for name, unit in STATE_UNITS.items()],
        "networks": _networks(driver),
        "memory": [_remembered(name, value[0]) for name, value in driver.initial_memory(1).items()],
        "action": {
            "name": "acceleration",
            "unit": "m/s2",
            "low": None if limit is None else -limit,
            "high": limit,
        },
        "hold": driver.hold if isinstance(driver, ResidualDriver) else 1,
    }


def _networks(driver: Driver, prefix: str = "") -> dict[str, list[dict[str, Any]]]:
    if isinstance(driver, ResidualDriver):
        seen = [number._asdict() for number in observed(driver.parts, driver.expert)]
        return {prefix: seen, **_networks(driver.expert, f"{prefix}expert.")}
    if isinstance(driver, Mixed):
        parts = [_networks(part, f"{prefix}{number}.") for number, part in enumerate(driver.drivers)]
        return {name: seen for part in parts for name, seen in part.items()}
    return {}


def _remembered(name: str, value: Any) -> dict[str, Any]:
    """Return the name, shape and first value of what is remembered of one CAV."""
    values = np.asarray(value, np.float64)
    same = bool(values.size) and np.array_equal(values, np.full_like(values, values.flat[0]), equal_nan=True)
    first = values.flat[0].item() if same else values.tolist()
    return {
        "name": name,
        "shape": list(values.shape),
        "first": None if same and np.isnan(values.flat[0]) else first,
    }
