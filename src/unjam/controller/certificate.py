"""The certificate of a controller: simulated worst cases, comfort, string stability, and operating domain."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from unjam.controller.file import SAMPLE_PART, Controller, Floats, read_sample
from unjam.drivers.local_state import LocalState
from unjam.drivers.requirements import RoadInterface
from unjam.drivers.safety import Actuator, FollowingState
from unjam.drivers.wrappers import FilteredDriver
from unjam.errors import InputError
from unjam.files import reject_damaged
from unjam.parameters import build_dataclass
from unjam.physics.idm import IDMParameters, equilibrium_gap, idm_acceleration
from unjam.worlds.drive import drive_world
from unjam.worlds.world import CarFollowingWorld

ISO_MEAN_SECONDS, LEADER_STOP_SECONDS = 2.0, 20.0
"""averaging time of accelerations in ISO 15622; simulated time after the start of a leader's emergency stop [s]"""
ATTACK_SECONDS, ATTACK_STEP_SECONDS = 40.0, 1.0
"""duration of an adversarial maneuver of a leader, and of each of its accelerations [s]"""
ATTACK_POPULATION, ATTACK_GENERATIONS, ATTACK_ELITES = 128, 16, 12
"""cross-entropy method: maneuvers in a generation, generations, and elites that determine the next generation"""
MAX_LEADER_ACCELERATION = 3.0
"""largest acceleration of an adversarial leader [m/s2]"""
MIN_MOVING_SPEED, STRING_SPEED_RATIOS = 1.0, (0.5, 0.9)
"""speed above which time gaps and string stability are evaluated [m/s]; speeds for string stability, as shares of the
highest visited speed"""
OSCILLATION_FREQUENCIES, OSCILLATION_AMPLITUDE = np.geomspace(0.04, 3.0, 20), 0.05
"""frequencies at which leaders oscillate [rad/s], and amplitude of their speed as a share of its mean; it is small, so
that the response is nearly linear"""
SETTLING_SECONDS, MEASURED_PERIODS, MIN_MEASURED_SECONDS = 100.0, 2, 200.0
"""settling time [s]; number of measured periods, and minimum measured time [s]"""
MAX_FOLLOWERS, GAIN_TOLERANCE = 60, 5e-3
"""maximum number of human drivers behind a CAV; gains up to one plus the tolerance count as one"""


@dataclass(frozen=True)
class WorstCases:
    """Results of simulations that try to cause contact with the leader, with the safety filter [m, s, m/s2]."""

    leader_stops: int
    """number of visited states from which the leader stopped with its maximum braking"""
    steps: int
    """simulated steps of single vehicles"""
    contacts: int
    min_gap: float
    min_time_gap: float
    """above 1 m/s, behind a leader that brakes with at most `SafetyFilter.time_gap_braking`"""
    max_braking: float
    attack: tuple[float, ...]
    """the leader's accelerations with the smallest gap, one per second"""


@dataclass(frozen=True)
class StringStability:
    """Response to speed oscillations of the leader around one speed [m/s] at several frequencies [rad/s]."""

    speed: float
    frequencies: tuple[float, ...]
    gains: tuple[float, ...]
    """amplitude of the CAV divided by that of the leader, at each frequency"""
    human_gains: tuple[float, ...]
    """gain of a human driver at each frequency, by the linearized IDM"""
    peak_frequency: float
    """frequency of the CAV's largest gain"""
    amplified_band: tuple[float, ...]
    """smallest and largest frequency with a gain of the CAV above one; empty if there is none"""
    max_stable_followers: int
    """maximum number of human drivers behind the CAV without amplification at any frequency"""


@dataclass(frozen=True)
class Comfort:
    """Ride comfort in the recorded episode."""

    rms_acceleration: float
    """root mean square [m/s2]; below 0.315 it is not uncomfortable by ISO 2631-1"""
    max_braking: float
    """mean over 2 s, as in ISO 15622 [m/s2]"""
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
    """Return the certificate of a controller as JSON, from simulations that start in the states of its sample.

    Raise `InputError` if it has no filter, no sample or no scenario.
    """
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
    if not actuator.is_instant:
        raise InputError("certify: actuators with delay or lag are not allowed; allowed: actuator.delay and lag 0")
    return asdict(certify_driver(driver, states, humans))


FollowingSimulator = Callable[[FollowingState, Floats], FollowingState]
"""simulates a controller behind leaders, from initial states and the leaders' accelerations, shape (steps, rows)"""


def certify_driver(driver: FilteredDriver, visited_states: LocalState, humans: IDMParameters) -> Certificate:
    """Return the certificate of a controller with its filter; it is deterministic.

    `visited_states` are the observations of a CAV on its road, arrays of shape (T,); `humans` drive behind it. Raise
    `InputError` if a part of the controller assumes another control step than its filter.
    """
    loop = float(visited_states.loop_length[0])
    fields = frozenset(name for name, values in visited_states._asdict().items() if values is not None)
    road = RoadInterface("the road of its filter", not np.isnan(loop), True, fields, driver.time_step)
    if reason := driver.requirements(road).unmet_reason(road):
        raise InputError(f"certify: the driver is not allowed on {road.title}: {reason}")

    def simulate(initial_states: FollowingState, leader_accelerations: Floats) -> FollowingState:
        world = CarFollowingWorld(initial_states, leader_accelerations, driver.limits, driver.time_step, loop)
        return drive_world(world, driver)

    states = FollowingState(*visited_states[:3])
    ranges = [(float(values.min()), float(values.max())) for values in states]
    speeds = [round(ratio * float(states.speed.max()), 1) for ratio in STRING_SPEED_RATIOS]
    speeds = [speed for speed in speeds if MIN_MOVING_SPEED < speed < humans.desired_speed]
    return Certificate(
        _worst_cases(simulate, states, driver, np.random.default_rng(0)),
        _comfort(states.speed, driver.time_step),
        _test_strings(simulate, speeds, driver.time_step, humans) if speeds else (),
        OperatingDomain(*ranges),
    )


def _worst_cases(
    simulate: FollowingSimulator, states: FollowingState, driver: FilteredDriver, generator: np.random.Generator
) -> WorstCases:
    """Simulate stops of leaders from every visited state, and search for worse maneuvers."""
    safety, step = driver.safety, driver.time_step
    is_safe = safety.max_acceleration(states, step) > -safety.braking  # the filter promises nothing elsewhere
    states = FollowingState(*(values[is_safe] for values in states))
    rows = len(states.speed)
    stop = np.full((round(LEADER_STOP_SECONDS / step), rows), -safety.leader_braking)
    hard_stop = simulate(states, stop)
    gentle_stop = simulate(states, stop * (safety.time_gap_braking / safety.leader_braking))
    attacked, attack, attack_steps = _search_attacks(simulate, states, driver, generator)
    records, is_moving = (hard_stop, gentle_stop, attacked), gentle_stop.speed > MIN_MOVING_SPEED
    return WorstCases(
        leader_stops=rows,
        steps=2 * stop.size + attack_steps,
        contacts=int(sum((each.gap.min(0) < 0.0).sum() for each in records)),
        min_gap=float(min(each.gap.min() for each in records)),
        min_time_gap=float((gentle_stop.gap[is_moving] / gentle_stop.speed[is_moving]).min(initial=np.inf)),
        max_braking=max(float(-np.diff(each.speed, axis=0).min()) / step for each in records),
        attack=tuple(np.round(attack, 2).tolist()),
    )


def _comfort(speeds: Floats, step: float) -> Comfort:
    steps = max(1, round(ISO_MEAN_SECONDS / step))
    means = (speeds[steps:] - speeds[:-steps]) / (steps * step)
    before = speeds[: len(means)]
    max_braking, max_acceleration = (np.interp(before, [5.0, 20.0], ends) for ends in ([5.0, 3.5], [4.0, 2.0]))
    accelerations = np.diff(speeds) / step
    return Comfort(
        rms_acceleration=float(np.sqrt((accelerations**2).mean())),
        max_braking=float(-means.min(initial=0.0)),
        meets_iso_15622=bool(((means >= -max_braking) & (means <= max_acceleration)).all()),
    )


def _search_attacks(
    simulate: FollowingSimulator, states: FollowingState, driver: FilteredDriver, generator: np.random.Generator
) -> tuple[FollowingState, Floats, int]:
    """Search maneuvers of a leader with the smallest gap, by the cross-entropy method.

    Return the generation with the smallest gap, its worst maneuver, and the simulated steps of single vehicles.
    """
    pieces, repeats = round(ATTACK_SECONDS / ATTACK_STEP_SECONDS), max(1, round(ATTACK_STEP_SECONDS / driver.time_step))
    low, high = -driver.safety.leader_braking, MAX_LEADER_ACCELERATION
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
    return *min(worst, key=lambda each: each[0].gap.min()), steps


def _test_strings(
    simulate: FollowingSimulator, speeds: list[float], step: float, humans: IDMParameters
) -> tuple[StringStability, ...]:
    """Simulate leaders with oscillations of all speeds and frequencies at once, each with one CAV behind it."""
    seconds = SETTLING_SECONDS + max(MIN_MEASURED_SECONDS, MEASURED_PERIODS * 2.0 * np.pi / OSCILLATION_FREQUENCIES[0])
    times: Floats = step * np.arange(round(seconds / step) + 1, dtype=np.float64)
    phases = OSCILLATION_FREQUENCIES * np.clip(times - SETTLING_SECONDS, 0.0, None)[:, None]
    means = np.repeat(speeds, len(OSCILLATION_FREQUENCIES))
    gaps = np.repeat([equilibrium_gap(speed, humans) for speed in speeds], len(OSCILLATION_FREQUENCIES))
    leaders = means * np.tile(1.0 + OSCILLATION_AMPLITUDE * np.sin(phases), len(speeds))
    record = simulate(FollowingState(means, means, gaps), np.diff(leaders, axis=0) / step)
    responses = np.split(record.speed, len(speeds), axis=1)
    pairs = zip(speeds, responses, strict=True)
    return tuple(_string_stability(speed, response, times, humans) for speed, response in pairs)


def _string_stability(speed: float, responses: Floats, times: Floats, humans: IDMParameters) -> StringStability:
    """Return the result for one mean speed; `responses` has the shape (times, frequencies) [m/s]."""
    pairs = zip(responses.T, OSCILLATION_FREQUENCIES, strict=True)
    amplitudes = np.array([_amplitude(response, times, frequency) for response, frequency in pairs])
    gains = amplitudes / (OSCILLATION_AMPLITUDE * speed)
    amplified = OSCILLATION_FREQUENCIES[gains > 1.0 + GAIN_TOLERANCE]
    human_gains = human_gain(OSCILLATION_FREQUENCIES, speed, humans)
    stable = [n for n in range(MAX_FOLLOWERS + 1) if (gains * human_gains**n).max() <= 1.0 + GAIN_TOLERANCE]
    return StringStability(
        speed,
        tuple(OSCILLATION_FREQUENCIES.tolist()),
        tuple(gains.tolist()),
        tuple(human_gains.tolist()),
        float(OSCILLATION_FREQUENCIES[int(np.argmax(gains))]),
        (float(amplified[0]), float(amplified[-1])) if len(amplified) else (),
        max(stable, default=0),
    )


def _amplitude(values: Floats, times: Floats, frequency: float) -> float:
    """Return the amplitude at a frequency over the last whole periods within the measured time."""
    period = 2.0 * np.pi / frequency
    duration = max(1, int((times[-1] - SETTLING_SECONDS) / 2.0 / period)) * period
    measured = times > times[-1] - duration
    wave = (values[measured] - values[measured].mean()) * np.exp(-1j * frequency * times[measured])
    return float(2.0 * np.abs(wave.mean()))


def human_gain(frequencies: Floats, speed: float, humans: IDMParameters) -> Floats:
    """Return the gain of a human driver by the linearized IDM at equilibrium: own amplitude over the leader's.

    |(f_dv j w + f_s) / ((j w)^2 + (f_dv - f_v) j w + f_s)|, where f(s, dv, v) is the acceleration, dv the
    leader's speed minus the own, and f_v its derivative at constant dv.
    Source: Treiber and Kesting 2013, Traffic Flow Dynamics, chapter 15.
    """
    gap, small = equilibrium_gap(speed, humans), 1e-5

    def f(s: float, dv: float, v: float) -> float:
        return float(idm_acceleration(v, v + dv, s, humans))

    f_s = (f(gap + small, 0.0, speed) - f(gap - small, 0.0, speed)) / (2.0 * small)
    f_dv = (f(gap, small, speed) - f(gap, -small, speed)) / (2.0 * small)
    f_v = (f(gap, 0.0, speed + small) - f(gap, 0.0, speed - small)) / (2.0 * small)
    s = 1j * frequencies
    return np.abs((f_dv * s + f_s) / (s**2 + (f_dv - f_v) * s + f_s))
