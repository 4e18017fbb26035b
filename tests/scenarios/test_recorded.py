from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from unjam.drivers.car_following import IDM
from unjam.errors import InputError
from unjam.physics.idm import idm_acceleration
from unjam.scenarios import Recorded, make_scenario, scenario_from_recipe, scenario_recipe
from unjam.worlds.episode import run_episode

TIMES = 0.1 * np.arange(900)
SEED_GROUPS = (), (5,), (7, 3), (7, 4), (8, 1)


def write_drive(path: Path, mean: float = 15.0) -> Path:
    pd.DataFrame({"time": TIMES, "speed": mean + 0.3 * mean * np.sin(TIMES / 8.0)}).to_csv(path, index=False)
    return path


def test_a_platoon_is_written_from_front_to_back() -> None:
    road = Recorded(platoon="human*2 cav human").draw(np.random.default_rng(0))
    assert road.vehicle_ids == ("human_3", "cav_2", "human_1", "human_0", "leader")
    assert road.cav_ids == ("cav_2",)
    assert road.driven_count == 4
    assert Recorded(platoon="cav human cav").possible_cav_ids() == ("cav_2", "cav_0")


@pytest.mark.parametrize(
    "platoon", ["human*5", "", "cav*0", "cav human*5000", "cav, human", "truck cav", "cav*-1", "cav**2"]
)
def test_other_platoons_are_refused(platoon: str) -> None:
    with pytest.raises(InputError, match="platoon"):
        make_scenario("recorded", {"platoon": platoon})


def test_all_vehicles_start_in_equilibrium_behind_the_recorded_vehicle() -> None:
    scenario = Recorded()
    road = scenario.draw(np.random.default_rng(3))
    gaps, speed = np.diff(road.start_positions) - 5.0, road.start_speed
    np.testing.assert_allclose(idm_acceleration(speed, speed, gaps, scenario.humans), 0.0, atol=1e-9)


def test_an_episode_has_a_random_part_of_a_random_recording(tmp_path: Path) -> None:
    for number, mean in enumerate((10.0, 20.0)):
        write_drive(tmp_path / f"{number}.csv", mean)
    scenario = Recorded(recordings=str(tmp_path), window=30.0)
    roads = [scenario.draw(np.random.default_rng(seed)) for seed in range(40)]
    assert {road.drawn_values["file"] for road in roads} == {0.0, 1.0}
    starts = [road.drawn_values["begin"] for road in roads]
    assert 0.0 <= min(starts) < 10.0 < 45.0 < max(starts) <= 60.0
    assert all(len(road.replayed_speeds) == 301 for road in roads)


def test_parts_of_the_recordings_are_strata(tmp_path: Path) -> None:
    for number in range(4):
        write_drive(tmp_path / f"{number}.csv")
    parts = [Recorded(recordings=str(tmp_path)).stratum(index, 4) for index in range(4)]
    assert [Path(part.recordings).name for part in parts] == ["0.csv", "1.csv", "2.csv", "3.csv"]


@pytest.mark.parametrize("changes", [{}, {"begin": 60.0}, {"window": 30.0}, {"horizon": 50}, {"simulation_step": 0.05}])
def test_no_episode_is_longer_than_the_scenario_says(tmp_path: Path, changes: dict[str, Any]) -> None:
    for name, count in (("short", 300), ("long", 900)):
        pd.DataFrame({"time": TIMES[:count], "speed": 10.0}).to_csv(tmp_path / f"{name}.csv", index=False)
    scenario = Recorded(recordings=str(tmp_path / "long.csv"), **changes)
    episode = run_episode(scenario, IDM(), 0, backend="batch")
    assert episode.control_steps == scenario.max_episode_steps
    assert replace(scenario, recordings=str(tmp_path)).max_episode_steps == scenario.max_episode_steps


def test_a_window_longer_than_the_recording_is_refused(tmp_path: Path) -> None:
    scenario = Recorded(recordings=str(write_drive(tmp_path / "a.csv")), window=100.0)
    with pytest.raises(InputError, match=r"window: 100 s is not allowed; allowed: <= 89.9 s"):
        scenario.draw(np.random.default_rng(0))


def test_notes_say_what_was_read(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    times = np.where(TIMES < 30.0, TIMES, TIMES + 9.0)
    pd.DataFrame({"time": times, "speed": 2.0 + 0.1 * TIMES}).to_csv(path, index=False)
    note, _ = Recorded(recordings=str(path)).notes
    assert note == "recordings: a.csv: 2 parts of 30 to 60 s with speeds of 2.0 to 11.0 m/s"
    assert Recorded(recordings=str(tmp_path)).notes[0].startswith("recordings: 1 file of ")
    write_drive(tmp_path / "b.csv")
    assert Recorded(recordings=str(tmp_path)).notes[0].endswith(", drawn at random")
    assert Recorded(recordings=str(tmp_path), order="name").notes[0].endswith(", in the order of their names")


def test_files_in_the_order_of_their_names_are_driven_once_each(tmp_path: Path) -> None:
    for name in "cab":
        write_drive(tmp_path / f"{name}.csv")
    roads = [Recorded(recordings=str(tmp_path), order="name").draw_from_seed((5, seed))[0] for seed in range(4)]
    assert [road.drawn_values["file"] for road in roads] == [0, 1, 2, 0]
    random = Recorded(recordings=str(tmp_path))
    orders = [[random.draw_from_seed((*first, k))[0].drawn_values["file"] for k in range(3)] for first in SEED_GROUPS]
    assert all(sorted(order) == [0, 1, 2] for order in orders)
    assert len(set(map(tuple, orders))) > 1


def test_all_files_that_cannot_be_read_are_named_together(tmp_path: Path) -> None:
    write_drive(tmp_path / "a.csv")
    (tmp_path / "README.txt").write_text("recorded in May\n")
    (tmp_path / "b.csv").write_text("time_s,v\n0,1\n")
    with pytest.raises(InputError, match=r"README.txt: .*; also refused: b.csv; move .* by a pattern"):
        _ = Recorded(recordings=str(tmp_path)).max_episode_steps
    assert Recorded(recordings=str(tmp_path / "a*")).max_episode_steps > 0


def test_a_begin_after_the_end_is_refused(tmp_path: Path) -> None:
    scenario = Recorded(recordings=str(write_drive(tmp_path / "a.csv")), begin=90.0)
    with pytest.raises(InputError, match=r"begin: 90 s is not allowed; allowed: < 89.9 s"):
        scenario.draw(np.random.default_rng(0))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [({"recordings": "missing.csv"}, "recordings: 'missing.csv'"), ({"warmup": 10}, "warmup: 10 is not allowed")],
)
def test_settings_without_a_meaning_are_refused(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        make_scenario("recorded", changes)


def test_a_recipe_makes_the_same_scenario(tmp_path: Path) -> None:
    scenario = replace(Recorded(recordings=str(write_drive(tmp_path / "a.csv"))), platoon="human cav")
    assert scenario_from_recipe(scenario_recipe(scenario)) == scenario
    assert scenario.user_files == [tmp_path / "a.csv"]


def test_the_network_is_long_enough_and_shared() -> None:
    roads = [Recorded().draw(np.random.default_rng(seed)) for seed in range(10)]
    for road in roads:
        (edge,) = road.network.edges
        assert edge.length > road.start_positions[-1] + 0.1 * road.replayed_speeds.sum() + 1000.0
    assert len({road.network for road in roads}) < 5
