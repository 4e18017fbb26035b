"""The record of a batch of rings."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from unjam.physics.arrays import Array
from unjam.scenarios.ring import LoopScenario
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.batch.human_idm import CONTACT_GAP
from unjam.worlds.closed_road import ClosedRoadLog
from unjam.worlds.record import Episode, Floats
from unjam.worlds.world import DriverLog


@dataclass(frozen=True)
class RingLog:
    """All simulation steps of W rings, in arrays of the batch."""

    scenarios: Sequence[LoopScenario]
    roads: Sequence[ClosedRoad]
    seeds: Sequence[Sequence[int]]
    start_positions: Floats
    """front bumpers at the start [m], shape (vehicles, W)"""
    find_contacts: Callable[[Array, Array, Array], Array]
    """returns the vehicles that touch another one, for positions, gaps and the length of the road [m]"""
    series: dict[str, list[Array]]
    """the series of `ClosedRoadLog` by name; arrays of shape (vehicles, W) or (CAVs * W,) for each step"""

    def make_episodes(
        self, control_steps: Floats, has_crashed: Floats, driver_log: DriverLog, penetration_rate: float | None
    ) -> tuple[Episode, ...]:
        """Return the record of each ring until its last control step.

        Vehicles that touched may be separate again at the end, because a control step has several simulation steps.
        """
        last = driver_log.last_observation
        decisions = [tuple(map(as_numpy, decision)) for decision in driver_log.decisions]
        last = None if last is None else as_numpy(last)
        driver_log = replace(driver_log, decisions=decisions, last_observation=last)
        vehicle_count, cav_count = len(self.start_positions), len(self.roads[0].cav_ids)
        row_counts = {"noise_free_speeds": vehicle_count, "speeds": vehicle_count}
        values = {name: self._stack(each, row_counts.get(name, cav_count)) for name, each in self.series.items()}
        episodes = []
        ends = control_steps.astype(int), has_crashed.astype(bool)
        rings = zip(self.scenarios, self.roads, self.seeds, *ends, strict=True)
        for ring, (scenario, road, seed, count, crashed) in enumerate(rings):
            steps = count * scenario.steps_per_control_step
            counts = {"requested_accelerations": count, "speeds": steps + 1}
            own: dict[str, Any] = {name: each[: counts.get(name, steps), :, ring] for name, each in values.items()}
            start = self.start_positions[:, ring]
            own |= {"has_crashed": bool(crashed), "penetration_rate": penetration_rate}
            log = ClosedRoadLog(scenario, road, start, **own)
            motion = log.speeds_and_positions()
            position = motion[1][:, -1]
            # The leader's position is not wrapped: a vehicle that touches its leader may be a little beyond it.
            gaps = np.append(position[1:], position[0] + road.loop_length) - position - VEHICLE_LENGTH
            touches = self.find_contacts(position, gaps, road.loop_length)
            is_touched = np.roll(touches & (gaps < CONTACT_GAP), 1)  # on a crossing, `touches` contains both vehicles
            fields = {
                "seed": tuple(seed),
                "status": "collision" if crashed else "completed",
                "control_step": scenario.control_step,
                "warmup": scenario.warmup,
                "drawn_values": road.drawn_values,
                "collisions": max(2 * int(crashed), int((touches | is_touched).sum())),
                "limit_speed": road.limit_speed,
            }
            rows = np.arange(cav_count) * len(self.roads) + ring
            episodes.append(log.episode(motion, fields, driver_log, rows))
        return tuple(episodes)

    def _stack(self, steps: list[Array], row_count: int) -> Floats:
        """Return the values of all steps, shape (steps, row_count, W)."""
        shape = len(steps), row_count, self.start_positions.shape[1]
        return np.stack([as_numpy(each) for each in steps]).reshape(shape) if steps else np.zeros(shape)


def as_numpy(values: Any) -> Floats:
    """Return an array or a tensor as a NumPy array in double precision."""
    return np.asarray(values.double().cpu() if hasattr(values, "cpu") else values, np.float64)
