"""`unjam runs` lists, compares and removes runs."""

import json
from pathlib import Path

import pytest

from tests.system.conftest import Run
from tests.training.test_runs import CONFIG, write_run


@pytest.fixture(autouse=True)
def runs(tmp_path: Path) -> None:
    write_run(tmp_path / "runs" / "ring-001", CONFIG, 1000, gain=7.0)
    write_run(tmp_path / "runs" / "ring-002", CONFIG, 400)


def test_runs_are_listed_compared_and_printed_as_csv(unjam: Run) -> None:
    lines = unjam("runs").stdout.splitlines()
    assert lines[1].split() == ["ring-001", "ring", "–", "finished", "1,000", "+7", "[+7,", "+7]"]
    assert "400 of 1,000" in lines[2]
    found = json.loads(unjam("runs", "--json", "--scenario", "ring").stdout)
    assert [run["state"] for run in found] == ["finished", "stopped"]
    compared = unjam("runs", "compare", "ring-001", "ring-002")
    assert "the settings of these runs are the same" in compared.stdout
    assert "unjam report runs/ring-001 runs/ring-002 --out compared.html" in compared.stderr
    assert unjam("runs", "progress", "ring-002").stdout.splitlines() == ["iteration,environment_steps", "1,400"]


def test_remove_asks_and_refuses_other_folders(unjam: Run, tmp_path: Path) -> None:
    unconfirmed = unjam("runs", "remove", "ring-001")
    assert (unconfirmed.returncode, unconfirmed.stdout) == (2, "")
    assert "allowed: --yes" in unconfirmed.stderr
    assert unjam("runs", "remove", "ring-001", "runs", "--yes").returncode == 2
    assert (tmp_path / "runs" / "ring-001").is_dir()
    elsewhere = unjam("runs", "--folder", "studies", "remove", "ring-001", "--yes")
    assert elsewhere.returncode == 2
    assert "allowed: after it, as in unjam runs remove --folder studies" in elsewhere.stderr
    assert (tmp_path / "runs" / "ring-001").is_dir()
    (tmp_path / "runs" / "ring-002" / "notes.txt").write_text("mine")
    kept = unjam("runs", "remove", "ring-002", "--yes")
    assert kept.stderr == "removed runs/ring-002, except files that unjam did not write: notes.txt\n"
    assert unjam("runs", "remove", "ring-001", "runs/ring-001", "--yes").returncode == 0
    assert not (tmp_path / "runs" / "ring-001").exists()
    assert [path.name for path in (tmp_path / "runs" / "ring-002").iterdir()] == ["notes.txt"]


def test_an_empty_list_suggests_a_training(unjam: Run) -> None:
    ran = unjam("runs", "--scenario", "merge")
    assert ran.returncode == 0
    assert "unjam train ring --preset demo" in ran.stderr
