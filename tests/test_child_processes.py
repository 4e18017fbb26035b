"""Python children import nothing from the working folder, however they start."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from unjam.child_processes import PACKAGE_PARENT, child_environment, child_import_path, isolated_start, python_command

SHOW = "import json, os, sys; print(json.dumps([sys.path, os.environ['PYTHONPATH']]))"


@pytest.mark.parametrize("inherited", ["", ":", ".", "/somewhere:", ":/somewhere", "lib:./x:/somewhere:.."])
def test_a_child_and_its_children_search_no_relative_folder(
    inherited: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", inherited)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sitecustomize.py").write_text("raise SystemExit(9)")
    (tmp_path / "json.py").write_text("raise SystemExit(9)")
    for command in (python_command("-c", SHOW), [sys.executable, "-c", SHOW]):
        ran = subprocess.run(command, env=child_environment(), capture_output=True, text=True, check=True)
        path, kept = json.loads(ran.stdout)
        assert kept == ("/somewhere" if "somewhere" in inherited else "")
        assert not [each for each in path if not os.path.isabs(each) or str(tmp_path) in each]


def test_the_folder_of_unjam_itself_stays_on_the_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(Path(PACKAGE_PARENT).parent)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([Path(PACKAGE_PARENT).name, "."]))
    assert child_environment()["PYTHONPATH"] == PACKAGE_PARENT


def test_a_child_inherits_the_folders_that_the_program_added_to_its_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script, mine, here = tmp_path / "script", tmp_path / "mine", tmp_path / "here"
    packages = tmp_path / "site-packages"
    for folder in (script, mine, here, packages):
        folder.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.setattr(sys.modules["__main__"], "__file__", str(script / "program.py"), raising=False)
    monkeypatch.setattr(sys, "path", ["", "lib", str(script), str(mine), str(here), str(packages)])
    assert child_import_path() == [str(mine), str(packages)]


def test_processes_of_a_library_are_isolated_while_they_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", "relative")
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    before = sys.path[:]
    with isolated_start(["/only"]):
        assert (sys.path, os.environ["PYTHONSAFEPATH"], os.environ["PYTHONPATH"]) == (["/only"], "1", "")
    assert (sys.path, os.environ.get("PYTHONSAFEPATH"), os.environ["PYTHONPATH"]) == (before, None, "relative")
