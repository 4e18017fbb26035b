"""Traffic on roads with lanes: the CAV's own ACC may carry out commands."""

from collections.abc import Sequence
from math import inf

import numpy as np

from unjam.drivers.command import Command, commanded_time_gaps
from unjam.worlds.multi_lane_log import MultiLaneLog, TrackedLeader
from unjam.worlds.open_road_log import OpenRoadLog
from unjam.worlds.record import Floats
from unjam.worlds.sumo.open_road import OpenTraffic
from unjam.worlds.sumo.traffic import OpenRoadT


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
