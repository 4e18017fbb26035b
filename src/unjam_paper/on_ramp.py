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
from unjam.files import atomic_write, to_json
from unjam.measures.feasibility import FEASIBLE
from unjam.measures.metric_table import HUMAN_LABEL, estimate_cell
from unjam.measures.statistics import estimate_on_shared_seeds
from unjam.scenarios.on_ramp import ON_RAMP
from unjam.training.presets import ON_RAMP_JAM_AHEAD
from unjam.worlds.worker_pool import WorkerPool
from unjam_paper.feasible import NO_VALUE_TEXT, verdict_text
from unjam_paper.results_file import read_part
from unjam_paper.study import Study, StudyFolder, evaluate_on_test_seeds, planned_runs

ON_RAMP_ROAD = replace(ON_RAMP, penetration_rate=0.05)
ON_RAMP_SEEDS = 100
TUNED_LABEL, LONGER_LABEL = "unjam:on-ramp-tuned", "tuned longer"
ON_RAMP_DRIVERS = {HUMAN_LABEL: "human", "own ACC": "cruise", TUNED_LABEL: TUNED_LABEL, LONGER_LABEL: ON_RAMP_JAM_AHEAD}
"""those that do not learn; what is learned is added to either of the last two"""
ON_RAMP_TIME, ON_RAMP_FLOW, ON_RAMP_BRAKING = "travel_time", "outflow_veh_per_h", "people_beyond_4_5"
ON_RAMP_METRICS = (
    ON_RAMP_TIME,
    ON_RAMP_FLOW,
    ON_RAMP_BRAKING,
    "mean_speed",
    "fuel_ml_per_km",
    "drivable",
    "min_time_gap",
    "cav_max_braking",
)
"""of each episode"""


def _write_on_ramp(variants: Iterable[str], study_folder: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    drivers = {label: make_driver(name, ON_RAMP_ROAD.control_step) for label, name in ON_RAMP_DRIVERS.items()}
    for variant in variants:
        for run in planned_runs(["on-ramp"], [variant], seeds):
            name = f"{variant} {run.seed}"
            drivers[name] = make_driver(str(study_folder.controller_folder(run)), ON_RAMP_ROAD.control_step)
    with WorkerPool(workers) as pool:
        atomic_write(
            folder / "ramp.json",
            to_json(evaluate_on_test_seeds(ON_RAMP_ROAD, drivers, ON_RAMP_SEEDS, ON_RAMP_METRICS, pool)),
        )


def on_ramp_table(variants: Mapping[str, str], folder: Path) -> pd.DataFrame:
    """Return how long everybody takes behind whom, and what more than behind tuned laws and people alone."""
    found = read_part(folder, "ramp")
    groups = {label: [label] for label in ON_RAMP_DRIVERS}
    for variant, words in variants.items():
        own = [label for label in found if label.rpartition(" ")[0] == variant]
        groups[f"{words}, {len(own)} trainings"] = own
    return pd.DataFrame([_on_ramp_row(found, label, members) for label, members in groups.items()])


def _on_ramp_row(results: dict[str, Any], label: str, members: Sequence[str]) -> dict[str, Any]:
    """Return what a driver, or several trainings together, are worth."""

    def values(labels: Sequence[str], name: str) -> np.ndarray:
        return np.array([[row[name] for row in results[each]["episodes"]] for each in labels], np.float64)

    def difference(baseline: str, name: str, digits: int) -> str:
        more = estimate_on_shared_seeds(values(members, name) - values([baseline], name))
        return NO_VALUE_TEXT if [baseline] == list(members) else str(estimate_cell(more, digits, sign="+"))

    closest = f"{np.nanmin(values(members, 'min_time_gap')):.2f}" if label != HUMAN_LABEL else NO_VALUE_TEXT
    return {
        "driver": label,
        "travel time [s]": f"{values(members, ON_RAMP_TIME).mean():.1f}",
        **{f"beyond {law} [s]": difference(law, ON_RAMP_TIME, 1) for law in (TUNED_LABEL, LONGER_LABEL)},
        "beyond people [s]": difference(HUMAN_LABEL, ON_RAMP_TIME, 1),
        "flow beyond people [veh/h]": difference(HUMAN_LABEL, ON_RAMP_FLOW, 0),
        "smallest headway [s]": closest,
        "drivable": _feasibility_text([results[each]["drivable"] for each in members]),
    }


def _feasibility_text(verdicts: Sequence[str]) -> str:
    """Return a verdict in a word, or of how many trainings it is drivable."""
    return verdict_text(verdicts) if len(verdicts) == 1 else f"{verdicts.count(FEASIBLE)} of {len(verdicts)}"


def on_ramp_study(variants: Mapping[str, str]) -> Study:
    """Return the study of variants that learn on the on-ramp, and what its table calls them."""
    return Study(
        title="what a residual is worth on the on-ramp at 5 % CAVs, beside tuned laws",
        make_runs=partial(planned_runs, ["on-ramp"], tuple(variants)),
        write=partial(_write_on_ramp, tuple(variants)),
        minutes=35.0,
        tables={"ramp": partial(on_ramp_table, variants)},
    )
