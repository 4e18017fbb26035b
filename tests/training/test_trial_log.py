"""Logs resume with equal requests and versions only."""

from pathlib import Path

import pytest

from unjam.errors import InputError
from unjam.training import trial_log
from unjam.training.trial_log import VERSIONED_PACKAGES, RowLog


@pytest.mark.parametrize("name", ["unjam", *VERSIONED_PACKAGES])
def test_rows_of_other_versions_are_not_continued(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def open_log() -> RowLog:
        return RowLog(tmp_path / "log", {"seed": 1}, "rows.jsonl")

    open_log().append({"score": 1.0})
    assert open_log().rows == [{"score": 1.0}]
    current = trial_log.manifest()
    (current if name == "unjam" else current["packages"])[name] = "0.0"
    monkeypatch.setattr(trial_log, "manifest", lambda: current)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=rf"made with other settings \(versions.{name}: '.+' there, '0.0' now\)"):
        open_log()
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_long_texts_that_differ_in_the_middle_are_shown_as_a_whole(tmp_path: Path) -> None:
    paths = [f"/home/project/{name}/networks/bottleneck.sumocfg" for name in ("spring", "autumn")]
    RowLog(tmp_path / "log", {"file": paths[0]}, "rows.jsonl")
    with pytest.raises(InputError, match=f"file: {paths[0]!r} there, {paths[1]!r} now"):
        RowLog(tmp_path / "log", {"file": paths[1]}, "rows.jsonl")
