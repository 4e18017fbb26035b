"""What detectors would measure on SUMO's motorway ramp if its people kept more distance and were fewer.

Its arguments are the .sumocfg file, the file for the measurements, and the one that tells how near the known
truth itself comes to them on the seeds that judge. A calibration may come nearer: it fits this one draw of chance.
"""

import sys
from dataclasses import asdict
from math import isnan
from pathlib import Path

from unjam.files import to_json
from unjam.manifest import manifest
from unjam.measures.detectors import COLUMNS, agreement, detected
from unjam.measures.statistics import estimate
from unjam.processes import PrivateFolder
from unjam.sumo_files.changed import write_changed
from unjam.training.calibrate import JUDGED
from unjam.training.corridor import FLOWS, changed_types, corridor
from unjam.training.seeds import held_out_seeds
from unjam.worlds.sumo.counting import Counting

TRUE = {"tau": 1.4, "speedFactor": 0.9, FLOWS: 0.85}
PLACES = {"gneE2": 50.0, "gneE3": 50.0, "gneE7": 100.0, "gneE8": 100.0}
INTERVAL, END, SEED = 60, 360, 12345

road, file, told = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
head = ",".join(("edge", *COLUMNS))
times = [f"{begin},{begin + INTERVAL}" for begin in range(0, END, INTERVAL)]
asked = [f"{edge},{position:g},{time}" for edge, position in PLACES.items() for time in times]
file.write_text("\n".join([head, *(f"{row},0," for row in asked)]) + "\n")
with PrivateFolder() as folder, Counting(1) as counting:
    here = corridor(road, file)
    types, path = changed_types(here.files, TRUE), Path(folder) / "true.sumocfg"
    write_changed(here.files, types, TRUE[FLOWS], path)
    seeds = [(SEED,), *held_out_seeds(JUDGED)]
    passed, *judged = counting.run(here.scenario(path), seeds, here.loops)
measured = zip(asked, *detected(here.measured, here.loops_of, passed), strict=True)
rows = [f"{row},{flow:.0f},{'' if isnan(speed) else f'{speed:.2f}'}" for row, flow, speed in measured]
file.write_text("\n".join([head, *rows]) + "\n")
here = corridor(road, file)
near = [asdict(agreement(here.measured, *detected(here.measured, here.loops_of, one))) for one in judged]
found = {name: asdict(estimate([each[name] for each in near])) for name in near[0]}
told.write_text(to_json({"factors": TRUE, "agreement": found, "manifest": manifest()}, indent=1))
