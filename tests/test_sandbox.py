"""What a process that reads files of others can still do."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.test_processes import soon
from tests.worlds.sumo.user_networks import straight
from unjam import sandbox
from unjam.drivers.user_driver import FileDriver
from unjam.processes import kernel_protections
from unjam.scenarios import Ring, make_scenario
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

kept = pytest.mark.skipif(len(kernel_protections()) < 2, reason="the kernel offers no Landlock or no seccomp")
TRIES = """
import os, socket, subprocess, sys
from pathlib import Path

canary, inside = Path(sys.argv[1]), Path(sys.argv[2])
tries = {
    "write": lambda: canary.write_text("changed"),
    "make": lambda: canary.with_name("made").touch(),
    "remove": canary.unlink,
    "move": lambda: canary.rename(canary.with_name("moved")),
    "link": lambda: os.link(canary, inside / "linked"),
    "by a child": lambda: subprocess.run(["cp", "/dev/null", canary], check=True, stderr=subprocess.DEVNULL),
    "TCP": lambda: socket.create_server(("", 0)),
    "UDP": lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM),
    "Unix": lambda: socket.socket(socket.AF_UNIX),
    "inside": (inside / "file").touch,
    "nowhere": lambda: Path(os.devnull).write_text("x"),
    "read": canary.read_text,
}
for name in sys.argv[3:] or tries:
    try:
        tries[name]()
        print(name)
    except (OSError, subprocess.CalledProcessError):
        pass
"""
DRIVER = """
import numpy as np, socket
from pathlib import Path

def tries(state):
    found = 0.0
    for act in (lambda: Path(__file__).with_name("left").touch(), socket.socket):
        try:
            act()
        except PermissionError:
            found += 0.25
    return np.full(len(state.speed), found)
"""


@kept
def test_a_confined_program_reads_and_writes_only_into_its_folder(tmp_path: Path) -> None:
    program, inside, canary = (tmp_path / name for name in ("tries.py", "inside", "canary"))
    program.write_text(TRIES)
    canary.write_text("as it was")
    inside.mkdir()
    command = [sys.executable, "-I", "-S", sandbox.__file__, str(2**30), "60", str(inside), str(program)]
    ran = subprocess.run([*command, str(canary), str(inside)], capture_output=True, text=True, check=True)
    assert ran.stdout.split() == ["inside", "nowhere", "read"]
    assert canary.read_text() == "as it was"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["canary", "inside", "tries.py"]


@pytest.mark.long
@kept
def test_a_worker_is_confined_only_for_user_networks(tmp_path: Path) -> None:
    (tmp_path / "driver.py").write_text(DRIVER)
    driver, left = FileDriver(tmp_path / "driver.py", "tries"), tmp_path / "left"
    path = straight(tmp_path, '<vehicle id="a" type="car" route="along" depart="0" departSpeed="5"/>')
    own = make_scenario(str(path), {"cav_types": ["car"], "horizon": 5})
    with WorkerPool(1) as workers:
        for scenario, found in ((own, 0.5), (own, 0.5), (Ring(horizon=5), 0.0)):
            (episode,) = workers.run([EpisodeTask(scenario, driver, (0,))])
            assert episode.has_run, episode.reason
            assert episode.trajectories[0].applied_acceleration[-1] == found
            assert left.exists() == (found == 0.0)


@pytest.mark.long
def test_user_networks_are_read_under_a_smaller_memory_limit(tmp_path: Path) -> None:
    path = straight(tmp_path, '<vehicle id="a" type="car" route="along" depart="0"/>')
    code = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_AS, (2**31, 2**31))\n"
        "from unjam.drivers import IDM\nfrom unjam.scenarios import make_scenario\n"
        "from unjam.worlds.worker_pool import EpisodeTask, WorkerPool\n"
        "own = make_scenario(sys.argv[1], {'cav_types': ['car'], 'horizon': 5})\n"
        "with WorkerPool(1) as workers:\n"
        "    print(workers.run([EpisodeTask(own, IDM(), (0,))])[0].status)\n"
    )
    ran = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=False)
    assert ran.stdout == "completed\n", ran.stderr


LIMITED = (
    "import os, sys, time\nfrom unjam import processes\nfrom unjam.errors import InputError\n"
    "processes.MAX_CHILD_MEMORY, processes.MAX_CHILD_TIME = 2**30, 1\n"
    "try:\n    processes.continue_in_limited_child('it')\nexcept InputError as error:\n    sys.exit(str(error))\n"
    "print(os.getpid(), flush=True)\n"
)
TOO_LONG = "it: cannot be read within 1 GiB and 1 s: signal "


@pytest.mark.parametrize(
    ("what", "code", "words"),
    [
        ("sys.exit(3)", 3, ""),
        ("pass", 0, ""),
        ("time.sleep(60)", 1, TOO_LONG),
        ("while True: pass", 1, TOO_LONG),
        ("bytes(2**31)", 1, "MemoryError"),
        ("os.abort()", 1, TOO_LONG),
    ],
)
def test_a_limited_child_that_fails_is_reported_in_one_line(what: str, code: int, words: str) -> None:
    ran = subprocess.run([sys.executable, "-c", LIMITED + what], capture_output=True, text=True, check=False)
    assert (ran.returncode, words in ran.stderr) == (code, True), ran.stderr
    if words == TOO_LONG:
        assert len(ran.stderr.splitlines()) == 1


def test_a_temporary_folder_of_a_library_is_removed_by_the_parent_of_a_limited_child(tmp_path: Path) -> None:
    """matplotlib makes one if it cannot write below HOME, and the child is not allowed to remove it."""
    environment = {**os.environ, "HOME": "/proc/none", "TMPDIR": str(tmp_path), "MPLCONFIGDIR": ""}
    code = "import matplotlib; matplotlib.get_cachedir()\n" + LIMITED
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment)
    assert (ran.returncode, ran.stdout != "") == (0, True)
    assert "temporary cache directory" in ran.stderr
    assert "Traceback" not in ran.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("signum", [signal.SIGTERM, signal.SIGKILL, signal.SIGINT])
def test_the_limited_child_ends_with_its_parent(signum: signal.Signals) -> None:
    code = LIMITED.replace("2**30, 1", "2**30, 60") + "time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        child = int(process.stdout.readline())
        process.send_signal(signum)
        assert soon(child)
