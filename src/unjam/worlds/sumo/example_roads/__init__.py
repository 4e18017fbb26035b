"""Example networks of SUMO for users to edit: nodes, edges, connections, demand and a configuration."""

import re
from importlib.resources import files
from pathlib import Path

from unjam.errors import unknown_name
from unjam.files import atomic_write
from unjam.processes import PrivateFolder
from unjam.worlds.sumo.networks import run_netconvert

EXAMPLE_ROADS = ("on-ramp",)
INPUTS = {"--node-files": "nodes.nod.xml", "--edge-files": "edges.edg.xml", "--connection-files": "connections.con.xml"}
"""files that netconvert reads, by option"""


def write_example_road(name: str, folder: Path) -> Path:
    """Write the files of an example network into an existing folder, and return the path of SUMO's configuration."""
    if name not in EXAMPLE_ROADS:
        raise unknown_name("road", name, EXAMPLE_ROADS)
    contents = {file.name: file.read_text(encoding="utf-8") for file in files(__name__).joinpath(name).iterdir()}
    inputs = {(option, file): contents[file] for option, file in INPUTS.items()}
    with PrivateFolder() as private:
        network = run_netconvert(inputs, [], Path(private)).read_text(encoding="utf-8")
    # The first comment has names of temporary files.
    contents[f"{name}.net.xml"] = re.sub(r"<!--.*?-->\n*", "", network, count=1, flags=re.DOTALL)
    for file, content in contents.items():
        atomic_write(folder / file, content)
    return folder / f"{name}.sumocfg"
