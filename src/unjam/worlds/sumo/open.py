"""Traffic on roads with ends: vehicles come and go, and each stay of a CAV is a trajectory of its own."""

from collections.abc import Sequence
from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.command import Command
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import Ahead
from unjam.physics.kinematics import next_speed
from unjam.worlds.audit import CAV, PEOPLE, SHIELD_ROUNDING, Audit, BrakingLog, Following, following
from unjam.worlds.record import Episode, Floats, Trajectory
from unjam.worlds.sumo.files import lane_change_parameters
from unjam.worlds.sumo.log import TrafficLog
from unjam.worlds.sumo.stays import StayLog
from unjam.worlds.sumo.traffic import OpenKind, Scene, Traffic
from unjam.worlds.world import Driven, OnProgress


class OpenTraffic(Traffic[OpenKind]):
    """What roads with ends have in common.

    A vehicle becomes a CAV at the first decision after it entered; until then it drives as people do. Its
    stay ends with the last decision after which it is still on the road. What comes before `start` each kind
    of road does in its own way.
    """

    _fuel_every = 1
    """decisions for which what all vehicles burn is held"""

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

    def _everybody(self) -> tuple[Sequence[str], Floats]:
        """Return who is on the road after the last step, and their speeds [m/s], in one order."""
        if self._now is None:
            names = list(self._on_road)
            self._now = names, np.array(self._simulation.speeds(names), np.float64)
        return self._now

    def _note_moment(self) -> None:
        """Get ready for what is asked of the moment after a decision."""

    def _pictured_now(self, names: Sequence[str]) -> dict[str, Any]:
        """Return what pictures show of these vehicles now, `positions` [m] and `gaps` to those ahead [m]."""
        raise NotImplementedError

    def _states(self, names: Sequence[str]) -> LocalState:
        """Return what CAVs perceive now."""
        raise NotImplementedError

    def _ahead(self, names: Sequence[str]) -> list[Ahead]:
        """Return what these CAVs' filters know now; nobody is ahead where there is no filter."""
        return [Ahead(speed, speed, inf) for speed in self._simulation.speeds(names)]

    def _lines(self) -> Floats:
        """Return the road's lines as `Scene` has them."""
        raise NotImplementedError

    @property
    def _cav_type(self) -> str:
        """What the type of a vehicle becomes with which it is a CAV; `{}` stands for the type it had."""
        return "cav"

    def _legal(self, speeds: dict[str, float]) -> dict[str, float]:
        """Return wanted speeds of CAVs, none above what the road allows [m/s]."""
        return speeds

    def _tell(self, speeds: dict[str, float]) -> None:
        """Command CAVs to have these speeds after the next step [m/s]."""
        self._simulation.command_speeds(speeds.keys(), speeds.values())

    def _colliding(self) -> Sequence[str]:
        """Return the vehicles that collided in the last step."""
        return self._simulation.colliding()

    def _ends_with(self, colliding: Sequence[str]) -> bool:
        """Whether a collision of these vehicles ends the episode."""
        return True

    def start(self, controlled: bool, on_progress: OnProgress | None = None) -> None:
        """Run the warm-up, then hand the CAVs over; drivers remember nothing of it."""
        self._on_road: dict[str, bool] = {}
        """who is there, in order of entry; true: to be driven by the driver"""
        self._lifted: dict[str, bool] = {}
        """whom SUMO has lifted off the road, likewise"""
        self._teleports = 0
        self._touched = set[str]()
        """who was in contact with another"""
        self._taken = set[str]()
        """CAVs that were taken control of"""
        self.cavs, self._arrived = [], 0
        self._alive = on_progress or (lambda steps: None)
        self._now: tuple[Sequence[str], Floats] | None = None
        self._forget()
        self._follow()
        self._warm_up(lambda: self._simulate({}), on_progress)
        self._controlled = controlled
        self._log = TrafficLog()
        self._stays = StayLog()
        self._log_waiting: list[int] = []
        self._log_fuel: list[float] = []
        self._arrived = self._teleports = 0
        self._touched.clear()
        self._forget()
        names, self._last_speeds = self._everybody()  # or the first step's changes of speed would be none
        self._watched, self._of_cav = list(names), np.zeros(len(names), np.uint8)
        self._look()

    def _forget(self) -> None:
        """Begin the log of everybody's accelerations anew."""
        self._watched: Sequence[str] = ()
        self._of_cav: NDArray[np.uint8] = np.zeros(0, np.uint8)
        self._drives: Sequence[str] = ()
        self._last_speeds = np.zeros(0)
        self._brakings = BrakingLog(self.scenario.simulation_step)

    @property
    def waiting(self) -> int:
        """How many want to enter now and cannot."""
        return self._log_waiting[-1]

    def exact_state(self) -> LocalState:
        """Return what exact sensors of the CAVs would read now."""
        return self._stays.states[-1].read_only()

    def advance(self, command: Command | None) -> None:
        """Simulate one decision, held over its simulation steps; None: the CAVs stay human."""
        self._simulation.check()
        scenario, names = self.scenario, self.cavs
        step, obeys = scenario.simulation_step, scenario.actuation != "cruise"
        wanted = self._told(command) if self._controlled else []
        before = self._stays.states[-1].speed
        shield = dict.fromkeys(names, 0.0)
        taken: dict[str, list[float]] = {name: [] for name in names}
        for _ in range(scenario.steps_per_decision):
            asked = {name: value for name, value in zip(names, wanted, strict=False) if name in self._on_road}
            commanded = self._legal(self._carried_out(asked, taken))
            self._simulate(commanded)
            still = [name for name in commanded if name in self._on_road]
            moved = dict(zip(still, self._simulation.speeds(still), strict=True)) if obeys else {}
            slower = [name for name, speed in moved.items() if speed < commanded[name]]
            # Who has reached what the road allows is not overridden.
            for name, most in zip(slower, self._simulation.allowed_speeds(slower), strict=True):
                shield[name] = max(shield[name], (min(commanded[name], most) - moved[name]) / step)
            if self.crashed or self.stopped:
                break
        self.decisions += 1
        self._look()
        if not (self._controlled and obeys):
            after = dict(zip(self._log.names, self.speeds, strict=True))
            changes = (after.get(name, speed) - speed for name, speed in zip(names, before, strict=True))
            wanted = [change / scenario.decision_step for change in changes]
        less = [sum(values) / scenario.steps_per_decision * obeys for values in taken.values()]
        self._stays.applied.append([asked - part for asked, part in zip(wanted, less, strict=True)])
        self._stays.filtered.append([max(values, default=0.0) for values in taken.values()])
        self._stays.shield.append(list(shield.values()))
        if self.full and (self.decisions - 1) % self._fuel_every == 0:
            self._log_fuel.append(sum(self._simulation.fuel(self._log.names)))

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
        self._tell(commanded)
        self._simulation.step()
        self._follow()
        self._watch()
        colliding = self._colliding()
        if colliding:
            self._touched.update(colliding)
            removed = set(colliding).intersection(self._simulation.arrived())
            removed -= set(self._simulation.lifted())  # one that is teleported to its end has arrived
            self._arrived, self._teleports = self._arrived - len(removed), self._teleports + len(removed)
            self.crashed = self.crashed or self._ends_with(colliding)

    def _follow(self) -> None:
        """Keep up with who is on the road."""
        self._now = None
        simulation = self._simulation
        entered, arrived, lifted = simulation.departed(), simulation.arrived(), simulation.lifted()
        self._arrived += len(arrived)
        self._teleports += len(lifted)
        self._lifted |= {name: self._on_road[name] for name in lifted if name in self._on_road}
        for name in (*arrived, *lifted):
            self._on_road.pop(name, None)
        for name in arrived:  # also from where it was lifted
            self._lifted.pop(name, None)
        self._moved([*arrived, *lifted], entered)
        for name in entered:
            self._on_road[name] = self._is_cav(name)
        for name in filter(self._lifted.__contains__, simulation.put_back()):
            self._on_road[name] = self._lifted.pop(name)

    def _watch(self) -> None:
        """Note how everybody's speed has changed in this step: people's and CAVs' apart."""
        names, speeds = self._everybody()
        last, driven = self._last_speeds, self.cavs if self._controlled else ()
        if names != self._watched:  # in few steps: the rest is quick
            before = dict(zip(self._watched, last.tolist(), strict=True))
            last = np.array(list(map(before.get, names, speeds.tolist())), np.float64)
        if names != self._watched or driven is not self._drives:
            self._of_cav = np.array(list(map(set(driven).__contains__, names)), np.uint8)
            self._watched, self._drives = list(names), driven
        self._brakings.note(speeds - last, self._whose())
        self._last_speeds = speeds

    def _whose(self) -> NDArray[np.uint8]:
        """Return whose changes of speed those of the last step are, in the order of `_watched`."""
        return self._of_cav

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
            new = [name for name in new if name not in self._taken]
            self._taken.update(new)
            simulation.take_control(new, scenario.actuation, scenario.right_of_way, self._cav_type)
            for name in new:
                for key, value in lane_change_parameters(scenario).items():
                    simulation.set_parameter(name, key, value)
        names, self.speeds = self._everybody()
        self._note_moment()
        self._log.note(names, self.speeds)
        if self._log.is_pictured:
            pictured = self._pictured_now(names)
            places = {"places": simulation.places(names)} if self.full else {}
            self._log.picture({**pictured, **places})
        self._stays.cavs.append(self.cavs)
        self._stays.states.append(self._states(self.cavs))
        self._log_waiting.append(len(simulation.waiting()) + len(self._lifted))

    def record(self, driven: Driven) -> Episode:
        """Return what happened since the start."""
        log, vehicles = self._log, self._log.vehicles
        trajectories = self._stays.trajectories(driven, self.crashed, lambda: self._alive(self.decisions))
        cavs = dict.fromkeys(each.vehicle for each in trajectories)
        branches = self._branches(vehicles)
        columns = log.columns(
            [(name in cavs, branch) for name, branch in zip(vehicles, branches, strict=True)]
        )
        of_column = dict(zip(columns.tolist(), branches, strict=True))
        held = np.repeat(self._log_fuel, self._fuel_every)[: self.decisions]
        facts: dict[str, Any] = {
            "vehicle_ids": vehicles,
            "cav_ids": tuple(cavs),
            "columns": tuple(columns.tolist()) if len(of_column) < len(vehicles) else (),
            "branches": tuple(of_column[column] for column in sorted(of_column)) if any(branches) else (),
            "speeds": log.speeds(columns),
            "every": log.every,
            "fuel": held if self.full else np.zeros((0, 0)),
            "arrived": self._arrived,
            "teleports": self._teleports,
            "collisions": len(self._touched),
            "waiting": np.array(self._log_waiting, np.float64),
            "lifted": len(self._lifted.keys() & set(vehicles)),
            "planned": self.scenario.horizon * self.scenario.decision_step,
            "lines": self._lines() if self.full else np.zeros((0, 2)),
            "trajectories": trajectories,
            "audit": self._audit(trajectories),
        }
        return Episode(**{**self._facts(), **facts, **self._pictured(columns)})

    def _branches(self, vehicles: Sequence[str]) -> Sequence[str]:
        """Return where each vehicle came from; an empty text where that is not known."""
        return [""] * len(vehicles)

    def _pictured(self, columns: NDArray[np.intp]) -> dict[str, Any]:
        """Return what pictures show, as the record has it, and what else it says of the road."""
        names = ("positions", "gaps", "places") if self.full else ("positions", "gaps")
        return {name: self._log.pictures(name, columns) for name in names}

    def _audit(self, trajectories: Sequence[Trajectory]) -> Audit:
        """Return the physics of every simulation step; how CAVs followed, of every decision."""
        people, cavs = self._brakings.of(PEOPLE), self._brakings.of(CAV)
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

    def last_applied(self) -> Floats:
        """Return what the CAVs were told in the last decision, once it was filtered [m/s2], shape (CAVs,)."""
        return np.array(self._stays.applied[-1])

    def scene(self) -> Scene:
        """Return this moment as pictures show it."""
        names, speeds = self._log.names, np.array(self.speeds)
        cavs = np.array([name in self.cavs for name in names], bool)
        return Scene(self._lines(), self._simulation.places(names), speeds, cavs)
