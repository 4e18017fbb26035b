"""The certificate of a controller: simulated worst cases, comfort, string stability, and operating domain."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from math import isnan
from typing import Any

import numpy as np

from unjam.controller.file import SAMPLE_PART, Controller, Floats, read_sample
from unjam.controller.string_stability import StringStability, measure_string_stability, operating_speeds
from unjam.drivers.local_state import MAX_OBSERVED_GAP, LocalState
from unjam.drivers.requirements import RoadInterface
from unjam.drivers.safety import Actuator, FollowingState
from unjam.drivers.wrappers import FilteredDriver
from unjam.errors import InputError, invalid_value
from unjam.files import reject_damaged
from unjam.parameters import build_dataclass
from unjam.physics.idm import IDMParameters
from unjam.text import format_count
from unjam.worlds.drive import drive_world
from unjam.worlds.world import CarFollowingWorld

ISO_MEAN_SECONDS, LEADER_STOP_SECONDS = 2.0, 20.0
"""averaging time of accelerations in ISO 15622; simulated time after the start of a leader's emergency stop [s]"""
ATTACK_SECONDS, ATTACK_STEP_SECONDS = 40.0, 1.0  # of an adversarial maneuver, and of each of its accelerations
ATTACK_POPULATION, ATTACK_GENERATIONS, ATTACK_ELITES = 128, 16, 12  # of the cross-entropy method
MAX_LEADER_ACCELERATION = 3.0  # largest acceleration of an adversarial leader [m/s2]
MAX_SPEED = 100.0  # largest speed in a state [m/s]
MAX_LOOP_LENGTH = 1e7  # length of a closed road: gaps can be nearly as long [m]
MIN_MOVING_SPEED = 1.0  # speed above which time gaps are evaluated [m/s]


@dataclass(frozen=True)
class WorstCases:
    """Results of simulations that try to cause contact with the leader, with the safety filter [m, s, m/s2]."""

    leader_stops: int  # number of visited states from which the leader stopped with its maximum braking
    steps: int  # simulated steps of single vehicles
    contacts: int
    min_gap: float
    min_time_gap: float  # above 1 m/s, behind a leader that brakes with at most `SafetyFilter.time_gap_braking`
    max_braking: float
    attack: tuple[float, ...]  # the leader's accelerations with the smallest gap, one per second


@dataclass(frozen=True)
class Comfort:
    """Ride comfort in the recorded episode."""

    rms_acceleration: float  # root mean square [m/s2]; below 0.315 it is not uncomfortable by ISO 2631-1
    max_braking: float  # mean over 2 s, as in ISO 15622 [m/s2]
    meets_iso_15622: bool
    """braking at most 3.5 m/s2 above 20 m/s, 5 m/s2 below 5 m/s, linear between; acceleration at most 2 and 4"""


@dataclass(frozen=True)
class OperatingDomain:
    """Ranges of the visited states: smallest and largest values."""

    speed: tuple[float, float]
    leader_speed: tuple[float, float]
    leader_gap: tuple[float, float]

    def contains(self, states: Any) -> Any:
        """Return whether states lie within the ranges, a Boolean for each row."""
        inside: Any = True
        for name, (low, high) in asdict(self).items():
            value = getattr(states, name)
            inside = inside & (value >= low) & (value <= high)
        return inside


@dataclass(frozen=True)
class Certificate:
    """All results."""

    worst_cases: WorstCases
    comfort: Comfort
    string_stability: tuple[StringStability, ...]
    domain: OperatingDomain


def make_certificate(controller: Controller) -> dict[str, Any]:
    """Return the certificate of a controller as JSON; raise `InputError` without a filter, a sample or a scenario."""
    driver = controller.driver
    if not isinstance(driver, FilteredDriver) or not driver.safety.active or SAMPLE_PART not in controller.parts:
        allowed = "output of `unjam export` for a road with a filter"
        raise InputError(f"certify: a controller without safety filter and sample is not allowed; allowed: {allowed}")
    if "scenario" not in controller.manifest:
        allowed = "one that was exported with --scenario"
        raise InputError(f"certify: a controller without a scenario is not allowed; allowed: {allowed}")
    with reject_damaged("certify"):
        states, _ = read_sample(controller.parts[SAMPLE_PART])
        road = controller.manifest["scenario"]
        humans = build_dataclass(IDMParameters, road["humans"], "controller: humans")
        actuator = build_dataclass(Actuator, road.get("actuator", {}), "controller: actuator")
    if driver.actuator != actuator:
        raise InputError(f"certify: a filter for {driver.actuator} is not allowed on its road; allowed: {actuator}")
    return asdict(certify_driver(driver, states, humans))


def describe_worst_cases(certificate: dict[str, Any], driver: FilteredDriver) -> str:
    """Return in one line from which states and behind which leaders a controller was simulated, and what happened."""
    worst, domain = certificate["worst_cases"], certificate["domain"]
    speeds, gaps = ("{:.3g} to {:.3g}".format(*domain[name]) for name in ("speed", "leader_gap"))
    braking = f"at most {driver.safety.leader_braking:g} m/s2"
    return (
        f"{worst['steps']:,} steps behind adversarial leaders that brake with {braking}, "
        f"from {format_count(worst['leader_stops'], 'state')} at {speeds} m/s with gaps of {gaps} m: "
        f"{format_count(worst['contacts'], 'contact')}, "
        f"minimum gap {worst['min_gap']:.2f} m"
    )


def falls_behind(result: dict[str, Any]) -> bool:
    """Return whether a vehicle falls behind its leader in a test of string stability, so that it has no gain."""
    return any(gain is None or isnan(gain) for gain in result["gains"])


def describe_string_stability(certificate: dict[str, Any], driver: FilteredDriver) -> str:
    """Return in one line whether a controller amplifies oscillations of its leader, and in which vehicle."""
    results, vehicle = certificate["string_stability"], driver.actuator.describe()
    if not results:
        return f"string stability was not tested, {vehicle}"
    if any(result["amplified_band"] for result in results):
        gain = max(gain for result in results for gain in result["gains"] if gain is not None and not isnan(gain))
        return f"not string stable, {vehicle}: amplifies oscillations up to {gain:.3g} times"
    if behind := [f"{result['speed']:g}" for result in results if falls_behind(result)]:
        return f"string stability is unknown, {vehicle}: at {', '.join(behind)} m/s it falls behind its leader"
    return f"string stable, {vehicle}"


FollowingSimulator = Callable[[FollowingState, Floats], FollowingState]
"""simulates a controller behind leaders, from initial states and the leaders' accelerations, shape (steps, rows)"""


def certify_driver(driver: FilteredDriver, visited_states: LocalState, humans: IDMParameters) -> Certificate:
    """Return the certificate of a controller with its filter, from simulations that begin in states of shape (T,)."""
    loop = float(visited_states.loop_length[0])
    fields = frozenset(name for name, values in visited_states._asdict().items() if values is not None)
    road = RoadInterface("the road of its filter", not np.isnan(loop), True, fields, driver.time_step)
    if reason := driver.requirements(road).unmet_reason(road):
        raise InputError(f"certify: the driver is not allowed on {road.title}: {reason}")

    def simulate(initial_states: FollowingState, leader_accelerations: Floats) -> FollowingState:
        vehicle = driver.limits, driver.time_step, loop, driver.actuator
        return drive_world(CarFollowingWorld(initial_states, leader_accelerations, *vehicle), driver)

    states, fewest = FollowingState(*visited_states[:3]), 1 + _steps_of_mean(driver.time_step)
    if driver.time_step > LEADER_STOP_SECONDS:
        raise invalid_value("certify: control step", driver.time_step, f"at most {LEADER_STOP_SECONDS:g} s")
    if len(states.speed) < fewest:
        count = format_count(len(states.speed), "state")
        raise InputError(f"certify: a sample of {count} is not allowed; allowed: {fewest} or more")
    max_gap = float(np.fmax(min(loop, MAX_LOOP_LENGTH), MAX_OBSERVED_GAP))
    limits = {"speed": MAX_SPEED, "leader speed": MAX_SPEED, "gap": max_gap}
    for (name, largest), values in zip(limits.items(), states, strict=True):
        if not ((values >= 0.0) & (values <= largest)).all():  # refuses NaN, too
            raise InputError(f"certify: {name} of the sample is not allowed; allowed: 0 to {largest:g} in each state")
    ranges = [(float(values.min()), float(values.max())) for values in states]
    speeds = operating_speeds(float(states.speed.mean()), humans)
    worst_cases, comfort = _worst_cases(simulate, states, driver), _comfort(states.speed, driver.time_step)
    stability = measure_string_stability(driver, speeds, humans, loop)
    return Certificate(worst_cases, comfort, stability, OperatingDomain(*ranges))


def _steps_of_mean(time_step: float) -> int:
    return max(1, round(ISO_MEAN_SECONDS / time_step))


def _worst_cases(simulate: FollowingSimulator, states: FollowingState, driver: FilteredDriver) -> WorstCases:
    safety, step = driver.safety, driver.time_step
    actuation = driver.actuator, driver.actuator.initial_state(states.speed, step)
    is_safe = safety.max_acceleration(states, step, actuation) > -safety.braking  # it promises nothing elsewhere
    if not is_safe.any():
        raise InputError("certify: the filter cannot avoid contact in any state of the sample; allowed: in some")
    states = FollowingState(*(values[is_safe] for values in states))
    rows = len(states.speed)
    stop = np.full((round(LEADER_STOP_SECONDS / step), rows), -safety.leader_braking)
    hard_stop = simulate(states, stop)
    gentle_stop = simulate(states, stop * (safety.time_gap_braking / safety.leader_braking))
    attacked, attack, attack_steps = _search_attacks(simulate, states, driver)
    records, is_moving = (hard_stop, gentle_stop, attacked), gentle_stop.speed > MIN_MOVING_SPEED
    return WorstCases(
        leader_stops=rows,
        steps=2 * stop.size + attack_steps,
        contacts=int(sum((record.gap.min(0) < 0.0).sum() for record in records)),
        min_gap=float(min(record.gap.min() for record in records)),
        min_time_gap=float((gentle_stop.gap[is_moving] / gentle_stop.speed[is_moving]).min(initial=np.inf)),
        max_braking=max(float(-np.diff(record.speed, axis=0).min()) / step for record in records),
        attack=tuple(np.round(attack, 2).tolist()),
    )


def _comfort(speeds: Floats, step: float) -> Comfort:
    steps = _steps_of_mean(step)
    means = (speeds[steps:] - speeds[:-steps]) / (steps * step)
    earlier_speeds = speeds[: len(means)]
    max_braking, max_acceleration = (np.interp(earlier_speeds, [5.0, 20.0], ends) for ends in ([5.0, 3.5], [4.0, 2.0]))
    accelerations = np.diff(speeds) / step
    return Comfort(
        rms_acceleration=float(np.sqrt((accelerations**2).mean())),
        max_braking=float(-means.min(initial=0.0)),
        meets_iso_15622=bool(((means >= -max_braking) & (means <= max_acceleration)).all()),
    )


def _search_attacks(
    simulate: FollowingSimulator, states: FollowingState, driver: FilteredDriver
) -> tuple[FollowingState, Floats, int]:
    """Return the generation with the smallest gap, its worst maneuver, and the simulated steps of single vehicles."""
    pieces, repeats = round(ATTACK_SECONDS / ATTACK_STEP_SECONDS), max(1, round(ATTACK_STEP_SECONDS / driver.time_step))
    low, high, generator = -driver.safety.leader_braking, MAX_LEADER_ACCELERATION, np.random.default_rng(0)
    mean, spread = np.zeros(pieces), np.full(pieces, (high - low) / 2.0)
    chosen = generator.integers(len(states.speed), size=ATTACK_POPULATION)
    start = FollowingState(*(values[chosen] for values in states))
    worst: list[tuple[FollowingState, Floats]] = []
    for _ in range(ATTACK_GENERATIONS):
        maneuvers = np.clip(generator.normal(mean, spread, (ATTACK_POPULATION, pieces)), low, high)
        record = simulate(start, np.repeat(maneuvers, repeats, axis=1).T)
        order = np.argsort(record.gap.min(0))
        worst.append((record, maneuvers[order[0]]))
        elites = maneuvers[order[:ATTACK_ELITES]]
        mean, spread = elites.mean(0), elites.std(0) + 0.2
    steps = ATTACK_GENERATIONS * ATTACK_POPULATION * pieces * repeats
    return *min(worst, key=lambda outcome: outcome[0].gap.min()), steps
