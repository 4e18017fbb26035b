"""What is measured of an episode. Each metric is defined here, once, with its unit and source."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from math import inf, prod
from typing import Any, Literal

import numpy as np

from unjam.measures.feasibility import (
    braking_beyond_metric,
    cav_max_braking,
    cav_min_ttc,
    cut_in_max_braking,
    feasibility,
    filter_override_share,
    human_max_braking,
    max_drac,
    max_jerk,
    min_time_gap,
    min_ttc,
    override_share,
    share_short_time_gap,
    yield_share,
)
from unjam.worlds.audit import BRAKING_THRESHOLDS, OVERRIDE_TOLERANCE
from unjam.worlds.episode_reward import MAX_REWARD_CELLS, episode_reward_terms
from unjam.worlds.record import Episode, Floats
from unjam.worlds.reward import eq16_reward
from unjam.worlds.trips import VEHICLE_GROUPS

STEADY_STATE_STEPS = 1000
"""decisions at the end of an episode that count as steady state; of one that is no longer, its second half"""
STANDING_SPEED = 0.1
"""[m/s]; SUMO's own threshold for a halting vehicle"""
MAX_CALM_SPEED_STD = 0.3
"""std of speed across vehicles below which traffic is calm [m/s]"""
MIN_CALM_SECONDS = 60.0
"""how long traffic must stay calm before its wave counts as dissolved"""
GASOLINE_DENSITY = 742.0
"""[mg/ml], as in SUMO's PollutantsInterface"""
SHARE_BOUNDS, UNBOUNDED = (0.0, 1.0), (-inf, inf)
"""bounds of metrics; others are not negative"""
PEAK_END_SECONDS = 600.0
"""end of a peak of demand in which flow is counted [s]: then it is capacity, not demand"""


def _steady_state(values: Floats) -> Floats:
    return values[-STEADY_STATE_STEPS:] if len(values) > STEADY_STATE_STEPS else values[len(values) // 2 :]


def _mean_over_cavs(values: Sequence[Any]) -> float:
    """Return the mean over CAVs; NaN where there were none."""
    return float(np.mean(values)) if len(values) else float("nan")


def _chunks(speeds: Floats) -> Iterator[Floats]:
    """Return moments part by part: of hours of traffic there is no copy."""
    rows = max(1, MAX_REWARD_CELLS // max(1, prod(speeds.shape[1:])))
    return (speeds[start : start + rows] for start in range(0, len(speeds), rows))


def _mean_of_present(speeds: Floats, transform: Callable[[Floats], Any] = np.asarray) -> float:
    """Return the mean of what `of` makes of all that are on the road; NaN where nobody ever was."""
    total, count = 0.0, 0
    for part in _chunks(speeds):
        there = part[~np.isnan(part)]
        total, count = total + float(transform(there).sum()), count + there.size
    return total / count if count else float("nan")


def _per_step(function: Callable[..., Floats], speeds: Floats) -> Floats:
    """Return `np.nanmean` or the like of each moment; NaN where nobody is."""
    found = []
    for part in _chunks(speeds):
        there = ~np.isnan(part).all(axis=1)
        found.append(np.full(len(part), np.nan))
        found[-1][there] = function(part[there], axis=1)
    return np.concatenate([np.zeros(0), *found])


def mean_speed(episode: Episode) -> float:
    """Mean over all vehicles and all steps of the episode, start-up included [m/s]. The honest convention."""
    return _mean_of_present(episode.speeds[1:])


def mean_speed_step_average(episode: Episode) -> float:
    """Mean over the moments of the mean over the vehicles then on the road [m/s]: Flow's convention.

    Where vehicles come and go it counts a moment with few vehicles as much as one in a jam.
    """
    return _mean_of_present(_per_step(np.nanmean, episode.speeds[1:]))


def mean_speed_steady(episode: Episode) -> float:
    """Mean over all vehicles in the last 1,000 steps [m/s]; of a shorter episode, in its second half."""
    return _mean_of_present(_steady_state(episode.speeds[1:]))


def mean_speed_second_half(episode: Episode) -> float:
    """Mean over all vehicles in the second half of the episode [m/s]."""
    return _mean_of_present(episode.speeds[1 + episode.control_steps // 2 :])


def speed_std_fleet(episode: Episode) -> float:
    """Standard deviation of speed across vehicles at one moment, averaged over the episode [m/s].

    The size of the waves: zero when all drive alike. Stern et al. 2018, section 4.
    """
    return _mean_of_present(_per_step(np.nanstd, episode.speeds[1:]))


def speed_std_fleet_steady(episode: Episode) -> float:
    """Standard deviation of speed across vehicles, averaged over the steady state [m/s]."""
    return _mean_of_present(_per_step(np.nanstd, _steady_state(episode.speeds[1:])))


def speed_std_cav(episode: Episode) -> float:
    """Standard deviation over time of the CAV's own speed [m/s]: the paper's `speed std` (Table 1)."""
    return _mean_over_cavs([np.std(trajectory.states.speed[1:]) for trajectory in episode.trajectories])


def cav_mean_speed(episode: Episode) -> float:
    """Mean over time of the CAV's own speed [m/s]: the paper's `average speed` (Table 1)."""
    return _mean_over_cavs([np.mean(trajectory.states.speed[1:]) for trajectory in episode.trajectories])


def speed_limit_ratio(episode: Episode) -> float:
    """Mean speed over the scenario's own limit; on the ring the IDM equilibrium speed of its length."""
    return mean_speed(episode) / (episode.limit_speed or np.nan)


def speed_limit_ratio_steady(episode: Episode) -> float:
    """Mean speed in the steady state over the scenario's own limit."""
    return mean_speed_steady(episode) / (episode.limit_speed or np.nan)


def episode_return(episode: Episode) -> float:
    """Sum of the reward that the episode was run with, not discounted; all CAVs share it."""
    return float(episode.reward.sum())


def return_eq16(episode: Episode) -> float:
    """Sum of the paper's reward, Eq. 16 with its sign mended, not discounted."""
    crashed = episode.status == "collision"
    terms = episode_reward_terms(eq16_reward, episode.speeds, episode.trajectories, crashed, episode.backlog)
    return float(sum(term.sum() for term in terms.values()))


def mean_abs_accel(episode: Episode) -> float:
    """Mean absolute acceleration that the CAV was told [m/s2]; of a human driver, what it did."""
    return _mean_over_cavs([np.abs(trajectory.applied_acceleration).mean() for trajectory in episode.trajectories])


def mean_abs_jerk(episode: Episode) -> float:
    """Mean absolute change of the CAV's actual acceleration per second [m/s3]."""
    speeds = (trajectory.states.speed for trajectory in episode.trajectories)
    jerks = [np.abs(np.diff(speed, 2)).mean() for speed in speeds if len(speed) > 2]
    return float(np.mean(jerks) / episode.control_step**2) if jerks else float("nan")


def share_standing(episode: Episode) -> float:
    """Share of vehicle-seconds spent below 0.1 m/s."""
    return _mean_of_present(episode.speeds[1:], lambda there: there < STANDING_SPEED)


def time_to_dissolve(episode: Episode) -> float:
    """Time until the wave that an episode starts with is dissolved [s]; NaN if there is none or it stays.

    From the first decision to the first moment from which on the std of speed across vehicles stays below
    0.3 m/s for 60 s on end.
    """
    spread = _per_step(np.nanstd, episode.speeds)
    calm = np.isnan(spread) | (spread < MAX_CALM_SPEED_STD)
    needed = round(MIN_CALM_SECONDS / episode.control_step)
    if calm[0] or len(calm) < needed:
        return float("nan")
    found = np.flatnonzero(np.convolve(calm, np.ones(needed), "valid") > needed - 0.5)
    return float(found[0] * episode.control_step) if len(found) else float("nan")


def collisions(episode: Episode) -> float:
    """Vehicles that collided, on a user's network by its own settings; with a CAV it ends the episode."""
    return float(episode.collisions)


def shield_override_share(episode: Episode) -> float:
    """Share of the CAV's commands that SUMO's safety check did not let pass."""
    return _mean_over_cavs(
        [(trajectory.shield_braking > OVERRIDE_TOLERANCE).mean() for trajectory in episode.trajectories]
    )


def shield_max_braking(episode: Episode) -> float:
    """Hardest braking that the safety check added to a command [m/s2]."""
    return float(max((trajectory.shield_braking.max() for trajectory in episode.trajectories), default=np.nan))


def fuel_ml_per_km(episode: Episode) -> float:
    """Fuel of all vehicles per kilometre [ml/km], by the scenario's emission class; NaN if nobody drove.

    SUMO's emission model, where it was recorded: https://sumo.dlr.de/docs/Models/Emissions.html
    """
    driven = sum(float(np.nansum(part)) for part in _chunks(episode.speeds[1:])) * episode.control_step
    if episode.fuel.size == 0 or driven == 0:
        return float("nan")
    return float(np.nansum(episode.fuel)) * episode.control_step / GASOLINE_DENSITY / (driven / 1000.0)


def outflow_veh_per_h(episode: Episode) -> float:
    """Flow [veh/h]: on a closed road distance driven by all vehicles over length and time (Edie 1963); of a
    road with ends, who left it over the time that it was to be driven; of a peak, in its last ten minutes.
    """
    if episode.demand_peak[1] > 0:
        end = min(round(episode.demand_peak[1] / episode.control_step), episode.control_steps)
        first = round(episode.demand_peak[0] / episode.control_step)
        begin = max(first if first < end else 0, end - round(PEAK_END_SECONDS / episode.control_step))
        there = ~np.isnan(episode.speeds[begin : end + 1])
        left = (there[:-1] & ~there[1:]).sum()
        return float(left * 3600.0 / max(end - begin, 1) / episode.control_step)
    hours, planned = (
        episode.control_steps * episode.control_step / 3600.0,
        np.nan_to_num(episode.planned_duration) / 3600.0,
    )
    if np.isnan(episode.loop_length):
        return episode.arrivals / (hours if episode.status == "collision" else max(hours, planned))
    driven = np.nansum(episode.positions[-1] - episode.positions[0])
    return float(driven / episode.loop_length / hours)


def mean_travel_time(episode: Episode) -> float:
    """Mean time per vehicle that wanted to drive, waiting to enter included [s]; NaN on a closed road.

    The integral over time of who is on the road or waits to be, over how many wanted to enter: nobody gains
    by keeping vehicles out. Who is under way at the end counts with the time so far, at a collision with all.
    On a network of the user's own it is the mean over SUMO's trips: `duration` and `departDelay`.
    """
    if episode.trips.vehicle_ids and episode.status != "collision":
        return float(episode.trips.travel_time.mean())
    if not len(episode.backlog):
        return float("nan")
    under_way = (~np.isnan(episode.speeds)).sum(axis=1) + episode.backlog
    demanded = len(episode.vehicle_ids) + episode.backlog[-1] - episode.teleported
    lost = (
        max(0.0, episode.planned_duration - episode.control_steps * episode.control_step)
        if episode.status == "collision"
        else 0.0
    )
    return float((under_way[1:].sum() * episode.control_step + under_way[-1] * lost) / (demanded or np.nan))


def delay(episode: Episode) -> float:
    """Mean delay of a trip [s]: SUMO's `timeLoss` and `departDelay` on a network of the user's own, elsewhere
    travel time beyond that on a free road; NaN where neither is known.
    """
    trips = episode.trips
    return float(trips.delay.mean()) if trips.vehicle_ids else mean_travel_time(episode) - episode.free_flow_time


def travel_time_metric(group: str) -> Callable[[Episode], float]:
    """Return the metric that is the travel time of one group of vehicles, waiting included [s]."""

    def mean(episode: Episode) -> float:
        return episode.trips.mean_travel_time(group)

    mean.__doc__ = f"Mean travel time of {group} alone on a network of the user's own, waiting included [s]."
    return mean


def insertion_backlog_veh(episode: Episode) -> float:
    """Vehicles that wait to enter at the end; on a closed road nobody does."""
    return float(episode.backlog[-1]) if len(episode.backlog) else 0.0


@dataclass(frozen=True)
class Metric:
    """A metric as tables show it."""

    function: Callable[[Episode], float]
    label: str
    unit: str
    digits: int = 2
    bounds: tuple[float, float] = (0.0, inf)
    """what it can be"""


def _braking_metrics(group: Literal["humans", "cavs"], key_prefix: str, label_prefix: str) -> dict[str, Metric]:
    """Return the metrics of how often somebody brakes hard."""
    return {
        f"{key_prefix}_braking_beyond_{limit:g}".replace(".", "_"): Metric(
            braking_beyond_metric(group, limit), f"{label_prefix} braking beyond {limit:g} m/s2", "per million", 0
        )
        for limit in BRAKING_THRESHOLDS
    }


METRICS: dict[str, Metric] = {
    "mean_speed": Metric(mean_speed, "mean speed", "m/s"),
    "mean_speed_step_average": Metric(mean_speed_step_average, "mean speed, average over steps", "m/s"),
    "mean_speed_steady": Metric(mean_speed_steady, "mean speed, steady", "m/s"),
    "mean_speed_second_half": Metric(mean_speed_second_half, "mean speed, second half", "m/s"),
    "speed_limit_ratio": Metric(speed_limit_ratio, "mean speed / limit", "", 3),
    "speed_limit_ratio_steady": Metric(speed_limit_ratio_steady, "mean speed / limit, steady", "", 3),
    "speed_std_fleet": Metric(speed_std_fleet, "speed std across vehicles", "m/s"),
    "speed_std_fleet_steady": Metric(speed_std_fleet_steady, "speed std across vehicles, steady", "m/s"),
    "share_standing": Metric(share_standing, "share of time stopped", "", 3, SHARE_BOUNDS),
    "time_to_dissolve": Metric(time_to_dissolve, "time to dissolve the wave", "s", 0),
    "cav_mean_speed": Metric(cav_mean_speed, "CAV's mean speed", "m/s"),
    "speed_std_cav": Metric(speed_std_cav, "CAV's speed std over time", "m/s"),
    "return": Metric(episode_return, "return", "", 0, UNBOUNDED),
    "return_eq16": Metric(return_eq16, "return, Eq. 16", "", 0, UNBOUNDED),
    "mean_abs_accel": Metric(mean_abs_accel, "CAV's mean |acceleration|", "m/s2", 3),
    "mean_abs_jerk": Metric(mean_abs_jerk, "CAV's mean |jerk|", "m/s3", 3),
    "min_ttc": Metric(min_ttc, "minimum time to collision", "s"),
    "min_time_gap": Metric(min_time_gap, "minimum time gap", "s"),
    "cav_min_ttc": Metric(cav_min_ttc, "CAV's minimum time to collision", "s"),
    "share_short_time_gap": Metric(share_short_time_gap, "CAV's share of time with a time gap below 1 s", "", 4, SHARE_BOUNDS),
    "max_drac": Metric(max_drac, "CAV's maximum DRAC", "m/s2"),
    "max_jerk": Metric(max_jerk, "CAV's maximum jerk", "m/s3", 1),
    "cav_max_braking": Metric(cav_max_braking, "CAV's maximum braking", "m/s2"),
    "cut_in_max_braking": Metric(cut_in_max_braking, "CAV's maximum braking after a cut-in", "m/s2"),
    **_braking_metrics("cavs", "cav", "CAV"),
    "human_max_braking": Metric(human_max_braking, "human drivers' maximum braking", "m/s2"),
    **_braking_metrics("humans", "human", "human"),
    "filter_override_share": Metric(filter_override_share, "control steps in which the safety filter braked", "", 4, SHARE_BOUNDS),
    "override_share": Metric(override_share, "commands overridden by SUMO in car following", "", 4, SHARE_BOUNDS),
    "yield_share": Metric(yield_share, "commands overridden by SUMO at a crossing", "", 4, SHARE_BOUNDS),
    "collisions": Metric(collisions, "vehicles in collisions", "", 0),
    "shield_override_share": Metric(shield_override_share, "commands overridden by SUMO", "", 4, SHARE_BOUNDS),
    "shield_max_braking": Metric(shield_max_braking, "maximum braking added by SUMO", "m/s2"),
    "fuel_ml_per_km": Metric(fuel_ml_per_km, "fuel", "ml/km", 1),
    "outflow_veh_per_h": Metric(outflow_veh_per_h, "flow", "veh/h", 0),
    "travel_time": Metric(mean_travel_time, "travel time, departure delay included", "s", 1),
    **{
        f"travel_time_{group}": Metric(travel_time_metric(group), f"travel time of {group}", "s", 1)
        for group in VEHICLE_GROUPS
    },
    "delay": Metric(delay, "delay, departure delay included", "s", 1, UNBOUNDED),
    "insertion_backlog_veh": Metric(insertion_backlog_veh, "insertion backlog", "", 0),
}


def measure(episode: Episode) -> dict[str, Any]:
    """Return the row of an episode: seed, status, steps, what was drawn, every metric by name, the verdict.

    The metrics of a failed episode are NaN, and its row has the reason.
    """
    row = {
        "seed": episode.seed[0] if len(episode.seed) == 1 else list(episode.seed),
        **{name: getattr(episode, name) for name in ("status", "reason", "error", "teleports", "contacts")},
        "steps": episode.control_steps,
        "warnings": [asdict(each) for each in episode.warnings],
        "vehicles": len(episode.vehicle_ids),
        **episode.drawn_values,
        "required_time_gap": episode.audit.required_time_gap,
        "has_lanes": episode.audit.has_lanes,
        **{name: metric.function(episode) if episode.has_run else np.nan for name, metric in METRICS.items()},
    }
    return {**row, "feasibility": feasibility(row)}
