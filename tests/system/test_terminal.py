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


def test_messages_about_hostile_names_and_columns_are_plain_lines(unjam: Run, tmp_path: Path) -> None:
    """Those that the logs and the warnings of libraries show, too."""
    name = "run\x1b[31m\u202e\nunjam: done"
    (tmp_path / name).mkdir()
    (tmp_path / name / "config.toml").write_text("ghost = 1")
    (tmp_path / name / "manifest.json").write_text("{}")
    rows = "1,2,3,4,5\n" * 300_000
    (tmp_path / "mixed.csv").write_text(f"pair,time,speed,leader_speed,gap\x1b[31m\n{rows}x,x,x,x,x\n")
    for arguments in (("runs", "--folder", "."), ("fit-drivers", "mixed.csv")):
        ran = unjam(*arguments)
        assert ran.stderr.replace("\n", "").isprintable(), ran.stderr
        assert not any(line == "unjam: done" for line in ran.stderr.splitlines())
