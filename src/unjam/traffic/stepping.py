"""Traffic of one episode, step by step: what `run_episode` and every other view of it go through.

The inner loop works on lists of plain floats. Between two steps of SUMO the caches are cold, and a NumPy
call on 22 numbers then costs more than a list comprehension.
"""

from array import array
from collections.abc import Callable, Sequence
from itertools import compress
from math import isfinite
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.local_state import LocalState
from unjam.errors import EpisodeError, InputError
from unjam.physics.arrays import Array, clip
from unjam.physics.kinematics import next_position, next_speed
from unjam.scenarios.scenario import Scenario
from unjam.traffic.neighbours import loop_neighbours, loop_state
from unjam.traffic.people import wanted_speeds
from unjam.traffic.simulation import Simulation

HISTORY = 60.0
"""seconds of the warm-up that a driver may remember"""
WARMUP_PROGRESS_STEPS = 500
NOISE_BLOCK = 100
"""steps for which noise is drawn at once"""
ODOMETER_TOLERANCE = 1e-6
"""by how much positions may differ from SUMO's odometer at the end [m]"""


class Traffic:
    """The actual environment: start, perceive, advance by one decision, and the log of all of it."""

    def __init__(
        self,
        scenario: Scenario,
        seed: Sequence[int],
        simulation: Simulation,
        plain_numbers: bool = False,
        record_fuel: bool = False,
    ) -> None:
        """Put the vehicles of `seed` on the road; nothing moves yet.

        With `plain_numbers`, a single CAV perceives and is driven in floats instead of arrays of one row.
        """
        road_seed, noise_seed, exploration_seed, sumo_seed = np.random.SeedSequence(list(seed)).spawn(4)
        self.scenario = scenario
        self.road = road = scenario.draw(np.random.default_rng(road_seed))
        self._exploration_generator = np.random.default_rng(exploration_seed)
        self.crashed = False
        self.collisions = 0
        """vehicles in contact with another"""
        self._controlled = False
        self._noise_generator = np.random.default_rng(noise_seed)
        self._simulation = simulation
        self._record_fuel = record_fuel
        simulation.load(road, scenario.simulation_step, int(sumo_seed.generate_state(1)[0]) % 2**31)

        self._places = {name: place for place, name in enumerate(road.vehicle_ids)}
        cavs = [self._places[name] for name in road.cav_ids]
        self.single = plain_numbers and len(cavs) == 1
        self._cavs = cavs
        self._near = loop_neighbours(cavs[0] if self.single else np.array(cavs), len(road.vehicle_ids))
        self._commanded = scenario.people == "commanded"
        needed = [range(len(road.vehicle_ids))] if self._commanded else self._near
        self._near_positions: dict[int, float] = {
            int(place): float(road.start_positions[place])
            for places in needed
            for place in np.atleast_1d(places)
        }
        self._be_human(road.vehicle_ids)
        if self._commanded:
            simulation.obey_right_of_way(road.vehicle_ids)
        self._speeds = simulation.speeds(road.vehicle_ids)
        if simulation.vehicle_count() != len(road.vehicle_ids):
            self._miss()
        self._forget()

    def _be_human(self, ids: Sequence[str]) -> None:
        """Let `ids` be those whose driving has noise, from the next step on."""
        self._human_ids = ids
        self._human_mask = [name in ids for name in self.road.vehicle_ids]
        self._noise_rows: list[list[float]] = []

    def _forget(self) -> None:
        """Begin the log anew."""
        self._log_moved = array("d")  # speeds with which the vehicles moved, before noise; row after row
        self._log_speeds = array("d", self._speeds)
        self._started = self._simulation.distances(self.road.vehicle_ids)
        self.log_fuel: list[list[float]] = []
        self._log_applied = array("d")
        self._log_commanded = array("d")

    def start(self, controlled: bool, progress: Callable[[int], None] | None = None) -> LocalState | None:
        """Run the warm-up, then hand the CAVs over, unless they stay human (`controlled` false).

        `progress` is called now and then with 0: no decision is made yet.

        Returns:
            What the CAVs perceived in the last minute of the warm-up at the times of decisions, shape
            (CAVs, moments), oldest first; None without a warm-up.
        """
        scenario, history = self.scenario, None
        for step in range(scenario.warmup):
            self._simulate()
            if self.crashed:
                raise EpisodeError(f"collision in step {step} of the all-human warm-up")
            if progress is not None and step % WARMUP_PROGRESS_STEPS == 0:
                progress(0)
        if scenario.warmup:
            each = scenario.steps_per_decision
            moments = list(range(scenario.warmup - each, -1, -each))[
                : round(HISTORY / scenario.decision_step)
            ]
            states = self.states(*self.speeds_and_positions(), np.array(self._cavs))
            history = LocalState(*(values[:, moments[::-1]] for values in states))
        self._controlled = controlled
        if controlled:
            self._simulation.take_control(self.road.cav_ids, scenario.actuation)
            self._be_human([name for name in self.road.vehicle_ids if name not in self.road.cav_ids])
        self._forget()
        return history

    @property
    def speeds(self) -> list[float]:
        """Speeds of all vehicles now [m/s], in road order."""
        return self._speeds

    def positions(self) -> NDArray[np.float64]:
        """Return where the front bumpers of all vehicles are now along the road, not wrapped [m]."""
        return self.road.start_positions + np.array(self._simulation.distances(self.road.vehicle_ids))

    def local_state(self) -> LocalState:
        """Return what the CAVs perceive now: arrays of shape (CAVs,), or plain numbers of a single one."""
        near = self._near_positions
        if self.single:
            return loop_state(self._speeds, near, self._near, self.road.loop_length)
        positions = np.full(len(self._speeds), np.nan)
        positions[list(near)] = list(near.values())
        return loop_state(np.array(self._speeds), positions, self._near, self.road.loop_length)

    def advance(self, acceleration: Array | None) -> None:
        """Simulate one decision: `acceleration` [m/s2] of every CAV, held over its simulation steps.

        A float or an array of shape (CAVs,), clipped to the action limit; None: the CAVs stay human.

        Raises:
            InputError: an acceleration is not finite, or there are not as many as CAVs.
        """
        scenario, cavs = self.scenario, self._cavs
        if not self._controlled:
            for _ in range(scenario.steps_per_decision):
                self._simulate()
        else:
            values = self._checked(acceleration)
            limit, step = scenario.action_limit, scenario.simulation_step
            applied = [clip(value, -limit, limit) for value in values]
            self._log_applied.fromlist(applied)
            for _ in range(scenario.steps_per_decision):
                speeds = self._speeds
                commanded = [
                    next_speed(speeds[place], wanted, step)
                    for place, wanted in zip(cavs, applied, strict=True)
                ]
                self._log_commanded.fromlist(commanded)
                self._simulation.command_speeds(self.road.cav_ids, commanded)
                self._simulate()
        if self._record_fuel:
            self.log_fuel.append(self._simulation.fuel(self.road.vehicle_ids))

    def _simulate(self) -> None:
        """Simulate one step, and add the humans' noise to their speeds.

        Two formulas of `physics.kinematics` are written out here: calls would cost a tenth of the episode.
        """
        simulation, near, step = self._simulation, self._near_positions, self.scenario.simulation_step
        if self._commanded:
            self._command_people()
        simulation.step()
        if simulation.vehicle_count() != len(self.road.vehicle_ids):
            self._miss()
        moved = simulation.speeds(self.road.vehicle_ids)
        self._log_moved.fromlist(moved)
        for place in near:
            near[place] += moved[place] * step
        self._speeds = moved
        if self.scenario.noise > 0 and not self._commanded:
            noise = self._next_noise()
            self._speeds = [speed if speed > 0.0 else 0.0 for speed in map(add, moved, noise)]
            simulation.replace_speeds(self._human_ids, compress(self._speeds, self._human_mask))
        self._log_speeds.fromlist(self._speeds)
        self.collisions = max(self.collisions, simulation.colliding_count())  # SUMO tells of each only once
        self.crashed = self.collisions > 0

    def _command_people(self) -> None:
        """Ask for the speeds that people want."""
        people = list(compress(range(len(self._speeds)), self._human_mask))
        noise = [0.0] * len(self._speeds)
        if self.scenario.noise > 0:
            noise = self._next_noise()
        wanted = wanted_speeds(self.scenario, self.road, people, self._speeds, self._near_positions, noise)
        self._simulation.command_speeds(self._human_ids, wanted)

    def exploration_noise(self) -> Sequence[Array]:
        """Return standard normal noise for every decision of the episode: arrays (CAVs,), or floats."""
        noise = self._exploration_generator.standard_normal((self.scenario.horizon, len(self._cavs)))
        return noise[:, 0].tolist() if self.single else list(noise)

    def _next_noise(self) -> list[float]:
        """Return by how much noise changes each speed in this step, not at all for CAVs [m/s]."""
        if not self._noise_rows:
            self._draw_noise()
        return self._noise_rows.pop()

    def _draw_noise(self) -> None:
        draws = self._noise_generator.standard_normal((NOISE_BLOCK, len(self._human_mask)))
        scale = self.scenario.noise_per_step * self.scenario.simulation_step
        self._noise_rows = (draws * np.where(self._human_mask, scale, 0.0)).tolist()[::-1]

    def speeds_and_positions(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return speeds [m/s] and positions [m] in every simulation step since the log began.

        Shape (vehicles, moments), the first moment being the start.

        Positions are SUMO's Euler step over the recorded speeds, checked against SUMO's own odometer.
        """
        step, road = self.scenario.simulation_step, self.road
        start = road.start_positions + np.array(self._started)
        moved = np.array(self._log_moved).reshape(-1, len(start)).T
        speeds = np.array(self._log_speeds).reshape(-1, len(start)).T
        positions = np.column_stack([start, next_position(start[:, None], moved.cumsum(1), step)])
        error = float(np.abs(positions[:, -1] - self.positions()).max())
        if error > ODOMETER_TOLERANCE:
            raise EpisodeError(f"positions differ from SUMO's odometer by {error:.2g} m")
        return speeds, positions

    def states(
        self, speeds: NDArray[np.float64], positions: NDArray[np.float64], places: NDArray[np.intp]
    ) -> LocalState:
        """Return what the vehicles at `places` perceived, shape (places, moments)."""
        near = loop_neighbours(places, len(self.road.vehicle_ids))
        return loop_state(speeds, positions, near, self.road.loop_length)

    def applied(self) -> NDArray[np.float64]:
        """Return the CAVs' commands within the action limit, of humans what they did [m/s2], (T, CAVs)."""
        if self._log_applied:
            return np.array(self._log_applied).reshape(-1, len(self._cavs))
        speeds = np.array(self._log_speeds).reshape(-1, len(self._human_mask))[:, self._cavs]
        return np.diff(speeds[:: self.scenario.steps_per_decision], axis=0) / self.scenario.decision_step

    def shield(self) -> NDArray[np.float64]:
        """Return the hardest braking that SUMO added to each command, zero if it let it pass, (T, CAVs)."""
        if not self._log_commanded:
            return np.zeros_like(self.applied())
        commanded = np.array(self._log_commanded).reshape(-1, len(self._cavs))
        moved = np.array(self._log_moved).reshape(-1, len(self._human_mask))[:, self._cavs]
        added = (commanded - moved) / self.scenario.simulation_step
        return added.reshape(-1, self.scenario.steps_per_decision, len(self._cavs)).max(1).clip(0.0, None)

    def _checked(self, acceleration: Any) -> list[float]:
        """Return a driver's answer as plain floats; raise `InputError` where it cannot be commanded."""
        try:
            if self.single:
                values, shape = [float(acceleration)], (1,)
            else:
                wanted = np.asarray(acceleration, np.float64)
                values, shape = wanted.tolist(), wanted.shape
        except (TypeError, ValueError):
            raise InputError(f"{self._where()}: acceleration is not numbers: {acceleration!r}") from None
        if shape != (len(self._cavs),):
            allowed = f"({len(self._cavs)},), one for each CAV"
            raise InputError(f"{self._where()}: acceleration has shape {shape}; allowed: {allowed}")
        for name, value in zip(self.road.cav_ids, values, strict=True):
            if not isfinite(value):
                raise InputError(f"{self._where()}: acceleration of {name} is {value}; allowed: finite")
        return values

    def _where(self) -> str:
        return f"driver: step {len(self._log_applied) // len(self._cavs)}"

    def _miss(self) -> None:
        present, wanted = self._simulation.vehicle_count(), len(self.road.vehicle_ids)
        raise EpisodeError(f"{present} vehicles on the road where {wanted} should be")
