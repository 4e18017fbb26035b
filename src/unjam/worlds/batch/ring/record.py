"""The record of a batch of rings."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from unjam.physics.arrays import Array
from unjam.scenarios.road import OrderedRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario
from unjam.worlds.batch.human_idm import CONTACT_GAP
from unjam.worlds.ordered_road import OrderedRoadLog
from unjam.worlds.record import Episode, Floats, common_fields
from unjam.worlds.world import DriverLog

FindContacts = Callable[[Array, Array, Array], Array]
"""returns the vehicles that touch another one, for positions, gaps and the length of the road [m]"""


def make_ring_episodes(
    rings: Iterable[tuple[Scenario, OrderedRoad, Sequence[int], int, bool]],
    start_positions: Floats,
    series: dict[str, list[Array]],
    find_contacts: FindContacts,
    driver_log: DriverLog,
    penetration_rate: float | None,
) -> tuple[Episode, ...]:
    """Return the record of each of `rings`: scenario, road, seed, number of control steps, and whether it has crashed.

    `start_positions` are front bumpers [m], (vehicles, W); `series` those of `OrderedRoadLog` by name, (vehicles, W) or
    (CAVs * W,) for each step; `penetration_rate` is that reported to the CAVs.
    """
    last = driver_log.last_observation
    decisions = [tuple(map(as_numpy, decision)) for decision in driver_log.decisions]
    driver_log = replace(driver_log, decisions=decisions, last_observation=None if last is None else as_numpy(last))
    ring_count, values = start_positions.shape[1], dict[str, Floats]()
    for name, steps in series.items():
        stacked = [as_numpy(step).reshape(-1, ring_count) for step in steps]
        values[name] = np.stack(stacked) if steps else np.zeros((0, 0, ring_count))
    episodes = []
    for ring, (scenario, road, seed, count, has_crashed) in enumerate(rings):
        step_count = count * scenario.steps_per_control_step
        counts = {"requested_accelerations": count, "speeds": step_count + 1}
        ring_arrays: dict[str, Any] = {
            name: array[: counts.get(name, step_count), :, ring] for name, array in values.items()
        }
        ring_arrays |= {"has_crashed": has_crashed, "penetration_rate": penetration_rate}
        log = OrderedRoadLog(scenario, road, start_positions[:, ring], **ring_arrays)
        motion = log.speeds_and_positions()
        position = motion[1][:, -1]
        # The leader's position is not wrapped: a vehicle that touches its leader may be a little beyond it.
        gaps = np.append(position[1:], position[0] + road.loop_length) - position - VEHICLE_LENGTH
        # Vehicles that touched may be separate again: a control step has several simulation steps.
        touches = find_contacts(position, gaps, road.loop_length)
        is_touched = np.roll(touches & (gaps < CONTACT_GAP), 1)  # on a crossing, `touches` contains both vehicles
        collisions = max(2 * int(has_crashed), int((touches | is_touched).sum()))
        fields = {**common_fields(scenario, road, seed, has_crashed), "collisions": collisions}
        rows = np.arange(len(road.cav_ids)) * ring_count + ring
        episodes.append(log.episode(motion, fields, driver_log, rows))
    return tuple(episodes)


def as_numpy(values: Any) -> Floats:
    """Return an array or a tensor as a NumPy array in double precision."""
    return np.asarray(values.double().cpu() if hasattr(values, "cpu") else values, np.float64)
