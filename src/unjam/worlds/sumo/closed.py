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
from numpy.typing import NDArray

from unjam.drivers.command import Command
from unjam.drivers.local_state import LocalState
from unjam.errors import EpisodeError
from unjam.physics.arrays import Array
from unjam.physics.kinematics import next_position, next_speed
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import Scenario
from unjam.worlds.record import Episode, trajectory
from unjam.worlds.sumo.files import Files, files_of_built
from unjam.worlds.sumo.neighbours import loop_neighbours, loop_state, places_along
from unjam.worlds.sumo.people import drivers_of, wanted_speeds
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.traffic import Scene, Seed, Traffic
from unjam.worlds.world import Driven, OnProgress

HISTORY = 60.0
"""seconds of the warm-up that a driver may remember"""
NOISE_BLOCK = 100
"""steps for which noise is drawn at once"""
ODOMETER_TOLERANCE = 1e-6
"""by how much positions may differ from SUMO's odometer at the end [m]"""


class ClosedTraffic(Traffic[ClosedRoad]):
    """The actual environment of a closed road."""

    def __init__(
        self, scenario: Scenario, road: ClosedRoad, seed: Seed, simulation: Simulation, full: bool
    ) -> None:
        """Put the vehicles on the road; nothing moves yet."""
        super().__init__(scenario, road, seed, simulation, full)
        self.entered = len(road.cav_ids)
        self._places = {name: place for place, name in enumerate(road.vehicle_ids)}
        cavs = [self._places[name] for name in road.cav_ids]
        self._cavs = cavs
        self._near = loop_neighbours(np.array(cavs), len(road.vehicle_ids))
        self._near_single = loop_neighbours(cavs[0], len(road.vehicle_ids))
        self._commanded = scenario.people == "commanded"
        self._drivers = drivers_of(scenario, road, road.vehicle_ids)
        needed = [range(len(road.vehicle_ids))] if self._commanded else self._near
        self._near_positions: dict[int, float] = {
            int(place): float(road.start_positions[place])
            for places in needed
            for place in np.atleast_1d(places)
        }
        self._be_human(road.vehicle_ids)
        if self._commanded:
            simulation.command_people(road.vehicle_ids, scenario.right_of_way)
        self._exploration: Any = None
        self._speeds = simulation.speeds(road.vehicle_ids)
        if simulation.vehicle_count() != len(road.vehicle_ids):
            self._miss()
        self._forget()

    def _files(self) -> Files:
        return files_of_built(self.scenario, self.road)

    def _be_human(self, ids: Sequence[str]) -> None:
        """Let `ids` be those whose driving has noise, from the next step on."""
        self._human_ids = ids
        self._human_mask = [name in ids for name in self.road.vehicle_ids]
        self._human_places = [place for place, human in enumerate(self._human_mask) if human]
        self._noise_rows: list[list[float]] = []

    def _forget(self) -> None:
        """Begin the log anew."""
        self._log_moved = array("d")  # speeds with which the vehicles moved, before noise; row after row
        self._log_speeds = array("d", self._speeds)
        self._started = self._simulation.distances(self.road.vehicle_ids)
        self.log_fuel = []
        self._log_applied = array("d")
        self._log_commanded = array("d")

    def start(self, controlled: bool, on_progress: OnProgress | None = None) -> LocalState | None:
        """Run the warm-up, then hand the CAVs over."""
        scenario, history = self.scenario, None
        self._warm_up(self._simulate, on_progress)
        if scenario.warmup and scenario.recall_warmup:
            each = scenario.steps_per_decision
            moments = list(range(scenario.warmup - each, -1, -each))[
                : round(HISTORY / scenario.decision_step)
            ]
            states = self.states(*self.speeds_and_positions(), np.array(self._cavs))
            history = states.each(lambda values: values[:, moments[::-1]])
        self._controlled = controlled
        if controlled:
            self._simulation.take_control(self.road.cav_ids, scenario.actuation, scenario.right_of_way)
            self._be_human([name for name in self.road.vehicle_ids if name not in self.road.cav_ids])
        self._forget()
        return history

    @property
    def cavs(self) -> Sequence[str]:
        """The CAVs: the same ones all the time."""
        return self.road.cav_ids

    @property
    def speeds(self) -> list[float]:
        """Speeds of all vehicles now [m/s], in road order."""
        return self._speeds

    def positions(self) -> NDArray[np.float64]:
        """Return where the front bumpers of all vehicles are now along the road, not wrapped [m]."""
        return self.road.start_positions + np.array(self._simulation.distances(self.road.vehicle_ids))

    def perceive(self) -> LocalState:
        """Return what the CAVs perceive now."""
        near = self._near_positions
        if self.single:
            return loop_state(self._speeds, near, self._near_single, self.road.loop_length)
        positions = np.full(len(self._speeds), np.nan)
        positions[list(near)] = list(near.values())
        return loop_state(np.array(self._speeds), positions, self._near, self.road.loop_length)

    def advance(self, command: Command | None) -> None:
        """Simulate one decision."""
        scenario, cavs = self.scenario, self._cavs
        if not self._controlled:
            for _ in range(scenario.steps_per_decision):
                self._simulate()
        else:
            step, applied = scenario.simulation_step, self._told(command)
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
        self.decisions += 1
        if self.full:
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
        noise = self._next_noise() if self.scenario.noise > 0 else [0.0] * len(self._speeds)
        wanted = wanted_speeds(
            self.scenario,
            self.road,
            self._drivers,
            self._human_places,
            self._speeds,
            self._near_positions,
            noise,
        )
        self._simulation.command_speeds(self._human_ids, wanted)

    def noise(self) -> Array:
        """Return standard normal noise of this decision, drawn for the whole episode at once."""
        if self._exploration is None:
            drawn = self._exploration_generator.standard_normal((self.scenario.horizon, len(self._cavs)))
            self._exploration = drawn[:, 0].tolist() if self.single else drawn
        return self._exploration[self.decisions]

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

    def record(self, driven: Driven) -> Episode:
        """Return what happened since the start."""
        road, each = self.road, self.scenario.steps_per_decision
        speeds, positions = (values[:, ::each] for values in self.speeds_and_positions())
        states = self.states(speeds, positions, np.arange(len(road.vehicle_ids)))
        applied, shield = self._applied(), self._shield()
        trajectories = tuple(
            trajectory(
                vehicle=name,
                number=row,
                start=0,
                rows=None if self.single else np.full(self.decisions + 1, row),
                states=states.each(lambda values: np.ascontiguousarray(values[place])),  # noqa: B023
                applied=np.ascontiguousarray(applied[:, row]),
                shield=np.ascontiguousarray(shield[:, row]),
                terminated=self.crashed,
                driven=driven,
            )
            for row, (name, place) in enumerate(zip(road.cav_ids, self._cavs, strict=True))
        )
        return Episode(
            **self._facts(),
            vehicle_ids=road.vehicle_ids,
            cav_ids=road.cav_ids,
            speeds=np.ascontiguousarray(speeds.T),
            positions=np.ascontiguousarray(positions.T),
            gaps=np.ascontiguousarray(states.leader_gap.T),
            fuel=np.array(self.log_fuel) if self.full else np.zeros((0, 0)),
            loop_length=road.loop_length,
            crossings=road.crossings,
            outline=road.outline,
            trajectories=trajectories,
        )

    def scene(self) -> Scene:
        """Return this moment as pictures show it."""
        cavs = np.isin(np.arange(len(self._speeds)), self._cavs)
        outline, loop = self.road.outline, self.road.loop_length
        places = places_along(outline, self.positions(), loop)
        return Scene(outline[:, 1:], places, np.array(self._speeds), cavs)

    def _applied(self) -> NDArray[np.float64]:
        """Return the CAVs' commands within the action limit, of humans what they did [m/s2], (T, CAVs)."""
        if self._log_applied:
            return np.array(self._log_applied).reshape(-1, len(self._cavs))
        speeds = np.array(self._log_speeds).reshape(-1, len(self._human_mask))[:, self._cavs]
        return np.diff(speeds[:: self.scenario.steps_per_decision], axis=0) / self.scenario.decision_step

    def _shield(self) -> NDArray[np.float64]:
        """Return the hardest braking that SUMO added to each command, zero if it let it pass, (T, CAVs)."""
        if not self._log_commanded:
            return np.zeros((self.decisions, len(self._cavs)))
        commanded = np.array(self._log_commanded).reshape(-1, len(self._cavs))
        moved = np.array(self._log_moved).reshape(-1, len(self._human_mask))[:, self._cavs]
        added = (commanded - moved) / self.scenario.simulation_step
        return added.reshape(-1, self.scenario.steps_per_decision, len(self._cavs)).max(1).clip(0.0, None)

    def _miss(self) -> None:
        present, wanted = self._simulation.vehicle_count(), len(self.road.vehicle_ids)
        raise EpisodeError(f"{present} vehicles on the road where {wanted} should be")
