"""What a report says of each driver beside people alone, and its episodes as a table to take away."""

import csv
import io
from collections.abc import Sequence
from typing import Any

from unjam.measures.metrics import METRICS
from unjam.measures.statistics import digits_of, paired_difference, signed
from unjam.reports.story import Column

LESS, MORE = "less", "more"
BETTER = {
    **dict.fromkeys(("travel_time", "delay", "backlog_veh", "fuel_ml_per_km", "share_standing"), LESS),
    **dict.fromkeys(("throughput_veh_per_h", "mean_speed", "mean_speed_steady", "min_ttc"), MORE),
    **dict.fromkeys(("speed_std_fleet", "speed_std_fleet_steady", "time_to_dissolve"), LESS),
    **dict.fromkeys(
        ("people_max_braking", "people_beyond_3_5", "people_beyond_4_5", "people_beyond_9"), LESS
    ),
    "collisions": LESS,
}
"""metrics that say the same of people alone and of traffic with CAVs, in the order of the table, and what is
better of each"""


def against_people(columns: Sequence[Column]) -> dict[str, Any]:
    """Return the table of differences to people alone, same seeds paired; empty where they are not there.

    A cell is marked better or worse where its interval lies on one side of zero: each for itself, so that of
    twenty cells one is marked by chance.
    """
    people = next((column for column in columns if column.name == "human"), None)
    others = [column for column in columns if column is not people]
    if people is None or not others:
        return {}
    rows = []
    for name, better in BETTER.items():
        metric = METRICS[name]
        gains = [paired_difference(column.rows, people.rows, name) for column in others]
        if not any(gain.count for gain in gains):
            continue
        cells = []
        for gain in gains:
            shown = gain.low > 0 or gain.high < 0
            mark = ("better" if (gain.mean > 0) == (better is MORE) else "worse") if shown else ""
            cells.append({"text": signed(gain, digits_of(gain, metric.digits)), "mark": mark})
        rows.append({"label": metric.label, "unit": metric.unit, "cells": cells})
    return {"names": [column.name for column in others], "rows": rows}


def episodes_as_csv(columns: Sequence[Column]) -> str:
    """Return all episodes as CSV: a row per driver and seed, a column per metric; NaN is empty."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["driver", "seed", "status", *METRICS])
    for column in columns:
        for row in column.rows:
            values = ("" if row[name] != row[name] else row[name] for name in METRICS)
            table.writerow([column.name, row["seed"], row["status"], *values])
    return text.getvalue()
