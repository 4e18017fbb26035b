"""Metrics of fuel by power, of the gaps of CAVs, and of a platoon behind a recorded vehicle."""

from collections.abc import Callable
from math import inf, nan
from typing import Any

import numpy as np

from unjam.measures.averages import mean_over_cavs, row_chunks
from unjam.physics.fuel import fuel_rate
from unjam.worlds.record import VEHICLE_GROUPS, Episode, Floats

MIN_WAVE_STD = 0.05  # std of the recorded speed below which there are no waves that could be amplified [m/s]


def fuel_by_power(episode: Episode) -> float:
    """Fuel of all vehicles by the power that a mid-size petrol car needs [ml/km], with 0.9 l/h at standstill.

    On a user's network it counts cars, trucks and buses, each as such a car. Treiber and Kesting 2013, Traffic Flow
    Dynamics, section 20.4.
    """
    return _fuel_by_power(episode, np.s_[:])


def cav_fuel_by_power(episode: Episode) -> float:
    """Fuel of the CAVs by power [ml/km], as `fuel_by_power`; NaN without CAVs."""
    return _fuel_by_power(episode, episode.cav_columns)


def human_fuel_by_power(episode: Episode) -> float:
    """Fuel of the human drivers by power [ml/km], as `fuel_by_power`; NaN without any."""
    return _fuel_by_power(episode, np.setdiff1d(np.arange(episode.speeds.shape[1]), episode.cav_columns))


def _fuel_by_power(episode: Episode, columns: Any) -> float:
    """Return the fuel of the vehicles in some columns; acceleration is the change of speed in a control step.

    The step in which a vehicle enters has no acceleration, so that neither its fuel nor its distance counts.
    """
    if episode.trips.vehicle_ids:
        counted = episode.trips.vehicles_of(*VEHICLE_GROUPS)
        is_counted = np.zeros(episode.speeds.shape[1], bool)  # only vehicles of one class share a column
        numbers = np.array(episode.vehicle_columns or range(len(is_counted)), np.intp)
        is_counted[numbers] = [name in counted for name in episode.vehicle_ids]
        numbers = np.arange(len(is_counted))[columns]
        columns = numbers[is_counted[numbers]]
    speeds, fuel, distance = episode.speeds[:, columns], 0.0, 0.0
    for before, after in zip(row_chunks(speeds[:-1]), row_chunks(speeds[1:]), strict=True):
        fuel += float(np.nansum(fuel_rate(after, (after - before) / episode.control_step)))
        distance += float(np.nansum(np.where(np.isnan(before), np.nan, after)))
    return fuel / (distance / 1000.0) if distance else nan


def cav_mean_gap(episode: Episode) -> float:
    """Mean gap of the CAV to its leader [m]; in front of a free road the gap is limited to what CAVs observe."""
    return mean_over_cavs(episode, lambda trajectory: np.mean(trajectory.states.leader_gap[1:]))


def cav_gap_95(episode: Episode) -> float:
    """Gap of the CAV to its leader that it exceeds in 5 % of the time [m]."""
    return mean_over_cavs(episode, lambda trajectory: np.quantile(trajectory.states.leader_gap[1:], 0.95))


def cav_max_gap(episode: Episode) -> float:
    """Largest gap of a CAV to its leader [m]; NaN without CAVs."""
    return float(max((trajectory.states.leader_gap.max() for trajectory in episode.trajectories), default=np.nan))


def time_behind_leader(episode: Episode) -> float:
    """Time by which the last vehicle is behind the recorded one at the end [s]; NaN on other roads.

    What it is longer than with human drivers is time that the platoon has lost. Where the last vehicle has not reached
    the point at which the recording begins, the recorded vehicle is taken to have driven there with its mean speed;
    NaN if that is zero.
    """
    if not episode.has_recorded_leader:
        return nan
    leader, last = episode.replayed_motion[:, 0, 0], float(episode.positions[-1, 0])
    passed = float(np.interp(last, leader, np.arange(len(episode.speeds))))
    if last < leader[0]:
        step_length = float(leader[-1] - leader[0]) / (len(leader) - 1)
        passed = (last - float(leader[0])) / step_length if step_length > 0.0 else nan
    return (episode.control_steps - passed) * episode.control_step


def amplification(episode: Episode) -> float:
    """Standard deviation over time of the last vehicle's speed over that of the recorded vehicle; NaN elsewhere.

    Above 1 the platoon amplifies the waves of the vehicle ahead, below 1 it dampens them. NaN without waves, too.
    """
    if not episode.has_recorded_leader:
        return nan
    spread = float(np.std(episode.replayed_motion[1:, 0, 1]))
    return float(np.std(episode.speeds[1:, 0])) / spread if spread > MIN_WAVE_STD else nan


def period_amplification(longest: float, shortest: float) -> Callable[[Episode], float]:
    """Return the metric that is the amplification of waves with periods between two limits [s]."""

    def ratio(episode: Episode) -> float:
        if not episode.has_recorded_leader:
            return nan
        recorded, last = episode.replayed_motion[1:, 0, 1], episode.speeds[1:, 0]
        frequencies = np.fft.rfftfreq(len(last), episode.control_step)
        is_in_band = (frequencies > 1.0 / longest) & (frequencies <= 1.0 / shortest)
        recorded_spectrum, last_spectrum = (_spectrum(speeds)[is_in_band] for speeds in (recorded, last))
        recorded_std, last_std = (
            float(np.sqrt(np.sum(spectrum**2))) for spectrum in (recorded_spectrum, last_spectrum)
        )
        return last_std / recorded_std if recorded_std > MIN_WAVE_STD else nan

    limits = f"above {shortest:g} s" if longest == inf else f"of {shortest:g} to {longest:g} s"
    ratio.__doc__ = (
        f"Amplification of waves with periods {limits} from the recorded to the last vehicle; NaN elsewhere, and if "
        f"the recorded vehicle has waves of less than {MIN_WAVE_STD:g} m/s."
    )
    return ratio


def _spectrum(speeds: Floats) -> Floats:
    """Return the standard deviation of a speed at each frequency, without its trend, which a Hann window needs."""
    steps, window = np.arange(len(speeds)), np.hanning(len(speeds))
    trend = np.polynomial.Polynomial.fit(steps, speeds, 1)(steps)
    scale = np.sqrt(2.0 / (len(speeds) * np.sum(window**2)))
    return scale * np.abs(np.fft.rfft((speeds - trend) * window))
