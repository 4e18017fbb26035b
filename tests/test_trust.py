"""Which code is trusted, and how this is reported."""

import itertools
import os
import subprocess
from pathlib import Path

import pytest

from unjam.child_processes import child_environment, python_command
from unjam.controller import controller_bytes
from unjam.controller import file as controller_file
from unjam.controller.file import pack_parts, read_controller, unpack_parts
from unjam.drivers.user_driver import FileDriver, FileReference
from unjam.errors import InputError
from unjam.files import sha256_of
from unjam.training.config import RunConfig, load_config, to_toml
from unjam.trust import (
    TRUSTED_VARIABLE,
    check_trusted,
    check_trusted_values,
    forget_expected_code,
    is_all_code_trusted,
    remember_trusted,
    trusting_code,
)
from unjam.user_code import UserCode, read_code


@pytest.fixture
def code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Code that no user has named."""
    monkeypatch.setenv("UNJAM_STATE", str(tmp_path / "state"))
    monkeypatch.delenv(TRUSTED_VARIABLE, raising=False)
    path = tmp_path / "code+1.py"
    path.write_text("x = 1\n")
    return path


@pytest.mark.parametrize(
    "text", ["{}:gentle", "{}:Keeper:gain=0.2", "pi+{}:gentle", "pi:window=30+{}:gentle", "{}:a+{}:b", "{}:a:b=[1,2]"]
)
@pytest.mark.parametrize("deep", [False, True])
def test_a_code_file_is_found_wherever_a_text_names_it(text: str, deep: bool, code: Path) -> None:
    named = text.replace("{}", str(code))
    values = {"tasks": [{"expert": "pi"}, {"evaluation": {"baselines": ["human", named]}}]}
    with pytest.raises(InputError, match=r"^run names Python code \('.*code\+1\.py'\), which "):
        check_trusted_values("run", values if deep else named)
    remember_trusted(code)
    check_trusted_values("run", values if deep else named)


@pytest.mark.parametrize(
    "name", ["none/../{}", "none/deep/../../{}", "./{}", "{}/../{}", "folder/{}", "x.py:/../{}", "x.py:/../link.txt"]
)
def test_code_is_found_by_every_name_that_leads_to_it(name: str, code: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(code.parent)
    Path("link.txt").symlink_to(code)
    Path("folder").symlink_to(code.parent)
    text = f"{name.replace('{}', code.name)}:x"
    assert FileReference.parse(text).load_object() == 1  # its user names it
    code.write_text("x = 2\n")
    with pytest.raises(InputError, match="it runs only with --trust-code"):
        check_trusted_values("run", text)


@pytest.mark.parametrize("name", ["later.py", "none/../later.py", "folder/later.py", "trusted.py/../later.py"])
def test_code_that_appears_after_the_check_does_not_run(name: str, code: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(code.parent)
    check_trusted_values("run", f"{name}:x")
    Path("folder").mkdir()
    for path in ("later.py", "folder/later.py"):
        Path(path).write_text("open('canary', 'w').close()\nx = 1\n")
    with pytest.raises(InputError, match=r"later\.py: has changed since the configuration was checked"):
        FileReference.parse(f"{name}:x").load_object()
    assert not Path("canary").exists()


@pytest.mark.parametrize("name", ["link.py", "link/code+1.py"])
def test_a_link_that_changes_after_the_check_is_not_followed(
    name: str, code: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(code.parent)
    remember_trusted(code)
    other = Path("other")
    other.mkdir()
    (other / code.name).write_text("x = 2\n")
    link = Path(name.partition("/")[0])
    link.symlink_to(code if link.suffix else code.parent)
    check_trusted_values("run", f"{name}:x")
    link.unlink()
    link.symlink_to(other / code.name if link.suffix else other)
    child = f"from unjam.drivers.user_driver import FileReference; print(FileReference.parse('{name}:x').load_object())"
    done = subprocess.run(
        python_command("-c", child), env=child_environment(), capture_output=True, text=True, check=False
    )
    assert (done.stdout, FileReference.parse(f"{name}:x").load_object()) == ("1\n", 1), done.stderr


def test_a_text_with_many_separators_is_refused_at_once(code: Path) -> None:
    text = f"{code}:x" + "+a:" * 5000
    with pytest.raises(InputError, match=r"^run: .* has too many parts; allowed: fewer \+ and :$"):
        check_trusted_values("run", text)


def test_a_relative_name_is_found(code: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(code.parent)
    with pytest.raises(InputError, match="it runs only with --trust-code"):
        check_trusted_values("run", f"{code.name}:gentle")


def test_a_link_to_trusted_code_is_trusted(code: Path) -> None:
    link = code.with_name("link.py")
    link.symlink_to(code)
    remember_trusted(code)
    check_trusted_values("run", f"{link}:gentle")


def test_trust_ends_with_the_block_and_its_code_is_remembered(code: Path) -> None:
    other = code.with_name("other.py")
    other.write_text("y = 2\n")
    with trusting_code():
        check_trusted("run", read_code(code))
        remember_trusted(code)
    check_trusted("run", read_code(code))
    with pytest.raises(InputError):
        check_trusted("run", read_code(other))
    assert TRUSTED_VARIABLE not in os.environ


def test_trust_ends_with_the_last_of_overlapping_blocks() -> None:
    """Blocks of two threads end in any order: the first to begin must not be the one that ends the trust."""
    first, second = trusting_code(), trusting_code()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert is_all_code_trusted()
    second.__exit__(None, None, None)
    assert not is_all_code_trusted()


def test_modules_that_code_imports_are_trusted_only_unchanged(code: Path) -> None:
    helper, file = code.with_name("helper_beside.py"), FileReference(code, "x")
    helper.write_text("value = 1\n")
    code.write_text("from helper_beside import value as x\n")
    assert file.load_object() == 1
    check_trusted("run", read_code(code))
    helper.write_text("value = 22\n")
    with pytest.raises(InputError, match="not run yourself in this version"):
        check_trusted("run", read_code(code))
    assert file.load_object() == 22  # naming it runs it
    check_trusted("run", read_code(code))
    helper.unlink()
    with pytest.raises(InputError):
        check_trusted("run", read_code(code))


def test_trust_that_cannot_be_stored_is_kept_for_this_process_and_its_children(
    code: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("UNJAM_STATE", str(code / "no folder"))
    remember_trusted(code)
    check_trusted("run", read_code(code))
    assert len(os.environ[TRUSTED_VARIABLE].split()) == 1
    code.write_text("x = 2\n")
    with pytest.raises(InputError):
        check_trusted("run", read_code(code))


def test_trust_is_stored_in_the_state_folder_of_the_system(
    code: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("UNJAM_STATE")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setenv("HOME", str(tmp_path))  # where the system does not ask XDG
    remember_trusted(code)
    check_trusted("run", read_code(code))
    assert [path.parent.name for path in tmp_path.rglob("trusted/*")] == ["trusted"]


LATE = "def late():\n    import helper_later\n    return helper_later.value\n"


@pytest.fixture
def folder_with_code(code: Path) -> Path:
    """Code that its user has run, with a module that it imports late, and a run folder that names it."""
    code.write_text(LATE)
    code.with_name("helper_later.py").write_text("value = 1\n")
    assert FileReference(code, "late").load_object()() == 1
    run = code.with_name("run")
    run.mkdir()
    (run / "config.toml").write_text(to_toml(RunConfig(expert=f"{code}:late")))
    return run


def test_modules_that_code_imports_late_are_trusted_only_unchanged(code: Path, folder_with_code: Path) -> None:
    check_trusted("run", read_code(code))
    code.with_name("helper_later.py").write_text("value = 2\n")
    with pytest.raises(InputError, match="not run yourself in this version"):
        load_config(folder_with_code / "config.toml")


@pytest.mark.parametrize("changed", ["code+1.py", "helper_later.py"])
def test_code_that_changes_after_it_was_checked_does_not_run(changed: str, code: Path, folder_with_code: Path) -> None:
    canary = code.with_name("canary")
    config = load_config(folder_with_code / "config.toml")
    file = code.with_name(changed)
    file.write_text(f"open({str(canary)!r}, 'w').close()\n{file.read_text()}")
    with pytest.raises(InputError, match=r"^code\+1\.py: has changed since the configuration was checked"):
        config.make_expert()
    child = 'from unjam.drivers.user_driver import FileReference; FileReference.parse(f"{PATH}:late").load_object()()'
    command = python_command("-c", f"PATH = {str(code)!r}; {child}")
    ran = subprocess.run(command, env=child_environment(), capture_output=True, text=True, check=False)
    assert "InputError: code+1.py: has changed since" in ran.stderr
    assert not canary.exists()
    with forget_expected_code():
        pass
    FileReference(code, "late").load_object()()  # its user names it again
    assert canary.exists()


def test_code_that_changes_after_a_controller_was_checked_does_not_run(
    code: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    helper, canary, run = code.with_name("helper_later.py"), code.with_name("canary"), code.with_name("run")
    code.write_text("def gentle(state):\n    import helper_later\n    return helper_later.value * state.speed\n")
    helper.write_text("value = 0.0\n")
    run.mkdir()
    (run / "controller.unjam").write_bytes(controller_bytes(FileDriver(code, "gentle"), {}))
    read_controller(run)

    def check(where: str, read: UserCode) -> None:
        check_trusted(where, read)
        helper.write_text(f"open({str(canary)!r}, 'w').close()\nvalue = 0.0\n")

    monkeypatch.setattr(controller_file, "check_trusted", check)
    with pytest.raises(InputError, match=r"code\+1\.py:gentle: its file has changed since"):
        read_controller(run)
    assert not canary.exists()


@pytest.mark.parametrize("at_first", ["nothing", "trusted code", "strange code"])
def test_code_of_a_controller_is_read_once_for_hash_and_trust(
    at_first: str, code: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file changes at every look, and the manifest has the hash of the strange code."""
    canary, run = code.with_name("canary"), code.with_name("run")
    trusted = b"def gentle(state):\n    return 0.0 * state.speed\n"
    strange = trusted + f"open({str(canary)!r}, 'w').close()\n".encode()
    code.write_bytes(trusted)
    remember_trusted(code)
    run.mkdir()
    file = run / "controller.unjam"
    file.write_bytes(controller_bytes(FileDriver(code, "gentle"), {}))
    hashes = sha256_of(trusted).encode(), sha256_of(strange).encode()
    file.write_bytes(pack_parts({name: part.replace(*hashes) for name, part in unpack_parts(file).items()}))
    contents, isfile, read_bytes = itertools.cycle([trusted, strange]), os.path.isfile, Path.read_bytes
    if at_first == "strange code":
        next(contents)
    elif at_first == "nothing":
        code.unlink()

    def is_file(path: str | Path) -> bool:
        found = isfile(path)
        code.touch()
        return found

    monkeypatch.setattr(os.path, "isfile", is_file)
    monkeypatch.setattr(Path, "read_bytes", lambda path: next(contents) if path == code else read_bytes(path))
    with pytest.raises(InputError, match=r"has changed since|is not a file|which you have not run yourself"):
        read_controller(run)
    assert not canary.exists()
