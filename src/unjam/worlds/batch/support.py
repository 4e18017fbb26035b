"""Which roads a batch steps as SUMO does, and which of them together."""

from collections.abc import Sequence
from dataclasses import fields

from unjam.errors import InputError
from unjam.scenarios.figure_eight import FigureEight
from unjam.scenarios.on_ramp import OnRamp
from unjam.scenarios.ring import LoopScenario, Ring
from unjam.scenarios.scenario import Scenario
from unjam.worlds.batch.leaders import MIN_LOOK_AHEAD

MAX_SIMULATION_STEP = 0.37
"""simulation step up to which SUMO's IDM makes one step of it [s]"""
ON_RAMP_SIMULATION_STEP = 0.5
"""of the motorways, in which drivers think twice [s]"""


def unsupported_reason(scenario: Scenario) -> str:
    """Return why a scenario cannot be stepped in a batch exactly as SUMO does it; empty where it can."""
    if not isinstance(scenario, Ring):
        return f"{scenario.title}: it is no ring"
    if scenario.human_control != "native":
        return "human_control: people are commanded"
    return _control_unsupported_reason(scenario)


def statistically_unsupported_reason(scenario: Scenario) -> str:
    """Return why a scenario can be stepped in no batch; empty where it can, if only statistically.

    Of a figure eight all but a few steps in a million are SUMO's, as far as that was tried. Its right of way
    is decisions, and one that turns makes another queue: whole episodes are alike in distribution alone. On
    on-ramps people follow as SUMO's do, but change lanes all at once and err by other numbers.
    """
    if isinstance(scenario, OnRamp):
        return _on_ramp_unsupported_reason(scenario)
    if not isinstance(scenario, FigureEight):
        return unsupported_reason(scenario)
    if scenario.human_control != "commanded":
        return "human_control: SUMO drives people"
    if not scenario.right_of_way or not scenario.enforce_human_limits:
        return f"{'enforce_human_limits' if scenario.right_of_way else 'right_of_way'}: false; allowed: true"
    if scenario.radius[0] <= MIN_LOOK_AHEAD:
        return f"radius: {scenario.radius[0]} m, where people look past a lane; allowed: > {MIN_LOOK_AHEAD:g} m"
    if scenario.population:
        return "population: people are calibrated"
    if scenario.actuation == "raw":
        return "actuation: raw; allowed: shielded, with a safety filter that acts"
    return _control_unsupported_reason(scenario)


def _on_ramp_unsupported_reason(scenario: OnRamp) -> str:
    if scenario.actuation != "cruise" or scenario.safety.active:
        return "actuation: CAVs have no ACC of their own that follows alone; allowed: cruise, without a filter"
    if scenario.cruise.keep_right is not None or scenario.cruise.speed_gain is not None:
        return "cruise.keep_right and cruise.speed_gain: CAVs change lanes otherwise than people; allowed: neither"
    if scenario.simulation_step != ON_RAMP_SIMULATION_STEP:
        return f"simulation_step: {scenario.simulation_step:g} s; allowed: {ON_RAMP_SIMULATION_STEP:g} s"
    if not scenario.sensors.is_exact or not scenario.actuator.is_instant:
        return "sensors and actuator: CAVs misread, or obey late; allowed: exact ones that obey at once"
    if scenario.warmup > 0:
        return f"warmup: {scenario.warmup}; allowed: 0"
    if scenario.roadside.loss_rate > 0:
        return f"roadside.loss_rate: {scenario.roadside.loss_rate:g}; allowed: 0"
    return ""


def _control_unsupported_reason(scenario: Scenario) -> str:
    exact = scenario.actuation == "raw" or (scenario.actuation == "shielded" and scenario.safety.active)
    if not exact:
        return "actuation: SUMO's own check decides what CAVs do; allowed: raw, or a safety filter that acts"
    if scenario.simulation_step > MAX_SIMULATION_STEP:
        return f"simulation_step: {scenario.simulation_step:g} s; allowed: <= {MAX_SIMULATION_STEP:g} s"
    return ""


def differ_only_in_size(first: Scenario, second: Scenario) -> bool:
    """Return whether roads differ in their sizes alone, so that they can be stepped together."""
    size = first.size_parameter if isinstance(first, LoopScenario) else ""
    shared = (each.name for each in fields(first) if each.name != size)
    return type(first) is type(second) and all(getattr(first, name) == getattr(second, name) for name in shared)


def check_batch_scenarios(scenarios: Sequence[Scenario], allow_statistical: bool) -> None:
    """Raise `InputError` where roads cannot be stepped together; exactly, or `statistical` too."""
    why_none = statistically_unsupported_reason if allow_statistical else unsupported_reason
    for road in scenarios:
        if why := why_none(road):
            raise InputError(f"batch: {why}")
        if not differ_only_in_size(road, scenarios[0]):
            raise InputError("batch: the scenarios differ in more than their lengths")
