"""Traffic on a closed road: the same vehicles in the same order from the first step to the last.

The inner loop works on lists of plain floats. Between two steps of SUMO the caches are cold, and a NumPy
call on 22 numbers then costs more than a list comprehension.
"""

from array import array
from collections.abc import Sequence
from itertools import compress
from operator import add
from typing import Any

import numpy as np

from unjam.drivers.car_following import _MIN_GAP
from unjam.drivers.command import Command
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import FollowingState
from unjam.errors import EpisodeError
from unjam.physics.arrays import Array, clamp_min
from unjam.physics.idm import idm_acceleration
from unjam.physics.kinematics import gap_on_loop, next_speed
from unjam.scenarios.population import apply_population
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario
from unjam.worlds.closed_road import (
    MAX_RECALL_SECONDS,
    NOISE_BLOCK_STEPS,
    ClosedRoadLog,
    loop_neighbors,
    loop_state,
    poses_along,
)
from unjam.worlds.record import Episode, Floats
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.traffic import NO_SPEED_COMMAND, RoadScene, SeedTree, Traffic
from unjam.worlds.world import DriverLog, ProgressCallback


class ClosedTraffic(Traffic[ClosedRoad]):
    """The actual environment of a closed road."""

    def __init__(
        self, scenario: Scenario, road: ClosedRoad, seed: SeedTree, simulation: Simulation, record_details: bool
    ) -> None:
        """Put the vehicles on the road; nothing moves yet."""
        super().__init__(scenario, road, seed, simulation, record_details)
        vehicles = len(road.vehicle_ids)
        self.cav_ids, self.entered_count = road.cav_ids, len(road.cav_ids)
        self._collided_vehicles: set[str] = set()
        """who was in contact with another"""
        self._cav_indices = [road.vehicle_ids.index(name) for name in road.cav_ids]
        """of the CAVs, in road order"""
        self._neighbors = loop_neighbors(np.array(self._cav_indices), vehicles)
        self._scalar_neighbors = loop_neighbors(self._cav_indices[0], vehicles)
        self._loop_arguments: Any = road.loop_length, road.crossings
        self._commands_humans = scenario.human_control == "commanded"
        self._idm_parameters = self._human_parameters(road.vehicle_ids)
        needed = range(vehicles) if self._commands_humans else np.concatenate(self._neighbors).tolist()
        self._tracked_positions = {place: float(road.start_positions[place]) for place in needed}
        self._set_human_vehicles(road.vehicle_ids)
        if self._commands_humans:
            simulation.command_humans(road.vehicle_ids, scenario.right_of_way, scenario.enforce_human_limits)
        self._exploration_noise: Any = None
        self.speeds = simulation.speeds(road.vehicle_ids)
        self._check_all_present()
        self._reset_log()

    def _set_human_vehicles(self, ids: Sequence[str]) -> None:
        """Let `ids` be those whose driving has noise, from the next step on."""
        self._human_ids = ids
        self._human_mask = [name in ids for name in self.road.vehicle_ids]
        self._human_indices = [place for place, human in enumerate(self._human_mask) if human]
        self._noise_rows: list[list[float]] = []

    def _reset_log(self) -> None:
        """Begin the log anew."""
        self._logged_noise_free_speeds = array("d")  # speeds with which the vehicles moved, before noise; row after row
        self._logged_speeds = array("d", self.speeds)
        self._start_distances = self._simulation.distances(self.road.vehicle_ids)
        self.logged_fuel = []
        self._logged_requested_accelerations = array("d")
        self._logged_safe_accelerations = array("d")  # of each CAV in each simulation step
        self._logged_commanded_speeds = array("d")

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> LocalState | None:
        """Run the warm-up, then hand the CAVs over, unless they stay human (`controlled` false).

        Returns:
            What the CAVs perceived in the last minute of the warm-up at the times of decisions, shape
            (CAVs, moments), oldest first; None without a warm-up that may be remembered.
        """
        scenario, history = self.scenario, None
        self._loop_arguments = (
            self.road.loop_length,
            self.road.crossings,
            self.road.provided_penetration_rate(self.measured_fields),
        )
        self._warm_up(self._simulate, on_progress)
        if scenario.warmup and scenario.remember_warmup:
            each = scenario.steps_per_control_step
            moments = list(range(scenario.warmup - each, -1, -each))[
                : round(MAX_RECALL_SECONDS / scenario.control_step)
            ]
            states = loop_state(*self.speeds_and_positions(), self._neighbors, *self._loop_arguments)
            history = states.select(np.s_[:, moments[::-1]])
        self._is_controlled = is_controlled
        if is_controlled:
            self._simulation.take_control(self.road.cav_ids, scenario.actuation, scenario.right_of_way)
            self._set_human_vehicles([name for name in self.road.vehicle_ids if name not in self.road.cav_ids])
        self._reset_log()
        return history

    def positions(self) -> Floats:
        """Return where the front bumpers of all vehicles are now along the road, not wrapped [m]."""
        return self.road.start_positions + np.array(self._simulation.distances(self.road.vehicle_ids))

    def exact_state(self) -> LocalState:
        """Return what exact sensors of the CAVs would read now."""
        near = self._tracked_positions
        if self.is_scalar:
            return loop_state(self.speeds, near, self._scalar_neighbors, *self._loop_arguments)
        positions = np.full(len(self.speeds), np.nan)
        positions[list(near)] = list(near.values())
        return loop_state(np.array(self.speeds), positions, self._neighbors, *self._loop_arguments).as_read_only()

    def advance(self, command: Command | None) -> None:
        """Simulate one decision, held over its simulation steps; None: the CAVs stay human."""
        self._simulation.check()
        wanted = self._limited_accelerations(command) if self._is_controlled else []
        self._logged_requested_accelerations.fromlist(wanted)
        for _ in range(self.scenario.steps_per_control_step):
            if self._is_controlled:
                self._drive_cavs(wanted)
            self._simulate()
        self.control_steps += 1
        if self.record_details:
            self.logged_fuel.append(self._simulation.fuel(self.road.vehicle_ids))

    def _drive_cavs(self, accelerations: list[float]) -> None:
        """Ask for the speeds that the CAVs' accelerations lead to in this step, once they are filtered."""
        speeds, near, step = self.speeds, self._tracked_positions, self.scenario.simulation_step
        loop, last, carry_out = self.road.loop_length, len(speeds) - 1, self._apply_acceleration
        told, commanded = [], []
        for name, place, acceleration in zip(self.cav_ids, self._cav_indices, accelerations, strict=True):
            speed, leader = speeds[place], place + 1 if place < last else 0
            gap = gap_on_loop(near[place], near[leader], loop, VEHICLE_LENGTH)
            allowed, done = carry_out(name, acceleration, FollowingState(speed, speeds[leader], gap))
            told.append(allowed)
            commanded.append(next_speed(speed, done, step))
        self._logged_safe_accelerations.fromlist(told)
        self._logged_commanded_speeds.fromlist(commanded)
        self._simulation.command_speeds(self.cav_ids, commanded)

    def _simulate(self) -> None:
        """Simulate one step, and add the humans' noise to their speeds.

        Two formulas of `physics.kinematics` are written out here: calls would cost a tenth of the episode.
        """
        simulation, near, step = self._simulation, self._tracked_positions, self.scenario.simulation_step
        if self._commands_humans:
            self._command_humans()
        simulation.step()
        self._check_all_present()
        speeds = simulation.speeds(self.road.vehicle_ids)
        self._logged_noise_free_speeds.fromlist(speeds)
        for place in near:
            near[place] += speeds[place] * step
        if self.scenario.noise > 0 and not self._commands_humans:
            speeds = list(map(add, speeds, self._next_speed_noise()))
            if min(speeds) < 0.0:
                speeds = [clamp_min(speed, 0.0) for speed in speeds]
            simulation.replace_speeds(self._human_ids, compress(speeds, self._human_mask))
        self.speeds = speeds
        self._logged_speeds.fromlist(speeds)
        if colliding := simulation.colliding_vehicles():
            self._collided_vehicles.update(colliding)
            self.has_crashed = True

    def _check_all_present(self) -> None:
        """Raise `EpisodeError` where not all vehicles are on the road."""
        present, wanted = self._simulation.vehicle_count(), len(self.road.vehicle_ids)
        if present != wanted:
            raise EpisodeError(f"{present} vehicles on the road where {wanted} should be")

    def _command_humans(self) -> None:
        """Ask for the speeds that people want: IDM with noise, as Flow does it; on a crossing SUMO drives."""
        scenario, road, speeds, positions = self.scenario, self.road, self.speeds, self._tracked_positions
        noise = self._next_speed_noise() if scenario.noise > 0 else [0.0] * len(speeds)
        step, loop, crossings = scenario.simulation_step, road.loop_length, road.crossings
        population = scenario.driver_population
        wanted = dict.fromkeys(self._human_indices, NO_SPEED_COMMAND)
        seen: list[tuple[int, float, float, float, float]] = []
        for place in self._human_indices:
            position = positions[place]
            on_road = position % loop
            for start, end in crossings:  # any() would cost as much as the rest
                if start <= on_road < end:
                    break
            else:
                speed, ahead = speeds[place], place + 1 if place + 1 < len(speeds) else 0
                gap = clamp_min(gap_on_loop(position, positions[ahead], loop, VEHICLE_LENGTH), _MIN_GAP)
                acceleration = idm_acceleration(speed, speeds[ahead], gap, self._idm_parameters[place])
                if population is None:
                    wanted[place] = clamp_min(speed + acceleration * step + noise[place], 0.0)
                else:
                    seen.append((place, acceleration, speed, speeds[ahead], gap))
        if seen:  # a population's network is asked once for all
            _, *columns = (np.array(column, np.float64) for column in zip(*seen, strict=True))
            accelerations = apply_population(population, *columns).tolist()
            for (place, _, speed, *_), acceleration in zip(seen, accelerations, strict=True):
                wanted[place] = clamp_min(speed + acceleration * step + noise[place], 0.0)
        self._simulation.command_speeds(self._human_ids, wanted.values())

    def noise(self, episode_noise_size: int = 0) -> Array:
        """Return standard normal noise of this decision, drawn for the whole episode at once."""
        if episode_noise_size:
            return super().noise(episode_noise_size)
        if self._exploration_noise is None:
            drawn = self._exploration_generator.standard_normal((self.scenario.horizon, len(self.cav_ids)))
            self._exploration_noise = drawn[:, 0].tolist() if self.is_scalar else drawn
        return self._exploration_noise[self.control_steps]

    def _next_speed_noise(self) -> list[float]:
        """Return by how much noise changes each speed in this step, not at all for CAVs [m/s]."""
        if not self._noise_rows:
            draws = self._noise_generator.standard_normal((NOISE_BLOCK_STEPS, len(self._human_mask)))
            scale = self.scenario.noise_per_step * self.scenario.simulation_step
            self._noise_rows = (draws * np.where(self._human_mask, scale, 0.0)).tolist()[::-1]
        return self._noise_rows.pop()

    def _make_log(self) -> ClosedRoadLog:
        """Return what was logged since the log began."""
        vehicles, cavs = len(self._human_mask), len(self.cav_ids)
        return ClosedRoadLog(
            scenario=self.scenario,
            road=self.road,
            start_positions=self.road.start_positions + np.array(self._start_distances),
            noise_free_speeds=np.array(self._logged_noise_free_speeds).reshape(-1, vehicles),
            speeds=np.array(self._logged_speeds).reshape(-1, vehicles),
            requested_accelerations=np.array(self._logged_requested_accelerations).reshape(-1, cavs),
            safe_accelerations=np.array(self._logged_safe_accelerations).reshape(-1, cavs),
            commanded_speeds=np.array(self._logged_commanded_speeds).reshape(-1, cavs),
            has_crashed=self.has_crashed,
            fuel=np.array(self.logged_fuel) if self.record_details else np.zeros((0, 0)),
            penetration_rate=self.road.provided_penetration_rate(self.measured_fields),
        )

    def speeds_and_positions(self) -> tuple[Floats, Floats]:
        """Return speeds [m/s] and positions [m] in every simulation step since the log began.

        Shape (vehicles, moments), the first moment being the start.

        Positions are SUMO's Euler step over the recorded speeds, checked against SUMO's own odometer.
        """
        return self._validated_series(self._make_log())

    def record(self, driver_log: DriverLog) -> Episode:
        """Return what happened since the start."""
        log, rows = self._make_log(), None if self.is_scalar else np.arange(len(self.cav_ids))
        facts = {**self._common_fields(), "collisions": len(self._collided_vehicles)}
        return log.episode(self._validated_series(log), facts, driver_log, rows)

    def _validated_series(self, log: ClosedRoadLog) -> tuple[Floats, Floats]:
        speeds, positions = log.speeds_and_positions()
        self._check_odometer(self.road.vehicle_ids, self.road.start_positions, positions[:, -1])
        return speeds, positions

    def last_applied_acceleration(self) -> Floats:
        """Return what the CAVs were told in the last decision, once it was filtered [m/s2], shape (CAVs,)."""
        told = np.array(self._logged_safe_accelerations[-len(self.cav_ids) * self.scenario.steps_per_control_step :])
        return told.reshape(-1, len(self.cav_ids)).mean(0)

    def scene(self) -> RoadScene:
        """Return this moment as pictures show it."""
        outline, loop = self.road.center_line, self.road.loop_length
        places, cavs = self.positions(), np.isin(np.arange(len(self.speeds)), self._cav_indices)
        return RoadScene(outline[:, 1:], poses_along(outline, places, loop), np.array(self.speeds), cavs)
