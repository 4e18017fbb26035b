"""Traffic of a main road that a ramp joins: people are commanded, and neighbours computed from positions.

All vehicles stand in one list: those that are past the place where the ways meet, then the main road's, then
the ramp's, each from front to back. Nobody overtakes, so that a vehicle's leader is the one before it in the
list, but for the first of the ramp, which follows the last that is past the meeting place.
"""

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.car_following import _MIN_GAP
from unjam.drivers.local_state import MAX_OBSERVED_GAP, LocalState
from unjam.drivers.safety import FollowingState
from unjam.errors import EpisodeError
from unjam.physics.idm import idm_acceleration, stack_idm_parameters
from unjam.physics.kinematics import next_position, next_speed
from unjam.scenarios.population import apply_population
from unjam.scenarios.road import MergeRoad, Origin
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.record import Episode, Floats
from unjam.worlds.sumo.networks import lane_center_lines, network_file
from unjam.worlds.sumo.open_road import OpenTraffic
from unjam.worlds.sumo.traffic import NO_SPEED_COMMAND
from unjam.worlds.world import DriverLog, ProgressCallback

MERGE_BRANCHES = ("highway", "ramp")
ABSENT_LEADER_GAP = 1e9
"""gap to a leader that is not there [m]"""


class MergingStreams:
    """The vehicles on a merging road, in the order described above."""

    def __init__(self) -> None:
        """Begin with an empty road."""
        self.names: list[str] = []
        self.positions: Floats = np.zeros(0)
        """of front bumpers, zero where the ways meet, negative before it [m]"""
        self.speeds: Floats = np.zeros(0)
        """[m/s]"""
        self._merged_count, self._main_road_count = 0, 0
        """how many are past the meeting place, and on the main road before it"""

    def enter(self, name: str, origin: Origin, speed: float) -> None:
        """Put a vehicle behind the last of its branch."""
        if origin.position >= 0:
            self._merged_count += 1
            place = self._merged_count - 1
        elif origin.branch == 0:
            self._main_road_count += 1
            place = self._merged_count + self._main_road_count - 1
        else:
            place = len(self.names)
        self.names.insert(place, name)
        self.positions = np.insert(self.positions, place, origin.position)
        self.speeds = np.insert(self.speeds, place, speed)

    def leave(self, names: Collection[str]) -> None:
        """Take the vehicles at the very front off the road."""
        count = len(names)
        if set(names) != set(self.names[:count]):
            raise EpisodeError(f"{', '.join(sorted(names))} left the road from behind another vehicle")
        self._merged_count -= count
        del self.names[:count]
        self.positions, self.speeds = self.positions[count:], self.speeds[count:]

    def move(self, speeds: Sequence[float], step: float) -> None:
        """Move all vehicles by one step, `speeds` being those after it [m/s]."""
        self.speeds = np.array(speeds, np.float64)
        self.positions = next_position(self.positions, self.speeds, step)
        while (
            self._main_road_count and self.positions[self._merged_count] >= 0
        ):  # the first of the main road: in place already
            self._merged_count, self._main_road_count = self._merged_count + 1, self._main_road_count - 1
        while (first := self._merged_count + self._main_road_count) < len(self.names) and self.positions[first] >= 0:
            place = int((self.positions[: self._merged_count] >= self.positions[first]).sum())
            self.names.insert(place, self.names.pop(first))
            order = np.arange(len(self.names))
            order[place : first + 1] = [first, *range(place, first)]
            self.positions, self.speeds = self.positions[order], self.speeds[order]
            self._merged_count += 1

    def leaders(self) -> NDArray[np.intp]:
        """Return the place of each vehicle's leader; -1 where it has none."""
        ahead = np.arange(len(self.names)) - 1
        first_on_ramp = self._merged_count + self._main_road_count
        if first_on_ramp < len(ahead):
            ahead[first_on_ramp] = self._merged_count - 1
        return ahead

    def gaps(self, leaders: NDArray[np.intp]) -> Floats:
        """Return each vehicle's gap to its leader [m]; `FAR` where it has none."""
        return np.where(leaders < 0, ABSENT_LEADER_GAP, self.positions[leaders] - self.positions - VEHICLE_LENGTH)

    def is_on_junction(self, approach_lengths: tuple[float, float]) -> NDArray[np.bool_]:
        """Return who is on the ways across the junction, `ways` metres long, that end where both meet."""
        before = np.zeros(len(self.names))
        before[self._merged_count : self._merged_count + self._main_road_count] = approach_lengths[0]
        before[self._merged_count + self._main_road_count :] = approach_lengths[1]
        return (self.positions < 0) & (self.positions >= -before)

    def states(self) -> LocalState:
        """Return what all vehicles perceive; who is farther than `MAX_OBSERVED_GAP` is not there."""
        leaders = self.leaders()
        followers, gaps = self._followers(leaders), self.gaps(leaders)
        behind = self.positions - self.positions[followers] - VEHICLE_LENGTH
        gaps_behind = np.where(followers < 0, ABSENT_LEADER_GAP, behind)
        return LocalState(
            speed=self.speeds,
            leader_speed=np.where(gaps < MAX_OBSERVED_GAP, self.speeds[leaders], self.speeds),
            leader_gap=gaps.clip(max=MAX_OBSERVED_GAP),
            follower_speed=np.where(gaps_behind < MAX_OBSERVED_GAP, self.speeds[followers], self.speeds),
            follower_gap=gaps_behind.clip(max=MAX_OBSERVED_GAP),
            route_position=self.positions,
            loop_length=np.full(len(self.names), np.nan),
        )

    def _followers(self, leaders: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the place of each vehicle's follower, of two the nearer one; -1 where it has none."""
        behind = np.full(len(leaders), -1)
        followed = np.flatnonzero(leaders >= 0)
        order = followed[np.argsort(self.positions[followed], kind="stable")]
        behind[leaders[order]] = order  # of several the last one written counts: the nearest
        return behind


class MergingTraffic(OpenTraffic[MergeRoad]):
    """The actual environment of a merge."""

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> None:
        """Run the warm-up, then hand the CAVs over."""
        self._streams = MergingStreams()
        super().start(is_controlled, on_progress)

    def _update_vehicles(self, left_names: Sequence[str], entered_names: Sequence[str]) -> None:
        streams, simulation = self._streams, self._simulation
        streams.leave(left_names)
        streams.move(simulation.speeds(streams.names), self.scenario.simulation_step)
        simulation.command_humans(entered_names, self.scenario.right_of_way, self.scenario.enforce_human_limits)
        origins = self.road.origins
        for name in sorted(entered_names, key=lambda name: -origins[name].position):  # the foremost first
            streams.enter(name, origins[name], simulation.speeds([name])[0])

    def _command_humans(self) -> None:
        """Ask for the speeds of the IDM with noise, except on the junction, where SUMO drives.

        CAVs are asked for too: what they are told in the same step replaces it.
        """
        scenario, streams = self.scenario, self._streams
        leaders = streams.leaders()
        gaps = streams.gaps(leaders).clip(_MIN_GAP, None)
        speeds = streams.speeds
        ahead = np.where(leaders < 0, speeds, speeds[leaders])
        humans = scenario.humans
        if self.road.human_parameters:
            humans = stack_idm_parameters(self._human_parameters(streams.names))
        acceleration = idm_acceleration(speeds, ahead, gaps, humans)
        acceleration = apply_population(scenario.driver_population, acceleration, speeds, ahead, gaps)
        if scenario.noise > 0:
            noise = self._noise_generator.standard_normal(len(speeds))
            acceleration = acceleration + scenario.noise_per_step * noise
        wanted = next_speed(speeds, acceleration, scenario.simulation_step)
        wanted[streams.is_on_junction(self.road.junction_lengths)] = NO_SPEED_COMMAND
        self._simulation.command_speeds(streams.names, wanted.tolist())

    def _names_and_speeds(self) -> tuple[Sequence[str], Floats]:
        return self._streams.names, self._streams.speeds

    def _prepare_states(self) -> None:
        self._all_local_states = self._streams.states()

    def _snapshot(self, names: Sequence[str]) -> dict[str, Any]:
        return {"positions": self._streams.positions, "gaps": self._all_local_states.leader_gap}

    def _local_states(self, names: Sequence[str]) -> LocalState:
        places = [self._streams.names.index(name) for name in names]
        return self._all_local_states.select(places)

    def record(self, driver_log: DriverLog) -> Episode:
        """Return what happened since the start; positions are checked against SUMO's odometer."""
        streams = self._streams
        entered = np.array([self.road.origins[name].position for name in streams.names])
        self._check_odometer(streams.names, entered, streams.positions)
        return super().record(driver_log)

    def _following_states(self, names: Sequence[str]) -> list[FollowingState]:
        if not self.scenario.safety.active:
            return super()._following_states(names)
        states, place_of = self._streams.states(), self._streams.names.index
        near = list(zip(*(values.tolist() for values in states[:3]), strict=True))
        return [FollowingState(*near[place_of(name)]) for name in names]

    def _lane_lines(self) -> Floats:
        return lane_center_lines(network_file(self.road.network))

    def _branches(self, vehicles: Sequence[str]) -> Sequence[str]:
        return [MERGE_BRANCHES[self.road.origins[name].branch] for name in vehicles]
