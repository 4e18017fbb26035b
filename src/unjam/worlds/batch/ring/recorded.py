"""W recorded roads as one world of arrays: platoons behind vehicles that replay recordings."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from unjam.drivers.local_state import LocalState
from unjam.physics.arrays import Array, as_indices, clamp_max, namespace, replace_columns
from unjam.scenarios.road import OrderedRoad
from unjam.scenarios.scenario import Scenario
from unjam.worlds.batch.human_idm import CONTACT_GAP, Leader, human_idm_speed, slow_to_desired_speed
from unjam.worlds.batch.noise import ArrayFactory
from unjam.worlds.batch.ring.world import RingBatch
from unjam.worlds.ordered_road import OrderedRoadLog, as_open_road_state
from unjam.worlds.record import Episode, Floats, common_fields
from unjam.worlds.world import DriverLog


class RecordedBatch(RingBatch):
    """W recorded roads, each with its own seed and recording; episodes equal SUMO's except for rounding."""

    _road_arrays = (*RingBatch._road_arrays, "_next_samples", "_road_ends")

    def __init__(
        self,
        scenarios: Sequence[Scenario],
        seeds: Sequence[Sequence[int]],
        to_array: ArrayFactory = np.asarray,
        **options: Any,
    ) -> None:
        super().__init__(scenarios, seeds, to_array, **options)
        recorded = [np.asarray(road.replayed_speeds) for road in self.roads]
        longest = max(map(len, recorded))
        # After the end of a recording, the road is still simulated, with a constant speed, but no longer recorded.
        padded = [np.pad(speeds, (0, longest - len(speeds)), "edge") for speeds in recorded]
        self._replayed_speeds, self._next_samples = to_array(np.stack(padded, 1)), to_array(np.ones(len(recorded)))
        self._columns = np.arange(len(recorded))
        counts = [(len(speeds) - 1) // scenarios[0].steps_per_control_step for speeds in recorded]
        self._ends = to_array(np.minimum(counts, scenarios[0].horizon).astype(np.float64))
        self._road_ends = to_array(np.array([road.network.edges[0].length for road in self.roads]))
        self._noise_scale[-1] = 0.0
        self._find_contacts = lambda position, gap, loop_length: gap < CONTACT_GAP

    @property
    def is_running(self) -> Array:
        """1 for each road with a running episode, else 0, shape (W,)."""
        return self._is_running

    @property
    def has_ended(self) -> bool:
        """Whether all recordings have ended, or the horizon is reached."""
        return self.control_steps >= float(self._ends.max())

    def exact_state(self) -> LocalState:
        """Return the current local state of the CAVs without sensor errors."""
        return as_open_road_state(super().exact_state())

    @property
    def motion(self) -> Array:
        """A copy of the current speeds [m/s] and positions [m] of all vehicles, shape (W, 2, vehicles)."""
        return namespace(self._speed).stack((self._speed[:-1].T, self._position.T), 1)

    def episode_of(self, road: int, motion: Floats) -> Episode:
        """Return the record of one road without commands, from its `motion` (control steps + 1, 2, vehicles)."""
        drawn_road, scenario = cast(OrderedRoad, self.roads[road]), self.scenario
        speeds, positions = motion.swapaxes(0, 1)
        if scenario.steps_per_control_step > 1:
            scenario = replace(scenario, simulation_step=scenario.control_step, steps_per_control_step=1)
        mean_speeds = np.diff(positions, axis=0) / scenario.control_step
        no_commands = np.zeros((0, len(drawn_road.cav_ids)))
        motion_log = scenario, drawn_road, positions[0], mean_speeds, speeds
        log = OrderedRoadLog(*motion_log, no_commands, no_commands, no_commands)
        fields = common_fields(scenario, drawn_road, (), bool(self.crashed_roads[road]))
        return log.episode((speeds.T, positions.T), fields, DriverLog(), None)

    def replace_roads(self, roads: Any, source: Any, source_roads: Any) -> None:
        """Continue on `roads` with roads of another batch; see `RingBatch.replace_roads`."""
        recordings = self._replayed_speeds, source._replayed_speeds
        samples = np.arange(max(map(len, recordings)))
        target_speeds, source_speeds = (speeds[samples.clip(max=len(speeds) - 1)] for speeds in recordings)
        self._replayed_speeds = replace_columns(target_speeds, roads, source_speeds, source_roads)
        super().replace_roads(roads, source, source_roads)

    def _human_speeds(self, speed: Array, leader: Leader) -> Array:
        if self._human_model is not None:
            return self._human_model(speed, *leader)
        parameters, step = self._human_parameters, self.scenario.simulation_step
        new_speed = human_idm_speed(speed, *leader, parameters, step)
        return slow_to_desired_speed(new_speed, speed, self._road_ends - self._position, parameters, step)

    def _next_speeds(self, speed: Array, leader: Leader, cav_speeds: Array | None) -> tuple[Array, Array]:
        noise_free_speeds, speeds = super()._next_speeds(speed, leader, cav_speeds)
        xp = namespace(speeds)
        replayed = self._replayed_speeds[as_indices(self._next_samples), self._columns][None]
        self._next_samples = clamp_max(self._next_samples + 1.0, len(self._replayed_speeds) - 1.0)
        return xp.concatenate([noise_free_speeds[:-1], replayed]), xp.concatenate([speeds[:-1], replayed])
