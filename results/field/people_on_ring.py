"""Puts calibrated people on the ring: python results/field/people_on_ring.py FOLDER DRIVERS.json CONTROLLER.

CONTROLLER is a run folder or a .unjam file, trained on the ring. FOLDER gets ring.json and ring.png.
"""

import sys
from pathlib import Path

from unjam.experiments.studies.people_on_ring import run

if __name__ == "__main__":
    folder, population, controller = map(Path, sys.argv[1:4])
    run(folder, population, controller, int(sys.argv[4]) if len(sys.argv) > 4 else 2, told=print)
