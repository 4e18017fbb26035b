"""Metrics of an episode, with units and sources."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from math import inf, isfinite, nan
from typing import Any, Literal

import numpy as np

from unjam.measures import platoon_metrics as platoon
from unjam.measures.averages import mean_over_cavs, mean_over_vehicle_steps, reduce_steps, row_chunks
from unjam.measures.feasibility import feasibility
from unjam.scenarios.scenario import sumo_seed
from unjam.worlds.audit import BRAKING_THRESHOLDS, OVERRIDE_TOLERANCE, BrakingStatistics
from unjam.worlds.record import VEHICLE_GROUPS, Episode, Floats
from unjam.worlds.reward import episode_reward_terms, eq16_reward

STEADY_STATE_STEPS = 1000
"""number of control steps at the end of an episode that count as steady state; in a shorter episode, the second half"""
STANDING_SPEED = 0.1  # speed below which a vehicle counts as standing [m/s]: SUMO's threshold of a halting vehicle
MAX_CALM_SPEED_STD = 0.3  # standard deviation of speed across vehicles below which there is no wave [m/s]
MIN_CALM_SECONDS = 60.0  # time without a wave after which the wave counts as dissolved [s]
GASOLINE_DENSITY = 742.0  # density of gasoline in SUMO's PollutantsInterface [mg/ml]
SHARE_BOUNDS, UNBOUNDED = (0.0, 1.0), (-inf, inf)  # bounds of shares, and of metrics that can be negative
PEAK_END_SECONDS = 600.0
"""duration at the end of the demand peak in which flow is counted [s]; this flow is the capacity, not the demand"""

EpisodeFunction = Callable[[Episode], float]


def _steady_state(values: Floats) -> Floats:
    return values[-STEADY_STATE_STEPS:] if len(values) > STEADY_STATE_STEPS else values[len(values) // 2 :]


def mean_speed(episode: Episode) -> float:
    """Mean speed over all vehicles and all steps of the episode, start-up included [m/s]."""
    return mean_over_vehicle_steps(episode.speeds[1:])


def mean_speed_step_average(episode: Episode) -> float:
    """Mean over the steps of the mean speed of the vehicles on the road [m/s]: Flow's convention.

    On an open road, a step with few vehicles counts as much as a step in a jam.
    """
    return mean_over_vehicle_steps(reduce_steps(np.nanmean, episode.speeds[1:]))


def mean_speed_steady(episode: Episode) -> float:
    """Mean speed over all vehicles in the last 1,000 steps [m/s]; of a shorter episode, in its second half."""
    return mean_over_vehicle_steps(_steady_state(episode.speeds[1:]))


def mean_speed_second_half(episode: Episode) -> float:
    """Mean speed over all vehicles in the second half of the episode [m/s]."""
    return mean_over_vehicle_steps(episode.speeds[1 + episode.control_steps // 2 :])


def speed_std_fleet(episode: Episode) -> float:
    """Standard deviation of speed across vehicles in a step, averaged over the episode [m/s].

    It measures the size of waves, and is zero if all vehicles have the same speed. Stern et al. 2018, section 4.
    """
    return mean_over_vehicle_steps(reduce_steps(np.nanstd, episode.speeds[1:]))


def speed_std_fleet_steady(episode: Episode) -> float:
    """Standard deviation of speed across vehicles, averaged over the steady state [m/s]."""
    return mean_over_vehicle_steps(reduce_steps(np.nanstd, _steady_state(episode.speeds[1:])))


def speed_std_cav(episode: Episode) -> float:
    """Standard deviation over time of the CAV's own speed [m/s]: the paper's `speed std` (Table 1)."""
    return mean_over_cavs(episode, lambda trajectory: np.std(trajectory.states.speed[1:]))


def cav_mean_speed(episode: Episode) -> float:
    """Mean over time of the CAV's own speed [m/s]: the paper's `average speed` (Table 1)."""
    return mean_over_cavs(episode, lambda trajectory: np.mean(trajectory.states.speed[1:]))


def speed_limit_ratio(episode: Episode) -> float:
    """Mean speed divided by the limit speed of the road, which is the IDM's equilibrium speed on a ring."""
    return mean_speed(episode) / (episode.limit_speed or np.nan)


def speed_limit_ratio_steady(episode: Episode) -> float:
    """Mean speed in the steady state divided by the limit speed of the road."""
    return mean_speed_steady(episode) / (episode.limit_speed or np.nan)


def episode_return(episode: Episode) -> float:
    """Sum of the rewards of the episode, not discounted; all CAVs have the same reward."""
    return float(episode.reward.sum())


def return_eq16(episode: Episode) -> float:
    """Sum of the paper's reward, Eq. 16 with its sign corrected, not discounted."""
    crashed = episode.status == "collision"
    terms = episode_reward_terms(eq16_reward, episode.speeds, episode.trajectories, crashed, episode.backlog)
    return float(sum(term.sum() for term in terms.values()))


def mean_abs_accel(episode: Episode) -> float:
    """Mean absolute commanded acceleration of the CAV [m/s2]; of a human driver, the actual acceleration."""
    return mean_over_cavs(episode, lambda trajectory: np.abs(trajectory.applied_acceleration).mean())


def mean_abs_jerk(episode: Episode) -> float:
    """Mean absolute change of the CAV's actual acceleration per second [m/s3]."""
    speeds = (trajectory.states.speed for trajectory in episode.trajectories)
    jerks = [np.abs(np.diff(speed, 2)).mean() for speed in speeds if len(speed) > 2]
    return float(np.mean(jerks) / episode.control_step**2) if jerks else nan


def min_ttc(episode: Episode) -> float:
    """Minimum time to collision of the CAV and of its follower, gap divided by closing speed [s].

    Infinite if neither was ever faster than its leader. Hayward 1972.
    """
    smallest = inf
    for trajectory in episode.trajectories:
        speed, leader_speed, leader_gap, follower_speed, follower_gap, *_ = trajectory.states
        for gap, closing_speed in ((leader_gap, speed - leader_speed), (follower_gap, follower_speed - speed)):
            is_closing = closing_speed > 0
            smallest = min(smallest, float((gap[is_closing] / closing_speed[is_closing]).min(initial=inf)))
    return smallest


def share_standing(episode: Episode) -> float:
    """Share of vehicle-seconds spent below 0.1 m/s."""
    return mean_over_vehicle_steps(episode.speeds[1:], lambda speeds: speeds < STANDING_SPEED)


def time_to_dissolve(episode: Episode) -> float:
    """Time until the wave at the start of the episode is dissolved [s]; NaN without a wave, or if the wave stays.

    The wave is dissolved when the standard deviation of speed across vehicles stays below 0.3 m/s for 60 s.
    """
    speed_std = reduce_steps(np.nanstd, episode.speeds)
    is_calm = np.isnan(speed_std) | (speed_std < MAX_CALM_SPEED_STD)
    steps = round(MIN_CALM_SECONDS / episode.control_step)
    if is_calm[0] or len(is_calm) < steps:
        return nan
    dissolved_steps = np.flatnonzero(np.convolve(is_calm, np.ones(steps), "valid") > steps - 0.5)
    return float(dissolved_steps[0] * episode.control_step) if len(dissolved_steps) else nan


def collisions(episode: Episode) -> float:
    """Number of vehicles that collided; on a user's network its settings define collisions.

    A collision of a CAV ends an episode on built-in roads, and in training also on a user's network.
    """
    return float(episode.collisions)


def filter_override_share(episode: Episode) -> float:
    """Share of the CAV's control steps in which the safety filter braked harder than its driver."""
    return mean_over_cavs(episode, lambda trajectory: (trajectory.filter_braking > 0).mean())


def shield_override_share(episode: Episode) -> float:
    """Share of the CAV's commands that SUMO's safety check changed."""
    return mean_over_cavs(episode, lambda trajectory: (trajectory.shield_braking > OVERRIDE_TOLERANCE).mean())


def shield_max_braking(episode: Episode) -> float:
    """Maximum braking that SUMO's safety check added to a command [m/s2]."""
    return float(max((trajectory.shield_braking.max() for trajectory in episode.trajectories), default=np.nan))


def fuel_ml_per_km(episode: Episode) -> float:
    """Fuel of all vehicles per kilometer by the scenario's emission class [ml/km]; NaN if no vehicle moves.

    Fuel is that of SUMO's emission model, where it was recorded: https://sumo.dlr.de/docs/Models/Emissions.html. HBEFA4
    burns 2.2 l/h at standstill: on closed roads fuel mostly depends on time, so that less fuel is no evidence of
    smoother driving. On a user's network fuel is measured once per second, with the density of gasoline for diesel.
    """
    if episode.fuel.size == 0:
        return nan
    distance = sum(float(np.nansum(chunk)) for chunk in row_chunks(episode.speeds[1:]))  # [m/s], over all steps
    return float(np.nansum(episode.fuel)) / GASOLINE_DENSITY / (distance / 1000.0) if distance else nan


def outflow_veh_per_h(episode: Episode) -> float:
    """Flow [veh/h]. On a closed road: distance of all vehicles over length and time (Edie 1963). On an open
    road: number of vehicles that left the road over the time of all planned control steps, or over the last ten
    minutes of a demand peak. Behind a recorded vehicle: distance of the platoon over its length and time.
    """
    step, steps = episode.control_step, episode.control_steps
    if episode.demand_peak[1] > 0:
        end, peak_start = min(round(episode.demand_peak[1] / step), steps), round(episode.demand_peak[0] / step)
        begin = max(peak_start if peak_start < end else 0, end - round(PEAK_END_SECONDS / step))
        present = ~np.isnan(episode.speeds[begin : end + 1])
        exit_count = (present[:-1] & ~present[1:]).sum()
        return float(exit_count * 3600.0 / max(end - begin, 1) / step)
    hours, planned = steps * step / 3600.0, np.nan_to_num(episode.planned_duration) / 3600.0
    if episode.has_recorded_leader:
        length = episode.replayed_motion[1:, 0, 0] - episode.positions[1:, 0]
        return float(episode.speeds[1:].sum() * 3600.0 / length.sum())
    if np.isnan(episode.loop_length):
        return episode.arrivals / (hours if episode.status == "collision" else max(hours, planned))
    distance = np.nansum(episode.positions[-1] - episode.positions[0])
    return float(distance / episode.loop_length / hours)


def mean_travel_time(episode: Episode) -> float:
    """Mean time of the vehicles of the demand, departure delay included [s]; NaN on a closed road.

    It is the total time of vehicles on the road and in the insertion backlog, divided by the number of vehicles of the
    demand, so that keeping vehicles out is no gain. Vehicles under way at the end count with their time so far; after a
    collision the remaining planned time is added. On a user's network: mean `duration` plus `departDelay` of SUMO.
    """
    has_crashed = episode.status == "collision"
    if episode.trips.vehicle_ids and not has_crashed:
        return float(episode.trips.travel_time.mean())
    if not len(episode.backlog):
        return nan
    under_way = (~np.isnan(episode.speeds)).sum(axis=1) + episode.backlog
    demand = len(episode.vehicle_ids) + episode.backlog[-1] - episode.teleported - episode.removed
    remaining = episode.planned_duration - episode.control_steps * episode.control_step
    lost_time = max(0.0, remaining) if has_crashed else 0.0
    return float((under_way[1:].sum() * episode.control_step + under_way[-1] * lost_time) / (demand or np.nan))


def delay(episode: Episode) -> float:
    """Mean delay of a trip [s]: SUMO's `timeLoss` plus `departDelay` on a user's network, travel time minus that in
    free flow on other roads; NaN if unknown.
    """
    trips = episode.trips
    return float(trips.delay.mean()) if trips.vehicle_ids else mean_travel_time(episode) - episode.free_flow_time


def min_time_gap(episode: Episode) -> float:
    """Minimum time gap of the CAV, net gap over own speed, while it drives faster than 1 m/s [s]; NaN if never.

    The audit, also of the other metrics of safety, covers all simulation steps; on the merge, all control steps.
    """
    return _nan_if_infinite(episode.audit.following.min_time_gap)


def _nan_if_infinite(value: float) -> float:
    return value if isfinite(value) else nan


def cav_min_ttc(episode: Episode) -> float:
    """Minimum time to collision of the CAV with its leader [s]; NaN if the CAV was never faster."""
    return _nan_if_infinite(episode.audit.following.min_time_to_collision)


def share_short_time_gap(episode: Episode) -> float:
    """Share of the time in which the CAV drives faster than 1 m/s with a time gap below one second."""
    return episode.audit.following.share_short_time_gap if episode.cav_ids else nan


def max_drac(episode: Episode) -> float:
    """Maximum deceleration rate to avoid a crash of the CAV, closing speed squared over twice the gap [m/s2].

    Almqvist, Hyden and Risser 1991.
    """
    return episode.audit.following.max_required_braking if episode.cav_ids else nan


def max_jerk(episode: Episode) -> float:
    """Maximum change of the CAV's acceleration over time [m/s3]."""
    return episode.audit.following.max_jerk


def cav_max_braking(episode: Episode) -> float:
    """Maximum braking of a CAV [m/s2]; NaN without CAVs."""
    return _max_braking(episode.audit.cav_braking)


def cut_in_max_braking(episode: Episode) -> float:
    """Maximum braking of a CAV in the 3 s after another vehicle cut in [m/s2], on roads with lanes.

    Other metrics of the braking of CAVs exclude these 3 s. NaN without cut-ins.
    """
    return _max_braking(episode.audit.cut_in_braking)


def _max_braking(statistics: BrakingStatistics) -> float:
    return statistics.max_braking if statistics.samples else nan


def human_max_braking(episode: Episode) -> float:
    """Maximum braking of human drivers [m/s2]."""
    return episode.audit.human_braking.max_braking


def override_share(episode: Episode) -> float:
    """Share of commands that SUMO's safety check changed, right of way excluded."""
    return episode.audit.following.override_share


def yield_share(episode: Episode) -> float:
    """Share of commands that SUMO changed near a crossing, where vehicles must yield."""
    return episode.audit.following.yield_share


def insertion_backlog_veh(episode: Episode) -> float:
    """Number of vehicles in the insertion backlog at the end; zero on a closed road."""
    return float(episode.backlog[-1] - episode.removed) if len(episode.backlog) else 0.0


def travel_time_metric(group: str) -> EpisodeFunction:
    """Return the metric function of the travel time of one group of vehicles, departure delay included [s]."""

    def mean(episode: Episode) -> float:
        return episode.trips.mean_travel_time(group)

    mean.__doc__ = f"Mean travel time of {group} on a user's network, departure delay included [s]."
    return mean


@dataclass(frozen=True)
class Metric:
    """A metric, and its label, unit and format in tables."""

    function: EpisodeFunction  # computes the metric; its docstring is the description in tables
    label: str
    unit: str
    digits: int = 2  # number of decimal places
    bounds: tuple[float, float] = (0.0, inf)  # smallest and largest possible value


def _braking_metrics(group: Literal["CAV", "human"]) -> dict[str, Metric]:
    """Return the metrics of how often a group of vehicles brakes harder than each of `BRAKING_THRESHOLDS`."""

    def exceedance(index: int, limit: float) -> EpisodeFunction:
        def rate(episode: Episode) -> float:
            cavs, humans = episode.audit.cav_braking, episode.audit.human_braking
            braking, samples = (cavs, cavs.samples) if group == "CAV" else (humans, cavs.samples + humans.samples)
            return 1e6 * braking.exceedances[index] / samples if braking.samples else nan

        driver, vehicles = ("CAV", "CAVs") if group == "CAV" else ("human driver", "all vehicles")
        rate.__doc__ = (
            f"Rate of vehicle-steps (simulation) with braking of a {driver} beyond {limit:g} m/s2, of all steps of "
            f"{vehicles} [per million]. "
            "ISO 15622 allows 3.5 above 20 m/s; dry asphalt hardly allows 9."
        )
        return rate

    return {
        f"{group.lower()}_braking_beyond_{limit:g}".replace(".", "_"): Metric(
            exceedance(index, limit), f"{group} braking beyond {limit:g} m/s2", "per million", 0
        )
        for index, limit in enumerate(BRAKING_THRESHOLDS)
    }


_share = partial(Metric, unit="", digits=4, bounds=SHARE_BOUNDS)

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
    "share_short_time_gap": _share(share_short_time_gap, "CAV's share of time with a time gap below 1 s"),
    "max_drac": Metric(max_drac, "CAV's maximum DRAC", "m/s2"),
    "max_jerk": Metric(max_jerk, "CAV's maximum jerk", "m/s3", 1),
    "cav_max_braking": Metric(cav_max_braking, "CAV's maximum braking", "m/s2"),
    "cut_in_max_braking": Metric(cut_in_max_braking, "CAV's maximum braking after a cut-in", "m/s2"),
    **_braking_metrics("CAV"),
    "human_max_braking": Metric(human_max_braking, "human drivers' maximum braking", "m/s2"),
    **_braking_metrics("human"),
    "filter_override_share": _share(filter_override_share, "control steps in which the safety filter braked"),
    "override_share": _share(override_share, "commands overridden by the simulator in car following"),
    "yield_share": _share(yield_share, "commands overridden by the simulator at a crossing"),
    "collisions": Metric(collisions, "vehicles in collisions", "", 0),
    "shield_override_share": _share(shield_override_share, "commands overridden by the simulator"),
    "shield_max_braking": Metric(shield_max_braking, "maximum braking added by SUMO", "m/s2"),
    "fuel_ml_per_km": Metric(fuel_ml_per_km, "fuel by emission model", "ml/km", 1),
    "fuel_by_power": Metric(platoon.fuel_by_power, "fuel by power", "ml/km", 1),
    "cav_fuel_by_power": Metric(platoon.cav_fuel_by_power, "CAV's fuel by power", "ml/km", 1),
    "human_fuel_by_power": Metric(platoon.human_fuel_by_power, "human drivers' fuel by power", "ml/km", 1),
    "cav_mean_gap": Metric(platoon.cav_mean_gap, "CAV's mean gap", "m", 1),
    "cav_gap_95": Metric(platoon.cav_gap_95, "CAV's gap, 95 %", "m", 1),
    "cav_max_gap": Metric(platoon.cav_max_gap, "CAV's largest gap", "m", 1),
    "time_behind_leader": Metric(platoon.time_behind_leader, "time behind the recorded vehicle", "s", 1),
    "amplification": Metric(platoon.amplification, "amplification of speed std", "", 2),
    "amplification_long": Metric(platoon.period_amplification(inf, 60.0), "amplification, above 60 s", "", 2),
    "amplification_medium": Metric(platoon.period_amplification(60.0, 20.0), "amplification, 20 to 60 s", "", 2),
    "amplification_short": Metric(platoon.period_amplification(20.0, 4.0), "amplification, 4 to 20 s", "", 2),
    "outflow_veh_per_h": Metric(outflow_veh_per_h, "flow", "veh/h", 0),
    "travel_time": Metric(mean_travel_time, "travel time, departure delay included", "s", 1),
    **{
        f"travel_time_{group}": Metric(travel_time_metric(group), f"travel time of {group}", "s", 1)
        for group in VEHICLE_GROUPS
    },
    "delay": Metric(delay, "delay, departure delay included", "s", 1, UNBOUNDED),
    "insertion_backlog_veh": Metric(insertion_backlog_veh, "insertion backlog", "", 0),
}

RECORDED_ROAD_METRICS = (
    *("fuel_by_power", "cav_fuel_by_power", "human_fuel_by_power", "cav_mean_gap", "cav_gap_95", "cav_max_gap"),
    *("min_time_gap", "time_behind_leader", "outflow_veh_per_h"),
    *("amplification", "amplification_long", "amplification_medium", "amplification_short"),
)
"""metrics that environments report for an episode behind a recorded vehicle"""


def measure(episode: Episode) -> dict[str, Any]:
    """Return the row of an episode: seeds, status, steps, drawn values, all metrics, and the verdict on feasibility.

    The metrics of a failed episode are NaN, and its row contains the reason.
    """
    row = {
        "seed": episode.seed[0] if len(episode.seed) == 1 else list(episode.seed),
        "sumo_seed": sumo_seed(episode.seed),
        **{name: getattr(episode, name) for name in ("status", "reason", "error", "teleports", "contacts")},
        "steps": episode.control_steps,
        "warnings": [asdict(warning) for warning in episode.warnings],
        **({"slow_entrances": [*map(asdict, episode.slow_entrances)]} if episode.slow_entrances else {}),
        "vehicles": len(episode.vehicle_ids),
        **episode.trips.values_at_end,
        **episode.drawn_values,
        "required_time_gap": episode.audit.required_time_gap,
        "has_lanes": episode.audit.has_lanes,
        **{name: metric.function(episode) if episode.has_run else np.nan for name, metric in METRICS.items()},
    }
    return {**row, "feasibility": feasibility(row)}
