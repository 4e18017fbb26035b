"""Traffic on roads with lanes: other vehicles cut in, and the CAV's own ACC may carry out commands.

A vehicle that cuts in leaves a smaller gap than the CAV would choose. The audit counts separately how the CAV
brakes in the seconds after a cut-in, and excludes the time gaps until it has recovered.
"""

from array import array
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.command import Command, commanded_time_gaps
from unjam.scenarios.scenario import Scenario
from unjam.worlds import audit
from unjam.worlds.audit import CAV_AFTER_CUT_IN, Audit, FollowingPair, is_recovering
from unjam.worlds.record import Floats, Trajectory
from unjam.worlds.sumo.open_log import OpenRoadLog
from unjam.worlds.sumo.open_road import OpenTraffic
from unjam.worlds.sumo.traffic import OpenRoadT


class TrackedLeader(NamedTuple):
    """The leader of a CAV, empty without a leader within range; own and leader speed [m/s], gap [m]."""

    leader: str
    speed: float
    leader_speed: float
    gap: float


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
        self._recovery_states: dict[str, tuple[bool, FollowingPair]] = {}
        """whether each CAV recovers from a change of its leader, and the pair in the last step"""
        self._steady_following = array("d")
        """of CAVs long behind the same leader, in each simulation step: speed, leader speed, gap, and recovery"""
        self._step_count = 0

    def _driver_kinds(self) -> NDArray[np.uint8]:
        self._step_count += 1
        kinds, rows = self._kinds.copy(), {name: row for row, name in enumerate(self._names)}
        names = [name for name in self._cav_ids if name in rows]
        for name, (leader, *pair) in zip(names, self._tracked_leaders(names) if names else (), strict=True):
            known = self._leaders.get(name)
            if known is None or known[0] != leader:
                known = self._leaders[name] = leader, self._step_count
            time_behind_leader = (self._step_count - known[1]) * self._scenario.simulation_step
            if time_behind_leader < audit.CUT_IN_SECONDS:
                kinds[rows[name]] = CAV_AFTER_CUT_IN
            current = FollowingPair(*pair)
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


class MultiLaneTraffic(OpenTraffic[OpenRoadT]):
    """Common part of the roads with lanes."""

    def _prepare(self) -> None:
        self._uncapped_max_speeds: dict[str, float] = {}
        """maximum speed without the cap, of CAVs that have a set-speed cap [m/s]"""
        self._time_gaps: dict[str, float] = {}
        """current time gap of CAVs with a time gap command to their ACC [s]"""

    def _make_log(self) -> OpenRoadLog:
        return MultiLaneLog(self.scenario, *self._names_and_speeds(), self._tracked_leaders)

    def advance(self, command: Command | None) -> None:
        """Simulate one control step, after time gap commands to the CAVs' own ACCs, if any."""
        has_time_gaps = command is not None and command.time_gap is not None
        if self.scenario.actuation == "cruise" and (has_time_gaps or self._time_gaps):
            default = self.scenario.cruise.time_gap
            commanded = commanded_time_gaps(command, default, self.cav_ids, self.control_steps)
            for name, time_gap in zip(self.cav_ids, commanded, strict=True):
                if time_gap != self._time_gaps.get(name, default):
                    self._simulation.set_time_gap(name, time_gap)
                    self._time_gaps[name] = time_gap
        super().advance(command)

    def _tracked_leaders(self, names: Sequence[str]) -> list[TrackedLeader]:
        raise NotImplementedError

    def _acc_limits(self, names: Sequence[str]) -> tuple[Floats, Floats] | None:
        """Return acceleration and comfortable deceleration of CAVs [m/s2]; None: those of the ACC."""
        return None

    def _is_uncapped(self, name: str) -> bool:
        """Whether a set-speed cap is not allowed where a CAV is."""
        return False

    def _command_cavs(self, speeds: dict[str, float]) -> None:
        """Give a CAV with its own ACC a set-speed cap, or none if it may drive freely.

        SUMO still drives such a CAV: it brakes as hard as its ACC must, and makes room for vehicles that change lanes.
        A CAV with a commanded speed does neither. Without a leader, the ACC accelerates as commanded.
        """
        cruise, simulation, names = self.scenario.cruise, self._simulation, list(speeds)
        if self.scenario.actuation != "cruise":
            super()._command_cavs(speeds)
            return
        current, targets = np.array(simulation.speeds(names)), np.array([*speeds.values()])
        step, limits = self.scenario.simulation_step, self._acc_limits(names)
        caps = cruise.set_speed(current, targets, self.limits.highest, step, limits)
        for name, cap in zip(names, caps.tolist(), strict=True):
            if cap < inf and not self._is_uncapped(name):
                max_speed = self._uncapped_max_speeds.setdefault(name, simulation.max_speed(name))
                simulation.set_max_speed(name, min(cap, max_speed))
            elif name in self._uncapped_max_speeds:
                simulation.set_max_speed(name, self._uncapped_max_speeds.pop(name))
