"""Traffic of a main road that a ramp joins: people are commanded, and neighbours computed from positions.

All vehicles stand in one list: those that are past the place where the ways meet, then the main road's, then
the ramp's, each from front to back. Nobody overtakes, so that a vehicle's leader is the one before it in the
list, but for the first of the ramp, which follows the last that is past the meeting place.
"""

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.car_following import SMALLEST_GAP
from unjam.drivers.local_state import LARGEST_GAP, LocalState
from unjam.drivers.safety import Ahead
from unjam.errors import EpisodeError
from unjam.physics.idm import idm_acceleration, parameter_rows
from unjam.physics.kinematics import next_position, next_speed
from unjam.scenarios.population import as_calibrated
from unjam.scenarios.road import MergingRoad, Origin
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.record import Episode, Floats
from unjam.worlds.sumo.networks import network_file, network_lines
from unjam.worlds.sumo.open import OpenTraffic
from unjam.worlds.sumo.traffic import LEAVE_TO_SUMO
from unjam.worlds.world import Driven, OnProgress

BRANCHES = ("highway", "ramp")
FAR = 1e9
"""gap to a leader that is not there [m]"""


class Streams:
    """The vehicles on a merging road, in the order described above."""

    def __init__(self) -> None:
        """Begin with an empty road."""
        self.names: list[str] = []
        self.positions: Floats = np.zeros(0)
        """of front bumpers, zero where the ways meet, negative before it [m]"""
        self.speeds: Floats = np.zeros(0)
        """[m/s]"""
        self._past, self._main = 0, 0
        """how many are past the meeting place, and on the main road before it"""

    def enter(self, name: str, origin: Origin, speed: float) -> None:
        """Put a vehicle behind the last of its branch."""
        if origin.position >= 0:
            self._past += 1
            place = self._past - 1
        elif origin.branch == 0:
            self._main += 1
            place = self._past + self._main - 1
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
        self._past -= count
        del self.names[:count]
        self.positions, self.speeds = self.positions[count:], self.speeds[count:]

    def move(self, speeds: Sequence[float], step: float) -> None:
        """Move all vehicles by one step, `speeds` being those after it [m/s]."""
        self.speeds = np.array(speeds, np.float64)
        self.positions = next_position(self.positions, self.speeds, step)
        while self._main and self.positions[self._past] >= 0:  # the first of the main road: in place already
            self._past, self._main = self._past + 1, self._main - 1
        while (first := self._past + self._main) < len(self.names) and self.positions[first] >= 0:
            place = int((self.positions[: self._past] >= self.positions[first]).sum())
            self.names.insert(place, self.names.pop(first))
            order = np.arange(len(self.names))
            order[place : first + 1] = [first, *range(place, first)]
            self.positions, self.speeds = self.positions[order], self.speeds[order]
            self._past += 1

    def leaders(self) -> NDArray[np.intp]:
        """Return the place of each vehicle's leader; -1 where it has none."""
        ahead = np.arange(len(self.names)) - 1
        first_on_ramp = self._past + self._main
        if first_on_ramp < len(ahead):
            ahead[first_on_ramp] = self._past - 1
        return ahead

    def gaps(self, leaders: NDArray[np.intp]) -> Floats:
        """Return each vehicle's gap to its leader [m]; `FAR` where it has none."""
        return np.where(leaders < 0, FAR, self.positions[leaders] - self.positions - VEHICLE_LENGTH)

    def on_junction(self, ways: tuple[float, float]) -> NDArray[np.bool_]:
        """Return who is on the ways across the junction, `ways` metres long, that end where both meet."""
        before = np.zeros(len(self.names))
        before[self._past : self._past + self._main] = ways[0]
        before[self._past + self._main :] = ways[1]
        return (self.positions < 0) & (self.positions >= -before)

    def states(self) -> LocalState:
        """Return what all vehicles perceive; who is farther than `LARGEST_GAP` is not there."""
        leaders = self.leaders()
        followers, gaps = self._followers(leaders), self.gaps(leaders)
        behind = self.positions - self.positions[followers] - VEHICLE_LENGTH
        gaps_behind = np.where(followers < 0, FAR, behind)
        return LocalState(
            speed=self.speeds,
            leader_speed=np.where(gaps < LARGEST_GAP, self.speeds[leaders], self.speeds),
            leader_gap=gaps.clip(max=LARGEST_GAP),
            follower_speed=np.where(gaps_behind < LARGEST_GAP, self.speeds[followers], self.speeds),
            follower_gap=gaps_behind.clip(max=LARGEST_GAP),
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


class MergingTraffic(OpenTraffic[MergingRoad]):
    """The actual environment of a merge."""

    def start(self, controlled: bool, on_progress: OnProgress | None = None) -> None:
        """Run the warm-up, then hand the CAVs over."""
        self._streams = Streams()
        super().start(controlled, on_progress)

    def _moved(self, left: Sequence[str], entered: Sequence[str]) -> None:
        streams, simulation = self._streams, self._simulation
        streams.leave(left)
        streams.move(simulation.speeds(streams.names), self.scenario.simulation_step)
        simulation.command_people(entered, self.scenario.right_of_way, self.scenario.bounded)
        origins = self.road.origins
        for name in sorted(entered, key=lambda name: -origins[name].position):  # the foremost first
            streams.enter(name, origins[name], simulation.speeds([name])[0])

    def _command_people(self) -> None:
        """Ask for the speeds of the IDM with noise, except on the junction, where SUMO drives.

        CAVs are asked for too: what they are told in the same step replaces it.
        """
        scenario, streams = self.scenario, self._streams
        leaders = streams.leaders()
        gaps = streams.gaps(leaders).clip(SMALLEST_GAP, None)
        speeds = streams.speeds
        ahead = np.where(leaders < 0, speeds, speeds[leaders])
        humans = scenario.humans
        if self.road.people:
            humans = parameter_rows(self._drivers_of(streams.names))
        acceleration = idm_acceleration(speeds, ahead, gaps, humans)
        acceleration = as_calibrated(scenario.calibrated, acceleration, speeds, ahead, gaps)
        if scenario.noise > 0:
            noise = self._noise_generator.standard_normal(len(speeds))
            acceleration = acceleration + scenario.noise_per_step * noise
        wanted = next_speed(speeds, acceleration, scenario.simulation_step)
        wanted[streams.on_junction(self.road.junctions)] = LEAVE_TO_SUMO
        self._simulation.command_speeds(streams.names, wanted.tolist())

    def _everybody(self) -> tuple[Sequence[str], Floats]:
        return self._streams.names, self._streams.speeds

    def _note_moment(self) -> None:
        self._states_of_all = self._streams.states()

    def _pictured_now(self, names: Sequence[str]) -> dict[str, Any]:
        return {"positions": self._streams.positions, "gaps": self._states_of_all.leader_gap}

    def _states(self, names: Sequence[str]) -> LocalState:
        places = [self._streams.names.index(name) for name in names]
        return self._states_of_all.at(places)

    def record(self, driven: Driven) -> Episode:
        """Return what happened since the start; positions are checked against SUMO's odometer."""
        streams = self._streams
        entered = np.array([self.road.origins[name].position for name in streams.names])
        self._check_odometer(streams.names, entered, streams.positions)
        return super().record(driven)

    def _ahead(self, names: Sequence[str]) -> list[Ahead]:
        if not self.scenario.safety.active:
            return super()._ahead(names)
        states, place_of = self._streams.states(), self._streams.names.index
        near = list(zip(*(values.tolist() for values in states[:3]), strict=True))
        return [Ahead(*near[place_of(name)]) for name in names]

    def _lines(self) -> Floats:
        return network_lines(network_file(self.road.network))

    def _branches(self, vehicles: Sequence[str]) -> Sequence[str]:
        return [BRANCHES[self.road.origins[name].branch] for name in vehicles]
