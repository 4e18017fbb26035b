import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from unjam.cli import machine
from unjam.cli.machine import RESULTS_SUMO, Check, check_health


@pytest.fixture(scope="module")
def found() -> list[Check]:
    return check_health()


@pytest.fixture(scope="module")
def checks(found: list[Check]) -> dict[str, Check]:
    return {check.name: check for check in found}


def test_all_that_is_needed_is_here(found: list[Check]) -> None:
    assert [check.name for check in found if check.needed and not check.ok] == []


def test_checks_each_thing_once_and_an_episode_last(found: list[Check], checks: dict[str, Check]) -> None:
    assert {"Python", "libsumo", "netconvert", "torch", "cache folder", "display"} <= checks.keys()
    assert len(checks) == len(found)
    assert found[-1].name == "an episode in a worker"


def test_says_what_was_found(checks: dict[str, Check]) -> None:
    assert checks["libsumo"].found.startswith("1.28")
    assert Path(checks["netconvert"].found).is_file()
    assert checks["an episode in a worker"].found == "100 steps of the ring"
    assert "GiB free" in checks["cache folder"].found


def test_what_can_be_missing_is_not_needed(checks: dict[str, Check]) -> None:
    assert {name for name, check in checks.items() if not check.needed} == {
        *("traci", "display", "mp4 video", "reading files of others"),
        "SUMO of the results",
        *("torch", "stable-baselines3", "sb3-contrib"),
    }


def versions_in(value: object) -> Iterator[str]:
    """The versions of libsumo that a results file names."""
    if isinstance(value, dict):
        packages = value.get("packages")
        if isinstance(packages, dict) and "libsumo" in packages:
            yield packages["libsumo"]
        for part in value.values():
            yield from versions_in(part)


def test_the_results_were_made_with_the_version_that_is_said() -> None:
    results = Path(__file__).parents[2] / "results"
    found = [
        version for path in results.rglob("*.json") for version in versions_in(json.loads(path.read_text()))
    ]
    assert len(found) > 10
    assert set(found) - {None} == {RESULTS_SUMO}  # None: a graphics card was measured where no SUMO is


def test_another_sumo_than_that_of_the_results_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "version", lambda name: "1.28.1")
    check = machine._sumo_of_results()
    assert (check.ok, check.needed, check.found) == (False, False, "1.28.1")
    assert f"made with SUMO {RESULTS_SUMO}" in check.remedy


def test_each_thing_that_can_be_missing_has_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> str:
        raise machine.PackageNotFoundError(name)

    monkeypatch.setattr(machine, "version", missing)
    monkeypatch.delenv("DISPLAY", raising=False)
    checks = {check.name: check for check in check_health()}
    for name in ("libsumo", "eclipse-sumo", "torch", "stable-baselines3", "sb3-contrib", "mp4 video"):
        assert not checks[name].ok
        assert checks[name].found == "not installed"
        assert "pip install" in checks[name].remedy
    assert not checks["display"].ok
    assert "--video" in checks["display"].remedy


def test_another_version_of_sumo_is_not_ok(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "version", lambda name: "1.27.0")
    check = machine._sumo_package("libsumo")
    assert not check.ok
    assert check.found == "1.27.0"
    assert "libsumo==1.28.0" in check.remedy


def test_a_cache_that_cannot_be_made_is_told_with_its_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("UNJAM_CACHE", str(tmp_path / "file" / "cache"))
    check = machine._cache()
    assert not check.ok
    assert str(tmp_path) in check.found
    assert "UNJAM_CACHE" in check.remedy


def test_a_cache_that_is_not_there_yet_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UNJAM_CACHE", str(tmp_path / "new" / "cache"))
    assert machine._cache().ok
    assert (tmp_path / "new" / "cache").is_dir()


def test_an_episode_that_fails_is_told_in_its_own_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("UNJAM_CACHE", str(tmp_path / "file" / "cache"))
    check = machine._try("an episode in a worker", machine._episode, "see the message")
    assert not check.ok
    assert str(tmp_path) in check.found
    assert "\n" not in check.found
