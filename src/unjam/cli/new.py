"""`unjam new` writes an example network that users edit."""

from pathlib import Path
from typing import Annotated

from typer import Argument

from unjam.cli.options import JsonOption
from unjam.cli.output import console, print_json, print_next_command
from unjam.training.run_folder import lock_new_folder
from unjam.worlds.sumo.example_roads import EXAMPLE_ROADS, write_example_road


def new_command(
    road: Annotated[str, Argument(help=f"Example network: {', '.join(EXAMPLE_ROADS)}.", metavar="ROAD")],
    out: Annotated[Path, Argument(help="Folder for its files.", metavar="FOLDER")],
    json: JsonOption = False,
) -> None:
    """Write an example network of SUMO to edit: nodes, edges, connections, demand, configuration, README.

    Example:

    - unjam new on-ramp my-road
    """
    with lock_new_folder(out):
        configuration = write_example_road(road, out)
    names = sorted(path.name for path in out.glob("[!.]*"))
    if json:
        print_json({"configuration": str(configuration), "files": names})
        return
    console.print(f"{out}: {', '.join(names)}")
    print_next_command("drive there", "drive", configuration, "--penetration-rate", 0.1)
