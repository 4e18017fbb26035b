"""Metrics of fuel by power, of gaps of CAVs, and of a platoon behind a recorded vehicle."""

from collections.abc import Callable
from math import inf, nan
from typing import Any

import numpy as np

from unjam.measures.averages import mean_over_cavs, row_chunks
from unjam.physics.fuel import fuel_rate
from unjam.worlds.record import VEHICLE_GROUPS, Episode, Floats

MIN_WAVE_STD = 0.05  # standard deviation of the recorded speed below which there are no waves [m/s]


def fuel_by_power(episode: Episode) -> float:
    """Fuel of all vehicles by the power that a mid-size petrol car needs [ml/km], with 0.9 l/h at standstill.

    On a user's network cars, trucks and buses count, all with the power of this car. Treiber and Kesting 2013, Traffic
    Flow Dynamics, section 20.4.
    """
    return _fuel_by_power(episode, np.s_[:])


def cav_fuel_by_power(episode: Episode) -> float:
    """Fuel of the CAVs by power [ml/km], as `fuel_by_power`; NaN without CAVs."""
    return _fuel_by_power(episode, episode.cav_columns)


def human_fuel_by_power(episode: Episode) -> float:
    """Fuel of the human drivers by power [ml/km], as `fuel_by_power`; NaN without human drivers."""
    return _fuel_by_power(episode, np.setdiff1d(np.arange(episode.speeds.shape[1]), episode.cav_columns))


def _fuel_by_power(episode: Episode, columns: Any) -> float:
    """Return the fuel of the vehicles in `columns` by power; acceleration is the change of speed in a control step.

    The acceleration in the step in which a vehicle enters is unknown: neither fuel nor distance of this step counts.
    """
    if episode.trips.vehicle_ids:
        counted_ids = episode.trips.vehicles_of(*VEHICLE_GROUPS)
        is_counted = np.zeros(episode.speeds.shape[1], bool)  # only vehicles of one class share a column
        vehicle_columns = np.array(episode.vehicle_columns or range(len(is_counted)), np.intp)
        is_counted[vehicle_columns] = [vehicle_id in counted_ids for vehicle_id in episode.vehicle_ids]
        indices = np.arange(len(is_counted))[columns]
        columns = indices[is_counted[indices]]
    speeds, fuel, distance = episode.speeds[:, columns], 0.0, 0.0
    for previous, current in zip(row_chunks(speeds[:-1]), row_chunks(speeds[1:]), strict=True):
        fuel += float(np.nansum(fuel_rate(current, (current - previous) / episode.control_step)))
        distance += float(np.nansum(np.where(np.isnan(previous), np.nan, current)))
    return fuel / (distance / 1000.0) if distance else nan


def cav_mean_gap(episode: Episode) -> float:
    """Mean gap of the CAV to its leader [m]; in front of a free road the gap is limited to what CAVs observe."""
    return mean_over_cavs(episode, lambda trajectory: np.mean(trajectory.states.leader_gap[1:]))


def cav_gap_95(episode: Episode) -> float:
    """Gap of the CAV to its leader that is exceeded in 5 % of the time [m]."""
    return mean_over_cavs(episode, lambda trajectory: np.quantile(trajectory.states.leader_gap[1:], 0.95))


def cav_max_gap(episode: Episode) -> float:
    """Largest gap of a CAV to its leader [m]; NaN without CAVs."""
    return float(max((trajectory.states.leader_gap.max() for trajectory in episode.trajectories), default=np.nan))


def time_behind_leader(episode: Episode) -> float:
    """Time by which the last vehicle is behind the recorded vehicle at the end [s]; NaN on other roads.

    The difference to human drivers is time that the platoon has lost. If the last vehicle has not reached the point at
    which the recording begins, the recorded vehicle is assumed to have driven there with its mean speed; NaN if this
    speed is zero.
    """
    if not episode.has_recorded_leader:
        return nan
    leader_positions, position = episode.replayed_motion[:, 0, 0], float(episode.positions[-1, 0])
    leader_step = float(np.interp(position, leader_positions, np.arange(len(episode.speeds))))
    if position < leader_positions[0]:
        step_length = float(leader_positions[-1] - leader_positions[0]) / (len(leader_positions) - 1)
        leader_step = (position - float(leader_positions[0])) / step_length if step_length > 0.0 else nan
    return (episode.control_steps - leader_step) * episode.control_step


def amplification(episode: Episode) -> float:
    """Standard deviation over time of the last vehicle's speed, divided by that of the recorded vehicle.

    Above 1 the platoon amplifies waves, below 1 it dampens them. NaN without waves, and on other roads.
    """
    if not episode.has_recorded_leader:
        return nan
    recorded_std = float(np.std(episode.replayed_motion[1:, 0, 1]))
    return float(np.std(episode.speeds[1:, 0])) / recorded_std if recorded_std > MIN_WAVE_STD else nan


def period_amplification(longest: float, shortest: float) -> Callable[[Episode], float]:
    """Return the metric function of the amplification of waves with periods between two limits [s]."""

    def ratio(episode: Episode) -> float:
        if not episode.has_recorded_leader:
            return nan
        recorded_speeds, last_speeds = episode.replayed_motion[1:, 0, 1], episode.speeds[1:, 0]
        frequencies = np.fft.rfftfreq(len(last_speeds), episode.control_step)
        is_in_band = (frequencies > 1.0 / longest) & (frequencies <= 1.0 / shortest)
        spectra = (_spectrum(speeds)[is_in_band] for speeds in (recorded_speeds, last_speeds))
        recorded_std, last_std = (float(np.sqrt(np.sum(spectrum**2))) for spectrum in spectra)
        return last_std / recorded_std if recorded_std > MIN_WAVE_STD else nan

    limits = f"above {shortest:g} s" if longest == inf else f"of {shortest:g} to {longest:g} s"
    ratio.__doc__ = (
        f"Amplification of waves with periods {limits} from the recorded to the last vehicle; NaN on other roads, and "
        f"if the waves of the recorded vehicle are below {MIN_WAVE_STD:g} m/s."
    )
    return ratio


def _spectrum(speeds: Floats) -> Floats:
    """Return the standard deviation of a speed at each frequency; its trend is removed for the Hann window."""
    steps, window = np.arange(len(speeds)), np.hanning(len(speeds))
    trend = np.polynomial.Polynomial.fit(steps, speeds, 1)(steps)
    scale = np.sqrt(2.0 / (len(speeds) * np.sum(window**2)))
    return scale * np.abs(np.fft.rfft((speeds - trend) * window))
