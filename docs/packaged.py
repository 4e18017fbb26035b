"""The table of packaged controllers for closed roads, made from results/string-stability.json."""

from typing import Any

import pandas as pd
from tables import results_part, show

from unjam.controller.string_stability import GAIN_TOLERANCE
from unjam.measures.feasibility import FEASIBLE
from unjam.measures.metric_table import estimate_cell
from unjam.measures.statistics import paired_difference

REASONS = {
    "ring-best": "a return among the largest of ten trainings from a standstill, with the smallest string gain",
    "ring-best-ideal": "the controller of this name for ideal cars, the ablation",
    "ring-gap-tuned": "a tuned formula for a start; the expert of `ring-best`",
    "ring-tuned": "a formula of few parameters; for waves (`ring-jammed`), not for a start",
    "rings-tuned": "for many rings, the expert of `unjam:best`",
    "shared-rings-tuned": "for rings that several CAVs share; the expert of `unjam:best` there",
    "ring-jammed-best": "a larger return than its formula in a developed wave",
    "ring-jammed-best-ideal": "the controller of this name for ideal cars, the ablation",
    "ring-jammed-tuned": "the largest mean return of a formula in a wave (over that for ideal cars undecided)",
    "ring-jammed-tuned-ideal": "the controller of this name for ideal cars, the ablation",
    "figure-eight-best": "the largest return by Eq. 16; its queue sometimes breaks in cars that respond at once",
    "figure-eight-best-ideal": "the residual for ideal cars, which holds its queue in both",
    "figure-eight-tuned": "the largest return of a formula by Eq. 16",
    "figure-eight-tuned-ideal": "the controller of this name for ideal cars, the ablation",
}
"""why a controller that is not string stable is part of the package"""


def packaged_table() -> str:
    """Return road, string gain, speed and feasibility of each controller in a usual car, and why it is included."""
    rows: list[dict[str, Any]] = []
    for road in ("ring", "ring-jammed", "figure-eight"):
        measured = [row for row in results_part(f"string-stability/packaged-{road}") if row["car"] == "usual"]
        human = next(row["episodes"] for row in results_part(f"string-stability/{road}") if row["expert"] == "human")
        for row in measured:
            name = row["driver"].removeprefix("unjam:")
            if name not in REASONS:
                continue
            feasible_count = sum(episode["feasibility"] == FEASIBLE for episode in row["episodes"])
            difference = paired_difference(row["episodes"], human, "mean_speed")
            rows.append(
                {
                    "unjam:": name,
                    "measured on": road,
                    "string stable": "yes" if row["gain"] <= 1.0 + GAIN_TOLERANCE else "no",
                    "string gain": f"{row['gain']:.2f}",
                    "mean speed [m/s], difference to human": str(estimate_cell(difference, 2, sign="+")),
                    "feasible": f"{feasible_count} of {len(row['episodes'])}",
                    "why it ships": REASONS[name],
                }
            )
    return show(pd.DataFrame(rows))
