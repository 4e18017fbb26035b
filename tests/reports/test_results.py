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
from unjam.training.drive import DriveResult
from unjam.worlds.episode import run_episode

ROAD = {"length": (120, 120), "vehicles": 8, "horizon": 150}


@pytest.fixture(scope="module")
def drive_result(tmp_path_factory: pytest.TempPathFactory) -> DriveResult:
    folder = tmp_path_factory.mktemp("drive") / "results"
    return unjam.drive(driver=["human", "pi"], episodes=2, seed=3, scenario_options=ROAD, workers=1, out=folder)


@pytest.fixture
def folder(drive_result: DriveResult, tmp_path: Path) -> Path:
    """A copy that a test may modify."""
    assert drive_result.folder is not None
    return shutil.copytree(drive_result.folder, tmp_path / "results")


def test_rows_equal_those_that_drive_returned(drive_result: DriveResult, folder: Path) -> None:
    found = read_results(folder).rows
    assert list(found) == ["human", "pi"]
    for driver, rows in drive_result.rows.items():
        assert [row["seed"] for row in found[driver]] == [3, 4]
        for row, read in zip(rows, found[driver], strict=True):
            finite = [name for name in METRICS if np.isfinite(row[name])]
            assert {name: read[name] for name in finite} == {name: row[name] for name in finite}
            assert read["length"] == 120.0


def test_nan_is_stored_as_null(folder: Path) -> None:
    row = read_results(folder).rows["human"][0]
    assert np.isnan(row["time_to_dissolve"])  # an episode of 15 s has no calm minute
    assert "null" in (folder / "evaluation.json").read_text()


def test_plot_episode_has_the_first_seed(folder: Path) -> None:
    found = read_results(folder).plot_episodes
    for name, driver in (("human", Human()), ("pi", PISaturation())):
        plotted, episode = found[name], run_episode(Ring(**ROAD), driver, (3,))
        np.testing.assert_allclose(plotted.speeds, episode.speeds, atol=1e-5)
        np.testing.assert_allclose(plotted.positions, episode.positions, atol=1e-3)
        np.testing.assert_allclose(plotted.gaps, episode.gaps, atol=1e-3)
        np.testing.assert_allclose(plotted.outline, episode.outline, atol=1e-3)
        assert plotted.limit_speed == episode.limit_speed
        assert plotted.drawn_values == {"length": 120.0}


def test_plot_episode_has_times_and_cavs(folder: Path) -> None:
    plotted = read_results(folder).plot_episodes["pi"]
    np.testing.assert_allclose(plotted.times, np.linspace(0, 15, 151))
    assert plotted.cav_columns == [0]
    assert plotted.vehicle_ids[0] == "cav_0"


def test_metadata_has_scenario_and_reward(folder: Path) -> None:
    found = read_results(folder)
    assert (found.metadata["scenario"], found.metadata["reward"]) == ("ring", "released")
    assert found.trained_label is None
    assert found.progress == []
    assert found.config == ""


def test_a_missing_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere' has no evaluation\.json$"):
        read_results(tmp_path / "nowhere")


def test_an_unfinished_run_is_refused_with_the_command_to_resume(tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text("steps = 100\n")
    with pytest.raises(InputError, match="resume with: unjam train --resume"):
        read_results(tmp_path)


@pytest.mark.parametrize(
    "content",
    [
        "",
        '{"rows": [',
        "\x00\x01",
        "[]",
        "{}",
        '{"rows": 3, "plot_episodes": []}',
        '{"rows": [{}], "plot_episodes": []}',
    ],
)
def test_a_damaged_evaluation_is_refused_in_one_line(folder: Path, content: str) -> None:
    (folder / "evaluation.json").write_text(content)
    with pytest.raises(InputError, match="cannot be read") as caught:
        read_results(folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("keep", [0, 4, 100, -10])
def test_a_damaged_episode_file_is_refused_in_one_line(folder: Path, keep: int) -> None:
    path = folder / "plot_episodes.safetensors"
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(InputError, match=r"does not belong to evaluation\.json"):
        read_results(folder)


def test_a_missing_episode_file_is_refused_in_one_line(folder: Path) -> None:
    (folder / "plot_episodes.safetensors").unlink()
    with pytest.raises(InputError, match=r"has no plot_episodes\.safetensors"):
        read_results(folder)


def test_a_truncated_line_of_progress_is_skipped(tmp_path: Path) -> None:
    lines = [json.dumps({"iteration": number, "return_mean": 1.5}) for number in (1, 2, 3)]
    (tmp_path / "progress.jsonl").write_text("\n".join(lines)[:-9])
    assert [row["iteration"] for row in read_progress(tmp_path)] == [1, 2]


def test_only_damaged_lines_of_progress_are_skipped(tmp_path: Path) -> None:
    lines = [json.dumps({"iteration": number}).encode() for number in (1, 2, 3, 4, 5)]
    lines[1:4] = [b'{"iteration": 2', b"\xff\xfe", b"[4]"]
    (tmp_path / "progress.jsonl").write_bytes(b"\n".join(lines))
    assert [row["iteration"] for row in read_progress(tmp_path)] == [1, 5]


def test_missing_progress_has_no_rows(tmp_path: Path) -> None:
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
def test_original_command_can_be_pasted_into_a_shell(command: tuple[str, ...]) -> None:
    line = original_command(results_made_by(*command))
    printed = subprocess.run(["sh", "-c", f"printf '%s\\n' {line}"], capture_output=True, text=True, check=False)
    assert printed.stdout.splitlines() == list(command)


def test_original_command_of_a_resumed_training_is_the_first_with_the_last_budget(tmp_path: Path) -> None:
    first = ["unjam", "train", "ring", "--steps", "400", "--set", "trpo.gamma=0.99"]
    longer, last = (["unjam", "train", "--resume", "it", "--steps", "800"], ["unjam", "train", "--resume", "it"])
    metadata = {"trained": "trained", "manifest": {"command": last}}
    lineage = [{"command": longer}, {"command": last}]
    (tmp_path / "manifest.json").write_text(json.dumps({"command": first, "lineage": lineage}))
    found = original_command(Results(tmp_path, metadata, {}, {}))
    assert found == " ".join([*first, "--steps", "800"])
    (tmp_path / "manifest.json").write_text("{")
    assert original_command(Results(tmp_path, metadata, {}, {})) == " ".join(last)


def test_plain_words_of_the_original_command_are_not_quoted() -> None:
    command = ["unjam", "train", "ring", "--out", "runs/ring-001", "--set", "trpo.gamma=0.99"]
    assert original_command(results_made_by(*command)) == " ".join(command)
    assert original_command(results_made_by()) == ""


def test_entries_of_absent_vehicles_are_not_stored() -> None:
    merge = run_episode(make_scenario("merge", {"horizon": 40}), Human(), (0,), record_details=True)
    plotted = to_plot_episode("human", merge)
    packed = pack_episode(plotted)
    is_present = ~np.isnan(merge.speeds)
    assert packed["speeds"].shape == (is_present.sum(),)
    assert packed["poses"].shape == (is_present.sum(), 3)
    unpacked = unpack_episode(packed)
    for name in PLOT_ARRAYS:
        np.testing.assert_array_equal(unpacked[name], getattr(plotted, name).astype(np.float32))
    ring = to_plot_episode("human", run_episode(make_scenario("ring", {"horizon": 5}), Human(), (0,)))
    assert "is_present" not in pack_episode(ring)
