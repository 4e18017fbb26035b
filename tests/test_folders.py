"""Folders of strangers: what may be in them."""

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.training.test_run import small_config
from unjam.errors import InputError
from unjam.folders import reject_unsafe_files
from unjam.training.run_folder import create_run_folder, read_config


def make_pipe(path: Path) -> None:
    os.mkfifo(path)


def make_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))


def make_link_to_pipe(path: Path) -> None:
    pipe = path.with_name("pipe")
    os.mkfifo(pipe)
    path.symlink_to(pipe)


@pytest.mark.parametrize("make", [make_pipe, make_socket, make_link_to_pipe])
@pytest.mark.parametrize("place", ["entry", "deep/er/entry"])
def test_special_files_are_refused_anywhere_in_a_folder(
    tmp_path: Path, make: Callable[[Path], None], place: str
) -> None:
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    make(tmp_path / place)
    with pytest.raises(InputError, match=r"(entry|pipe)' is a special file; allowed: regular files"):
        reject_unsafe_files(tmp_path)


def test_files_folders_and_links_to_them_are_accepted(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder/file").write_text("")
    for name, target in (("a", "folder"), ("b", "folder/file"), ("c", "nothing")):
        (tmp_path / name).symlink_to(target)
    reject_unsafe_files(tmp_path)


@pytest.mark.parametrize("target", ["secret", "folder", "nothing", "/dev/zero", "link"])
@pytest.mark.parametrize("name", ["config.toml", "deep/er/entry"])
def test_links_that_lead_out_of_a_folder_are_refused(name: str, target: str, tmp_path: Path) -> None:
    """A report shows what such a file holds."""
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "folder").mkdir()
    results = tmp_path / "results"
    (results / name).parent.mkdir(parents=True)
    (tmp_path / "link").symlink_to(results)
    reject_unsafe_files(tmp_path / "link")  # the user named it
    (tmp_path / "link").unlink()
    (tmp_path / "link").symlink_to("secret")
    (results / name).symlink_to(tmp_path / target)
    with pytest.raises(InputError, match=f"{name}' is a link out of its folder; allowed: the file itself"):
        reject_unsafe_files(results)


@pytest.mark.parametrize("name", ["progress.jsonl", "checkpoint/000001-0.safetensors"])
def test_a_run_with_a_pipe_is_refused_before_it_is_read(tmp_path: Path, name: str) -> None:
    run = tmp_path / "run"
    create_run_folder(run, small_config())
    (run / name).parent.mkdir(exist_ok=True)
    make_pipe(run / name)
    with pytest.raises(InputError, match="is a special file"):
        read_config(run)
