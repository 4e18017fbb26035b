"""Puts calibrated people on the ring: FOLDER CONTROLLER OWN_HEADWAY.json ALL_OWN.json [WORKERS].

CONTROLLER is a run folder or a .unjam file, trained on the ring; the populations are of `unjam fit-drivers`.
FOLDER gets ring.json and ring.png.
"""

import sys
from pathlib import Path

from unjam.studies.robustness import people_on_ring

if __name__ == "__main__":
    folder, controller, headway, everything = map(Path, sys.argv[1:5])
    populations = {"own headways": headway, "all parameters own": everything}
    people_on_ring(
        folder, populations, controller, int(sys.argv[5]) if len(sys.argv) > 5 else 2, on_progress=print
    )
