"""Traffic on roads with lanes: others cut in, and a CAV's own ACC may be what follows.

Who cuts in leaves less of a gap than anybody would choose. What a CAV does in the seconds after it says
nothing of how it follows; the audit counts it apart.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from unjam.worlds.audit import SHORT_HEADWAY, Audit, brakings, following
from unjam.worlds.record import Floats, Trajectory
from unjam.worlds.sumo.open import OpenTraffic
from unjam.worlds.sumo.simulation import LEAVE_TO_SUMO
from unjam.worlds.sumo.traffic import OpenKind
from unjam.worlds.world import OnProgress

CUT_IN = 3.0
"""time after a change of leader in which braking is counted apart [s]"""
SETTLED = 5.0
"""time behind the same leader after which headways are a car's own choice [s]"""
PEOPLE, CAV, CAV_CUT_IN = 0, 1, 2
"""whose braking it is"""


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
        self._seen: list[tuple[float, float, float]] = []
        """speed, leader's speed and gap of CAVs that follow the same for long, in each simulation step"""
        self._steps = 0
        super().start(controlled, on_progress)

    def _followed(self, names: Sequence[str]) -> list[Followed]:
        """Return whom these CAVs follow now."""
        raise NotImplementedError

    def _is_free(self, name: str) -> bool:
        """Whether nobody may hold a CAV back where it is."""
        return False

    def _watch(self) -> None:
        super()._watch()
        self._steps += 1
        if not self._controlled:
            return
        step = self.scenario.simulation_step
        rows = {name: row for row, name in enumerate(self._watched)}
        names = [name for name in self.cavs if name in rows]
        first = len(self._changed) - len(rows)
        for name, (leader, *seen) in zip(names, self._followed(names), strict=True):
            known = self._leaders.get(name)
            if known is None or known[0] != leader:
                known = self._leaders[name] = leader, self._steps
            since = (self._steps - known[1]) * step
            if since < CUT_IN:
                self._changed[first + rows[name]] = CAV_CUT_IN
            if leader and since > SETTLED:
                self._seen.append((seen[0], seen[1], seen[2]))

    def _legal(self, speeds: dict[str, float]) -> dict[str, float]:
        """Return wanted speeds; with an ACC of its own, who is not held back is told nothing.

        Whoever is told a speed, be it a high one, makes no room for who changes lanes.
        """
        if self.scenario.actuation != "cruise":
            return speeds
        most = self.limits.highest * self.scenario.simulation_step - 1e-9
        now = self._simulation.speeds(list(speeds))
        return {
            name: LEAVE_TO_SUMO if speed - own >= most or self._is_free(name) else speed
            for (name, speed), own in zip(speeds.items(), now, strict=True)
        }

    def _audit(self, trajectories: Sequence[Trajectory]) -> Audit:
        """Return the physics of every simulation step; how CAVs follow whom they have followed for long."""
        accelerations = np.array(self._changes) / self.scenario.simulation_step
        whose = np.frombuffer(bytes(self._changed), np.uint8)
        people, cavs, cut_in = (brakings(accelerations[whose == who]) for who in (PEOPLE, CAV, CAV_CUT_IN))
        speed, ahead, gap = self._settled()
        found = following(speed, ahead, gap, self.scenario.simulation_step)
        decided = self._decided(trajectories)
        commands = {name: getattr(decided, name) for name in ("jerk", "overridden", "yielded")}
        return Audit(people, cavs, replace(found, **commands), SHORT_HEADWAY, lanes=True, cut_in=cut_in)

    def _settled(self) -> Floats:
        """Return what was seen of who follows the same for long: three arrays of shape (1, moments)."""
        return np.array(self._seen, np.float64).reshape(-1, 3).T[:, None]
