"""Folders of results that commands number themselves."""

import subprocess
import sys
from pathlib import Path

import pytest

from unjam.cli.options import new_folder


def test_processes_that_start_together_get_folders_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert [new_folder(None, "ring").name for _ in range(3)] == ["ring-001", "ring-002", "ring-003"]


def test_a_folder_that_stays_empty_is_removed_at_the_end(tmp_path: Path) -> None:
    code = (
        "from unjam.cli.options import new_folder\n"
        "new_folder(None, 'ring'); (new_folder(None, 'ring') / 'results.json').touch()"
    )
    subprocess.run([sys.executable, "-P", "-c", code], cwd=tmp_path, check=True)
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["ring-002"]


def test_a_folder_that_cannot_be_made_is_left_to_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    folder = new_folder(None, "x" * 300)
    assert len(folder.name) == 304
    assert not [*(tmp_path / "runs").iterdir()]
