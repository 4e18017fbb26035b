"""What a controller is certified for: worst cases tried, comfort, strings of vehicles, and the domain."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from unjam.controller.file import SAMPLE, Controller, Floats, read_sample
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import Actuator, Ahead
from unjam.drivers.wrappers import Filtered
from unjam.errors import InputError
from unjam.files import reading
from unjam.parameters import build
from unjam.physics.idm import IDMParameters, equilibrium_gap, idm_acceleration
from unjam.worlds.drive import drive
from unjam.worlds.world import Pursued, PursuitWorld

MEAN_SECONDS = 2.0
"""over which ISO 15622 takes the mean of an acceleration [s]"""
STOP_SECONDS = 20.0
"""how long a leader's emergency stop is followed [s]"""
ATTACK_SECONDS, ATTACK_PIECE = 40.0, 1.0
"""an adversary's manoeuvre, and how long each of its accelerations holds [s]"""
ATTACKS, GENERATIONS, KEPT = 128, 16, 12
"""manoeuvres in a generation, generations, and how many of the worst breed the next (cross-entropy method)"""
MOVING = 1.0
"""speed above which a time headway counts, and strings are looked at [m/s]"""
STRING_SHARES = (0.5, 0.9)
"""of the highest visited speed, at which strings are looked at"""
LEADER_ACCELERATION = 3.0
"""largest of an adversary [m/s2]"""
SWAY = 0.05
"""amplitude of a leader's speed, as a share of its mean: small, so that the answer is about linear"""
SETTLE, PERIODS, LEAST = 100.0, 2, 200.0
"""time to settle [s]; whole periods that are measured, but at least so long [s]"""
FREQUENCIES = np.geomspace(0.04, 3.0, 20)
"""[rad/s]"""
MOST_BEHIND = 60
"""people behind a CAV that are tried"""
ROUNDING = 5e-3
"""of a gain that counts as one"""


@dataclass(frozen=True)
class WorstCases:
    """What was tried to make a controller touch its leader, under the filter."""

    stops: int
    """visited states from which the leader stopped with the hardest braking"""
    steps: int
    """of single cars, in all"""
    contacts: int
    smallest_gap: float
    """[m]"""
    smallest_headway: float
    """faster than 1 m/s, behind a leader who brakes no harder than the floor allows for [s]"""
    hardest_braking: float
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
    people: tuple[float, ...]
    """one human's, by the linearised IDM"""
    worst_frequency: float
    """where the CAV's is largest [rad/s]"""
    amplified: tuple[float, ...]
    """smallest and largest frequency at which the CAV's gain is above one; empty where none is [rad/s]"""
    stabilised: int
    """most people behind the CAV whose last one sways no more than the leader at any frequency"""


@dataclass(frozen=True)
class Comfort:
    """How it feels to ride along on its road."""

    acceleration: float
    """root mean square [m/s2]; below 0.315 ISO 2631-1 calls it not uncomfortable"""
    hardest_braking: float
    """mean over 2 s, as ISO 15622 counts it [m/s2]"""
    within_iso_15622: bool
    """braking at most 3.5 m/s2 above 20 m/s, 5 m/s2 below 5 m/s, linear between; speeding up at most 2, 4"""


@dataclass(frozen=True)
class Domain:
    """Where a controller was seen: smallest and largest of what it perceived."""

    speed: tuple[float, float]
    leader_speed: tuple[float, float]
    leader_gap: tuple[float, float]

    def holds(self, state: Any) -> Any:
        """Return whether states lie within, a truth for each row."""
        inside: Any = True
        for name, (low, high) in asdict(self).items():
            value = getattr(state, name)
            inside = inside & (value >= low) & (value <= high)
        return inside


@dataclass(frozen=True)
class Certificate:
    """All of it."""

    worst: WorstCases
    comfort: Comfort
    strings: tuple[StringStability, ...]
    domain: Domain


def certificate_of(controller: Controller) -> dict[str, Any]:
    """Try a controller on what its sample says that it perceived; return what a certificate says, as JSON.

    Raises:
        InputError: it has no filter, no sample or no road: nothing can be certified.
    """
    driver = controller.driver
    if not isinstance(driver, Filtered) or not driver.safety.active or SAMPLE not in controller.parts:
        raise InputError(
            "certify: a controller without its safety filter and sample is not allowed; allowed: what "
            "`unjam export` writes of a road with a filter"
        )
    if "scenario" not in controller.manifest:
        raise InputError(
            "certify: a controller that names no road is not allowed; allowed: one that was exported with "
            "--scenario"
        )
    with reading("certify"):
        states, _ = read_sample(controller.parts[SAMPLE])
        road = controller.manifest["scenario"]
        humans = build(IDMParameters, road["humans"], "controller: humans")
        actuator = build(Actuator, road.get("actuator", {}), "controller: actuator")
    if not actuator.instant:
        raise InputError(
            "certify: a road whose cars obey late is not allowed; allowed: actuator.delay and lag 0"
        )
    return asdict(certify(driver, states, humans))


Pursue = Callable[[Ahead, Floats], Pursued]
"""drives a controller behind leaders: (where the pairs begin, what leaders do)"""


def certify(driver: Filtered, visited: LocalState, humans: IDMParameters) -> Certificate:
    """Try a controller with its filter, and say what holds; the same controller gets the same certificate.

    `visited` is what one of its CAVs perceived on its road, arrays of shape (T,); `humans` drive behind it.
    """
    loop = float(visited.loop_length[0])

    def pursue(start: Ahead, leader: Floats) -> Pursued:
        return drive(PursuitWorld(start, leader, driver.limits, driver.time_step, loop), driver)

    states = Ahead(*visited[:3])
    ranges = [(float(values.min()), float(values.max())) for values in states]
    speeds = [round(share * float(states.speed.max()), 1) for share in STRING_SHARES]
    speeds = [speed for speed in speeds if MOVING < speed < humans.desired_speed]
    return Certificate(
        _worst_cases(pursue, states, driver, np.random.default_rng(0)),
        _comfort(states.speed, driver.time_step),
        _strings(pursue, speeds, driver.time_step, humans) if speeds else (),
        Domain(*ranges),
    )


def _worst_cases(
    pursue: Pursue, states: Ahead, driver: Filtered, generator: np.random.Generator
) -> WorstCases:
    """Let leaders stop from every visited state, and an adversary look for something worse."""
    safety, step = driver.safety, driver.time_step
    safe = safety.highest(states, step) > -safety.braking  # elsewhere nothing was promised
    states = Ahead(*(values[safe] for values in states))
    rows = len(states.speed)
    stop = np.full((round(STOP_SECONDS / step), rows), -safety.leader_braking)
    stopped = pursue(states, stop)
    gently = pursue(states, stop * (safety.headway_braking / safety.leader_braking))
    attacked, attack, steps = _attacked(pursue, states, driver, generator)
    moving, found = gently.speed > MOVING, (stopped, gently, attacked)
    return WorstCases(
        stops=rows,
        steps=2 * stop.size + steps,
        contacts=int(sum((each.gap.min(0) < 0.0).sum() for each in found)),
        smallest_gap=float(min(each.gap.min() for each in found)),
        smallest_headway=float((gently.gap[moving] / gently.speed[moving]).min(initial=np.inf)),
        hardest_braking=max(float(-np.diff(each.speed, axis=0).min()) / step for each in found),
        attack=tuple(np.round(attack, 2).tolist()),
    )


def _comfort(speed: Floats, step: float) -> Comfort:
    """Return how it feels to drive so; `speed` has the shape (T,) [m/s]."""
    span = max(1, round(MEAN_SECONDS / step))
    means = (speed[span:] - speed[:-span]) / (span * step)
    before = speed[: len(means)]
    braking, push = (np.interp(before, [5.0, 20.0], ends) for ends in ([5.0, 3.5], [4.0, 2.0]))
    accelerations = np.diff(speed) / step
    return Comfort(
        acceleration=float(np.sqrt((accelerations**2).mean())),
        hardest_braking=float(-means.min(initial=0.0)),
        within_iso_15622=bool(((means >= -braking) & (means <= push)).all()),
    )


def _attacked(
    pursue: Pursue, states: Ahead, driver: Filtered, generator: np.random.Generator
) -> tuple[Pursued, Floats, int]:
    """Search manoeuvres of a leader that come as close as can be: the cross-entropy method.

    Returns:
        The generation that came closest, its worst manoeuvre, and steps of single cars.
    """
    pieces, held = round(ATTACK_SECONDS / ATTACK_PIECE), max(1, round(ATTACK_PIECE / driver.time_step))
    low, high = -driver.safety.leader_braking, LEADER_ACCELERATION
    mean, spread = np.zeros(pieces), np.full(pieces, (high - low) / 2.0)
    chosen = generator.integers(len(states.speed), size=ATTACKS)
    start = Ahead(*(values[chosen] for values in states))
    tried: list[tuple[Pursued, Floats]] = []
    for _ in range(GENERATIONS):
        tries = np.clip(generator.normal(mean, spread, (ATTACKS, pieces)), low, high)
        found = pursue(start, np.repeat(tries, held, axis=1).T)
        order = np.argsort(found.gap.min(0))
        tried.append((found, tries[order[0]]))
        best = tries[order[:KEPT]]
        mean, spread = best.mean(0), best.std(0) + 0.2
    return *min(tried, key=lambda each: each[0].gap.min()), GENERATIONS * ATTACKS * pieces * held


def _strings(
    pursue: Pursue, speeds: list[float], step: float, humans: IDMParameters
) -> tuple[StringStability, ...]:
    """Let leaders sway at all speeds and frequencies at once, one CAV behind each."""
    seconds = SETTLE + max(LEAST, PERIODS * 2.0 * np.pi / FREQUENCIES[0])
    times: Floats = step * np.arange(round(seconds / step) + 1, dtype=np.float64)
    sway = 1.0 + SWAY * np.sin(FREQUENCIES * np.clip(times - SETTLE, 0.0, None)[:, None])
    means = np.repeat(speeds, len(FREQUENCIES))
    gaps = np.repeat([equilibrium_gap(speed, humans) for speed in speeds], len(FREQUENCIES))
    leaders = means * np.tile(sway, len(speeds))
    found = pursue(Ahead(means, means, gaps), np.diff(leaders, axis=0) / step)
    by_speed = np.split(found.speed, len(speeds), axis=1)
    return tuple(
        _string(speed, answers, times, humans) for speed, answers in zip(speeds, by_speed, strict=True)
    )


def _string(speed: float, answers: Floats, times: Floats, humans: IDMParameters) -> StringStability:
    """Return what became of the sways around one speed; `answers` has the shape (moments, frequencies)."""
    pairs = zip(answers.T, FREQUENCIES, strict=True)
    gains = np.array([_amplitude(answer, times, frequency) for answer, frequency in pairs]) / (SWAY * speed)
    growing = FREQUENCIES[gains > 1.0 + ROUNDING]
    people = human_gain(FREQUENCIES, speed, humans)
    stable = [n for n in range(MOST_BEHIND + 1) if (gains * people**n).max() <= 1.0 + ROUNDING]
    return StringStability(
        speed,
        tuple(FREQUENCIES.tolist()),
        tuple(gains.tolist()),
        tuple(people.tolist()),
        float(FREQUENCIES[int(np.argmax(gains))]),
        (float(growing[0]), float(growing[-1])) if len(growing) else (),
        max(stable, default=0),
    )


def _amplitude(values: Floats, times: Floats, frequency: float) -> float:
    """Return the amplitude at a frequency over the last whole periods that fit into what is measured."""
    period = 2.0 * np.pi / frequency
    whole = max(1, int((times[-1] - SETTLE) / 2.0 / period)) * period
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
