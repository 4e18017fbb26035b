"""Limits of size and of rights: large networks, long environments, little memory, and users without a home."""

import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
import psutil

import unjam.environments  # noqa: F401  registers the environments
from tests.faults.outcome import Outcome
from tests.faults.processes import MAX_MEMORY_GROWTH, UNJAM
from tests.worlds.sumo.user_networks import straight
from unjam.drivers import IDM
from unjam.scenarios import make_scenario
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

HEADWAY = 20.0
"""distance between vehicles on a large network [m]"""
SMALL = ["--length", "60", "--vehicles", "5"]
TINY_TRAINING = ["scenario_options.horizon=100", "trpo.steps_per_iteration=100", "policy.hidden=[8]"]
TINY_TRAINING += ["evaluation.episodes=1", "evaluation.validation_episodes=1"]
COMMANDS = {
    "drive": ["drive", "ring", *SMALL, "--set", "horizon=20", "-d", "pi", "-n", "1"],
    "train": ["train", "ring", *SMALL, *(f"--set={setting}" for setting in TINY_TRAINING), "--steps", "200"],
}
MEMORY = 0.4e9, 2.0e9
"""least and largest address space of a command with little memory [bytes]; without a limit a training takes 1.2 GB"""
ABORTED = -signal.SIGABRT, 1
"""exit codes if a library (C++, OpenBLAS) ends the process without asking"""
NOBODY = 65_534
"""user and group without a home"""
SECONDS = 300


def large_networks(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Drive so many vehicles, a tenth of them CAVs, at once on a user network."""
    outcome = Outcome()
    vehicles = "".join(
        f'<vehicle id="v{number}" type="{"van" if number % 10 == 0 else "car"}" route="along" depart="0" '
        f'departPos="{HEADWAY * (number + 1)}" departSpeed="10"/>'
        for number in reversed(range(count))
    )
    path = straight(folder, vehicles, length=HEADWAY * (count + 500), end=30.0, step=0.5)
    road = make_scenario(str(path), {"cav_types": ["van"], "horizon": 40})
    with WorkerPool(1) as workers:
        (episode,) = workers.run([EpisodeTask(road, IDM(), (0,))])
    assert episode.has_run, episode.reason
    speeds = episode.speeds[-1][~np.isnan(episode.speeds[-1])]
    assert not episode.warnings, episode.warnings
    assert len(speeds) == count
    assert (speeds > 0).all()
    outcome.happened["the vehicle was on the road until the end"] += count
    return outcome


def long_environments(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Step one environment so often in one process."""
    outcome, process, first = Outcome(), psutil.Process(), 0
    environment = gymnasium.make("unjam/Ring-v0", length=(60, 60), vehicles=5, horizon=1000)
    ended = True
    for number in range(count):
        if ended:
            environment.reset(seed=number)
        observation, reward, terminated, truncated, _ = environment.step(generator.uniform(-1, 1, 1).astype(np.float32))
        assert np.isfinite(observation).all()
        assert np.isfinite(float(reward))
        ended = terminated or truncated
        if number == count // 10:
            first = process.memory_info().rss
    growth = (process.memory_info().rss - first) / 1e6
    assert growth <= MAX_MEMORY_GROWTH
    environment.close()
    outcome.happened["observation and reward were finite"] += count
    outcome.facts["memory growth [MB]"] = round(growth, 1)
    return outcome


def little_memory(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Run commands that may take less memory than they need, or slightly more."""
    outcome = Outcome()
    for number in range(count):
        name = list(COMMANDS)[number % len(COMMANDS)]
        limit = int(generator.uniform(*MEMORY))
        out = folder / f"{name}-{number}"
        code, error = run_command(
            [*COMMANDS[name], "--workers", "1", "--out", str(out)],
            folder,
            prepare=lambda limit=limit: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
        )
        assert code in (0, 2, 3, *ABORTED), error
        assert "Traceback" not in error, error
        if code == 0:
            outcome.happened[f"{name}: it was done"] += 1
            continue
        how = "a library aborted it" if code in ABORTED else "one line"
        repeated = [*COMMANDS[name], "--out", str(out)]
        if name == "train" and (out / "config.toml").exists():
            repeated = ["train", "--resume", str(out)]
        code, error = run_command([*repeated, "--workers", "1"], folder)
        assert code == 0, error
        outcome.happened[f"{name}: {how}; with enough memory it was done"] += 1
    return outcome


def other_users(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Run commands as a user without a home or rights, in a folder of its own; needs the rights to change users."""
    outcome = Outcome()
    with tempfile.TemporaryDirectory() as home:
        os.chmod(home, 0o755)
        for number in range(count):
            name = list(COMMANDS)[number % len(COMMANDS)]
            working_folder = Path(home) / str(number)
            working_folder.mkdir()
            os.chown(working_folder, NOBODY, NOBODY)
            command = [*COMMANDS[name], "--workers", "1", "--out", "out"]
            code, error = run_command(command, working_folder, user=NOBODY)
            assert code == 0, error
            assert (working_folder / "out" / "report.html").stat().st_uid == NOBODY
            shutil.rmtree(working_folder)
            outcome.happened[f"{name}: it was done, and wrote nothing elsewhere"] += 1
        assert not list(Path(home).iterdir())
    return outcome


def can_run_as_others() -> bool:
    """Return whether this process may start Python as a user without a home."""
    try:
        return subprocess.run([sys.executable, "-c", ""], user=NOBODY, check=False).returncode == 0
    except (OSError, ValueError):  # without the rights, where Python is not readable, or on Windows
        return False


def run_command(
    words: list[str], folder: Path, prepare: Callable[[], None] | None = None, user: int | None = None
) -> tuple[int, str]:
    """Run the command line, and return its exit code and its errors."""
    environment = os.environ | (
        {"HOME": "/nonexistent", "UNJAM_CACHE": str(folder / "cache")} if user is not None else {}
    )
    finished = subprocess.run(
        [sys.executable, *UNJAM, *words],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
        preexec_fn=prepare,
        user=user,
        group=user,
        extra_groups=[] if user is not None else None,
    )
    return finished.returncode, finished.stderr
