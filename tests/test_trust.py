"""Which code is trusted, and who is told."""

import os
from pathlib import Path

import pytest

from unjam.drivers.from_file import FileReference
from unjam.errors import InputError
from unjam.trust import TRUSTED, check_trusted, check_values, is_all_trusted, remember, trusting_code


@pytest.fixture
def code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Code that nobody has named."""
    monkeypatch.setenv("UNJAM_STATE", str(tmp_path / "state"))
    monkeypatch.delenv(TRUSTED, raising=False)
    path = tmp_path / "code+1.py"
    path.write_text("x = 1\n")
    return path


@pytest.mark.parametrize(
    "text",
    [
        "{}:gentle",
        "{}:Keeper:gain=0.2",
        "pi+{}:gentle",
        "pi:window=30+{}:gentle",
        "{}:a+{}:b",
        "{}:a:b=[1,2]",
    ],
)
@pytest.mark.parametrize("deep", [False, True])
def test_a_file_is_found_wherever_a_text_names_it(text: str, deep: bool, code: Path) -> None:
    named = text.replace("{}", str(code))
    values = {"tasks": [{"expert": "pi"}, {"evaluation": {"baselines": ["human", named]}}]}
    with pytest.raises(InputError, match=r"^run names Python code \('.*code\+1\.py'\), which "):
        check_values("run", values if deep else named)
    remember(code)
    check_values("run", values if deep else named)


def test_a_name_relative_to_here_is_found(code: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(code.parent)
    with pytest.raises(InputError, match="it runs only with --trust-code"):
        check_values("run", f"{code.name}:gentle")


def test_a_link_to_code_is_that_code(code: Path) -> None:
    link = code.with_name("link.py")
    link.symlink_to(code)
    remember(code)
    check_values("run", f"{link}:gentle")


def test_trust_ends_with_the_block_and_what_ran_in_it_is_remembered(code: Path) -> None:
    other = code.with_name("other.py")
    other.write_text("y = 2\n")
    with trusting_code():
        check_trusted("run", code)
        remember(code)
    check_trusted("run", code)
    with pytest.raises(InputError):
        check_trusted("run", other)
    assert TRUSTED not in os.environ


def test_trust_ends_with_the_last_of_the_blocks_that_overlap() -> None:
    """Blocks of two threads end in any order: the first to begin must not be the one that ends the trust."""
    first, second = trusting_code(), trusting_code()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert is_all_trusted()
    second.__exit__(None, None, None)
    assert not is_all_trusted()


def test_what_code_imports_from_beside_it_is_trusted_as_it_was(code: Path) -> None:
    helper, file = code.with_name("helper_beside.py"), FileReference(code, "x")
    helper.write_text("value = 1\n")
    code.write_text("from helper_beside import value as x\n")
    assert file.load() == 1
    check_trusted("run", code)
    helper.write_text("value = 22\n")
    with pytest.raises(InputError, match="not as it is now"):
        check_trusted("run", code)
    assert file.load() == 22  # whoever names it runs it
    check_trusted("run", code)
    helper.unlink()
    with pytest.raises(InputError):
        check_trusted("run", code)


def test_what_cannot_be_remembered_is_told_to_this_process_and_its_children(
    code: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("UNJAM_STATE", str(code / "no folder"))
    remember(code)
    check_trusted("run", code)
    assert len(os.environ[TRUSTED].split()) == 1
    code.write_text("x = 2\n")
    with pytest.raises(InputError):
        check_trusted("run", code)


def test_the_state_of_programs_is_where_the_system_has_it(
    code: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("UNJAM_STATE")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setenv("HOME", str(tmp_path))  # where the system does not ask XDG
    remember(code)
    check_trusted("run", code)
    assert [path.parent.name for path in tmp_path.rglob("trusted/*")] == ["trusted"]
