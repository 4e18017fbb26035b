"""Synthetic pairs of leader and follower, on which tests calibrate."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from unjam.following.leader_replay import AccelerationFunction, follow_leader, idm_function
from unjam.physics.idm import IDMParameters, equilibrium_gap
from unjam.recordings.trajectories import FollowingTrajectory

STEP = 0.1


def follower(
    driver: AccelerationFunction,
    name: str = "0",
    seconds: float = 40.0,
    speed: float = 8.0,
    gap: float = 14.0,
    seed: int = 0,
    split: str = "",
) -> FollowingTrajectory:
    """Return the trajectory of `driver` behind a leader whose speed oscillates."""
    times = np.arange(round(seconds / STEP) + 1) * STEP
    phase = np.random.default_rng(seed).uniform(0, 6)
    leader_speed = 8.0 + 3.0 * np.sin(0.25 * times + phase) + np.sin(0.9 * times)
    leader_path = gap + np.r_[0.0, np.cumsum(leader_speed[1:]) * STEP]
    leader = (leader_speed[:, None], leader_path[:, None])
    states = list(follow_leader(driver, (np.array([speed]), np.array([gap])), leader, STEP))
    speeds, gaps = (
        np.concatenate([[first], *rows]) for first, rows in zip((speed, gap), zip(*states, strict=True), strict=True)
    )
    return FollowingTrajectory(name, name, STEP, speeds, leader_speed, gaps, "human", split)


def idm_driver(
    parameters: IDMParameters, name: str = "0", seed: int = 0, seconds: float = 40.0, split: str = ""
) -> FollowingTrajectory:
    """Return the trajectory of an IDM that starts with its equilibrium gap."""
    gap = equilibrium_gap(8.0, parameters)
    return follower(idm_function(parameters), name, seconds, 8.0, gap, seed, split)


def write_table(path: Path, drivers: Sequence[Mapping[str, object]] = ({},) * 3) -> None:
    """Write trajectories as a user has them, as CSV or Parquet; drivers differ in their time headway.

    `drivers` has further columns with one value for each driver.
    """
    parts = []
    for number, columns in enumerate(drivers):
        trajectory = idm_driver(IDMParameters(time_headway=0.9 + 0.1 * number), seed=number, seconds=20.0)
        times = STEP * np.arange(len(trajectory.speed))
        numbers = {"t": times, "v_foll": trajectory.speed, "v_lead": trajectory.leader_speed, "gap": trajectory.gap}
        parts.append(pd.DataFrame({"pair": number, **numbers, **columns}))
    table = pd.concat(parts)
    table.to_parquet(path) if path.suffix == ".parquet" else table.to_csv(path, index=False)
