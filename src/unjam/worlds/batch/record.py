"""What happened in a batch of rings: sums of each, and the whole record where it was kept."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from unjam.physics.arrays import Array
from unjam.scenarios.ring import Loop
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.worlds.batch.lanes import CONTACT
from unjam.worlds.closed import ClosedLog
from unjam.worlds.record import Episode, Floats
from unjam.worlds.world import Driven


@dataclass(frozen=True)
class Rings:
    """What happened on W rings; arrays of shape (W,)."""

    decisions: Floats
    """made until the end, or until a collision"""
    crashed: Floats
    """1 where there was a collision"""
    terms: dict[str, Floats]
    """terms of the reward, summed"""
    mean_speed: Floats
    """of all vehicles after each decision [m/s]"""
    headway: Floats
    """smallest of the CAVs in any step while they drive faster than 1 m/s [s]; infinite where never"""
    braking: Floats
    """hardest of the CAVs in a step [m/s2]"""
    episodes: tuple[Episode, ...] = ()
    """the whole record of each, without its reward; none where it was not kept"""


@dataclass(frozen=True)
class RingLog:
    """All simulation steps of W rings, arrays as they were stepped."""

    start: Floats
    """front bumpers as it began [m], shape (vehicles, W)"""
    speeds: list[Array]
    """with noise, that at the start being the first; (vehicles, W) each"""
    touching: Callable[[Array, Array, Array], Array]
    """which vehicles touch another one, of positions, gaps and the road's length [m]"""
    moved: list[Array] = field(default_factory=list)
    """speeds before noise; likewise"""
    wanted: list[Array] = field(default_factory=list)
    """what drivers asked for in each decision; (CAVs * W,) each"""
    told: list[Array] = field(default_factory=list)
    """what passed the filter in each step; likewise"""
    commanded: list[Array] = field(default_factory=list)
    """the speeds that this leads to; likewise"""

    def episodes(
        self,
        scenarios: Sequence[Loop],
        roads: Sequence[ClosedRoad],
        seeds: Sequence[Sequence[int]],
        decisions: Floats,
        crashed: Floats,
        driven: Driven,
        cav_share: float | None,
    ) -> tuple[Episode, ...]:
        """Return the record of each ring, which ends after so many decisions; the share is as it was told.

        Who touched in one that has `crashed` may do so no more when it ends: a decision has many steps.
        """
        rings, cavs = len(roads), len(roads[0].cav_ids)
        decided = [tuple(map(as_numpy, decision)) for decision in driven.decisions]
        last = None if driven.last_observation is None else as_numpy(driven.last_observation)
        driven = replace(driven, decisions=decided, last_observation=last)
        ways = {name: _stacked(getattr(self, name), -1, rings) for name in ("moved", "speeds")}
        asked = {name: _stacked(getattr(self, name), cavs, rings) for name in ("wanted", "told", "commanded")}
        return tuple(
            self._episode(
                scenario, road, seed, number, int(count), bool(touched), driven, cav_share, {**ways, **asked}
            )
            for number, (scenario, road, seed, count, touched) in enumerate(
                zip(scenarios, roads, seeds, decisions, crashed, strict=True)
            )
        )

    def _episode(
        self,
        scenario: Loop,
        road: ClosedRoad,
        seed: Sequence[int],
        number: int,
        decisions: int,
        crashed: bool,
        driven: Driven,
        cav_share: float | None,
        steps: dict[str, Floats],
    ) -> Episode:
        made = decisions * scenario.steps_per_decision
        ends = {"wanted": decisions, "speeds": made + 1}
        own: dict[str, Any] = {
            name: values[: ends.get(name, made), :, number] for name, values in steps.items()
        }
        log = ClosedLog(scenario, road, self.start[:, number], **own, cav_share=cav_share)
        moments = log.moments()
        before = moments[1][:, -1]
        # Not wrapped: who touches the car ahead is a little before or beyond it.
        ahead = np.append(before[1:], before[0] + road.loop_length)
        gaps = ahead - before - VEHICLE_LENGTH
        collided = self.touching(before, gaps, road.loop_length)
        hit = np.roll(collided & (gaps < CONTACT), 1)  # across a crossing both are told of
        facts = {
            "seed": tuple(seed),
            "status": "collision" if crashed else "completed",
            "step": scenario.decision_step,
            "warmup": scenario.warmup,
            "drawn": road.drawn,
            "collisions": max(2 * crashed, int((collided | hit).sum())),
            "limit_speed": road.limit_speed,
        }
        rows = np.arange(len(road.cav_ids)) * self.start.shape[1] + number
        return replace(log, crashed=crashed).episode(moments, facts, driven, rows)


def as_numpy(values: Any) -> Floats:
    """Return an array or a tensor as a NumPy array in double precision."""
    return np.asarray(values.double().cpu() if hasattr(values, "cpu") else values, np.float64)


def _stacked(values: list[Array], first: int, rings: int) -> Floats:
    """Return arrays one after the other, shape (len(values), first, rings)."""
    if not values:
        return np.zeros((0, max(first, 0), rings))
    return np.stack([as_numpy(each) for each in values]).reshape(len(values), first, rings)
