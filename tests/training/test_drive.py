import json
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from unjam.controller.file import controller_bytes
from unjam.drivers import IDM, LocalState, PISaturation, check_driver
from unjam.drivers.driver import Driver, Memory
from unjam.environments.gymnasium_env import RoadEnv
from unjam.errors import InputError
from unjam.files import sha256_of, to_json
from unjam.measures.metrics import METRICS, measure
from unjam.reports.results import read_results
from unjam.scenarios import Ring
from unjam.seeds import held_out_seeds
from unjam.training.drive import DriveResult, drive
from unjam.training.evaluate import raise_failures
from unjam.worlds.episode import run_episode

ROAD: dict[str, Any] = {"length": (120, 130), "vehicles": 8, "horizon": 60}


@pytest.fixture(scope="module")
def drive_result(tmp_path_factory: pytest.TempPathFactory) -> DriveResult:
    """Two drivers on the same three episodes, written into a folder."""
    out = tmp_path_factory.mktemp("drives") / "new" / "folder"
    return drive("ring", ["pi", IDM()], episodes=3, seed=4, scenario_options=ROAD, workers=1, out=out)


def test_every_driver_has_a_row_for_every_seed(drive_result: DriveResult) -> None:
    assert list(drive_result.rows) == ["pi", "idm"]
    for rows in drive_result.rows.values():
        assert [row["seed"] for row in rows] == [4, 5, 6]
        assert {row["status"] for row in rows} == {"completed"}


def test_hash_of_a_controller_is_that_of_the_file_that_drove(tmp_path: Path) -> None:
    file, first = tmp_path / "mine.unjam", controller_bytes(PISaturation(), {})
    file.write_bytes(first)

    def replace_controller(episode: object, steps: int) -> None:
        file.write_bytes(controller_bytes(PISaturation(window=20.0), {}))

    drive("ring", str(file), 1, scenario_options=ROAD, workers=1, out=tmp_path / "out", progress=replace_controller)
    assert file.read_bytes() != first
    assert read_results(tmp_path / "out").metadata["controllers"] == {str(file): sha256_of(first)}


def test_drivers_have_the_order_of_all_tables_and_the_mean_is_of_the_first_that_was_given() -> None:
    result = drive("ring", ["pi", "human"], episodes=1, scenario_options=ROAD, workers=1)
    assert list(result.rows) == list(result.plot_episodes) == ["human", "pi"]
    assert [entry["driver"] for entry in result.document()["drivers"]] == ["human", "pi"]
    assert result.mean["return"] == result.rows["pi"][0]["return"]


def test_row_measures_the_episode_of_its_seed(drive_result: DriveResult) -> None:
    ring = Ring(**ROAD)
    for row in drive_result.rows["pi"]:
        (trajectory,) = run_episode(ring, PISaturation(), (row["seed"],)).trajectories
        assert row["return"] == trajectory.reward.sum()


def test_test_seeds_are_those_of_training_evaluations() -> None:
    judged = drive("ring", "pi", episodes=2, scenario_options=ROAD, workers=1, test_seeds=True).rows["pi"]
    again = [run_episode(Ring(**ROAD), PISaturation(), seed).trajectories[0] for seed in held_out_seeds(2)]
    assert [row["return"] for row in judged] == [trajectory.reward.sum() for trajectory in again]


def test_results_are_written_with_a_report(drive_result: DriveResult) -> None:
    assert drive_result.folder is not None
    assert {path.name for path in drive_result.folder.iterdir()} == {
        "evaluation.json",
        "episodes.parquet",
        "plot_episodes.safetensors",
        "report.html",
    }
    assert drive_result.report == drive_result.folder / "report.html"
    results = read_results(drive_result.folder)
    assert list(results.rows) == ["pi", "idm"]
    assert results.metadata["reward"] == "released"
    assert results.trained_label is None


def test_mean_is_that_of_the_first_driver(drive_result: DriveResult) -> None:
    speeds = [row["mean_speed"] for row in drive_result.rows["pi"]]
    assert drive_result.mean["mean_speed"] == pytest.approx(np.mean(speeds))
    found = drive_result.summary("idm")["mean_speed"]
    assert found.mean == pytest.approx(np.mean([row["mean_speed"] for row in drive_result.rows["idm"]]))
    assert found.low <= found.mean <= found.high
    assert found.count == 3


def test_document_has_a_list_of_drivers(drive_result: DriveResult) -> None:
    document = json.loads(to_json(drive_result.document()))
    assert document["scenario"] == "ring"
    assert [entry["driver"] for entry in document["drivers"]] == ["pi", "idm"]
    for entry in document["drivers"]:
        assert len(entry["episodes"]) == 3
        assert entry["mean"].keys() == entry["ci95"].keys() == METRICS.keys()
        assert entry["report"] == str(drive_result.report)
    expert = document["drivers"][0]["baseline"]
    assert expert in ("pi", "idm")
    for entry in document["drivers"]:
        assert entry["baseline"] == expert
        assert (entry["difference_to_baseline"] is None) == (entry["driver"] == expert)


def test_a_requested_baseline_is_compared_with_in_results_and_report(tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = drive("ring", ["human", "pi", "idm"], 2, 0, ROAD, workers=1, out=out, baseline="idm")
    documents = {entry["driver"]: entry for entry in result.document()["drivers"]}
    assert {entry["baseline"] for entry in documents.values()} == {"idm"}
    assert documents["idm"]["difference_to_baseline"] is None
    expected = result.summary("pi")["mean_speed"].mean - result.summary("idm")["mean_speed"].mean
    assert documents["pi"]["difference_to_baseline"]["mean_speed"][0] == pytest.approx(expected)
    assert "that of idm" in result._repr_html_() or "compared with idm" in result._repr_html_()
    assert "pi: " in str(result)
    assert "m/s" in str(result)
    assert result.report is not None
    assert "Differences to idm" in result.report.read_text()
    with pytest.raises(InputError, match="baseline: 'ghost' is not allowed; allowed: human, pi"):
        drive("ring", ["human", "pi"], baseline="ghost")


def test_document_is_strict_json_with_null_for_nan() -> None:
    result = drive("ring", "pi", episodes=1, scenario_options=ROAD, workers=1)
    document = json.loads(to_json(result.document()), parse_constant=lambda name: pytest.fail(name))
    (document,) = document["drivers"]  # also one driver is a list
    assert document["driver"] == "pi"
    assert document["mean"]["mean_speed"] == result.mean["mean_speed"]
    assert document["mean"]["time_to_dissolve"] is None  # 6 s are too short for traffic to be calm for a minute
    assert document["ci95"]["mean_speed"] == [None, None]  # one episode has no spread
    assert document["folder"] is None


def test_without_out_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = drive("ring", "idm", episodes=1, scenario_options=ROAD, workers=1)
    assert (result.folder, result.report) == (None, None)
    assert not list(tmp_path.iterdir())


def test_no_temporary_file_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)  # where Python remembers what TMPDIR was
    drive("ring", "idm", episodes=1, scenario_options=ROAD, workers=1)
    assert not list(tmp_path.iterdir())


def test_number_of_workers_does_not_change_the_result(drive_result: DriveResult) -> None:
    other = drive("ring", ["pi", "idm"], episodes=3, seed=4, scenario_options=ROAD, workers=2)
    assert to_json(other.rows) == to_json(drive_result.rows)


def test_progress_has_driver_and_episode() -> None:
    messages: list[tuple[Any, int]] = []
    drive(
        "ring",
        ["pi", "idm"],
        1,
        scenario_options=ROAD,
        workers=1,
        progress=lambda key, steps: messages.append((key, steps)),
    )
    assert (("pi", 0), 60) in messages
    assert (("idm", 0), 60) in messages


def test_user_reward_is_used(my_drivers: Path, tmp_path: Path) -> None:
    name = f"{my_drivers}:calm"
    result = drive("ring", "idm", 1, scenario_options=ROAD, reward=name, workers=1, out=tmp_path / "out")
    (trajectory,) = run_episode(Ring(**ROAD), IDM(), (0,), name).trajectories
    assert result.rows["idm"][0]["return"] == trajectory.reward.sum()
    assert read_results(tmp_path / "out").metadata["reward"] == name


def test_failed_driver_has_rows_and_can_be_raised(my_drivers: Path, tmp_path: Path) -> None:
    bad = f"{my_drivers}:broken"
    result = drive("ring", ["idm", bad], episodes=2, scenario_options=ROAD, workers=1, out=tmp_path / "out")
    assert [row["status"] for row in result.rows[bad]] == ["failed", "failed"]
    assert [row["status"] for row in result.rows["idm"]] == ["completed", "completed"]
    assert (tmp_path / "out" / "report.html").is_file()
    with pytest.raises(InputError, match="step 0: acceleration of cav_0 is nan") as caught:
        raise_failures(result)
    assert "\n" not in str(caught.value)


def test_nothing_is_raised_without_failures(drive_result: DriveResult) -> None:
    raise_failures(drive_result)


class Stays(Driver):
    """A driver that another process cannot make again."""

    def act(self, state: LocalState, memory: Memory) -> tuple[Any, Memory]:
        return state.speed * 0.0, memory


class Follows:
    """Follows the leader's speed; knows nothing of unjam."""

    def __init__(self, gain: float) -> None:
        self.gain = gain

    def initial_memory(self, n: int) -> dict[str, Any]:
        return {"asked": np.zeros(n)}

    def act(self, state: LocalState, memory: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return self.gain * (state.leader_speed - state.speed), {"asked": memory["asked"] + 1.0}


def follow(state: LocalState) -> Any:
    return 0.5 * (state.leader_speed - state.speed)


def test_functions_and_objects_are_drivers() -> None:
    result = drive("ring", [follow, Follows(0.5), Follows(0.2), Stays, "idm"], 2, scenario_options=ROAD, workers=1)
    assert list(result.rows) == ["idm", "follow", "Follows", "Follows (2)", "Stays"]
    raise_failures(result)
    rows = {label: [row["return"] for row in rows] for label, rows in result.rows.items()}
    assert rows["follow"] == rows["Follows"] != rows["Follows (2)"]
    episode = run_episode(Ring(**ROAD), Follows(0.2), 1)
    assert measure(episode)["return"] == rows["Follows (2)"][1]
    check_driver(follow)
    check_driver(Follows(0.2))


def test_error_in_a_function_is_raised_unchanged() -> None:
    with pytest.raises(ZeroDivisionError):
        drive("ring", lambda state: 1 / 0, 1, scenario_options=ROAD, workers=1)


def test_drive_works_with_an_open_environment_and_warns() -> None:
    with closing(RoadEnv(**ROAD)) as environment:
        environment.reset(seed=0)
        with pytest.warns(UserWarning, match="runs in a process of its own"):
            concurrent = drive("ring", follow, 1, scenario_options=ROAD, workers=1)
    assert concurrent.mean["return"] == drive("ring", follow, 1, scenario_options=ROAD, workers=1).mean["return"]


def test_result_has_a_pandas_table_and_a_notebook_view(drive_result: DriveResult) -> None:
    table = drive_result.table()
    assert list(table.index) == list(METRICS)
    assert table["pi", "mean"].to_dict() == pytest.approx(drive_result.mean, nan_ok=True)
    assert list(table["idm"].columns) == ["mean", "low", "high"]
    episodes = drive_result.episodes()
    assert len(episodes) == 6
    assert list(episodes.loc[episodes["driver"] == "pi", "seed"]) == ["4", "5", "6"]
    html = drive_result._repr_html_()
    assert "mean speed [m/s]" in html
    assert html.count('src="data:image/svg+xml;base64,') == 1
    brief = drive_result.table(brief=True)
    assert set(brief.index) < set(METRICS)
    pd.testing.assert_frame_equal(brief, table.loc[list(brief.index)])


def test_result_draws_its_episodes(drive_result: DriveResult) -> None:
    assert [axes.get_title(loc="left") for axes in drive_result.plot().axes][:2] == ["pi", "idm"]
    assert drive_result.plot("time-series").axes[0].get_ylabel() == "CAV's speed [m/s]"
    with pytest.raises(InputError, match="kind: 'waves' is not allowed; allowed: space-time, time-series"):
        drive_result.plot("waves")  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="plot: all episodes failed"):
        replace(drive_result, plot_episodes={}).plot()


@pytest.fixture
def detect_worker_start(monkeypatch: pytest.MonkeyPatch) -> Callable[[], bool]:
    """Detects whether a worker process was started."""
    from unjam.worlds import worker_pool

    detect_worker_start: list[object] = []
    start = worker_pool._Worker._start

    def noted(self: Any) -> Any:
        detect_worker_start.append(self)
        return start(self)

    monkeypatch.setattr(worker_pool._Worker, "_start", noted)
    return lambda: bool(detect_worker_start)


@pytest.mark.parametrize(
    "wrong",
    [
        {"scenario": "rong"},
        {"driver": "nonesuch"},
        {"driver": ["pi", "nonesuch"]},
        {"driver": "pi:speed=1"},
        {"driver": 3},
        {"driver": []},
        {"scenario_options": {"lenght": (120, 130)}},
        {"scenario_options": {"vehicles": 1}},
        {"reward": "gold"},
        {"reward": "nowhere.py:gold"},
        *({"episodes": wrong} for wrong in (0, 1.5, True, "x", None)),
        {"seed": -1},
        {"seed": "x"},
        {"scenario": 5},
        {"scenario_options": 5},
        {"seed": 999_999, "episodes": 2},
        {"seed": 3, "test_seeds": True},
        *({"workers": wrong} for wrong in (0, -1, 1.5, "x")),
    ],
    ids=str,
)
def test_wrong_arguments_are_refused_before_the_start(
    tmp_path: Path, detect_worker_start: Callable[[], bool], wrong: dict[str, Any]
) -> None:
    arguments = {
        "driver": "pi",
        "episodes": 1,
        "scenario_options": ROAD,
        "workers": 1,
        "out": tmp_path / "out",
        **wrong,
    }
    with pytest.raises(InputError) as caught:
        drive(**arguments)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()
    assert not detect_worker_start()


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_existing_files_are_not_changed(tmp_path: Path, detect_worker_start: Callable[[], bool], kind: str) -> None:
    mine = tmp_path / "out" / "mine.txt" if kind == "folder" else tmp_path / "out"
    mine.parent.mkdir(exist_ok=True)
    mine.write_text("keep")
    with pytest.raises(InputError, match="out' is not empty; allowed: a new folder"):
        drive("ring", "pi", 1, scenario_options=ROAD, out=tmp_path / "out")
    assert mine.read_text() == "keep"
    assert not detect_worker_start()


def test_fixture_detects_started_workers(detect_worker_start: Callable[[], bool]) -> None:
    assert not detect_worker_start()
    drive("ring", "idm", 1, scenario_options=ROAD, workers=1)
    assert detect_worker_start()


def test_drivers_with_equal_descriptions_are_both_run(my_drivers: Path) -> None:
    from unjam.controller import make_driver

    drivers = [make_driver(f"{my_drivers}:Keeper:gain={gain}", 0.1) for gain in (0.1, 0.2)]
    assert len(drive("ring", drivers, 1, scenario_options=ROAD, workers=1).rows) == 2


def test_a_set_speed_below_recorded_speeds_is_noted(tmp_path: Path) -> None:
    times = np.arange(0.0, 30.1, 0.1)
    pd.DataFrame({"time": times, "speed_ms": 30.0 + 4.7 * np.sin(times / 5.0)}).to_csv(tmp_path / "fast.csv")
    road, names = {"recordings": str(tmp_path), "window": 3.0}, ["human", "acc", "acc:set_speed=31", "acc:set_speed=36"]
    result = drive("recorded", names, 1, scenario_options=road, workers=1, backend="batch", out=tmp_path / "out")
    other = "is below the recorded 34.7 m/s: name another, as in acc:set_speed=45"
    expected = [f"acc: its set speed of 30 m/s {other}", f"acc:set_speed=31: its set speed of 31 m/s {other}"]
    assert [note for note in result.notes if "set speed" in note] == expected
    assert all(note in (tmp_path / "out" / "report.html").read_text() for note in expected)
    artificial = drive("recorded", "acc", 1, scenario_options={"horizon": 5}, workers=1, backend="batch")
    assert "set speed" not in str(artificial.notes)


def test_failed_drive_leaves_no_folder(tmp_path: Path, my_drivers: Path) -> None:
    road = {"horizon": 20}
    result = drive("ring", f"{my_drivers}:broken", 1, scenario_options=road, workers=1, out=tmp_path / "drive")
    assert (result.folder, result.report) == (None, None)
    assert not (tmp_path / "drive").exists()
