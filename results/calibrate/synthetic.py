"""What detectors would measure on SUMO's motorway ramp if its people kept more distance and were fewer.

Its arguments are the .sumocfg file, a new folder for the road with the known factors, and the files for what
is measured there on several days, each a seed that is used nowhere else.
"""

import sys
from math import isnan
from pathlib import Path

from unjam.files import to_json
from unjam.measures.detectors import COLUMNS, detected
from unjam.sumo_files.changed import write_changed
from unjam.training.corridor import FLOWS, changed_types, corridor
from unjam.worlds.sumo.counting import Counting

TRUE = {"tau": 1.4, "speedFactor": 0.9, FLOWS: 0.85}
PLACES = {"gneE2": 50.0, "gneE3": 50.0, "gneE7": 100.0, "gneE8": 100.0}
INTERVAL, END, SEED = 60, 360, 12345

road, folder, *files = sys.argv[1], *map(Path, sys.argv[2:])
folder.mkdir()
head = ",".join(("edge", *COLUMNS))
times = [f"{begin},{begin + INTERVAL}" for begin in range(0, END, INTERVAL)]
asked = [f"{edge},{position:g},{time}" for edge, position in PLACES.items() for time in times]
files[0].write_text("\n".join([head, *(f"{row},0," for row in asked)]) + "\n")
here = corridor(road, files[0])
path = write_changed(here.files, changed_types(here.files, TRUE), TRUE[FLOWS], folder / "true.sumocfg")
(folder / "factors.json").write_text(to_json(TRUE))
with Counting(1) as counting:
    days = counting.run(here.scenario(path), [(SEED + day,) for day in range(len(files))], here.loops)
for file, passed in zip(files, days, strict=True):
    measured = zip(asked, *detected(here.measured, here.loops_of, passed), strict=True)
    rows = [f"{row},{flow:.0f},{'' if isnan(speed) else f'{speed:.2f}'}" for row, flow, speed in measured]
    file.write_text("\n".join([head, *rows]) + "\n")
