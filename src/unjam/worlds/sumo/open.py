"""Traffic on roads with ends: vehicles come and go, and each stay of a CAV is a trajectory of its own."""

from array import array
from collections import defaultdict
from collections.abc import Sequence
from math import inf
from operator import sub
from typing import Any, NamedTuple

import numpy as np

from unjam.drivers.command import Command
from unjam.drivers.local_state import LARGEST_GAP, LocalState
from unjam.drivers.safety import Ahead
from unjam.physics.kinematics import next_speed
from unjam.worlds.audit import SHIELD_ROUNDING, Audit, Following, brakings, following
from unjam.worlds.record import Episode, Floats, Trajectory, trajectory
from unjam.worlds.sumo.traffic import OpenKind, Scene, Traffic
from unjam.worlds.world import Driven, OnProgress


class Moment(NamedTuple):
    """All vehicles that are on the road at one moment, in the same order."""

    names: Sequence[str]
    speeds: Sequence[float]
    """[m/s]"""
    positions: Sequence[float]
    """[m]"""
    gaps: Sequence[float]
    """to the vehicle ahead [m]"""


class OpenTraffic(Traffic[OpenKind]):
    """What roads with ends have in common.

    A vehicle becomes a CAV at the first decision after it entered; until then it drives as people do. Its
    stay ends with the last decision after which it is still on the road. What comes before `start` each kind
    of road does in its own way.
    """

    def _is_cav(self, name: str) -> bool:
        """Whether a vehicle that has just entered is a CAV."""
        return name in self.road.cav_ids

    @property
    def expects_cavs(self) -> bool:
        """Whether a CAV may still enter: not all that the road names have."""
        return self.entered < len(self.road.cav_ids)

    def _moved(self, left: Sequence[str], entered: Sequence[str]) -> None:
        """Follow how the vehicles moved in the last step, who left and who entered."""

    def _command_people(self) -> None:
        """Ask for the speeds that people want, where SUMO does not drive them."""

    def _everybody(self) -> tuple[Sequence[str], list[float]]:
        """Return who is on the road after the last step, and their speeds [m/s], in one order."""
        names = list(self._on_road)
        return names, self._simulation.speeds(names)

    def _moment(self) -> Moment:
        """Return all vehicles on the road now."""
        raise NotImplementedError

    def _states(self, names: Sequence[str]) -> LocalState:
        """Return what CAVs perceive now."""
        raise NotImplementedError

    def _ahead(self, names: Sequence[str]) -> list[Ahead]:
        """Return what these CAVs' filters know now."""
        speeds = self._simulation.speeds(names)
        if not self.scenario.safety.active:
            return [Ahead(speed, speed, inf) for speed in speeds]
        near = (self._simulation.neighbours(name, LARGEST_GAP) for name in names)
        return [Ahead(speed, ahead, gap) for speed, (ahead, gap, *_) in zip(speeds, near, strict=True)]

    def _lines(self) -> Floats:
        """Return the road's lines as `Scene` has them."""
        raise NotImplementedError

    def _pictured(self, vehicles: Sequence[str]) -> dict[str, Any]:
        """Return what else the record says of the road."""
        raise NotImplementedError

    @property
    def _cav_type(self) -> str:
        """What the type of a vehicle becomes with which it is a CAV; `{}` stands for the type it had."""
        return "cav"

    def _legal(self, speeds: dict[str, float]) -> dict[str, float]:
        """Return wanted speeds of CAVs, none above what the road allows [m/s]."""
        return speeds

    def _ends_with(self, colliding: Sequence[str]) -> bool:
        """Whether a collision of these vehicles ends the episode."""
        return True

    def start(self, controlled: bool, on_progress: OnProgress | None = None) -> None:
        """Run the warm-up, then hand the CAVs over; drivers remember nothing of it."""
        self._on_road: dict[str, bool] = {}
        """who is there, in order of entry; true: to be driven by the driver"""
        self.cavs, self._arrived = [], 0
        self._forget()
        self._follow()
        self._warm_up(lambda: self._simulate({}), on_progress)
        self._controlled = controlled
        self._log_moments: list[Moment] = []
        self._log_cavs: list[Sequence[str]] = []
        self._log_states: list[LocalState] = []
        self._log_applied: list[list[float]] = []
        self._log_filtered: list[list[float]] = []
        self._log_shield: list[list[float]] = []
        self._log_places: list[Floats] = []
        self._log_waiting: list[int] = []
        self._arrived = 0
        self._forget()
        self._look()

    def _forget(self) -> None:
        """Begin the log of everybody's accelerations anew."""
        self._watched, self._of_cav = list[str](), b""
        self._drives: Sequence[str] = ()
        self._last_speeds: list[float] = []
        self._changes, self._changed = array("d"), bytearray()
        """everybody's changes of speed in each simulation step [m/s], and whether a CAV's"""

    @property
    def waiting(self) -> int:
        """How many want to enter now and cannot."""
        return self._log_waiting[-1]

    def _state(self) -> LocalState:
        """Return what exact sensors of the CAVs would read now."""
        return self._log_states[-1].read_only()

    def advance(self, command: Command | None) -> None:
        """Simulate one decision, held over its simulation steps; None: the CAVs stay human."""
        scenario, names = self.scenario, self.cavs
        step, obeys = scenario.simulation_step, scenario.actuation != "cruise"
        wanted = self._told(command) if self._controlled else []
        before = self._log_states[-1].speed
        shield = dict.fromkeys(names, 0.0)
        taken: dict[str, list[float]] = {name: [] for name in names}
        for _ in range(scenario.steps_per_decision):
            asked = {name: value for name, value in zip(names, wanted, strict=False) if name in self._on_road}
            commanded = self._legal(self._carried_out(asked, taken))
            self._simulate(commanded)
            still = [name for name in commanded if name in self._on_road]
            for name, moved in zip(still, self._simulation.speeds(still), strict=True):
                shield[name] = max(shield[name], (commanded[name] - moved) / step * obeys)
            if self.crashed:
                break
        self.decisions += 1
        self._look()
        if not (self._controlled and obeys):
            after = dict(zip(self._log_moments[-1].names, self.speeds, strict=True))
            changes = (after.get(name, speed) - speed for name, speed in zip(names, before, strict=True))
            wanted = [change / scenario.decision_step for change in changes]
        less = [sum(values) / scenario.steps_per_decision for values in taken.values()]
        self._log_applied.append([asked - part for asked, part in zip(wanted, less, strict=True)])
        self._log_filtered.append([max(values, default=0.0) for values in taken.values()])
        self._log_shield.append(list(shield.values()))
        if self.full:
            self.log_fuel.append(self._simulation.fuel(self._log_moments[-1].names))

    def _carried_out(self, wanted: dict[str, float], taken: dict[str, list[float]]) -> dict[str, float]:
        """Return the speeds that CAVs' accelerations lead to in this step, once they are filtered [m/s].

        What the filter takes from each is added to `taken` [m/s2].
        """
        names, found, step = list(wanted), {}, self.scenario.simulation_step
        for name, ahead in zip(names, self._ahead(names), strict=True):
            told, done = self._carry_out(name, wanted[name], ahead)
            taken[name].append(wanted[name] - told)
            found[name] = next_speed(ahead.speed, done, step)
        return found

    def _simulate(self, commanded: dict[str, float]) -> None:
        """Simulate one step after which these CAVs shall have these speeds [m/s]."""
        self._command_people()
        self._simulation.command_speeds(commanded.keys(), commanded.values())
        self._simulation.step()
        self._follow()
        self._watch()
        colliding = self._simulation.colliding()
        if colliding:
            self.collisions = max(self.collisions, len(colliding))
            self.crashed = self.crashed or self._ends_with(colliding)

    def _follow(self) -> None:
        """Keep up with who is on the road."""
        entered, left = self._simulation.departed(), self._simulation.left()
        self._arrived += len(self._simulation.arrived())
        for name in left:
            self._on_road.pop(name, None)
        self._moved(left, entered)
        for name in entered:
            self._on_road[name] = self._is_cav(name)

    def _watch(self) -> None:
        """Note how everybody's speed has changed in this step: people's and CAVs' apart."""
        names, speeds = self._everybody()
        last, driven = self._last_speeds, self.cavs if self._controlled else ()
        if names != self._watched:  # in few steps: the rest is quick
            before = dict(zip(self._watched, last, strict=True))
            last = [before.get(name, speed) for name, speed in zip(names, speeds, strict=True)]
        if names != self._watched or driven is not self._drives:
            self._of_cav = bytes(map(set(driven).__contains__, names))
            self._watched, self._drives = list(names), driven
        self._changes.fromlist(list(map(sub, speeds, last)))
        self._changed.extend(self._of_cav)
        self._last_speeds = speeds

    def _look(self) -> None:
        """Note who is where after a decision, and take control of the CAVs that have entered."""
        scenario, simulation, known = self.scenario, self._simulation, set(self.cavs)
        rows = [row for row, name in enumerate(self.cavs) if name in self._on_road]
        new = [name for name, chosen in self._on_road.items() if chosen and name not in known]
        self.kept = rows if new or len(rows) < len(known) else None
        if self.kept is not None:
            self.cavs = [*(self.cavs[row] for row in rows), *new]
        self.entered += len(new)
        if self._controlled:
            simulation.take_control(new, scenario.actuation, scenario.right_of_way, self._cav_type)
        moment = self._moment()
        self.speeds = moment.speeds
        self._log_moments.append(moment)
        self._log_cavs.append(self.cavs)
        self._log_states.append(self._states(self.cavs))
        self._log_waiting.append(len(simulation.waiting()))
        if self.full:
            self._log_places.append(simulation.places(moment.names))

    def record(self, driven: Driven) -> Episode:
        """Return what happened since the start."""
        names = list(dict.fromkeys(name for moment in self._log_moments for name in moment.names))
        column = {name: index for index, name in enumerate(names)}
        shape = (self.decisions + 1, len(names))
        speeds, positions, gaps = (np.full(shape, np.nan) for _ in range(3))
        places = np.full((*shape, 3), np.nan) if self.full else np.zeros((0, 0, 3))
        fuel = np.full((len(self.log_fuel), len(names)), np.nan) if self.full else np.zeros((0, 0))
        for time, (there, *values) in enumerate(self._log_moments):
            columns = [column[name] for name in there]
            for log, row in zip((speeds, positions, gaps), values, strict=True):
                log[time, columns] = row
            if self.full:
                places[time, columns] = self._log_places[time]
                if time:
                    fuel[time - 1, columns] = self.log_fuel[time - 1]
        trajectories = self._trajectories(driven)
        return Episode(
            **{**self._facts(), **self._pictured(names)},
            vehicle_ids=tuple(names),
            cav_ids=tuple(dict.fromkeys(each.vehicle for each in trajectories)),
            speeds=speeds,
            positions=positions,
            gaps=gaps,
            fuel=fuel,
            arrived=self._arrived,
            waiting=np.array(self._log_waiting, np.float64),
            lines=self._lines() if self.full else np.zeros((0, 2)),
            places=places,
            trajectories=trajectories,
            audit=self._audit(trajectories),
        )

    def _audit(self, trajectories: Sequence[Trajectory]) -> Audit:
        """Return the physics of every simulation step; how CAVs followed, of every decision."""
        accelerations = np.array(self._changes) / self.scenario.simulation_step
        of_cav = np.array(self._changed, bool)
        people, cavs = brakings(accelerations[~of_cav]), brakings(accelerations[of_cav])
        return Audit(people, cavs, self._decided(trajectories), self.scenario.safety.time_headway)

    def _decided(self, trajectories: Sequence[Trajectory]) -> Following:
        """Return how CAVs followed, and how often they were overridden, from what every decision recorded."""
        most = max((len(each.states.speed) for each in trajectories), default=0)
        speed, leader, gap = np.full((3, most, len(trajectories)), np.nan)
        for column, each in enumerate(trajectories):
            rows = slice(len(each.states.speed))
            speed[rows, column] = each.states.speed
            leader[rows, column], gap[rows, column] = each.states.leader_speed, each.states.leader_gap
        step = self.scenario.decision_step
        added = np.concatenate([each.shield for each in trajectories]) if trajectories else np.zeros(0)
        return following(speed, leader, gap, step, added > SHIELD_ROUNDING, np.zeros_like(added))

    def _trajectories(self, driven: Driven) -> tuple[Trajectory, ...]:
        """Return the stays of at least one decision, in order of entry."""
        stays: defaultdict[str, list[tuple[int, int]]] = defaultdict(list)
        """moment and row of each CAV"""
        for time, names in enumerate(self._log_cavs):
            for row, name in enumerate(names):
                stays[name].append((time, row))
        states = list(zip(*self._log_states, strict=True))
        found = []
        for number, (name, places) in enumerate(stays.items()):
            start, steps = places[0][0], len(places) - 1
            if steps == 0:
                continue
            found.append(
                trajectory(
                    vehicle=name,
                    number=number,
                    start=start,
                    rows=np.array([row for _, row in places]),
                    states=LocalState(*(_stay(values, places) for values in states)),
                    applied=_stay(self._log_applied, places[:-1]),
                    filtered=_stay(self._log_filtered, places[:-1]),
                    shield=_stay(self._log_shield, places[:-1]),
                    terminated=self.crashed and start + steps == self.decisions,
                    driven=driven,
                )
            )
        return tuple(found)

    def last_applied(self) -> Floats:
        """Return what the CAVs were told in the last decision, once it was filtered [m/s2], shape (CAVs,)."""
        return np.array(self._log_applied[-1])

    def scene(self) -> Scene:
        """Return this moment as pictures show it."""
        names, speeds = self._log_moments[-1].names, np.array(self.speeds)
        cavs = np.array([name in self.cavs for name in names], bool)
        return Scene(self._lines(), self._simulation.places(names), speeds, cavs)


def _stay(values: Sequence[Any], places: Sequence[tuple[int, int]]) -> Any:
    """Return what a CAV was told of one quantity at its moments and rows; None where the road offers none."""
    return None if values[0] is None else np.array([values[time][row] for time, row in places])
