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
from unjam.studies.paper import PAPER
from unjam.studies.plan import ROADS, VARIANTS, PlannedRun
from unjam.studies.pool import EXPERTS, Pool, TrainedRun
from unjam.training.config import load_config

Rows = list[dict[str, Any]]

HONEST = (
    "return",
    "return_eq16",
    "mean_speed",
    "mean_speed_steady",
    "speed_limit_ratio_steady",
    "speed_std_fleet",
    "time_to_dissolve",
    "throughput_veh_per_h",
    "backlog_veh",
    "min_headway",
    "collisions",
)
"""metrics of the deterministic policy on held-out seeds"""


def metric_of(road: str, variant: str) -> str:
    """Return which return trainings are judged by: that of their reward, which all drivers have."""
    return "return_eq16" if PlannedRun(road, variant, 0).config.reward == "eq16" else "return"


def best_expert(references: dict[str, Rows], metric: str = "return") -> str:
    """Return the label of the expert with the largest mean of a metric."""
    there = [label for label in EXPERTS if label in references]
    return max(there, key=lambda label: estimate([row[metric] for row in references[label]]).mean)


def table_rows(pool: Pool, road: str, variants: Sequence[str], seeds: int) -> Rows:
    """Return a row per driver that does not learn, and per variant, on a road."""
    references = pool.references(road)
    best = best_expert(references, metric_of(road, variants[0]))
    rows: Rows = []
    for label, found in references.items():
        row = {"road": road, "name": label, "learns": False, "trainings": 0, "episodes": len(found)}
        row |= {"best_expert": label == best}
        row |= {name: entries(estimate(_finite(found, name))) for name in HONEST}
        row["paper_convention"] = _as_in_the_paper(found)
        row["steady_by_draw"] = _by_draw(road, found)
        rows.append(row)
    for variant in variants:
        runs = pool.trained([PlannedRun(road, variant, seed) for seed in range(seeds)])
        rows.append(_of_variant(road, variant, runs, references))
    return rows


def _of_variant(
    road: str, variant: str, runs: list[TrainedRun], references: dict[str, Rows]
) -> dict[str, Any]:
    reported, metric = PAPER.get((road, variant)), metric_of(road, variant)
    best = best_expert(references, metric)
    expert = references[best]
    row: dict[str, Any] = {
        "road": road,
        "name": VARIANTS[variant].label,
        "variant": variant,
        "learns": True,
        "trainings": len(runs),
        "episodes": len(runs[0].rows),
        "steps": runs[0].run.config.steps,
        "paper": reported._asdict() if reported else None,
    }
    for name in HONEST:
        own = name != "return" or metric == "return"  # returns of another reward are no returns here
        values = [_mean(_finite(run.rows, name)) if own else float("nan") for run in runs]
        row[name] = entries(estimate(values, interquartile_mean))
    row["paper_convention"] = {
        "reward": _mean_and_std([run.in_training("return_mean") for run in runs]),
        "speed": _mean_and_std([run.in_training("cav_mean_speed") for run in runs]),
        "std": _mean_and_std([run.in_training("speed_std_cav") for run in runs]),
    }
    row["steady_by_draw"] = _by_draw(road, [one for run in runs for one in run.rows])
    gains = [paired_difference(run.rows, expert, metric).mean for run in runs]
    row["beyond"] = {"expert": best, "metric": metric}
    row["beyond_best_expert"] = entries(estimate(gains))
    improved = probability_of_improvement([run.rows for run in runs], expert, metric)
    row["probability_of_improvement"] = entries(improved)
    row["seconds"] = _mean([run.seconds for run in runs])
    row["gains"] = gains
    return row


def _by_draw(road: str, rows: Rows) -> dict[str, dict[str, float]]:
    """Return the steady mean speed by each number that episodes draw: the length, or the radius."""
    ranges = load_config(changes=ROADS[road]).make_scenario().drawn_ranges
    return {
        name: {
            f"{value:g}": _mean(_finite([row for row in rows if row[name] == value], "mean_speed_steady"))
            for value in sorted({row[name] for row in rows})
        }
        for name in ranges
    }


def entries(found: Estimate) -> dict[str, float]:
    """Return an estimate as tables keep it."""
    return {"mean": found.mean, "low": found.low, "high": found.high}


def _as_in_the_paper(rows: Rows) -> dict[str, dict[str, float]]:
    names = {"reward": "return", "speed": "cav_mean_speed", "std": "speed_std_cav"}
    return {key: _mean_and_std(_finite(rows, name)) for key, name in names.items()}


def _mean_and_std(values: Sequence[float]) -> dict[str, float]:
    return {"mean": _mean(values), "std": float(np.std(values)) if len(values) else float("nan")}


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _finite(rows: Rows, name: str) -> list[float]:
    return [row[name] for row in rows if np.isfinite(row[name])]


def write_table(rows: Rows, folder: Path) -> None:
    """Write a table as JSON, all of it, and as CSV, the numbers that people look at."""
    write_whole(folder / "table.json", to_json(rows, indent=1))
    write_whole(folder / "table.csv", pd.DataFrame([_flat(row) for row in rows]).to_csv(index=False))


def _flat(row: dict[str, Any]) -> dict[str, Any]:
    paper = row.get("paper") or {}
    convention = row["paper_convention"]
    flat: dict[str, Any] = {"road": row["road"], "name": row["name"], "trainings": row["trainings"]}
    for key in ("reward", "speed", "std"):
        flat[f"{key}, paper"] = paper.get(key)
        flat[f"{key}, paper convention"] = round(convention[key]["mean"], 2)
    for name in HONEST:
        flat[name] = round(row[name]["mean"], 3)
    for name in ("beyond_best_expert", "probability_of_improvement"):
        if name in row:
            flat[name] = round(row[name]["mean"], 3)
    return flat
