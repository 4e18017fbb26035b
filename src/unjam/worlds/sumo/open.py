"""Traffic on roads with ends: vehicles come and go, and each stay of a CAV is a trajectory of its own."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from unjam.drivers.command import Command
from unjam.drivers.local_state import LocalState
from unjam.physics.kinematics import next_speed
from unjam.scenarios.scenario import Scenario
from unjam.worlds.record import Episode, Trajectory, trajectory
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.traffic import Floats, RoadKind, Scene, Seed, Traffic
from unjam.worlds.world import Driven, OnProgress


class OpenTraffic(Traffic[RoadKind]):
    """What roads with ends have in common.

    A vehicle becomes a CAV at the first decision after it entered; until then it drives as people do. Its
    stay ends with the last decision after which it is still on the road.
    """

    def __init__(
        self, scenario: Scenario, road: RoadKind, seed: Seed, simulation: Simulation, full: bool
    ) -> None:
        """Put the vehicles on the road; nothing moves yet."""
        super().__init__(scenario, road, seed, simulation, full)
        self._on_road: dict[str, bool] = {}
        """who is there, in order of entry; true: to be driven by the driver"""
        self._cavs: list[str] = []
        self._waiting: list[int] = []
        self._arrived = 0

    # What each kind of road does in its own way.

    def _is_cav(self, name: str) -> bool:
        """Whether a vehicle that has just entered is a CAV."""
        raise NotImplementedError

    def _moved(self, left: Sequence[str], entered: Sequence[str]) -> None:
        """Follow how the vehicles moved in the last step, who left and who entered."""

    def _command_people(self) -> None:
        """Ask for the speeds that people want, where SUMO does not drive them."""

    def _moment(self) -> tuple[Sequence[str], Sequence[float], Sequence[float], Sequence[float]]:
        """Return names, speeds, positions and gaps of all vehicles on the road now."""
        raise NotImplementedError

    def _states(self, names: Sequence[str]) -> LocalState:
        """Return what CAVs perceive now."""
        raise NotImplementedError

    def _pictured(self, vehicles: Sequence[str]) -> dict[str, Any]:
        """Return what the record says of the road itself."""
        raise NotImplementedError

    # What all of them do alike.

    def start(self, controlled: bool, on_progress: OnProgress | None = None) -> None:
        """Run the warm-up, then hand the CAVs over; drivers remember nothing of it."""
        self._follow()
        self._warm_up(lambda: self._simulate({}), on_progress)
        self._controlled = controlled
        self._log_moments: list[tuple[Sequence[str], Sequence[float], Sequence[float], Sequence[float]]] = []
        self._log_cavs: list[list[str]] = []
        self._log_states: list[LocalState] = []
        self._log_applied: list[list[float]] = []
        self._log_shield: list[list[float]] = []
        self._log_places: list[Floats] = []
        self._waiting, self._arrived = [], 0
        self._look()

    @property
    def cavs(self) -> Sequence[str]:
        """The CAVs on the road now, in order of entry."""
        return self._cavs

    @property
    def kept(self) -> Sequence[int] | None:
        """Rows of the CAVs before the last decision that are on the road after it; None: the same ones."""
        return None if len(self._kept) == self._before == len(self._cavs) else self._kept

    def perceive(self) -> LocalState:
        """Return what the CAVs perceive now: arrays of shape (CAVs,)."""
        return self._log_states[-1]

    def advance(self, command: Command | None) -> None:
        """Simulate one decision of the CAVs that are on the road, as `Traffic` says."""
        scenario, names = self.scenario, self._cavs
        step = scenario.simulation_step
        applied = self._told(command) if self._controlled else []
        before = self._log_states[-1].speed
        shield = dict.fromkeys(names, 0.0)
        for _ in range(scenario.steps_per_decision):
            told = {name: value for name, value in zip(names, applied, strict=False) if name in self._on_road}
            speeds = self._simulation.speeds(list(told))
            wanted = {
                name: next_speed(speed, value, step)
                for (name, value), speed in zip(told.items(), speeds, strict=True)
            }
            commanded = self._legal(wanted)
            self._simulate(commanded)
            still = [name for name in commanded if name in self._on_road]
            for name, moved in zip(still, self._simulation.speeds(still), strict=True):
                shield[name] = max(shield[name], (commanded[name] - moved) / step)
            if self.crashed:
                break
        self.decisions += 1
        self._look()
        if not self._controlled:
            after = dict(zip(self._log_moments[-1][0], self._log_moments[-1][1], strict=True))
            changes = (after.get(name, speed) - speed for name, speed in zip(names, before, strict=True))
            applied = [change / scenario.decision_step for change in changes]
        self._log_applied.append(applied)
        self._log_shield.append(list(shield.values()))
        if self.full:
            self.log_fuel.append(self._simulation.fuel(self._log_moments[-1][0]))

    def _simulate(self, commanded: dict[str, float]) -> None:
        """Simulate one step after which these CAVs shall have these speeds [m/s]."""
        self._command_people()
        self._simulation.command_speeds(commanded.keys(), commanded.values())
        self._simulation.step()
        self._follow()
        colliding = self._simulation.colliding()
        if colliding:
            self.collisions = max(self.collisions, len(colliding))
            self.crashed = self.crashed or self._ends_with(colliding)

    def _legal(self, speeds: dict[str, float]) -> dict[str, float]:
        """Return wanted speeds of CAVs, none above what the road allows [m/s]."""
        return speeds

    def _ends_with(self, colliding: Sequence[str]) -> bool:
        """Whether a collision of these vehicles ends the episode."""
        return True

    def _follow(self) -> None:
        """Keep up with who is on the road."""
        entered, left = self._simulation.departed(), self._simulation.left()
        self._arrived += len(self._simulation.arrived())
        for name in left:
            self._on_road.pop(name, None)
        self._moved(left, entered)
        for name in entered:
            self._on_road[name] = self._is_cav(name)

    def _look(self) -> None:
        """Note who is where after a decision, and take control of the CAVs that have entered."""
        known = set(self._cavs)
        self._before = len(self._cavs)
        self._kept = [row for row, name in enumerate(self._cavs) if name in self._on_road]
        new = [name for name, chosen in self._on_road.items() if chosen and name not in known]
        self._cavs = [*(self._cavs[row] for row in self._kept), *new]
        self.entered += len(new)
        if self._controlled and new:
            self._take_control(new)
        self._log_moments.append(self._moment())
        self._log_cavs.append(self._cavs)
        self._log_states.append(self._states(self._cavs))
        self._waiting.append(len(self._simulation.waiting()))
        if self.full:
            self._log_places.append(self._simulation.places(self._log_moments[-1][0]))

    def _take_control(self, names: Sequence[str]) -> None:
        scenario = self.scenario
        self._simulation.take_control(names, scenario.actuation, scenario.right_of_way)

    @property
    def speeds(self) -> Sequence[float]:
        """Speeds of all vehicles on the road now [m/s]."""
        return self._log_moments[-1][1]

    def record(self, driven: Driven) -> Episode:
        """Return what happened since the start."""
        names = list(dict.fromkeys(name for moment in self._log_moments for name in moment[0]))
        column = {name: index for index, name in enumerate(names)}
        shape = (self.decisions + 1, len(names))
        speeds, positions, gaps = (np.full(shape, np.nan) for _ in range(3))
        places = np.full((*shape, 3), np.nan) if self.full else np.zeros((0, 0, 3))
        fuel = np.full((len(self.log_fuel), len(names)), np.nan) if self.full else np.zeros((0, 0))
        for time, (there, *values) in enumerate(self._log_moments):
            columns = [column[name] for name in there]
            for array, row in zip((speeds, positions, gaps), values, strict=True):
                array[time, columns] = row
            if self.full:
                places[time, columns] = self._log_places[time]
                if time:
                    fuel[time - 1, columns] = self.log_fuel[time - 1]
        trajectories = self._trajectories(driven)
        facts = {**self._facts(), **self._pictured(names)}
        return Episode(
            **facts,
            vehicle_ids=tuple(names),
            cav_ids=tuple(dict.fromkeys(each.vehicle for each in trajectories)),
            speeds=speeds,
            positions=positions,
            gaps=gaps,
            fuel=fuel,
            arrived=self._arrived,
            waiting=np.array(self._waiting, np.float64),
            places=places,
            trajectories=trajectories,
        )

    def _trajectories(self, driven: Driven) -> tuple[Trajectory, ...]:
        """Return the stays of at least one decision, in order of entry."""
        rows: dict[str, list[int]] = {}
        first: dict[str, int] = {}
        for time, names in enumerate(self._log_cavs):
            for row, name in enumerate(names):
                first.setdefault(name, time)
                rows.setdefault(name, []).append(row)
        found = []
        for number, (name, places) in enumerate(rows.items()):
            start, steps = first[name], len(places) - 1
            if steps == 0:
                continue
            moments = list(enumerate(places, start))
            states = zip(*self._log_states, strict=True)
            found.append(
                trajectory(
                    vehicle=name,
                    number=number,
                    start=start,
                    rows=np.array(places),
                    states=LocalState(
                        *(np.array([values[time][row] for time, row in moments]) for values in states)
                    ),
                    applied=np.array([self._log_applied[time][row] for time, row in moments[:-1]]),
                    shield=np.array([self._log_shield[time][row] for time, row in moments[:-1]]),
                    terminated=self.crashed and start + steps == self.decisions,
                    driven=driven,
                )
            )
        return tuple(found)

    def scene(self) -> Scene:
        """Return this moment as pictures show it."""
        names, speeds, *_ = self._log_moments[-1]
        cavs = set(self._cavs)
        return Scene(
            self._lines(),
            self._simulation.places(names),
            np.array(speeds),
            np.array([name in cavs for name in names], bool),
        )

    def _lines(self) -> Floats:
        """Return the road's lines as `Scene` has them."""
        raise NotImplementedError
