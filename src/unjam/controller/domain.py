"""The intended use of a controller: its training scenario, its certified domain, and notes on other scenarios."""

import json
from collections.abc import Iterable
from typing import Any

import numpy as np

from unjam.controller import controller_path
from unjam.controller.certificate import OperatingDomain
from unjam.controller.file import CERTIFICATE_PART, Controller, read_controller
from unjam.drivers.local_state import LocalState
from unjam.errors import InputError
from unjam.files import UNREADABLE_ERRORS, parse_json
from unjam.parameters import build_dataclass, flatten_keys
from unjam.text import to_one_line
from unjam.worlds.record import Episode

IRRELEVANT_PARAMETERS = {
    *("horizon", "emission_class", "remember_warmup", "population", "recordings", "begin", "window", "platoon")
}  # parameters in which the scenario of a controller may differ without a note
KEY_PARAMETERS = ("length", "radius", "vehicles", "cavs", "penetration_rate", "warmup")
"""parameters in descriptions of scenarios"""
MAX_LISTED_PARAMETERS = 3  # largest number of parameters that a note lists
SB3_SUFFIX = ".zip"  # end of the file names of models of Stable-Baselines3
OUTSIDE_DOMAIN_THRESHOLD = 0.05  # share of control steps outside of the domain above which there is a note


def controller_notes(road: dict[str, Any], names: Iterable[str], episodes: dict[str, Episode]) -> list[str]:
    """Return notes on controllers that drive on another road than in training, or outside of their certified domain.

    `road` is the recipe of a scenario; `names` are names of drivers, and `episodes` their first episodes by name.
    """
    notes = []
    for name in names:
        if name.endswith(SB3_SUFFIX):
            step = road["simulation_step"] * road["steps_per_control_step"]
            notes.append(control_step_note(name, {step}))
        try:
            if controller_path(name) is None:
                continue
            controller = read_controller(name)
        except InputError:
            continue
        if mismatch := road_mismatch(controller.manifest, road):
            notes.append(f"{name} {mismatch}")
        states = [trajectory.states for trajectory in episodes[name].trajectories] if name in episodes else []
        share = max((outside_domain_share(controller, state) for state in states), default=0.0)
        if share > OUTSIDE_DOMAIN_THRESHOLD:
            share_text = f"{100 * share:.0f} % of the control steps of its first episode"
            notes.append(f"{name} was outside of its certified domain in {share_text}")
    return notes


def control_step_note(name: str, steps: Iterable[float]) -> str:
    """Return the note for a model of Stable-Baselines3 on roads with the given control steps [s]."""
    step_text = " or ".join(f"{step:g}" for step in sorted(set(steps)))
    example = f"{name}:policy_time_step=1.0"
    return f"{name} does not contain its control step: here it acts every {step_text} s; {example} sets another"


def road_mismatch(manifest: dict[str, Any], road: dict[str, Any]) -> str:
    """Return how a scenario differs from that of a controller's training; a range within the training's does not."""
    training_road = manifest.get("scenario")
    if not isinstance(training_road, dict):
        return ""
    verb = "tuned" if "tuning" in manifest else "trained"
    if training_road.get("kind") != road["kind"]:
        return f"was {verb} on the {_value_text(training_road.get('kind'))} road, not on the {road['kind']} road"
    training_values, values = map(_flatten_recipe, (training_road, road))
    common_names = [name for name in values if name in training_values and name not in IRRELEVANT_PARAMETERS]
    different_names = [name for name in common_names if not _is_within(training_values[name], values[name])]
    if not different_names:
        return ""
    listed = different_names[:MAX_LISTED_PARAMETERS]
    texts = [f"{name} {_value_text(values[name])} (there {_value_text(training_values[name])})" for name in listed]
    if len(different_names) > len(listed):
        texts.append(f"{len(different_names) - len(listed)} more")
    return f"was {verb} on the {road['kind']} road with other parameters: {', '.join(texts)}"


def _flatten_recipe(recipe: dict[str, Any]) -> dict[str, Any]:
    """Return a recipe with dotted keys, and with the number of its ramps."""
    if isinstance(ramps := recipe.get("ramps"), list | tuple):
        recipe = {**recipe, "ramps": {"count": len(ramps), **dict(enumerate(ramps))}}
    return flatten_keys(recipe)


def road_description(manifest: dict[str, Any]) -> str:
    """Return a short description of the scenario in a manifest; empty if it has none."""
    road = manifest.get("scenario")
    if not isinstance(road, dict):
        return ""
    texts = [f"{name} {_value_text(road[name])}" for name in KEY_PARAMETERS if road.get(name) is not None]
    return ", ".join([_value_text(road.get("kind")), *texts])


def _is_within(training_value: Any, value: Any) -> bool:
    """Return whether a value equals the value of the training, or lies within it if both are ranges."""
    training_value, value = json.loads(json.dumps([training_value, value]))  # turns tuples into lists
    are_ranges = isinstance(value, list) and isinstance(training_value, list) and len(value) == len(training_value) == 2
    return training_value == value or (are_ranges and training_value[0] <= value[0] and value[1] <= training_value[1])


def _value_text(value: Any) -> str:
    """Return a value from an untrusted file on one line; a range as `low-high`."""
    return to_one_line("-".join(map(str, dict.fromkeys(value))) if isinstance(value, list | tuple) else value)


def outside_domain_share(controller: Controller, states: LocalState) -> float:
    """Return the share of states outside of a controller's certified domain; 0 without a certificate."""
    if CERTIFICATE_PART not in controller.parts:
        return 0.0
    try:
        values = parse_json(controller.parts[CERTIFICATE_PART])["domain"]
        domain = build_dataclass(OperatingDomain, values, "certificate: domain")
    except (*UNREADABLE_ERRORS, InputError):  # `unjam verify` reports the error, which must not end a drive
        return 0.0
    return float(1.0 - np.mean(domain.contains(states)))
