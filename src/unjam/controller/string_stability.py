"""String stability: how strongly a vehicle passes on small oscillations of its leader's speed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from unjam.drivers.safety import FollowingState
from unjam.drivers.wrappers import FilteredDriver
from unjam.physics.arrays import Floats
from unjam.physics.idm import IDMParameters, equilibrium_gap, idm_acceleration
from unjam.worlds.drive import drive_world
from unjam.worlds.world import CarFollowingWorld

OSCILLATION_FREQUENCIES = np.geomspace(
    0.001, 1.0, 25
)  # [Hz]: the leader's speed has periods from 17 minutes to a second
OSCILLATION_AMPLITUDE = 0.05  # share of the mean speed; the response to such a small change is nearly linear
SETTLING_SECONDS = 300.0  # time behind a leader with constant speed, before the oscillations start
GAIN_TOLERANCE = 0.02  # a vehicle counts as string stable with gains up to one plus this tolerance
OPERATING_SPEED_RATIOS = (0.5, 1.0, 1.5)  # shares of the mean speed of CAVs on their road
MIN_OPERATING_SPEED = 1.0  # smallest speed of an operating point [m/s]
MIN_SPEED_SHARE = 0.975
"""mean speed as a share of the leader's, below which a vehicle does not follow, but falls behind"""
MAX_FOLLOWERS = 60  # human drivers behind a CAV


@dataclass(frozen=True)
class StringStability:
    """Response to oscillations of the leader around one speed [m/s] at several frequencies [Hz]."""

    speed: float
    frequencies: tuple[float, ...]
    gains: tuple[float, ...]
    """amplitude of the CAV divided by that of the leader, at each frequency; NaN where it falls behind its leader"""
    human_gains: tuple[float, ...]  # gain of a human driver at each frequency, by the linearized IDM
    peak_frequency: float  # frequency of the CAV's largest gain
    amplified_band: tuple[float, ...]  # smallest and largest frequency beyond the tolerance; empty if there is none
    max_stable_followers: int  # human drivers behind the CAV without amplification by all together


def operating_speeds(mean_speed: float, humans: IDMParameters) -> list[float]:
    """Return the speeds of the tests for a road on which CAVs drive with a mean speed [m/s]."""
    speeds = {max(round(ratio * mean_speed, 1), MIN_OPERATING_SPEED) for ratio in OPERATING_SPEED_RATIOS}
    return sorted(speed for speed in speeds if speed < humans.desired_speed)


def measure_string_stability(
    driver: FilteredDriver, speeds: Sequence[float], humans: IDMParameters, loop_length: float = np.nan
) -> tuple[StringStability, ...]:
    """Return the response of a vehicle at each speed [m/s], with `humans` behind it on a road of this length [m]."""
    frequencies, results = OSCILLATION_FREQUENCIES, list[StringStability]()
    for speed, gains in zip(speeds, string_gains(driver, speeds, humans, loop_length), strict=True):
        amplified = frequencies[gains > 1.0 + GAIN_TOLERANCE]
        human_gains = human_gain(frequencies, speed, humans)
        stable = [n for n in range(MAX_FOLLOWERS + 1) if (gains * human_gains**n).max() <= 1.0 + GAIN_TOLERANCE]
        tested, own_gains, human = (tuple(values.tolist()) for values in (frequencies, gains, human_gains))
        band = (float(amplified[0]), float(amplified[-1])) if len(amplified) else ()
        peak_frequency = float(frequencies[int(np.argmax(gains))])
        results.append(StringStability(speed, tested, own_gains, human, peak_frequency, band, max(stable, default=0)))
    return tuple(results)


def string_gains(
    driver: FilteredDriver, speeds: Sequence[float], humans: IDMParameters, loop_length: float = np.nan
) -> Floats:
    """Return the gain at each speed [m/s] and each of the `OSCILLATION_FREQUENCIES`, shape (speeds, frequencies).

    The filter, the limits and the actuator of the driver act, and the CAV starts with the gap of human drivers. The
    gain is NaN where it falls behind its leader: a vehicle that stands still passes on no oscillation either.
    """
    if not speeds:
        return np.zeros((0, len(OSCILLATION_FREQUENCIES)))
    step, count = driver.time_step, len(OSCILLATION_FREQUENCIES)
    times: Floats = step * np.arange(round((SETTLING_SECONDS + 1.0 / OSCILLATION_FREQUENCIES[0]) / step) + 1.0)
    phases = 2.0 * np.pi * OSCILLATION_FREQUENCIES * np.clip(times - SETTLING_SECONDS, 0.0, None)[:, None]
    means = np.repeat(speeds, count)
    gaps = np.repeat([equilibrium_gap(speed, humans) for speed in speeds], count)
    leaders = means * np.tile(1.0 + OSCILLATION_AMPLITUDE * np.sin(phases), len(speeds))
    start = FollowingState(means, means, gaps)
    world = CarFollowingWorld(start, np.diff(leaders, axis=0) / step, driver.limits, step, loop_length, driver.actuator)
    responses = drive_world(world, driver).speed.reshape(len(times), len(speeds), count)
    amplitudes = [
        [
            _amplitude(response, times, frequency)
            for response, frequency in zip(rows, OSCILLATION_FREQUENCIES, strict=True)
        ]
        for rows in responses.transpose(1, 2, 0)
    ]
    settled = responses[times > SETTLING_SECONDS].mean(0)  # one period of the slowest oscillation
    gains = np.array(amplitudes) / (OSCILLATION_AMPLITUDE * np.array(speeds)[:, None])
    return np.where(settled >= MIN_SPEED_SHARE * np.array(speeds)[:, None], gains, np.nan)


def human_gain(frequencies: Floats, speed: float, humans: IDMParameters) -> Floats:
    """Return the gain of a human driver at frequencies [Hz], by the linearized IDM at equilibrium.

    |(f_dv j w + f_s) / ((j w)^2 + (f_dv - f_v) j w + f_s)|, where f(s, dv, v) is the acceleration, dv the
    leader's speed minus the own, f_v its derivative at constant dv, and w the frequency in rad/s.
    Source: Treiber and Kesting 2013, Traffic Flow Dynamics, chapter 15.
    """
    gap, small = equilibrium_gap(speed, humans), 1e-5

    def f(s: float, dv: float, v: float) -> float:
        return float(idm_acceleration(v, v + dv, s, humans))

    f_s = (f(gap + small, 0.0, speed) - f(gap - small, 0.0, speed)) / (2.0 * small)
    f_dv = (f(gap, small, speed) - f(gap, -small, speed)) / (2.0 * small)
    f_v = (f(gap, 0.0, speed + small) - f(gap, 0.0, speed - small)) / (2.0 * small)
    s = 2j * np.pi * frequencies
    return np.abs((f_dv * s + f_s) / (s**2 + (f_dv - f_v) * s + f_s))


def _amplitude(values: Floats, times: Floats, frequency: float) -> float:
    """Return the amplitude at a frequency [Hz] over its last whole periods, at most half of the time, or one period."""
    period = 1.0 / frequency
    duration = max(1, int((times[-1] - SETTLING_SECONDS) / 2.0 / period)) * period
    measured = times > times[-1] - duration
    wave = (values[measured] - values[measured].mean()) * np.exp(-2j * np.pi * frequency * times[measured])
    return float(2.0 * np.abs(wave.mean()))
