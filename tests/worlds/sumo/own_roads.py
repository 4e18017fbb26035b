"""Networks that nobody here made, and a plain one, for tests of the user's own network."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import sumo

from unjam.worlds.sumo.networks import sumo_program

SPARSE = '<flow id="f" type="own" route="along" begin="0" end="50" period="4" departSpeed="max"/>'
"""vehicles of the type `own`, for `network`"""
GAME = Path(sumo.SUMO_HOME) / "tools" / "game"


def game(folder: Path, name: str) -> Path:
    """A copy of one of SUMO's games: `ramp`, a highway with ramps, or `cross`, a signalled crossing."""
    shutil.copytree(GAME / name, folder / name, dirs_exist_ok=True)
    for file in (f"{name}.sumocfg", "input_additional.add.xml"):
        shutil.copy(GAME / file, folder)
    return folder / f"{name}.sumocfg"


def grid(folder: Path, kind: str = "traffic_light") -> Path:
    """A grid of netgenerate's with signals (or `priority`), and two minutes of randomTrips.py."""
    network, trips, path = folder / "grid.net.xml", folder / "grid.trips.xml", folder / "grid.sumocfg"
    generate = [sumo_program("netgenerate"), "--grid", "--grid.number", "3", "--grid.length", "120"]
    generate += ["--default-junction-type", kind, "--seed", "4", "-o", str(network)]
    trip = [sys.executable, str(Path(sumo.SUMO_HOME) / "tools" / "randomTrips.py"), "-n", str(network)]
    trip += ["-o", str(trips), "-e", "120", "-p", "1.5", "--seed", "4"]
    for command in (generate, trip):
        environment = {**os.environ, "SUMO_HOME": str(sumo.SUMO_HOME)}
        subprocess.run(command, check=True, capture_output=True, cwd=folder, env=environment)
    path.write_text(
        f'<configuration><net-file value="{network.name}"/><route-files value="{trips.name}"/>'
        '<end value="120"/><step-length value="0.5"/></configuration>'
    )
    return path


def straight(
    folder: Path, vehicles: str, length: float = 1000.0, end: float = 60.0, speed: float = 20.0
) -> Path:
    """One road with one lane and a limit of 20 m/s or another, and vehicles on the route `along`."""
    (folder / "nodes.xml").write_text(
        f'<nodes><node id="a" x="0" y="0"/><node id="b" x="{length}" y="0"/></nodes>'
    )
    (folder / "edges.xml").write_text(
        f'<edges><edge id="road" from="a" to="b" numLanes="1" speed="{speed}"/></edges>'
    )
    (folder / "demand.rou.xml").write_text(
        f'<routes><vType id="car" carFollowModel="IDM" speedDev="0" minGap="1.5"/>'
        f'<vType id="van" length="7" minGap="3" speedDev="0"/>'
        f'<route id="along" edges="road"/>{vehicles}</routes>'
    )
    command = [sumo_program("netconvert"), "-n", "nodes.xml", "-e", "edges.xml", "-o", "road.net.xml"]
    subprocess.run(command, check=True, capture_output=True, cwd=folder)
    path = folder / "straight.sumocfg"
    path.write_text(
        '<configuration><net-file value="road.net.xml"/><route-files value="demand.rou.xml"/>'
        f'<end value="{end}"/><step-length value="0.1"/></configuration>'
    )
    return path


def network(folder: Path, demand: str, more: str = "", options: str = "") -> str:
    """A straight road with vehicles on the route `along`, elements in an additional file, and options."""
    file = straight(folder, "", length=800.0)
    (folder / "demand.rou.xml").write_text(f'<routes><route id="along" edges="road"/>{demand}</routes>')
    (folder / "more.add.xml").write_text(f"<additional>{more}</additional>")
    text = file.read_text().replace("<end ", f'<additional-files value="more.add.xml"/>{options}<end ')
    file.write_text(text)
    return str(file)
