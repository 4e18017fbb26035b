"""Compares the human baseline on networks of others with plain SUMO, trip by trip: see docs/own-network.md.

    python -m tests.networks results/networks.json NAME=FILE.sumocfg:SECONDS ...

Of each network so many seconds are simulated from its begin on, with the same seed. SUMO itself reads the
configuration here and writes what that asks for: use only files that you trust.
"""

import json
import os
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.etree import ElementTree

import numpy as np

from tests.worlds.sumo.test_plain_sumo import human_baseline
from unjam.files import atomic_write, to_json
from unjam.manifest import manifest
from unjam.sumo_files import read_sumo_files
from unjam.tree import pack, unpack
from unjam.worlds.record import Trips
from unjam.worlds.sumo.networks import sumo_program
from unjam.worlds.sumo.outputs import read_trips, trip_options
from unjam.worlds.sumo.simulation import Simulation

ONE = "--one"
ANY_CLASS: dict[str, str] = defaultdict(lambda: "passenger")


def run_measured(command: list[str], folder: Path) -> tuple[str, int, dict[str, float]]:
    """Return what a command prints, its exit code, its CPU time [s] and memory [MB], children included."""
    with (folder / "printed").open("w+") as printed:
        process = subprocess.Popen(command, stdout=printed, stderr=subprocess.STDOUT)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        printed.seek(0)
        cost = {"seconds": usage.ru_utime + usage.ru_stime, "megabytes": usage.ru_maxrss / 1024.0}
        return printed.read(), process.returncode, cost


def facts_of(trips: Trips) -> dict[str, float]:
    """Return the numbers of departures and arrivals, and the mean travel time [s]."""
    mean = float(trips.travel_time.mean()) if trips.vehicle_ids else float("nan")
    departed = int((trips.duration > 0).sum())
    return {"departures": departed, "arrivals": int(trips.has_arrived.sum()), "travel_time": mean}


def count_different(found: Trips, plain: Trips) -> int:
    """Return how many trips are not equal to the last digit, or are there in one of both alone."""
    rows: list[dict[str, tuple[float, ...]]] = []
    for each in (found, plain):
        times = np.stack([each.depart_delay, each.duration, each.time_loss], 1).tolist()
        rows.append(dict(zip(each.vehicle_ids, map(tuple, times), strict=True)))
    return sum(rows[0].get(name) != rows[1].get(name) for name in rows[0].keys() | rows[1].keys())


def count_teleports(statistics: Path) -> int:
    """Return the teleports of SUMO's statistic output: what it prints may be cut by a warning."""
    found = ElementTree.parse(statistics).getroot().find("teleports")
    assert found is not None
    return int(found.attrib["total"])


def drive_baseline(path: Path, seconds: float, out: Path) -> None:
    """Drive the human baseline and write its trips, the seed that SUMO had, and its teleports."""
    end = read_sumo_files(path).begin + seconds
    with Simulation() as simulation:
        episode, seed = human_baseline(path, simulation, end=end)
    trips, arrays = pack(episode.trips)
    lists = {name: array.tolist() for name, array in arrays.items()}
    facts = {"seed": seed, "teleports": episode.teleports, "status": episode.status}
    out.write_text(json.dumps({**facts, "trips": trips, "arrays": lists}))


def compare(path: Path, seconds: float) -> dict[str, Any]:
    """Return how the human baseline and plain SUMO differ on a network, and what each costs."""
    with TemporaryDirectory() as place:
        folder, ours, plain_file = Path(place), Path(place, "ours.json"), Path(place, "plain.xml")
        words = [sys.executable, "-m", "tests.networks", ONE, str(path), str(seconds), str(ours)]
        printed, code, cost = run_measured(words, folder)
        if code:
            return {"refused": printed.strip().splitlines()[-1].partition("Error: ")[2]}
        found = json.loads(ours.read_text())
        arrays = {name: np.array(values) for name, values in found["arrays"].items()}
        trips: Trips = unpack(Trips, found["trips"], arrays)
        end = read_sumo_files(path).begin + seconds
        command = [sumo_program("sumo"), "-c", str(path), "--seed", str(found["seed"]), "--end", str(end)]
        statistics = folder / "statistics.xml"
        command += [*trip_options(plain_file), "--no-step-log", "--statistic-output", str(statistics)]
        printed, code, plain_cost = run_measured(command, folder)
        if code:
            return {"refused": f"plain SUMO ends with code {code}: {printed.strip()[-300:]}"}
        plain = read_trips(plain_file, ANY_CLASS, 0.0)
        teleports = count_teleports(statistics)
    return {
        "human_baseline": {**facts_of(trips), "teleports": found["teleports"], **cost},
        "plain_sumo": {**facts_of(plain), "teleports": teleports, **plain_cost},
        "different_trips": count_different(trips, plain),
        "status": found["status"],
    }


def main(words: list[str]) -> None:
    """Compare all networks, and write what was found after each."""
    if words[0] == ONE:
        return drive_baseline(Path(words[1]).resolve(), float(words[2]), Path(words[3]))
    target, found, about = Path(words[0]), dict[str, Any](), manifest()
    del about["command"]  # it names folders of this machine
    for word in words[1:]:
        name, _, rest = word.partition("=")
        file, _, seconds = rest.rpartition(":")
        found[name] = {"seconds": float(seconds), **compare(Path(file).resolve(), float(seconds))}
        print(name, json.dumps(found[name]), flush=True)
        atomic_write(target, to_json({"manifest": about, "networks": found}, indent=1))
    return None


if __name__ == "__main__":
    main(sys.argv[1:])
