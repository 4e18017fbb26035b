"""Output of commands in terminals with other encodings, and about files with hostile names."""

from pathlib import Path

import pytest

from tests.system.conftest import Run


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "ascii"])
def test_an_error_about_a_hostile_name_is_one_plain_line_in_every_encoding(
    unjam: Run, tmp_path: Path, encoding: str
) -> None:
    name = "road\x1b[31m\u202e–ü.toml"
    (tmp_path / name).write_text("length = ")
    ran = unjam("drive", name, environment={"PYTHONIOENCODING": encoding}, encoding=encoding)
    (line,) = ran.stderr.splitlines()
    assert ran.returncode == 2
    assert line.startswith("unjam: scenario file road?[31m?")
    assert line.isprintable()


@pytest.mark.parametrize("arguments", [("scenarios", "ring"), ("drivers",), ("drive", "--help")])
def test_commands_print_in_an_encoding_without_their_letters(unjam: Run, arguments: tuple[str, ...]) -> None:
    ran = unjam(*arguments, environment={"PYTHONIOENCODING": "ascii"})
    assert ran.returncode == 0
    assert ran.stdout.isascii()
    assert ran.stderr == ""
