"""What a controller is for: the road that it was trained on, what it met there, and notes on others."""

import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from unjam.controller import SHIPPED, shipped_file
from unjam.controller.certificate import Domain
from unjam.controller.file import CERTIFICATE, Controller, read_controller
from unjam.drivers.driver import Driver
from unjam.drivers.local_state import LocalState
from unjam.errors import InputError
from unjam.files import NONE_OF_OURS, parse_json
from unjam.parameters import build, flat
from unjam.worlds.record import Episode

WITHOUT_EFFECT = {"horizon", "emission_class", "recall_warmup", "population"}
"""parameters of a scenario that make no other road of it"""
FACTS = ("length", "radius", "vehicles", "cavs", "cav_share", "warmup")
"""parameters that tell roads of a kind apart at a glance"""
SHOWN = 3
"""parameters that a note names"""
MUCH = 0.05
"""share of decisions outside of what a controller is certified for, from which a note says so"""


def notes_on_controllers(road: dict[str, Any], names: Iterable[str], shown: dict[str, Episode]) -> list[str]:
    """Return a line for each controller that was not made for this road, or met there what it never had.

    `road` is the recipe of the scenario; `shown` is what some of the drivers met, by name.
    """
    notes = []
    for name in names:
        controller = controller_of(name)
        if controller is None:
            continue
        if (other := other_road(controller.manifest, road)) or (other := other_step(controller.driver, road)):
            notes.append(f"{name} {other}")
        states = [each.states for each in shown[name].trajectories] if name in shown else []
        share = max((outside_domain(controller, each) for each in states), default=0.0)
        if share > MUCH:
            notes.append(f"{name} was outside of its certified domain in {100 * share:.0f} % of decisions")
    return notes


def controller_of(text: str) -> Controller | None:
    """Return the controller that a driver's name stands for; None where it is none, or cannot be read."""
    shipped = text.startswith(SHIPPED)
    path = shipped_file(text.removeprefix(SHIPPED)) if shipped else Path(text)
    try:
        return read_controller(path) if os.path.exists(path) and not text.endswith(".py") else None
    except InputError:
        return None


def other_road(manifest: dict[str, Any], road: dict[str, Any]) -> str:
    """Return in what a road is not the one that a controller was trained on; empty where it is, or unknown.

    `road` is the recipe of the scenario, as the manifest has one. A range within the trained one is the same.
    """
    trained = manifest.get("scenario")
    if not isinstance(trained, dict):
        return ""
    made = "tuned" if "tuned" in manifest else "trained"
    if trained.get("kind") != road["kind"]:
        return f"was {made} on the {_short(trained.get('kind'))}, not on the {road['kind']}"
    there, here = flat(trained), flat(road)
    known = [name for name in here if name in there and name not in WITHOUT_EFFECT]
    differ = [name for name in known if not _within(there[name], here[name])]
    words = [f"{name} {_short(here[name])} (there {_short(there[name])})" for name in differ[:SHOWN]]
    more = [f"{len(differ) - SHOWN} more"] if len(differ) > SHOWN else []
    return f"was {made} on another {road['kind']}: {', '.join(words + more)}" if differ else ""


def other_step(driver: Driver, road: dict[str, Any]) -> str:
    """Return that a driver counts time in steps which are not a road's decisions; empty where it does not.

    `road` is the recipe of the scenario. Of a driver by kind of road it is not known which of them drives.
    """
    step, recipe = road["simulation_step"] * road["steps_per_decision"], driver.recipe()
    steps = set(_time_steps(recipe)) if recipe["kind"] != "by-road" else set()
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


def road_of(manifest: dict[str, Any]) -> str:
    """Return in words for which road a controller was made; empty where its manifest names none."""
    made = manifest.get("scenario")
    if not isinstance(made, dict):
        return ""
    facts = [f"{name} {_short(made[name])}" for name in FACTS if made.get(name) is not None]
    return ", ".join([_short(made.get("kind")), *facts])


def _within(trained: Any, now: Any) -> bool:
    """Return whether a value is that of the training; of a range, whether it lies within."""
    trained, now = json.loads(json.dumps([trained, now]))  # tuples are lists there
    pair = isinstance(now, list) and isinstance(trained, list) and len(now) == len(trained) == 2
    return trained == now or (pair and trained[0] <= now[0] and now[1] <= trained[1])


def _short(value: Any) -> str:
    """Return a value that somebody else wrote, on one line and without what a terminal would act on."""
    text = "-".join(map(str, dict.fromkeys(value))) if isinstance(value, list | tuple) else str(value)
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def outside_domain(controller: Controller, states: LocalState) -> float:
    """Return the share of states in which a certified controller was never seen; 0 of one without."""
    if CERTIFICATE not in controller.parts:
        return 0.0
    try:
        domain = build(Domain, parse_json(controller.parts[CERTIFICATE])["domain"], "certificate: domain")
    except (*NONE_OF_OURS, InputError):  # `unjam verify` says so; what was driven is not lost for it
        return 0.0
    return float(1.0 - np.mean(domain.holds(states)))
