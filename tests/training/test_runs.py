import json
from dataclasses import replace
from pathlib import Path
from zipfile import ZipFile

import pytest
import tomli_w

import unjam
from unjam.errors import InputError
from unjam.files import append_line, to_json
from unjam.measures.metrics import METRICS
from unjam.processes import lock_folder
from unjam.reports.results import CONTROLLER_FILE, weights_id
from unjam.training.config import RunConfig, TaskConfig, load_config
from unjam.training.run_folder import create_run_folder
from unjam.training.runs import config_differences, read_run, remove_run


def write_run(folder: Path, config: RunConfig, done: int, gain: float | None = None) -> Path:
    """A run folder with so many steps, evaluated with such a gain."""
    create_run_folder(folder, config)
    append_line(folder / "progress.jsonl", to_json({"iteration": 1, "environment_steps": done}))
    if gain is not None:
        rows = [
            {"driver": driver, "seed": [1, seed], **dict.fromkeys(METRICS, 0.0), "return": mean_return + seed}
            for driver, mean_return in (("pi", 100.0), ("trained", 100.0 + gain))
            for seed in range(3)
        ]
        about = {"trained": "trained", "expert": "pi", "rows": rows}
        (folder / "evaluation.json").write_text(json.dumps(about))
    return folder


CONFIG = load_config(changes={"steps": 1000, "preset": ""})


@pytest.fixture
def under(tmp_path: Path) -> Path:
    write_run(tmp_path / "ring-001", CONFIG, 1000, gain=7.0)
    write_run(tmp_path / "deep" / "ring-002", replace(CONFIG, seed=3, scenario_options={"cavs": 2}), 400)
    write_run(tmp_path / "merge-001", replace(CONFIG, scenario="merge", expert="acc"), 0)
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "config.toml").write_text("mine = 1")
    return tmp_path


def test_runs_are_listed_with_state_and_steps(under: Path) -> None:
    with lock_folder(under / "merge-001"):
        found = {run.name: run for run in unjam.list_runs(under)}
    assert {name: (run.state, run.steps) for name, run in found.items()} == {
        "ring-001": ("finished", 1000),
        "deep/ring-002": ("stopped", 400),
        "merge-001": ("running", 0),
    }
    gain = found["ring-001"].gains[""]
    assert gain is not None
    assert gain.mean == pytest.approx(7.0)
    assert found["deep/ring-002"].gains == {"": None}
    assert [run.name for run in unjam.list_runs(under, "merge")] == ["merge-001"]


def test_an_evaluation_of_an_earlier_controller_does_not_count(under: Path) -> None:
    folder = under / "ring-001"
    older = None
    for content in ("older", "newer"):
        with ZipFile(folder / CONTROLLER_FILE, "w") as archive:
            archive.writestr("weights.safetensors", content)
        if content == "older":
            older = weights_id(folder / CONTROLLER_FILE)
    with ZipFile(folder / CONTROLLER_FILE, "a") as archive:
        archive.writestr("signature.json", "{}")  # of the maker, which changes the file
    about = json.loads((folder / "evaluation.json").read_text())
    for weights, state in ((weights_id(folder / CONTROLLER_FILE), "finished"), (older, "stopped")):
        (folder / "evaluation.json").write_text(json.dumps(about | {"weights": weights}))
        (found,) = (run for run in unjam.list_runs(under) if run.name == "ring-001")
        assert (found.state, found.gains[""] is None) == (state, state == "stopped")


@pytest.mark.parametrize("key", ["scenario", "tasks"])
def test_the_code_of_a_foreign_road_does_not_run_when_runs_are_listed_and_read(
    key: str, under: Path, caplog: pytest.LogCaptureFixture
) -> None:
    code, ran = under / "merge-001" / "road.py", under / "ran"
    code.write_text(f"open({str(ran)!r}, 'w').close()\nfrom unjam.scenarios import Ring\n")
    road = f"{code}:Ring"
    changes = {"tasks": [{"scenario": road}]} if key == "tasks" else {key: road}
    (under / "merge-001" / "config.toml").write_text(tomli_w.dumps(changes))
    assert [run.name for run in unjam.list_runs(under)] == ["deep/ring-002", "ring-001"]
    assert f"merge-001 is not listed: config file {under / 'merge-001'}" in caplog.text
    for read in (read_run, remove_run):
        with pytest.raises(InputError, match="names Python code"):
            read(under / "merge-001")
    assert not ran.exists()


def test_only_differing_settings_are_listed(under: Path) -> None:
    runs = [read_run(under / name) for name in ("ring-001", "deep/ring-002")]
    assert config_differences(runs) == {"seed": [0, 3], "scenario_options.cavs": [None, 2]}


def test_only_the_run_is_removed(under: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with lock_folder(under / "ring-001"), pytest.raises(InputError, match="written by another process"):
        remove_run(under / "ring-001")
    for other in (under / "notes", under):
        with pytest.raises(InputError):
            remove_run(other)
    (under / "link").symlink_to(under / "ring-001")
    with pytest.raises(InputError, match="is a link"):
        remove_run(under / "link")
    monkeypatch.chdir(under / "ring-001")
    with pytest.raises(InputError, match="has the working folder"):
        remove_run(Path("."))
    monkeypatch.chdir(under)
    assert remove_run(under / "ring-001") == []
    assert not (under / "ring-001").exists()
    assert (under / "notes" / "config.toml").is_file()


def test_files_of_the_user_in_a_run_are_not_removed(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    config = replace(CONFIG, tasks=(TaskConfig(name="first"), TaskConfig(name="second")))
    write_run(folder, config, 400)
    notes = [folder / "notes.txt", folder / "second" / "data" / "mine.csv"]
    parts = [folder / "first" / "report.html", folder / "checkpoint" / "a.safetensors", folder / ".a1.part"]
    for path in (*notes, *parts):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("")
    assert sorted(remove_run(folder)) == notes
    assert sorted(path for path in folder.rglob("*") if path.is_file()) == notes
    assert not (folder / "first").exists()


def test_missing_root_folder_is_refused() -> None:
    with pytest.raises(InputError, match="allowed: a folder with run folders"):
        unjam.list_runs("nowhere")


def test_damaged_run_is_listed_as_damaged(under: Path) -> None:
    file = under / "ring-001/evaluation.json"
    file.write_text(file.read_text()[:100])
    found = {run.name: run for run in unjam.list_runs(under)}
    assert {name: run.state for name, run in found.items()} == {
        "ring-001": "damaged",
        "deep/ring-002": "stopped",
        "merge-001": "stopped",
    }
    assert found["ring-001"].gains == {"": None}
