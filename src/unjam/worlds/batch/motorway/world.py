"""W motorways as one world, where CAVs reduce the set speeds of their own ACCs; rows of CAVs are in order of entry."""

from collections.abc import Collection, Sequence
from typing import NamedTuple, Self, cast

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.command import Command, batch_commanded_accelerations, commanded_time_gaps
from unjam.drivers.local_state import LocalState
from unjam.drivers.roadside import MeasuredVehicles, RoadSections, RoadsideMessages, SpeedMeasurement
from unjam.errors import InputError
from unjam.physics.arrays import Array, Floats, replace_padded_rows
from unjam.physics.kinematics import next_speed
from unjam.scenarios.motorway import Motorway
from unjam.scenarios.motorway_road import MotorwayRoad
from unjam.worlds.batch.human_idm import CONTACT_GAP
from unjam.worlds.batch.motorway.record import NO_END_STEP, MotorwayLog
from unjam.worlds.batch.motorway.traffic import NO_SPEED_CAP, BatchMotorways, LearnedCorrection, enable_acc
from unjam.worlds.batch.motorway.vehicles import KEYS_PER_ROAD, find_rows, vehicle_keys
from unjam.worlds.batch.noise import ArrayFactory, DrawNormal
from unjam.worlds.lane_neighbors import neighbors_on_lane, observe_lane
from unjam.worlds.record import Episode
from unjam.worlds.reward import Outcome, time_gap
from unjam.worlds.worker_pool import EpisodeTask
from unjam.worlds.world import DriverLog, ProgressCallback


class ReplayOptions(NamedTuple):
    """Options of a replay, in which the vehicles of an episode enter at the same times again."""

    seeds: Sequence[tuple[Sequence[int], Sequence[int]]]
    """seeds of the drivers' errors and of exploration, for each road"""
    control_steps: int
    """number of control steps after which the replay ends"""
    has_driver_errors: bool
    correction: LearnedCorrection | None


class MotorwayBatch:
    """W motorways of one scenario, each with its own seed; episodes equal SUMO's in distribution."""

    is_scalar = False
    measured_fields: Collection[str] = ()
    """names of the optional fields of `LocalState` that the driver reads"""
    remaining_rows: Sequence[int] | None = None

    def __init__(
        self,
        scenario: Motorway,
        seeds: Sequence[Sequence[int]],
        explore: Sequence[float] | None = None,
        replay: ReplayOptions | None = None,
        keep_record: bool = True,
        draw: DrawNormal | None = None,
    ) -> None:
        """Start with one empty road for each seed; with `keep_record`, 1,000 control steps of a road take 10 MB.

        `explore` scales the exploration noise of each road. With `draw`, which then draws the noise of the drivers on
        all roads, vehicles have single precision.
        """
        self._exploration_scales = np.ones(len(seeds)) if explore is None else np.array(explore)
        self.scenario, self._seeds, self._replay, self._keep_record = scenario, seeds, replay, keep_record
        drawn_roads = [scenario.draw_from_seed(seed) for seed in seeds]
        self.roads = [cast(MotorwayRoad, road) for road, _ in drawn_roads]
        generator_seeds = [road_seeds[:2] for _, road_seeds in drawn_roads] if replay is None else replay.seeds
        self._human_generators, self._exploration_generators = (
            [np.random.default_rng(seed) for seed in seeds_of_kind]
            for seeds_of_kind in zip(*generator_seeds, strict=True)
        )
        self._draw = draw
        precision = np.float64 if draw is None else np.float32
        options = replay and replay.correction, scenario.steps_per_control_step, precision
        self._traffic = BatchMotorways(self.roads, scenario.simulation_step, self._draw_errors, *options)
        self._is_cav = np.zeros((len(seeds), max(len(road.entries) for road in self.roads)), bool)
        for index, road in enumerate(self.roads):
            self._is_cav[index, : len(road.entries)] = [entry.name in road.cav_ids for entry in road.entries]
        geometry, roadside, control_step = self.roads[0].geometry, self.roads[0].roadside, scenario.control_step
        self._road_sections = RoadSections(geometry.lane_count + 1, geometry.length, len(seeds))
        self._measurement = SpeedMeasurement(roadside, self._road_sections, geometry.speed_limit, control_step)
        self._messages = RoadsideMessages(roadside, control_step, self._human_generators[0])
        self.limits, self.control_steps = scenario.acceleration_limits, 0
        self.entered_count, self.cav_count = 0, 0
        self._cav_keys: NDArray[np.intp] = np.zeros(0, np.intp)
        """key of each CAV on a road, in order of entry; see `vehicle_keys`"""
        self._cav_entry_counts = np.zeros(len(seeds))
        self._start_steps = np.zeros(len(seeds), np.intp)
        """number of control steps of the batch before the start of the episode of each road"""
        self.backlogs = np.zeros(len(seeds), np.intp)
        self._previous_cav_speeds = np.zeros(0)
        self._is_controlled, self._has_time_gap_commands = False, False
        self._episode_noise: Floats | None = None
        self._log = MotorwayLog(self.roads, scenario)

    def _draw_errors(self, shape: tuple[int, ...]) -> Floats:
        """Return noise for the errors of all drivers in this step; without `draw`, each road has its own generator."""
        if self._replay is not None and not self._replay.has_driver_errors:
            return np.zeros(shape)
        if self._draw is not None:
            return self._draw(shape)
        counts = np.bincount(self._traffic.vehicles.road, minlength=len(self.roads)).tolist()
        generators = zip(self._human_generators, counts, strict=True)
        return np.concatenate([generator.standard_normal((shape[0], count)) for generator, count in generators], 1)

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> None:
        """Start with empty roads, without a history."""
        self._is_controlled = is_controlled
        self._update_cavs()

    @classmethod
    def from_tasks(cls, tasks: Sequence[EpisodeTask], to_array: ArrayFactory) -> Self:
        """Return a batch with the roads of tasks; raise `InputError` for arrays other than NumPy's."""
        if to_array is not np.asarray:
            raise InputError("to_array: batches of motorways are NumPy's; allowed: numpy.asarray")
        scenario, explore = cast(Motorway, tasks[0].scenario), [task.explore for task in tasks]
        return cls(scenario, [task.seed for task in tasks], explore=explore)

    @property
    def cav_roads(self) -> NDArray[np.intp]:
        """Index of the road of each CAV, shape (CAVs,)."""
        return self._cav_keys // KEYS_PER_ROAD

    def values_of_cavs(self, values: Array) -> Array:
        """Return the value of the road of each CAV, given values of shape (W,)."""
        return values[self.cav_roads]

    @property
    def has_ended(self) -> bool:
        """Whether the horizon is reached."""
        return self.control_steps >= (self.scenario.horizon if self._replay is None else self._replay.control_steps)

    @property
    def crashed_roads(self) -> NDArray[np.bool_]:
        """Whether vehicles have touched on each road, shape (W,)."""
        return self._log.end_steps < NO_END_STEP

    @property
    def control_step_counts(self) -> NDArray[np.intp]:
        """Number of control steps in the episode of each road, shape (W,)."""
        return self.control_steps - self._start_steps

    @property
    def completed_roads(self) -> NDArray[np.bool_]:
        """Whether each road has reached its horizon, or will have no further CAV, shape (W,)."""
        cav_counts = np.bincount(self.cav_roads, minlength=len(self.roads))
        has_no_further_cav = (cav_counts == 0) & (self._cav_entry_counts == self._is_cav.sum(1))
        return has_no_further_cav | (self.control_step_counts >= self.scenario.horizon)

    @property
    def entry_counts(self) -> NDArray[np.intp]:
        """Number of vehicles that have entered each road, shape (W,)."""
        return self._traffic.insertion_queue.entry_counts

    def replace_roads(self, roads: Sequence[int], source: Self, source_roads: Sequence[int]) -> None:
        """Continue on `roads` with empty `source_roads` of another batch that has just been started.

        Both batches keep no record and have the same scenario without detectors, whose intervals all roads share.
        """
        rows = np.flatnonzero(~np.isin(self.cav_roads, roads))
        self._cav_keys, self.cav_count = self._cav_keys[rows], len(rows)
        self._local_state = self._local_state.select(rows).as_read_only()
        for road, source_road in zip(roads, source_roads, strict=True):
            self.roads[road] = source.roads[source_road]
            self._human_generators[road] = source._human_generators[source_road]
            self._exploration_generators[road] = source._exploration_generators[source_road]
        self._is_cav = replace_padded_rows(self._is_cav, roads, source._is_cav, source_roads, False)
        self._cav_entry_counts[roads], self._start_steps[roads] = 0.0, self.control_steps
        self._log.end_steps[roads], self.backlogs[roads] = NO_END_STEP, 0
        self._traffic.replace_roads(roads, source._traffic, source_roads)
        self._measurement.clear_roads(roads)
        self._messages.replace_roads(roads, source._messages, source_roads)

    def local_state(self) -> LocalState:
        """Return the state that the CAVs observe, arrays of shape (CAVs,)."""
        return self._local_state

    def advance(self, command: Command | None) -> None:
        """Simulate one control step with a constant command; without a command the CAVs stay human."""
        scenario, traffic, accelerations = self.scenario, self._traffic, None
        self._previous_cav_speeds = self._local_state.speed
        if self._is_controlled:
            accelerations = batch_commanded_accelerations(command, self.limits, self.cav_count, self.control_steps)
            self._set_time_gaps(command)
        for _ in range(scenario.steps_per_control_step):
            if accelerations is not None:
                self._apply_set_speeds(np.asarray(accelerations))
            arrived = traffic.step()
            if not self._keep_record:
                continue
            vehicles = traffic.vehicles
            leader_rows = neighbors_on_lane(traffic.neighbors.leaders, vehicles.lane)
            cav_rows = self._cav_rows()
            cav_rows = cav_rows[(cav_rows >= 0) & self._is_controlled]
            self._log.record_step(vehicles, leader_rows, arrived, cav_rows)
        self.control_steps += 1
        self._update_cavs()

    def _cav_rows(self) -> NDArray[np.intp]:
        """Return the rows of the CAVs among the vehicles; `NO_VEHICLE` for those that have left."""
        vehicles = self._traffic.vehicles
        return find_rows(self._cav_keys, vehicles, np.flatnonzero(self._is_cav[vehicles.road, vehicles.entry]))

    def _set_time_gaps(self, command: Command | None) -> None:
        """Set the time gaps of the CAVs' ACCs from the first such command on; the scenario has the default."""
        self._has_time_gap_commands |= command is not None and command.time_gap is not None
        if self._has_time_gap_commands:
            labels = [str(key) for key in self._cav_keys]
            time_gaps = commanded_time_gaps(command, self.scenario.cruise.time_gap, labels, self.control_steps)
            rows = self._cav_rows()
            self._traffic.vehicles = self._traffic.vehicles.replace_rows(rows, time_headway=time_gaps)

    def _apply_set_speeds(self, accelerations: Floats) -> None:
        """Set the set speed of the ACC of each CAV, without a cap in merging sections."""
        vehicles, geometry, step = self._traffic.vehicles, self._traffic.geometry, self.scenario.simulation_step
        rows = self._cav_rows()
        is_present = rows >= 0
        rows, accelerations = rows[is_present], accelerations[is_present]
        speed = vehicles.speed[rows]
        commanded = next_speed(speed, accelerations, step)
        set_speed = self.scenario.cruise.set_speed(speed, commanded, self.limits.highest, step)
        is_merging = geometry.sections(vehicles.lane[rows], vehicles.position[rows]).is_merging
        cap = np.where(is_merging, NO_SPEED_CAP, np.minimum(set_speed, NO_SPEED_CAP))
        self._traffic.vehicles = vehicles.replace_rows(rows, speed_cap=cap)

    def _update_cavs(self) -> None:
        """Hand new CAVs to their driver, measure the CAVs' states, and record the vehicles after a control step."""
        traffic, vehicles = self._traffic, self._traffic.vehicles
        is_cav = self._is_cav[vehicles.road, vehicles.entry]
        cav_rows = np.flatnonzero(is_cav)
        remains = find_rows(self._cav_keys, vehicles, cav_rows) >= 0
        new_rows = cav_rows[~np.isin(vehicle_keys(vehicles, cav_rows), self._cav_keys)]
        new_rows = new_rows[np.argsort(vehicle_keys(vehicles, new_rows), kind="stable")]
        self.remaining_rows = np.flatnonzero(remains).tolist() if len(new_rows) or not remains.all() else None
        self._cav_keys = np.concatenate([self._cav_keys[remains], vehicle_keys(vehicles, new_rows)])
        self.entered_count, self.cav_count = self.entered_count + len(new_rows), len(self._cav_keys)
        if self._is_controlled and len(new_rows):
            vehicles = traffic.vehicles = enable_acc(vehicles, new_rows, self.scenario.cruise)
        self._cav_entry_counts += np.bincount(vehicles.road[new_rows], minlength=len(self.roads))
        measured = MeasuredVehicles(vehicles.lane, vehicles.position, vehicles.speed, is_cav, vehicles.road)
        self._messages.send(self._measurement.update(measured))
        self._local_state = self._exact_state()
        leader_rows = neighbors_on_lane(traffic.neighbors.leaders, vehicles.lane)
        gaps = vehicles.position[leader_rows] - traffic.geometry.vehicle_length - vehicles.position
        gaps = np.where(leader_rows >= 0, gaps, np.nan)
        crashed_roads = vehicles.road[gaps < CONTACT_GAP]
        self._log.end_steps[crashed_roads] = np.minimum(self._log.end_steps[crashed_roads], self.control_steps)
        self.backlogs = traffic.insertion_queue.backlog(traffic.time - self.scenario.simulation_step)
        if self._keep_record:
            self._log.record_control_step(vehicles, gaps, self.backlogs, self._cav_keys, self._local_state)

    def _exact_state(self) -> LocalState:
        """Return the current local state of the CAVs."""
        traffic, vehicles = self._traffic, self._traffic.vehicles
        rows, geometry = self._cav_rows(), traffic.geometry
        roads, _, lane, position, speed = (column[rows] for column in vehicles[:5])
        motion = vehicles.position, vehicles.speed, np.broadcast_to(geometry.vehicle_length, vehicles.speed.shape)
        own, left, right = (observe_lane(traffic.neighbors, rows, lane + offset, *motion) for offset in (0, 1, -1))
        limit = geometry.speed_limits(lane, geometry.sections(lane, position))
        lane_speeds, road_speeds = self._road_sections.speeds_ahead(self._messages.latest, lane, position, roads)
        if self.roads[0].roadside.source == "none":
            lane_speeds = road_speeds = None
        penetration_rate = self._cav_entry_counts / traffic.insertion_queue.entry_counts.clip(1)
        state = LocalState(
            speed,
            *own[0],
            *own[1],
            position - geometry.origin,
            np.full(len(rows), np.nan),
            allowed_speed=limit * vehicles.speed_factor[rows],
            distance_to_merge=geometry.distance_to_merge(lane, position),
            lane_speeds=lane_speeds,
            road_speeds=road_speeds,
            adjacent_gaps=np.stack([gap for _, gap in left + right], -1),
            adjacent_speeds=np.stack([adjacent_speed for adjacent_speed, _ in left + right], -1),
            penetration_rate=penetration_rate[roads],
        )
        return state.as_read_only()

    def last_applied_acceleration(self) -> Floats:
        """Return the CAVs' accelerations in the last control step [m/s2]; zero for CAVs that have left."""
        previous_speed, new_speed = self._previous_cav_speeds, self._local_state.speed
        remaining, changes = self.remaining_rows, np.zeros(len(previous_speed))
        rows = np.arange(len(previous_speed)) if remaining is None else np.array(remaining, np.intp)
        changes[rows] = new_speed[: len(rows)] - previous_speed[rows]
        return changes / self.scenario.control_step

    def last_outcome(self) -> Outcome:
        """Return the outcome of the last control step, a row for each road; CAVs that have just entered are absent."""
        vehicles, state, accelerations = self._traffic.vehicles, self._local_state, self.last_applied_acceleration()
        if self.remaining_rows is not None:
            accelerations = accelerations[self.remaining_rows]
        count = len(accelerations)
        by_cav = accelerations, time_gap(state.leader_gap, state.speed)[:count], state.speed[:count]
        accelerations, time_gaps, cav_speeds = self._by_road(self.cav_roads[:count], *by_cav)
        (speeds,) = self._by_road(vehicles.road, vehicles.speed)
        return Outcome(speeds, accelerations, time_gaps, self.crashed_roads, self.backlogs, cav_speeds)

    def _by_road(self, roads: NDArray[np.intp], *values: Floats) -> Floats:
        """Return values of vehicles by road, shape (values, W, largest number of vehicles), padded with NaN."""
        counts = np.bincount(roads, minlength=len(self.roads))
        order = np.argsort(roads, kind="stable")
        columns = np.arange(len(roads)) - np.repeat(np.cumsum(counts) - counts, counts)
        table = np.full((len(values), len(counts), counts.max()), np.nan)
        table[:, roads[order], columns] = np.array(values)[:, order]
        return table

    def noise(self, episode_noise_size: int = 0) -> Floats:
        """Return scaled noise for one action, shape (CAVs,), or for the episode; see `World.noise`."""
        roads, generators = self.cav_roads, self._exploration_generators
        if episode_noise_size:
            if self._episode_noise is None:
                self._episode_noise = np.stack(
                    [generator.standard_normal(episode_noise_size) for generator in generators]
                )
            return self._exploration_scales[roads, None] * self._episode_noise[roads]
        noise = np.empty(len(roads))
        for road in np.unique(roads).tolist():
            is_on_road = roads == road
            noise[is_on_road] = generators[road].standard_normal(int(is_on_road.sum()))
        return self._exploration_scales[roads] * noise

    def record(self, driver_log: DriverLog) -> tuple[Episode, ...]:
        """Return the record of each road, without rewards."""
        return self._log.make_episodes(driver_log, self._seeds)
