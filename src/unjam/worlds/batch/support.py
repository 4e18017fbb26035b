"""Checks which scenarios a batch can simulate, exactly as SUMO or in distribution, and which can share a batch."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from operator import attrgetter
from typing import Any

from unjam.errors import InputError
from unjam.parameters import replaced_member
from unjam.scenarios.figure_eight import FigureEight
from unjam.scenarios.motorway import Motorway
from unjam.scenarios.motorway_vehicles import LaneChanging
from unjam.scenarios.recorded import Recorded
from unjam.scenarios.ring import Ring
from unjam.scenarios.scenario import Scenario
from unjam.worlds.backend import TEXT_MEMBERS, unread_reason
from unjam.worlds.batch.human_idm import MIN_LOOK_AHEAD
from unjam.worlds.batch.motorway.world import MotorwayBatch
from unjam.worlds.batch.ring.recorded import RecordedBatch
from unjam.worlds.batch.ring.world import RingBatch

MAX_SIMULATION_STEP = 0.37
"""longest simulation step that SUMO's IDM does not divide into several [s]"""
MOTORWAY_STEP = 0.5
"""simulation step of motorways, which SUMO's EIDM divides into two [s]"""
MAX_BATCH_LANES = 2
"""maximum number of lanes of a motorway in a batch, which considers one lane change from each lane"""


@dataclass(frozen=True)
class BatchKind:
    """How batches simulate the scenarios of one class."""

    world: type[RingBatch] | type[MotorwayBatch]
    unsupported_reason: Callable[[Any], str]
    """returns why a batch cannot simulate a scenario of this class; empty if it can"""
    is_exact: bool = False
    """whether episodes equal SUMO's except for rounding; otherwise only their distribution does"""
    max_roads: int = 128
    """maximum number of roads in a batch that records episodes: about 130 MB for rings with 22 vehicles"""
    has_own_drivers: bool = False
    """whether each road of a batch can have its own driver and exploration"""


def unsupported_reason(scenario: Scenario) -> str:
    """Return why a batch cannot reproduce SUMO's episodes of a scenario except for rounding; empty if it can."""
    if (kind := batch_kind(scenario)) and not kind.is_exact:
        return f"{scenario.title} is neither a ring nor a recorded road"
    return statistically_unsupported_reason(scenario)


def statistically_unsupported_reason(scenario: Scenario) -> str:
    """Return why a batch cannot simulate a scenario at all; empty if it can, at least with SUMO's distribution.

    On figure eights nearly all steps equal SUMO's, but one different decision about the right of way changes the queue.
    On motorways, all vehicles change lanes at once, and the errors of drivers are other random numbers.
    """
    if kind := batch_kind(scenario):
        return kind.unsupported_reason(scenario)
    base = next((base for base in BATCH_KINDS if isinstance(scenario, base)), None)
    return unread_reason(scenario, base or Ring, [field.name for field in fields(scenario)])


def _ring_reason(scenario: Ring | Recorded) -> str:
    human_control = "human_control", scenario.human_control == "native", "native"
    return _first_unmet_requirement(scenario, human_control, *_actuation_requirements(scenario))


def _figure_eight_reason(scenario: FigureEight) -> str:
    return _first_unmet_requirement(
        scenario,
        ("human_control", scenario.human_control == "commanded", "commanded"),
        ("right_of_way", scenario.right_of_way, "True"),
        ("enforce_human_limits", scenario.enforce_human_limits, "True"),
        ("radius", scenario.radius[0] > MIN_LOOK_AHEAD, f"> {MIN_LOOK_AHEAD:g} m: drivers do not look past a lane"),
        ("population", not scenario.population, "none"),
        ("actuation", scenario.actuation != "raw", "shielded, with an active safety filter"),
        *_actuation_requirements(scenario),
    )


def _motorway_reason(scenario: Motorway) -> str:
    return _first_unmet_requirement(
        scenario,
        ("actuation", scenario.actuation == "cruise", "cruise"),
        ("safety.active", not scenario.safety.active, "False: CAVs have their own ACC"),
        ("cruise.keep_right", scenario.cruise.keep_right is None, "None: CAVs change lanes as human drivers do"),
        ("cruise.speed_gain", scenario.cruise.speed_gain is None, "None: CAVs change lanes as human drivers do"),
        ("cruise.cooperation", scenario.cruise.cooperation is None, "None: CAVs change lanes as human drivers do"),
        ("simulation_step", scenario.simulation_step == MOTORWAY_STEP, f"{MOTORWAY_STEP:g} s"),
        ("lane_changing", scenario.lane_changing == LaneChanging(), "SUMO's defaults"),
        ("speed_limit_control.active", not scenario.speed_limit_control.active, "False"),
        ("ramp_meter.active", not scenario.ramp_meter.active, "False"),
        ("trucks.share", scenario.trucks.share == 0, "0"),
        ("ordinary_acc.share", scenario.ordinary_acc.share == 0, "0"),
        ("lanes", scenario.lanes <= MAX_BATCH_LANES, "1, 2"),
        ("sensors.is_exact", scenario.sensors.is_exact, "True"),
        ("actuator.is_instant", scenario.actuator.is_instant, "True"),
        ("warmup", scenario.warmup == 0, "0"),
        ("roadside.loss_rate", scenario.roadside.loss_rate == 0, "0"),
    )


def _actuation_requirements(scenario: Scenario) -> tuple[tuple[str, bool, str], ...]:
    is_exact = scenario.actuation == "raw" or (scenario.actuation == "shielded" and scenario.safety.active)
    return (
        ("actuation", is_exact, "raw, or shielded with an active safety filter instead of SUMO's own check"),
        ("simulation_step", scenario.simulation_step <= MAX_SIMULATION_STEP, f"<= {MAX_SIMULATION_STEP:g} s"),
    )


def _first_unmet_requirement(scenario: Scenario, *requirements: tuple[str, bool, str]) -> str:
    """Return a message on the first setting that is not supported; each has name, support, and allowed values."""
    for name, is_supported, allowed in requirements:
        if not is_supported:
            return f"{name}: {attrgetter(name)(scenario)} is not allowed in a batch; allowed: {allowed}"
    return ""


BATCH_KINDS: dict[type[Scenario], BatchKind] = {
    Ring: BatchKind(RingBatch, _ring_reason, is_exact=True),
    Recorded: BatchKind(RecordedBatch, _ring_reason, is_exact=True),
    FigureEight: BatchKind(RingBatch, _figure_eight_reason),
    Motorway: BatchKind(MotorwayBatch, _motorway_reason, max_roads=64, has_own_drivers=True),
}


def batch_kind(scenario: Scenario) -> BatchKind | None:
    """Return how batches simulate a scenario, whose class may change values of its base only; None if they cannot."""
    kinds = ((base, kind) for base, kind in BATCH_KINDS.items() if isinstance(scenario, base))
    return next((kind for base, kind in kinds if not replaced_member(type(scenario), base, TEXT_MEMBERS)), None)


def required_batch_kind(scenario: Scenario) -> BatchKind:
    """Return how batches simulate a scenario; raise `InputError` if they cannot."""
    if (kind := batch_kind(scenario)) is None:
        raise InputError(f"batch: {statistically_unsupported_reason(scenario)}")
    return kind


def can_share_batch(first: Scenario, second: Scenario) -> bool:
    """Return whether two scenarios can share a batch: they differ at most in the size of their roads."""
    size_parameter = getattr(first, "size_parameter", "")
    shared = (field.name for field in fields(first) if field.name != size_parameter)
    return type(first) is type(second) and all(getattr(first, name) == getattr(second, name) for name in shared)


def check_batch_scenarios(scenarios: Sequence[Scenario], allow_statistical: bool) -> None:
    """Raise `InputError` if scenarios cannot share a batch that equals SUMO, if allowed only in distribution."""
    find_reason = statistically_unsupported_reason if allow_statistical else unsupported_reason
    for scenario in scenarios:
        if reason := find_reason(scenario):
            raise InputError(f"batch: {reason}")
        if not can_share_batch(scenario, scenarios[0]):
            raise InputError("batch: the scenarios differ in more than their lengths")
