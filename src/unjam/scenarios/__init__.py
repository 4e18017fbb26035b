"""Scenarios: roads, traffic, how an episode starts and ends."""

from dataclasses import asdict
from typing import Any

from unjam.errors import InputError, unknown_name
from unjam.parameters import build_dataclass, merge_changes, nest_keys
from unjam.scenarios.figure_eight import FigureEight
from unjam.scenarios.merge import Merge
from unjam.scenarios.motorway import MOTORWAY_SCENARIOS, Motorway, Ramp
from unjam.scenarios.population import read_population
from unjam.scenarios.ring import Ring
from unjam.scenarios.road import Road
from unjam.scenarios.scenario import Scenario
from unjam.scenarios.user_network import UserNetwork, load_user_network

__all__ = ["SCENARIOS", "FigureEight", "Merge", "Motorway", "Ramp", "Ring", "Road", "Scenario", "make_scenario"]

SCENARIOS: dict[str, Scenario] = {
    "ring": Ring(),
    "ring-warm": Ring(warmup=750),
    "ring-jammed": Ring(warmup=6000),
    "figure-eight": FigureEight(),
    "figure-eight-30": FigureEight(radius=(30, 30)),
    "merge": Merge(),
    **MOTORWAY_SCENARIOS,
}

EXAMPLE_PENETRATION_RATE = 0.1
"""penetration rate of a user network as an example"""
SCENARIO_KINDS = {kind.title: kind for kind in (Ring, FigureEight, Merge, Motorway, UserNetwork)}
"""all kinds of road, by title"""


def make_scenario(name: str, changes: dict[str, Any] | None = None) -> Scenario:
    """Return the scenario `name`, or that of a .sumocfg file, with `changes` to its parameters.

    A dot in a name leads into a group of parameters: `{"safety.time_gap": 1.5}`. Raise `InputError` for an unknown
    scenario or parameter, or a value out of range.
    """
    changes = nest_keys(changes or {})
    if name.endswith(".sumocfg"):
        return load_user_network(name, changes)
    if name not in SCENARIOS:
        raise unknown_name("scenario", name, [*SCENARIOS, "a .sumocfg file"])
    scenario = SCENARIOS[name]
    if not changes:
        return scenario
    if file := changes.get("population"):  # typical parameters, and what computes the motion, follow from it
        population = read_population(str(file))
        commanded = {"human_control": "commanded"} if population.residual else {}
        changes = {"humans": asdict(population.typical), **commanded, **changes}
    return build_dataclass(type(scenario), merge_changes(asdict(scenario), changes), f"scenario {name}")


def example_scenario(name: str) -> Scenario:
    """Return a scenario as it is listed and sampled: a user network has some CAVs."""
    return make_scenario(name, {"penetration_rate": EXAMPLE_PENETRATION_RATE} if name.endswith(".sumocfg") else None)


def scenario_recipe(scenario: Scenario) -> dict[str, Any]:
    """Return a scenario as JSON; the inverse of `scenario_from_recipe`.

    Raise `InputError` for a class that `scenario_from_recipe` does not know, as a subclass of the user's.
    """
    kind = type(scenario)
    if SCENARIO_KINDS.get(kind.title) is not kind:
        known = ", ".join(each.__name__ for each in SCENARIO_KINDS.values())
        raise InputError(
            f"scenario: {kind.__name__} is not allowed in a file or another process; allowed: {known} themselves, and "
            "any class with run_episode in one process"
        )
    return {"kind": scenario.title, **asdict(scenario)}


def scenario_from_recipe(recipe: dict[str, Any]) -> Scenario:
    """Return the scenario of a recipe."""
    values = {key: value for key, value in recipe.items() if key != "kind"}
    return build_dataclass(SCENARIO_KINDS[recipe["kind"]], values, "scenario")
