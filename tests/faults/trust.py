"""Attacks by files of others, and on what a run belongs to; and kills at every point of a run's life."""

import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import chdir
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, get_args

import numpy as np
import psutil
import pytest

from tests.conftest import unrun_driver
from tests.controller.test_file import residual
from tests.faults.outcome import Outcome, one_line
from tests.system.test_untrusted_code import COMMANDS
from tests.test_processes import holder
from tests.test_sandbox import TRIES
from tests.test_user_code import LATE, plant_bytecode
from tests.training.test_crash_points import Moment, content_of, crash, run
from tests.training.test_fingerprint import of_expert, of_network, of_reward, with_checkpoint
from tests.training.test_run import small_config
from tests.worlds.sumo.test_hostile_networks import OPTIONS
from tests.worlds.sumo.test_networks import edges_of
from tests.worlds.sumo.user_networks import straight
from tests.worlds.test_episode import insists
from tests.worlds.test_record import fingerprint as episode_fingerprint
from unjam import sandbox
from unjam.cli import app
from unjam.controller import controller_bytes
from unjam.controller.verify import verify_controller_file
from unjam.drivers import Driver, LocalState, PISaturation
from unjam.drivers.user_driver import FileReference
from unjam.drivers.wrappers import HistoryDriver, MixedDriver
from unjam.errors import EpisodeError, InputError
from unjam.processes import lock_folder
from unjam.scenarios import Ring, make_scenario
from unjam.training import run_folder
from unjam.training.fingerprint import fingerprint
from unjam.training.run_folder import create_run_folder, restore_newest_checkpoint
from unjam.trust import check_trusted_values, forget_expected_code, remember_trusted
from unjam.user_code import read_code
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo import networks
from unjam.worlds.sumo.backend import SumoBackend, sumo_inputs
from unjam.worlds.sumo.networks import network_file
from unjam.worlds.sumo.sandboxed import SandboxedSimulation
from unjam.worlds.sumo.simulation import Simulation

FORBIDDEN = ("write", "make", "remove", "move", "link", "by a child", "TCP", "UDP", "Unix")
"""forbidden actions that the program `TRIES` attempts"""
CARS = '<flow id="f" type="car" route="along" begin="0" end="60" period="3"/>'
GENTLE = "def gentle(state):\n    return 0.1 * (state.leader_speed - state.speed)\n"
ROADS = ("ring", "figure-eight", "merge", "on-ramp", "own")


def sandboxes(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Let programs in the sandbox write or open a socket: one next to the reader, and SUMO itself."""
    outcome, inside = Outcome(), folder / "inside"
    inside.mkdir()
    program, canary = folder / "tries.py", folder / "canary"
    program.write_text(TRIES)
    path = straight(folder, CARS)
    road = make_scenario(str(path), {"penetration_rate": 0.5, "horizon": 5})
    files = sumo_inputs(road, road.draw_from_seed((0,))[0])
    canary.write_text("as it was")
    limited = [sys.executable, "-I", "-S", sandbox.__file__, str(2**30), "60", str(inside), str(program)]
    before = sorted(path.name for path in folder.iterdir())
    with SandboxedSimulation() as sumo:
        for _ in range(count):
            if generator.random() < 0.5:
                expected = str(generator.choice(FORBIDDEN))
                ran = subprocess.run([*limited, str(canary), str(inside), expected], capture_output=True, check=True)
                assert ran.stdout == b"", expected
                words = f"a program in the sandbox: {expected}: refused by the kernel"
            else:
                expected = str(generator.choice([*OPTIONS, "remote-port"]))
                option = f"--{expected}={45871 if expected == 'remote-port' else canary}"
                try:
                    sumo.load(files._replace(options=(*files.options, option)), 0.1, 0)
                    sumo.step()
                except EpisodeError as error:
                    one_line(error)
                process = psutil.Process(sumo._process.pid)
                assert not any(net_connection.status == "LISTEN" for net_connection in process.net_connections())
                words = "SUMO with options to write or to listen: it did not"
            assert canary.read_text() == "as it was"
            assert sorted(path.name for path in folder.iterdir()) == before
            outcome.happened[words] += 1
    return outcome


def crash_points(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Kill a run or fill the disk before, during or after a write to its folder, and resume the run."""
    outcome = Outcome()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_folder, "manifest", lambda: {"started": "some day"})
        total = crash(folder / "wanted", 0, "before", False).count
        expected = content_of(folder / "wanted")
        points = list(product((True, False), get_args(Moment), range(1, total + 1)))
        order = generator.permutation(len(points))
        for number in np.resize(order, count):  # every point occurs once before a point is repeated
            kill, moment, at = points[number]
            place = folder / "run"
            crash(place, at, moment, kill)
            run(place)
            assert content_of(place) == expected, points[number]
            shutil.rmtree(place)
            how = "killed" if kill else "the disk was full"
            outcome.happened[f"{how} {MOMENT_LABELS.get(moment, moment)}: it went on to the same files"] += 1
    outcome.facts["points"] = len(points)
    return outcome


MOMENT_LABELS = {"half": "within"}


@dataclass(frozen=True)
class _Run:
    """A run folder with a checkpoint that is changed."""

    folder: Path
    place: Path


def _another_setting(at: _Run, generator: np.random.Generator) -> Any:
    with_checkpoint(at.folder, small_config())
    changes = [
        {"seed": 5},
        {"trpo__gamma": 0.5},
        {"scenario_options__vehicles": 9},
        {"expert": "idm"},
        {"agent": "ppo"},
    ]
    return small_config(**changes[int(generator.integers(len(changes)))])


def _another_file(at: _Run, generator: np.random.Generator) -> Any:
    makers = {of_expert: "mine.py", of_reward: "mine.py", of_network: "demand.rou.xml"}
    make = list(makers)[int(generator.integers(len(makers)))]
    config = make(at.place)
    with_checkpoint(at.folder, config)
    changed = at.place / makers[make]
    changed.write_text(changed.read_text() + " ")
    return config


def _anothers_checkpoint(at: _Run, generator: np.random.Generator) -> Any:
    other = at.place / "other"
    with_checkpoint(at.folder, small_config())
    with_checkpoint(other, small_config(seed=int(generator.integers(1, 100))))
    shutil.rmtree(at.folder / "checkpoint")
    shutil.copytree(other / "checkpoint", at.folder / "checkpoint")
    return small_config()


def _edited_checkpoint(at: _Run, generator: np.random.Generator) -> Any:
    with_checkpoint(at.folder, small_config())
    (checkpoint,) = (at.folder / "checkpoint").iterdir()
    content = checkpoint.read_bytes()
    assert b'seed\\": 0' in content
    checkpoint.write_bytes(content.replace(b'seed\\": 0', b'seed\\": 7'))
    return small_config(seed=7)


LINEAGES: dict[str, Callable[[_Run, np.random.Generator], Any]] = {
    "another setting": _another_setting,
    "another expert, reward or network": _another_file,
    "another run's checkpoint": _anothers_checkpoint,
    "an edited checkpoint": _edited_checkpoint,
}


def lineages(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Resume a run from the checkpoint of another run, or with another configuration."""
    outcome = Outcome()
    for number in range(count):
        at = _Run(folder / str(number) / "run", folder / str(number))
        at.place.mkdir()
        what = str(generator.choice(list(LINEAGES)))
        config = LINEAGES[what](at, generator)
        before = content_of(at.folder)
        with pytest.raises(InputError) as caught:
            restore_newest_checkpoint(at.folder, {at.folder}, fingerprint(config))
        one_line(caught.value)
        assert content_of(at.folder) == before
        outcome.happened[f"{what}: refused in one line, nothing changed"] += 1
        shutil.rmtree(at.place)
    return outcome


def locks(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Lock a folder that another process has locked, and again after that process was killed."""
    outcome = Outcome()
    for _ in range(count):
        process = holder(folder)
        with pytest.raises(InputError, match="is being written by another process") as caught, lock_folder(folder):
            pass
        one_line(caught.value)
        process.kill()
        process.wait()
        with lock_folder(folder):
            outcome.happened["refused in one line; free as soon as the owner was killed"] += 1
        assert list(folder.iterdir()) == []
    return outcome


def caches(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Edit, cut, empty or remove a network in the cache, and request it again."""
    outcome, road = Outcome(), Ring(length=(230, 230)).draw(np.random.default_rng(0)).network
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("UNJAM_CACHE", str(folder))
        made = network_file(road)
        whole, edges = made.read_bytes(), edges_of(made)
        for _ in range(count):
            at = int(generator.integers(len(whole)))
            kind = str(generator.choice(["edited", "cut", "empty", "gone"]))
            made.unlink()
            if kind != "gone":
                edited = whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :]
                made.write_bytes({"edited": edited, "cut": whole[:at], "empty": b""}[kind])
            networks._intact_networks.clear()  # as in a new process
            assert network_file(road) == made
            assert edges_of(made) == edges
            assert len(list(made.parent.iterdir())) == 1
            outcome.happened[f"{kind}: noticed, and made again"] += 1
    return outcome


def codes(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Read a run folder that names Python code in its controller and in its configuration, with each command."""
    outcome = Outcome()
    for number in range(count):
        place = folder / str(number)
        run, code, ran = place / "run", place / "run" / "code.py", place / "ran"
        create_run_folder(run, small_config(expert=f"{code}:gentle", scenario_options__horizon=20))
        (run / "best.toml").write_text((run / "config.toml").read_text())
        straight(place, CARS)
        code.write_text(f"{GENTLE}seen = gentle\n")
        user_driver = unrun_driver(code, f"open({str(ran)!r}, 'w').close()\n")
        driver, where = _nest_driver(user_driver, generator)
        (run / "controller.unjam").write_bytes(controller_bytes(driver, {}))
        before = sorted(place.rglob("*"))
        verb = list(READERS)[number % len(READERS)]
        with chdir(place), pytest.raises(InputError, match="Python code") as caught:
            READERS[verb]()
        one_line(caught.value)
        assert sorted(place.rglob("*")) == before
        outcome.happened[f"{where}: refused in one line, nothing ran"] += 1
        shutil.rmtree(place)
    return outcome


def _command(words: Sequence[str]) -> Callable[[], object]:
    return lambda: app(list(words), standalone_mode=False)


READERS: dict[str, Callable[[], object]] = {
    "verify": lambda: verify_controller_file("run"),
    "verify of the file": lambda: verify_controller_file("run/controller.unjam"),
    **{verb: _command(words) for verb, words in COMMANDS.items() if verb not in ("verify", "model")},
}
"""functions that read the folder, in this process; the commands `verify` and `model` start a child process"""


def _nest_driver(user_driver: Driver, generator: np.random.Generator) -> tuple[Driver, str]:
    """Return a driver that contains a driver of Python code, and a description of it."""
    choices: Sequence[tuple[Driver, str]] = (
        (user_driver, "a driver"),
        (residual(user_driver), "an expert"),
        (MixedDriver((PISaturation(), user_driver)), "one of several drivers"),
        (HistoryDriver(user_driver, 0.1), "a driver that another holds"),
    )
    return choices[int(generator.integers(len(choices)))]


def replacements(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Replace a user's file, or a module that it imports, or put bytecode next to it, at any time."""
    outcome = Outcome()
    for number in range(count):
        place = folder / str(number)
        (place / "package").mkdir(parents=True)
        main = place / "main.py"
        for name in ("neighbor", "later", "package/inner"):
            (place / f"{name}.py").write_text("value = 'good'\n")
        main.write_text(LATE)
        file = place / f"{generator.choice(['main', 'neighbor', 'later', 'package/inner'])}.py"
        changed_code = f"open({str(place / 'ran')!r}, 'w').close()\n{file.read_text()}"
        moment = str(generator.choice(["bytecode", "after it was read", "after it was checked"]))
        with forget_expected_code():
            if moment == "bytecode":
                plant_bytecode(file, str(generator.choice(["by time", "by an unchecked hash"])))
                late = FileReference(main, "late").load_object()
            elif moment == "after it was read":
                code = read_code(main)
                file.write_text(changed_code)
                late = code.run().late
            else:
                remember_trusted(main)
                check_trusted_values("run", f"{main}:late")
                file.write_text(changed_code)
                with pytest.raises(InputError, match="has changed since") as caught:
                    FileReference(main, "late").load_object()
                one_line(caught.value)
                late = None
        assert late is None or late() == ("good", "good", "good")
        assert not (place / "ran").exists()
        became = "refused in one line" if late is None else "what was hashed ran"
        outcome.happened[f"{moment}: {became}"] += 1
        shutil.rmtree(place)
    return outcome


def cheats(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Run a driver that modifies its read-only observations, on every kind of road."""
    outcome, own, expected_fingerprints = Outcome(), straight(folder, CARS, length=300.0), {}

    def unmodified_driver(state: LocalState) -> np.ndarray:
        return np.clip(0.5 * np.subtract(state.leader_speed, state.speed), -1, 1)

    with Simulation() as simulation:
        for number in range(count):
            name = ROADS[number % len(ROADS)]
            closed = name in ("ring", "figure-eight")
            share = {"cavs": 2, "warmup": 0} if closed else {"penetration_rate": 1.0}
            road = make_scenario(str(own) if name == "own" else name, {**share, "horizon": 30})
            seed = int(generator.integers(10))
            if (name, seed) not in expected_fingerprints:
                driven = run_episode(road, unmodified_driver, seed, backend=SumoBackend(simulation))
                expected_fingerprints[name, seed] = episode_fingerprint(driven)
            episode = run_episode(road, insists, seed, backend=SumoBackend(simulation))
            assert episode_fingerprint(episode) == expected_fingerprints[name, seed]
            outcome.happened[f"{name}: measured as if it had not"] += 1
    return outcome
