"""Which scenarios a batch can simulate as SUMO does, and which of them can share a batch."""

from collections.abc import Sequence
from dataclasses import fields

from unjam.errors import InputError
from unjam.scenarios.figure_eight import FigureEight
from unjam.scenarios.on_ramp import OnRamp
from unjam.scenarios.ring import LoopScenario, Ring
from unjam.scenarios.scenario import Scenario
from unjam.worlds.batch.leaders import MIN_LOOK_AHEAD

MAX_SIMULATION_STEP = 0.37
"""longest simulation step that SUMO's IDM does not divide into several [s]"""
ON_RAMP_SIMULATION_STEP = 0.5
"""simulation step of on-ramps, which SUMO's EIDM divides into two [s]"""


def unsupported_reason(scenario: Scenario) -> str:
    """Return why a batch cannot reproduce SUMO's episodes of a scenario exactly; empty if it can."""
    if not isinstance(scenario, Ring):
        return f"{scenario.title} is not a ring"
    if scenario.human_control != "native":
        return f"human_control: {scenario.human_control}; allowed: native"
    return _control_unsupported_reason(scenario)


def statistically_unsupported_reason(scenario: Scenario) -> str:
    """Return why a batch cannot simulate a scenario at all; empty if it can, at least with SUMO's distribution.

    On figure eights, all but a few steps in a million were equal to SUMO's where they were compared. But one different
    decision about the right of way changes the order of the queue, so that only distributions agree. On on-ramps,
    human drivers follow as in SUMO, but all vehicles change lanes at once, and drivers' errors are other draws.
    """
    if isinstance(scenario, OnRamp):
        return _on_ramp_unsupported_reason(scenario)
    if not isinstance(scenario, FigureEight):
        return unsupported_reason(scenario)
    radius = scenario.radius[0]
    return _first_reason(
        (scenario.human_control != "commanded", f"human_control: {scenario.human_control}; allowed: commanded"),
        (not scenario.right_of_way, "right_of_way: false; allowed: true"),
        (not scenario.enforce_human_limits, "enforce_human_limits: false; allowed: true"),
        (
            radius <= MIN_LOOK_AHEAD,
            f"radius: {radius} m, where drivers look past a lane; allowed: > {MIN_LOOK_AHEAD:g} m",
        ),
        (bool(scenario.population), "population: calibrated human drivers; allowed: none"),
        (scenario.actuation == "raw", "actuation: raw; allowed: shielded, with an active safety filter"),
    ) or _control_unsupported_reason(scenario)


def _on_ramp_unsupported_reason(scenario: OnRamp) -> str:
    cruise, step = scenario.cruise, scenario.simulation_step
    has_own_acc = scenario.actuation == "cruise" and not scenario.safety.active
    changes_lanes = cruise.keep_right is not None or cruise.speed_gain is not None
    is_ideal = scenario.sensors.is_exact and scenario.actuator.is_instant
    return _first_reason(
        (
            not has_own_acc,
            "actuation: CAVs have no ACC that follows on its own; allowed: cruise, without a safety filter",
        ),
        (changes_lanes, "cruise.keep_right and cruise.speed_gain: CAVs change lanes unlike humans; allowed: neither"),
        (step != ON_RAMP_SIMULATION_STEP, f"simulation_step: {step:g} s; allowed: {ON_RAMP_SIMULATION_STEP:g} s"),
        (not is_ideal, "sensors and actuator: errors or delays; allowed: exact sensors and instant actuators"),
        (scenario.warmup > 0, f"warmup: {scenario.warmup}; allowed: 0"),
        (scenario.roadside.loss_rate > 0, f"roadside.loss_rate: {scenario.roadside.loss_rate:g}; allowed: 0"),
    )


def _control_unsupported_reason(scenario: Scenario) -> str:
    is_exact = scenario.actuation == "raw" or (scenario.actuation == "shielded" and scenario.safety.active)
    step = scenario.simulation_step
    return _first_reason(
        (
            not is_exact,
            "actuation: SUMO's own check limits CAVs; allowed: raw, or shielded with an active safety filter",
        ),
        (step > MAX_SIMULATION_STEP, f"simulation_step: {step:g} s; allowed: <= {MAX_SIMULATION_STEP:g} s"),
    )


def _first_reason(*checks: tuple[bool, str]) -> str:
    return next((reason for has_failed, reason in checks if has_failed), "")


def differ_only_in_size(first: Scenario, second: Scenario) -> bool:
    """Return whether scenarios differ at most in the size of their roads, so that they can share a batch."""
    size = first.size_parameter if isinstance(first, LoopScenario) else ""
    shared = (each.name for each in fields(first) if each.name != size)
    return type(first) is type(second) and all(getattr(first, name) == getattr(second, name) for name in shared)


def check_batch_scenarios(scenarios: Sequence[Scenario], allow_statistical: bool) -> None:
    """Raise `InputError` if scenarios cannot share a batch that equals SUMO exactly, or statistically if allowed."""
    reason_of = statistically_unsupported_reason if allow_statistical else unsupported_reason
    for scenario in scenarios:
        if reason := reason_of(scenario):
            raise InputError(f"batch: {reason}")
        if not differ_only_in_size(scenario, scenarios[0]):
            raise InputError("batch: the scenarios differ in more than their lengths")
