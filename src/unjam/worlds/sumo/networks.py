"""Network files of built-in roads, which netconvert makes and unjam caches; and SUMO's programs and messages."""

import errno
import os
import shutil
import subprocess
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from functools import cache, lru_cache
from importlib.metadata import PackageNotFoundError, version
from itertools import dropwhile
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
import platformdirs

from unjam.errors import DISK_ERRNOS, DiskError, EpisodeError, MissingPartError, disk_error, invalid_value
from unjam.files import atomic_write, make_folder, remove_leftovers, sha256_of
from unjam.processes import PrivateFolder
from unjam.scenarios.road import Edge, RoadNetwork
from unjam.sumo_files import file_stamp, read_lanes
from unjam.worlds.record import Floats

STALE_FILE_SECONDS = 3600.0
"""age after which no process uses a temporary file any more [s]"""
MESSAGE_TOTAL_MARKER = "total messages of type:"
"""text in the lines at the end of a log that have the numbers of its messages"""
XMLAttributes = dict[str, Any]
UNCONTROLLED_LINK_STATES = "MZ-"
"""states of connections at which no vehicle has to wait: right of way, zipper merge, dead end"""
_intact_networks: dict[Path, tuple[int, int]] = {}
"""stamps of the cached networks that this process has verified"""


class NetworkLane(NamedTuple):
    """A lane of a network outside of junctions, with length [m], speed limit [m/s], and the lanes that follow it."""

    name: str
    edge: str
    length: float
    speed_limit: float
    successors: tuple[str, ...]
    has_stop_line: bool = False
    """whether vehicles may have to wait at the end of the lane, at a signal or stop sign, or to yield"""


@cache
def sumo_program(name: str) -> str:
    """Return the path of a program of SUMO, in its package or on the PATH; raise `MissingPartError` if missing."""
    with suppress(ImportError, AttributeError):
        import sumo

        bundled = Path(sumo.SUMO_HOME) / "bin" / name
        if bundled.exists():
            return str(bundled)
    if path := shutil.which(name):
        return path
    raise MissingPartError(f"SUMO's {name} is not installed; install it: pip install eclipse-sumo==1.28.0")


@cache
def sumo_version() -> str:
    """Return the installed version of libsumo; raise `MissingPartError` if there is none."""
    try:
        return version("libsumo")
    except PackageNotFoundError:
        raise MissingPartError("libsumo is not installed; install it: pip install libsumo==1.28.0") from None


def sumo_message(lines: Iterable[str]) -> str:
    """Return the error message in the output of one of SUMO's programs, as one line."""
    return "; ".join(text for line in lines if (text := line.strip()) and text != "Quitting (on error).")


def last_error_message(log_path: Path) -> str:
    """Return the error message at the end of SUMO's log, without the warnings before it; empty without one."""
    try:
        lines = [line for line in log_path.read_text(errors="replace").splitlines() if MESSAGE_TOTAL_MARKER not in line]
    except OSError:
        return ""
    return sumo_message(dropwhile(lambda line: not line.lstrip().startswith("Error"), lines))


def network_file(network: RoadNetwork) -> Path:
    """Return the network file of a built-in road, which netconvert makes unless an intact one is cached.

    Raise `MissingPartError` if netconvert is missing, `DiskError` if the cache cannot be written.
    """
    nodes = [
        {"id": name, "x": f"{x:.6f}", "y": f"{y:.6f}", "type": "priority" if has_priority else None, "radius": radius}
        for name, x, y, has_priority, radius in network.nodes
    ]
    edges = [_edge_attributes(edge, network.speed_limit) for edge in network.edges]
    files = {("--node-files", "road.nod.xml"): xml_document("nodes", "node", nodes)}
    files["--edge-files", "road.edg.xml"] = xml_document("edges", "edge", edges)
    if network.connections:
        names = "from", "to", "fromLane", "toLane"
        connections = [dict[str, Any](zip(names, connection, strict=True)) for connection in network.connections]
        files["--connection-files", "road.con.xml"] = xml_document("connections", "connection", connections)
    options = ["--no-turnarounds", "true", *([] if network.has_internal_links else ["--no-internal-links", "true"])]
    content = "\n".join([sumo_version(), *options, *files.values()])
    name = sha256_of(content.encode())[:24]
    target = cache_folder() / "networks" / f"{name}.net.xml"
    if is_intact(target):
        return target
    try:
        make_folder(target.parent)
    except (DiskError, FileNotFoundError) as error:  # the latter below /proc
        reason = error if isinstance(error, DiskError) else disk_error(error, target.parent)
        raise DiskError(f"{reason}; UNJAM_CACHE can name another folder") from None
    remove_leftovers(target.parent, min_age=STALE_FILE_SECONDS)
    try:
        with PrivateFolder() as folder:
            network_bytes = run_netconvert(files, options, Path(folder)).read_bytes()
    except OSError as error:
        raise (disk_error(error, "a temporary file") if error.errno in DISK_ERRNOS else error) from None
    atomic_write(target, network_bytes + checksum_line(network_bytes))  # several workers may do this at the same time
    return target


class NetworkGeometry(NamedTuple):
    """Geometry and speed limits of a network file; lengths [m]."""

    lane_lines: Floats
    """center lines of all lanes: rows (x, y) [m], with a row of NaN after each line"""
    edge_lengths: dict[str, float]
    lane_counts: dict[str, int]
    speed_limits: dict[str, float]
    """highest speed limit of the lanes of each edge [m/s]"""


def network_geometry(path: Path) -> NetworkGeometry:
    """Return the geometry of a network file; the file is read again if it has changed."""
    return _read_geometry(path, file_stamp(path))


@lru_cache(8)
def _read_geometry(path: Path, stamp: tuple[int, int]) -> NetworkGeometry:
    lanes = read_lanes(path)
    rows = [point for *_, points in lanes for point in (*points, (float("nan"), float("nan")))]
    lengths, counts = {edge: length for edge, length, *_ in lanes}, Counter(edge for edge, *_ in lanes)
    limits = {edge: limit for edge, _, limit, _ in sorted(lanes, key=lambda lane: lane[2])}
    return NetworkGeometry(np.array(rows, np.float64).reshape(-1, 2), lengths, dict(counts), limits)


def _edge_attributes(edge: Edge, default_speed_limit: float) -> XMLAttributes:
    ends = {"id": edge.name, "from": edge.from_node, "to": edge.to_node}
    shape = " ".join(f"{x:.6f},{y:.6f}" for x, y in edge.shape) or None
    lane = {"numLanes": edge.lanes, "speed": edge.speed_limit or default_speed_limit, "length": repr(edge.length)}
    return {**ends, **lane, "priority": edge.priority, "shape": shape}


def xml_document(root: str, tag: str, elements: Iterable[XMLAttributes]) -> str:
    """Return an XML document of elements with one tag."""
    return "\n".join([f"<{root}>", *(xml_element(tag, **attributes) for attributes in elements), f"</{root}>"])


def xml_element(tag: str, /, **attributes: Any) -> str:
    """Return an XML element without content; attributes that are None are left out."""
    pairs = [f"{key}={quoteattr(str(value))}" for key, value in attributes.items() if value is not None]
    return f"<{tag} {' '.join(pairs)}/>"


def run_netconvert(files: dict[tuple[str, str], str], options: list[str], folder: Path) -> Path:
    """Return the network that netconvert makes in a folder; `files` are contents by (option, name of the file).

    Raise `EpisodeError` with netconvert's message if it fails, and `OSError` if the disk is full.
    """
    network = folder / "road.net.xml"
    for (_, name), content in files.items():
        (folder / name).write_text(content)
    inputs = [f"{option}={folder / name}" for option, name in files]
    fixed_options = [f"--output-file={network}", "--offset.disable-normalization=true", "--precision=6"]
    command = [sumo_program("netconvert"), *inputs, *fixed_options, *options]
    # netconvert ignores the signal of a file size limit, as Python does, and writes an incomplete file.
    result = subprocess.run(command, capture_output=True, text=True, check=False, restore_signals=False)
    if result.returncode == 0 and network.exists():
        if network.read_bytes().rstrip().endswith(b"</net>"):
            return network
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # netconvert itself does not report a full disk
    message = sumo_message((result.stderr or result.stdout).splitlines())
    raise EpisodeError(f"netconvert cannot make the road: {message}")


def cache_folder() -> Path:
    """Return the folder of the cache; raise `InputError` if SUMO would read its name as a list or a variable."""
    folder = os.environ.get("UNJAM_CACHE") or platformdirs.user_cache_dir("unjam")
    if any(character in folder for character in ",;$%"):
        raise invalid_value("UNJAM_CACHE", folder, "a folder without , ; $ % in its name")
    return Path(folder)


def checksum_line(content: bytes) -> bytes:
    """Return the last line of a cached network, which has the hash of the lines before it."""
    return f"<!-- sha256 {sha256_of(content)} -->\n".encode()


def is_intact(network: Path) -> bool:
    """Return whether a cached network exists, and is complete and unchanged."""
    try:
        stamp = file_stamp(network)
        if _intact_networks.get(network) != stamp:
            content = network.read_bytes()
            length = len(content) - len(checksum_line(b""))
            if content[length:] != checksum_line(content[:length]):
                return False
            _intact_networks[network] = stamp
    except OSError:
        return False
    return True
