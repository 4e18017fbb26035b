"""The base class of all worlds in SUMO."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Generic, TypeVar

import numpy as np

from unjam.errors import EpisodeError
from unjam.physics.idm import IDMParameters
from unjam.scenarios.road import OpenRoad, Road
from unjam.scenarios.scenario import Scenario, sumo_seed
from unjam.worlds.backend import WorldOptions
from unjam.worlds.record import Episode, Floats
from unjam.worlds.road_world import DrawnRoad, SimulatedRoad
from unjam.worlds.sumo.inputs import SumoInputs, single_lane_inputs
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.world import DriverLog, ProgressCallback

ODOMETER_TOLERANCE = 1e-6
"""allowed difference between positions and SUMO's odometer at the end of an episode [m]"""
ODOMETER_RELATIVE_TOLERANCE = 1e-10
"""the same, relative to the distance driven: sums of many steps have rounding errors"""
WARMUP_PROGRESS_STEPS = 10
"""steps of the warm-up between two reports of progress"""
NO_SPEED_COMMAND = -1.0
"""speed by which SUMO takes control of a vehicle again"""

RoadT = TypeVar("RoadT", bound=Road)
OpenRoadT = TypeVar("OpenRoadT", bound=OpenRoad)


class Traffic(SimulatedRoad, Generic[RoadT]):
    """The world of a road in SUMO."""

    road: RoadT  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(
        self,
        scenario: Scenario,
        seed: Sequence[int],
        simulation: Simulation,
        options: WorldOptions,
        drawn: DrawnRoad | None = None,
    ) -> None:
        super().__init__(scenario, seed, drawn)
        self.options, self._simulation = options, simulation
        simulation.load(self.inputs(scenario, self.road), scenario.simulation_step, sumo_seed(self.seed))
        self._prepare()

    def _prepare(self) -> None:
        """Create the attributes that this kind of road needs in addition."""

    @staticmethod
    def inputs(scenario: Scenario, road: Any) -> SumoInputs:
        """Return SUMO's input files and options for a road."""
        return single_lane_inputs(scenario, road)

    def _warm_up(self, simulate: Callable[[], None], on_progress: ProgressCallback | None) -> None:
        """Simulate human-only traffic; raise `EpisodeError` if it collides or SUMO stops."""
        for step in range(self.scenario.warmup):
            simulate()
            if self.has_crashed or self.stop_reason:
                reason = self.stop_reason or "collision"
                raise EpisodeError(f"{reason} in step {step} of the all-human warm-up")
            if on_progress is not None and step % WARMUP_PROGRESS_STEPS == 0:
                on_progress(0)

    def _human_parameters(self, ids: Sequence[str]) -> list[IDMParameters]:
        return [self.road.human_parameters.get(vehicle_id, self.scenario.humans) for vehicle_id in ids]

    def _check_odometer(self, ids: Sequence[str], start_positions: Floats, positions: Floats) -> None:
        """Raise `EpisodeError` if positions differ from the start positions plus SUMO's odometer [m]."""
        error = np.abs(start_positions + np.array(self._simulation.distances(ids)) - positions).max(initial=0.0)
        if error > max(ODOMETER_TOLERANCE, ODOMETER_RELATIVE_TOLERANCE * positions.max(initial=0.0)):
            raise EpisodeError(f"positions differ from SUMO's odometer by {error:.2g} m")

    def record(self, driver_log: DriverLog) -> Episode:
        """Return the record of the episode with SUMO's warnings; this ends SUMO."""
        self._simulation.check()
        episode = self._make_record(driver_log)
        return replace(episode, warnings=self._simulation.finish())

    def _make_record(self, driver_log: DriverLog) -> Episode:
        """Return the record of the episode without warnings."""
        raise NotImplementedError
