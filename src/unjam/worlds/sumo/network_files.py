"""SUMO's network files: written as XML and made by netconvert, once for each content."""

import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterable
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import platformdirs
from numpy.typing import NDArray

from unjam.errors import DISK_ERRNOS, EpisodeError, MissingPartError, disk_error
from unjam.scenarios.road import Edge, Network, Node
from unjam.sumo_files import read_lanes

Attributes = dict[str, Any]
"""of an XML element"""


def cache_folder() -> Path:
    """Return where networks are kept: `$UNJAM_CACHE`, or the user's cache folder."""
    chosen = os.environ.get("UNJAM_CACHE")
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("unjam"))


@cache
def sumo_program(name: str) -> str:
    """Return the path of one of SUMO's programs: the installed package's, else the one on the PATH.

    Raises:
        MissingPartError: neither has it.
    """
    try:
        import sumo

        bundled = Path(sumo.SUMO_HOME) / "bin" / name
        if bundled.exists():
            return str(bundled)
    except (ImportError, AttributeError):
        pass
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


def network_file(network: Network) -> Path:
    """Return SUMO's network file, made with netconvert if this content was never made before.

    Raises:
        MissingPartError: netconvert is missing.
        DiskError: the cache cannot be written.
    """
    files = {
        ("--node-files", "road.nod.xml"): _xml("nodes", "node", map(_node, network.nodes)),
        ("--edge-files", "road.edg.xml"): _xml(
            "edges", "edge", (_edge(e, network.speed) for e in network.edges)
        ),
    }
    if network.connections:
        pairs = ({"from": before, "to": after} for before, after in network.connections)
        files["--connection-files", "road.con.xml"] = _xml("connections", "connection", pairs)
    options = ["--no-turnarounds", "true", *([] if network.links else ["--no-internal-links", "true"])]
    content = "\n".join([sumo_version(), *options, *files.values()])
    name = hashlib.sha256(content.encode()).hexdigest()[:24]
    target = cache_folder() / "networks" / f"{name}.net.xml"
    if target.exists():
        return target
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent) as folder:
            made = _netconvert(files, options, Path(folder))
            os.replace(made, target)  # whole or not at all, also with several workers at it
    except OSError as error:
        if error.errno in DISK_ERRNOS:
            raise disk_error(error, target.parent) from None
        raise
    return target


@cache
def network_lines(path: Path) -> NDArray[np.float64]:
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
    kind = {"type": "priority"} if node.priority else {}
    radius = {} if node.radius is None else {"radius": node.radius}
    return {"id": node.name, "x": f"{node.x:.6f}", "y": f"{node.y:.6f}", **kind, **radius}


def _edge(edge: Edge, speed: float) -> Attributes:
    found = {"id": edge.name, "from": edge.begin, "to": edge.end, "numLanes": 1, "speed": speed}
    found["length"] = repr(edge.length)
    if edge.priority is not None:
        found["priority"] = edge.priority
    if edge.shape:
        found["shape"] = " ".join(f"{x:.6f},{y:.6f}" for x, y in edge.shape)
    return found


def _xml(root: str, tag: str, elements: Iterable[Attributes]) -> str:
    return "\n".join([f"<{root}>", *(element_xml(tag, each) for each in elements), f"</{root}>"])


def element_xml(tag: str, attributes: Attributes) -> str:
    """Return an XML element without content."""
    pairs = " ".join(f"{key}={quoteattr(str(value))}" for key, value in attributes.items())
    return f"<{tag} {pairs}/>"


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
    if done.returncode != 0 or not made.exists():
        lines = (line.strip() for line in (done.stderr or done.stdout).splitlines())
        words = "; ".join(line for line in lines if line and line != "Quitting (on error).")
        raise EpisodeError(f"netconvert cannot make the road: {words}")
    return made
