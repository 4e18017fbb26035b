"""What a controller is for: the road that it was trained on, and what it met there."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from unjam.controller.certificate import Domain
from unjam.controller.file import CERTIFICATE, Controller, read_controller
from unjam.drivers.local_state import LocalState
from unjam.errors import InputError
from unjam.parameters import build, flat

WITHOUT_EFFECT = {"horizon", "emission_class", "recall_warmup", "population"}
"""parameters of a scenario that make no other road of it"""
FACTS = ("length", "radius", "vehicles", "cavs", "cav_share", "warmup")
"""parameters that tell roads of a kind apart at a glance"""
SHOWN = 3
"""parameters that a note names"""


def controller_of(text: str, file: Path | None) -> Controller | None:
    """Return the controller that a driver's name stands for; None where it is none, or cannot be read."""
    path = file or Path(text)
    try:
        return read_controller(path) if os.path.exists(path) and (file or not text.endswith(".py")) else None
    except InputError:
        return None


def other_road(manifest: dict[str, Any], road: dict[str, Any]) -> str:
    """Return in what a road is not the one that a controller was trained on; empty where it is, or unknown.

    Args:
        manifest: the controller's.
        road: recipe of the scenario, as the manifest has one. A range within the trained one is the same.
    """
    trained = manifest.get("scenario")
    if not isinstance(trained, dict):
        return ""
    made = "tuned" if "tuned" in manifest else "trained"
    if trained["kind"] != road["kind"]:
        return f"was {made} on the {trained['kind']}, not on the {road['kind']}"
    there, here = flat(trained), flat(road)
    known = [name for name in here if name in there and name not in WITHOUT_EFFECT]
    differ = [name for name in known if not _within(there[name], here[name])]
    words = [f"{name} {_short(here[name])} (there {_short(there[name])})" for name in differ[:SHOWN]]
    more = [f"{len(differ) - SHOWN} more"] if len(differ) > SHOWN else []
    return f"was {made} on another {road['kind']}: {', '.join(words + more)}" if differ else ""


def road_of(manifest: dict[str, Any]) -> str:
    """Return in words for which road a controller was made; empty where its manifest names none."""
    made = manifest.get("scenario")
    if not isinstance(made, dict):
        return ""
    facts = [f"{name} {_short(made[name])}" for name in FACTS if name in made]
    return ", ".join([str(made.get("kind")), *facts])


def _within(trained: Any, now: Any) -> bool:
    """Return whether a value is that of the training; of a range, whether it lies within."""
    trained, now = json.loads(json.dumps([trained, now]))  # tuples are lists there
    pair = isinstance(now, list) and isinstance(trained, list) and len(now) == len(trained) == 2
    return trained == now or (pair and trained[0] <= now[0] and now[1] <= trained[1])


def _short(value: Any) -> str:
    return "-".join(map(str, dict.fromkeys(value))) if isinstance(value, list | tuple) else str(value)


def outside_domain(controller: Controller, states: LocalState) -> float:
    """Return the share of states in which a certified controller was never seen; 0 of one without."""
    if CERTIFICATE not in controller.parts:
        return 0.0
    domain = build(Domain, json.loads(controller.parts[CERTIFICATE])["domain"], "certificate: domain")
    return float(1.0 - np.mean(domain.holds(states)))
