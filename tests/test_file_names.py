"""Names of files in a configuration, joined by +."""

from pathlib import Path

import pytest

from unjam.errors import InputError
from unjam.file_names import MAX_NAMES, split_names


def test_names_are_split_at_plus_but_not_within_paths_of_files(tmp_path: Path) -> None:
    (tmp_path / "a+b.py").touch()
    assert split_names("pi+a+b.py:x+acc:gain=1e+5", tmp_path) == ["pi", "a+b.py:x", "acc:gain=1e+5"]


def test_too_many_names_are_refused_at_once() -> None:
    assert len(split_names("+".join(["pi"] * MAX_NAMES))) == MAX_NAMES
    with pytest.raises(
        InputError, match=r"^names: '.{0,60}' and the names before it are not allowed; allowed: at most 100 names$"
    ):
        split_names("+".join(["pi"] * 100_000))
