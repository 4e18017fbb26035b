"""Faults of whole commands: kills at random times, a clock that jumps, packed tables, and large inputs."""

import gzip
import io
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import psutil
import pytest

import unjam
from tests.faults.outcome import Outcome, one_line
from tests.faults.processes import UNJAM, start_unjam
from unjam.errors import InputError
from unjam.processes import is_locked, lock_folder
from unjam.recordings.loaders import read_trajectories
from unjam_paper.results_file import read_part

ROAD = ["--length", "60", "--vehicles", "5"]
TRIAL = {"length": "[60,60]", "vehicles": 5, "horizon": 40}
SEARCH = [*(f"scenario_options.{name}={value}" for name, value in TRIAL.items()), "trpo.steps_per_iteration=160"]
SEARCH += ["steps=160", "model.model_ratio=0", "evaluation.validation_episodes=1"]
SETTINGS = [word for setting in SEARCH for word in ("--set", setting)]
COMMANDS = {
    "tune": ["tune", "ring", *ROAD, "--set", "horizon=20", "--vary", "window=10,30", "--steps", "3000"],
    "search": ["search", "ring", *SETTINGS, "--workers", "1", "--vary", "trpo.target_kl=0.01,0.02", "--trials", "2"],
    "reproduce": ["reproduce", "small", "--seeds", "1"],
}
COMMANDS["tune"] += ["--expert", "pi", "--max-string-gain", "0"]
SMALL_STUDIES = """
import sys
import pytest
sys.path.insert(0, {root!r})
from tests.paper.conftest import add_small_study
from unjam.cli import main
add_small_study(pytest.MonkeyPatch())
main()
"""
"""a program that is the command line with the study `small`"""
PROGRAMS = {"reproduce": ("-c", SMALL_STUDIES.format(root=str(Path(__file__).parents[2])))}
RESULTS: dict[str, Callable[[Path], Any]] = {
    "tune": lambda out: (out / "pi.unjam").read_bytes(),
    "search": lambda out: (out / "best.toml").read_text(),
    "reproduce": lambda out: str([{**row, "seconds": 0.0} for row in read_part(out / "small.json", "table")]),
}
"""commands that write a folder, and what a repetition must write there again"""
DAY = 86_400.0
MAX_REFUSAL_SECONDS, MAX_REFUSAL_MEMORY = 20.0, 500.0
"""maximum processor time [s] and memory [MB] until a table that unpacks to gigabytes is refused"""


def killed_commands(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Kill commands (signal 9) at random times, and repeat them until they end."""
    outcome = Outcome()
    for name, words in COMMANDS.items():
        start = partial(start_unjam, folder, program=PROGRAMS.get(name, UNJAM))
        started = time.monotonic()
        assert start([*words, "--out", f"{name}-whole"]).wait() == 0, (folder / "words.txt").read_text()
        duration, whole = time.monotonic() - started, RESULTS[name](folder / f"{name}-whole")
        for number in range(list(COMMANDS).index(name), count, len(COMMANDS)):
            out = folder / f"{name}-{number}"
            process = start([*words, "--out", out.name])
            time.sleep(float(generator.uniform(0.0, duration)))
            process.kill()
            process.wait()
            for written in out.rglob("*.json"):
                json.loads(written.read_text())
            assert start([*words, "--out", out.name]).wait() == 0, (folder / "words.txt").read_text()
            assert RESULTS[name](out) == whole
            outcome.happened[f"{name}: no file was half-written, and a repetition had the same result"] += 1
    return outcome


def jumping_clocks(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Drive while the clock of the process jumps by up to a day with each look at it."""
    outcome, options = Outcome(), {"length": (60, 60), "vehicles": 5, "horizon": 50}

    def speed(seed: int, out: Path) -> float:
        return unjam.drive("ring", "pi", 1, seed, options, out=out, workers=1).rows["pi"][0]["mean_speed"]

    real = time.time
    for seed in range(count):
        out = folder / f"jumping-{seed}"
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(time, "time", lambda: real() + generator.uniform(-DAY, DAY))
            jumped = speed(seed, out)
            with lock_folder(out):
                assert is_locked(out)
        assert not is_locked(out)
        assert jumped == speed(seed, folder / f"steady-{seed}")
        outcome.happened["the episode was the same, and its folder was free again"] += 1
    return outcome


def packed_tables(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Read tables of recorded traffic of a few megabytes that unpack to gigabytes, or have a huge line or element."""
    outcome, process = Outcome(), psutil.Process()
    kinds = dict(zip(PACKED_TABLES, (write(generator) for write in PACKED_TABLES.values()), strict=True))
    for number in range(count):
        name = list(kinds)[number % len(kinds)]
        path = folder / f"table{name}"
        path.write_bytes(kinds[name])
        before, started = process.memory_info().rss, time.process_time()
        with pytest.raises(InputError) as caught:
            read_trajectories(path)
        assert one_line(caught.value)
        assert time.process_time() - started < MAX_REFUSAL_SECONDS
        assert process.memory_info().rss - before < MAX_REFUSAL_MEMORY * 1e6
        outcome.happened[f"{name}: refused in one line before it took memory"] += 1
    return outcome


def _packed_text(generator: np.random.Generator) -> bytes:
    head = gzip.compress(b"pair,time,speed,leader_speed,gap\n")
    return head + gzip.compress(b"1,0.1,3,4,10\n" * 10_000_000, 1) * int(generator.integers(9, 12))


def _packed_parquet(generator: np.random.Generator) -> bytes:
    content = io.BytesIO()
    columns = {f"column {number}": 1.0 for number in range(9)}
    pd.DataFrame(columns, index=range(15_000_000 + int(generator.integers(9)))).to_parquet(content, index=False)
    return content.getvalue()


PACKED_TABLES: dict[str, Callable[[np.random.Generator], bytes]] = {
    ".csv.gz": _packed_text,
    ".parquet": _packed_parquet,
    ".csv": lambda generator: b"pair,time\n" + b"1," * int(generator.integers(10**6, 10**7)),
    ".xml": lambda generator: b'<fcd-export><vehicle id="' + b"a" * int(generator.integers(10**7, 5 * 10**7)),
}


def many_drivers(count: int, folder: Path, generator: np.random.Generator) -> Outcome:
    """Compare so many drivers in one command."""
    outcome = Outcome()
    drivers = [f"pi:window={1 + number / 10:g}" for number in range(count)]
    found = unjam.drive("ring", drivers, 1, scenario_options={"horizon": 5}, workers=1)
    for driver in drivers:
        assert found.rows[driver][0]["status"] == "completed"
        outcome.happened["its episode ran"] += 1
    return outcome
