"""What a controller is for: the road that it was trained on, what it met there, and notes on others."""

import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from unjam.controller import PACKAGED_PREFIX, packaged_file
from unjam.controller.certificate import OperatingDomain
from unjam.controller.file import CERTIFICATE_PART, Controller, read_controller
from unjam.drivers.driver import Driver
from unjam.drivers.local_state import LocalState
from unjam.errors import InputError
from unjam.files import UNREADABLE_ERRORS, parse_json
from unjam.parameters import build_dataclass, flatten_keys
from unjam.worlds.record import Episode

IRRELEVANT_PARAMETERS = {"horizon", "emission_class", "remember_warmup", "population"}
"""parameters of a scenario that make no other road of it"""
KEY_PARAMETERS = ("length", "radius", "vehicles", "cavs", "penetration_rate", "warmup")
"""parameters that tell roads of a kind apart at a glance"""
MAX_LISTED_PARAMETERS = 3
"""parameters that a note names"""
OUTSIDE_DOMAIN_THRESHOLD = 0.05
"""share of decisions outside of what a controller is certified for, from which a note says so"""


def controller_notes(road: dict[str, Any], names: Iterable[str], episodes: dict[str, Episode]) -> list[str]:
    """Return a line for each controller that was not made for this road, or met there what it never had.

    `road` is the recipe of the scenario; `shown` is what some of the drivers met, by name.
    """
    notes = []
    for name in names:
        controller = find_controller(name)
        if controller is None:
            continue
        if (other := road_mismatch(controller.manifest, road)) or (other := step_mismatch(controller.driver, road)):
            notes.append(f"{name} {other}")
        states = [each.states for each in episodes[name].trajectories] if name in episodes else []
        share = max((outside_domain_share(controller, each) for each in states), default=0.0)
        if share > OUTSIDE_DOMAIN_THRESHOLD:
            notes.append(f"{name} was outside of its certified domain in {100 * share:.0f} % of decisions")
    return notes


def find_controller(driver_name: str) -> Controller | None:
    """Return the controller that a driver's name stands for; None where it is none, or cannot be read."""
    shipped = driver_name.startswith(PACKAGED_PREFIX)
    path = packaged_file(driver_name.removeprefix(PACKAGED_PREFIX)) if shipped else Path(driver_name)
    try:
        return read_controller(path) if os.path.exists(path) and not driver_name.endswith(".py") else None
    except InputError:
        return None


def road_mismatch(manifest: dict[str, Any], road: dict[str, Any]) -> str:
    """Return in what a road is not the one that a controller was trained on; empty where it is, or unknown.

    `road` is the recipe of the scenario, as the manifest has one. A range within the trained one is the same.
    """
    trained = manifest.get("scenario")
    if not isinstance(trained, dict):
        return ""
    made = "tuned" if "tuning" in manifest else "trained"
    if trained.get("kind") != road["kind"]:
        return f"was {made} on the {_printable(trained.get('kind'))}, not on the {road['kind']}"
    there, here = flatten_keys(trained), flatten_keys(road)
    known = [name for name in here if name in there and name not in IRRELEVANT_PARAMETERS]
    differ = [name for name in known if not _is_within(there[name], here[name])]
    words = [
        f"{name} {_printable(here[name])} (there {_printable(there[name])})" for name in differ[:MAX_LISTED_PARAMETERS]
    ]
    more = [f"{len(differ) - MAX_LISTED_PARAMETERS} more"] if len(differ) > MAX_LISTED_PARAMETERS else []
    return f"was {made} on another {road['kind']}: {', '.join(words + more)}" if differ else ""


def step_mismatch(driver: Driver, road: dict[str, Any]) -> str:
    """Return that a driver counts time in steps which are not a road's decisions; empty where it does not.

    `road` is the recipe of the scenario. Of a driver by kind of road it is not known which of them drives.
    """
    step, recipe = road["simulation_step"] * road["steps_per_control_step"], driver.recipe()
    steps = set(_time_steps(recipe)) if recipe["kind"] != "road-type-switch" else set()
    if not steps or any(abs(each - step) < 1e-9 for each in steps):
        return ""
    counted = ", ".join(f"{each:g}" for each in sorted(steps))
    return f"counts time in steps of {counted} s, and decisions here take {step:g} s"


def _time_steps(recipe: Any) -> Iterator[float]:
    """Yield each time step in a driver's recipe [s]."""
    if isinstance(recipe, dict):
        for name, part in recipe.items():
            yield from [part] if name == "time_step" else _time_steps(part)
    elif isinstance(recipe, list):
        for part in recipe:
            yield from _time_steps(part)


def road_description(manifest: dict[str, Any]) -> str:
    """Return in words for which road a controller was made; empty where its manifest names none."""
    made = manifest.get("scenario")
    if not isinstance(made, dict):
        return ""
    facts = [f"{name} {_printable(made[name])}" for name in KEY_PARAMETERS if made.get(name) is not None]
    return ", ".join([_printable(made.get("kind")), *facts])


def _is_within(training_value: Any, value: Any) -> bool:
    """Return whether a value is that of the training; of a range, whether it lies within."""
    training_value, value = json.loads(json.dumps([training_value, value]))  # tuples are lists there
    pair = isinstance(value, list) and isinstance(training_value, list) and len(value) == len(training_value) == 2
    return training_value == value or (pair and training_value[0] <= value[0] and value[1] <= training_value[1])


def _printable(value: Any) -> str:
    """Return a value that somebody else wrote, on one line and without what a terminal would act on."""
    text = "-".join(map(str, dict.fromkeys(value))) if isinstance(value, list | tuple) else str(value)
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def outside_domain_share(controller: Controller, states: LocalState) -> float:
    """Return the share of states in which a certified controller was never seen; 0 of one without."""
    if CERTIFICATE_PART not in controller.parts:
        return 0.0
    try:
        domain = build_dataclass(
            OperatingDomain, parse_json(controller.parts[CERTIFICATE_PART])["domain"], "certificate: domain"
        )
    except (*UNREADABLE_ERRORS, InputError):  # `unjam verify` says so; what was driven is not lost for it
        return 0.0
    return float(1.0 - np.mean(domain.contains(states)))
