import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from unjam.cli import diagnostics
from unjam.cli.diagnostics import REFERENCE_SUMO_VERSION, HealthCheck, check_health


@pytest.fixture(scope="module")
def health() -> list[HealthCheck]:
    return check_health()


@pytest.fixture(scope="module")
def checks(health: list[HealthCheck]) -> dict[str, HealthCheck]:
    return {check.name: check for check in health}


def test_all_required_parts_are_installed(health: list[HealthCheck]) -> None:
    assert [check.name for check in health if check.is_required and not check.is_ok] == []


def test_each_part_is_checked_once_and_an_episode_last(
    health: list[HealthCheck], checks: dict[str, HealthCheck]
) -> None:
    assert {"Python", "libsumo", "netconvert", "torch", "cache folder", "display"} <= checks.keys()
    assert len(checks) == len(health)
    assert health[-1].name == "an episode in a worker"


def test_checks_have_details(checks: dict[str, HealthCheck]) -> None:
    assert checks["libsumo"].detail.startswith("1.28")
    assert Path(checks["netconvert"].detail).is_file()
    assert checks["an episode in a worker"].detail == "100 steps of the ring"
    assert "GiB free" in checks["cache folder"].detail


def test_optional_parts_are_not_required(checks: dict[str, HealthCheck]) -> None:
    assert {name for name, check in checks.items() if not check.is_required} == {
        *("traci", "display", "mp4 video (imageio-ffmpeg)", "reading untrusted files"),
        "SUMO of the results",
        *("torch", "stable-baselines3", "sb3-contrib", "optuna", "cryptography"),
    }


def versions_in(value: object) -> Iterator[str]:
    """Yield the versions of libsumo in a results file."""
    if isinstance(value, dict):
        packages = value.get("packages")
        if isinstance(packages, dict) and "libsumo" in packages:
            yield packages["libsumo"]
        for part in value.values():
            yield from versions_in(part)


def test_the_results_were_measured_with_the_reference_version() -> None:
    results = Path(__file__).parents[2] / "results"
    found = [version for path in results.rglob("*.json") for version in versions_in(json.loads(path.read_text()))]
    assert len(found) > 10
    assert set(found) - {None} == {REFERENCE_SUMO_VERSION}  # None: measured on a GPU machine without SUMO


def test_another_sumo_than_that_of_the_results_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnostics, "version", lambda name: "1.28.1")
    check = diagnostics._reference_sumo_check()
    assert (check.is_ok, check.is_required, check.detail) == (False, False, "1.28.1")
    assert f"measured with SUMO {REFERENCE_SUMO_VERSION}" in check.remedy


def test_each_missing_part_has_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> str:
        raise diagnostics.PackageNotFoundError(name)

    monkeypatch.setattr(diagnostics, "version", missing)
    monkeypatch.delenv("DISPLAY", raising=False)
    checks = {check.name: check for check in check_health()}
    for name in ("libsumo", "eclipse-sumo", "torch", "stable-baselines3", "sb3-contrib", "mp4 video (imageio-ffmpeg)"):
        assert not checks[name].is_ok
        assert checks[name].detail == "not installed"
        assert "pip install" in checks[name].remedy
    assert not checks["display"].is_ok
    assert "--video" in checks["display"].remedy


def test_another_minor_version_of_sumo_is_not_ok(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnostics, "version", lambda name: "1.27.0")
    check = diagnostics._sumo_check("libsumo")
    assert not check.is_ok
    assert check.detail == "1.27.0"
    assert "libsumo==1.28.0" in check.remedy


def test_a_cache_that_cannot_be_made_has_a_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("UNJAM_CACHE", str(tmp_path / "file" / "cache"))
    check = diagnostics._cache_check()
    assert not check.is_ok
    assert str(tmp_path) in check.detail
    assert "UNJAM_CACHE" in check.remedy


def test_a_missing_cache_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UNJAM_CACHE", str(tmp_path / "new" / "cache"))
    assert diagnostics._cache_check().is_ok
    assert (tmp_path / "new" / "cache").is_dir()


def test_a_failed_episode_has_its_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("UNJAM_CACHE", str(tmp_path / "file" / "cache"))
    check = diagnostics._call_check("an episode in a worker", diagnostics._run_test_episode, "see the message")
    assert not check.is_ok
    assert str(tmp_path) in check.detail
    assert "\n" not in check.detail
