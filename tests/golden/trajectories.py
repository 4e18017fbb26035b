"""Golden trajectories: short episodes of every expert on every road, as they once were.

They differ where SUMO, a formula or a road has changed: numbers in the documentation then no longer hold.
"""

import hashlib
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tests.worlds.sumo.user_networks import straight
from unjam.drivers.registry import DRIVERS, driver_from_name
from unjam.road_family import IDEAL_VEHICLES
from unjam.scenarios import make_scenario
from unjam.scenarios.scenario import Scenario
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.networks import sumo_version
from unjam.worlds.sumo.simulation import Simulation

ROADS = {
    "ring": ("ring", {"horizon": 200, **IDEAL_VEHICLES}),
    "ring-warm": ("ring-warm", {"horizon": 100, "warmup": 300, **IDEAL_VEHICLES}),
    "figure-eight": ("figure-eight", {"horizon": 400, **IDEAL_VEHICLES}),
    "merge": ("merge", {"horizon": 60}),
    "on-ramp": ("on-ramp", {"horizon": 150, "peak": [0, 150], "penetration_rate": 0.3}),
    "user-network": ("", {"horizon": 250, "cav_types": ["van"]}),
}
ON_MOTORWAYS = ("cruise", "advisory-speed", "jam-ahead", "gap-maker", "adaptive-acc")
VANS = "".join(
    f'<vehicle id="{number}" type="{"car" if number % 3 else "van"}" route="along" '
    f'depart="{2 * number}" departSpeed="8"/>'
    for number in range(9)
)
ROW_INTERVAL = 25
"""control steps between two rows of a CSV"""
GRAIN = 1e-4
"""[m/s] and [m]: what is finer than this may differ from one processor to another"""
SEED = (20,)


def folder(version: str | None = None) -> Path:
    """Return where the golden trajectories of a version of SUMO are; of the installed one by default."""
    return Path(__file__).parent / (version or sumo_version())


def cases() -> list[tuple[str, str]]:
    """Return every road with every driver that may drive on it; those of motorways on the motorway alone."""
    closed = ("ring", "ring-warm", "figure-eight")
    found = [
        (road, driver)
        for road in (*closed, "merge", "user-network")
        for driver, kind in DRIVERS.items()
        if driver not in ON_MOTORWAYS and (road in closed or not kind.class_requirements.needs_loop)
    ]
    return [*found, *(("on-ramp", driver) for driver in ("human", "follower-stopper", *ON_MOTORWAYS))]


def scenario_of(road: str, network: Path) -> Scenario:
    """Return a road of the list, short; `network` is a folder for the user's own."""
    name, changes = ROADS[road]
    if not name:
        path = network / "straight.sumocfg"
        name = str(path if path.exists() else straight(network, VANS, length=600.0))
    return make_scenario(name, dict(changes))


def drive_all() -> Iterator[tuple[str, Episode]]:
    """Yield the name and the episode of each case."""
    with tempfile.TemporaryDirectory() as network, Simulation() as simulation:
        for road, driver in cases():
            scenario = scenario_of(road, Path(network))
            expert = driver_from_name(driver, scenario.control_step)
            yield f"{road}-{driver}", run_episode(scenario, expert, SEED, backend=SumoBackend(simulation))


def hash_of(episode: Episode) -> str:
    """Return the hash of all speeds and positions, rounded to `GRAIN`."""
    grains = [np.rint(np.nan_to_num(each, nan=-1e6) / GRAIN) for each in (episode.speeds, episode.positions)]
    content = b"".join(grain.astype("<i8").tobytes() for grain in grains)
    return hashlib.sha256(repr(episode.vehicle_ids).encode() + content).hexdigest()


def table_of(episode: Episode) -> str:
    """Return the speeds of all vehicles [m/s] now and then, as CSV; empty where one is not on the road."""
    lines = [",".join(["control_step", *episode.vehicle_ids])]
    for step in range(0, len(episode.speeds), ROW_INTERVAL):
        speeds = ("" if np.isnan(speed) else f"{speed:.4f}" for speed in episode.speeds[step])
        lines.append(",".join([str(step), *speeds]))
    return "\n".join(lines) + "\n"


def read_hashes(place: Path) -> dict[str, str]:
    """Return the golden hashes by case."""
    return json.loads((place / "hashes.json").read_text())


def fingerprint(hashes: dict[str, str]) -> str:
    """Return a short hash of all hashes: what a line of the changelog names."""
    return hashlib.sha256(json.dumps(hashes, sort_keys=True).encode()).hexdigest()[:12]
