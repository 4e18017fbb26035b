"""Traffic on roads with lanes: others cut in, and a CAV's own ACC may be what follows.

A vehicle that cuts in leaves a smaller gap than the CAV would choose. The audit counts separately how the CAV
brakes in the seconds after a cut-in, and excludes the time gaps until it has recovered.
"""

from array import array
from collections.abc import Sequence
from dataclasses import replace
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.command import Command, time_headways
from unjam.worlds.audit import (
    CAV,
    CAV_CUT_IN,
    CUT_IN,
    PEOPLE,
    SETTLED,
    SHORT_HEADWAY,
    Audit,
    Pair,
    following,
    is_recovering,
)
from unjam.worlds.record import Floats, Trajectory
from unjam.worlds.sumo.open import OpenTraffic
from unjam.worlds.sumo.traffic import OpenKind
from unjam.worlds.world import OnProgress


class Followed(NamedTuple):
    """Whom a CAV follows."""

    leader: str
    """its name; empty: nobody is near"""
    speed: float
    """the CAV's own [m/s]"""
    leader_speed: float
    """[m/s]"""
    gap: float
    """[m]"""


class LaneTraffic(OpenTraffic[OpenKind]):
    """What roads with lanes have in common."""

    def start(self, controlled: bool, on_progress: OnProgress | None = None) -> None:
        """Run the warm-up, then hand the CAVs over; drivers remember nothing of it."""
        self._leaders: dict[str, tuple[str, int]] = {}
        """of each CAV: its leader, and the simulation step since when"""
        self._pairs: dict[str, tuple[bool, Pair]] = {}
        """of each CAV: whether it recovers from a change of leader, and the two in the last step"""
        self._seen = array("d")
        """of CAVs that have had their leader for more than `SETTLED`, in each simulation step: speed, that of
        the leader, gap, and whether they still recover"""
        self._steps = 0
        self._fastest: dict[str, float] = {}
        """of CAVs that have a set speed, how fast they would drive without it"""
        self._headways: dict[str, float] = {}
        """of CAVs whose ACC was asked for a time headway: the one that it keeps now [s]"""
        super().start(controlled, on_progress)

    def advance(self, command: Command | None) -> None:
        """Simulate one decision; CAVs' own ACCs, if they have any, are asked for time headways first."""
        asks = command is not None and command.time_headway is not None
        if self.scenario.actuation == "cruise" and (asks or self._headways):
            least = self.scenario.cruise.time_headway
            wanted = time_headways(command, least, self.cavs, self.decisions)
            for name, headway in zip(self.cavs, wanted, strict=True):
                if headway != self._headways.get(name, least):
                    self._simulation.set_headway(name, headway)
                    self._headways[name] = headway
        super().advance(command)

    def _followed(self, names: Sequence[str]) -> list[Followed]:
        """Return whom these CAVs follow now."""
        raise NotImplementedError

    def _acc_limits(self, names: Sequence[str]) -> tuple[Floats, Floats] | None:
        """Return acceleration and comfortable braking of the CAVs' vehicles [m/s2]; None: as the ACC says."""
        return None

    def _is_free(self, name: str) -> bool:
        """Whether nobody may hold a CAV back where it is."""
        return False

    def _whose(self) -> NDArray[np.uint8]:
        """Look whom CAVs follow, and return whose changes of speed those of the last step are."""
        whose = super()._whose()
        self._steps += 1
        if not self._controlled:
            return whose
        whose = whose.copy()
        step = self.scenario.simulation_step
        rows = {name: row for row, name in enumerate(self._watched)}
        names = [name for name in self.cavs if name in rows]
        for name, (leader, *seen) in zip(names, self._followed(names), strict=True):
            known = self._leaders.get(name)
            if known is None or known[0] != leader:
                known = self._leaders[name] = leader, self._steps
            since = (self._steps - known[1]) * step
            if since < CUT_IN:
                whose[rows[name]] = CAV_CUT_IN
            now = Pair(*seen)
            so_far, before = self._pairs.get(name, (False, now))
            recovers = bool(leader) and is_recovering(so_far, since, before, now)
            self._pairs[name] = recovers, now
            if leader and since > SETTLED:
                self._seen.extend((*now, recovers))
        return whose

    def _tell(self, speeds: dict[str, float]) -> None:
        """With an ACC of its own, a CAV is given a set speed; none, where it may drive as it likes.

        So SUMO goes on to drive it: it brakes as hard as its ACC must, and makes room for who changes lanes.
        Who is told its speed does neither. With nobody near, the ACC accelerates as it was asked to.
        """
        cruise, step = self.scenario.cruise, self.scenario.simulation_step
        if self.scenario.actuation != "cruise":
            super()._tell(speeds)
            return
        now = np.array(self._simulation.speeds(list(speeds)))
        limits = self._acc_limits(list(speeds))
        held = cruise.set_speed(now, np.array([*speeds.values()]), self.limits.highest, step, limits)
        for name, cap in zip(speeds, held.tolist(), strict=True):
            if cap < inf and not self._is_free(name):
                fastest = self._fastest.setdefault(name, self._simulation.fastest(name))
                self._simulation.set_fastest(name, min(cap, fastest))
            elif name in self._fastest:
                self._simulation.set_fastest(name, self._fastest.pop(name))

    def _audit(self, trajectories: Sequence[Trajectory]) -> Audit:
        """Return the physics of every simulation step; how CAVs follow whom they have followed for long."""
        people, cavs, cut_in = map(self._brakings.of, (PEOPLE, CAV, CAV_CUT_IN))
        speed, ahead, gap, recovering = self._settled()
        step = self.scenario.simulation_step
        found = following(speed, ahead, gap, step, recovering=recovering)
        decided = self._decided(trajectories)
        commands = {name: getattr(decided, name) for name in ("jerk", "overridden", "yielded")}
        return Audit(people, cavs, replace(found, **commands), SHORT_HEADWAY, lanes=True, cut_in=cut_in)

    def _settled(self) -> Floats:
        """Return what `_seen` holds: four arrays of shape (1, moments)."""
        return np.array(self._seen, np.float64).reshape(-1, 4).T[:, None]
