"""What SUMO reads of an episode: the network, made once for each content, who drives how, and who enters."""

import errno
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from unjam.errors import DISK_ERRNOS, EpisodeError, MissingPartError, disk_error
from unjam.physics.idm import IDMParameters
from unjam.scenarios.road import (
    BuiltRoad,
    Connection,
    Edge,
    MotorwayRoad,
    Node,
    OwnRoad,
    Road,
    RoadNetwork,
)
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario
from unjam.sumo_files import read_lanes
from unjam.worlds.record import Floats
from unjam.worlds.sumo.cache import cache_folder, is_as_made, seal

Attributes = dict[str, Any]
"""of an XML element"""
SMALLEST_CAV_GAP = 0.5
"""gap that SUMO keeps for a CAV [m]"""
CAV_COLOUR = "215,38,61"
"""red, in SUMO's window"""
OBEDIENT = 20.0
"""accelerations of an obedient CAV's type [m/s2]: far beyond what it asks for, so that only safety clips"""
ACCELERATION = 2.6
"""of commanded people and of cars, SUMO's own [m/s2]"""
CAV_TYPES = "cav_of_{}"
"""the type of a CAV whose own type is `{}`"""
KEPT = (
    *("vClass", "length", "width", "height", "maxSpeed", "speedFactor", "guiShape", "emissionClass"),
    "laneChangeModel",
)
"""attributes of a vehicle type that a CAV takes over, beside those of changing lanes: `lc...`"""


class Files(NamedTuple):
    """What SUMO reads of an episode."""

    options: tuple[str, ...]
    """that say how to simulate"""
    named: dict[str, tuple[Path, ...]]
    """the network, and what else is there already, by the option that names it"""
    traffic: str
    """XML of vehicle types, and of routes and vehicles where they are not the user's"""
    option: str
    """by which SUMO takes the traffic"""
    to_copy: frozenset[Path] = frozenset()
    """files that SUMO must not read themselves, but in a harmless copy"""


def files_of(scenario: Scenario, road: Road) -> Files:
    """Return what SUMO reads of a road: one that is built for the episode, or the user's own network."""
    if isinstance(road, OwnRoad):
        return _own_files(scenario, road)
    assert isinstance(road, BuiltRoad)
    # Vehicles neither vanish from a jam nor give up waiting to enter.
    patience = ("--time-to-teleport", "-1", "--max-depart-delay", "-1")
    network = {"--net-file": (network_file(road.network),)}
    return Files(patience, network, _traffic_xml(scenario, road), "--route-files")


def _own_files(scenario: Scenario, road: OwnRoad) -> Files:
    """Return what SUMO reads of the user's own network: never its configuration itself."""
    files = road.files
    options = [f"--{name}={value}" for name, value in files.options.items()]
    # Validation would fetch the schemas that the files name.
    options += [f"--xml-validation{what}=never" for what in ("", ".net", ".routes")]
    named = {
        "--net-file": (files.network,),
        "--additional-files": files.additional_files,
        "--route-files": files.route_files,
    }
    traffic = _own_types_xml(scenario, road)
    return Files(tuple(options), named, traffic, "--additional-files", files.to_copy)


def _traffic_xml(scenario: Scenario, road: BuiltRoad) -> str:
    """Return the XML of types, routes and vehicles of an episode."""
    own = road.people if scenario.human_control == "native" else {}
    if isinstance(road, MotorwayRoad):
        lines = _motorway_types(scenario, road)
    else:
        humans = {"human": scenario.humans, **{f"of_{name}": one for name, one in own.items()}}
        lines = [_vehicle_type(name, scenario, **_human_layer(scenario, one)) for name, one in humans.items()]
        lines.append(_cav_type(scenario))
    for route in road.routes:
        laps = route.laps if route.laps > 1 else None
        lines.append(_element("route", id=route.name, edges=" ".join(route.edges), repeat=laps))
    for entry in road.entries:
        attributes = {
            "id": entry.name,
            "type": entry.kind or (f"of_{entry.name}" if entry.name in own else "human"),
            # SUMO would not let a driver who keeps a large distance begin closer than that.
            "insertionChecks": "collision" if entry.kind else "none" if entry.name in own else None,
            "route": entry.route,
            "depart": f"{entry.time:.2f}",
            "departPos": "base" if entry.kind else repr(entry.position),
            "departSpeed": entry.speed,
            "departLane": entry.lane,
        }
        lines.append(_element("vehicle", **attributes))
    return "\n".join(["<routes>", *lines, "</routes>"])


def _motorway_types(scenario: Scenario, road: MotorwayRoad) -> list[str]:
    """Return the XML of each person's type, and of the CAV's that may replace him: it wants to be as fast."""
    lines = []
    for name, person in road.kinds.items():
        alike = {"length": road.vehicle_length, "emissionClass": scenario.emission_class}
        alike |= {"speedFactor": person.speed_factor, "speedDev": 0.0, "emergencyDecel": 9.0}
        follows = {
            "carFollowModel": person.model,
            "tau": person.time_headway,
            "accel": person.acceleration,
            "decel": person.deceleration,
            "minGap": person.gap,
        }
        lines.append(_element("vType", id=name, **alike, **follows))
        lines.append(_element("vType", **{"id": CAV_TYPES.format(name), **alike, **_cav_layer(scenario)}))
    return lines


def _own_types_xml(scenario: Scenario, road: OwnRoad) -> str:
    """Return the XML of a CAV type beside each of the user's types: as large, but driven by commands."""
    types = []
    for name, attributes in road.files.types.items():
        kept = {key: value for key, value in attributes.items() if key in KEPT or key.startswith("lc")}
        calm = {"id": CAV_TYPES.format(name), "sigma": 0.0, "speedDev": 0.0}
        types.append({**kept, **calm, **_cav_layer(scenario)})
    return _document("additional", "vType", types)


def _vehicle_type(name: str, scenario: Scenario, **attributes: Any) -> str:
    """Return the XML of a vehicle type: SUMO's defaults of chance switched off, the rest as given."""
    common = {
        "id": name,
        "length": VEHICLE_LENGTH,
        "speedFactor": 1.0,
        "speedDev": 0.0,  # without it SUMO draws factors between 0.8 and 1.2
        "sigma": 0.0,
        "impatience": scenario.impatience,
        "emissionClass": scenario.emission_class,
    }
    return _element("vType", **{**common, **attributes})


def _human_layer(scenario: Scenario, humans: IDMParameters) -> Attributes:
    """Return how SUMO drives people: its own IDM; under commanded people Flow's layer, quick, with no gap."""
    population = scenario.calibrated
    layer = {
        "carFollowModel": "IDM",
        "accel": humans.max_acceleration,
        "decel": humans.comfortable_deceleration,
        "tau": humans.time_headway,
        "delta": humans.exponent,
        "minGap": humans.minimum_gap,
        "maxSpeed": humans.desired_speed,
    }
    if scenario.human_control == "commanded":
        layer |= {"accel": ACCELERATION, "decel": 4.5, "tau": 1.0, "minGap": scenario.people_gap}
        if population:  # the layer may not hold back who keeps less than a second
            layer |= {"tau": min(1.0, population.quickest), "maxSpeed": population.fastest}
    return layer


def _cav_type(scenario: Scenario) -> str:
    """Return the XML of the CAVs: a type that executes any safe command exactly.

    Where the actuation is Flow's, it is the human type instead; with a gap, or it would creep up until it
    touches.
    """
    if scenario.actuation == "flow":
        layer = _human_layer(scenario, scenario.humans)
        layer["minGap"] = max(layer["minGap"], SMALLEST_CAV_GAP)
        return _vehicle_type("cav", scenario, color=CAV_COLOUR, **layer)
    return _vehicle_type("cav", scenario, **_cav_layer(scenario), maxSpeed=scenario.top_speed)


def _cav_layer(scenario: Scenario) -> Attributes:
    """Return how a CAV follows in SUMO: as its own ACC does, or as it is told."""
    cruise = scenario.cruise
    if scenario.actuation != "cruise":
        return _obedient_layer(scenario)
    return {
        "color": CAV_COLOUR,
        "carFollowModel": "IDM",
        "tau": cruise.time_headway,
        "accel": cruise.acceleration,
        "decel": cruise.deceleration,
        "minGap": cruise.gap,
    }


def _obedient_layer(scenario: Scenario) -> Attributes:
    """Return the attributes of a type that executes any safe command exactly.

    With SUMO's safe-speed check on, a Krauss vehicle with a reaction time of one step and a small minimum
    gap is the one that stays out of the way until the command would lead to a crash. Where a filter keeps it
    safe, it has a car's engine and brakes: SUMO only makes it yield, and others expect of it what it can do.
    """
    safety = scenario.safety
    brakes = safety.braking if safety.active else OBEDIENT
    return {
        "color": CAV_COLOUR,
        "carFollowModel": "Krauss",
        "accel": max(ACCELERATION, scenario.limits.highest) if safety.active else OBEDIENT,
        **dict.fromkeys(("decel", "emergencyDecel", "apparentDecel"), brakes),
        "tau": scenario.simulation_step,
        "minGap": SMALLEST_CAV_GAP,
    }


@cache
def sumo_program(name: str) -> str:
    """Return the path of one of SUMO's programs: the installed package's, else the one on the PATH.

    Raises:
        MissingPartError: neither has it.
    """
    with suppress(ImportError, AttributeError):
        import sumo

        bundled = Path(sumo.SUMO_HOME) / "bin" / name
        if bundled.exists():
            return str(bundled)
    found = shutil.which(name)
    if found is None:
        raise MissingPartError(f"SUMO's {name} is not there; install it: pip install eclipse-sumo==1.28.0")
    return found


@cache
def sumo_version() -> str:
    """Return the installed version of libsumo; `MissingPartError` where there is none."""
    try:
        return version("libsumo")
    except PackageNotFoundError:
        raise MissingPartError("libsumo is not installed; install it: pip install libsumo==1.28.0") from None


def sumo_words(lines: Iterable[str]) -> str:
    """Return what one of SUMO's programs says of an error, as one line."""
    return "; ".join(said for line in lines if (said := line.strip()) and said != "Quitting (on error).")


def network_file(network: RoadNetwork) -> Path:
    """Return SUMO's network file, made with netconvert if this content was never made before, or is damaged.

    Raises:
        MissingPartError: netconvert is missing.
        DiskError: the cache cannot be written.
    """
    edges = (_edge(edge, network.speed) for edge in network.edges)
    files = {
        ("--node-files", "road.nod.xml"): _document("nodes", "node", map(_node, network.nodes)),
        ("--edge-files", "road.edg.xml"): _document("edges", "edge", edges),
    }
    if network.connections:
        pairs = map(_connection, network.connections)
        files["--connection-files", "road.con.xml"] = _document("connections", "connection", pairs)
    options = ["--no-turnarounds", "true", *([] if network.links else ["--no-internal-links", "true"])]
    content = "\n".join([sumo_version(), *options, *files.values()])
    name = hashlib.sha256(content.encode()).hexdigest()[:24]
    target = cache_folder() / "networks" / f"{name}.net.xml"
    if is_as_made(target):
        return target
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent) as folder:
            made = _netconvert(files, options, Path(folder))
            with made.open("ab") as file:
                file.write(seal(made.read_bytes()))
                file.flush()
                os.fsync(file.fileno())
            os.replace(made, target)  # whole or not at all, also with several workers at it
    except OSError as error:
        if error.errno in DISK_ERRNOS:
            raise disk_error(error, target.parent) from None
        raise
    return target


@cache
def network_lines(path: Path) -> Floats:
    """Return the centre lines of all lanes: rows (x, y) [m], a row of NaN between two lines."""
    rows: list[tuple[float, float]] = []
    for _, _, points in read_lanes(path):
        rows += [*points, (float("nan"), float("nan"))]
    return np.array(rows, np.float64).reshape(-1, 2)


@cache
def edge_lengths(path: Path) -> dict[str, float]:
    """Return the length of each edge [m]."""
    return {edge: length for edge, length, _ in read_lanes(path)}


def _node(node: Node) -> Attributes:
    kind = "priority" if node.priority else None
    return {"id": node.name, "x": f"{node.x:.6f}", "y": f"{node.y:.6f}", "type": kind, "radius": node.radius}


def _connection(connection: Connection) -> Attributes:
    ends = {"from": connection.before, "to": connection.after}
    return {**ends, "fromLane": connection.lane, "toLane": connection.lane_after}


def _edge(edge: Edge, speed: float) -> Attributes:
    ends = {"id": edge.name, "from": edge.begin, "to": edge.end}
    shape = " ".join(f"{x:.6f},{y:.6f}" for x, y in edge.shape) or None
    lane = {"numLanes": edge.lanes, "speed": edge.speed or speed, "length": repr(edge.length)}
    return {**ends, **lane, "priority": edge.priority, "shape": shape}


def _document(root: str, tag: str, elements: Iterable[Attributes]) -> str:
    return "\n".join([f"<{root}>", *(_element(tag, **each) for each in elements), f"</{root}>"])


def _element(tag: str, /, **attributes: Any) -> str:
    """Return an XML element without content, and without the attributes that are None."""
    pairs = [f"{key}={quoteattr(str(value))}" for key, value in attributes.items() if value is not None]
    return f"<{tag} {' '.join(pairs)}/>"


def _netconvert(files: dict[tuple[str, str], str], options: list[str], folder: Path) -> Path:
    made = folder / "road.net.xml"
    for (_, name), content in files.items():
        (folder / name).write_text(content)
    command = [
        sumo_program("netconvert"),
        *(f"{option}={folder / name}" for option, name in files),
        f"--output-file={made}",
        "--offset.disable-normalization=true",
        "--precision=6",
        *options,
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == 0 and made.exists():
        if made.read_bytes().rstrip().endswith(b"</net>"):
            return made
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # of which netconvert itself says nothing
    words = sumo_words((done.stderr or done.stdout).splitlines())
    raise EpisodeError(f"netconvert cannot make the road: {words}")
