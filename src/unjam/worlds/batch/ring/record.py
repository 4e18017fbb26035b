"""What happened in a batch of rings: sums of each, and the whole record where it was kept."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from unjam.physics.arrays import Array
from unjam.scenarios.ring import LoopScenario
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.batch.leaders import CONTACT_GAP
from unjam.worlds.closed_road import ClosedRoadLog
from unjam.worlds.record import Episode, Floats
from unjam.worlds.world import DriverLog


@dataclass(frozen=True)
class RingResults:
    """What happened on W rings; arrays of shape (W,)."""

    control_steps: Floats
    """made until the end, or until a collision"""
    has_crashed: Floats
    """1 where there was a collision"""
    reward_terms: dict[str, Floats]
    """terms of the reward, summed"""
    mean_speed: Floats
    """of all vehicles after each decision [m/s]"""
    min_time_gap: Floats
    """smallest of the CAVs in any step while they drive faster than 1 m/s [s]; infinite where never"""
    max_braking: Floats
    """hardest of the CAVs in a step [m/s2]"""
    episodes: tuple[Episode, ...] = ()
    """the whole record of each, without its reward; none where it was not kept"""


@dataclass(frozen=True)
class RingLog:
    """All simulation steps of W rings, arrays as they were stepped."""

    start_positions: Floats
    """front bumpers as it began [m], shape (vehicles, W)"""
    speeds: list[Array]
    """with noise, that at the start being the first; (vehicles, W) each"""
    find_contacts: Callable[[Array, Array, Array], Array]
    """which vehicles touch another one, of positions, gaps and the road's length [m]"""
    noise_free_speeds: list[Array] = field(default_factory=list)
    """speeds before noise; likewise"""
    requested_accelerations: list[Array] = field(default_factory=list)
    """what drivers asked for in each decision; (CAVs * W,) each"""
    safe_accelerations: list[Array] = field(default_factory=list)
    """what passed the filter in each step; likewise"""
    commanded_speeds: list[Array] = field(default_factory=list)
    """the speeds that this leads to; likewise"""

    def make_episodes(
        self,
        scenarios: Sequence[LoopScenario],
        roads: Sequence[ClosedRoad],
        seeds: Sequence[Sequence[int]],
        control_steps: Floats,
        has_crashed: Floats,
        driver_log: DriverLog,
        penetration_rate: float | None,
    ) -> tuple[Episode, ...]:
        """Return the record of each ring, which ends after so many decisions; the share is as it was told.

        Who touched in one that has `crashed` may do so no more when it ends: a decision has many steps.
        """
        rings, cavs = len(roads), len(roads[0].cav_ids)
        decided = [tuple(map(as_numpy, decision)) for decision in driver_log.decisions]
        last = None if driver_log.last_observation is None else as_numpy(driver_log.last_observation)
        driver_log = replace(driver_log, decisions=decided, last_observation=last)
        ways = {name: _stack_steps(getattr(self, name), -1, rings) for name in ("noise_free_speeds", "speeds")}
        asked = {
            name: _stack_steps(getattr(self, name), cavs, rings)
            for name in ("requested_accelerations", "safe_accelerations", "commanded_speeds")
        }
        return tuple(
            self._make_episode(
                scenario, road, seed, number, int(count), bool(touched), driver_log, penetration_rate, {**ways, **asked}
            )
            for number, (scenario, road, seed, count, touched) in enumerate(
                zip(scenarios, roads, seeds, control_steps, has_crashed, strict=True)
            )
        )

    def _make_episode(
        self,
        scenario: LoopScenario,
        road: ClosedRoad,
        seed: Sequence[int],
        ring_index: int,
        control_steps: int,
        has_crashed: bool,
        driver_log: DriverLog,
        penetration_rate: float | None,
        step_values: dict[str, Floats],
    ) -> Episode:
        made = control_steps * scenario.steps_per_control_step
        ends = {"requested_accelerations": control_steps, "speeds": made + 1}
        own: dict[str, Any] = {
            name: values[: ends.get(name, made), :, ring_index] for name, values in step_values.items()
        }
        log = ClosedRoadLog(
            scenario, road, self.start_positions[:, ring_index], **own, penetration_rate=penetration_rate
        )
        moments = log.speeds_and_positions()
        before = moments[1][:, -1]
        # Not wrapped: who touches the car ahead is a little before or beyond it.
        ahead = np.append(before[1:], before[0] + road.loop_length)
        gaps = ahead - before - VEHICLE_LENGTH
        collided = self.find_contacts(before, gaps, road.loop_length)
        hit = np.roll(collided & (gaps < CONTACT_GAP), 1)  # across a crossing both are told of
        facts = {
            "seed": tuple(seed),
            "status": "collision" if has_crashed else "completed",
            "control_step": scenario.control_step,
            "warmup": scenario.warmup,
            "drawn_values": road.drawn_values,
            "collisions": max(2 * has_crashed, int((collided | hit).sum())),
            "limit_speed": road.limit_speed,
        }
        rows = np.arange(len(road.cav_ids)) * self.start_positions.shape[1] + ring_index
        return replace(log, has_crashed=has_crashed).episode(moments, facts, driver_log, rows)


def as_numpy(values: Any) -> Floats:
    """Return an array or a tensor as a NumPy array in double precision."""
    return np.asarray(values.double().cpu() if hasattr(values, "cpu") else values, np.float64)


def _stack_steps(values: list[Array], row_count: int, ring_count: int) -> Floats:
    """Return arrays one after the other, shape (len(values), first, rings)."""
    if not values:
        return np.zeros((0, max(row_count, 0), ring_count))
    return np.stack([as_numpy(each) for each in values]).reshape(len(values), row_count, ring_count)
