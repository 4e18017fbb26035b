"""Named starting points of a training run, from `presets.toml` and from other installed packages."""

import operator
import tomllib
from functools import cache, reduce
from pathlib import Path
from typing import Any, cast

from unjam.errors import invalid_value, unknown_name
from unjam.parameters import merge_changes
from unjam.plugins import load_plugins
from unjam.road_family import FAMILY
from unjam.scenarios.family import family_scenarios
from unjam.scenarios.ring import LoopScenario
from unjam.scenarios.scenario import Scenario

BRAKING_COST = 0.0075
"""weight of the reward's acceleration term on loops, where the speed term is 1 at the speed limit"""
ON_RAMP_TASK_WEIGHT = 0.3333
"""weight of an on-ramp task: an episode has as many CAVs and takes as long as twenty episodes on rings"""


@cache
def _packaged_presets() -> dict[str, dict[str, Any]]:
    return tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


@cache
def all_presets() -> dict[str, dict[str, Any]]:
    """Return the presets of unjam and of other packages by name; their entry `on` has values for single scenarios."""
    return reduce(operator.or_, load_plugins("unjam.presets").values(), _packaged_presets())


def preset_values(preset: str, scenario: str) -> dict[str, Any]:
    """Return the values of a preset for a scenario; raise `InputError` if there is no such preset."""
    presets = _packaged_presets() if preset in _packaged_presets() else all_presets()
    if preset not in presets:
        raise unknown_name("preset", preset, presets)
    by_scenario = presets[preset].get("on", {})
    values = _merge_like(by_scenario.get(scenario, presets[preset]))
    if not values:
        raise invalid_value("scenario", scenario, f"with the preset {preset}: {', '.join(by_scenario)}")
    if group := values.pop("road_group", ""):
        values["tasks"] = [_family_task(name, road) for name, road in family_scenarios(group, "training").items()]
    return values


def _merge_like(values: dict[str, Any]) -> dict[str, Any]:
    """Return the values of the preset that the entry `like` names, changed by the other values."""
    changes = {key: value for key, value in values.items() if key not in ("on", "like")}
    if "like" not in values:
        return changes
    return merge_changes(_merge_like(reduce(operator.getitem, values["like"].split("."), _packaged_presets())), changes)


def _family_task(name: str, scenario: Scenario) -> dict[str, Any]:
    """Return a road of the family as a task; on loops, the speed in the reward is relative to the speed limit."""
    task = {"scenario": FAMILY[name].scenario, "scenario_options": FAMILY[name].options, "reward": "", "name": name}
    if not scenario.is_closed:
        return {**task, "weight": ON_RAMP_TASK_WEIGHT}
    loop = cast(LoopScenario, scenario)
    limits = [loop.limit_speed(size) for size in loop.drawn_ranges[loop.size_parameter]]
    speed = round(5.0 * len(limits) / sum(limits), 4)
    return {**task, "reward": f"released:speed={speed},acceleration={BRAKING_COST}"}
