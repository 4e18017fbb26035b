"""Which rings a batch steps exactly as SUMO does, and which of them together."""

from dataclasses import fields

from unjam.scenarios.ring import Ring
from unjam.scenarios.scenario import Scenario

LONGEST_STEP = 0.37
"""simulation step up to which SUMO's IDM makes one step of it [s]"""


def why_not(scenario: Scenario) -> str:
    """Return why a scenario cannot be stepped in a batch exactly as SUMO does it; empty where it can."""
    if not isinstance(scenario, Ring):
        return f"{scenario.title}: it is no ring"
    if scenario.human_control != "native":
        return "human_control: people are commanded"
    exact = scenario.actuation == "raw" or (scenario.actuation == "shielded" and scenario.safety.active)
    if not exact:
        return "actuation: SUMO's own check decides what CAVs do; allowed: raw, or a safety filter that acts"
    if scenario.simulation_step > LONGEST_STEP:
        return f"simulation_step: {scenario.simulation_step:g} s; allowed: <= {LONGEST_STEP:g} s"
    return ""


def alike(one: Ring, other: Ring) -> bool:
    """Return whether rings differ in their lengths alone, so that they can be stepped together."""
    shared = (each.name for each in fields(one) if each.name != Ring.size)
    return type(one) is type(other) and all(getattr(one, name) == getattr(other, name) for name in shared)
