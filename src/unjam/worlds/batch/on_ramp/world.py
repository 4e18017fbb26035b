"""W motorways that a ramp joins as one world to drive in: CAVs hold their own ACCs back, as in SUMO.

Rows of CAVs are in the order in which they entered, whatever their road.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.command import Command, batch_commanded_accelerations, commanded_time_gaps
from unjam.drivers.local_state import ADJACENT_POSITIONS, MAX_OBSERVED_GAP, SECTIONS_AHEAD, LocalState
from unjam.drivers.roadside import RoadSections, RoadsideMessages
from unjam.physics.arrays import Floats
from unjam.physics.kinematics import next_speed
from unjam.scenarios.on_ramp import OnRamp
from unjam.scenarios.road import MotorwayRoad
from unjam.worlds.batch.leaders import CONTACT_GAP
from unjam.worlds.batch.on_ramp.record import MotorwayLog
from unjam.worlds.batch.on_ramp.traffic import NO_SPEED_CAP, BatchMotorways, LearnedCorrection, enable_acc
from unjam.worlds.batch.on_ramp.vehicles import (
    NUMBERS_PER_ROAD,
    MotorwayVehicles,
    find_rows,
    neighbors_on_lane,
    vehicle_numbers,
)
from unjam.worlds.record import Episode
from unjam.worlds.world import DriverLog, ProgressCallback


class ReplayOptions(NamedTuple):
    """What is otherwise where the people of an episode come once more, all at the same times."""

    seeds: Sequence[tuple[Sequence[int], Sequence[int]]]
    """of what people misjudge, and of exploration, for each road"""
    control_steps: int
    """after which it ends"""
    has_driver_errors: bool
    """whether people misjudge anything"""
    correction: LearnedCorrection | None
    """what people do besides"""


class MotorwayBatch:
    """W on-ramps of the same kind, each with a seed of its own; alike SUMO's in distribution."""

    is_scalar = False
    measured_fields: Collection[str] = ()
    """fields of a `LocalState` that the driver looks at"""
    remaining_rows: Sequence[int] | None = None

    def __init__(
        self,
        scenario: OnRamp,
        seeds: Sequence[Sequence[int]],
        dtype: type = np.float64,
        explore: Sequence[float] | None = None,
        replay: "ReplayOptions | None" = None,
    ) -> None:
        """Take empty roads, one for each seed; numbers have the precision `kind`.

        By `explore` exploration noise counts on each road; None: as it is drawn. `resume_arguments`: what is otherwise
        than in the episodes of these seeds.
        """
        self._exploration_scales = np.ones(len(seeds)) if explore is None else np.array(explore)
        self.scenario, self._seeds = scenario, seeds
        drawn = [scenario.draw_from_seed(seed) for seed in seeds]
        self.roads = [cast(MotorwayRoad, road) for road, _ in drawn]
        self._replay, own = replay, [(noise, seed) for _, (noise, seed, *_) in drawn]
        self._human_generators, self._exploration_generators = (
            [np.random.default_rng(seed) for seed in seeds]
            for seeds in zip(*(own if replay is None else replay.seeds), strict=True)
        )
        self._dtype, step = dtype, self.scenario.simulation_step
        numbers, learned = lambda values: values.astype(dtype), replay and replay.correction
        taken = self.scenario.steps_per_control_step
        self._traffic = BatchMotorways(self.roads, step, self._draw_errors, numbers, learned, taken)
        entries = max(len(road.entries) for road in self.roads)
        self._is_cav = np.zeros((len(drawn), entries), bool)
        for number, road in enumerate(self.roads):
            self._is_cav[number, : len(road.entries)] = [entry.name in road.cav_ids for entry in road.entries]
        ways, road = len(self.roads[0].lane_names), self.roads[0]
        self._road_sections = RoadSections(ways, road.length, len(drawn))
        self._messages = RoadsideMessages(road.roadside, self.scenario.control_step, self._human_generators[0])
        self.limits, self.control_steps, self.entered_count = self.scenario.acceleration_limits, 0, 0
        self._cav_numbers: NDArray[np.intp] = np.zeros(0, np.intp)
        """road and entry of each CAV as one number, in order of entry"""
        self._cav_entry_counts = np.zeros(len(drawn))
        """CAVs that have entered each road"""
        self._is_controlled, self._has_time_gap_commands = False, False
        self._episode_noise: Floats | None = None
        """what networks explore with all episode long, of each road"""
        decision_step = self.scenario.control_step
        planned = self.scenario.horizon * decision_step
        self._log = MotorwayLog(self.roads, entries, step, decision_step, planned)

    def _draw_errors(self, shape: tuple[int, ...]) -> Floats:
        """Return the errors of all vehicles in this step: each road draws its own."""
        if self._replay is not None and not self._replay.has_driver_errors:
            return np.zeros(shape, self._dtype)
        counts = np.bincount(self._traffic.vehicles.road, minlength=len(self.roads))
        drawn = [
            generator.standard_normal((shape[0], count))
            for generator, count in zip(self._human_generators, counts.tolist(), strict=True)
        ]
        return np.concatenate(drawn, 1).astype(self._dtype)

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> None:
        """Begin with empty roads; nothing was before."""
        self._is_controlled = is_controlled
        self._update_cavs()

    @property
    def cav_count(self) -> int:
        """CAVs on the roads now."""
        return len(self._cav_numbers)

    @property
    def cav_roads(self) -> NDArray[np.intp]:
        """Which road each CAV is on, shape (CAVs,)."""
        return self._cav_numbers // NUMBERS_PER_ROAD

    @property
    def has_ended(self) -> bool:
        """Whether the horizon is reached."""
        horizon = self.scenario.horizon if self._replay is None else self._replay.control_steps
        return self.control_steps >= horizon

    def local_state(self) -> LocalState:
        """Return what the CAVs perceive now: arrays of shape (CAVs,)."""
        return self._local_state

    def advance(self, command: Command | None) -> None:
        """Simulate one decision, held over its steps; None: the CAVs stay human."""
        scenario, before = self.scenario, self._local_state.speed
        wanted = None
        if self._is_controlled:
            wanted = batch_commanded_accelerations(command, self.limits, self.cav_count, self.control_steps)
            self._set_time_gaps(command)
        for _ in range(scenario.steps_per_control_step):
            if wanted is not None:
                self._apply_set_speeds(np.asarray(wanted, np.float64))
            left = self._traffic.step()
            vehicles = self._traffic.vehicles
            ahead = neighbors_on_lane(self._traffic.neighbors.leaders, vehicles.lane)
            self._log.record_step(vehicles, ahead, left, find_rows(self._cav_numbers, vehicles), self._is_controlled)
        self.control_steps += 1
        self._update_cavs()
        after, kept = before.copy(), slice(len(before)) if self.remaining_rows is None else self.remaining_rows
        after[kept] = self._local_state.speed[: len(after[kept])]
        self._log.record_accelerations((after - before) / scenario.control_step)

    def _set_time_gaps(self, command: Command | None) -> None:
        """Let CAVs' ACCs keep the time headways that a driver asks for; their own, where it asks no more."""
        self._has_time_gap_commands = self._has_time_gap_commands or (
            command is not None and command.time_gap is not None
        )
        if not self._has_time_gap_commands:
            return
        names = [str(number) for number in self._cav_numbers]
        least = self.scenario.cruise.time_gap
        headways = commanded_time_gaps(command, least, names, self.control_steps)
        self._traffic.vehicles.time_headway[find_rows(self._cav_numbers, self._traffic.vehicles)] = headways

    def _apply_set_speeds(self, accelerations: Floats) -> None:
        """Give each CAV a set speed, or none where its ACC may drive as it likes or a lane closes."""
        vehicles, cruise, step = self._traffic.vehicles, self.scenario.cruise, self.scenario.simulation_step
        found = find_rows(self._cav_numbers, vehicles)
        there = found >= 0
        rows, accelerations = found[there], accelerations[there]
        speed, stretch = vehicles.speed[rows].astype(np.float64), self._traffic.geometry
        asked = cruise.set_speed(speed, next_speed(speed, accelerations, step), self.limits.highest, step)
        beside = (vehicles.position[rows] >= stretch.merge_start) & (vehicles.position[rows] < stretch.merge_end)
        vehicles.speed_cap[rows] = np.where(beside, NO_SPEED_CAP, np.minimum(asked, NO_SPEED_CAP))

    def _update_cavs(self) -> None:
        """Note who is where after a decision, and take control of the CAVs that have entered."""
        vehicles = self._traffic.vehicles
        there = find_rows(self._cav_numbers, vehicles) >= 0
        keys = vehicle_numbers(vehicles)
        chosen_ones = np.flatnonzero(self._is_cav[vehicles.road, vehicles.entry])
        new = chosen_ones[~np.isin(keys[chosen_ones], self._cav_numbers)]
        new = new[np.argsort(keys[new], kind="stable")]
        self.remaining_rows = np.flatnonzero(there).tolist() if len(new) or not there.all() else None
        self._cav_numbers = np.concatenate([self._cav_numbers[there], keys[new]])
        self.entered_count += len(new)
        if self._is_controlled and len(new):
            enable_acc(vehicles, new, self.scenario.cruise)
        self._cav_entry_counts += np.bincount(vehicles.road[new], minlength=len(self.roads))
        means = self._road_sections.mean_speeds(
            vehicles.lane, vehicles.position, vehicles.speed, self._traffic.geometry.speed_limit, vehicles.road
        )
        self._messages.send(means)
        self._local_state = self._exact_state(vehicles)
        waiting = self._traffic.insertion_queue.backlog(self._traffic.time - self.scenario.simulation_step)
        gaps = self._gaps(vehicles)
        touched = vehicles.road[gaps < CONTACT_GAP]
        self._log.end_steps[touched] = np.minimum(self._log.end_steps[touched], self.control_steps)
        self._log.record_control_step(vehicles, gaps, waiting, self._cav_numbers, self._local_state)

    def _gaps(self, vehicles: MotorwayVehicles) -> Floats:
        """Return the gaps of all to those ahead on their ways [m]; NaN where nobody is."""
        if not len(vehicles.road):
            return np.zeros(0)
        row = neighbors_on_lane(self._traffic.neighbors.leaders, vehicles.lane)
        gaps = vehicles.position[row] - self.roads[0].vehicle_length - vehicles.position
        return np.where(row >= 0, gaps, np.nan)

    def _exact_state(self, vehicles: MotorwayVehicles) -> LocalState:
        """Return what exact sensors of the CAVs would read now."""
        rows, road = find_rows(self._cav_numbers, vehicles), self.roads[0]
        if not len(rows):
            return _empty_state()
        near = self._traffic.neighbors
        way, place, speed = vehicles.lane[rows], vehicles.position[rows], vehicles.speed[rows]

        def neighbor_state(neighbors: NDArray[np.intp], lane_offset: int, direction: float) -> tuple[Floats, Floats]:
            row = neighbors_on_lane(neighbors, vehicles.lane + lane_offset)[rows]
            gap = direction * (vehicles.position[row] - place) - road.vehicle_length
            there = (row >= 0) & (gap < MAX_OBSERVED_GAP)
            return np.where(there, vehicles.speed[row], speed), np.where(there, gap, MAX_OBSERVED_GAP)

        beside = [
            neighbor_state(each, side, sign)
            for side in (1, -1)
            for each, sign in ((near.leaders, 1.0), (near.followers, -1.0))
        ]
        ramp = (way == 0) & (place < road.merge_position)
        allowed = np.where(ramp, self._traffic.geometry.ramp_speed_limit, self._traffic.geometry.speed_limit)
        lane_speeds, road_speeds = self._road_sections.speeds_ahead(
            self._messages.latest, way, place, vehicles.road[rows]
        )
        share = self._cav_entry_counts / self._traffic.insertion_queue.entry_counts.clip(1)
        found = LocalState(
            speed,
            *neighbor_state(near.leaders, 0, 1.0),
            *neighbor_state(near.followers, 0, -1.0),
            place - road.merge_position,
            np.full(len(rows), np.nan),
            allowed_speed=allowed * vehicles.speed_factor[rows],
            distance_to_merge=road.merge_position - place,
            lane_speeds=lane_speeds,
            road_speeds=road_speeds,
            adjacent_gaps=np.stack([gap for _, gap in beside], -1),
            adjacent_speeds=np.stack([its for its, _ in beside], -1),
            penetration_rate=share[vehicles.road[rows]],
        )
        return found.map(lambda values: values.astype(np.float64)).as_read_only()

    def noise(self, episode_noise_size: int = 0) -> Floats:
        """Return standard normal noise for one look of a network, shape (CAVs,), or what lasts."""
        roads = self.cav_roads
        if episode_noise_size:
            if self._episode_noise is None:
                each = [generator.standard_normal(episode_noise_size) for generator in self._exploration_generators]
                self._episode_noise = np.stack(each)
            return self._exploration_scales[roads, None] * self._episode_noise[roads]
        found = np.empty(len(roads))
        for road in np.unique(roads).tolist():
            here = roads == road
            found[here] = self._exploration_generators[road].standard_normal(int(here.sum()))
        return self._exploration_scales[roads] * found

    def record(self, driver_log: DriverLog) -> tuple[Episode, ...]:
        """Return what happened on each road since the start, without what was earned."""
        return self._log.make_episodes(driver_log, self._seeds, NUMBERS_PER_ROAD)


def _empty_state() -> LocalState:
    """Return what is perceived where no CAV is on the road."""
    one, many, four = np.zeros(0), np.zeros((0, SECTIONS_AHEAD)), np.zeros((0, len(ADJACENT_POSITIONS)))
    own = LocalState(one, one, one, one, one, one, one)
    told = {"allowed_speed": one, "distance_to_merge": one, "lane_speeds": many, "road_speeds": many}
    return own._replace(**told, adjacent_gaps=four, adjacent_speeds=four, penetration_rate=one)
