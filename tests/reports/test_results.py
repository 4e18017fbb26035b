import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import unjam
from unjam.drivers import Human, PISaturation
from unjam.errors import InputError
from unjam.measures.metrics import METRICS
from unjam.reports.results import (
    PLOT_ARRAYS,
    Results,
    original_command,
    pack_episode,
    read_progress,
    read_results,
    to_plot_episode,
    unpack_episode,
)
from unjam.scenarios import Ring, make_scenario
from unjam.training.evaluate import DriveResult
from unjam.worlds.episode import run_episode

ROAD = {"length": (120, 120), "vehicles": 8, "horizon": 150}


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> DriveResult:
    folder = tmp_path_factory.mktemp("drive") / "results"
    return unjam.drive(driver=["human", "pi"], episodes=2, seed=3, scenario_options=ROAD, workers=1, out=folder)


@pytest.fixture
def folder(driven: DriveResult, tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    assert driven.folder is not None
    return shutil.copytree(driven.folder, tmp_path / "results")


def test_rows_are_those_that_drive_returned(driven: DriveResult, folder: Path) -> None:
    found = read_results(folder).rows
    assert list(found) == ["human", "pi"]
    for driver, rows in driven.rows.items():
        assert [row["seed"] for row in found[driver]] == [3, 4]
        for row, read in zip(rows, found[driver], strict=True):
            finite = [name for name in METRICS if np.isfinite(row[name])]
            assert {name: read[name] for name in finite} == {name: row[name] for name in finite}
            assert read["length"] == 120.0


def test_what_is_not_a_number_stays_so(folder: Path) -> None:
    row = read_results(folder).rows["human"][0]
    assert np.isnan(row["time_to_dissolve"])  # an episode of 15 s has no calm minute
    assert "null" in (folder / "evaluation.json").read_text()


def test_the_shown_episode_is_the_one_of_the_first_seed(folder: Path) -> None:
    found = read_results(folder).plot_episodes
    for name, driver in (("human", Human()), ("pi", PISaturation())):
        shown, episode = found[name], run_episode(Ring(**ROAD), driver, (3,))
        np.testing.assert_allclose(shown.speeds, episode.speeds, atol=1e-5)
        np.testing.assert_allclose(shown.positions, episode.positions, atol=1e-3)
        np.testing.assert_allclose(shown.gaps, episode.gaps, atol=1e-3)
        np.testing.assert_allclose(shown.outline, episode.outline, atol=1e-3)
        assert shown.limit_speed == episode.limit_speed
        assert shown.drawn_values == {"length": 120.0}


def test_the_shown_episode_knows_its_times_and_its_cavs(folder: Path) -> None:
    shown = read_results(folder).plot_episodes["pi"]
    np.testing.assert_allclose(shown.times, np.linspace(0, 15, 151))
    assert shown.cav_columns == [0]
    assert shown.vehicle_ids[0] == "cav_0"


def test_it_knows_what_it_is_about(folder: Path) -> None:
    found = read_results(folder)
    assert (found.metadata["scenario"], found.metadata["reward"]) == ("ring", "released")
    assert found.trained_label is None
    assert found.progress == []
    assert found.config == ""


def test_a_missing_folder_is_said_to_have_no_results(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere' has no evaluation\.json$"):
        read_results(tmp_path / "nowhere")


def test_an_unfinished_run_is_told_how_to_go_on(tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text("steps = 100\n")
    with pytest.raises(InputError, match="go on with: unjam train --resume"):
        read_results(tmp_path)


@pytest.mark.parametrize(
    "content", ["", '{"rows": [', "\x00\x01", "[]", "{}", '{"rows": 3, "shown": []}', '{"rows": [{}], "shown": []}']
)
def test_a_damaged_evaluation_gets_one_clear_line(folder: Path, content: str) -> None:
    (folder / "evaluation.json").write_text(content)
    with pytest.raises(InputError, match="cannot be read") as caught:
        read_results(folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("keep", [0, 4, 100, -10])
def test_a_damaged_picture_file_gets_one_clear_line(folder: Path, keep: int) -> None:
    path = folder / "shown.safetensors"
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(InputError, match="cannot be read"):
        read_results(folder)


def test_a_missing_picture_file_gets_one_clear_line(folder: Path) -> None:
    (folder / "shown.safetensors").unlink()
    with pytest.raises(InputError, match=r"has no shown\.safetensors"):
        read_results(folder)


def test_a_line_of_progress_cut_short_is_left_out(tmp_path: Path) -> None:
    lines = [json.dumps({"iteration": number, "return_mean": 1.5}) for number in (1, 2, 3)]
    (tmp_path / "progress.jsonl").write_text("\n".join(lines)[:-9])
    assert [row["iteration"] for row in read_progress(tmp_path)] == [1, 2]


def test_a_damaged_line_of_progress_drops_no_other(tmp_path: Path) -> None:
    lines = [json.dumps({"iteration": number}).encode() for number in (1, 2, 3, 4, 5)]
    lines[1:4] = [b'{"iteration": 2', b"\xff\xfe", b"[4]"]
    (tmp_path / "progress.jsonl").write_bytes(b"\n".join(lines))
    assert [row["iteration"] for row in read_progress(tmp_path)] == [1, 5]


def test_no_progress_is_no_rows(tmp_path: Path) -> None:
    assert read_progress(tmp_path) == []


def results_made_by(*command: str) -> Results:
    return Results(Path("x"), {"manifest": {"command": list(command)}}, {}, {})


@pytest.mark.parametrize(
    "command",
    [
        ("unjam", "drive", "ring", "--driver", "pi"),
        ("unjam", "drive", "--out", "my runs"),
        ("unjam", "drive", "--driver", "follower-stopper:gaps=[1,2,3]"),
        ("unjam", "drive", "--out", "Ann's runs"),
        ("unjam", "drive", "--out", "$HOME/`x`", "#1", "~", "a\\b", ""),
    ],
)
def test_the_command_to_repeat_can_be_pasted_into_a_shell(command: tuple[str, ...]) -> None:
    line = original_command(results_made_by(*command))
    told = subprocess.run(["sh", "-c", f"printf '%s\\n' {line}"], capture_output=True, text=True, check=False)
    assert told.stdout.splitlines() == list(command)


def test_a_training_that_went_on_is_repeated_by_its_first_command_with_its_last_budget(tmp_path: Path) -> None:
    first = ["unjam", "train", "ring", "--steps", "400", "--set", "trpo.gamma=0.99"]
    longer, again = (["unjam", "train", "--resume", "it", "--steps", "800"], ["unjam", "train", "--resume", "it"])
    about = {"trained": "trained", "manifest": {"command": again}}
    lineage = [{"command": longer}, {"command": again}]
    (tmp_path / "manifest.json").write_text(json.dumps({"command": first, "lineage": lineage}))
    found = original_command(Results(tmp_path, about, {}, {}))
    assert found == " ".join([*first, "--steps", "800"])
    (tmp_path / "manifest.json").write_text("{")
    assert original_command(Results(tmp_path, about, {}, {})) == " ".join(again)


def test_plain_words_of_the_command_are_left_as_they_are() -> None:
    command = ["unjam", "train", "ring", "--out", "runs/ring-001", "--set", "trpo.gamma=0.99"]
    assert original_command(results_made_by(*command)) == " ".join(command)
    assert original_command(results_made_by()) == ""


def test_where_vehicles_come_and_go_the_gaps_are_not_stored() -> None:
    merge = run_episode(make_scenario("merge", {"horizon": 40}), Human(), (0,), record_details=True)
    shown = to_plot_episode("human", merge)
    small = pack_episode(shown)
    there = ~np.isnan(merge.speeds)
    assert small["speeds"].shape == (there.sum(),)
    assert small["places"].shape == (there.sum(), 3)
    whole = unpack_episode(dict(small))
    for name in PLOT_ARRAYS:
        np.testing.assert_array_equal(whole[name], getattr(shown, name).astype(np.float32))
    ring = to_plot_episode("human", run_episode(make_scenario("ring", {"horizon": 5}), Human(), (0,)))
    assert "there" not in pack_episode(ring)
