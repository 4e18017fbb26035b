"""Closed roads with one lane: who is whose neighbour, what was logged, and the record that is made of it."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.local_state import LocalState
from unjam.physics.kinematics import gap_on_loop, next_position
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario
from unjam.worlds.audit import SHIELD_ROUNDING, Audit, brakings, following
from unjam.worlds.record import Episode, Floats, trajectory
from unjam.worlds.world import Driven

HISTORY = 60.0
"""seconds of the warm-up that a driver may remember"""
APPROACH = 50.0
"""way before a crossing on which what SUMO adds is put down to the right of way [m]"""
NOISE_BLOCK = 100
"""steps for which people's noise is drawn at once; what is left of a block is dropped as CAVs take over"""


class Neighbours(NamedTuple):
    """Places of some vehicles and of those around them, in road order: integers, or arrays of them."""

    own: Any
    ahead: Any
    behind: Any


def loop_neighbours(chosen: Any, vehicles: int) -> Neighbours:
    """Return the neighbours of the `chosen` places among `vehicles` on a loop with one lane.

    Nobody overtakes there: each vehicle keeps the neighbours that it starts with.
    """
    return Neighbours(chosen, (chosen + 1) % vehicles, (chosen - 1) % vehicles)


def loop_state(
    speeds: Any,
    positions: Any,
    near: Neighbours,
    loop_length: float,
    crossings: tuple[tuple[float, float], ...] = (),
    cav_share: float | None = None,
) -> LocalState:
    """Return what the vehicles `near.own` perceive on a closed road; integers there give plain numbers.

    Speeds [m/s] and positions of front bumpers, not wrapped [m], are by place in road order: arrays of shape
    (vehicles,) or (vehicles, moments), or lists. Where the road crosses itself is from and to [m]. The share
    of CAVs is a service's to tell; None: it does not.
    """
    own, ahead, behind = near
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
    if cav_share is not None:
        state = state._replace(cav_share=state.loop_length * 0.0 + cav_share)
    if not crossings:
        return state
    ways = [(start - position) % loop_length for start, _ in crossings]
    nearest = min(ways) if type(position) is float else np.minimum.reduce(ways)
    return state._replace(to_crossing=nearest)


def places_along(outline: Floats, positions: Floats, loop_length: float) -> Floats:
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
class ClosedLog:
    """All simulation steps of a closed road: D decisions of S steps in all, N vehicles, C of them CAVs."""

    scenario: Scenario
    road: ClosedRoad
    start: Floats
    """front bumpers as the log began, not wrapped [m], shape (N,)"""
    moved: Floats
    """speeds with which the vehicles moved, before noise [m/s], shape (S, N)"""
    speeds: Floats
    """with noise, the first being that at the start [m/s], shape (S + 1, N)"""
    wanted: Floats
    """what the drivers asked for, within the limits [m/s2], shape (D, C); no rows where CAVs stayed human"""
    told: Floats
    """what of it passed the safety filter [m/s2], shape (S, C); likewise"""
    commanded: Floats
    """the speeds that this leads to [m/s], shape (S, C); likewise"""
    crashed: bool = False
    fuel: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """[mg/s], shape (D, N); (0, 0) where it was not recorded"""
    cav_share: float | None = None
    """as CAVs were told, if they were"""

    @property
    def places(self) -> NDArray[np.intp]:
        """Which of the vehicles are CAVs, in road order."""
        return np.array([self.road.vehicle_ids.index(name) for name in self.road.cav_ids])

    def moments(self) -> tuple[Floats, Floats]:
        """Return speeds [m/s] and positions [m] in every simulation step, shape (N, S + 1): Euler steps."""
        start, moved = self.start[:, None], self.moved.T
        positions = next_position(start, moved.cumsum(1), self.scenario.simulation_step)
        return self.speeds.T, np.column_stack([start, positions])

    def episode(
        self, moments: tuple[Floats, Floats], facts: dict[str, Any], driven: Driven, rows: Any
    ) -> Episode:
        """Return the record, of the `moments` of this log, with `facts` that it says besides.

        `rows` are those of the CAVs in what was decided, shape (C,); None: decisions are plain numbers.
        """
        road, each = self.road, self.scenario.steps_per_decision
        speeds, positions = (values[:, ::each] for values in moments)
        decisions = speeds.shape[1] - 1
        gaps = gap_on_loop(positions, np.roll(positions, -1, axis=0), road.loop_length, VEHICLE_LENGTH)
        near = loop_neighbours(self.places, len(self.start))
        states = loop_state(speeds, positions, near, road.loop_length, road.crossings, self.cav_share)
        (applied, filtered), shield = self._applied(), self._shield(decisions)
        trajectories = tuple(
            trajectory(
                vehicle=name,
                number=number if rows is None else int(rows[number]),
                start=0,
                rows=None if rows is None else np.full(decisions + 1, rows[number]),
                states=states.each(lambda values: np.ascontiguousarray(values[number])),  # noqa: B023
                applied=np.ascontiguousarray(applied[:, number]),
                filtered=np.ascontiguousarray(filtered[:, number]),
                shield=np.ascontiguousarray(shield[:, number]),
                terminated=self.crashed,
                driven=driven,
            )
            for number, name in enumerate(road.cav_ids)
        )
        return Episode(
            **facts,
            vehicle_ids=road.vehicle_ids,
            cav_ids=road.cav_ids,
            speeds=np.ascontiguousarray(speeds.T),
            positions=np.ascontiguousarray(positions.T),
            gaps=np.ascontiguousarray(gaps.T),
            fuel=self.fuel,
            loop_length=road.loop_length,
            crossings=road.crossings,
            outline=road.outline,
            trajectories=trajectories,
            audit=self._audit(*moments),
        )

    def _audit(self, speeds: Floats, positions: Floats) -> Audit:
        """Return the physics of every simulation step; arrays of shape (vehicles, moments)."""
        step, loop = self.scenario.simulation_step, self.road.loop_length
        floor = self.scenario.safety.time_headway
        near = loop_neighbours(self.places, len(self.start))
        states = loop_state(speeds, positions, near, loop).each(lambda values: values.T)
        followed = states.speed, states.leader_speed, states.leader_gap
        accelerations, driven = np.diff(speeds, axis=1) / step, np.zeros(len(speeds), bool)
        if not len(self.wanted):
            return Audit(brakings(accelerations), following=following(*followed, step), floor=floor)
        driven[self.places] = True
        before = [(end - states.route_position[:-1]) % loop for _, end in self.road.crossings]
        ways = [end - start + APPROACH for start, end in self.road.crossings]
        close = sum((left < way for left, way in zip(before, ways, strict=True)), np.zeros(1, bool))
        found = following(*followed, step, self._added() > SHIELD_ROUNDING, close)
        return Audit(brakings(accelerations[~driven]), brakings(accelerations[driven]), found, floor)

    def _applied(self) -> tuple[Floats, Floats]:
        """Return what CAVs were told, and how much the filter took from it at most [m/s2], (D, C) each.

        Of humans it is what they did.
        """
        each = self.scenario.steps_per_decision
        if len(self.wanted):
            taken = self.wanted[:, None] - self.told.reshape(len(self.wanted), each, -1)
            return self.wanted - taken.mean(1), taken.max(1)
        did = np.diff(self.speeds[::each, self.places], axis=0) / self.scenario.decision_step
        return did, np.zeros_like(did)

    def _shield(self, decisions: int) -> Floats:
        """Return the hardest braking that was added to each command, zero if it passed, (D, C)."""
        return self._added().reshape(decisions, -1, len(self.road.cav_ids)).max(1).clip(0.0, None)

    def _added(self) -> Floats:
        """Return the braking that SUMO added to each command in each step [m/s2], shape (S, C).

        A car that is told to drive faster than it can does not, which is no braking.
        """
        moved = self.moved[:, self.places]
        if not len(self.wanted):
            return np.zeros_like(moved)
        commanded = np.minimum(self.commanded, self.scenario.top_speed)
        return (commanded - moved) / self.scenario.simulation_step
