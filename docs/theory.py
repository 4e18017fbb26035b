"""Tables of the measurements on the theorems of the paper, from results/theory.json."""

from dataclasses import asdict
from typing import Any

import numpy as np
import pandas as pd
from tables import results_part

from unjam.measures.statistics import estimate_over_trainings
from unjam_paper.study import interval_text
from unjam_paper.variants import VARIANTS


def theory_results() -> dict[str, Any]:
    """Return the results of the study."""
    return results_part("theory/theory")


def untrained_table() -> pd.DataFrame:
    """Return the returns of untrained policies with and without the expert (A1)."""
    table: dict[str, dict[str, str]] = {}
    for row in theory_results()["untrained"]:
        cells = table.setdefault(row["road"], {"": row["road"]})
        cells[row["policy"]] = (
            interval_text(asdict(estimate_over_trainings(row["returns"])), 0)
            if "returns" in row
            else f"{row['mean']:.0f}"
        )
    return pd.DataFrame(table.values())


def convergence_table() -> pd.DataFrame:
    """Return when trainings come within 5 % of the best known return, and how many are within it at the end (A2)."""
    table = []
    for row in theory_results()["convergence"]:
        arrivals = ["never" if steps is None else f"{steps:,}" for steps in row["convergence_steps"]]
        table.append(
            {
                "": VARIANTS[row["variant"]].label,
                "trainings": row["trainings"],
                "converge after [environment steps]": ", ".join(arrivals),
                "converged at the end": f"{row['converged_at_end']} of {row['trainings']}",
                "return at the end, in training": interval_text(row["last"], 0),
            }
        )
    return pd.DataFrame(table)


def model_error_table() -> pd.DataFrame:
    """Return model error, rollout length, gap of returns and bound in the first and last tenth of trainings (A3)."""
    table = []
    for variant, runs in theory_results()["model"].items():
        cells: dict[str, Any] = {"": VARIANTS[variant].label}
        first_rows = [row for run in runs for row in run[: max(1, len(run) // 10)]]
        last_rows = [row for run in runs for row in run[-max(1, len(run) // 10) :]]
        for name, heading, digits in (
            ("eps_m", "eps_m", 3),
            ("k_star", "k*", 0),
            ("gap", "gap of returns", 2),
            ("bound", "bound on it", 0),
        ):
            ends = [_known_mean(rows, name) for rows in (first_rows, last_rows)]
            cells[f"{heading}, first and last tenth"] = " → ".join(
                "–" if np.isnan(end) else f"{end:,.{digits}f}" for end in ends
            )
        table.append(cells)
    return pd.DataFrame(table)


def _known_mean(rows: list[dict[str, Any]], name: str) -> float:
    values = [row[name] for row in rows if row[name] is not None]
    return float(np.mean(values)) if values else float("nan")
