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

from unjam.drivers.car_following import SMALLEST_GAP
from unjam.drivers.command import Command
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import Ahead
from unjam.errors import EpisodeError
from unjam.physics.arrays import Array, at_least
from unjam.physics.idm import idm_acceleration
from unjam.physics.kinematics import gap_on_loop, next_speed
from unjam.scenarios.population import as_calibrated
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario
from unjam.worlds.closed import HISTORY, NOISE_BLOCK, ClosedLog, loop_neighbours, loop_state, places_along
from unjam.worlds.record import Episode, Floats
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.traffic import LEAVE_TO_SUMO, Scene, Seed, Traffic
from unjam.worlds.world import Driven, OnProgress


class ClosedTraffic(Traffic[ClosedRoad]):
    """The actual environment of a closed road."""

    def __init__(
        self, scenario: Scenario, road: ClosedRoad, seed: Seed, simulation: Simulation, full: bool
    ) -> None:
        """Put the vehicles on the road; nothing moves yet."""
        super().__init__(scenario, road, seed, simulation, full)
        vehicles = len(road.vehicle_ids)
        self.cavs, self.entered = road.cav_ids, len(road.cav_ids)
        self._touched: set[str] = set()
        """who was in contact with another"""
        self._places = [road.vehicle_ids.index(name) for name in road.cav_ids]
        """of the CAVs, in road order"""
        self._near = loop_neighbours(np.array(self._places), vehicles)
        self._near_single = loop_neighbours(self._places[0], vehicles)
        self._loop: Any = road.loop_length, road.crossings
        self._commanded = scenario.human_control == "commanded"
        self._drivers = self._drivers_of(road.vehicle_ids)
        needed = range(vehicles) if self._commanded else np.concatenate(self._near).tolist()
        self._near_positions = {place: float(road.start_positions[place]) for place in needed}
        self._be_human(road.vehicle_ids)
        if self._commanded:
            simulation.command_people(road.vehicle_ids, scenario.right_of_way, scenario.bounded)
        self._exploration: Any = None
        self.speeds = simulation.speeds(road.vehicle_ids)
        self._expect_all()
        self._forget()

    def _be_human(self, ids: Sequence[str]) -> None:
        """Let `ids` be those whose driving has noise, from the next step on."""
        self._human_ids = ids
        self._human_mask = [name in ids for name in self.road.vehicle_ids]
        self._human_places = [place for place, human in enumerate(self._human_mask) if human]
        self._noise_rows: list[list[float]] = []

    def _forget(self) -> None:
        """Begin the log anew."""
        self._log_moved = array("d")  # speeds with which the vehicles moved, before noise; row after row
        self._log_speeds = array("d", self.speeds)
        self._started = self._simulation.distances(self.road.vehicle_ids)
        self.log_fuel = []
        self._log_wanted = array("d")
        self._log_told = array("d")  # of each CAV in each simulation step
        self._log_commanded = array("d")

    def start(self, controlled: bool, on_progress: OnProgress | None = None) -> LocalState | None:
        """Run the warm-up, then hand the CAVs over, unless they stay human (`controlled` false).

        Returns:
            What the CAVs perceived in the last minute of the warm-up at the times of decisions, shape
            (CAVs, moments), oldest first; None without a warm-up that may be remembered.
        """
        scenario, history = self.scenario, None
        self._loop = self.road.loop_length, self.road.crossings, self.road.share_told(self.asked)
        self._warm_up(self._simulate, on_progress)
        if scenario.warmup and scenario.recall_warmup:
            each = scenario.steps_per_decision
            moments = list(range(scenario.warmup - each, -1, -each))[
                : round(HISTORY / scenario.decision_step)
            ]
            states = loop_state(*self.speeds_and_positions(), self._near, *self._loop)
            history = states.at(np.s_[:, moments[::-1]])
        self._controlled = controlled
        if controlled:
            self._simulation.take_control(self.road.cav_ids, scenario.actuation, scenario.right_of_way)
            self._be_human([name for name in self.road.vehicle_ids if name not in self.road.cav_ids])
        self._forget()
        return history

    def positions(self) -> Floats:
        """Return where the front bumpers of all vehicles are now along the road, not wrapped [m]."""
        return self.road.start_positions + np.array(self._simulation.distances(self.road.vehicle_ids))

    def exact_state(self) -> LocalState:
        """Return what exact sensors of the CAVs would read now."""
        near = self._near_positions
        if self.single:
            return loop_state(self.speeds, near, self._near_single, *self._loop)
        positions = np.full(len(self.speeds), np.nan)
        positions[list(near)] = list(near.values())
        return loop_state(np.array(self.speeds), positions, self._near, *self._loop).read_only()

    def advance(self, command: Command | None) -> None:
        """Simulate one decision, held over its simulation steps; None: the CAVs stay human."""
        self._simulation.check()
        wanted = self._told(command) if self._controlled else []
        self._log_wanted.fromlist(wanted)
        for _ in range(self.scenario.steps_per_decision):
            if self._controlled:
                self._drive_cavs(wanted)
            self._simulate()
        self.decisions += 1
        if self.full:
            self.log_fuel.append(self._simulation.fuel(self.road.vehicle_ids))

    def _drive_cavs(self, wanted: list[float]) -> None:
        """Ask for the speeds that the CAVs' accelerations lead to in this step, once they are filtered."""
        speeds, near, step = self.speeds, self._near_positions, self.scenario.simulation_step
        loop, last, carry_out = self.road.loop_length, len(speeds) - 1, self._carry_out
        told, commanded = [], []
        for name, place, acceleration in zip(self.cavs, self._places, wanted, strict=True):
            speed, leader = speeds[place], place + 1 if place < last else 0
            gap = gap_on_loop(near[place], near[leader], loop, VEHICLE_LENGTH)
            allowed, done = carry_out(name, acceleration, Ahead(speed, speeds[leader], gap))
            told.append(allowed)
            commanded.append(next_speed(speed, done, step))
        self._log_told.fromlist(told)
        self._log_commanded.fromlist(commanded)
        self._simulation.command_speeds(self.cavs, commanded)

    def _simulate(self) -> None:
        """Simulate one step, and add the humans' noise to their speeds.

        Two formulas of `physics.kinematics` are written out here: calls would cost a tenth of the episode.
        """
        simulation, near, step = self._simulation, self._near_positions, self.scenario.simulation_step
        if self._commanded:
            self._command_people()
        simulation.step()
        self._expect_all()
        speeds = simulation.speeds(self.road.vehicle_ids)
        self._log_moved.fromlist(speeds)
        for place in near:
            near[place] += speeds[place] * step
        if self.scenario.noise > 0 and not self._commanded:
            speeds = list(map(add, speeds, self._next_noise()))
            if min(speeds) < 0.0:
                speeds = [at_least(speed, 0.0) for speed in speeds]
            simulation.replace_speeds(self._human_ids, compress(speeds, self._human_mask))
        self.speeds = speeds
        self._log_speeds.fromlist(speeds)
        if colliding := simulation.colliding():
            self._touched.update(colliding)
            self.crashed = True

    def _expect_all(self) -> None:
        """Raise `EpisodeError` where not all vehicles are on the road."""
        present, wanted = self._simulation.vehicle_count(), len(self.road.vehicle_ids)
        if present != wanted:
            raise EpisodeError(f"{present} vehicles on the road where {wanted} should be")

    def _command_people(self) -> None:
        """Ask for the speeds that people want: IDM with noise, as Flow does it; on a crossing SUMO drives."""
        scenario, road, speeds, positions = self.scenario, self.road, self.speeds, self._near_positions
        noise = self._next_noise() if scenario.noise > 0 else [0.0] * len(speeds)
        step, loop, crossings = scenario.simulation_step, road.loop_length, road.crossings
        population = scenario.calibrated
        wanted = dict.fromkeys(self._human_places, LEAVE_TO_SUMO)
        seen: list[tuple[int, float, float, float, float]] = []
        for place in self._human_places:
            position = positions[place]
            on_road = position % loop
            for start, end in crossings:  # any() would cost as much as the rest
                if start <= on_road < end:
                    break
            else:
                speed, ahead = speeds[place], place + 1 if place + 1 < len(speeds) else 0
                gap = at_least(gap_on_loop(position, positions[ahead], loop, VEHICLE_LENGTH), SMALLEST_GAP)
                acceleration = idm_acceleration(speed, speeds[ahead], gap, self._drivers[place])
                if population is None:
                    wanted[place] = at_least(speed + acceleration * step + noise[place], 0.0)
                else:
                    seen.append((place, acceleration, speed, speeds[ahead], gap))
        if seen:  # a population's network is asked once for all
            _, *columns = (np.array(column, np.float64) for column in zip(*seen, strict=True))
            accelerations = as_calibrated(population, *columns).tolist()
            for (place, _, speed, *_), acceleration in zip(seen, accelerations, strict=True):
                wanted[place] = at_least(speed + acceleration * step + noise[place], 0.0)
        self._simulation.command_speeds(self._human_ids, wanted.values())

    def noise(self, lasting: int = 0) -> Array:
        """Return standard normal noise of this decision, drawn for the whole episode at once."""
        if lasting:
            return super().noise(lasting)
        if self._exploration is None:
            drawn = self._exploration_generator.standard_normal((self.scenario.horizon, len(self.cavs)))
            self._exploration = drawn[:, 0].tolist() if self.single else drawn
        return self._exploration[self.decisions]

    def _next_noise(self) -> list[float]:
        """Return by how much noise changes each speed in this step, not at all for CAVs [m/s]."""
        if not self._noise_rows:
            draws = self._noise_generator.standard_normal((NOISE_BLOCK, len(self._human_mask)))
            scale = self.scenario.noise_per_step * self.scenario.simulation_step
            self._noise_rows = (draws * np.where(self._human_mask, scale, 0.0)).tolist()[::-1]
        return self._noise_rows.pop()

    def _log(self) -> ClosedLog:
        """Return what was logged since the log began."""
        vehicles, cavs = len(self._human_mask), len(self.cavs)
        return ClosedLog(
            scenario=self.scenario,
            road=self.road,
            start=self.road.start_positions + np.array(self._started),
            moved=np.array(self._log_moved).reshape(-1, vehicles),
            speeds=np.array(self._log_speeds).reshape(-1, vehicles),
            wanted=np.array(self._log_wanted).reshape(-1, cavs),
            told=np.array(self._log_told).reshape(-1, cavs),
            commanded=np.array(self._log_commanded).reshape(-1, cavs),
            crashed=self.crashed,
            fuel=np.array(self.log_fuel) if self.full else np.zeros((0, 0)),
            cav_share=self.road.share_told(self.asked),
        )

    def speeds_and_positions(self) -> tuple[Floats, Floats]:
        """Return speeds [m/s] and positions [m] in every simulation step since the log began.

        Shape (vehicles, moments), the first moment being the start.

        Positions are SUMO's Euler step over the recorded speeds, checked against SUMO's own odometer.
        """
        return self._checked(self._log())

    def record(self, driven: Driven) -> Episode:
        """Return what happened since the start."""
        log, rows = self._log(), None if self.single else np.arange(len(self.cavs))
        facts = {**self._facts(), "collisions": len(self._touched)}
        return log.episode(self._checked(log), facts, driven, rows)

    def _checked(self, log: ClosedLog) -> tuple[Floats, Floats]:
        speeds, positions = log.moments()
        self._check_odometer(self.road.vehicle_ids, self.road.start_positions, positions[:, -1])
        return speeds, positions

    def last_applied(self) -> Floats:
        """Return what the CAVs were told in the last decision, once it was filtered [m/s2], shape (CAVs,)."""
        told = np.array(self._log_told[-len(self.cavs) * self.scenario.steps_per_decision :])
        return told.reshape(-1, len(self.cavs)).mean(0)

    def scene(self) -> Scene:
        """Return this moment as pictures show it."""
        outline, loop = self.road.outline, self.road.loop_length
        places, cavs = self.positions(), np.isin(np.arange(len(self.speeds)), self._places)
        return Scene(outline[:, 1:], places_along(outline, places, loop), np.array(self.speeds), cavs)
