import errno
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from unjam.errors import DiskError, InputError
from unjam.files import (
    append_line,
    atomic_write,
    is_leftover,
    make_folder,
    open_in_place,
    remove,
    to_json,
    write_new_file,
)
from unjam.folders import protect_folder
from unjam.processes import bind_to_parent, lock_folder


def test_text_and_bytes_replace_the_previous_content(tmp_path: Path) -> None:
    path = tmp_path / "file"
    atomic_write(path, "grün\n")
    assert path.read_bytes() == "grün\n".encode()
    atomic_write(path, b"\x00\xff")
    assert path.read_bytes() == b"\x00\xff"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO])
@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failed_write_keeps_the_previous_content(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, number: int
) -> None:
    path = tmp_path / "file"
    atomic_write(path, "old")

    def fail(*_: object, **options: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, step, fail)
    with pytest.raises(DiskError) as caught:
        atomic_write(path, "new")
    assert str(caught.value) == f"cannot write {path}: {os.strerror(number)}"
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit on the size of files")
def test_a_write_that_the_system_cuts_short_keeps_the_previous_content(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("old")
    program = f"""
import resource, signal
from pathlib import Path
from unjam.errors import DiskError
from unjam.files import atomic_write
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
try:
    atomic_write(Path({str(path)!r}), b"x" * 5000)
except DiskError as error:
    print(error)
"""
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert ran.stdout.strip() == f"cannot write {path}: {os.strerror(errno.EFBIG)}"
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_that_is_not_about_the_disk_is_unchanged(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        atomic_write(tmp_path / "nowhere" / "file", "new")


def test_appends_whole_lines(tmp_path: Path) -> None:
    path = tmp_path / "lines"
    append_line(path, "eins")
    append_line(path, "zwölf")
    assert path.read_text(encoding="utf-8") == "eins\nzwölf\n"


def test_appending_to_a_full_disk_is_a_disk_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(DiskError, match=f"cannot write {tmp_path}/lines: {os.strerror(errno.ENOSPC)}"):
        append_line(tmp_path / "lines", "more")


def test_makes_a_folder_and_its_parents_unless_it_exists(tmp_path: Path) -> None:
    for _ in range(2):
        make_folder(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()


@pytest.mark.parametrize("below", ["", "sub"])
def test_a_folder_where_a_file_is_in_the_way_is_a_disk_error(tmp_path: Path, below: str) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(DiskError, match="cannot write"):
        make_folder(tmp_path / "file" / below)
    assert (tmp_path / "file").read_text() == "mine"


Writer = Callable[[Path], object]
WRITERS: dict[str, Writer] = {
    "whole": lambda path: atomic_write(path, "new"),
    "new": lambda path: write_new_file(path, b"new", 0o600),
    "line": lambda path: append_line(path, "new"),
    "in place": lambda path: os.close(open_in_place(path, os.O_RDWR | os.O_CREAT)),
}


@pytest.fixture
def outside(tmp_path: Path) -> Iterator[Path]:
    """A folder with a user's file, which stays as it was."""
    folder = tmp_path / "outside"
    folder.mkdir()
    (folder / "file").write_text("mine")
    os.utime(folder / "file", (1, 1))
    os.utime(folder, (1, 1))
    yield folder
    assert [path.name for path in folder.iterdir()] == ["file"]
    assert (folder / "file").read_text() == "mine"
    assert (folder / "file").stat().st_mtime == folder.stat().st_mtime == 1


@pytest.mark.parametrize("target", ["file", "", "nothing"])
@pytest.mark.parametrize("how", WRITERS)
def test_nothing_is_written_through_a_link(how: str, target: str, outside: Path, tmp_path: Path) -> None:
    path = tmp_path / "name"
    path.symlink_to(outside / target)
    with pytest.raises(InputError, match=r"name' (is a symbolic link .*; allowed: |exists; allowed: )"):
        WRITERS[how](path)
    assert path.is_symlink()
    assert sorted(each.name for each in tmp_path.iterdir()) == ["name", "outside"]


@pytest.mark.parametrize("how", ["whole", "line", "in place"])
def test_a_hard_link_of_a_file_elsewhere_is_not_written_in_place(how: str, outside: Path, tmp_path: Path) -> None:
    path = tmp_path / "name"
    path.hardlink_to(outside / "file")
    if how == "whole":
        atomic_write(path, "new")
        assert path.read_text() == "new"
        return
    with pytest.raises(InputError, match=r"name' has 2 names \(hard links\), .*; allowed: a file with one"):
        WRITERS[how](path)


DEEP: dict[str, Writer] = {
    **{f"{name}, deep": (lambda path, write=write: write(path / "sub" / "file")) for name, write in WRITERS.items()},
    "make": lambda path: make_folder(path / "sub" / "it"),
    "remove": lambda path: remove(path / "sub" / "file"),
    "up": lambda path: atomic_write(path / ".." / "outside" / "file", "new"),
    "up by a new folder": lambda path: make_folder(path / "new" / ".." / ".." / "outside" / "new"),
}


@pytest.mark.parametrize("how", DEEP)
def test_inside_a_protected_folder_no_path_leads_out(how: str, outside: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "results").symlink_to("elsewhere")  # the user's own choice
    results = tmp_path / "results"
    with protect_folder(results):
        atomic_write(results / "file", "new")
        (results / "sub").symlink_to(outside)
        with pytest.raises(InputError, match="is a symbolic link or leads out of its folder"):
            DEEP[how](results)
    assert (tmp_path / "elsewhere" / "file").read_text() == "new"
    with pytest.raises(InputError, match=r"sub' is a symbolic link"), protect_folder(results):
        pass


def test_removing_folders_never_touches_the_targets_of_links(outside: Path, tmp_path: Path) -> None:
    make_folder(tmp_path / "it")
    (tmp_path / "it" / "sub").symlink_to(outside)
    remove(tmp_path / "it")
    remove(tmp_path / "it")
    (tmp_path / "link").symlink_to(outside)
    remove(tmp_path / "link")
    assert [path.name for path in tmp_path.iterdir()] == ["outside"]


def test_a_folder_is_not_made_in_place_of_a_broken_link(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("nowhere")
    with pytest.raises(InputError, match="link' is a symbolic link"):
        make_folder(tmp_path / "link")
    assert not (tmp_path / "nowhere").exists()


def test_a_child_process_follows_no_link_in_a_folder_that_its_parent_protects(outside: Path, tmp_path: Path) -> None:
    (tmp_path / "results" / "trials").mkdir(parents=True)
    code = (
        "import sys\nfrom pathlib import Path\nfrom unjam.errors import InputError\n"
        "from unjam.files import atomic_write\n"
        "try:\n    atomic_write(Path(sys.argv[1]), 'new')\nexcept InputError as error:\n    print(error)\n"
    )
    with lock_folder(tmp_path / "results"):
        (tmp_path / "results" / "trials" / "0").symlink_to(outside)
        ran = subprocess.run(
            [sys.executable, "-c", code, str(tmp_path / "results" / "trials" / "0" / "file")],
            **{"capture_output": True, "text": True, "check": True, "env": bind_to_parent(os.environ)},
        )
    assert "trials/0' is a symbolic link" in ran.stdout


@pytest.mark.parametrize("before", WRITERS)
def test_without_handles_of_folders_links_are_refused_as_well(
    before: str, outside: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "supports_dir_fd", set())  # as on Windows
    (tmp_path / "results").mkdir()
    make_folder(tmp_path / "results" / "it")
    (tmp_path / "results" / "it" / "file").write_text("new")
    WRITERS[before](tmp_path / "results" / "name")
    remove(tmp_path / "results" / "it")
    assert [path.name for path in (tmp_path / "results").iterdir()] == ["name"]
    with protect_folder(tmp_path / "results"):
        (tmp_path / "results" / "sub").symlink_to(outside)
        with pytest.raises(InputError, match="is a symbolic link"):
            WRITERS[before](tmp_path / "results" / "sub" / "file")


def test_the_leftover_of_a_killed_write_has_a_name_that_cannot_be_guessed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def die(*_: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", die)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            atomic_write(tmp_path / "file", "new")
    left = [path for path in tmp_path.iterdir() if is_leftover(path)]
    assert len({path.name for path in left}) == 2
    assert all(len(path.name) == len(".part") + 17 for path in left)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf"), np.float64("nan")])
def test_json_has_null_where_a_number_is_not_finite(value: float) -> None:
    assert to_json({"a": [value, 1.5, (value,)], "b": {"c": value}}) == '{"a": [null, 1.5, [null]], "b": {"c": null}}'


def test_numbers_and_arrays_of_other_packages_are_plain_json() -> None:
    values = {"a": np.int64(3), "b": np.float32(0.5), "c": torch.tensor(2.0), "d": np.array([1.0, np.nan])}
    assert to_json(values) == '{"a": 3, "b": 0.5, "c": 2.0, "d": [1.0, null]}'
    assert to_json([np.longdouble(1.5), np.array([np.nan], np.longdouble)]) == "[1.5, [null]]"


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    )
)
def test_json_preserves_every_finite_value(value: object) -> None:
    assert json.loads(to_json(value)) == value
    assert json.loads(to_json(value, indent=1)) == value


@pytest.mark.parametrize("rights", [0o600, 0o640, 0o666])
def test_a_file_that_is_written_again_keeps_its_rights(rights: int, tmp_path: Path) -> None:
    file = tmp_path / "controller.unjam"
    atomic_write(file, "before")
    file.chmod(rights)
    atomic_write(file, "after")
    assert (file.stat().st_mode & 0o777, file.read_text()) == (rights, "after")
