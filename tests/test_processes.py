"""Locks of folders, and processes that end with their parent."""

import errno
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.training.test_run import small_config
from tests.worlds.test_worker_pool import has_ended
from unjam.errors import InputError
from unjam.folders import PROTECTED_FOLDERS_VARIABLE
from unjam.processes import (
    HEARTBEAT_INTERVAL,
    LOCK_FILE,
    MAX_MISSED_HEARTBEATS,
    PARENT_VARIABLE,
    PRIVATE_LOCK_FILE,
    PrivateFolder,
    bind_to_parent,
    check_not_locked,
    exit_with_parent,
    is_locked,
    lock_folder,
    remove_stale_private_folders,
)
from unjam.training.run_folder import create_run_folder
from unjam.training.train import train

linux = pytest.mark.skipif(sys.platform != "linux", reason="Linux notifies a process of the end of its parent")
HOLD = (
    "import sys\nfrom pathlib import Path\nfrom unjam.processes import lock_folder\n"
    "with lock_folder(Path(sys.argv[1])):\n    print('held', flush=True)\n    sys.stdin.read()\n"
)


def holder(folder: Path) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def soon(process: int) -> bool:
    patience = time.monotonic() + 15.0
    while not has_ended(process) and time.monotonic() < patience:
        time.sleep(0.05)
    return has_ended(process)


def test_a_folder_has_one_owner_and_is_unlocked_when_that_is_killed(tmp_path: Path) -> None:
    process = holder(tmp_path)
    words = "is being written by another process; allowed: one at a time"
    with pytest.raises(InputError, match=words), lock_folder(tmp_path):
        pass
    process.kill()
    process.wait()
    with lock_folder(tmp_path):
        assert (tmp_path / LOCK_FILE).is_file()
    assert list(tmp_path.iterdir()) == []


def test_an_owner_in_the_same_process_excludes_others_too(tmp_path: Path) -> None:
    with lock_folder(tmp_path), pytest.raises(InputError), lock_folder(tmp_path):
        pass
    with lock_folder(tmp_path):
        pass


def test_a_second_training_of_a_run_is_refused_in_one_line_and_writes_nothing(tmp_path: Path) -> None:
    create_run_folder(tmp_path, small_config())
    process = holder(tmp_path)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    with pytest.raises(InputError, match="another process") as caught:
        train(small_config(steps=900), tmp_path, resume=True)
    assert caught.value.exit_code == 2
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before
    process.communicate("")


def test_a_folder_with_only_leftovers_of_a_killed_owner_is_new(tmp_path: Path) -> None:
    for name in (LOCK_FILE, ".config.toml.part"):
        (tmp_path / name).touch()
    create_run_folder(tmp_path, small_config())
    assert (tmp_path / "config.toml").is_file()


CHILD = (
    "import os, signal, time\nfrom unjam.processes import exit_with_parent\n"
    "exit_with_parent(signal.SIGKILL)\nprint(os.getpid(), flush=True)\n"
    "while True:\n    pass\n"
)


@linux
def test_a_busy_process_ends_with_its_parent() -> None:
    code = (
        "import os, signal, subprocess, sys\nfrom unjam.processes import bind_to_parent\n"
        f"child = subprocess.Popen([sys.executable, '-c', {CHILD!r}], stdout=subprocess.PIPE, text=True,\n"
        "    env=bind_to_parent(os.environ))\n"
        "print(child.stdout.readline(), flush=True)\nos.kill(os.getpid(), signal.SIGKILL)\n"
    )
    parent = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert parent.returncode == -signal.SIGKILL
    assert soon(int(parent.stdout))


@linux
def test_a_process_ends_at_once_if_its_parent_has_already_ended() -> None:
    gone = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True)
    done = subprocess.run(
        [sys.executable, "-c", CHILD], env={**os.environ, PARENT_VARIABLE: gone.stdout.decode().strip()}, timeout=60
    )
    assert done.returncode == -signal.SIGKILL


@linux
def test_a_process_ends_at_once_if_its_parent_has_ended_without_being_waited_for() -> None:
    with subprocess.Popen([sys.executable, "-c", "print('done')"], stdout=subprocess.PIPE) as ended:
        assert ended.stdout is not None
        ended.stdout.read()
        while Path(f"/proc/{ended.pid}/stat").read_text().rpartition(") ")[2][0] != "Z":
            time.sleep(0.01)
        environment = {**os.environ, PARENT_VARIABLE: str(ended.pid)}
        done = subprocess.run([sys.executable, "-c", CHILD], env=environment, timeout=60)
    assert done.returncode == -signal.SIGKILL


def test_a_process_without_the_variable_is_not_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(PARENT_VARIABLE, raising=False)
    exit_with_parent(signal.SIGKILL)
    assert bind_to_parent({"A": "b"}) == {"A": "b", PARENT_VARIABLE: str(os.getpid()), PROTECTED_FOLDERS_VARIABLE: "[]"}


@pytest.mark.long
@linux
def test_a_training_ends_with_the_process_that_started_it(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys, threading, time\nfrom pathlib import Path\n"
        "from unjam.training.executors import CommandLine, LocalExecutor\n"
        "processes, folder = LocalExecutor(), Path(sys.argv[1])\n"
        "words = ['train', 'ring', '--steps', '100000000', '--workers', '1', '--out', str(folder / 'run')]\n"
        "command = CommandLine(words, folder / 'log')\n"
        "threading.Thread(target=processes.run, args=(command,), daemon=True).start()\n"
        "while not (folder / 'run' / 'config.toml').exists():\n    time.sleep(0.05)\n"
        "print(*(process.pid for process in processes._running), flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    parent = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=False, timeout=120
    )
    assert parent.returncode == -signal.SIGKILL
    assert soon(int(parent.stdout))


def test_checking_a_lock_neither_makes_nor_changes_it(tmp_path: Path) -> None:
    folder, lock, other = tmp_path / "run", tmp_path / "run" / LOCK_FILE, tmp_path / "other"
    folder.mkdir()
    assert not is_locked(folder)
    assert list(folder.iterdir()) == []
    process = holder(folder)
    before = lock.read_bytes(), lock.stat().st_mtime_ns
    assert is_locked(folder)
    with pytest.raises(InputError, match="is being written by another process"):
        check_not_locked(folder)
    assert (lock.read_bytes(), lock.stat().st_mtime_ns) == before
    process.kill()
    process.wait()
    assert not is_locked(folder)
    assert (lock.read_bytes(), lock.stat().st_mtime_ns) == before
    lock.rename(other)
    lock.symlink_to(other)
    assert not is_locked(folder)
    assert (other.read_bytes(), other.stat().st_mtime_ns) == before


@pytest.mark.parametrize("link", [Path.symlink_to, Path.hardlink_to])
def test_a_lock_that_is_a_link_is_refused_and_its_target_unchanged(
    link: Callable[[Path, Path], None], tmp_path: Path
) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "mine").write_text("mine")
    link(tmp_path / "run" / LOCK_FILE, tmp_path / "mine")
    with pytest.raises(InputError, match=r"\.lock' (is a symbolic link|has 2 names)"), lock_folder(tmp_path / "run"):
        pass
    assert (tmp_path / "mine").read_text() == "mine"


def test_an_owner_on_another_machine_locks_a_folder_while_it_sends_heartbeats(tmp_path: Path) -> None:
    (tmp_path / LOCK_FILE).write_text("elsewhere 12\n")  # a file system with locks that are local to the machine
    with pytest.raises(InputError, match="is being written on elsewhere; allowed: "), lock_folder(tmp_path):
        pass
    assert (tmp_path / LOCK_FILE).is_file()
    long_ago = time.time() - 2 * MAX_MISSED_HEARTBEATS * HEARTBEAT_INTERVAL
    os.utime(tmp_path / LOCK_FILE, (long_ago, long_ago))
    with lock_folder(tmp_path):
        assert (tmp_path / LOCK_FILE).read_text().split() == [platform.node(), str(os.getpid())]


def test_an_owner_sends_heartbeats(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("unjam.processes.HEARTBEAT_INTERVAL", 0.01)
    with lock_folder(tmp_path):
        os.utime(tmp_path / LOCK_FILE, (1, 1))
        patience = time.monotonic() + 5
        while (tmp_path / LOCK_FILE).stat().st_mtime == 1 and time.monotonic() < patience:
            time.sleep(0.01)
        assert (tmp_path / LOCK_FILE).stat().st_mtime > 1


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
def test_a_fork_that_ends_leaves_private_folders(tmp_path: Path) -> None:
    code = (
        "import os, sys\nfrom unjam.processes import PrivateFolder\nkept = PrivateFolder()\n"
        "with PrivateFolder() as folder:\n    child = os.fork()\n    if child == 0:\n        sys.exit()\n"
        "    os.waitpid(child, 0)\n    print(os.path.exists(folder), os.path.exists(kept.name))"
    )
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
    assert done.stdout == "True True\n"
    assert list(tmp_path.iterdir()) == []


def test_private_folders_of_killed_processes_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    code = (
        "import sys, tempfile\ntempfile.tempdir = sys.argv[1]\nfrom unjam.processes import PrivateFolder\n"
        "folder = PrivateFolder()\nprint(folder.name, flush=True)\nsys.stdin.read()\n"
    )
    started = [
        subprocess.Popen(
            [sys.executable, "-c", code, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        for _ in range(2)
    ]
    killed, alive = (Path(process.stdout.readline().strip()) for process in started if process.stdout)
    mine = tmp_path / "unjam-results"  # a folder with results of a user
    mine.mkdir()
    for name in (LOCK_FILE, PRIVATE_LOCK_FILE):
        (mine / name).touch()
    started[0].kill()
    started[0].wait()
    remove_stale_private_folders.__wrapped__()
    assert killed.exists()  # it may be so new that its process does not hold it yet
    for folder in (killed, alive, mine):
        os.utime(folder, (1, 1))
    remove_stale_private_folders.__wrapped__()
    assert (killed.exists(), alive.exists(), mine.exists()) == (False, True, True)
    started[1].communicate("")
    assert not alive.exists()


@pytest.fixture
def without_file_locks(monkeypatch: pytest.MonkeyPatch) -> None:
    fcntl = pytest.importorskip("fcntl")

    def refuse(*arguments: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)


@pytest.mark.usefixtures("without_file_locks")
def test_a_folder_on_a_file_system_without_locks_has_one_owner(tmp_path: Path) -> None:
    with lock_folder(tmp_path):
        assert is_locked(tmp_path)
        with pytest.raises(InputError, match="is being written by another process"), lock_folder(tmp_path):
            raise AssertionError
    assert not is_locked(tmp_path)
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    (tmp_path / LOCK_FILE).write_text(f"{platform.node()} {ended.pid}\n")
    assert not is_locked(tmp_path)
    with lock_folder(tmp_path):
        assert is_locked(tmp_path)


@pytest.mark.usefixtures("without_file_locks")
def test_private_folders_on_a_file_system_without_locks_are_not_removed_by_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with PrivateFolder() as name:
        os.utime(name, (1, 1))
        remove_stale_private_folders.__wrapped__()
        assert Path(name).exists()
    assert not Path(name).exists()
