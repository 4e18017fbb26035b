"""Traffic on a main road with a ramp: human drivers are commanded, and neighbors are computed from positions.

One list contains the vehicles past the merge point, then those on the main road, then those on the ramp, each group
from front to back. The leader of a vehicle is the previous vehicle in the list; for the first vehicle on the ramp, it
is the last vehicle past the merge point.
"""

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.car_following import MIN_IDM_GAP
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import FollowingState
from unjam.errors import EpisodeError
from unjam.physics.idm import idm_acceleration, stack_idm_parameters
from unjam.physics.kinematics import next_position, next_speed
from unjam.scenarios.population import apply_population
from unjam.scenarios.road import MergeRoad, Origin
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.record import Episode, Floats
from unjam.worlds.sumo.open_road import OpenTraffic, neighbor_state
from unjam.worlds.sumo.traffic import NO_SPEED_COMMAND
from unjam.worlds.world import DriverLog

MERGE_BRANCHES = ("highway", "ramp")
ABSENT_LEADER_GAP = 1e9
"""gap of a vehicle without a leader [m]"""


class MergingStreams:
    """The vehicles of a merge, in the order that the module describes."""

    def __init__(self) -> None:
        self.vehicle_ids: list[str] = []
        self.positions: Floats = np.zeros(0)
        """positions of the front bumpers, zero at the merge point and negative before it [m]"""
        self.speeds: Floats = np.zeros(0)
        self._branches = np.zeros(0, np.intp)
        """branch on which each vehicle entered; 0: the main road, 1: the ramp"""

    def enter(self, vehicle_id: str, origin: Origin, speed: float) -> None:
        """Add a vehicle at the position of its entry."""
        self.vehicle_ids.append(vehicle_id)
        self.positions, self.speeds = np.append(self.positions, origin.position), np.append(self.speeds, speed)
        self._branches = np.append(self._branches, origin.branch)
        self._sort()

    def leave(self, ids: Collection[str]) -> None:
        """Remove vehicles, which must be the first in the list."""
        count = len(ids)
        if set(ids) != set(self.vehicle_ids[:count]):
            raise EpisodeError(f"{', '.join(sorted(ids))} left the road from behind another vehicle")
        del self.vehicle_ids[:count]
        self._select(slice(count, None))

    def move(self, speeds: Sequence[float], step: float) -> None:
        """Move all vehicles by one step [s]; `speeds` are their speeds after the step [m/s]."""
        self.speeds = np.array(speeds, np.float64)
        self.positions = next_position(self.positions, self.speeds, step)
        self._sort()

    def _groups(self) -> NDArray[np.intp]:
        """Return 0 for vehicles past the merge point, 1 on the main road before it, and 2 on the ramp."""
        return np.where(self.positions >= 0, 0, 1 + self._branches)

    def _sort(self) -> None:
        order = np.lexsort((-self.positions, self._groups()))
        if (order != np.arange(len(order))).any():
            self.vehicle_ids = [self.vehicle_ids[row] for row in order.tolist()]
            self._select(order)

    def _select(self, rows: Any) -> None:
        self.positions, self.speeds, self._branches = self.positions[rows], self.speeds[rows], self._branches[rows]

    def leaders(self) -> NDArray[np.intp]:
        """Return the row of each vehicle's leader; -1 without a leader."""
        leaders = np.arange(len(self.vehicle_ids)) - 1
        merged_count, first_on_ramp = np.searchsorted(self._groups(), (1, 2))
        if first_on_ramp < len(leaders):
            leaders[first_on_ramp] = merged_count - 1
        return leaders

    def gaps(self, leaders: NDArray[np.intp]) -> Floats:
        """Return each vehicle's gap to its leader [m]; `ABSENT_LEADER_GAP` without a leader."""
        return np.where(leaders < 0, ABSENT_LEADER_GAP, self._leader_gaps(np.arange(len(leaders)), leaders))

    def _leader_gaps(self, rows: NDArray[np.intp], leaders: NDArray[np.intp]) -> Floats:
        return self.positions[leaders] - self.positions[rows] - VEHICLE_LENGTH

    def is_on_junction(self, approach_lengths: tuple[float, float]) -> NDArray[np.bool_]:
        """Return which vehicles are on the junction; `approach_lengths` are its lengths on both branches [m]."""
        return (self.positions < 0) & (self.positions >= -np.array(approach_lengths)[self._branches])

    def states(self) -> LocalState:
        """Return the local states of all vehicles; neighbors beyond `MAX_OBSERVED_GAP` count as absent."""
        leaders = self.leaders()
        rows, followers = np.arange(len(leaders)), self._followers(leaders)
        return neighbor_state(rows, leaders, followers, self.positions, self.speeds, self._leader_gaps)

    def _followers(self, leaders: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the row of each vehicle's follower, the nearer one if there are two; -1 without a follower."""
        followers = np.full(len(leaders), -1)
        with_leader = np.flatnonzero(leaders >= 0)
        order = with_leader[np.argsort(self.positions[with_leader], kind="stable")]
        followers[leaders[order]] = order  # of two followers, the nearer one is assigned last
        return followers


class MergingTraffic(OpenTraffic[MergeRoad]):
    """The world of a merge in SUMO."""

    def _prepare(self) -> None:
        self._streams = MergingStreams()

    def _update_vehicles(self, left_ids: Sequence[str], entered_ids: Sequence[str]) -> None:
        streams, simulation = self._streams, self._simulation
        streams.leave(left_ids)
        streams.move(simulation.speeds(streams.vehicle_ids), self.scenario.simulation_step)
        simulation.command_humans(entered_ids, self.scenario.right_of_way, self.scenario.enforce_human_limits)
        origins = self.road.origins
        for vehicle_id in sorted(entered_ids, key=lambda entered: -origins[entered].position):  # from front to back
            streams.enter(vehicle_id, origins[vehicle_id], simulation.speeds([vehicle_id])[0])

    def _command_humans(self) -> None:
        """Command the IDM's speeds with noise, except on the junction; commands of CAVs replace theirs afterwards."""
        scenario, streams = self.scenario, self._streams
        leaders, speeds = streams.leaders(), streams.speeds
        gaps = streams.gaps(leaders).clip(MIN_IDM_GAP, None)
        leader_speeds = np.where(leaders < 0, speeds, speeds[leaders])
        humans = scenario.humans
        if self.road.human_parameters:
            humans = stack_idm_parameters(self._human_parameters(streams.vehicle_ids))
        acceleration = idm_acceleration(speeds, leader_speeds, gaps, humans)
        acceleration = apply_population(scenario.driver_population, acceleration, speeds, leader_speeds, gaps)
        if scenario.noise > 0:
            noise = self.noise_generator.standard_normal(len(speeds))
            acceleration = acceleration + scenario.noise_per_step * noise
        commanded = next_speed(speeds, acceleration, scenario.simulation_step)
        commanded[streams.is_on_junction(self.road.junction_lengths)] = NO_SPEED_COMMAND
        self._simulation.command_speeds(streams.vehicle_ids, commanded.tolist())

    def _ids_and_speeds(self) -> tuple[Sequence[str], Floats]:
        return self._streams.vehicle_ids, self._streams.speeds

    def _local_states(self, ids: Sequence[str]) -> LocalState:
        self._all_local_states = self._streams.states()
        return self._all_local_states.select([self._streams.vehicle_ids.index(vehicle_id) for vehicle_id in ids])

    def _snapshot(self, ids: Sequence[str]) -> dict[str, Any]:
        return {"positions": self._streams.positions, "gaps": self._all_local_states.leader_gap}

    def _following_states(self, ids: Sequence[str]) -> list[FollowingState]:
        if not self.scenario.safety.active:
            return super()._following_states(ids)
        rows = list(zip(*(column.tolist() for column in self._streams.states()[:3]), strict=True))
        return [FollowingState(*rows[self._streams.vehicle_ids.index(vehicle_id)]) for vehicle_id in ids]

    def _branches(self, vehicles: Sequence[str]) -> Sequence[str]:
        return [MERGE_BRANCHES[self.road.origins[vehicle_id].branch] for vehicle_id in vehicles]

    def _make_record(self, driver_log: DriverLog) -> Episode:
        """Return the record after checking positions against SUMO's odometer."""
        streams = self._streams
        entries = np.array([self.road.origins[vehicle_id].position for vehicle_id in streams.vehicle_ids])
        self._check_odometer(streams.vehicle_ids, entries, streams.positions)
        return super()._make_record(driver_log)
