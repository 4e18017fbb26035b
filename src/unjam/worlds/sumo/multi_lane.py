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

from unjam.drivers.command import Command, commanded_time_gaps
from unjam.worlds.audit import (
    CAV_AFTER_CUT_IN,
    CAV_DRIVER,
    CUT_IN_SECONDS,
    HUMAN_DRIVER,
    SHORT_TIME_GAP,
    STEADY_FOLLOWING_SECONDS,
    Audit,
    FollowingPair,
    following_statistics,
    is_recovering,
)
from unjam.worlds.record import Floats, Trajectory
from unjam.worlds.sumo.open_road import OpenTraffic
from unjam.worlds.sumo.traffic import OpenRoadT
from unjam.worlds.world import ProgressCallback


class TrackedLeader(NamedTuple):
    """Whom a CAV follows."""

    leader: str
    """its name; empty: nobody is near"""
    speed: float
    """the CAV's own [m/s]"""
    leader_speed: float
    """[m/s]"""
    gap: float
    """[m]"""


class MultiLaneTraffic(OpenTraffic[OpenRoadT]):
    """What roads with lanes have in common."""

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> None:
        """Run the warm-up, then hand the CAVs over; drivers remember nothing of it."""
        self._leaders: dict[str, tuple[str, int]] = {}
        """of each CAV: its leader, and the simulation step since when"""
        self._recovery_states: dict[str, tuple[bool, FollowingPair]] = {}
        """of each CAV: whether it recovers from a change of leader, and the two in the last step"""
        self._logged_following = array("d")
        """of CAVs that have had their leader for more than `SETTLED`, in each simulation step: speed, that of
        the leader, gap, and whether they still recover"""
        self._step_count = 0
        self._uncapped_max_speeds: dict[str, float] = {}
        """of CAVs that have a set speed, how fast they would drive without it"""
        self._time_gaps: dict[str, float] = {}
        """of CAVs whose ACC was asked for a time headway: the one that it keeps now [s]"""
        super().start(is_controlled, on_progress)

    def advance(self, command: Command | None) -> None:
        """Simulate one decision; CAVs' own ACCs, if they have any, are asked for time headways first."""
        asks = command is not None and command.time_gap is not None
        if self.scenario.actuation == "cruise" and (asks or self._time_gaps):
            least = self.scenario.cruise.time_gap
            wanted = commanded_time_gaps(command, least, self.cav_ids, self.control_steps)
            for name, headway in zip(self.cav_ids, wanted, strict=True):
                if headway != self._time_gaps.get(name, least):
                    self._simulation.set_time_gap(name, headway)
                    self._time_gaps[name] = headway
        super().advance(command)

    def _tracked_leaders(self, names: Sequence[str]) -> list[TrackedLeader]:
        """Return whom these CAVs follow now."""
        raise NotImplementedError

    def _acc_limits(self, names: Sequence[str]) -> tuple[Floats, Floats] | None:
        """Return acceleration and comfortable braking of the CAVs' vehicles [m/s2]; None: as the ACC says."""
        return None

    def _is_uncapped(self, name: str) -> bool:
        """Whether nobody may hold a CAV back where it is."""
        return False

    def _driver_kinds(self) -> NDArray[np.uint8]:
        """Look whom CAVs follow, and return whose changes of speed those of the last step are."""
        whose = super()._driver_kinds()
        self._step_count += 1
        if not self._is_controlled:
            return whose
        whose = whose.copy()
        step = self.scenario.simulation_step
        rows = {name: row for row, name in enumerate(self._logged_names)}
        names = [name for name in self.cav_ids if name in rows]
        for name, (leader, *seen) in zip(names, self._tracked_leaders(names), strict=True):
            known = self._leaders.get(name)
            if known is None or known[0] != leader:
                known = self._leaders[name] = leader, self._step_count
            since = (self._step_count - known[1]) * step
            if since < CUT_IN_SECONDS:
                whose[rows[name]] = CAV_AFTER_CUT_IN
            now = FollowingPair(*seen)
            so_far, before = self._recovery_states.get(name, (False, now))
            recovers = bool(leader) and is_recovering(so_far, since, before, now)
            self._recovery_states[name] = recovers, now
            if leader and since > STEADY_FOLLOWING_SECONDS:
                self._logged_following.extend((*now, recovers))
        return whose

    def _command_cavs(self, speeds: dict[str, float]) -> None:
        """With an ACC of its own, a CAV is given a set speed; none, where it may drive as it likes.

        So SUMO goes on to drive it: it brakes as hard as its ACC must, and makes room for who changes lanes.
        Who is told its speed does neither. With nobody near, the ACC accelerates as it was asked to.
        """
        cruise, step = self.scenario.cruise, self.scenario.simulation_step
        if self.scenario.actuation != "cruise":
            super()._command_cavs(speeds)
            return
        now = np.array(self._simulation.speeds(list(speeds)))
        limits = self._acc_limits(list(speeds))
        held = cruise.set_speed(now, np.array([*speeds.values()]), self.limits.highest, step, limits)
        for name, cap in zip(speeds, held.tolist(), strict=True):
            if cap < inf and not self._is_uncapped(name):
                fastest = self._uncapped_max_speeds.setdefault(name, self._simulation.max_speed(name))
                self._simulation.set_max_speed(name, min(cap, fastest))
            elif name in self._uncapped_max_speeds:
                self._simulation.set_max_speed(name, self._uncapped_max_speeds.pop(name))

    def _audit(self, trajectories: Sequence[Trajectory]) -> Audit:
        """Return the physics of every simulation step; how CAVs follow whom they have followed for long."""
        people, cavs, cut_in = map(self._braking_log.statistics, (HUMAN_DRIVER, CAV_DRIVER, CAV_AFTER_CUT_IN))
        speed, ahead, gap, recovering = self._steady_following()
        step = self.scenario.simulation_step
        found = following_statistics(speed, ahead, gap, step, in_recovery=recovering)
        decided = self._following_statistics(trajectories)
        commands = {name: getattr(decided, name) for name in ("max_jerk", "override_share", "yield_share")}
        return Audit(people, cavs, replace(found, **commands), SHORT_TIME_GAP, has_lanes=True, cut_in_braking=cut_in)

    def _steady_following(self) -> Floats:
        """Return what `_logged_following` holds: four arrays of shape (1, moments)."""
        return np.array(self._logged_following, np.float64).reshape(-1, 4).T[:, None]
