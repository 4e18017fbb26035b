"""Traffic on a road with one lane, which has the same vehicles in the same order from the first step to the last.

The inner loop uses lists of floats: after a step of SUMO, the processor's caches are cold, and NumPy is slower.
"""

from collections.abc import Sequence
from itertools import compress
from operator import add
from typing import Any

import numpy as np

from unjam.drivers.car_following import MIN_IDM_GAP
from unjam.drivers.command import Command
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import FollowingState
from unjam.errors import EpisodeError
from unjam.physics.arrays import Array, clamp_min
from unjam.physics.idm import idm_acceleration
from unjam.physics.kinematics import gap_on_loop, next_speed
from unjam.scenarios.population import apply_population
from unjam.scenarios.road import OrderedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.text import format_count
from unjam.worlds import ordered_road
from unjam.worlds.record import Episode, Floats
from unjam.worlds.road_world import RoadScene
from unjam.worlds.sumo.traffic import NO_SPEED_COMMAND, Traffic
from unjam.worlds.world import DriverLog, ProgressCallback


class OrderedTraffic(Traffic[OrderedRoad]):
    """The world in SUMO of a road with one lane and always the same vehicles."""

    def _prepare(self) -> None:
        scenario, simulation, road = self.scenario, self._simulation, self.road
        vehicle_count = len(road.vehicle_ids)
        self.cav_ids, self.entered_count = road.cav_ids, len(road.cav_ids)
        self.is_scalar = self.options.accepts_floats and self.cav_count == 1
        self._collided_vehicles: set[str] = set()
        self._cav_indices = [road.vehicle_ids.index(cav_id) for cav_id in road.cav_ids]
        self._neighbors = ordered_road.loop_neighbors(np.array(self._cav_indices), vehicle_count)
        self._scalar_neighbors = ordered_road.loop_neighbors(self._cav_indices[0], vehicle_count)
        self._commands_humans = scenario.human_control == "commanded"
        self._idm_parameters = self._human_parameters(road.vehicle_ids)
        tracked = range(vehicle_count) if self._commands_humans else np.concatenate(self._neighbors).tolist()
        self._tracked_positions = {index: float(road.start_positions[index]) for index in tracked}
        self._set_human_vehicles(road.vehicle_ids)
        if self._commands_humans:
            simulation.command_humans(road.vehicle_ids, scenario.right_of_way, scenario.enforce_human_limits)
        self._exploration_noise: Any = None
        self._current_state: LocalState | None = None
        self._speeds = simulation.speeds(road.vehicle_ids)
        self._check_all_present()
        self._reset_log()

    def _set_human_vehicles(self, ids: Sequence[str]) -> None:
        self._human_ids = ids
        self._human_mask = [vehicle_id in ids for vehicle_id in self.road.vehicle_ids]
        self._human_indices = [index for index, is_human in enumerate(self._human_mask) if is_human]
        self._noise_rows: list[list[float]] = []

    def _reset_log(self) -> None:
        positions = self.road.start_positions + np.array(self._simulation.distances(self.road.vehicle_ids))
        self._recorder = ordered_road.OrderedRoadRecorder(self.scenario, self.road, positions, self._speeds)
        self._series = self._recorder.series
        self._fuel: list[Sequence[float]] = []

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> LocalState | None:
        """Run the warm-up, and let the driver control the CAVs if `is_controlled`.

        Return the CAVs' states in the last minute of the warm-up, shape (CAVs, times), oldest first, or None.
        """
        scenario, road, history = self.scenario, self.road, None
        self._penetration_rate = road.provided_penetration_rate(self.options.measured_fields)
        self._loop_arguments = road.loop_length, road.crossings, self._penetration_rate
        self._warm_up(self._simulate, on_progress)
        if scenario.warmup and scenario.remember_warmup:
            stride = scenario.steps_per_control_step
            count = round(ordered_road.MAX_RECALL_SECONDS / scenario.control_step)
            steps = list(range(scenario.warmup - stride, -1, -stride))[:count]
            history = ordered_road.loop_state(*self.speeds_and_positions(), self._neighbors, *self._loop_arguments)
            history = history.select(np.s_[:, steps[::-1]])
        self.is_controlled = is_controlled
        if is_controlled:
            self._simulation.take_control(road.cav_ids, scenario.actuation, scenario.right_of_way)
            self._set_human_vehicles([vehicle_id for vehicle_id in road.vehicle_ids if vehicle_id not in road.cav_ids])
        self._reset_log()
        return history

    def exact_state(self) -> LocalState:
        """Return the exact current local state of the CAVs."""
        if self._current_state is None:
            self._current_state = self._compute_state()
        return self._current_state

    def _compute_state(self) -> LocalState:
        tracked = self._tracked_positions
        if self.is_scalar:
            return ordered_road.loop_state(self._speeds, tracked, self._scalar_neighbors, *self._loop_arguments)
        positions = np.full(len(self._speeds), np.nan)
        positions[list(tracked)] = list(tracked.values())
        state = ordered_road.loop_state(np.array(self._speeds), positions, self._neighbors, *self._loop_arguments)
        return state.as_read_only()

    def advance(self, command: Command | None) -> None:
        """Simulate one control step; with the command None, the CAVs drive as human-driven vehicles."""
        self._simulation.check()
        accelerations = self.limited_accelerations(command) if self.is_controlled else []
        self._series["requested_accelerations"].fromlist(accelerations)
        for _ in range(self.scenario.steps_per_control_step):
            if self.is_controlled:
                self._drive_cavs(accelerations)
            self._simulate()
        self.control_steps += 1
        if self.options.record_details:
            self._fuel.append(self._simulation.fuel(self.road.vehicle_ids))

    def _drive_cavs(self, accelerations: list[float]) -> None:
        speeds, positions, step = self._speeds, self._tracked_positions, self.scenario.simulation_step
        loop, last_index, filtered_acceleration = self.road.loop_length, len(speeds) - 1, self.filtered_acceleration
        safe, commanded = [], []
        for cav_id, index, acceleration in zip(self.cav_ids, self._cav_indices, accelerations, strict=True):
            speed, leader = speeds[index], index + 1 if index < last_index else 0
            gap = gap_on_loop(positions[index], positions[leader], loop, VEHICLE_LENGTH)
            state = FollowingState(speed, speeds[leader], gap)
            safe_acceleration, actual = filtered_acceleration(cav_id, acceleration, state)
            safe.append(safe_acceleration)
            commanded.append(next_speed(speed, actual, step))
        self._series["safe_accelerations"].fromlist(safe)
        self._series["commanded_speeds"].fromlist(commanded)
        self._simulation.command_speeds(self.cav_ids, commanded)

    def _simulate(self) -> None:
        """Simulate one step, and add noise to the speeds of human-driven vehicles.

        The formulas of `kinematics` are inlined, as function calls take time.
        """
        simulation, positions, step = self._simulation, self._tracked_positions, self.scenario.simulation_step
        if self._commands_humans:
            self._command_humans()
        simulation.step()
        self._check_all_present()
        speeds = simulation.speeds(self.road.vehicle_ids)
        self._series["noise_free_speeds"].fromlist(speeds)
        for index in positions:
            positions[index] += speeds[index] * step
        if self.scenario.noise > 0 and not self._commands_humans:
            speeds = list(map(add, speeds, self._next_speed_noise()))
            if min(speeds) < 0.0:
                speeds = [0.0 if speed < 0.0 else speed for speed in speeds]
            simulation.replace_speeds(self._human_ids, compress(speeds, self._human_mask))
        self._speeds, self._current_state = speeds, None
        self._series["speeds"].fromlist(speeds)
        if colliding := simulation.colliding_vehicles():
            self._collided_vehicles.update(colliding)
            self.has_crashed = True

    def _check_all_present(self) -> None:
        present, expected = self._simulation.vehicle_count(), len(self.road.vehicle_ids)
        if present != expected:
            raise EpisodeError(f"{format_count(present, 'vehicle')} on the road; expected: {expected}")

    def _command_humans(self) -> None:
        """Command the IDM's speeds with noise, as Flow does, except on a crossing, where SUMO drives."""
        scenario, road, speeds, positions = self.scenario, self.road, self._speeds, self._tracked_positions
        noise = self._next_speed_noise() if scenario.noise > 0 else [0.0] * len(speeds)
        step, loop, crossings = scenario.simulation_step, road.loop_length, road.crossings
        population = scenario.driver_population
        commanded = dict.fromkeys(self._human_indices, NO_SPEED_COMMAND)
        rows: list[tuple[int, float, float, float, float]] = []
        for index in self._human_indices:
            position = positions[index]
            loop_position = position % loop
            for start, end in crossings:  # any() would take as long as the other statements together
                if start <= loop_position < end:
                    break
            else:
                speed, leader = speeds[index], index + 1 if index + 1 < len(speeds) else 0
                gap = clamp_min(gap_on_loop(position, positions[leader], loop, VEHICLE_LENGTH), MIN_IDM_GAP)
                acceleration = idm_acceleration(speed, speeds[leader], gap, self._idm_parameters[index])
                if population is None:
                    commanded[index] = clamp_min(speed + acceleration * step + noise[index], 0.0)
                else:
                    rows.append((index, acceleration, speed, speeds[leader], gap))
        if rows:  # apply the population's network once to all vehicles
            _, *columns = (np.array(column, np.float64) for column in zip(*rows, strict=True))
            accelerations = apply_population(population, *columns).tolist()
            for (index, _, speed, *_), acceleration in zip(rows, accelerations, strict=True):
                commanded[index] = clamp_min(speed + acceleration * step + noise[index], 0.0)
        self._simulation.command_speeds(self._human_ids, commanded.values())

    def noise(self, episode_noise_size: int = 0) -> Array:
        """Return the standard normal noise of this control step, which is drawn for the whole episode at once."""
        if episode_noise_size:
            return super().noise(episode_noise_size)
        if self._exploration_noise is None:
            noise = self._exploration_generator.standard_normal((self.scenario.horizon, len(self.cav_ids)))
            self._exploration_noise = noise[:, 0].tolist() if self.is_scalar else noise
        return self._exploration_noise[self.control_steps]

    def _next_speed_noise(self) -> list[float]:
        """Return the noise of each speed in this step [m/s]; zero for CAVs."""
        if not self._noise_rows:
            draws = self.noise_generator.standard_normal((ordered_road.NOISE_BLOCK_STEPS, len(self._human_mask)))
            scale = self.scenario.noise_per_step * self.scenario.simulation_step
            self._noise_rows = (draws * np.where(self._human_mask, scale, 0.0)).tolist()[::-1]
        return self._noise_rows.pop()

    def _make_log(self) -> ordered_road.OrderedRoadLog:
        fuel = np.array(self._fuel) if self.options.record_details else np.zeros((0, 0))
        rate = self._penetration_rate
        return self._recorder.make_log(has_crashed=self.has_crashed, fuel=fuel, penetration_rate=rate)

    def speeds_and_positions(self) -> tuple[Floats, Floats]:
        """Return speeds and positions in every simulation step, after a check against SUMO's odometer."""
        speeds, positions = self._make_log().speeds_and_positions()
        self._check_odometer(self.road.vehicle_ids, self.road.start_positions, positions[:, -1])
        return speeds, positions

    def record_so_far(self) -> Episode:
        """Return the record so far without the decisions of the driver; SUMO continues."""
        return self._make_record(DriverLog())

    def _make_record(self, driver_log: DriverLog) -> Episode:
        fields = {**self.record_fields(), "collisions": len(self._collided_vehicles)}
        rows = None if self.is_scalar else np.arange(len(self.cav_ids))
        return self._make_log().episode(self.speeds_and_positions(), fields, driver_log, rows)

    def last_applied_acceleration(self) -> Array:
        """Return the CAVs' accelerations in the last control step, as `RoadWorld.last_applied_acceleration` does."""
        if self.is_scalar and self.scenario.steps_per_control_step == 1:
            return self._series["safe_accelerations"][-1]
        return self._recorder.last_applied_acceleration()

    @property
    def speeds(self) -> Sequence[float]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Current speeds of all vehicles with a driver [m/s]."""
        speeds = self._series["speeds"][-len(self._speeds) :]  # an array, which NumPy reads faster than a list
        return speeds[: self.road.driven_count]

    def scene(self) -> RoadScene:
        """Return the current state of the road for pictures."""
        self._simulation.check()
        positions = self.road.start_positions + np.array(self._simulation.distances(self.road.vehicle_ids))
        return ordered_road.ordered_scene(self.road, positions, self._speeds)


class RecordedTraffic(OrderedTraffic):
    """The world in SUMO of a recorded road, on which the first vehicle replays a recording."""

    def _prepare(self) -> None:
        *_, self._replayed_id = self.road.vehicle_ids
        self._upcoming_speeds = np.asarray(self.road.replayed_speeds)[:0:-1].tolist()
        # Set speeds after the insertion: SUMO inserts no vehicle above its desired speed.
        ids = self.road.vehicle_ids
        self._simulation.replace_speeds(ids, [self.road.start_speed] * len(ids))
        self._simulation.replay(self._replayed_id, self.scenario.top_speed)
        super()._prepare()

    def _set_human_vehicles(self, ids: Sequence[str]) -> None:
        super()._set_human_vehicles([vehicle_id for vehicle_id in ids if vehicle_id != self._replayed_id])

    @property
    def has_ended(self) -> bool:
        """Whether the recording or the horizon has ended, or the episode has ended early."""
        return super().has_ended or len(self._upcoming_speeds) < self.scenario.steps_per_control_step

    def _simulate(self) -> None:
        self._simulation.command_speeds([self._replayed_id], [self._upcoming_speeds.pop()])
        super()._simulate()
