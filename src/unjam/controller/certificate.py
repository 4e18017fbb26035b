"""What a controller is certified for: worst cases tried, comfort, strings of vehicles, and the domain."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from unjam.controller.file import SAMPLE_PART, Controller, Floats, read_sample
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import Actuator, FollowingState
from unjam.drivers.wrappers import FilteredDriver
from unjam.errors import InputError
from unjam.files import reject_damaged
from unjam.parameters import build_dataclass
from unjam.physics.idm import IDMParameters, equilibrium_gap, idm_acceleration
from unjam.worlds.drive import drive_world
from unjam.worlds.world import CarFollowingRecord, CarFollowingWorld

ISO_MEAN_SECONDS = 2.0
"""over which ISO 15622 takes the mean of an acceleration [s]"""
LEADER_STOP_SECONDS = 20.0
"""how long a leader's emergency stop is followed [s]"""
ATTACK_SECONDS, ATTACK_STEP_SECONDS = 40.0, 1.0
"""an adversary's manoeuvre, and how long each of its accelerations holds [s]"""
ATTACK_POPULATION, ATTACK_GENERATIONS, ATTACK_ELITES = 128, 16, 12
"""manoeuvres in a generation, generations, and how many of the worst breed the next (cross-entropy method)"""
MIN_MOVING_SPEED = 1.0
"""speed above which a time headway counts, and strings are looked at [m/s]"""
STRING_SPEED_RATIOS = (0.5, 0.9)
"""of the highest visited speed, at which strings are looked at"""
MAX_LEADER_ACCELERATION = 3.0
"""largest of an adversary [m/s2]"""
OSCILLATION_AMPLITUDE = 0.05
"""amplitude of a leader's speed, as a share of its mean: small, so that the answer is about linear"""
SETTLING_SECONDS, MEASURED_PERIODS, MIN_MEASURED_SECONDS = 100.0, 2, 200.0
"""time to settle [s]; whole periods that are measured, but at least so long [s]"""
OSCILLATION_FREQUENCIES = np.geomspace(0.04, 3.0, 20)
"""[rad/s]"""
MAX_FOLLOWERS = 60
"""people behind a CAV that are tried"""
GAIN_TOLERANCE = 5e-3
"""of a gain that counts as one"""


@dataclass(frozen=True)
class WorstCases:
    """What was tried to make a controller touch its leader, under the filter."""

    leader_stops: int
    """visited states from which the leader stopped with the hardest braking"""
    steps: int
    """of single cars, in all"""
    contacts: int
    min_gap: float
    """[m]"""
    min_time_gap: float
    """faster than 1 m/s, behind a leader who brakes no harder than the floor allows for [s]"""
    max_braking: float
    """[m/s2]"""
    attack: tuple[float, ...]
    """the leader's accelerations that came closest, each for a second [m/s2]"""


@dataclass(frozen=True)
class StringStability:
    """What becomes of a leader's sway at one speed."""

    speed: float
    """[m/s]"""
    frequencies: tuple[float, ...]
    """[rad/s]"""
    gains: tuple[float, ...]
    """the CAV's amplitude over the leader's, at each"""
    human_gains: tuple[float, ...]
    """one human's, by the linearised IDM"""
    peak_frequency: float
    """where the CAV's is largest [rad/s]"""
    amplified_band: tuple[float, ...]
    """smallest and largest frequency at which the CAV's gain is above one; empty where none is [rad/s]"""
    max_stable_followers: int
    """most people behind the CAV whose last one sways no more than the leader at any frequency"""


@dataclass(frozen=True)
class Comfort:
    """How it feels to ride along on its road."""

    rms_acceleration: float
    """root mean square [m/s2]; below 0.315 ISO 2631-1 calls it not uncomfortable"""
    max_braking: float
    """mean over 2 s, as ISO 15622 counts it [m/s2]"""
    meets_iso_15622: bool
    """braking at most 3.5 m/s2 above 20 m/s, 5 m/s2 below 5 m/s, linear between; speeding up at most 2, 4"""


@dataclass(frozen=True)
class OperatingDomain:
    """Where a controller was seen: smallest and largest of what it perceived."""

    speed: tuple[float, float]
    leader_speed: tuple[float, float]
    leader_gap: tuple[float, float]

    def contains(self, states: Any) -> Any:
        """Return whether states lie within, a truth for each row."""
        inside: Any = True
        for name, (low, high) in asdict(self).items():
            value = getattr(states, name)
            inside = inside & (value >= low) & (value <= high)
        return inside


@dataclass(frozen=True)
class Certificate:
    """All of it."""

    worst_cases: WorstCases
    comfort: Comfort
    string_stability: tuple[StringStability, ...]
    domain: OperatingDomain


def make_certificate(controller: Controller) -> dict[str, Any]:
    """Try a controller on what its sample says that it perceived; return what a certificate says, as JSON.

    Raises:
        InputError: it has no filter, no sample or no road: nothing can be certified.
    """
    driver = controller.driver
    if not isinstance(driver, FilteredDriver) or not driver.safety.active or SAMPLE_PART not in controller.parts:
        raise InputError(
            "certify: a controller without its safety filter and sample is not allowed; allowed: what "
            "`unjam export` writes of a road with a filter"
        )
    if "scenario" not in controller.manifest:
        raise InputError(
            "certify: a controller that names no road is not allowed; allowed: one that was exported with --scenario"
        )
    with reject_damaged("certify"):
        states, _ = read_sample(controller.parts[SAMPLE_PART])
        road = controller.manifest["scenario"]
        humans = build_dataclass(IDMParameters, road["humans"], "controller: humans")
        actuator = build_dataclass(Actuator, road.get("actuator", {}), "controller: actuator")
    if not actuator.is_instant:
        raise InputError("certify: a road whose cars obey late is not allowed; allowed: actuator.delay and lag 0")
    return asdict(certify_driver(driver, states, humans))


FollowingSimulator = Callable[[FollowingState, Floats], CarFollowingRecord]
"""drives a controller behind leaders: (where the pairs begin, what leaders do)"""


def certify_driver(driver: FilteredDriver, visited_states: LocalState, humans: IDMParameters) -> Certificate:
    """Try a controller with its filter, and say what holds; the same controller gets the same certificate.

    `visited` is what one of its CAVs perceived on its road, arrays of shape (T,); `humans` drive behind it.
    """
    loop = float(visited_states.loop_length[0])

    def simulate(initial_states: FollowingState, leader_accelerations: Floats) -> CarFollowingRecord:
        return drive_world(
            CarFollowingWorld(initial_states, leader_accelerations, driver.limits, driver.time_step, loop), driver
        )

    states = FollowingState(*visited_states[:3])
    ranges = [(float(values.min()), float(values.max())) for values in states]
    speeds = [round(share * float(states.speed.max()), 1) for share in STRING_SPEED_RATIOS]
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
    """Let leaders stop from every visited state, and an adversary look for something worse."""
    safety, step = driver.safety, driver.time_step
    safe = safety.max_acceleration(states, step) > -safety.braking  # elsewhere nothing was promised
    states = FollowingState(*(values[safe] for values in states))
    rows = len(states.speed)
    stop = np.full((round(LEADER_STOP_SECONDS / step), rows), -safety.leader_braking)
    stopped = simulate(states, stop)
    gently = simulate(states, stop * (safety.time_gap_braking / safety.leader_braking))
    attacked, attack, steps = _search_attacks(simulate, states, driver, generator)
    moving, found = gently.speed > MIN_MOVING_SPEED, (stopped, gently, attacked)
    return WorstCases(
        leader_stops=rows,
        steps=2 * stop.size + steps,
        contacts=int(sum((each.gap.min(0) < 0.0).sum() for each in found)),
        min_gap=float(min(each.gap.min() for each in found)),
        min_time_gap=float((gently.gap[moving] / gently.speed[moving]).min(initial=np.inf)),
        max_braking=max(float(-np.diff(each.speed, axis=0).min()) / step for each in found),
        attack=tuple(np.round(attack, 2).tolist()),
    )


def _comfort(speeds: Floats, step: float) -> Comfort:
    """Return how it feels to drive so; `speed` has the shape (T,) [m/s]."""
    span = max(1, round(ISO_MEAN_SECONDS / step))
    means = (speeds[span:] - speeds[:-span]) / (span * step)
    before = speeds[: len(means)]
    braking, push = (np.interp(before, [5.0, 20.0], ends) for ends in ([5.0, 3.5], [4.0, 2.0]))
    accelerations = np.diff(speeds) / step
    return Comfort(
        rms_acceleration=float(np.sqrt((accelerations**2).mean())),
        max_braking=float(-means.min(initial=0.0)),
        meets_iso_15622=bool(((means >= -braking) & (means <= push)).all()),
    )


def _search_attacks(
    simulate: FollowingSimulator, states: FollowingState, driver: FilteredDriver, generator: np.random.Generator
) -> tuple[CarFollowingRecord, Floats, int]:
    """Search manoeuvres of a leader that come as close as can be: the cross-entropy method.

    Returns:
        The generation that came closest, its worst manoeuvre, and steps of single cars.
    """
    pieces, held = round(ATTACK_SECONDS / ATTACK_STEP_SECONDS), max(1, round(ATTACK_STEP_SECONDS / driver.time_step))
    low, high = -driver.safety.leader_braking, MAX_LEADER_ACCELERATION
    mean, spread = np.zeros(pieces), np.full(pieces, (high - low) / 2.0)
    chosen = generator.integers(len(states.speed), size=ATTACK_POPULATION)
    start = FollowingState(*(values[chosen] for values in states))
    tried: list[tuple[CarFollowingRecord, Floats]] = []
    for _ in range(ATTACK_GENERATIONS):
        tries = np.clip(generator.normal(mean, spread, (ATTACK_POPULATION, pieces)), low, high)
        found = simulate(start, np.repeat(tries, held, axis=1).T)
        order = np.argsort(found.gap.min(0))
        tried.append((found, tries[order[0]]))
        best = tries[order[:ATTACK_ELITES]]
        mean, spread = best.mean(0), best.std(0) + 0.2
    return *min(tried, key=lambda each: each[0].gap.min()), ATTACK_GENERATIONS * ATTACK_POPULATION * pieces * held


def _test_strings(
    simulate: FollowingSimulator, speeds: list[float], step: float, humans: IDMParameters
) -> tuple[StringStability, ...]:
    """Let leaders sway at all speeds and frequencies at once, one CAV behind each."""
    seconds = SETTLING_SECONDS + max(MIN_MEASURED_SECONDS, MEASURED_PERIODS * 2.0 * np.pi / OSCILLATION_FREQUENCIES[0])
    times: Floats = step * np.arange(round(seconds / step) + 1, dtype=np.float64)
    sway = 1.0 + OSCILLATION_AMPLITUDE * np.sin(
        OSCILLATION_FREQUENCIES * np.clip(times - SETTLING_SECONDS, 0.0, None)[:, None]
    )
    means = np.repeat(speeds, len(OSCILLATION_FREQUENCIES))
    gaps = np.repeat([equilibrium_gap(speed, humans) for speed in speeds], len(OSCILLATION_FREQUENCIES))
    leaders = means * np.tile(sway, len(speeds))
    found = simulate(FollowingState(means, means, gaps), np.diff(leaders, axis=0) / step)
    by_speed = np.split(found.speed, len(speeds), axis=1)
    return tuple(
        _string_stability(speed, answers, times, humans) for speed, answers in zip(speeds, by_speed, strict=True)
    )


def _string_stability(speed: float, speeds: Floats, times: Floats, humans: IDMParameters) -> StringStability:
    """Return what became of the sways around one speed; `member_predictions` has the shape (moments, frequencies)."""
    pairs = zip(speeds.T, OSCILLATION_FREQUENCIES, strict=True)
    gains = np.array([_amplitude(answer, times, frequency) for answer, frequency in pairs]) / (
        OSCILLATION_AMPLITUDE * speed
    )
    growing = OSCILLATION_FREQUENCIES[gains > 1.0 + GAIN_TOLERANCE]
    people = human_gain(OSCILLATION_FREQUENCIES, speed, humans)
    stable = [n for n in range(MAX_FOLLOWERS + 1) if (gains * people**n).max() <= 1.0 + GAIN_TOLERANCE]
    return StringStability(
        speed,
        tuple(OSCILLATION_FREQUENCIES.tolist()),
        tuple(gains.tolist()),
        tuple(people.tolist()),
        float(OSCILLATION_FREQUENCIES[int(np.argmax(gains))]),
        (float(growing[0]), float(growing[-1])) if len(growing) else (),
        max(stable, default=0),
    )


def _amplitude(values: Floats, times: Floats, frequency: float) -> float:
    """Return the amplitude at a frequency over the last whole periods that fit into what is measured."""
    period = 2.0 * np.pi / frequency
    whole = max(1, int((times[-1] - SETTLING_SECONDS) / 2.0 / period)) * period
    chosen = times > times[-1] - whole
    wave = (values[chosen] - values[chosen].mean()) * np.exp(-1j * frequency * times[chosen])
    return float(2.0 * np.abs(wave.mean()))


def human_gain(frequencies: Floats, speed: float, humans: IDMParameters) -> Floats:
    """Return how much of a leader's sway a human of the linearised IDM makes, at equilibrium.

    |(f_dv j w + f_s) / ((j w)^2 + (f_dv - f_v) j w + f_s)|, where f(s, dv, v) is the acceleration, dv the
    leader's speed less the own, and f_v its derivative at constant dv.
    Source: Treiber and Kesting 2013, Traffic Flow Dynamics, chapter 15.
    """
    gap, small = equilibrium_gap(speed, humans), 1e-5

    def f(s: float, closing: float, v: float) -> float:
        return float(idm_acceleration(v, v + closing, s, humans))

    f_s = (f(gap + small, 0.0, speed) - f(gap - small, 0.0, speed)) / (2.0 * small)
    f_dv = (f(gap, small, speed) - f(gap, -small, speed)) / (2.0 * small)
    f_v = (f(gap, 0.0, speed + small) - f(gap, 0.0, speed - small)) / (2.0 * small)
    s = 1j * frequencies
    return np.abs((f_dv * s + f_s) / (s**2 + (f_dv - f_v) * s + f_s))
