"""Compare the human baseline with plain SUMO on public networks, trip by trip (docs/own-network.md).

    python -m tests.networks results/networks.json NAME=FILE.sumocfg:SECONDS ...

For each network SECONDS are simulated from its begin on, with the same seed. SUMO reads the configuration and can write
the files that it names: use only files that you trust.
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

BASELINE_OPTION = "--one"
"""option with which this program drives the human baseline in a process of its own"""
ANY_CLASS: dict[str, str] = defaultdict(lambda: "passenger")


def run_measured(command: list[str], folder: Path) -> tuple[str, int, dict[str, float]]:
    """Run a command; return its output, exit code, CPU time [s] and memory [MB], including child processes."""
    with (folder / "output").open("w+") as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        output.seek(0)
        cost = {"seconds": usage.ru_utime + usage.ru_stime, "megabytes": usage.ru_maxrss / 1024.0}
        return output.read(), process.returncode, cost


def trip_summary(trips: Trips) -> dict[str, float]:
    """Return the numbers of departures and arrivals, and the mean travel time [s]."""
    mean = float(trips.travel_time.mean()) if trips.vehicle_ids else float("nan")
    departed = int((trips.duration > 0).sum())
    return {"departures": departed, "arrivals": int(trips.has_arrived.sum()), "travel_time": mean}


def count_different(baseline: Trips, plain: Trips) -> int:
    """Return the number of trips that differ in any digit, or that only one of both has."""
    rows: list[dict[str, tuple[float, ...]]] = []
    for trips in (baseline, plain):
        times = np.stack([trips.depart_delay, trips.duration, trips.time_loss], 1).tolist()
        rows.append(dict(zip(trips.vehicle_ids, map(tuple, times), strict=True)))
    vehicle_ids = rows[0].keys() | rows[1].keys()
    return sum(rows[0].get(vehicle_id) != rows[1].get(vehicle_id) for vehicle_id in vehicle_ids)


def count_teleports(statistics: Path) -> int:
    """Return the teleports in the statistic output of SUMO; warnings can interrupt the printed number."""
    element = ElementTree.parse(statistics).getroot().find("teleports")
    assert element is not None
    return int(element.attrib["total"])


def drive_baseline(path: Path, seconds: float, out: Path) -> None:
    """Drive the human baseline and write its trips, the seed of SUMO, teleports and status."""
    end = read_sumo_files(path).begin + seconds
    with Simulation() as simulation:
        episode, seed = human_baseline(path, simulation, end=end)
    trips, arrays = pack(episode.trips)
    lists = {name: array.tolist() for name, array in arrays.items()}
    facts = {"seed": seed, "teleports": episode.teleports, "status": episode.status}
    out.write_text(json.dumps({**facts, "trips": trips, "arrays": lists}))


def compare(path: Path, seconds: float) -> dict[str, Any]:
    """Return trips of the human baseline and of plain SUMO on a network, their differences, CPU time and memory."""
    with TemporaryDirectory() as parent:
        folder, baseline_file, plain_file = Path(parent), Path(parent, "baseline.json"), Path(parent, "plain.xml")
        command = [sys.executable, "-m", "tests.networks", BASELINE_OPTION, str(path), str(seconds), str(baseline_file)]
        output, code, cost = run_measured(command, folder)
        if code:
            return {"refused": output.strip().splitlines()[-1].partition("Error: ")[2]}
        baseline = json.loads(baseline_file.read_text())
        arrays = {name: np.array(values) for name, values in baseline["arrays"].items()}
        trips: Trips = unpack(Trips, baseline["trips"], arrays)
        end = read_sumo_files(path).begin + seconds
        command = [sumo_program("sumo"), "-c", str(path), "--seed", str(baseline["seed"]), "--end", str(end)]
        statistics = folder / "statistics.xml"
        command += [*trip_options(plain_file), "--no-step-log", "--statistic-output", str(statistics)]
        output, code, plain_cost = run_measured(command, folder)
        if code:
            return {"refused": f"plain SUMO ends with code {code}: {output.strip()[-300:]}"}
        plain = read_trips(plain_file, ANY_CLASS, 0.0)
        teleports = count_teleports(statistics)
    return {
        "human_baseline": {**trip_summary(trips), "teleports": baseline["teleports"], **cost},
        "plain_sumo": {**trip_summary(plain), "teleports": teleports, **plain_cost},
        "different_trips": count_different(trips, plain),
        "status": baseline["status"],
    }


def main(arguments: list[str]) -> None:
    """Compare all networks, and write the results after each network."""
    if arguments[0] == BASELINE_OPTION:
        return drive_baseline(Path(arguments[1]).resolve(), float(arguments[2]), Path(arguments[3]))
    target, results, metadata = Path(arguments[0]), dict[str, Any](), manifest()
    del metadata["command"]  # it contains folders of this machine
    for argument in arguments[1:]:
        name, _, value = argument.partition("=")
        file, _, seconds = value.rpartition(":")
        results[name] = {"seconds": float(seconds), **compare(Path(file).resolve(), float(seconds))}
        print(name, json.dumps(results[name]), flush=True)
        atomic_write(target, to_json({"manifest": metadata, "networks": results}, indent=1))
    return None


if __name__ == "__main__":
    main(sys.argv[1:])
