"""String stability: the gain of a vehicle for small oscillations of its leader's speed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from unjam.drivers.safety import FollowingState
from unjam.drivers.wrappers import FilteredDriver
from unjam.physics.arrays import Floats
from unjam.physics.idm import IDMParameters, equilibrium_gap, idm_acceleration
from unjam.worlds.drive import drive_world
from unjam.worlds.world import CarFollowingWorld

OSCILLATION_FREQUENCIES = np.geomspace(0.001, 1.0, 25)
"""frequencies of the leader's speed [Hz]: periods of 17 minutes to 1 s"""
OSCILLATION_AMPLITUDE = 0.05  # share of the mean speed; the response to such a small change is nearly linear
SETTLING_SECONDS = 300.0  # time behind a leader with constant speed, before the oscillations start
GAIN_TOLERANCE = 0.02  # a vehicle counts as string stable with gains up to one plus this tolerance
OPERATING_SPEED_RATIOS = (0.5, 1.0, 1.5)  # speeds of the tests as shares of the mean speed of CAVs on their road
MIN_OPERATING_SPEED = 1.0  # smallest speed of a test [m/s]
MIN_SPEED_SHARE = 0.975  # mean speed as a share of the leader's mean speed, below which a vehicle falls behind
MAX_FOLLOWERS = 60  # largest number of human drivers behind a CAV in `max_stable_followers`


@dataclass(frozen=True)
class StringStability:
    """Response to oscillations of the leader around one speed [m/s] at several frequencies [Hz]."""

    speed: float
    frequencies: tuple[float, ...]
    gains: tuple[float, ...]
    """speed amplitude of the CAV relative to the leader at each frequency; NaN if the CAV falls behind its leader"""
    human_gains: tuple[float, ...]  # gain of a human driver at each frequency, by the linearized IDM
    peak_frequency: float  # frequency of the CAV's largest gain
    amplified_band: tuple[float, ...]  # smallest and largest frequency that the CAV amplifies; empty if there is none
    max_stable_followers: int  # largest number of human drivers behind the CAV without amplification by all vehicles


def operating_speeds(mean_speed: float, humans: IDMParameters) -> list[float]:
    """Return the speeds of the tests [m/s] for the mean speed of CAVs and the human drivers on a road."""
    speeds = {max(round(ratio * mean_speed, 1), MIN_OPERATING_SPEED) for ratio in OPERATING_SPEED_RATIOS}
    return sorted(speed for speed in speeds if speed < humans.desired_speed)


def measure_string_stability(
    driver: FilteredDriver, speeds: Sequence[float], humans: IDMParameters, loop_length: float = np.nan
) -> tuple[StringStability, ...]:
    """Return the response of a CAV at each speed [m/s] with human drivers behind it; `loop_length` is NaN if open."""
    frequencies, results = OSCILLATION_FREQUENCIES, list[StringStability]()
    for speed, gains in zip(speeds, string_gains(driver, speeds, humans, loop_length), strict=True):
        amplified = frequencies[gains > 1.0 + GAIN_TOLERANCE]
        human_gains = human_gain(frequencies, speed, humans)
        stable_counts = [n for n in range(MAX_FOLLOWERS + 1) if (gains * human_gains**n).max() <= 1.0 + GAIN_TOLERANCE]
        result = StringStability(
            speed=speed,
            frequencies=tuple(frequencies.tolist()),
            gains=tuple(gains.tolist()),
            human_gains=tuple(human_gains.tolist()),
            peak_frequency=float(frequencies[int(np.argmax(gains))]),
            amplified_band=(float(amplified[0]), float(amplified[-1])) if len(amplified) else (),
            max_stable_followers=max(stable_counts, default=0),
        )
        results.append(result)
    return tuple(results)


def string_gains(
    driver: FilteredDriver, speeds: Sequence[float], humans: IDMParameters, loop_length: float = np.nan
) -> Floats:
    """Return the gain at each speed [m/s] and each of the `OSCILLATION_FREQUENCIES`, shape (speeds, frequencies).

    The simulation includes filter, limits and actuator of the driver. The CAV starts with the equilibrium gap of human
    drivers. The gain is NaN if it falls behind its leader: the gain of a vehicle that stands would be zero.
    """
    if not speeds:
        return np.zeros((0, len(OSCILLATION_FREQUENCIES)))
    step, count = driver.time_step, len(OSCILLATION_FREQUENCIES)
    times: Floats = step * np.arange(round((SETTLING_SECONDS + 1.0 / OSCILLATION_FREQUENCIES[0]) / step) + 1.0)
    phases = 2.0 * np.pi * OSCILLATION_FREQUENCIES * np.clip(times - SETTLING_SECONDS, 0.0, None)[:, None]
    initial_speeds = np.repeat(speeds, count)
    initial_gaps = np.repeat([equilibrium_gap(speed, humans) for speed in speeds], count)
    leader_speeds = initial_speeds * np.tile(1.0 + OSCILLATION_AMPLITUDE * np.sin(phases), len(speeds))
    initial_states = FollowingState(initial_speeds, initial_speeds, initial_gaps)
    leader_accelerations = np.diff(leader_speeds, axis=0) / step
    world = CarFollowingWorld(initial_states, leader_accelerations, driver.limits, step, loop_length, driver.actuator)
    responses = drive_world(world, driver).speed.reshape(len(times), len(speeds), count)
    amplitudes = [
        [
            _amplitude(response, times, frequency)
            for response, frequency in zip(rows, OSCILLATION_FREQUENCIES, strict=True)
        ]
        for rows in responses.transpose(1, 2, 0)
    ]
    mean_speeds = responses[times > SETTLING_SECONDS].mean(0)  # over one period of the slowest oscillation
    gains = np.array(amplitudes) / (OSCILLATION_AMPLITUDE * np.array(speeds)[:, None])
    return np.where(mean_speeds >= MIN_SPEED_SHARE * np.array(speeds)[:, None], gains, np.nan)


def human_gain(frequencies: Floats, speed: float, humans: IDMParameters) -> Floats:
    """Return the gain of a human driver at frequencies [Hz], by the linearized IDM at equilibrium.

    |(f_dv j w + f_s) / ((j w)^2 + (f_dv - f_v) j w + f_s)|, where f(s, dv, v) is the acceleration, dv the leader's
    speed minus own speed, f_s, f_dv and f_v are the partial derivatives of f, and w is the frequency in rad/s.
    Source: Treiber and Kesting 2013, Traffic Flow Dynamics, chapter 15.
    """
    gap, h = equilibrium_gap(speed, humans), 1e-5

    def f(s: float, dv: float, v: float) -> float:
        return float(idm_acceleration(v, v + dv, s, humans))

    f_s = (f(gap + h, 0.0, speed) - f(gap - h, 0.0, speed)) / (2.0 * h)
    f_dv = (f(gap, h, speed) - f(gap, -h, speed)) / (2.0 * h)
    f_v = (f(gap, 0.0, speed + h) - f(gap, 0.0, speed - h)) / (2.0 * h)
    jw = 2j * np.pi * frequencies
    return np.abs((f_dv * jw + f_s) / (jw**2 + (f_dv - f_v) * jw + f_s))


def _amplitude(speeds: Floats, times: Floats, frequency: float) -> float:
    """Return the amplitude at a frequency [Hz] over the last whole periods: at most half of the time, or one period."""
    period = 1.0 / frequency
    duration = max(1, int((times[-1] - SETTLING_SECONDS) / 2.0 / period)) * period
    is_last = times > times[-1] - duration
    oscillation = speeds[is_last] - speeds[is_last].mean()
    return float(2.0 * np.abs((oscillation * np.exp(-2j * np.pi * frequency * times[is_last])).mean()))
