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
ATTACK_SECONDS, ATTACK_STEP_SECONDS = 40.0, 1.0  # duration of an adversarial maneuver, and of each acceleration in it
ATTACK_POPULATION, ATTACK_GENERATIONS, ATTACK_ELITES = 128, 16, 12  # sizes in the cross-entropy method
MAX_LEADER_ACCELERATION = 3.0  # largest acceleration of an adversarial leader [m/s2]
MAX_SPEED = 100.0  # largest allowed speed in a state [m/s]
MAX_LOOP_LENGTH = 1e7  # largest length of a closed road in the limit of gaps [m]
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
    attack: tuple[float, ...]  # accelerations of the leader in the maneuver with the smallest gap, one per second


@dataclass(frozen=True)
class Comfort:
    """Ride comfort in the recorded episode."""

    rms_acceleration: float  # root mean square [m/s2]; below 0.315 it is not uncomfortable by ISO 2631-1
    max_braking: float  # mean over 2 s, as in ISO 15622 [m/s2]
    meets_iso_15622: bool
    """braking at most 3.5 m/s2 above 20 m/s, 5 m/s2 below 5 m/s, linear between; acceleration at most 2 and 4"""


@dataclass(frozen=True)
class OperatingDomain:
    """Smallest and largest values of the visited states [m/s, m]."""

    speed: tuple[float, float]
    leader_speed: tuple[float, float]
    leader_gap: tuple[float, float]

    def contains(self, states: Any) -> Any:
        """Return whether states lie within the ranges, a Boolean for each row."""
        is_inside: Any = True
        for name, (low, high) in asdict(self).items():
            value = getattr(states, name)
            is_inside = is_inside & (value >= low) & (value <= high)
        return is_inside


@dataclass(frozen=True)
class Certificate:
    """All results of a certification."""

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
        scenario = controller.manifest["scenario"]
        humans = build_dataclass(IDMParameters, scenario["humans"], "controller: humans")
        actuator = build_dataclass(Actuator, scenario.get("actuator", {}), "controller: actuator")
    if driver.actuator != actuator:
        raise InputError(f"certify: a filter for {driver.actuator} is not allowed on its road; allowed: {actuator}")
    return asdict(certify_driver(driver, states, humans))


def describe_worst_cases(certificate: dict[str, Any], driver: FilteredDriver) -> str:
    """Return one line with the initial states and leaders of the simulated worst cases, contacts and minimum gap."""
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
    """Return whether a vehicle falls behind its leader in a test of string stability, and therefore has no gain."""
    return any(gain is None or isnan(gain) for gain in result["gains"])


def describe_string_stability(certificate: dict[str, Any], driver: FilteredDriver) -> str:
    """Return one line on whether a controller amplifies oscillations of its leader, with its vehicle."""
    results, vehicle = certificate["string_stability"], driver.actuator.describe()
    if not results:
        return f"string stability was not tested, {vehicle}"
    if any(result["amplified_band"] for result in results):
        gain = max(gain for result in results for gain in result["gains"] if gain is not None and not isnan(gain))
        return f"not string stable, {vehicle}: amplifies oscillations up to {gain:.3g} times"
    if speeds := [f"{result['speed']:g}" for result in results if falls_behind(result)]:
        return f"string stability is unknown, {vehicle}: at {', '.join(speeds)} m/s it falls behind its leader"
    return f"string stable, {vehicle}"


FollowingSimulator = Callable[[FollowingState, Floats], FollowingState]
"""function that simulates a controller behind leaders, given initial states, shape (rows,), and accelerations of the
leaders [m/s2], shape (steps, rows); it returns the states in all steps"""


def certify_driver(driver: FilteredDriver, visited_states: LocalState, humans: IDMParameters) -> Certificate:
    """Return the certificate of a controller with its filter, from simulations that begin in states of shape (T,)."""
    loop_length = float(visited_states.loop_length[0])
    fields = frozenset(name for name, values in visited_states._asdict().items() if values is not None)
    road = RoadInterface("the road of its filter", not np.isnan(loop_length), True, fields, driver.time_step)
    if reason := driver.requirements(road).unmet_reason(road):
        raise InputError(f"certify: the driver is not allowed on {road.title}: {reason}")

    def simulate(initial_states: FollowingState, leader_accelerations: Floats) -> FollowingState:
        vehicle = driver.limits, driver.time_step, loop_length, driver.actuator
        return drive_world(CarFollowingWorld(initial_states, leader_accelerations, *vehicle), driver)

    states, min_count = FollowingState(*visited_states[:3]), 1 + _averaged_steps(driver.time_step)
    if driver.time_step > LEADER_STOP_SECONDS:
        raise invalid_value("certify: control step", driver.time_step, f"at most {LEADER_STOP_SECONDS:g} s")
    if len(states.speed) < min_count:
        count_text = format_count(len(states.speed), "state")
        raise InputError(f"certify: a sample of {count_text} is not allowed; allowed: {min_count} or more")
    max_gap = float(np.fmax(min(loop_length, MAX_LOOP_LENGTH), MAX_OBSERVED_GAP))
    maxima = {"speed": MAX_SPEED, "leader speed": MAX_SPEED, "gap": max_gap}
    for (name, maximum), values in zip(maxima.items(), states, strict=True):
        if not ((values >= 0.0) & (values <= maximum)).all():  # also for NaN
            raise InputError(f"certify: {name} of the sample is not allowed; allowed: 0 to {maximum:g} in each state")
    ranges = [(float(values.min()), float(values.max())) for values in states]
    speeds = operating_speeds(float(states.speed.mean()), humans)
    worst_cases = _simulate_worst_cases(simulate, states, driver)
    comfort = _measure_comfort(states.speed, driver.time_step)
    stability = measure_string_stability(driver, speeds, humans, loop_length)
    return Certificate(worst_cases, comfort, stability, OperatingDomain(*ranges))


def _averaged_steps(time_step: float) -> int:
    return max(1, round(ISO_MEAN_SECONDS / time_step))


def _simulate_worst_cases(simulate: FollowingSimulator, states: FollowingState, driver: FilteredDriver) -> WorstCases:
    safety, step = driver.safety, driver.time_step
    actuation = driver.actuator, driver.actuator.initial_state(states.speed, step)
    # In other states, even maximum braking may not avoid contact.
    is_safe = safety.max_acceleration(states, step, actuation) > -safety.braking
    if not is_safe.any():
        raise InputError("certify: the filter cannot avoid contact in any state of the sample; allowed: in some")
    states = FollowingState(*(values[is_safe] for values in states))
    rows = len(states.speed)
    leader_accelerations = np.full((round(LEADER_STOP_SECONDS / step), rows), -safety.leader_braking)
    hard_stop = simulate(states, leader_accelerations)
    gentle_stop = simulate(states, leader_accelerations * (safety.time_gap_braking / safety.leader_braking))
    attacked, attack, attack_steps = _search_attacks(simulate, states, driver)
    simulations, is_moving = (hard_stop, gentle_stop, attacked), gentle_stop.speed > MIN_MOVING_SPEED
    return WorstCases(
        leader_stops=rows,
        steps=2 * leader_accelerations.size + attack_steps,
        contacts=int(sum((simulation.gap.min(0) < 0.0).sum() for simulation in simulations)),
        min_gap=float(min(simulation.gap.min() for simulation in simulations)),
        min_time_gap=float((gentle_stop.gap[is_moving] / gentle_stop.speed[is_moving]).min(initial=np.inf)),
        max_braking=max(float(-np.diff(simulation.speed, axis=0).min()) / step for simulation in simulations),
        attack=tuple(np.round(attack, 2).tolist()),
    )


def _measure_comfort(speeds: Floats, step: float) -> Comfort:
    steps = _averaged_steps(step)
    mean_accelerations = (speeds[steps:] - speeds[:-steps]) / (steps * step)
    first_speeds = speeds[: len(mean_accelerations)]
    max_braking, max_acceleration = (np.interp(first_speeds, [5.0, 20.0], ends) for ends in ([5.0, 3.5], [4.0, 2.0]))
    accelerations = np.diff(speeds) / step
    is_comfortable = (mean_accelerations >= -max_braking) & (mean_accelerations <= max_acceleration)
    return Comfort(
        rms_acceleration=float(np.sqrt((accelerations**2).mean())),
        max_braking=float(-mean_accelerations.min(initial=0.0)),
        meets_iso_15622=bool(is_comfortable.all()),
    )


def _search_attacks(
    simulate: FollowingSimulator, states: FollowingState, driver: FilteredDriver
) -> tuple[FollowingState, Floats, int]:
    """Return the generation with the smallest gap, its worst maneuver, and the number of simulated vehicle steps."""
    size, repeats = round(ATTACK_SECONDS / ATTACK_STEP_SECONDS), max(1, round(ATTACK_STEP_SECONDS / driver.time_step))
    low, high, generator = -driver.safety.leader_braking, MAX_LEADER_ACCELERATION, np.random.default_rng(0)
    mean, std = np.zeros(size), np.full(size, (high - low) / 2.0)
    rows = generator.integers(len(states.speed), size=ATTACK_POPULATION)
    initial_states = FollowingState(*(values[rows] for values in states))
    generations: list[tuple[FollowingState, Floats]] = []
    for _ in range(ATTACK_GENERATIONS):
        maneuvers = np.clip(generator.normal(mean, std, (ATTACK_POPULATION, size)), low, high)
        simulation = simulate(initial_states, np.repeat(maneuvers, repeats, axis=1).T)
        order = np.argsort(simulation.gap.min(0))
        generations.append((simulation, maneuvers[order[0]]))
        elites = maneuvers[order[:ATTACK_ELITES]]
        mean, std = elites.mean(0), elites.std(0) + 0.2
    steps = ATTACK_GENERATIONS * ATTACK_POPULATION * size * repeats
    return *min(generations, key=lambda generation: generation[0].gap.min()), steps
