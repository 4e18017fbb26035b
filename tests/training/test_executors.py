"""Parallel command lines: in processes of this machine, and on a Ray cluster of two machines."""

import hashlib
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.training.test_run import small_config
from unjam.errors import MissingPartError, UnjamError
from unjam.reports.results import read_progress
from unjam.training import executors
from unjam.training.config import RunConfig
from unjam.training.executors import CommandLine, LocalExecutor, run_all, training_command

FAST = small_config(evaluation__validation_interval=0, evaluation__episodes=1, evaluation__baselines=[])


def command_of(folder: Path, config: RunConfig = FAST) -> CommandLine:
    return training_command(config, folder / "run", folder / "plan.toml", folder / "log")


def hash_of(folder: Path) -> str:
    return hashlib.sha256((folder / "run" / "controller.unjam").read_bytes()).hexdigest()


def test_failed_command_does_not_stop_the_others(tmp_path: Path) -> None:
    commands = {
        "bad": CommandLine(["fly"], tmp_path / "bad.log"),
        "good": CommandLine(["--version"], tmp_path / "logs" / "good.log"),
    }
    messages: list[str] = []
    with pytest.raises(UnjamError, match="1 of 2 failed: bad; first log: "):
        run_all(commands, 1, "local", messages.append)
    assert "unjam 0" in commands["good"].log.read_text()
    assert sorted(line.split(": ")[1] for line in messages) == ["bad failed", "good"]


def test_started_training_is_resumed(tmp_path: Path) -> None:
    command = command_of(tmp_path)
    assert command.argv()[4:6] == ["train", "--config"]
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.toml").touch()
    assert command.argv()[4:6] == ["train", "--resume"]


def test_killed_command_is_started_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import os, pathlib, sys\n"
        "file = pathlib.Path(sys.argv[1])\n"
        "file.write_text((file.read_text() if file.exists() else '') + 'x')\n"
        "if len(file.read_text()) < int(sys.argv[2]): os.kill(os.getpid(), 9)\n"
    )
    monkeypatch.setattr(CommandLine, "argv", lambda self: [sys.executable, str(script), *self.arguments])
    for times, code in ((2, 0), (3, 0), (9, -9)):
        counted = tmp_path / f"{times}"
        assert LocalExecutor().run(CommandLine([str(counted), str(times)], tmp_path / "log")) == code
        assert len(counted.read_text()) == min(times, executors.MAX_ATTEMPTS)


def test_stop_ends_running_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CommandLine, "argv", lambda self: [sys.executable, "-c", "import time; time.sleep(60)"])
    processes, codes = LocalExecutor(), []
    thread = threading.Thread(target=lambda: codes.append(processes.run(CommandLine([], tmp_path / "log"))))
    thread.start()
    while not processes._running:
        time.sleep(0.01)
    processes.stop()
    thread.join(timeout=10)
    assert codes == [-signal.SIGTERM]
    assert (tmp_path / "log").read_text().count("$ ") == 1


@pytest.mark.parametrize("is_starting", [True, False])
def test_stop_reaches_a_process_that_is_being_started(
    is_starting: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CommandLine, "argv", lambda self: [sys.executable, "-c", "import time; time.sleep(60)"])
    processes = LocalExecutor()
    stopping = threading.Thread(target=processes.stop)

    class SlowPopen(subprocess.Popen[bytes]):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            assert is_starting
            stopping.start()
            time.sleep(0.2)
            super().__init__(*arguments, **options)

    if not is_starting:
        processes.stop()
    monkeypatch.setattr(executors.subprocess, "Popen", SlowPopen)
    start = time.monotonic()
    assert processes.run(CommandLine([], tmp_path / "log")) == -signal.SIGTERM
    assert time.monotonic() - start < 30


def test_missing_ray_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingPartError, match=r"pip install 'unjam\[ray\]'"):
        run_all({"any": CommandLine(["--version"], tmp_path / "log")}, 1, "ray", print)


@pytest.mark.slow
def test_ray_imports_nothing_from_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray")
    monkeypatch.chdir(tmp_path)
    for planted in (tmp_path / "numpy.py", tmp_path / "unjam" / "__init__.py"):
        planted.parent.mkdir(exist_ok=True)
        planted.write_text(f"open({str(tmp_path / 'canary')!r}, 'w').close()\n")
    (tmp_path / "file").touch()
    run_all({"relative": command_of(Path("relative"))}, 1, "ray", print)
    assert (tmp_path / "relative" / "run" / "controller.unjam").is_file()
    with pytest.raises(UnjamError, match=r"^[^\n]*/file[^\n]*$"):
        run_all({"failing": CommandLine([], tmp_path / "file" / "log")}, 1, "ray", print)
    assert not (tmp_path / "canary").exists()


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A Ray cluster of two machines, which are processes here, with a core each."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    started = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    monkeypatch.setenv("RAY_ADDRESS", str(started.address))
    yield started
    started.shutdown()


@pytest.mark.slow
def test_cluster_gives_the_same_controllers_as_this_machine(tmp_path: Path, cluster: Any) -> None:
    cluster.add_node(num_cpus=1)
    names = ("one", "two")
    configs = [small_config(seed=seed, evaluation__baselines=[]) for seed in range(2)]
    hashes = []
    for executor in ("local", "ray"):
        commands = {
            name: command_of(tmp_path / executor / name, config) for name, config in zip(names, configs, strict=True)
        }
        run_all(commands, 2, executor, lambda line: None)
        hashes.append([hash_of(tmp_path / executor / name) for name in names])
    assert hashes[0] == hashes[1]
    assert hashes[0][0] != hashes[0][1]


@pytest.mark.slow
def test_training_on_a_lost_machine_resumes_elsewhere(tmp_path: Path, cluster: Any) -> None:

    lost = cluster.add_node(num_cpus=1)
    config = small_config(steps=6000, evaluation__validation_interval=0, evaluation__baselines=[])
    commands = {name: command_of(tmp_path / name, config) for name in ("one", "two")}
    failures: list[BaseException] = []

    def drive() -> None:
        try:
            run_all(commands, 2, "ray", lambda line: None)
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=drive)
    thread.start()
    wait_until(lambda: all(len(read_progress(tmp_path / name / "run")) >= 2 for name in commands))
    cluster.remove_node(lost, allow_graceful=False)
    thread.join(timeout=180)
    assert not thread.is_alive()
    assert failures == []
    for name in commands:
        assert read_progress(tmp_path / name / "run")[-1]["environment_steps"] == 6000
        assert (tmp_path / name / "run" / "report.html").is_file()
    started = [
        [line for line in (tmp_path / name / "log").read_text().splitlines() if line.startswith("$ ")]
        for name in commands
    ]
    assert sorted(sum("--resume" in line for line in lines) for lines in started) == [0, 1]


def wait_until(condition: Callable[[], bool], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)
