"""How often people of NGSIM run into each other on a figure eight: alone, and with whom among them.

`python results/tried/contacts.py` writes contacts.json beside itself, in a minute: for each driver in how
many episodes of tuning seeds anybody touched, of how many, and the mean speed in the second half [m/s].
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from unjam.files import to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.gain import Rows
from unjam.measures.table import PEOPLE
from unjam.studies.everywhere import PI_ON_ALL, PI_ON_RINGS, driven, kept_of
from unjam.training.family import FAMILY
from unjam.training.seeds import tuning_seeds
from unjam.worlds.workers import Workers

EPISODES = {PEOPLE: 100}
OF_OTHERS = 40
OTHERS = {
    "idm": "idm",
    "acc": "acc",
    "unjam:best": "unjam:best",
    "unjam:figure-eight-best": "unjam:figure-eight-best",
    "unjam:ring-best": "unjam:ring-best",
    "PI, tuned on all": PI_ON_ALL,
    "PI, tuned on the rings": PI_ON_RINGS,
}


def facts(rows: Rows) -> dict[str, Any]:
    """Return what is written of a driver's episodes."""
    return {
        "touched": sum(row["collisions"] > 0 for row in rows),
        "episodes": len(rows),
        "speed": float(np.mean([row["mean_speed_second_half"] for row in rows])),
    }


if __name__ == "__main__":
    road, found = FAMILY["figure-eight-ngsim"].make(), {}
    with Workers(2) as workers:
        run = partial(workers.run_each, keep=kept_of)
        for name in (PEOPLE, *OTHERS):
            seeds = tuning_seeds(EPISODES.get(name, OF_OTHERS), 6000)
            found |= driven(road, {name: OTHERS.get(name, name)}, seeds, run)
    written = {"manifest": manifest(), "drivers": {name: facts(rows) for name, rows in found.items()}}
    write_whole(Path(__file__).with_name("contacts.json"), to_json(written, indent=1))
