"""The record of an episode: trajectories of CAVs, speeds and positions of all vehicles, and counts of events."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from heapq import heappop, heappush
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.local_state import LocalState
from unjam.physics.arrays import Floats
from unjam.scenarios.road import Road
from unjam.scenarios.scenario import Scenario
from unjam.worlds.audit import Audit
from unjam.worlds.world import DriverLog

SHARED_COLUMN_FRAMES = 200
"""number of frames of an episode in a video; vehicles that share a column are at least one frame apart"""
VEHICLE_GROUPS = {
    "cars": ("passenger", "private", "hov", "taxi", "evehicle", "custom1", "custom2"),
    "trucks": ("truck", "trailer", "delivery"),
    "buses": ("bus", "coach"),
}
"""SUMO's vehicle classes by group; travel times are reported for each group"""


@dataclass(frozen=True)
class Trajectory:
    """One trip of one CAV: T control steps. Arrays have shape (T,) unless stated otherwise."""

    vehicle: str
    start_step: int
    states: LocalState
    """states that the CAV observed, and its state at the end, shape (T + 1,)"""
    observations: Floats
    """network observation at each action and at the end, shape (actions + 1, inputs); (1, 0) without a network"""
    expert_acceleration: Floats
    """the expert's acceleration within the action limit [m/s2]"""
    residual: Floats
    """the network's residual with its exploration noise, not clipped [m/s2]; zero without a network"""
    applied_acceleration: Floats
    """the commanded acceleration, or harder braking by the safety filter; mean over the control step [m/s2]"""
    filter_braking: Floats
    """largest reduction of the driver's acceleration by the safety filter [m/s2]; zero if it did not intervene"""
    shield_braking: Floats
    """braking that SUMO's safety check added to the command [m/s2]; zero if it did not intervene"""
    initial_memory: dict[str, Any]
    """the expert's memory before the first control step, without the axis of rows; empty without a network"""
    action_repeat: int
    terminated: bool
    """whether a collision ended the trip; otherwise the horizon or the end of the road did"""
    reward_terms: dict[str, Floats] = field(default_factory=dict)

    @property
    def step_slice(self) -> slice:
        """The control steps of the trip in the episode."""
        return slice(self.start_step, self.start_step + len(self.applied_acceleration))

    @cached_property
    def reward(self) -> Floats:
        """The reward of each control step: the sum of the terms."""
        return np.sum(list(self.reward_terms.values()), axis=0)

    @property
    def actions_and_rewards(self) -> tuple[Floats, Floats]:
        """The network's residual in each action, and the sum of rewards during the action; shape (actions,)."""
        starts = np.arange(0, len(self.residual), self.action_repeat)
        return self.residual[starts], np.add.reduceat(self.reward, starts)


def make_trajectory(
    vehicle: str,
    entry_number: int,
    start_step: int,
    rows: NDArray[np.intp] | None,
    states: LocalState,
    applied_acceleration: Floats,
    filter_braking: Floats,
    shield_braking: Floats,
    terminated: bool,
    driver_log: DriverLog,
) -> Trajectory:
    """Return the trajectory of a trip with the driver's decisions; arguments are as in `Trajectory`, or as follows.

    `entry_number` is the number of CAVs that entered earlier. `rows` has the row of the CAV in each step, shape
    (T + 1,); None if decisions are floats.
    """
    trip, commands = (vehicle, start_step, states), (applied_acceleration, filter_braking, shield_braking)
    if not driver_log.decisions:
        expert, residual = applied_acceleration, np.zeros_like(applied_acceleration)
        return Trajectory(*trip, np.zeros((1, 0)), expert, residual, *commands, {}, 1, terminated)

    def select(values: Sequence[Any], steps: Sequence[int]) -> Floats:
        return np.array([values[step] if rows is None else values[step][rows[step - start_step]] for step in steps])

    experts, residuals, observations = zip(*driver_log.decisions, strict=True)
    observations = [*observations, driver_log.last_observation]
    steps = range(start_step, start_step + len(applied_acceleration))
    actions = [*steps[:: driver_log.action_repeat], steps.stop]
    if np.size(observations[steps.stop]) == 0:  # a collision between two actions; other CAVs drove on
        actions[-1] = actions[-2]
    observed = select(observations, actions).astype(np.float64).reshape(len(actions), -1)
    decisions, memory = (select(experts, steps), select(residuals, steps)), driver_log.initial_memories[entry_number]
    return Trajectory(*trip, observed, *decisions, *commands, memory, driver_log.action_repeat, terminated)


@dataclass(frozen=True)
class Trips:
    """The trips of all n vehicles with a departure in an episode, until its end; arrays have shape (n,).

    Source: https://sumo.dlr.de/docs/Simulation/Output/TripInfo.html
    """

    vehicle_ids: tuple[str, ...] = ()
    vehicle_classes: tuple[str, ...] = ()
    depart_delay: Floats = field(default_factory=lambda: np.zeros(0))
    """time that each vehicle waited for its insertion, `departDelay` [s]"""
    duration: Floats = field(default_factory=lambda: np.zeros(0))
    """time on the road [s]; 0 if the vehicle was not inserted"""
    time_loss: Floats = field(default_factory=lambda: np.zeros(0))
    """time lost by driving below the desired speed, `timeLoss` [s]"""
    has_arrived: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    entrances: tuple[str, ...] = ()
    """edge on which each vehicle was inserted; empty if it was not inserted"""
    depart_speed: Floats = field(default_factory=lambda: np.zeros(0))
    """speed of each vehicle at its insertion [m/s]"""

    @property
    def delay(self) -> Floats:
        """Delay of each trip: `timeLoss` plus `departDelay` [s]."""
        return self.time_loss + self.depart_delay

    @property
    def travel_time(self) -> Floats:
        """Travel time of each trip, including the time that the vehicle waited for its insertion [s]."""
        return self.duration + self.depart_delay

    @property
    def values_at_end(self) -> dict[str, float]:
        """Number of unfinished trips, and share of delay in their travel time; empty without trips."""
        if not self.vehicle_ids:
            return {}
        is_unfinished = ~self.has_arrived
        delay, travel_time = (float(times[is_unfinished].sum()) for times in (self.delay, self.travel_time))
        share = delay / travel_time if travel_time else 0.0
        return {"unfinished_trips": int(is_unfinished.sum()), "delay_share_at_end": share}

    def vehicles_of(self, *groups: str) -> set[str]:
        """Return the ids of the vehicles of some `VEHICLE_GROUPS`."""
        classes = {vehicle_class for group in groups for vehicle_class in VEHICLE_GROUPS[group]}
        pairs = zip(self.vehicle_ids, self.vehicle_classes, strict=True)
        return {vehicle_id for vehicle_id, vehicle_class in pairs if vehicle_class in classes}

    def mean_travel_time(self, group: str) -> float:
        """Return the mean travel time of a group of `VEHICLE_GROUPS` [s]; NaN if it has no vehicles."""
        is_in_group = np.isin(self.vehicle_classes, VEHICLE_GROUPS[group])
        return float(self.travel_time[is_in_group].mean()) if is_in_group.any() else float("nan")


@dataclass(frozen=True)
class SlowEntrance:
    """An edge where vehicles wait for their insertion, although traffic is free or their insertion speed is fixed."""

    edge: str
    vehicles: int
    depart_delay: float
    """mean waiting time [s]"""
    depart_speed: float
    """mean insertion speed [m/s]"""


@dataclass(frozen=True)
class SumoWarning:
    """All of SUMO's warnings of one kind in an episode."""

    kind: str
    """the message with placeholders for names and numbers"""
    example: str
    count: int


@dataclass(frozen=True)
class Episode:
    """The record of one episode with T control steps and N vehicles or columns, without the warm-up."""

    seed: tuple[int, ...]
    status: str
    """`completed`, `failed`, or the cause of an early end: `collision`, or `teleports` (max-num-teleports of SUMO)"""
    reason: str = ""
    error: str = ""
    control_step: float = 0.1
    """duration of a control step [s]"""
    warmup: int = 0
    drawn_values: dict[str, float] = field(default_factory=dict)
    loop_length: float = float("nan")
    """length of a closed road [m]; NaN on a road with ends"""
    crossings: tuple[tuple[float, float], ...] = ()
    """ranges along the road where it crosses itself [m]"""
    merge_positions: tuple[float, ...] = ()
    """positions along the road where ramps join [m]"""
    limit_speed: float = float("nan")
    """speed limit of the scenario [m/s]"""
    vehicle_ids: tuple[str, ...] = ()
    cav_ids: tuple[str, ...] = ()
    vehicle_columns: tuple[int, ...] = ()
    """column of each vehicle if vehicles share columns, CAVs only with CAVs; empty if each has its own column"""
    snapshot_stride: int = 1
    """number of control steps between two snapshots of positions; above 1 in long episodes with many vehicles"""
    collisions: int = 0
    """vehicles that collided: on a built-in road by contact, on a user's network according to its settings"""
    contacts: int = 0
    """CAVs in contact with another vehicle on a user's network; on other roads contact ends the episode"""
    speeds: Floats = field(default_factory=lambda: np.zeros((1, 0)))
    """speeds [m/s], shape (T + 1, N); NaN if a vehicle is not on the road"""
    positions: Floats = field(default_factory=lambda: np.zeros((1, 0)))
    """front bumpers along the route, not wrapped [m], shape (T // snapshot_stride + 1, N)"""
    gaps: Floats = field(default_factory=lambda: np.zeros((1, 0)))
    """net gap to the leader [m], shape (T // snapshot_stride + 1, N)"""
    replayed_motion: Floats = field(default_factory=lambda: np.zeros((1, 0, 2)))
    """positions [m] and speeds [m/s] of k vehicles that replay recordings, shape (T + 1, k, 2); they lead the vehicles
    of `vehicle_ids`, which do not contain them"""
    fuel: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """fuel rate in each step [mg/s], shape (T, N); on a road with ends the total, (T,); (0, 0) if not recorded"""
    outline: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """center line of a closed road: rows (coordinate along the route, x, y) [m]"""
    branches: tuple[str, ...] = ()
    """origin of the vehicles of each column, on a road with several entrances"""
    arrivals: int = 0
    teleports: int = 0
    """number of teleports by SUMO after long standing or a collision; SUMO reinserts a teleported vehicle later"""
    demand_peak: tuple[float, float] = (0.0, 0.0)
    """start and end of the period of highest demand [s]; (0, 0) without a peak"""
    planned_duration: float = float("nan")
    """duration of an episode without collisions on a road with ends [s]; NaN on a closed road"""
    free_flow_time: float = float("nan")
    """mean travel time in free flow [s]; NaN if unknown"""
    backlog: Floats = field(default_factory=lambda: np.zeros(0))
    """insertion backlog, including teleported and removed vehicles, shape (T + 1,); (0,) on a closed road"""
    teleported: int = 0
    """number of vehicles in the backlog at the end that were teleported and not reinserted"""
    removed: int = 0
    """number of vehicles in the backlog at the end that SUMO removed after a jam or a collision"""
    lane_lines: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    """lanes of a road with ends: rows (x, y) [m], separated by rows of NaN; (0, 2) if not recorded"""
    poses: Floats = field(default_factory=lambda: np.zeros((0, 0, 3)))
    """(x, y, heading) of front bumpers on a road with ends [m, rad], shape (T // snapshot_stride + 1 or 0, N, 3)"""
    lane_indices: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """index in `lane_names` or NaN of each vehicle, shape (T // snapshot_stride + 1, N); (0, 0) if not recorded"""
    lane_names: tuple[str, ...] = ()
    """names of the lanes from left to right in driving direction; empty on roads without lanes"""
    reward_terms: dict[str, Floats] = field(default_factory=dict)
    """terms of the reward by name, shape (T,)"""
    trajectories: tuple[Trajectory, ...] = ()
    trips: Trips = field(default_factory=Trips)
    """trips of all vehicles on a user's network; empty on other roads"""
    slow_entrances: tuple[SlowEntrance, ...] = ()
    """entrances of a user's network where vehicles wait without a jam"""
    audit: Audit = field(default_factory=Audit)
    warnings: tuple[SumoWarning, ...] = ()
    """SUMO's warnings, also in the warm-up, except teleports, collisions and braking, which have their own counts"""

    @property
    def reward(self) -> Floats:
        """The reward of each control step, shape (T,): the sum of the terms."""
        return np.sum(list(self.reward_terms.values()), axis=0)

    @property
    def control_steps(self) -> int:
        """Number of control steps: the environment steps of the episode."""
        return len(self.speeds) - 1

    @property
    def cav_columns(self) -> list[int]:
        """Columns of the CAVs, in order of entry."""
        columns = self.vehicle_columns or range(len(self.vehicle_ids))
        column = dict(zip(self.vehicle_ids, columns, strict=True))
        return list(dict.fromkeys(column[name] for name in self.cav_ids))

    @property
    def has_recorded_leader(self) -> bool:
        """Whether the first vehicle on the road replays a recording."""
        return self.replayed_motion.shape[1] > 0

    @property
    def has_run(self) -> bool:
        """Whether the episode ran, even if it ended early."""
        return self.status != "failed"


def assign_columns(
    first_steps: NDArray[np.intp], last_steps: NDArray[np.intp], groups: Sequence[Hashable], min_spacing: int = 1
) -> NDArray[np.intp]:
    """Return a column for each of n trips, given the first and the last step of each (inclusive).

    Only trips of the same group share a column, with at least `min_spacing` empty steps between two trips.
    """
    columns, column_count = np.zeros(len(groups), np.intp), 0
    heaps: dict[Hashable, list[tuple[int, int]]] = {}
    for trip in np.argsort(first_steps, kind="stable").tolist():
        heap = heaps.setdefault(groups[trip], [])
        if heap and heap[0][0] + min_spacing < first_steps[trip]:
            _, column = heappop(heap)
        else:
            column, column_count = column_count, column_count + 1
        columns[trip] = column
        heappush(heap, (int(last_steps[trip]), column))
    return columns


def common_fields(
    scenario: Scenario, road: Road, seed: Sequence[int], has_crashed: bool, stop_reason: str = ""
) -> dict[str, Any]:
    """Return the common fields of all records by name; `stop_reason` is the reason of an early end by SUMO."""
    return {
        "seed": tuple(seed),
        "status": "collision" if has_crashed else "teleports" if stop_reason else "completed",
        "reason": "" if has_crashed else stop_reason,
        "control_step": scenario.control_step,
        "warmup": scenario.warmup,
        "drawn_values": road.drawn_values,
        "limit_speed": road.limit_speed,
        "merge_positions": road.merge_positions,
    }


def failed_episode(seed: tuple[int, ...], reason: str, error: str) -> Episode:
    """Return the record of an episode that did not run, because each requested episode must have a record."""
    return Episode(seed=seed, status="failed", reason=reason, error=error)
