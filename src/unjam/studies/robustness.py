"""Robustness: trained controllers and experts on roads, and with sensors, that are not those of training."""

import json
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from unjam.controller import make_driver
from unjam.drivers.driver import Driver
from unjam.drivers.residual import Impaired
from unjam.files import to_json, write_whole
from unjam.measures.statistics import paired_difference
from unjam.studies.study import REFERENCES, ROADS, PlannedRun, Study, StudyFolder, Table
from unjam.studies.table import entries, estimates, interval, number
from unjam.training.config import load_config
from unjam.training.evaluate import evaluate, held_out_seeds
from unjam.worlds.workers import Workers

EPISODES = 10
TRAINED = "trained"
SHOWN = ("mean_speed", "mean_speed_steady", "speed_std_fleet", "min_headway", "collisions", "backlog_veh")
PEOPLE = {
    "desired_speed": 17.49,
    "time_headway": 1.355,
    "max_acceleration": 1.243,
    "comfortable_deceleration": 1.424,
    "minimum_gap": 2.157,
}
"""the IDM that suits the 325 drivers of the NGSIM pairs best together, results/field/ngsim-drivers.json"""


@dataclass(frozen=True)
class Condition:
    """What differs from training."""

    name: str
    scenario_changes: dict[str, Any] = field(default_factory=dict)
    impaired: dict[str, float] = field(default_factory=dict)
    """arguments of `Impaired`"""


EVERYWHERE = (
    Condition("as in training"),
    Condition("twice the noise", {"noise": 0.4}),
    Condition("people of NGSIM", {"humans": PEOPLE}),
    Condition("gaps ± 0.5 m", impaired={"gap_noise": 0.5}),
)
LATE = Condition("0.3 s late", impaired={"delay": 0.3})
RINGS = (
    *EVERYWHERE,
    LATE,
    Condition("two CAVs", {"cavs": 2}),
    Condition("one CAV in 44, 520 m", {"vehicles": 44, "length": [520, 520]}),
    Condition("200 to 219 m", {"length": [200, 219]}),
    Condition("271 to 300 m", {"length": [271, 300]}),
)
CONDITIONS: dict[str, tuple[Condition, ...]] = {
    "ring": (*RINGS, Condition("after ten minutes of jam", {"warmup": 6000})),
    "ring-jammed": (*RINGS, Condition("before there is a jam", {"warmup": 0})),
    "figure-eight": (
        *EVERYWHERE,
        LATE,
        Condition("two CAVs", {"cavs": 2}),
        Condition("radius 30 m", {"radius": [30, 30]}),
        Condition("radius 36 to 38 m", {"radius": [36, 38]}),
        Condition("twice as long", {"horizon": 3000}),
    ),
    "merge": (
        *EVERYWHERE,
        Condition("1 s late", impaired={"delay": 1.0}),  # it decides once in a second
        Condition("a CAV in 20", {"penetration": 0.05}),
        Condition("a CAV in 5", {"penetration": 0.2}),
        Condition("1,800 veh/h", {"inflow": 1800}),
        Condition("200 veh/h from the ramp", {"ramp_flow": 200}),
    ),
}
CONTROLLERS = {
    "ring": PlannedRun("ring", "best", 0),
    "ring-jammed": PlannedRun("ring-jammed", "best", 2),
    "figure-eight": PlannedRun("figure-eight", "ours", 0),
    "merge": PlannedRun("merge", "ours", 0),
}
"""the trainings whose controllers are shipped"""
EXPERTS = {
    "ring": ("PI", "PI (paper)"),
    "ring-jammed": ("PI", "PI (paper)"),
    "figure-eight": ("gentle varying pacer", "PI (paper)"),
    "merge": ("closing jam absorber", "jam absorber", "PI (paper)"),
}
"""the shipped controller's own comes first"""


def under_conditions(studies: StudyFolder, road: str, processes: int, episodes: int = EPISODES) -> Table:
    """Return a row per condition and driver: people alone, experts, the trained controller."""
    rows = []
    names = {"people": "human", **{label: REFERENCES[label] for label in EXPERTS[road]}}
    names[TRAINED] = str(studies.folder_of(CONTROLLERS[road]))
    with Workers(processes) as workers:
        for condition in CONDITIONS[road]:
            changes = {f"road.{key}": value for key, value in condition.scenario_changes.items()}
            scenario = load_config(changes={**ROADS[road], **changes}).make_scenario()
            step = scenario.decision_step
            drivers: dict[str, Driver] = {}
            for label, name in names.items():
                made, how = make_driver(name, step), {} if name == "human" else condition.impaired
                drivers[label] = Impaired(made, **how, time_step=step) if how else made
            found = evaluate(scenario, drivers, held_out_seeds(episodes), workers).rows
            for label, driven in found.items():
                row: dict[str, Any] = {"road": road, "condition": condition.name, "driver": label}
                gain = paired_difference(driven, found[EXPERTS[road][0]], "mean_speed")
                rows.append({**row, **estimates(driven, SHOWN), "faster_than_expert": entries(gain)})
    return rows


def _write(studies: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    rows = [row for road in CONDITIONS for row in under_conditions(studies, road, workers)]
    write_whole(folder / "robustness.json", to_json(rows, indent=1))


def _table(road: str, folder: Path) -> pd.DataFrame:
    """Return the mean speed of all vehicles by condition and driver, and what training has added."""
    table: dict[str, dict[str, str]] = {}
    for row in json.loads((folder / "robustness.json").read_text()):
        if row["road"] == road:
            cells = table.setdefault(row["condition"], {"": row["condition"]})
            cells[f"{row['driver']} [m/s]"] = number(row["mean_speed"]["mean"], 2)
            if row["driver"] == TRAINED:
                cells["beyond its expert [m/s]"] = interval(row["faster_than_expert"], 2, "+")
                cells["its smallest headway [s]"] = number(row["min_headway"]["mean"], 2)
                cells["its collisions"] = number(row["collisions"]["mean"], 2)
    return pd.DataFrame(table.values())


ROBUSTNESS = Study(
    "the shipped controllers on roads, among people and with sensors that they have not trained with",
    lambda seeds: list(CONTROLLERS.values()),
    _write,
    minutes=40.0,
    tables={road: partial(_table, road) for road in CONDITIONS},
)
