import json
import shutil
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from importlib.metadata import version
from pathlib import Path

import pytest

import unjam
from unjam import manifest as module
from unjam.manifest import manifest
from unjam_paper.results_file import read_parts


def git(*arguments: str) -> subprocess.CompletedProcess[str]:
    here = Path(unjam.__file__).parent
    return subprocess.run(["git", *arguments], cwd=here, capture_output=True, text=True, check=False)


def test_the_manifest_names_versions_and_machine() -> None:
    made = manifest()
    assert made["unjam"] == unjam.__version__
    assert made["python"] == ".".join(map(str, sys.version_info[:3]))
    for package in ("libsumo", "eclipse-sumo", "torch", "numpy", "stable-baselines3", "sb3-contrib"):
        assert made["packages"][package] == version(package)
    assert made["machine"]["cores"] >= 1


def test_the_manifest_is_json() -> None:
    assert json.loads(json.dumps(manifest())).keys() == manifest().keys()


def test_the_manifest_has_the_current_time() -> None:
    age = datetime.now(UTC) - datetime.fromisoformat(manifest()["started"])
    assert timedelta(seconds=-2) < age < timedelta(minutes=1)


def test_the_manifest_names_the_command_without_its_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["/somewhere/bin/unjam", "train", "--set", "seed=3"])
    assert manifest()["command"] == ["unjam", "train", "--set", "seed=3"]


def test_a_package_that_is_missing_has_no_version(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "RECORDED_PACKAGES", ("numpy", "no-such-package-of-ours"))
    assert manifest()["packages"] == {"numpy": version("numpy"), "no-such-package-of-ours": None}


@pytest.mark.skipif(not shutil.which("git") or git("rev-parse").returncode != 0, reason="no checkout")
def test_the_manifest_names_the_commit_of_its_source() -> None:
    commit = manifest()["commit"]
    assert git("rev-parse", commit.removesuffix("+")).stdout == git("rev-parse", "HEAD").stdout


def test_outside_a_checkout_there_is_no_commit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "__file__", str(tmp_path / "manifest.py"))
    assert manifest()["commit"] is None


@pytest.mark.skipif(not shutil.which("git"), reason="no git")
def test_git_is_not_called_for_a_package_inside_another_repository(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The settings of a repository name programs that Git runs."""
    author = ["-c", "user.name=me", "-c", "user.email=me@here"]
    program, canary = tmp_path / "monitor", tmp_path / "canary"
    program.write_text(f"#!/bin/sh\ntouch {canary}\n")
    program.chmod(0o700)
    for arguments in (
        ["init"],
        [*author, "commit", "--allow-empty", "-m", "mine"],
        ["config", "core.fsmonitor", str(program)],
    ):
        subprocess.run(["git", *arguments], cwd=tmp_path, capture_output=True, check=True)
    package = tmp_path / ".venv" / "lib" / "site-packages" / "unjam"
    package.mkdir(parents=True)
    monkeypatch.setattr(module, "__file__", str(package / "manifest.py"))
    assert manifest()["commit"] is None
    assert not canary.exists()
    subprocess.run(["git", "status"], cwd=package, capture_output=True, check=True)
    assert canary.exists()  # Git itself, asked there, runs it


def test_without_git_there_is_no_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert manifest()["commit"] is None


RESULTS = Path(__file__).parents[1] / "results"
FILTERED = "2026-11-22T13:41"
"""since when CAVs have a safety filter"""
OF_RECORDED_PEOPLE = {"field/field", "field/ngsim-drivers"}
"""without a CAV"""


@pytest.mark.long
def test_no_result_with_cavs_is_older_than_the_safety_filter() -> None:
    older = set[str]()
    for path in RESULTS.glob("*.json"):
        for name, found in read_parts(path).items():
            about = found if isinstance(found, dict) else {}
            if (about.get("manifest") or about).get("started", FILTERED) < FILTERED:
                older.add(f"{path.stem}/{name}")
    assert {place for place in older if not place.startswith("research-notes/")} == OF_RECORDED_PEOPLE
