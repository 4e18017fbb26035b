"""Tables of studies: the paper's convention beside the paper's numbers, and the honest one."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from unjam.files import to_json, write_whole
from unjam.measures.statistics import (
    Estimate,
    estimate,
    interquartile_mean,
    paired_difference,
    probability_of_improvement,
)
from unjam.studies.study import REFERENCES, ROADS, VARIANTS, PlannedRun, StudyFolder, Table, TrainedRun
from unjam.training.config import load_config

PAPER: dict[tuple[str, str], tuple[float, float, float]] = {
    ("ring", "trpo"): (1699.15, 3.42, 0.55),
    ("ring", "ppo"): (1057.14, 3.43, 0.75),
    ("ring", "sac"): (1048.97, 3.24, 0.38),
    ("ring", "proposed"): (1753.66, 4.04, 0.48),
    ("ring", "mb-trpo"): (1717.45, 3.55, 0.73),
    ("ring", "no-initial-policy"): (1633.28, 3.53, 0.57),
    ("figure-eight", "trpo"): (542.42, 1.84, 1.43),
    ("figure-eight", "ppo"): (228.86, 1.60, 1.20),
    ("figure-eight", "sac"): (435.72, 2.30, 1.94),
    ("figure-eight", "proposed"): (862.81, 6.41, 2.04),
    ("merge", "trpo"): (420.07, 15.26, 2.46),
    ("merge", "ppo"): (415.02, 14.67, 2.77),
    ("merge", "sac"): (449.72, 16.47, 2.38),
    ("merge", "proposed"): (492.93, 17.44, 2.22),
}
"""Tables 1 and 2, by road and variant: reward, and of the CAV's own speed, start-up and exploration included,
the mean (`average speed`) and the standard deviation over time (`speed std`) [m/s]"""
HONEST = (
    *("return", "return_eq16", "mean_speed", "mean_speed_steady", "speed_limit_ratio_steady"),
    *("speed_std_fleet", "time_to_dissolve", "throughput_veh_per_h", "backlog_veh"),
    *("min_headway", "collisions"),
)
"""metrics of the deterministic policy on held-out seeds"""
EXPERTS = tuple(label for label in REFERENCES if label not in ("human", "zero", "constant +0.1"))
CONVENTION = {
    "reward": ("return", "return_mean"),
    "speed": ("cav_mean_speed", "cav_mean_speed"),
    "std": ("speed_std_cav", "speed_std_cav"),
}
"""the paper's columns: each as a metric of episodes, and as a number of the training batches"""


def metric_of(road: str, variant: str) -> str:
    """Return which return trainings are judged by: that of their reward, which all drivers have."""
    return "return_eq16" if PlannedRun(road, variant, 0).config.reward == "eq16" else "return"


def best_expert(references: dict[str, Table], metric: str = "return") -> str:
    """Return the label of the expert with the largest mean of a metric."""
    there = [label for label in EXPERTS if label in references]
    return max(there, key=lambda label: estimate([row[metric] for row in references[label]]).mean)


def table_rows(studies: StudyFolder, road: str, variants: Sequence[str], seeds: int) -> Table:
    """Return a row per driver that does not learn, and per variant, on a road."""
    references = studies.references(road)
    best = best_expert(references, metric_of(road, variants[0]))
    rows: Table = []
    for label, found in references.items():
        row = {"road": road, "name": label, "learns": False, "trainings": 0, "episodes": len(found)}
        row |= {"best_expert": label == best, **estimates(found, HONEST)}
        convention = {key: _mean_and_std(_finite(found, name)) for key, (name, _) in CONVENTION.items()}
        rows.append({**row, "paper_convention": convention, "steady_by_draw": _by_draw(road, found)})
    trained = {variant: studies.trained(road, variant, seeds) for variant in variants}
    return [*rows, *(_of_variant(road, variant, runs, references) for variant, runs in trained.items())]


def _of_variant(
    road: str, variant: str, runs: list[TrainedRun], references: dict[str, Table]
) -> dict[str, Any]:
    reported, metric = PAPER.get((road, variant)), metric_of(road, variant)
    best = best_expert(references, metric)
    row: dict[str, Any] = {
        "road": road,
        "name": VARIANTS[variant].label,
        "variant": variant,
        "learns": True,
        "trainings": len(runs),
        "episodes": len(runs[0].rows),
        "steps": runs[0].run.config.steps,
        "paper": dict(zip(CONVENTION, reported, strict=True)) if reported else None,
    }
    for name in HONEST:
        own = name != "return" or metric == "return"  # returns of another reward are no returns here
        values = [_mean(_finite(run.rows, name)) if own else float("nan") for run in runs]
        row[name] = entries(estimate(values, interquartile_mean))
    row["paper_convention"] = {
        key: _mean_and_std([run.in_training(name) for run in runs]) for key, (_, name) in CONVENTION.items()
    }
    row["steady_by_draw"] = _by_draw(road, [one for run in runs for one in run.rows])
    gains = [paired_difference(run.rows, references[best], metric).mean for run in runs]
    row["beyond"] = {"expert": best, "metric": metric}
    row["beyond_best_expert"] = entries(estimate(gains))
    improved = probability_of_improvement([run.rows for run in runs], references[best], metric)
    row["probability_of_improvement"] = entries(improved)
    row["seconds"] = _mean([run.seconds for run in runs])
    row["gains"] = gains
    return row


def _by_draw(road: str, rows: Table) -> dict[str, dict[str, float]]:
    """Return the steady mean speed by each number that episodes draw: the length, or the radius."""
    return {
        name: {
            f"{value:g}": _mean(_finite([row for row in rows if row[name] == value], "mean_speed_steady"))
            for value in sorted({row[name] for row in rows})
        }
        for name in load_config(changes=ROADS[road]).make_scenario().drawn_ranges
    }


def estimates(rows: Table, names: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return the mean of each of these metrics over episodes, with its interval."""
    return {name: entries(estimate([row[name] for row in rows])) for name in names}


def entries(found: Estimate) -> dict[str, float]:
    """Return an estimate as tables keep it."""
    return {"mean": found.mean, "low": found.low, "high": found.high}


def number(value: float | None, digits: int, sign: str = "") -> str:
    """Return a number as pages show it; a dash where there is none."""
    return "–" if value is None else f"{value:{sign}.{digits}f}"


def interval(entries: dict[str, Any], digits: int, sign: str = "") -> str:
    """Return an estimate with its interval as pages show it."""
    mean, low, high = (number(entries[name], digits, sign) for name in ("mean", "low", "high"))
    return unbroken(f"{mean} [{low}, {high}]")


def unbroken(text: str) -> str:
    """Return a text that stays on one line of a table."""
    return text.replace(" ", "\N{NO-BREAK SPACE}")


def _mean_and_std(values: Sequence[float]) -> dict[str, float]:
    return {"mean": _mean(values), "std": float(np.std(values)) if len(values) else float("nan")}


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _finite(rows: Table, name: str) -> list[float]:
    return [row[name] for row in rows if np.isfinite(row[name])]


def write_table(rows: Table, folder: Path) -> None:
    """Write a table as JSON, all of it, and as CSV, the numbers that people look at."""
    write_whole(folder / "table.json", to_json(rows, indent=1))
    write_whole(folder / "table.csv", pd.DataFrame([_flat(row) for row in rows]).to_csv(index=False))


def _flat(row: dict[str, Any]) -> dict[str, Any]:
    paper = row.get("paper") or {}
    flat: dict[str, Any] = {"road": row["road"], "name": row["name"], "trainings": row["trainings"]}
    for key in CONVENTION:
        flat[f"{key}, paper"] = paper.get(key)
        flat[f"{key}, paper convention"] = round(row["paper_convention"][key]["mean"], 2)
    for name in (*HONEST, "beyond_best_expert", "probability_of_improvement"):
        if name in row:  # drivers that do not learn are not compared with experts
            flat[name] = round(row[name]["mean"], 3)
    return flat
