"""What a learned residual is worth on the on-ramp, where one vehicle in twenty is a CAV, beside tuned laws.

The seeds are shared by all trainings, which the intervals know.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from unjam.controller import make_driver
from unjam.files import to_json, write_whole
from unjam.measures.drivable import DRIVABLE
from unjam.measures.statistics import estimate_on_shared_seeds
from unjam.measures.table import PEOPLE, cell_of
from unjam.scenarios.on_ramp import ON_RAMP
from unjam.studies.drivable import NOTHING, in_a_word
from unjam.studies.results_file import read_part
from unjam.studies.study import Study, StudyFolder, judged, planned
from unjam.training.presets import ON_RAMP_LONG
from unjam.worlds.workers import Workers

ROAD = replace(ON_RAMP, cav_share=0.05)
SEEDS = 100
TUNED, LONGER = "unjam:on-ramp-tuned", "tuned longer"
NAMED = {PEOPLE: "human", "own ACC": "cruise", TUNED: TUNED, LONGER: ON_RAMP_LONG}
"""those that do not learn; what is learned is added to either of the last two"""
TIME, FLOW, BRAKING = "travel_time", "throughput_veh_per_h", "people_beyond_4_5"
KEPT = (TIME, FLOW, BRAKING, "mean_speed", "fuel_ml_per_km", "drivable", "min_headway", "cav_max_braking")
"""of each episode"""


def _write(variants: Iterable[str], studies: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    drivers = {label: make_driver(name, ROAD.decision_step) for label, name in NAMED.items()}
    for variant in variants:
        for run in planned(["on-ramp"], [variant], seeds):
            name = f"{variant} {run.seed}"
            drivers[name] = make_driver(str(studies.controller_of(run)), ROAD.decision_step)
    with Workers(workers) as pool:
        write_whole(folder / "ramp.json", to_json(judged(ROAD, drivers, SEEDS, KEPT, pool)))


def table(variants: Mapping[str, str], folder: Path) -> pd.DataFrame:
    """Return how long everybody takes behind whom, and what more than behind tuned laws and people alone."""
    found = read_part(folder, "ramp")
    groups = {label: [label] for label in NAMED}
    for variant, words in variants.items():
        own = [label for label in found if label.rpartition(" ")[0] == variant]
        groups[f"{words}, {len(own)} trainings"] = own
    return pd.DataFrame([_row(found, label, members) for label, members in groups.items()])


def _row(found: dict[str, Any], label: str, members: Sequence[str]) -> dict[str, Any]:
    """Return what a driver, or several trainings together, are worth."""

    def of(labels: Sequence[str], name: str) -> np.ndarray:
        return np.array([[row[name] for row in found[each]["episodes"]] for each in labels], np.float64)

    def beyond(baseline: str, name: str, digits: int) -> str:
        more = estimate_on_shared_seeds(of(members, name) - of([baseline], name))
        return NOTHING if [baseline] == list(members) else str(cell_of(more, digits, sign="+"))

    closest = f"{np.nanmin(of(members, 'min_headway')):.2f}" if label != PEOPLE else NOTHING
    return {
        "driver": label,
        "travel time [s]": f"{of(members, TIME).mean():.1f}",
        **{f"beyond {law} [s]": beyond(law, TIME, 1) for law in (TUNED, LONGER)},
        "beyond people [s]": beyond(PEOPLE, TIME, 1),
        "flow beyond people [veh/h]": beyond(PEOPLE, FLOW, 0),
        "smallest headway [s]": closest,
        "drivable": _drivable([found[each]["drivable"] for each in members]),
    }


def _drivable(said: Sequence[str]) -> str:
    """Return a verdict in a word, or of how many trainings it is drivable."""
    return in_a_word(said) if len(said) == 1 else f"{said.count(DRIVABLE)} of {len(said)}"


def ramp_trained(variants: Mapping[str, str]) -> Study:
    """Return the study of variants that learn on the on-ramp, and what its table calls them."""
    return Study(
        title="what a residual is worth on the on-ramp at 5 % CAVs, beside tuned laws",
        runs=partial(planned, ["on-ramp"], tuple(variants)),
        write=partial(_write, tuple(variants)),
        minutes=35.0,
        tables={"ramp": partial(table, variants)},
    )
