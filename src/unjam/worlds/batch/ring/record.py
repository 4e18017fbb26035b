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
"""returns which vehicles touch another vehicle, for positions, gaps and the length of the road [m]"""


def make_ring_episodes(
    rings: Iterable[tuple[Scenario, OrderedRoad, Sequence[int], int, bool]],
    start_positions: Floats,
    series: dict[str, list[Array]],
    find_contacts: FindContacts,
    driver_log: DriverLog,
    penetration_rate: float | None,
) -> tuple[Episode, ...]:
    """Return the record of each ring, given scenario, road, seed, number of control steps, and whether it has crashed.

    `start_positions` are those of front bumpers [m], (vehicles, W). `series` has fields of `OrderedRoadLog` by name,
    with shape (vehicles, W) or (CAVs * W,) in each step. `penetration_rate` is reported to the CAVs.
    """
    if driver_log.last_observation is not None:
        driver_log = replace(driver_log, last_observation=as_numpy(driver_log.last_observation))
    driver_log = replace(driver_log, decisions=[tuple(map(as_numpy, decision)) for decision in driver_log.decisions])
    ring_count, arrays = start_positions.shape[1], dict[str, Floats]()
    for name, steps in series.items():
        step_arrays = [as_numpy(step).reshape(-1, ring_count) for step in steps]
        arrays[name] = np.stack(step_arrays) if steps else np.zeros((0, 0, ring_count))
    episodes = []
    for ring, (scenario, road, seed, control_steps, has_crashed) in enumerate(rings):
        step_count = control_steps * scenario.steps_per_control_step
        lengths = {"requested_accelerations": control_steps, "speeds": step_count + 1}
        fields: dict[str, Any] = {"has_crashed": has_crashed, "penetration_rate": penetration_rate}
        fields |= {name: array[: lengths.get(name, step_count), :, ring] for name, array in arrays.items()}
        log = OrderedRoadLog(scenario, road, start_positions[:, ring], **fields)
        motion = log.speeds_and_positions()
        position = motion[1][:, -1]
        # Positions are not wrapped, because a vehicle that touches its leader may be slightly beyond it.
        gaps = np.append(position[1:], position[0] + road.loop_length) - position - VEHICLE_LENGTH
        touches = find_contacts(position, gaps, road.loop_length)
        is_touched = np.roll(touches & (gaps < CONTACT_GAP), 1)  # on a crossing, `touches` contains both vehicles
        # At least 2, because vehicles can separate again within a control step.
        collisions = max(2 * int(has_crashed), int((touches | is_touched).sum()))
        episode_fields = {**common_fields(scenario, road, seed, has_crashed), "collisions": collisions}
        rows = np.arange(len(road.cav_ids)) * ring_count + ring
        episodes.append(log.episode(motion, episode_fields, driver_log, rows))
    return tuple(episodes)


def as_numpy(values: Any) -> Floats:
    """Return an array or a tensor as a NumPy array in double precision."""
    return np.asarray(values.double().cpu() if hasattr(values, "cpu") else values, np.float64)
