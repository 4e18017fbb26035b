"""Closed roads with one lane: who is whose neighbour, what was logged, and the record that is made of it."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.local_state import LocalState
from unjam.physics.kinematics import gap_on_loop, next_position
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario
from unjam.worlds.audit import OVERRIDE_TOLERANCE, Audit, braking_statistics, following_statistics
from unjam.worlds.record import Episode, Floats, make_trajectory
from unjam.worlds.world import DriverLog

MAX_RECALL_SECONDS = 60.0
"""seconds of the warm-up that a driver may remember"""
CROSSING_APPROACH_LENGTH = 50.0
"""way before a crossing on which what SUMO adds is put down to the right of way [m]"""
NOISE_BLOCK_STEPS = 100
"""steps for which people's noise is drawn at once; what is left of a block is dropped as CAVs take over"""


class NeighborIndices(NamedTuple):
    """Places of some vehicles and of those around them, in road order: integers, or arrays of them."""

    own: Any
    leader: Any
    follower: Any


def loop_neighbors(indices: Any, vehicle_count: int) -> NeighborIndices:
    """Return the neighbours of the `chosen` places among `vehicles` on a loop with one lane.

    Nobody overtakes there: each vehicle keeps the neighbours that it starts with.
    """
    return NeighborIndices(indices, (indices + 1) % vehicle_count, (indices - 1) % vehicle_count)


def loop_state(
    speeds: Any,
    positions: Any,
    neighbors: NeighborIndices,
    loop_length: float,
    crossings: tuple[tuple[float, float], ...] = (),
    penetration_rate: float | None = None,
) -> LocalState:
    """Return what the vehicles `near.own` perceive on a closed road; integers there give plain numbers.

    Speeds [m/s] and positions of front bumpers, not wrapped [m], are by place in road order: arrays of shape
    (vehicles,) or (vehicles, moments), or lists. Where the road crosses itself is from and to [m]. The share
    of CAVs is a service's to tell; None: it does not.
    """
    own, ahead, behind = neighbors
    speed, position = speeds[own], positions[own]
    state = LocalState(  # names would cost as much as all the rest, in every step of a simulator
        speed,
        speeds[ahead],
        gap_on_loop(position, positions[ahead], loop_length, VEHICLE_LENGTH),
        speeds[behind],
        gap_on_loop(positions[behind], position, loop_length, VEHICLE_LENGTH),
        position % loop_length,
        loop_length if type(position) is float else np.full(position.shape, loop_length),
    )
    if penetration_rate is not None:
        state = state._replace(penetration_rate=state.loop_length * 0.0 + penetration_rate)
    if not crossings:
        return state
    ways = [(start - position) % loop_length for start, _ in crossings]
    nearest = min(ways) if type(position) is float else np.minimum.reduce(ways)
    return state._replace(distance_to_crossing=nearest)


def poses_along(outline: Floats, positions: Floats, loop_length: float) -> Floats:
    """Return rows (x, y, heading) of vehicles whose front bumpers are at `positions` along a closed road.

    The outline is rows (coordinate along the road, x, y) [m]; positions are not wrapped [m], any shape.

    Returns:
        Shape (..., 3): [m], and [rad] against the x axis; a vehicle lies between the places of its bumpers.
    """
    (x, y), (rear_x, rear_y) = (
        [np.interp(along % loop_length, outline[:, 0], outline[:, axis]) for axis in (1, 2)]
        for along in (positions, positions - VEHICLE_LENGTH)
    )
    return np.stack([x, y, np.arctan2(y - rear_y, x - rear_x)], axis=-1)


@dataclass(frozen=True)
class ClosedRoadLog:
    """All simulation steps of a closed road: D decisions of S steps in all, N vehicles, C of them CAVs."""

    scenario: Scenario
    road: ClosedRoad
    start_positions: Floats
    """front bumpers as the log began, not wrapped [m], shape (N,)"""
    noise_free_speeds: Floats
    """speeds with which the vehicles moved, before noise [m/s], shape (S, N)"""
    speeds: Floats
    """with noise, the first being that at the start [m/s], shape (S + 1, N)"""
    requested_accelerations: Floats
    """what the drivers asked for, within the limits [m/s2], shape (D, C); no rows where CAVs stayed human"""
    safe_accelerations: Floats
    """what of it passed the safety filter [m/s2], shape (S, C); likewise"""
    commanded_speeds: Floats
    """the speeds that this leads to [m/s], shape (S, C); likewise"""
    has_crashed: bool = False
    fuel: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """[mg/s], shape (D, N); (0, 0) where it was not recorded"""
    penetration_rate: float | None = None
    """as CAVs were told, if they were"""

    @property
    def cav_indices(self) -> NDArray[np.intp]:
        """Which of the vehicles are CAVs, in road order."""
        return np.array([self.road.vehicle_ids.index(name) for name in self.road.cav_ids])

    def speeds_and_positions(self) -> tuple[Floats, Floats]:
        """Return speeds [m/s] and positions [m] in every simulation step, shape (N, S + 1): Euler steps."""
        start, moved = self.start_positions[:, None], self.noise_free_speeds.T
        positions = next_position(start, moved.cumsum(1), self.scenario.simulation_step)
        return self.speeds.T, np.column_stack([start, positions])

    def episode(
        self,
        speeds_and_positions: tuple[Floats, Floats],
        common_fields: dict[str, Any],
        driver_log: DriverLog,
        rows: Any,
    ) -> Episode:
        """Return the record, of the `moments` of this log, with `facts` that it says besides.

        `rows` are those of the CAVs in what was decided, shape (C,); None: decisions are plain numbers.
        """
        road, each = self.road, self.scenario.steps_per_control_step
        speeds, positions = (values[:, ::each] for values in speeds_and_positions)
        decisions = speeds.shape[1] - 1
        gaps = gap_on_loop(positions, np.roll(positions, -1, axis=0), road.loop_length, VEHICLE_LENGTH)
        near = loop_neighbors(self.cav_indices, len(self.start_positions))
        states = loop_state(speeds, positions, near, road.loop_length, road.crossings, self.penetration_rate)
        (applied, filtered), shield = self._applied_and_filtered(), self._shield_braking(decisions)
        trajectories = tuple(
            make_trajectory(
                vehicle=name,
                entry_number=number if rows is None else int(rows[number]),
                start_step=0,
                rows=None if rows is None else np.full(decisions + 1, rows[number]),
                states=states.map(lambda values: np.ascontiguousarray(values[number])),  # noqa: B023
                applied_acceleration=np.ascontiguousarray(applied[:, number]),
                filter_braking=np.ascontiguousarray(filtered[:, number]),
                shield_braking=np.ascontiguousarray(shield[:, number]),
                terminated=self.has_crashed,
                driver_log=driver_log,
            )
            for number, name in enumerate(road.cav_ids)
        )
        return Episode(
            **common_fields,
            vehicle_ids=road.vehicle_ids,
            cav_ids=road.cav_ids,
            speeds=np.ascontiguousarray(speeds.T),
            positions=np.ascontiguousarray(positions.T),
            gaps=np.ascontiguousarray(gaps.T),
            fuel=self.fuel,
            loop_length=road.loop_length,
            crossings=road.crossings,
            outline=road.center_line,
            trajectories=trajectories,
            audit=self._audit(*speeds_and_positions),
        )

    def _audit(self, speeds: Floats, positions: Floats) -> Audit:
        """Return the physics of every simulation step; arrays of shape (vehicles, moments)."""
        step, loop = self.scenario.simulation_step, self.road.loop_length
        floor = self.scenario.safety.time_gap
        near = loop_neighbors(self.cav_indices, len(self.start_positions))
        states = loop_state(speeds, positions, near, loop).map(lambda values: values.T)
        followed = states.speed, states.leader_speed, states.leader_gap
        accelerations, driven = np.diff(speeds, axis=1) / step, np.zeros(len(speeds), bool)
        if not len(self.requested_accelerations):
            return Audit(
                braking_statistics(accelerations),
                following=following_statistics(*followed, step),
                required_time_gap=floor,
            )
        driven[self.cav_indices] = True
        before = [(end - states.route_position[:-1]) % loop for _, end in self.road.crossings]
        ways = [end - start + CROSSING_APPROACH_LENGTH for start, end in self.road.crossings]
        close = sum((left < way for left, way in zip(before, ways, strict=True)), np.zeros(1, bool))
        found = following_statistics(*followed, step, self._added_braking() > OVERRIDE_TOLERANCE, close)
        return Audit(
            braking_statistics(accelerations[~driven]), braking_statistics(accelerations[driven]), found, floor
        )

    def _applied_and_filtered(self) -> tuple[Floats, Floats]:
        """Return what CAVs were told, and how much the filter took from it at most [m/s2], (D, C) each.

        Of humans it is what they did.
        """
        each = self.scenario.steps_per_control_step
        if len(self.requested_accelerations):
            taken = self.requested_accelerations[:, None] - self.safe_accelerations.reshape(
                len(self.requested_accelerations), each, -1
            )
            return self.requested_accelerations - taken.mean(1), taken.max(1)
        did = np.diff(self.speeds[::each, self.cav_indices], axis=0) / self.scenario.control_step
        return did, np.zeros_like(did)

    def _shield_braking(self, control_steps: int) -> Floats:
        """Return the hardest braking that was added to each command, zero if it passed, (D, C)."""
        return self._added_braking().reshape(control_steps, -1, len(self.road.cav_ids)).max(1).clip(0.0, None)

    def _added_braking(self) -> Floats:
        """Return the braking that SUMO added to each command in each step [m/s2], shape (S, C).

        A car that is told to drive faster than it can does not, which is no braking.
        """
        moved = self.noise_free_speeds[:, self.cav_indices]
        if not len(self.requested_accelerations):
            return np.zeros_like(moved)
        commanded = np.minimum(self.commanded_speeds, self.scenario.top_speed)
        return (commanded - moved) / self.scenario.simulation_step
