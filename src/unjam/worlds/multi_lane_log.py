"""The log of an episode on a road with lanes, where other vehicles cut in.

A vehicle that cuts in leaves a smaller gap than the CAV would choose. The audit counts separately how the CAV
brakes in the seconds after a cut-in, and excludes the time gaps until it has recovered.
"""

from array import array
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.safety import FollowingState
from unjam.scenarios.scenario import Scenario
from unjam.worlds import audit
from unjam.worlds.audit import CAV_AFTER_CUT_IN, Audit, is_recovering
from unjam.worlds.open_road_log import OpenRoadLog
from unjam.worlds.record import Floats, Trajectory

TrackedLeader = tuple[str, FollowingState]
"""the leader of a CAV, empty without a leader within range, and the state of the CAV behind it"""


class MultiLaneLog(OpenRoadLog):
    """The log of an episode on a road with lanes: counts braking after cut-ins and steady car following."""

    def __init__(
        self,
        scenario: Scenario,
        names: Sequence[str],
        speeds: Floats,
        tracked_leaders: Callable[[Sequence[str]], list[TrackedLeader]],
    ) -> None:
        super().__init__(scenario, names, speeds)
        self._tracked_leaders = tracked_leaders
        self._leaders: dict[str, tuple[str, int]] = {}
        """leader of each CAV, and the simulation step since which it is the leader"""
        self._recovery_states: dict[str, tuple[bool, FollowingState]] = {}
        """whether each CAV recovers from a change of its leader, and the pair in the last step"""
        self._steady_following = array("d")
        """of CAVs long behind the same leader, in each simulation step: speed, leader speed, gap, and recovery"""
        self._step_count = 0

    def _driver_kinds(self) -> NDArray[np.uint8]:
        self._step_count += 1
        kinds, rows = self._kinds.copy(), {name: row for row, name in enumerate(self._names)}
        names = [name for name in self._cav_ids if name in rows]
        for name, (leader, current) in zip(names, self._tracked_leaders(names) if names else (), strict=True):
            known = self._leaders.get(name)
            if known is None or known[0] != leader:
                known = self._leaders[name] = leader, self._step_count
            time_behind_leader = (self._step_count - known[1]) * self._scenario.simulation_step
            if time_behind_leader < audit.CUT_IN_SECONDS:
                kinds[rows[name]] = CAV_AFTER_CUT_IN
            was_recovering, previous = self._recovery_states.get(name, (False, current))
            recovers = bool(leader) and is_recovering(was_recovering, time_behind_leader, previous, current)
            self._recovery_states[name] = recovers, current
            if leader and time_behind_leader > audit.STEADY_FOLLOWING_SECONDS:
                self._steady_following.extend((*current, recovers))
        return kinds

    def make_audit(self, trajectories: Sequence[Trajectory]) -> Audit:
        """Return the audit of every simulation step; overrides and jerk of every control step."""
        speed, leader_speed, gap, recovers = np.array(self._steady_following, np.float64).reshape(-1, 4).T[:, None]
        step, common = self._scenario.simulation_step, super().make_audit(trajectories)
        steady = audit.following_statistics(speed, leader_speed, gap, step, in_recovery=recovers)
        commands = {name: getattr(common.following, name) for name in ("max_jerk", "override_share", "yield_share")}
        return replace(
            common,
            following=replace(steady, **commands),
            required_time_gap=audit.SHORT_TIME_GAP,
            has_lanes=True,
            cut_in_braking=self._braking.statistics(CAV_AFTER_CUT_IN),
        )
