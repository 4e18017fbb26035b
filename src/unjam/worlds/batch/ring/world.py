"""W rings as one world of arrays of shape (vehicles, W), with vehicles in road order.

The first row of the speeds is repeated at the end, so that the leaders' speeds are a slice. Rows of CAVs contain the
first CAV of every ring, then the second CAV of every ring, and so on.
"""

from collections.abc import Collection, Sequence
from functools import reduce
from itertools import product
from math import isfinite
from typing import Any, ClassVar, NamedTuple, Self, cast

import numpy as np

from unjam.drivers.command import Command, batch_commanded_accelerations
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import ActuatorState, CAVActuation, FollowingState
from unjam.drivers.sensors import SensorReadings
from unjam.errors import EpisodeError
from unjam.physics.arrays import Array, clamp_max, clamp_min, namespace, replace_columns
from unjam.physics.kinematics import gap_on_loop, next_position, next_speed
from unjam.scenarios.road import ClosedRoad, OrderedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario
from unjam.worlds.batch import human_idm
from unjam.worlds.batch.figure_eight.crossing import CrossingMemory, FigureEightMovement, figure_eight_contacts
from unjam.worlds.batch.noise import ArrayFactory, DrawNormal, NoiseState, QuickNoise, SeededNoise, WorldSeeds
from unjam.worlds.batch.ring.record import as_numpy, make_ring_episodes
from unjam.worlds.ordered_road import MAX_RECALL_SECONDS
from unjam.worlds.record import Episode, Floats
from unjam.worlds.reward import Outcome, time_gap
from unjam.worlds.worker_pool import EpisodeTask
from unjam.worlds.world import DriverLog, ProgressCallback


class WarmUpState(NamedTuple):
    """State of one ring after its warm-up, when its CAVs are handed to their driver."""

    speed: Floats
    """speeds [m/s], shape (vehicles + 1,); the first speed is repeated at the end"""
    position: Floats
    """positions [m], shape (vehicles,)"""
    gap: Floats
    """gaps to the vehicle ahead [m], shape (vehicles,)"""
    has_crashed: bool
    noise: NoiseState
    history: LocalState | None
    """states of the CAVs in the last minute, shape (CAVs, moments); None if CAVs do not remember the warm-up"""
    crossing_memory: CrossingMemory | None = None


class RingBatch:
    """W closed roads of one kind, each with its own seed; episodes of rings equal SUMO's except for rounding.

    With quick noise, human drivers follow the vehicle ahead only, and ignore the last vehicles on the next lanes.
    """

    is_scalar, remaining_rows = False, None
    _road_arrays: ClassVar[tuple[str, ...]] = (
        *("_speed", "_position", "_gap", "_loop_lengths", "_cav_loop_lengths", "_crossing_starts", "_human_parameters"),
        *("_is_running", "crashed_roads", "control_step_counts", "_ends"),
    )
    """names of the attributes with a column for each road"""
    measured_fields: Collection[str] = ()
    """names of the optional fields of `LocalState` that the driver reads"""
    safe_accelerations: Sequence[Array] = ()
    """the CAVs' accelerations after the safety filter in each simulation step of the last control step [m/s2]"""
    warm_up_states: Sequence[WarmUpState] = ()
    """state of each ring after its warm-up; empty if the warm-up must be simulated"""

    def __init__(
        self,
        scenarios: Sequence[Scenario],
        seeds: Sequence[Sequence[int]],
        to_array: ArrayFactory = np.asarray,
        keep_record: bool = True,
        draw: DrawNormal | None = None,
        human_model: human_idm.HumanSpeedModel | None = None,
    ) -> None:
        """Put vehicles on the roads of scenarios that differ only in their lengths.

        `to_array` makes the arrays. With `keep_record`, episodes take 16 bytes per vehicle and step. `draw` draws all
        noise; without it, each road has the noise of SUMO's episode. `human_model` replaces SUMO's IDM away from
        junctions.
        """
        scenario = self.scenario = scenarios[0]
        drawn_roads = [road.draw_from_seed(seed) for road, seed in zip(scenarios, seeds, strict=True)]
        roads = [cast(OrderedRoad, road) for road, _ in drawn_roads]
        world_seeds = [road_seeds for _, road_seeds in drawn_roads]
        self._scenarios, self._seeds, self._keep_record, self._to_array = scenarios, seeds, keep_record, to_array
        self.roads, self._is_controlled = roads, False
        vehicles, cavs = len(roads[0].vehicle_ids), len(roads[0].cav_ids)
        self._shape = cavs, len(roads)
        self.limits, self.control_steps = scenario.acceleration_limits, 0
        self.cav_count = self.entered_count = cavs * len(roads)
        indices = np.array([roads[0].vehicle_ids.index(cav_id) for cav_id in roads[0].cav_ids])
        self._cav_indices, self._leader_indices, self._follower_indices = (
            rows.tolist() for rows in (indices, indices + 1, (indices - 1) % vehicles)
        )
        loop_lengths, step = np.array([road.loop_length for road in roads]), scenario.simulation_step
        self._loop_lengths, self._cav_loop_lengths = to_array(loop_lengths), to_array(np.tile(loop_lengths, cavs))
        start_speeds = np.tile([road.start_speed for road in roads], (vehicles, 1))
        self._set_motion(start_speeds, np.stack([road.start_positions for road in roads], 1), loop_lengths)
        self._human_parameters = human_idm.human_parameters(roads, scenario.humans, to_array)
        self._human_model = human_model
        self._figure_eight, self._find_contacts = None, human_idm.ring_contacts
        if roads[0].crossings:
            self._figure_eight = FigureEightMovement(
                scenario, cast(Sequence[ClosedRoad], roads), self._cav_indices, to_array, human_model
            )
            self._find_contacts = figure_eight_contacts
        crossings = zip(*(road.crossings for road in roads), strict=True)
        self._crossing_starts = [to_array(np.tile([start for start, _ in crossing], cavs)) for crossing in crossings]
        self._ends = to_array(np.full(len(roads), float(scenario.horizon)))
        """number of control steps in the episode of each road, shape (W,)"""
        self._noise_scale = to_array(np.full((vehicles, 1), scenario.noise_per_step * step))
        self._actuation = CAVActuation(scenario.safety, scenario.actuator, step)
        self._readings = RingReadings(scenario, roads[0].cav_ids, world_seeds, to_array)
        self._noise = (
            SeededNoise(world_seeds, vehicles, (scenario.horizon, cavs), to_array)
            if draw is None
            else QuickNoise(draw, vehicles, cavs, len(roads))
        )
        self._has_quick_noise = draw is not None
        self._reset_log()

    @classmethod
    def from_tasks(cls, tasks: Sequence[EpisodeTask], to_array: ArrayFactory) -> Self:
        """Return a batch with the roads of tasks."""
        scenarios = [task.scenario for task in tasks]
        return cls(scenarios, [task.seed for task in tasks], to_array)

    def values_of_cavs(self, values: Array) -> Array:
        """Return the value of the road of each CAV, given values of shape (W,)."""
        return self._to_array(np.tile(values, self._shape[0]))

    def _set_motion(self, speeds: Array, positions: Array, loop_lengths: Array) -> None:
        """Set speeds [m/s], positions [m], and gaps, given NumPy arrays of shape (vehicles, W); `loop_lengths` (W,)."""
        self._speed = self._to_array(np.concatenate([speeds, speeds[:1]]))
        self._position = self._to_array(positions)
        self._gap = self._to_array(gap_on_loop(positions, np.roll(positions, -1, 0), loop_lengths, VEHICLE_LENGTH))

    def _reset_log(self) -> None:
        cav_series = "requested_accelerations", "safe_accelerations", "commanded_speeds"
        self._series = {"speeds": [self._speed[:-1]], **{name: [] for name in ("noise_free_speeds", *cav_series)}}
        self._start_positions = as_numpy(self._position)
        zeros = self._speed[0] * 0.0
        self._is_running, self.crashed_roads, self.control_step_counts = zeros + 1.0, zeros > 0.0, zeros
        """whether the episode of each road is running and has crashed, and its control steps, shape (W,)"""

    def place_vehicles(self, speeds: Array, positions: Array, memories: Sequence[CrossingMemory | None]) -> None:
        """Set speeds [m/s] and positions [m] before the start, (vehicles, W), and the `memories` of figure eights."""
        if self._figure_eight:
            self._figure_eight.restore_memory(cast(Sequence[CrossingMemory], memories))
        self._set_motion(speeds, positions, as_numpy(self._loop_lengths))
        self._reset_log()

    def set_actuators(self, state: ActuatorState) -> None:
        """Set the accelerations and pending commands of the CAVs before the start."""
        self._actuation.set_state("all", state)

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> LocalState | None:
        """Run the warm-up or restore `warm_up_states`, and hand the CAVs to their driver if `is_controlled`.

        Return the states of the CAVs in the last minute of the warm-up, NumPy arrays of shape (CAVs * W, moments),
        oldest first; None if there is no warm-up to remember.
        """
        history = self._restore(self.warm_up_states) if self.warm_up_states else self._simulate_warm_up()
        if bool(self.crashed_roads.any()):
            raise EpisodeError("collision in the all-human warm-up of a ring")
        self._is_controlled = is_controlled
        if is_controlled:
            self._noise_scale[self._cav_indices] = 0.0
            self._noise.drop_block()
            if self._figure_eight:
                self._figure_eight.hand_over()
        self._reset_log()
        return history

    def _simulate_warm_up(self) -> LocalState | None:
        """Simulate the warm-up, and return the states of the CAVs that `start` returns."""
        scenario, states = self.scenario, list[LocalState]()
        max_count = round(MAX_RECALL_SECONDS / scenario.control_step)
        for remaining_steps in range(scenario.warmup, 0, -1):
            control_steps, rest_steps = divmod(remaining_steps, scenario.steps_per_control_step)
            if rest_steps == 0 and control_steps <= max_count:
                states.append(self.exact_state().map(as_numpy))
            self._simulate(None)
        if not states or not scenario.remember_warmup:
            return None
        return states[0].map(lambda *values: np.stack(values, 1), *states[1:])

    def run_warm_up(self) -> list[WarmUpState]:
        """Run the warm-up and return the state of each ring after it; requires NumPy arrays and seeded noise."""
        history, noise = self._simulate_warm_up(), cast(SeededNoise, self._noise).states()
        if history is not None:
            history = history.map(lambda values: values.reshape(*self._shape, -1).swapaxes(0, 1).copy())
        speed, position, gap = (values.T.copy() for values in (self._speed, self._position, self._gap))
        states = []
        for ring, has_crashed in enumerate(self.crashed_roads.tolist()):
            memory = self._figure_eight and CrossingMemory(*(values[:, ring] for values in self._figure_eight.memory))
            ring_history = None if history is None else history.select(ring)
            motion = speed[ring], position[ring], gap[ring]
            states.append(WarmUpState(*motion, has_crashed, noise[ring], ring_history, memory))
        return states

    def _restore(self, states: Sequence[WarmUpState]) -> LocalState | None:
        *motion, noise, histories, memories = zip(*states, strict=True)
        arrays = (self._to_array(np.stack(values, -1)) for values in motion)
        self._speed, self._position, self._gap, self.crashed_roads = arrays
        cast(SeededNoise, self._noise).restore(noise)
        if self._figure_eight:
            self._figure_eight.restore_memory(memories)
        if histories[0] is None:
            return None
        return histories[0].map(lambda *values: np.stack(values, 1).reshape(self.cav_count, -1), *histories[1:])

    def replace_roads(self, roads: Any, source: Self, source_roads: Any) -> None:
        """Continue on `roads` with `source_roads` of another batch that has just been started.

        Both batches have one CAV on each road, keep no record, and have the same kind of arrays, noise and scenario.
        """
        for name in self._road_arrays:
            setattr(self, name, replace_columns(getattr(self, name), roads, getattr(source, name), source_roads))
        for road, source_road in zip(roads, source_roads, strict=True):
            self.roads[road] = source.roads[source_road]
        self._readings.replace_roads(roads, source._readings, source_roads)
        self._noise.replace_worlds(roads, source._noise, source_roads)  # pyright: ignore[reportArgumentType]
        self._actuation.reset_rows(roads)
        if self._figure_eight and source._figure_eight:
            self._figure_eight.replace_roads(roads, source._figure_eight, source_roads)

    def detach_state(self) -> None:
        """Detach the state of torch tensors, so that no gradients flow through earlier steps."""
        self._speed, self._position, self._gap = (
            values.detach() for values in (self._speed, self._position, self._gap)
        )
        self._actuation.detach()

    @property
    def speeds(self) -> Array:
        """Speeds of all vehicles with a driver [m/s], shape (vehicles, W)."""
        return self._speed[: self.roads[0].driven_count]

    @property
    def completed_roads(self) -> Array:
        """Whether the episode of each road has reached its horizon, shape (W,)."""
        return self.control_step_counts >= self._ends

    def last_applied_acceleration(self) -> Array:
        """Return the CAVs' mean accelerations in the last control step, after the filter [m/s2], shape (CAVs * W,)."""
        return sum(self.safe_accelerations) / len(self.safe_accelerations)

    def last_outcome(self) -> Outcome:
        """Return the outcome of the last control step, a row for each road; its arrays must not be changed."""
        speed, _, gap = self.following_state()
        by_cav = self.last_applied_acceleration(), time_gap(gap, speed), speed
        accelerations, time_gaps, cav_speeds = (values.reshape(self._shape).T for values in by_cav)
        no_backlog = 0.0 * self._is_running
        return Outcome(self.speeds.T, accelerations, time_gaps, self.crashed_roads, no_backlog, cav_speeds)

    @property
    def has_ended(self) -> bool:
        """Whether the horizon is reached; rings with a collision are still simulated, but no longer recorded."""
        return self.control_steps >= self.scenario.horizon

    def local_state(self) -> LocalState:
        """Return what the CAVs observe now: arrays of shape (CAVs * W,)."""
        state = self.exact_state()
        if isinstance(state.speed, np.ndarray):  # parts of which belong to the world
            state = state.as_read_only()
        return self._readings.read_for_drivers(self.control_steps, state)

    def exact_state(self) -> LocalState:
        """Return the exact local state of the CAVs now."""
        loop, position = self._cav_loop_lengths, self._select_rows(self._position, self._cav_indices)
        if self._has_quick_noise and isfinite(self.roads[0].loop_length):
            lap_position = position - loop * namespace(position).floor(position / loop)  # `%` takes ten times as long
        else:
            lap_position = position % loop
        rate = self.roads[0].provided_penetration_rate(self.measured_fields)
        distances = [(start - position) % loop for start in self._crossing_starts]
        return LocalState(
            *self.following_state(),
            self._select_rows(self._speed, self._follower_indices),
            self._select_rows(self._gap, self._follower_indices),
            lap_position,
            loop,
            distance_to_crossing=reduce(namespace(position).minimum, distances) if distances else None,
            penetration_rate=None if rate is None else position * 0.0 + rate,
        )

    def following_state(self) -> FollowingState:
        """Return the exact speeds, leader speeds and gaps of the CAVs, shape (CAVs * W,) each."""
        leader_speed = self._select_rows(self._speed, self._leader_indices)
        speed, gap = (self._select_rows(values, self._cav_indices) for values in (self._speed, self._gap))
        return FollowingState(speed, leader_speed, gap)

    def _select_rows(self, values: Array, indices: list[int]) -> Array:
        """Return the values of some vehicles of all rings, shape (CAVs * W,)."""
        return values[indices[0]] if len(indices) == 1 else values[indices].reshape(-1)

    def advance(self, command: Command | None) -> None:
        """Simulate one control step with a constant command; without a command the CAVs stay human."""
        requested = None
        if self._is_controlled:
            requested = batch_commanded_accelerations(command, self.limits, self.cav_count, self.control_steps)
            if self._keep_record:
                self._series["requested_accelerations"].append(requested)
        self.safe_accelerations = [self._simulate(requested) for _ in range(self.scenario.steps_per_control_step)]
        self.control_steps += 1
        self.control_step_counts = self.control_step_counts + self._is_running
        self._is_running = self._is_running * (~self.crashed_roads & ~self.completed_roads)

    def _human_speeds(self, speed: Array, leader: human_idm.Leader) -> Array:
        """Return the noise-free speeds of all vehicles after this step as human drivers, shape (vehicles, W)."""
        parameters, step = self._human_parameters, self.scenario.simulation_step
        if self._human_model is not None:
            return self._human_model(speed, *leader)
        if self._has_quick_noise:
            return human_idm.human_idm_speed(speed, *leader, parameters, step)
        return human_idm.human_ring_speed(speed, self._position, leader, self._loop_lengths, parameters, step)

    def _simulate(self, accelerations: Array | None) -> Array:
        """Simulate one step, and return the accelerations of the CAVs after the filter; None if they are human."""
        step, speed, state = self.scenario.simulation_step, self._speed, self.following_state()
        safe, commanded = None, None
        if accelerations is not None:
            safe, applied = self._actuation.apply("all", accelerations, self._readings.read_for_filters(state))
            commanded = next_speed(state.speed, applied, step)
            if self._keep_record:
                self._series["safe_accelerations"].append(safe)
                self._series["commanded_speeds"].append(commanded)
        noise_free, speeds = self._next_speeds(speed[:-1], human_idm.Leader(speed[1:], self._gap), commanded)
        xp = namespace(noise_free)
        leader_speed = xp.concatenate([noise_free[1:], noise_free[:1]])
        self._gap = self._gap + (leader_speed - noise_free) * step
        self._position = next_position(self._position, noise_free, step)
        if self._figure_eight or bool((self._gap < human_idm.CONTACT_GAP).any()):
            contacts = self._find_contacts(self._position, self._gap, self._loop_lengths)
            self.crashed_roads = self.crashed_roads | (contacts.any(0) & (self._is_running > 0.0))
        self._speed = xp.concatenate([speeds, speeds[:1]])
        if self._keep_record:
            self._series["noise_free_speeds"].append(noise_free)
            self._series["speeds"].append(speeds)
        return safe

    def _next_speeds(self, speed: Array, leader: human_idm.Leader, cav_speeds: Array | None) -> tuple[Array, Array]:
        """Return noise-free speeds with which vehicles move in this step, and speeds after it, (vehicles, W) each."""
        commanded = None if cav_speeds is None else cav_speeds.reshape(self._shape)
        if self._figure_eight:
            noise = self._noise.human_noise() * self._noise_scale if self.scenario.noise > 0 else 0.0
            return (self._figure_eight.move(speed, self._position, leader, noise, commanded),) * 2
        noise_free = self._human_speeds(speed, leader)
        if commanded is not None:
            min_speed = speed[self._cav_indices] - self.scenario.cav_max_braking * self.scenario.simulation_step
            noise_free[self._cav_indices] = clamp_max(clamp_min(commanded, min_speed), self.scenario.top_speed)
        if self.scenario.noise > 0:
            return noise_free, clamp_min(noise_free + self._noise.human_noise() * self._noise_scale, 0.0)
        return noise_free, noise_free

    def noise(self, episode_noise_size: int = 0) -> Array:
        """Return standard normal noise of this control step, shape (CAVs * W,), or of the episode; see `World`."""
        if episode_noise_size:
            return self._noise.episode_noise(episode_noise_size)
        return self._noise.exploration_noise(self.control_steps)

    def record(self, driver_log: DriverLog) -> tuple[Episode, ...]:
        """Return the record of each ring, without rewards; empty if no record is kept."""
        if not self._keep_record:
            return ()
        step_counts, has_crashed = as_numpy(self.control_step_counts).astype(int), as_numpy(self.crashed_roads) > 0.0
        rings = zip(self._scenarios, self.roads, self._seeds, step_counts.tolist(), has_crashed.tolist(), strict=True)
        rate = self.roads[0].provided_penetration_rate(self.measured_fields)
        return make_ring_episodes(rings, self._start_positions, self._series, self._find_contacts, driver_log, rate)


class RingReadings:
    """Sensor readings of the CAVs on W rings, whose generators draw in the same order as in SUMO's worlds."""

    def __init__(self, scenario: Scenario, cav_ids: Sequence[str], seeds: WorldSeeds, to_array: ArrayFactory) -> None:
        sensors, braking = scenario.sensors, scenario.safety.leader_braking
        step, ring_seeds = scenario.simulation_step, () if sensors.is_exact else seeds
        self._ring_readings = [SensorReadings(sensors, braking, step, seed) for *_, seed in ring_seeds]
        self._cav_ids, self._to_array, self._shape = cav_ids, to_array, (len(cav_ids), len(seeds))
        self._cached_readings: tuple[int, LocalState] | None = None

    def replace_roads(self, roads: Sequence[int], source: "RingReadings", source_roads: Sequence[int]) -> None:
        """Continue on `roads` with the sensors of another batch, from the next control step on."""
        if self._ring_readings:
            for road, source_road in zip(roads, source_roads, strict=True):
                self._ring_readings[road] = source._ring_readings[source_road]

    def read_for_drivers(self, step_index: int, true_state: LocalState) -> LocalState:
        """Return the readings of the drivers from the true state; they are the same for all calls in a control step."""
        if not self._ring_readings:
            return true_state
        if self._cached_readings is None or self._cached_readings[0] != step_index:
            states = true_state.map(lambda values: as_numpy(values).reshape(self._shape))
            first, *others = (
                readings.read_for_driver(self._cav_ids, states.select(np.s_[:, ring]))
                for ring, readings in enumerate(self._ring_readings)
            )
            joined = first.map(lambda *values: self._to_array(np.stack(values, 1).reshape(-1)), *others)
            self._cached_readings = step_index, joined
        return self._cached_readings[1]

    def read_for_filters(self, true_state: FollowingState) -> FollowingState:
        """Return the readings of the safety filters from the true state; call it once in each simulation step."""
        if not self._ring_readings:
            return true_state
        cavs = product(self._cav_ids, self._ring_readings)
        rows = np.stack([as_numpy(values) for values in true_state], 1).tolist()
        readings = [
            ring_readings.read_for_filter(cav_id, FollowingState(*row))
            for (cav_id, ring_readings), row in zip(cavs, rows, strict=True)
        ]
        return FollowingState(*self._to_array(np.array(readings).T))
