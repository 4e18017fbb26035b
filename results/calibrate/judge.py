"""How near roads come to what was measured on the day they were calibrated to, and on another.

Its arguments are the file for the answer, a file of factors that are known, those of the measurements, and
the roads: name=file.sumocfg.
"""

import json
import sys
from dataclasses import asdict
from pathlib import Path

from unjam.files import to_json
from unjam.manifest import manifest
from unjam.measures.detectors import agreement, detected
from unjam.measures.statistics import estimate
from unjam.training.calibrate import JUDGED
from unjam.training.corridor import corridor
from unjam.training.seeds import held_out_seeds
from unjam.worlds.sumo.counting import Counting

told, factors, first, second = map(Path, sys.argv[1:5])
found = {}
with Counting(2) as counting:
    for name, road in (text.split("=") for text in sys.argv[5:]):
        days = {"calibrated to": corridor(road, first), "another day": corridor(road, second)}
        one = days["calibrated to"]
        passed = counting.run(one.scenario(Path(road)), held_out_seeds(JUDGED), one.loops)
        found[name] = {}
        for day, here in days.items():
            each_day = (detected(here.measured, here.loops_of, each) for each in passed)
            rows = [asdict(agreement(here.measured, *both)) for both in each_day]
            found[name][day] = {key: asdict(estimate([row[key] for row in rows])) for key in rows[0]}
answer = {"factors": json.loads(factors.read_text()), "agreement": found, "manifest": manifest()}
told.write_text(to_json(answer, indent=1))
