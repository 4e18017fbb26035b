"""SUMO's network files: made by netconvert, once for each content."""

import hashlib
import os
import shutil
import subprocess
import tempfile
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import platformdirs
from numpy.typing import NDArray

from unjam.errors import DISK_ERRNOS, EpisodeError, MissingPartError, disk_error
from unjam.scenarios.road import PlainNetwork
from unjam.sumo_files import read_lanes


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


def network_file(plain: PlainNetwork) -> Path:
    """Return SUMO's network file, made with netconvert if this content was never made before.

    Raises:
        MissingPartError: netconvert is missing.
        DiskError: the cache cannot be written.
    """
    content = "\n".join(
        [sumo_version(), *plain.netconvert_options, plain.nodes, plain.edges, plain.connections]
    )
    name = hashlib.sha256(content.encode()).hexdigest()[:24]
    target = cache_folder() / "networks" / f"{name}.net.xml"
    if target.exists():
        return target
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent) as folder:
            made = _netconvert(plain, Path(folder))
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


def _netconvert(plain: PlainNetwork, folder: Path) -> Path:
    nodes, edges, made = folder / "road.nod.xml", folder / "road.edg.xml", folder / "road.net.xml"
    nodes.write_text(plain.nodes)
    edges.write_text(plain.edges)
    extra = []
    if plain.connections:
        connections = folder / "road.con.xml"
        connections.write_text(plain.connections)
        extra = [f"--connection-files={connections}"]
    command = [
        sumo_program("netconvert"),
        f"--node-files={nodes}",
        f"--edge-files={edges}",
        f"--output-file={made}",
        "--offset.disable-normalization=true",
        "--precision=6",
        *extra,
        *plain.netconvert_options,
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0 or not made.exists():
        lines = (line.strip() for line in (done.stderr or done.stdout).splitlines())
        words = "; ".join(line for line in lines if line and line != "Quitting (on error).")
        raise EpisodeError(f"netconvert cannot make the road: {words}")
    return made
