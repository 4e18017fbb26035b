"""Scenarios: roads, traffic, how an episode starts and ends."""

from collections.abc import Mapping
from dataclasses import asdict
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from unjam.drivers.user_driver import is_file_reference, object_label
from unjam.errors import invalid_value
from unjam.parameters import build_dataclass, merge_changes, nest_keys
from unjam.road_family import FAMILY_PREFIX, FAMILY_SCENARIOS
from unjam.scenarios.figure_eight import FigureEight
from unjam.scenarios.merge import Merge
from unjam.scenarios.motorway import MOTORWAY_SCENARIOS, Motorway, Ramp
from unjam.scenarios.population import read_population
from unjam.scenarios.recorded import Recorded
from unjam.scenarios.ring import Ring
from unjam.scenarios.road import Road
from unjam.scenarios.scenario import Scenario
from unjam.scenarios.user_network import UserNetwork, load_user_network
from unjam.scenarios.user_scenario import CODE_ENTRY, class_recipe, load_class, load_python_scenario, load_toml_scenario

__all__ = [
    "SCENARIOS",
    "FigureEight",
    "Merge",
    "Motorway",
    "Ramp",
    "Recorded",
    "Ring",
    "Road",
    "Scenario",
    "make_scenario",
]

SCENARIOS: dict[str, Scenario] = {
    "ring": Ring(),
    "ring-warm": Ring(warmup=750),
    "ring-jammed": Ring(warmup=6000),
    "figure-eight": FigureEight(),
    "figure-eight-30": FigureEight(radius=(30, 30)),
    "merge": Merge(),
    **MOTORWAY_SCENARIOS,
    "recorded": Recorded(),
}

EXAMPLE_PENETRATION_RATE = 0.1
"""penetration rate of a user network in lists and samples"""
TOML_KINDS: dict[str, type[Scenario]] = {kind.title: kind for kind in (Ring, FigureEight, Merge, Motorway, Recorded)}
"""kinds of road that a TOML file describes, by title"""
SCENARIO_KINDS = {**TOML_KINDS, UserNetwork.title: UserNetwork}
"""all kinds of road"""


ScenarioLike = str | Scenario | type[Scenario]
"""a scenario, its class, or its name: of a built-in one, `family/NAME`, a .sumocfg or .toml file, or `path.py:name`"""


def make_scenario(scenario: ScenarioLike, changes: dict[str, Any] | None = None) -> Scenario:
    """Return a scenario with `changes` to its parameters.

    A dot in a name leads into a group of parameters: `{"safety.time_gap": 1.5, "ramps.0.inflow": 600}`. Raise
    `InputError` for an unknown scenario or parameter, or a value out of range.
    """
    if not isinstance(changes, Mapping | None):
        raise invalid_value("scenario options", changes, "a dict of parameters of the scenario")
    changes = nest_keys(changes or {})
    if isinstance(scenario, str) and scenario.endswith(".sumocfg"):
        return load_user_network(scenario, changes)
    base, name = _base_scenario(scenario), scenario if isinstance(scenario, str) else object_label(scenario)
    if not changes:
        return base
    if file := changes.get("population"):  # it decides the typical parameters and `human_control`
        population = read_population(str(file))
        commanded = {"human_control": "commanded"} if population.residual else {}
        changes = {"humans": asdict(population.typical), **commanded, **changes}
    return build_dataclass(type(base), merge_changes(asdict(base), changes), f"scenario {name}")


def _base_scenario(scenario: ScenarioLike) -> Scenario:
    """Return a scenario without changes; .sumocfg files are not supported."""
    if isinstance(scenario, Scenario):
        return scenario
    if isinstance(scenario, type):
        return build_dataclass(scenario, {}, f"scenario {scenario.__name__}")
    if not isinstance(scenario, str):
        raise invalid_value("scenario", scenario, "a name, a Scenario, or its class")
    if is_file_reference(scenario):
        return load_python_scenario(scenario)
    if scenario.endswith(".toml"):
        return load_toml_scenario(Path(scenario), TOML_KINDS)[0]
    if scenario == Motorway.title:  # the kind of a TOML file, without its settings
        return Motorway()
    if family_road := FAMILY_SCENARIOS.get(scenario):
        return make_scenario(family_road.scenario, family_road.options)
    if scenario not in SCENARIOS:
        names = {name.removeprefix(FAMILY_PREFIX): name for name in (*FAMILY_SCENARIOS, *SCENARIOS)}
        close = get_close_matches(scenario.removeprefix(FAMILY_PREFIX), names, 1)
        hint = f"; did you mean {names[close[0]]!r}?" if close else ""
        if scenario.startswith(FAMILY_PREFIX):
            raise invalid_value("scenario", scenario, f"one that `unjam scenarios family` lists{hint}")
        other_forms = f"{FAMILY_PREFIX}NAME", "a .sumocfg or .toml file", "path.py:name"
        raise invalid_value("scenario", scenario, f"{', '.join((*SCENARIOS, *other_forms))}{hint}")
    return SCENARIOS[scenario]


def default_scenario(name: str) -> Scenario | type[Scenario]:
    """Return the scenario or class with the default settings of a named scenario; `Scenario` if the name is unknown."""
    if name.endswith(".sumocfg"):
        return UserNetwork
    is_built_in = name in (*SCENARIOS, *FAMILY_SCENARIOS, Motorway.title)
    is_known = is_built_in or name.endswith(".toml") or is_file_reference(name)
    return _base_scenario(name) if is_known else Scenario


def inline_toml_file(values: dict[str, Any]) -> dict[str, Any]:
    """Return a configuration with the content of a scenario's TOML file, which may change, instead of its name."""
    name = values.get("scenario")
    if not isinstance(name, str) or not name.endswith(".toml"):
        return values
    scenario, settings = load_toml_scenario(Path(name), TOML_KINDS)
    options = values.get("scenario_options", {})
    options = merge_changes(settings, nest_keys(options)) if isinstance(options, dict) else options
    return {**values, "scenario": scenario.title, "scenario_options": options}


def example_scenario(name: str) -> Scenario:
    """Return a scenario for lists and samples; a user network has `EXAMPLE_PENETRATION_RATE`."""
    return make_scenario(name, {"penetration_rate": EXAMPLE_PENETRATION_RATE} if name.endswith(".sumocfg") else None)


def scenario_recipe(scenario: Scenario) -> dict[str, Any]:
    """Return a scenario as JSON; raise `InputError` for a class that another process cannot import."""
    kind = type(scenario)
    code = {} if SCENARIO_KINDS.get(kind.title) is kind else {CODE_ENTRY: class_recipe(kind)}
    return {"kind": kind.title, **code, **asdict(scenario)}


def scenario_from_recipe(recipe: dict[str, Any]) -> Scenario:
    """Return the scenario of a recipe; run the Python file of a user's class, which must be unchanged."""
    values = dict(recipe)
    title, code = values.pop("kind", ""), values.pop(CODE_ENTRY, None)
    if code is None and title not in SCENARIO_KINDS:
        raise invalid_value("scenario.kind", title, ", ".join(SCENARIO_KINDS))
    return build_dataclass(SCENARIO_KINDS[title] if code is None else load_class(code), values, "scenario")
