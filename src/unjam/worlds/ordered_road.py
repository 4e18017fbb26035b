"""Roads with one lane and constant vehicles: neighbors, the log of an episode, and its record."""

from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field
from math import inf, nan
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.local_state import LocalState, observe_neighbor
from unjam.physics.kinematics import gap_on_loop, next_position
from unjam.scenarios.road import OrderedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario
from unjam.worlds.audit import OVERRIDE_TOLERANCE, Audit, braking_statistics, following_statistics
from unjam.worlds.record import Episode, Floats, Trajectory, make_trajectory
from unjam.worlds.road_world import RoadScene
from unjam.worlds.world import DriverLog

MAX_RECALL_SECONDS = 60.0
"""duration of the warm-up that a driver may remember [s]"""
CROSSING_APPROACH_LENGTH = 50.0
"""distance before a crossing on which SUMO's braking counts as yielding [m]"""
NOISE_BLOCK_STEPS = 100
"""number of steps of human speed noise drawn at once; the rest of a block is dropped when CAVs take over"""


class NeighborIndices(NamedTuple):
    """Indices of some vehicles and their neighbors, in road order: integers, or arrays of them."""

    own: Any
    leader: Any
    follower: Any


def loop_neighbors(indices: Any, vehicle_count: int) -> NeighborIndices:
    """Return the neighbors of vehicles on a loop with one lane, where neighbors never change."""
    return NeighborIndices(indices, (indices + 1) % vehicle_count, (indices - 1) % vehicle_count)


def loop_state(
    speeds: Any,
    positions: Any,
    neighbors: NeighborIndices,
    loop_length: float,
    crossings: tuple[tuple[float, float], ...] = (),
    penetration_rate: float | None = None,
) -> LocalState:
    """Return the local state of the vehicles `neighbors.own`; floats for integer indices.

    Speeds [m/s] and positions of front bumpers, not wrapped [m], are in road order: arrays of shape (vehicles,) or
    (vehicles, moments), or lists. `loop_length` [m] is infinite on a road with ends. `crossings` are ranges where the
    road crosses itself [m]. `penetration_rate` is the rate that a service reports; None without a service.
    """
    own, leader, follower = neighbors
    speed, position = speeds[own], positions[own]
    state = LocalState(  # keyword arguments would double the time of this function, which runs in every step
        speed,
        speeds[leader],
        gap_on_loop(position, positions[leader], loop_length, VEHICLE_LENGTH),
        speeds[follower],
        gap_on_loop(positions[follower], position, loop_length, VEHICLE_LENGTH),
        position % loop_length,
        loop_length if type(position) is float else np.full(position.shape, loop_length),
    )
    if loop_length == inf:
        state = as_open_road_state(state)
    if penetration_rate is not None:
        state = state._replace(penetration_rate=speed * 0.0 + penetration_rate)
    if not crossings:
        return state
    distances = [(start - position) % loop_length for start, _ in crossings]
    nearest = min(distances) if type(position) is float else np.minimum.reduce(distances)
    return state._replace(distance_to_crossing=nearest)


def as_open_road_state(state: LocalState) -> LocalState:
    """Return a state computed on an infinite loop as a state on a road with ends."""
    speed, gap = state.speed, state.follower_gap
    follower_speed, follower_gap = observe_neighbor(gap < inf, gap, state.follower_speed, speed)
    return state._replace(follower_speed=follower_speed, follower_gap=follower_gap, loop_length=speed * nan)


def poses_along(outline: Floats, positions: Floats, loop_length: float) -> Floats:
    """Return rows (x, y, heading) of vehicles on a closed road [m, rad], shape (..., 3); heading 0 is the x axis.

    The outline has rows (coordinate along the road, x, y). Positions of front bumpers are not wrapped [m], any shape.
    """
    (x, y), (rear_x, rear_y) = (
        [np.interp(along % loop_length, outline[:, 0], outline[:, axis]) for axis in (1, 2)]
        for along in (positions, positions - VEHICLE_LENGTH)
    )
    return np.stack([x, y, np.arctan2(y - rear_y, x - rear_x)], axis=-1)


@dataclass(frozen=True)
class OrderedRoadLog:
    """Log of a road with N vehicles, C of them CAVs, over D control steps with S simulation steps in total."""

    scenario: Scenario
    road: OrderedRoad
    start_positions: Floats
    """front bumpers at the start of the log, not wrapped [m], shape (N,)"""
    noise_free_speeds: Floats
    """speeds with which the vehicles moved, before noise [m/s], shape (S, N)"""
    speeds: Floats
    """speeds with noise, first those at the start [m/s], shape (S + 1, N)"""
    requested_accelerations: Floats
    """the drivers' accelerations within the limits [m/s2], shape (D, C); no rows if CAVs stayed human"""
    safe_accelerations: Floats
    """accelerations after the safety filter [m/s2], shape (S, C); no rows if CAVs stayed human"""
    commanded_speeds: Floats
    """speeds after each step with these accelerations [m/s], shape (S, C); no rows if CAVs stayed human"""
    has_crashed: bool = False
    fuel: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """fuel rate [mg/s], shape (D, N); (0, 0) if not recorded"""
    penetration_rate: float | None = None
    """penetration rate that is reported to the CAVs; None if it is not reported"""

    @property
    def cav_indices(self) -> NDArray[np.intp]:
        """Indices of the CAVs among the vehicles, in road order."""
        return np.array([self.road.vehicle_ids.index(cav_id) for cav_id in self.road.cav_ids])

    def speeds_and_positions(self) -> tuple[Floats, Floats]:
        """Return speeds [m/s] and positions [m] in every simulation step, shape (N, S + 1), by Euler steps."""
        start = self.start_positions[:, None]
        positions = next_position(start, self.noise_free_speeds.T.cumsum(1), self.scenario.simulation_step)
        return self.speeds.T, np.column_stack([start, positions])

    def _local_states(self, speeds: Floats, positions: Floats) -> LocalState:
        road, neighbors = self.road, loop_neighbors(self.cav_indices, len(self.start_positions))
        return loop_state(speeds, positions, neighbors, road.loop_length, road.crossings, self.penetration_rate)

    def episode(
        self,
        speeds_and_positions: tuple[Floats, Floats],
        common_fields: dict[str, Any],
        driver_log: DriverLog,
        rows: Any,
    ) -> Episode:
        """Return the record; `rows` are those of the CAVs in the decisions, (C,), or None if decisions are floats."""
        road, stride = self.road, self.scenario.steps_per_control_step
        speeds, positions = (values[:, ::stride] for values in speeds_and_positions)
        control_steps = speeds.shape[1] - 1
        gaps = gap_on_loop(positions, np.roll(positions, -1, axis=0), road.loop_length, VEHICLE_LENGTH)
        states, driven_count = self._local_states(speeds, positions), road.driven_count
        applied, filter_braking = self._applied_and_filtered()
        shield_braking = self._added_braking().reshape(control_steps, -1, len(road.cav_ids)).max(1).clip(0.0, None)
        trajectories = list[Trajectory]()
        for index, cav_id in enumerate(road.cav_ids):
            entry = index if rows is None else int(rows[index])
            entry_rows = None if rows is None else np.full(control_steps + 1, entry)
            state = states.map(lambda values: np.ascontiguousarray(values[index]))  # noqa: B023
            commands = (np.ascontiguousarray(values[:, index]) for values in (applied, filter_braking, shield_braking))
            trip = cav_id, entry, 0, entry_rows, state
            trajectories.append(make_trajectory(*trip, *commands, terminated=self.has_crashed, driver_log=driver_log))
        return Episode(
            **common_fields,
            vehicle_ids=road.vehicle_ids[:driven_count],
            cav_ids=road.cav_ids,
            speeds=np.ascontiguousarray(speeds[:driven_count].T),
            positions=np.ascontiguousarray(positions[:driven_count].T),
            gaps=np.ascontiguousarray(gaps[:driven_count].T),
            fuel=self.fuel[:, :driven_count],
            replayed_motion=np.stack([positions[driven_count:].T, speeds[driven_count:].T], -1),
            loop_length=nan if road.loop_length == inf else road.loop_length,
            crossings=road.crossings,
            outline=road.center_line,
            trajectories=tuple(trajectories),
            audit=self._audit(*speeds_and_positions),
        )

    def _audit(self, speeds: Floats, positions: Floats) -> Audit:
        step, time_gap = self.scenario.simulation_step, self.scenario.safety.time_gap
        states = self._local_states(speeds, positions).map(lambda values: values.T)
        pairs = states.speed, states.leader_speed, states.leader_gap
        accelerations = np.diff(speeds[: self.road.driven_count], axis=1) / step
        is_cav = np.zeros(len(accelerations), bool)
        is_cav[self.cav_indices] = len(self.requested_accelerations) > 0
        near_crossing = np.zeros(1, bool)
        for start, end in self.road.crossings:
            distance_to_end = (end - states.route_position[:-1]) % self.road.loop_length
            near_crossing = near_crossing | (distance_to_end < end - start + CROSSING_APPROACH_LENGTH)
        is_overridden = self._added_braking() > OVERRIDE_TOLERANCE
        return Audit(
            braking_statistics(accelerations[~is_cav]),
            braking_statistics(accelerations[is_cav]),
            following_statistics(*pairs, step, is_overridden, near_crossing),
            time_gap,
        )

    def _applied_and_filtered(self) -> tuple[Floats, Floats]:
        """Return the CAVs' mean filtered commands, and the largest reductions by the filter [m/s2], (D, C) each."""
        stride, requested = self.scenario.steps_per_control_step, self.requested_accelerations
        if len(requested):
            reductions = requested[:, None] - self.safe_accelerations.reshape(len(requested), stride, -1)
            return requested - reductions.mean(1), reductions.max(1)
        actual = np.diff(self.speeds[::stride, self.cav_indices], axis=0) / self.scenario.control_step
        return actual, np.zeros_like(actual)

    def _added_braking(self) -> Floats:
        """Return the braking that SUMO added to the commands in each step [m/s2], shape (S, C)."""
        actual_speeds = self.noise_free_speeds[:, self.cav_indices]
        if not len(self.requested_accelerations):
            return np.zeros_like(actual_speeds)
        # Limiting a command to the top speed is not braking.
        commanded = np.minimum(self.commanded_speeds, self.scenario.top_speed)
        return (commanded - actual_speeds) / self.scenario.simulation_step


class OrderedRoadRecorder:
    """Collects the rows of an `OrderedRoadLog` during an episode; `series` has the joined rows of each field."""

    def __init__(self, scenario: Scenario, road: OrderedRoad, start_positions: Floats, speeds: Iterable[float]) -> None:
        self._arguments = scenario, road, start_positions
        names = "noise_free_speeds", "requested_accelerations", "safe_accelerations", "commanded_speeds"
        self.series = {name: array("d") for name in names} | {"speeds": array("d", speeds)}

    def make_log(self, **fields: Any) -> OrderedRoadLog:
        """Return the log so far; `fields` are its other fields."""
        _, road, _ = self._arguments
        widths: dict[str, int] = dict.fromkeys(("noise_free_speeds", "speeds"), len(road.vehicle_ids))
        for name, values in self.series.items():
            fields[name] = np.array(values).reshape(-1, widths.get(name, len(road.cav_ids)))
        return OrderedRoadLog(*self._arguments, **fields)

    def last_applied_acceleration(self) -> Floats:
        """Return the CAVs' mean accelerations in the last control step, after the filter [m/s2], shape (CAVs,)."""
        scenario, road, _ = self._arguments
        count = len(road.cav_ids) * scenario.steps_per_control_step
        rows = np.array(self.series["safe_accelerations"][-count:]).reshape(-1, len(road.cav_ids))
        return rows[0] if len(rows) == 1 else rows.mean(0)


def ordered_scene(road: OrderedRoad, positions: Floats, speeds: Any) -> RoadScene:
    """Return the scene of all vehicles from positions along the road, not wrapped [m], and speeds [m/s]."""
    is_cav = np.isin(road.vehicle_ids, road.cav_ids)
    if len(road.center_line):
        poses, line = poses_along(road.center_line, positions, road.loop_length), road.center_line[:, 1:]
    else:  # straight
        poses = np.stack([positions, 0.0 * positions, 0.0 * positions], -1)
        line = np.array([[positions[0] - VEHICLE_LENGTH, 0.0], [positions[-1], 0.0]])
    return RoadScene(line, poses, np.array(speeds), is_cav)
