"""Tables of the studies that `unjam reproduce` made, from files under results/."""

import json
from typing import Any

import pandas as pd
from tables import RESULTS

PAPER = {"reward": "return", "speed": "CAV's speed [m/s]", "std": "its std [m/s]"}


def rows_of(study: str, road: str) -> list[dict[str, Any]]:
    """Return the rows of a study's table on a road."""
    rows = json.loads((RESULTS / study / "table.json").read_text())
    return [row for row in rows if row["road"] == road]


def paper_convention(study: str, road: str) -> pd.DataFrame:
    """Return a table in the paper's convention, beside the paper's own numbers."""
    table = []
    for row in rows_of(study, road):
        cells = {"": row["name"]}
        for key, heading in PAPER.items():
            ours, reported = row["paper_convention"][key], (row.get("paper") or {}).get(key)
            digits = 0 if key == "reward" else 2
            cells[heading] = f"{ours['mean']:.{digits}f} ± {ours['std']:.{digits}f}"
            cells[f"{heading}, paper"] = "" if reported is None else f"{reported:.{digits}f}"
        table.append(cells)
    return pd.DataFrame(table)


def honest(study: str, road: str) -> pd.DataFrame:
    """Return a table in the honest convention."""
    table = []
    for row in rows_of(study, road):
        beyond, better = row.get("beyond_best_expert"), row.get("probability_of_improvement")
        table.append(
            {
                "": f"{row['name']}{' (best expert)' if row.get('best_expert') else ''}",
                "trainings": row["trainings"] or "",
                "return": number(row["return"]["mean"], 0),
                "mean speed [m/s]": number(row["mean_speed"]["mean"], 2),
                "of the limit, steady": number(row["speed_limit_ratio_steady"]["mean"], 3),
                "std across vehicles [m/s]": number(row["speed_std_fleet"]["mean"], 2),
                "smallest headway [s]": number(row["min_headway"]["mean"], 2),
                "collisions": number(row["collisions"]["mean"], 2),
                "beyond": "" if beyond is None else interval(beyond, 0, "+"),
                "better": "" if better is None else f"{100 * better['mean']:.0f} %",
            }
        )
    return pd.DataFrame(table)


def number(value: float | None, digits: int) -> str:
    """Return a number as tables show it; a dash where there is none."""
    return "–" if value is None else f"{value:.{digits}f}"


def interval(entries: dict[str, Any], digits: int, sign: str = "") -> str:
    """Return an estimate with its interval."""
    values = [entries[name] for name in ("mean", "low", "high")]
    mean, low, high = ("–" if value is None else f"{value:{sign}.{digits}f}" for value in values)
    return f"{mean} [{low}, {high}]"
