"""Faults of processes: lost workers, networks that crash SUMO, thousands of episodes, killed runs."""

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import psutil

from tests.faults.files import any_mutation
from tests.faults.outcome import Outcome, one_line
from tests.worlds.sumo.test_hostile_networks import OPTIONS, WRITING
from tests.worlds.sumo.user_networks import straight
from tests.worlds.test_record import fingerprint
from tests.worlds.test_worker_pool import processes
from unjam.drivers import IDM, PISaturation
from unjam.errors import InputError
from unjam.scenarios import Ring, make_scenario
from unjam.training.run_folder import load_checkpoint
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

UNJAM = "-m", "unjam"
"""arguments of Python that start the command line"""
MAX_MEMORY_GROWTH = 20.0
"""maximum growth of the memory of a process over any number of resets [MB]"""
SIGNALS = {signal.SIGKILL: 0.5, signal.SIGSEGV: 0.45, signal.SIGSTOP: 0.05}
"""signals by which a worker is lost, and their probabilities"""
WORKER_TIMEOUT = 5.0
"""time after which a stopped worker counts as hung [s]"""
ATTEMPTS = 6
"""maximum number of attempts of an episode; on a busy machine a new worker may take longer than the timeout"""
INVALID_NUMBERS = ("nan", "-1", "1e30", "inf", "", "0", "ghost", "1e-30")
DEMAND = (
    '<vehicle id="a" type="car" route="along" depart="0"/><trip id="b" type="car" depart="1" from="road" to="road"/>'
)


def resets(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Run episodes one after the other in one process, on rings of eleven lengths."""
    outcome, process, first = Outcome(), psutil.Process(), 0
    with Simulation() as simulation:
        for number in range(count):
            length = 220 + 5 * int(generator.integers(11))
            episode = run_episode(
                Ring(length=(length, length), horizon=2), IDM(), (number,), backend=SumoBackend(simulation)
            )
            assert episode.has_run
            outcome.happened["the episode ran"] += 1
            if number == count // 10:
                first = process.memory_info().rss
    growth = (process.memory_info().rss - first) / 1e6
    assert growth <= MAX_MEMORY_GROWTH
    outcome.facts["memory growth [MB]"] = round(growth, 1)
    return outcome


def lost_workers(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Kill, crash or stop workers during episodes."""
    outcome, road, slowest = Outcome(), Ring(horizon=8000), 0.0
    expected = fingerprint(run_episode(road, PISaturation(), (0,)))
    with WorkerPool(1, timeout=WORKER_TIMEOUT, max_attempts=ATTEMPTS) as workers:
        losses: dict[int, signal.Signals] = {}

        def lose_worker(task: int, steps: int) -> None:
            (worker,) = processes(workers)
            count_of_losses = min(2, count - outcome.injected)
            if len(losses) < count_of_losses and worker not in losses and 0 < steps < road.horizon:
                losses[worker] = list(SIGNALS)[generator.choice(len(SIGNALS), p=list(SIGNALS.values()))]
                os.kill(worker, losses[worker])

        while outcome.injected < count:
            losses.clear()
            started = time.monotonic()
            (episode,) = workers.run([EpisodeTask(road, PISaturation(), (0,))], lose_worker)
            slowest = max(slowest, time.monotonic() - started)
            assert episode.has_run, episode.reason
            assert fingerprint(episode) == expected
            for lost in losses.values():
                outcome.happened[f"{lost.name}: the episode was repeated to the same bytes"] += 1
    outcome.facts["longest episode with its repetitions [s]"] = round(slowest, 1)
    return outcome


def networks(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Damage a user network, its demand or its configuration, and drive on it."""
    outcome = Outcome()
    path = straight(folder, DEMAND, length=200.0)
    names = ("road.net.xml", "demand.rou.xml", "straight.sumocfg")
    originals = {name: (folder / name).read_bytes() for name in names}
    with WorkerPool(1, timeout=10.0, max_attempts=1) as workers:
        assert drive_network(path, workers) == DRIVEN
        for _ in range(count):
            for name, content in originals.items():
                (folder / name).write_bytes(content)
            name = str(generator.choice(names))
            (folder / name).write_bytes(break_xml(originals[name], generator))
            outcome.happened[drive_network(path, workers)] += 1
    return outcome


def hostile(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Drive with SUMO files that request writing, open ports, or reading of other files."""
    outcome, working_folder = Outcome(), folder / "here"
    working_folder.mkdir()
    path, canary = straight(working_folder, DEMAND, length=600.0), working_folder / "canary"
    canary.write_text("as it was")
    plain, elements = path.read_text(), re.findall(r"^  <.*/>$", WRITING, re.MULTILINE)
    with WorkerPool(1) as workers:
        for _ in range(count):
            option = f'<{generator.choice(OPTIONS)} value="{canary}"/>'
            option = str(generator.choice([option, '<remote-port value="45871"/>']))
            if generator.random() < 0.5:
                option = '<additional-files value="more.add.xml"/>'
                elements_text = "".join(generator.choice(elements, size=3, replace=False))
                content = f"<additional>{elements_text}</additional>".replace("CANARY", str(canary))
                (working_folder / "more.add.xml").write_text(content)
            path.write_text(plain.replace("</configuration>", f"{option}</configuration>"))
            before = {each.name: each.read_bytes() for each in working_folder.iterdir()}
            result = drive_network(path, workers)
            assert result in (DRIVEN, REFUSED)
            assert {each.name: each.read_bytes() for each in working_folder.iterdir()} == before
            for process in map(psutil.Process, [os.getpid(), *processes(workers)]):
                assert not any(net_connection.status == "LISTEN" for net_connection in process.net_connections())
            outcome_text = "it drove" if result == DRIVEN else "it was refused in one line"
            outcome.happened[f"{outcome_text}, nothing was written, and nothing listened"] += 1
    return outcome


DRIVEN = "driven: the damage does not matter"
REFUSED = "refused in one line before SUMO started"


def drive_network(path: Path, workers: WorkerPool) -> str:
    """Drive five control steps on a network, and return the outcome."""
    try:
        road = make_scenario(str(path), {"cav_types": ["car"], "horizon": 5})
    except InputError as error:
        one_line(error)
        return REFUSED
    (episode,) = workers.run([EpisodeTask(road, IDM(), (0,))])
    if episode.has_run:
        return DRIVEN
    assert "\n" not in episode.reason
    if "workers were lost" in episode.reason:
        return "SUMO crashed in the worker, which was replaced"
    return "refused in SUMO's words"


def break_xml(content: bytes, generator: np.random.Generator) -> bytes:
    """Return an XML file with changed bytes, or with one value, attribute or element changed."""
    kind = generator.choice(["bytes", "value", "value", "attribute", "element"])
    if kind == "bytes":
        return any_mutation(content, generator)
    text = content.decode()
    pattern = {"value": r'"[^"]*"', "attribute": r' [\w:]+="[^"]*"', "element": r"<[^>]*>"}[str(kind)]
    matches = list(re.finditer(pattern, text))
    place = matches[int(generator.integers(len(matches)))]
    replacement = f'"{generator.choice(INVALID_NUMBERS)}"' if kind == "value" else ""
    return (text[: place.start()] + replacement + text[place.end() :]).encode()


TINY = {
    "ring": ["ring", "--length", "60", "--vehicles", "5", "--set", "scenario_options.horizon=100"],
    "figure-eight": ["figure-eight", "--set", "scenario_options.horizon=100"],
    "merge": ["merge", "--set", "scenario_options.horizon=40", "--set", "scenario_options.penetration_rate=0.5"],
    "user-network": ["straight.sumocfg", "--cav-types", "car", "--set", "scenario_options.horizon=100"],
}
LEARNERS = ("trpo", "sac", "ppo")
SETTINGS = [
    *("evaluation.episodes=1", "evaluation.validation_episodes=1", "evaluation.validation_interval=2"),
    *("policy.hidden=[8]", "trpo.steps_per_iteration=100", "ppo.steps_per_iteration=100", "ppo.epochs=3"),
    *(
        "sac.steps_per_iteration=100",
        "sac.learning_starts=200",
        "sac.gradient_steps_per_step=0.05",
        "sac.batch_size=16",
    ),
]
ITERATIONS = 6


def killed_runs(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Kill training runs (signal 9) at random times, and resume them, on each road with one of the learners."""
    outcome = Outcome()
    straight(folder, '<flow id="f" type="car" route="along" begin="0" end="60" period="3"/>', length=300.0)
    pairs = [(road, LEARNERS[number % len(LEARNERS)]) for number, road in enumerate(TINY)]
    shares = np.diff(np.linspace(0, count, len(pairs) + 1).round().astype(int))
    for (road, agent), kills in zip(pairs, shares, strict=True):
        if kills == 0:
            continue
        words = f"{road}, {agent}: the run ended with the same hashes"
        command = ["train", *TINY[road], "--agent", agent, "--workers", "1"]
        command += [part for setting in SETTINGS for part in ("--set", setting)]
        steps = 100 * ITERATIONS if road != "merge" else 120 * ITERATIONS
        last = ["--steps", str(steps), "--json"]
        uninterrupted = start_unjam(folder, [*command, *last, "--out", f"{road}-whole"])
        assert uninterrupted.wait() == 0, (folder / "words.txt").read_text()
        run = folder / f"{road}-killed"
        start = [*command, *last, "--out", run.name]
        for _ in range(kills):
            kill_at_random_time(folder, start, run, generator)
            outcome.happened[words] += 1
            start = ["train", "--resume", run.name, "--json"] if (run / "config.toml").exists() else start
        process = start_unjam(folder, start)
        assert process.wait() == 0, (folder / "words.txt").read_text()
        assert result_hashes(run) == result_hashes(folder / f"{road}-whole")
    return outcome


def start_unjam(folder: Path, arguments: list[str], program: Sequence[str] = UNJAM) -> "subprocess.Popen[bytes]":
    """Start the command line, with its errors in a file."""
    command = [sys.executable, *program, *arguments]
    with (folder / "words.txt").open("wb") as words:
        return subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=words)


def kill_at_random_time(folder: Path, command: list[str], run: Path, generator: np.random.Generator) -> None:
    """Start a run, and kill it at a random time between its first rows and its end."""
    progress = run / "progress.jsonl"
    before = row_count(progress)
    process = start_unjam(folder, command)
    more_rows = int(generator.integers(0, 3))
    while process.poll() is None and row_count(progress) < min(before + more_rows, ITERATIONS - 1):
        time.sleep(0.02)
    time.sleep(float(generator.uniform(0.0, 1.0)))
    process.kill()
    process.wait()


def row_count(progress: Path) -> int:
    """Return the number of rows of progress that a run has written."""
    return progress.read_bytes().count(b"\n") if progress.exists() else 0


def result_hashes(run: Path) -> dict[str, str]:
    """Return the hashes of a run's parameters, of its metrics, and of its controller."""
    checkpoint = load_checkpoint(run / "checkpoint")
    assert checkpoint is not None
    parameters = b"".join(name.encode() + checkpoint[1][name].numpy().tobytes() for name in sorted(checkpoint[1]))
    progress_rows = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    metrics = json.dumps([{key: row[key] for key in row if key != "seconds"} for row in progress_rows])
    evaluation = json.dumps(json.loads((run / "evaluation.json").read_text())["rows"])
    parts = {
        "parameters": parameters,
        "metrics": metrics.encode(),
        "evaluation": evaluation.encode(),
        "controller": (run / "controller.unjam").read_bytes(),
    }
    return {name: hashlib.sha256(part).hexdigest() for name, part in parts.items()}
