"""Networks from other sources, and a plain one, for tests of users' networks."""

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


def built(folder: Path, nodes: str, edges: str, routes: str, configuration: str, *options: str) -> Path:
    """A network of netconvert's with `options`, its routes and its configuration, all as inner XML."""
    files = {"nodes.xml": f"<nodes>{nodes}</nodes>", "edges.xml": f"<edges>{edges}</edges>"}
    files |= {"demand.rou.xml": f"<routes>{routes}</routes>"}
    inputs = '<net-file value="road.net.xml"/><route-files value="demand.rou.xml"/>'
    files |= {"my.sumocfg": f"<configuration>{inputs}{configuration}</configuration>"}
    for name, content in files.items():
        (folder / name).write_text(content)
    command = [sumo_program("netconvert"), "-n", "nodes.xml", "-e", "edges.xml", "-o", "road.net.xml"]
    subprocess.run([*command, *options], check=True, capture_output=True, cwd=folder)
    return folder / "my.sumocfg"


def straight(
    folder: Path,
    vehicles: str,
    length: float = 1000.0,
    end: float = 60.0,
    speed: float = 20.0,
    step: float = 0.1,
    options: str = "",
) -> Path:
    """One road with one lane and a limit of 20 m/s or another, and vehicles on the route `along`."""
    made = built(
        folder,
        f'<node id="a" x="0" y="0"/><node id="b" x="{length}" y="0"/>',
        f'<edge id="road" from="a" to="b" numLanes="1" speed="{speed}"/>',
        f'<vType id="car" carFollowModel="IDM" speedDev="0" minGap="1.5"/>'
        f'<vType id="van" length="7" minGap="3" speedDev="0"/>'
        f'<route id="along" edges="road"/>{vehicles}',
        f'<end value="{end}"/><step-length value="{step}"/>{options}',
    )
    return made.rename(folder / "straight.sumocfg")


def crossing(folder: Path, configuration: str = "") -> Path:
    """A small signalled crossing of cars and long buses, which overlap on it in ten minutes."""
    places = {"w": (-300, 0), "e": (300, 0), "s": (0, -300), "n": (0, 300)}
    nodes = '<node id="m" x="0" y="0" type="traffic_light"/>' + "".join(
        f'<node id="{name}" x="{x}" y="{y}"/>' for name, (x, y) in places.items()
    )
    edges = "".join(
        f'<edge id="{begin}{end}" from="{begin}" to="{end}" numLanes="2" speed="13.9"/>'
        for name in places
        for begin, end in ((name, "m"), ("m", name))
    )
    flows = "".join(
        f'<flow id="{kind}{begin}{end}" type="{kind}" from="{begin}m" to="m{end}" begin="0" end="900" '
        f'vehsPerHour="{flow}"/>'
        for begin in places
        for end in places
        for kind, flow in (("car", 150), ("bus", 15))
        if begin != end
    )
    small = ("--default.junctions.radius", "2", "--junctions.small-radius", "1", "--no-turnarounds", "true")
    routes = f'<vType id="car"/><vType id="bus" vClass="bus"/>{flows}'
    return built(folder, nodes, edges, routes, f'<end value="900"/>{configuration}', *small)


def two_way(folder: Path, configuration: str = "") -> Path:
    """A road with left-hand traffic on which cars overtake slow tractors in the opposite lane."""
    nodes = '<node id="a" x="0" y="0"/><node id="b" x="3000" y="0"/>'
    edges = "".join(
        f'<edge id="{there}" from="{there[0]}" to="{there[1]}" numLanes="1" speed="25"><neigh lane="{back}_0"/></edge>'
        for there, back in (("ab", "ba"), ("ba", "ab"))
    )
    flow = '<flow id="{}" type="{}" route="{}" begin="1" end="600" vehsPerHour="{}" departSpeed="max"/>'
    flows = [("t", "tractor", "r", 60), ("f", "car", "r", 300), ("g", "car", "q", 100)]
    routes = (
        '<vType id="car" lcOpposite="2"/><vType id="tractor" maxSpeed="8"/>'
        '<route id="r" edges="ab"/><route id="q" edges="ba"/>' + "".join(flow.format(*one) for one in flows)
    )
    configuration = f'<end value="600"/><step-length value="0.5"/>{configuration}'
    return built(folder, nodes, edges, routes, configuration, "--lefthand", "true")


UNSORTED = (
    '<flow id="a" type="car" route="along" begin="0" end="30" period="6"/>'
    '<flow id="b" type="car" route="along" begin="30" end="60" period="6"/>'
    '<flow id="c" type="car" route="along" begin="0" end="30" period="4"/>'
)
"""of which SUMO ignores the last flow"""
LATE = '<flow id="z" type="car" route="along" begin="25200" end="25500" period="3"/>'
STANDING = (
    '<vehicle id="van" type="van" route="along" depart="0"><stop lane="road_0" endPos="300" duration="90"/>'
    '</vehicle><flow id="f" type="car" route="along" begin="1" end="40" period="4"/>'
)
"""of which SUMO teleports those that stand behind the first"""
TELEPORTS = '<time-to-teleport value="5"/>'


def network(folder: Path, demand: str, more: str = "", options: str = "") -> str:
    """A straight road with vehicles on the route `along`, elements in an additional file, and options."""
    file = straight(folder, "", length=800.0)
    (folder / "demand.rou.xml").write_text(f'<routes><route id="along" edges="road"/>{demand}</routes>')
    (folder / "more.add.xml").write_text(f"<additional>{more}</additional>")
    text = file.read_text().replace("<end ", f'<additional-files value="more.add.xml"/>{options}<end ')
    file.write_text(text)
    return str(file)
