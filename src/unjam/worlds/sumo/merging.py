"""Traffic of a main road that a ramp joins: people are commanded, and neighbours computed from positions."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from unjam.drivers.car_following import SMALLEST_GAP
from unjam.drivers.local_state import LocalState
from unjam.errors import EpisodeError
from unjam.physics.idm import idm_acceleration, parameter_rows
from unjam.physics.kinematics import next_speed
from unjam.scenarios.population import as_calibrated
from unjam.scenarios.road import MergingRoad
from unjam.scenarios.scenario import Scenario
from unjam.worlds.record import Episode
from unjam.worlds.sumo.files import Files, files_of_built
from unjam.worlds.sumo.network_files import network_file, network_lines
from unjam.worlds.sumo.open import OpenTraffic
from unjam.worlds.sumo.people import LEAVE_TO_SUMO, drivers_of
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.streams import Streams
from unjam.worlds.sumo.traffic import Floats, Seed
from unjam.worlds.world import Driven

BRANCHES = ("highway", "ramp")
ODOMETER_TOLERANCE = 1e-6
"""by how much positions may differ from SUMO's odometer [m]"""


class MergingTraffic(OpenTraffic[MergingRoad]):
    """The actual environment of a merge."""

    def __init__(
        self, scenario: Scenario, road: MergingRoad, seed: Seed, simulation: Simulation, full: bool
    ) -> None:
        """Put the first vehicles on the road; nothing moves yet."""
        super().__init__(scenario, road, seed, simulation, full)
        self._streams = Streams()

    def _files(self) -> Files:
        return files_of_built(self.scenario, self.road)

    def _is_cav(self, name: str) -> bool:
        return name in self.road.cav_ids

    @property
    def expects_cavs(self) -> bool:
        """Whether a CAV may still enter: not all that ever will have."""
        return self.entered < len(self.road.cav_ids)

    def _moved(self, left: Sequence[str], entered: Sequence[str]) -> None:
        streams, simulation = self._streams, self._simulation
        streams.leave(left)
        streams.move(simulation.speeds(streams.names), self.scenario.simulation_step)
        simulation.command_people(entered, self.scenario.right_of_way)
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
            humans = parameter_rows(drivers_of(scenario, self.road, streams.names))
        acceleration = idm_acceleration(speeds, ahead, gaps, humans)
        acceleration = as_calibrated(scenario.calibrated, acceleration, speeds, ahead, gaps)
        if scenario.noise > 0:
            noise = self._noise_generator.standard_normal(len(speeds))
            acceleration = acceleration + scenario.noise_per_step * noise
        wanted = next_speed(speeds, acceleration, scenario.simulation_step)
        wanted[streams.on_junction(self.road.junctions)] = LEAVE_TO_SUMO
        self._simulation.command_speeds(streams.names, wanted.tolist())

    def _moment(self) -> tuple[Sequence[str], Sequence[float], Sequence[float], Sequence[float]]:
        streams = self._streams
        self._states_of_all = states = streams.states()
        names, positions = list(streams.names), streams.positions.tolist()
        return names, streams.speeds.tolist(), positions, states.leader_gap.tolist()

    def _states(self, names: Sequence[str]) -> LocalState:
        places = [self._streams.names.index(name) for name in names]
        return self._states_of_all.each(lambda values: values[places])

    def record(self, driven: Driven) -> Episode:
        """Return what happened since the start; positions are checked against SUMO's odometer."""
        streams = self._streams
        entered = np.array([self.road.origins[name].position for name in streams.names])
        odometer = np.array(self._simulation.distances(streams.names))
        error = float(np.abs(entered + odometer - streams.positions).max(initial=0.0))
        if error > ODOMETER_TOLERANCE:
            raise EpisodeError(f"positions differ from SUMO's odometer by {error:.2g} m")
        return super().record(driven)

    def _lines(self) -> Floats:
        return network_lines(network_file(self.road.network))

    def _pictured(self, vehicles: Sequence[str]) -> dict[str, Any]:
        branches = tuple(BRANCHES[self.road.origins[name].branch] for name in vehicles)
        lines = self._lines() if self.full else np.zeros((0, 2))
        return {"branches": branches, "lines": lines}
