"""Traffic on roads with lanes: others cut in, and a CAV's own ACC may be what follows.

Who cuts in leaves less of a gap than anybody would choose. What a CAV does in the seconds after it says
nothing of how it follows; the audit counts it apart.
"""

from array import array
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.physics.idm import IDMParameters, desired_gap
from unjam.worlds.audit import SHORT_HEADWAY, Audit, following
from unjam.worlds.record import Floats, Trajectory
from unjam.worlds.sumo.open import CAV, PEOPLE, OpenTraffic
from unjam.worlds.sumo.simulation import LEAVE_TO_SUMO
from unjam.worlds.sumo.traffic import OpenKind
from unjam.worlds.world import OnProgress

CUT_IN = 3.0
"""time after a change of leader in which braking is counted apart [s]"""
SETTLED = 5.0
"""time behind the same leader after which headways are a car's own choice [s]"""
CAV_CUT_IN = 2
"""whose braking it is, beside PEOPLE and CAV"""


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
        self._seen = array("d")
        """speed, leader's speed and gap of CAVs that follow the same for long, in each simulation step"""
        self._steps = 0
        cruise = self.scenario.cruise
        self._acc = IDMParameters(
            time_headway=cruise.time_headway,
            max_acceleration=cruise.acceleration,
            comfortable_deceleration=cruise.deceleration,
            minimum_gap=cruise.gap,
        )
        super().start(controlled, on_progress)

    def _followed(self, names: Sequence[str]) -> list[Followed]:
        """Return whom these CAVs follow now."""
        raise NotImplementedError

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
            if leader and since > SETTLED:
                self._seen.extend(seen)
        return whose

    def _legal(self, speeds: dict[str, float]) -> dict[str, float]:
        """Return wanted speeds; with an ACC of its own, who is not held back is told nothing.

        Whoever is told a speed, be it a high one, makes no room for who changes lanes, and brakes no harder
        than is comfortable: SUMO takes that for a wish. Where its own ACC would, it is left to it.
        """
        if self.scenario.actuation != "cruise":
            return speeds
        most = self.limits.highest * self.scenario.simulation_step - 1e-9
        followed = zip(speeds.items(), self._followed(list(speeds)), strict=True)
        return {
            name: LEAVE_TO_SUMO
            if speed - seen.speed >= most or self._is_free(name) or self._brakes_hard(seen)
            else speed
            for (name, speed), seen in followed
        }

    def _brakes_hard(self, seen: Followed) -> bool:
        """Return whether a CAV's own ACC brakes harder than is comfortable, behind whom it follows."""
        if not seen.leader or seen.gap <= 0:
            return bool(seen.leader)
        acc = self._acc
        wanted = desired_gap(seen.speed, seen.speed - seen.leader_speed, acc)
        return acc.max_acceleration * (1.0 - (wanted / seen.gap) ** 2) < -acc.comfortable_deceleration

    def _audit(self, trajectories: Sequence[Trajectory]) -> Audit:
        """Return the physics of every simulation step; how CAVs follow whom they have followed for long."""
        people, cavs, cut_in = map(self._brakings.of, (PEOPLE, CAV, CAV_CUT_IN))
        speed, ahead, gap = self._settled()
        found = following(speed, ahead, gap, self.scenario.simulation_step)
        decided = self._decided(trajectories)
        commands = {name: getattr(decided, name) for name in ("jerk", "overridden", "yielded")}
        return Audit(people, cavs, replace(found, **commands), SHORT_HEADWAY, lanes=True, cut_in=cut_in)

    def _settled(self) -> Floats:
        """Return what was seen of who follows the same for long: three arrays of shape (1, moments)."""
        return np.array(self._seen, np.float64).reshape(-1, 3).T[:, None]
