"""W whole rings as one world to drive in: vehicles times rings, stepped as arrays, free of the simulator.

Arrays have the vehicles of a ring along their first axis, in road order, and the rings along their second; a
row of the vehicles' speeds comes again at the end, so that who is ahead is a slice. CAVs' rows are ring after
ring of the first CAV, then of the second, and so on.
"""

from collections.abc import Callable, Collection, Sequence
from functools import reduce
from typing import cast

import numpy as np

from unjam.drivers.command import Command, batch_commanded_accelerations
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import CAVActuation, FollowingState
from unjam.errors import EpisodeError
from unjam.physics.arrays import Array, clamp_max, clamp_min, namespace
from unjam.physics.kinematics import gap_on_loop, next_position, next_speed
from unjam.scenarios.ring import LoopScenario
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.audit import MIN_TIME_GAP_SPEED
from unjam.worlds.batch.figure_eight.crossing import CrossingMemory
from unjam.worlds.batch.figure_eight.geometry import crossing_starts, figure_eight_contacts
from unjam.worlds.batch.figure_eight.movement import FigureEightMovement
from unjam.worlds.batch.human_idm import HumanSpeedModel, human_idm_speed, human_parameters, human_ring_speed
from unjam.worlds.batch.leaders import CONTACT_GAP, Leader, ring_contacts
from unjam.worlds.batch.noise import ArrayFactory, SeededNoise, make_noise
from unjam.worlds.batch.ring.record import RingLog, RingResults, as_numpy
from unjam.worlds.batch.ring.sensors import RingReadings
from unjam.worlds.batch.ring.warm_up import WarmUpState
from unjam.worlds.batch.support import check_batch_scenarios
from unjam.worlds.closed_road import MAX_RECALL_SECONDS
from unjam.worlds.reward import Outcome, make_reward, time_gap
from unjam.worlds.world import DriverLog, ProgressCallback


class RingBatch:
    """W closed roads of the same kind, each with a seed of its own; rings equal SUMO's, but for rounding.

    With noise that is drawn quickly people follow the car ahead and nobody else. SUMO's also look at the last
    car of the next lane, and no farther than they must: see `unjam.worlds.batch.leaders`.
    """

    is_scalar, remaining_rows = False, None
    measured_fields: Collection[str] = ()
    """fields of a `LocalState` that the driver looks at: of those that are told, only these are"""
    warm_up_states: Sequence[WarmUpState] = ()
    """each ring after its warm-up, where that was run before"""

    def __init__(
        self,
        scenarios: Sequence[LoopScenario],
        seeds: Sequence[Sequence[int]],
        to_array: ArrayFactory = np.asarray,
        reward: str = "",
        keep_record: bool = True,
        draw: Callable[[tuple[int, ...]], Array] | None = None,
        human_model: HumanSpeedModel | None = None,
        allow_statistical: bool = False,
    ) -> None:
        """Put the vehicles on the roads; nothing moves yet.

        Args:
            scenarios: of each ring; they differ in their lengths alone.
            seeds: of each ring, as `run_episode` takes them.
            numbers: makes the arrays that are stepped, as NumPy's or torch's, in any precision.
            reward: name; empty: the scenario's own.
            keep: whether all is kept for episodes, some 16 bytes for each vehicle and step in float64.
            draw: of all noise, for arrays of a shape; None: each ring draws what SUMO's episode would.
            people: how they drive where no junction binds them, if it is not as SUMO's IDM does.
            statistical: whether roads are allowed that equal SUMO's in distribution alone.

        Raises:
            InputError: a scenario cannot be stepped so, or they are not alike.
        """
        check_batch_scenarios(scenarios, allow_statistical)
        scenario = self.scenario = scenarios[0]
        drawn = [each.draw_from_seed(seed) for each, seed in zip(scenarios, seeds, strict=True)]
        roads, seeded = [cast(ClosedRoad, road) for road, _ in drawn], [others for _, others in drawn]
        self._scenarios, self._seeds, self._keep_record, self._to_array = scenarios, seeds, keep_record, to_array
        self.roads, self._is_controlled = roads, False
        worlds, vehicles, cavs = len(roads), len(roads[0].vehicle_ids), len(roads[0].cav_ids)
        self.limits, self.control_steps = scenario.acceleration_limits, 0
        self.cav_count = self.entered_count = cavs * worlds
        places = np.array([roads[0].vehicle_ids.index(name) for name in roads[0].cav_ids])
        self._cav_indices, self._leader_indices, self._follower_indices = (
            each.tolist() for each in (places, places + 1, (places - 1) % vehicles)
        )
        self._shape = cavs, worlds
        start = np.stack([road.start_positions for road in roads], 1)
        loops = np.array([road.loop_length for road in roads])
        self._loop_lengths = to_array(loops)
        self._cav_loop_lengths = to_array(np.tile(loops, cavs))
        self._gap = to_array(gap_on_loop(start, np.roll(start, -1, 0), loops, VEHICLE_LENGTH))
        self._position = to_array(start)
        self._speed = to_array(np.zeros((vehicles + 1, worlds)))
        self._human_parameters, self._human_model = human_parameters(roads, scenario.humans, to_array), human_model
        across = bool(roads[0].crossings)
        self._figure_eight = (
            FigureEightMovement(scenario, roads, self._cav_indices, to_array, human_model) if across else None
        )
        self._find_contacts = figure_eight_contacts if across else ring_contacts
        self._crossing_starts = [to_array(np.tile(each, cavs)) for each in crossing_starts(roads)]
        step = scenario.simulation_step
        self._noise_scale = to_array(np.full((vehicles, 1), scenario.noise_per_step * step))
        self._actuation, self._max_speed_drop = (
            CAVActuation(scenario.safety, scenario.actuator, step),
            scenario.cav_max_braking * step,
        )
        self._readings = RingReadings(scenario, roads[0].cav_ids, seeded, to_array)
        self._noise = make_noise(seeded, vehicles, (scenario.horizon, cavs), to_array, draw)
        self._reward, self._has_quick_noise = make_reward(reward or scenario.reward), draw is not None
        self._reset_log()

    def _reset_log(self) -> None:
        """Begin the log and the sums anew."""
        self._log = RingLog(as_numpy(self._position), [self._speed[:-1]], self._find_contacts)
        ring = self._loop_lengths * 0.0
        each_cav = self._cav_loop_lengths.reshape(self._shape) * 0.0
        self._is_running, self._control_step_counts = ring + 1.0, ring
        self._reward_sums, self._mean_speed_sums, self._has_crashed = dict[str, Array](), ring, ring > 0.0
        self._min_time_gap, self._max_braking = each_cav + np.inf, each_cav

    def place_vehicles(self, speeds: Array, positions: Array, memories: Sequence[CrossingMemory | None]) -> None:
        """Put vehicles elsewhere before the start [m/s, m], (vehicles, W), on eights with those who wait."""
        if self._figure_eight:
            self._figure_eight.restore_memory(cast(Sequence[CrossingMemory], memories))
        self._speed = self._to_array(np.concatenate([speeds, speeds[:1]]))
        self._position = self._to_array(positions)
        gap = gap_on_loop(positions, np.roll(positions, -1, 0), as_numpy(self._loop_lengths), VEHICLE_LENGTH)
        self._gap = self._to_array(gap)
        self._reset_log()

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> LocalState | None:
        """Run the warm-up, unless it is `begun`; then hand the CAVs over, or they stay human.

        Returns:
            What the CAVs perceived in the last minute of the warm-up at the times of decisions, NumPy arrays
            of shape (CAVs * W, moments), oldest first; None without a warm-up that may be remembered.
        """
        seen = self._restore(self.warm_up_states) if self.warm_up_states else self._drive_warm_up()
        if bool(self._has_crashed.any()):
            raise EpisodeError("collision in the all-human warm-up of a ring")
        self._is_controlled = is_controlled
        if is_controlled:
            self._noise_scale[self._cav_indices] = 0.0
            self._noise.drop_block()
            if self._figure_eight:
                self._figure_eight.hand_over()
        self._reset_log()
        return seen

    def _drive_warm_up(self) -> LocalState | None:
        """Let people drive as long as the scenario says, and return what `start` does."""
        scenario, seen = self.scenario, list[LocalState]()
        each, longest = scenario.steps_per_control_step, round(MAX_RECALL_SECONDS / scenario.control_step)
        for step in range(scenario.warmup):
            left = scenario.warmup - step
            if left % each == 0 and left // each <= longest:
                seen.append(self._exact_state().map(as_numpy))
            self._simulate(None)
        if not seen or not scenario.remember_warmup:
            return None
        return seen[0].map(lambda *values: np.stack(values, 1), *seen[1:])

    def run_warm_up(self) -> list[WarmUpState]:
        """Run the warm-up, and return each ring after it; with arrays of NumPy, and noise as SUMO's."""
        seen, states = self._drive_warm_up(), cast(SeededNoise, self._noise).states()
        by_ring = seen and seen.map(lambda values: values.reshape(*self._shape, -1).swapaxes(0, 1).copy())
        speed, position, gap = (values.T.copy() for values in (self._speed, self._position, self._gap))
        found = []
        for ring, noise in enumerate(states):
            crashed, remembered = bool(self._has_crashed[ring]), by_ring and by_ring.select(ring)
            waits = self._figure_eight and CrossingMemory(
                *(as_numpy(each)[:, ring] for each in self._figure_eight.memory)
            )
            found.append(WarmUpState(speed[ring], position[ring], gap[ring], crashed, noise, remembered, waits))
        return found

    def _restore(self, states: Sequence[WarmUpState]) -> LocalState | None:
        """Go on where rings had begun, and return what `start` does."""
        speeds, positions, gaps, crashed, noise, seen, waits = zip(*states, strict=True)
        self._speed, self._position, self._gap, self._has_crashed = (
            self._to_array(np.stack(each, -1)) for each in (speeds, positions, gaps, crashed)
        )
        cast(SeededNoise, self._noise).restore(noise)
        if self._figure_eight:
            self._figure_eight.restore_memory(waits)
        if seen[0] is None:
            return None
        return seen[0].map(lambda *values: np.stack(values, 1).reshape(self.cav_count, -1), *seen[1:])

    @property
    def has_ended(self) -> bool:
        """Whether the horizon is reached; a ring on which vehicles collided goes on, and counts no more."""
        return self.control_steps >= self.scenario.horizon

    def local_state(self) -> LocalState:
        """Return what the CAVs perceive now: arrays of shape (CAVs * W,)."""
        state = self._exact_state()  # of which some is the world's own
        state = state.as_read_only() if isinstance(state.speed, np.ndarray) else state
        return self._readings.read_for_drivers(self.control_steps, state)

    def _exact_state(self) -> LocalState:
        """Return what exact sensors of the CAVs would read now."""
        speed, gap = self._speed, self._gap
        share, place = (
            self.roads[0].provided_penetration_rate(self.measured_fields),
            self._rows_of(self._position, self._cav_indices),
        )
        ways = [(start - place) % self._cav_loop_lengths for start in self._crossing_starts]
        return LocalState(
            *self._following_state(),
            self._rows_of(speed, self._follower_indices),
            self._rows_of(gap, self._follower_indices),
            place % self._cav_loop_lengths,
            self._cav_loop_lengths,
            distance_to_crossing=reduce(namespace(place).minimum, ways) if ways else None,
            penetration_rate=None if share is None else self._cav_loop_lengths * 0.0 + share,
        )

    def _following_state(self) -> FollowingState:
        """Return what exact sensors would tell the CAVs' filters."""
        speed, own = self._speed, self._cav_indices
        return FollowingState(
            self._rows_of(speed, own), self._rows_of(speed, self._leader_indices), self._rows_of(self._gap, own)
        )

    def _rows_of(self, values: Array, indices: list[int]) -> Array:
        """Return what is at some places, ring after ring of each, shape (CAVs * W,)."""
        return values[indices[0]] if len(indices) == 1 else values[indices].reshape(-1)

    def advance(self, command: Command | None) -> None:
        """Simulate one decision, held over its simulation steps; None: the CAVs stay human."""
        each, before = self.scenario.steps_per_control_step, self._rows_of(self._speed, self._cav_indices)
        told_all = self.limits, self.cav_count, self.control_steps
        wanted = batch_commanded_accelerations(command, *told_all) if self._is_controlled else None
        log = self._log
        if wanted is not None and self._keep_record:
            log.requested_accelerations.append(wanted)
        told = [self._simulate(wanted) for _ in range(each)]
        self.control_steps += 1
        after, _, gap = self._following_state()
        applied: Array = sum(told) / each if told[0] is not None else (after - before) / self.scenario.control_step
        outcome = Outcome(
            speeds=self._speed[:-1].T,
            accelerations=applied.reshape(self._shape).T,
            time_gaps=time_gap(gap, after).reshape(self._shape).T,
            has_crashed=self._has_crashed,
            backlog=self._is_running * 0.0,
        )
        for name, term in self._reward(outcome).items():
            self._reward_sums[name] = self._reward_sums.get(name, 0.0) + term * self._is_running
        self._control_step_counts = self._control_step_counts + self._is_running
        self._mean_speed_sums = self._mean_speed_sums + outcome.speeds.mean(-1) * self._is_running
        self._is_running = self._is_running * ~self._has_crashed

    def _human_speeds(self, speed: Array, leader: Leader) -> Array:
        """Return the speeds after this step of all vehicles, if people drive them, shape (vehicles, W)."""
        people, step = self._human_parameters, self.scenario.simulation_step
        if self._human_model is not None:
            return self._human_model(speed, *leader)
        if self._has_quick_noise:
            return human_idm_speed(speed, *leader, people, step)
        return human_ring_speed(speed, self._position, leader, self._loop_lengths, people, step)

    def _simulate(self, accelerations: Array | None) -> Array:
        """Simulate one step, and return what CAVs were told; None: they are human."""
        step, speed = self.scenario.simulation_step, self._speed
        cavs, told, commanded = self._following_state(), None, None
        if accelerations is not None:
            told, done = self._actuation.apply("all", accelerations, self._readings.read_for_filters(cavs))
            commanded = next_speed(cavs.speed, done, step)
            if self._keep_record:
                self._log.safe_accelerations.append(told)
                self._log.commanded_speeds.append(commanded)
        moved, speeds = self._next_speeds(speed[:-1], Leader(speed[1:], self._gap), commanded)
        xp = namespace(moved)
        ahead = xp.concatenate([moved[1:], moved[:1]])
        self._gap = self._gap + (ahead - moved) * step
        self._position = next_position(self._position, moved, step)
        if self._figure_eight or bool((self._gap < CONTACT_GAP).any()):
            self._has_crashed = self._has_crashed | self._find_contacts(
                self._position, self._gap, self._loop_lengths
            ).any(0)
        self._speed = xp.concatenate([speeds, speeds[:1]])
        if self._keep_record:
            self._log.noise_free_speeds.append(moved)
            self._log.speeds.append(speeds)
        self._update_extremes(cavs)
        return told

    def _next_speeds(self, speed: Array, leader: Leader, cav_speeds: Array | None) -> tuple[Array, Array]:
        """Return the speeds with which all move in this step, and those after it, (vehicles, W) each."""
        told = None if cav_speeds is None else cav_speeds.reshape(self._shape)
        if self._figure_eight:
            noise = self._noise.human_noise() * self._noise_scale if self.scenario.noise > 0 else 0.0
            return (self._figure_eight.next_speeds(speed, self._position, leader, noise, told),) * 2
        moved = self._human_speeds(speed, leader)
        if told is not None:
            slowest = speed[self._cav_indices] - self._max_speed_drop
            moved[self._cav_indices] = clamp_max(clamp_min(told, slowest), self.scenario.top_speed)
        if self.scenario.noise > 0:
            return moved, clamp_min(moved + self._noise.human_noise() * self._noise_scale, 0.0)
        return moved, moved

    def _update_extremes(self, following_state: FollowingState) -> None:
        """Note how the CAVs follow at the beginning of a step, and how hard they brake in it."""
        braking = (
            following_state.speed - self._rows_of(self._speed, self._cav_indices)
        ) / self.scenario.simulation_step
        counted = braking.reshape(self._shape) * self._is_running
        self._max_braking = namespace(counted).maximum(self._max_braking, counted)
        self._min_time_gap = self._lowered_time_gaps(following_state)

    def _lowered_time_gaps(self, following_state: FollowingState) -> Array:
        """Return the smallest headways with those at a moment, shape (CAVs, W)."""
        speed, gap = (each.reshape(self._shape) for each in (following_state.speed, following_state.gap))
        xp, counts = namespace(speed), (speed > MIN_TIME_GAP_SPEED) * (self._is_running > 0)
        return xp.where(
            counts, xp.minimum(self._min_time_gap, gap / clamp_min(speed, MIN_TIME_GAP_SPEED)), self._min_time_gap
        )

    def noise(self, episode_noise_size: int = 0) -> Array:
        """Return standard normal noise of this decision, shape (CAVs * W,), or what lasts."""
        return (
            self._noise.episode_noise(episode_noise_size)
            if episode_noise_size
            else self._noise.exploration_noise(self.control_steps)
        )

    def record(self, driver_log: DriverLog) -> RingResults:
        """Return what happened since the start."""
        headway, share = (
            self._lowered_time_gaps(self._following_state()),
            self.roads[0].provided_penetration_rate(self.measured_fields),
        )
        made, crashed = as_numpy(self._control_step_counts), 1.0 - as_numpy(self._is_running)
        kept = self._scenarios, self.roads, self._seeds, made, crashed
        return RingResults(
            control_steps=made,
            has_crashed=crashed,
            reward_terms={name: as_numpy(total) for name, total in self._reward_sums.items()},
            mean_speed=as_numpy(self._mean_speed_sums) / made,
            min_time_gap=as_numpy(headway).min(0),
            max_braking=as_numpy(self._max_braking).max(0),
            episodes=self._log.make_episodes(*kept, driver_log, share) if self._keep_record else (),
        )
