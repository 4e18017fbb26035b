"""A batch of recorded roads equals SUMO's episodes of the same seeds."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from tests.worlds.batch.test_world import assert_alike
from unjam.controller import make_driver
from unjam.drivers.safety import Actuator, SafetyFilter
from unjam.measures.platoon_metrics import time_behind_leader
from unjam.models.rollouts import to_device
from unjam.scenarios import Recorded
from unjam.worlds.batch.ring.recorded import RecordedBatch
from unjam.worlds.batch.run import run_batches, start_batch_drive
from unjam.worlds.episode import run_episode
from unjam.worlds.worker_pool import EpisodeTask

SHORT = Recorded(horizon=600)
ROADS = {
    "a CAV and people": (SHORT, "smooth-acc"),
    "people alone": (SHORT, "human"),
    "people ahead and two CAVs": (replace(SHORT, platoon="human*2 cav human*3 cav human"), "idm"),
    "people without noise": (replace(SHORT, noise=0.0), "pi"),
    "people with much noise": (replace(SHORT, noise=5.0), "idm"),
    "calibrated people": (replace(SHORT, population="unjam:ngsim"), "idm"),
    "people above their desired speed": (replace(SHORT, humans=replace(SHORT.humans, desired_speed=9.0)), "human"),
    "a car without delay": (replace(SHORT, actuator=Actuator()), "acc"),
    "no filter": (replace(SHORT, actuation="raw", safety=SafetyFilter(active=False)), "smooth-acc"),
    "commands that are held": (replace(SHORT, steps_per_control_step=5, horizon=100), "smooth-acc"),
    "a coarser step": (replace(SHORT, simulation_step=0.25), "smooth-acc"),
}


@pytest.mark.parametrize("name", ROADS)
def test_a_batch_equals_sumo(name: str) -> None:
    scenario, driver_name = ROADS[name]
    driver = make_driver(driver_name, scenario.control_step)
    found = run_batches([EpisodeTask(scenario, driver, (seed,)) for seed in range(3)])
    for seed, episode in enumerate(found):
        assert_alike(episode, run_episode(scenario, driver, seed))


def write_drive(path: Path, seconds: float) -> str:
    times = 0.1 * np.arange(round(seconds / 0.1) + 1)
    pd.DataFrame({"time": times, "speed": 12.0 + 6.0 * np.sin(times / 6.0)}).to_csv(path, index=False)
    return str(path)


def test_each_road_ends_with_its_recording(tmp_path: Path) -> None:
    roads = [Recorded(recordings=write_drive(tmp_path / f"{each}.csv", each)) for each in (30.0, 45.0, 20.0)]
    driver = make_driver("smooth-acc", 0.1)
    found = run_batches([EpisodeTask(road, driver, (0,)) for road in roads])
    assert [episode.control_steps for episode in found] == [300, 450, 200]
    for road, episode in zip(roads, found, strict=True):
        assert_alike(episode, run_episode(road, driver, 0))


def test_the_recorded_vehicle_repeats_its_recording(tmp_path: Path) -> None:
    road = Recorded(recordings=write_drive(tmp_path / "a.csv", 40.0))
    episode = run_episode(road, make_driver("human", 0.1), 0)
    expected = 12.0 + 6.0 * np.sin(0.1 * np.arange(401) / 6.0)
    np.testing.assert_allclose(episode.replayed_motion[:, 0, 1], expected, atol=1e-5)
    assert episode.vehicle_ids == ("human_5", "human_4", "human_3", "human_2", "human_1", "cav_0")


def test_the_time_behind_the_recorded_vehicle_may_be_longer_than_the_episode(tmp_path: Path) -> None:
    times = 0.1 * np.arange(201)
    pd.DataFrame({"time": times, "speed": 12.0}).to_csv(tmp_path / "a.csv", index=False)
    road = Recorded(recordings=str(tmp_path / "a.csv"), platoon="cav human*30", noise=0.0)
    (episode,) = run_batches([EpisodeTask(road, make_driver("human", 0.1), (0,))])
    distance = episode.replayed_motion[-1, 0, 0] - episode.positions[-1, 0]
    assert distance / 12.0 > 20.0
    assert time_behind_leader(episode) == pytest.approx(distance / 12.0, rel=1e-3)


def test_torch_gives_the_same_speeds() -> None:
    speeds = []
    for to_array in (np.asarray, lambda values: to_device(values, "cpu")):
        world = RecordedBatch([replace(SHORT, horizon=200, noise=0.0)] * 3, [(0,), (1,), (2,)], to_array)
        loop = start_batch_drive(world, make_driver("smooth-acc", 0.1), to_array)
        for _ in loop:
            pass
        speeds.append(np.asarray(world.exact_state().speed, np.float64))
    np.testing.assert_allclose(speeds[1], speeds[0], rtol=2e-4)
    assert torch.is_tensor(world.exact_state().speed)


def test_the_last_vehicle_observes_nobody_behind() -> None:
    road = replace(SHORT, platoon="human cav", horizon=20)
    for backend in ("sumo", "batch"):
        (cav,) = run_episode(road, make_driver("idm", 0.1), 0, backend=backend).trajectories
        assert set(cav.states.follower_gap) == {100.0}
        np.testing.assert_array_equal(cav.states.follower_speed, cav.states.speed)
