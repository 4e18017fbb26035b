"""Our on-ramp as a network of a user's own, which has no map of where the ramp joins: who gains there?

Writes own-network.json. Each seed that judges gives its vehicles once; of them the share draws the CAVs.
"""

import shutil
import sys
import tempfile
from itertools import product
from pathlib import Path
from typing import Any

from unjam.controller import make_driver
from unjam.files import to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.metrics import measure
from unjam.scenarios import make_scenario
from unjam.scenarios.own_network import WITH_OWN_ACC
from unjam.training.seeds import held_out_seeds
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.files import files_of
from unjam.worlds.sumo.simulation import Simulation

SEEDS = 10
SHARES = (0.05, 0.1, 0.2)
DRIVERS = ("unjam:best", "cruise")


def network(seed: tuple[int, ...], folder: Path) -> Path:
    """Write the on-ramp of a seed as files of a user's, with people alone, and return its configuration."""
    scenario = make_scenario("on-ramp", {})
    files = files_of(scenario, scenario.of_seed(seed)[0])
    (net,) = files.named["--net-file"]
    shutil.copy(net, folder / "ramp.net.xml")
    people = [line for line in files.traffic.splitlines() if 'id="cav_of_' not in line]
    (folder / "ramp.rou.xml").write_text("\n".join(people))
    inputs = '<net-file value="ramp.net.xml"/><route-files value="ramp.rou.xml"/>'
    step = f'<step-length value="{scenario.simulation_step}"/><max-depart-delay value="-1"/>'
    path = folder / "ramp.sumocfg"
    path.write_text(f'<configuration>{inputs}<end value="{scenario.seconds:g}"/>{step}</configuration>')
    return path


def main() -> None:
    """Drive people alone, and each driver at each share, on the same vehicles."""
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as place, Simulation() as simulation:
        for seed in held_out_seeds(SEEDS):
            file = network(seed, Path(place))
            for share, name in [(1e-9, "human"), *product(SHARES, DRIVERS)]:
                changes = {"cav_share": share, "steps_per_decision": 2, **WITH_OWN_ACC}
                road = make_scenario(str(file), changes)
                driver = make_driver(name, road.decision_step)
                row = measure(run_episode(road, driver, seed, full=True, simulation=simulation))
                label = name if name == "human" else f"{name}, {100 * share:g} %"
                rows.append({"driver": label, **row})
                print(seed, label, round(row["travel_time"], 1), flush=True)
    target = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).with_name("own-network.json"))
    write_whole(target, to_json({"rows": rows, "manifest": manifest()}, indent=1))


if __name__ == "__main__":
    main()
