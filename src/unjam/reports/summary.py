"""What was driven as tables of pandas, and as a notebook shows it."""

from typing import Any

import pandas as pd

from unjam.measures.metrics import METRICS
from unjam.measures.statistics import summarise
from unjam.reports.figures import data_uri
from unjam.reports.lanes import space_time_of
from unjam.reports.results import shown_of
from unjam.reports.story import Column, table_of
from unjam.worlds.record import Episode

Rows = dict[str, list[dict[str, Any]]]
"""by driver: a row of metrics per episode, failed ones too"""


def frame_of_rows(rows_by_driver: Rows) -> pd.DataFrame:
    """Return a row per episode and driver: `driver`, `seed` in words, `status`, and every metric."""
    return pd.DataFrame(
        [
            {"driver": label, **row, "seed": str(row["seed"])}
            for label, rows in rows_by_driver.items()
            for row in rows
        ]
    )


def frame_of_metrics(rows_by_driver: Rows) -> pd.DataFrame:
    """Return a row per metric; columns are pairs of a driver and `mean`, `low` or `high`."""
    found = {label: summarise(rows) for label, rows in rows_by_driver.items()}
    numbers = {
        (label, part): [getattr(metrics[name], part) for name in METRICS]
        for label, metrics in found.items()
        for part in ("mean", "low", "high")
    }
    frame = pd.DataFrame(numbers, index=pd.Index(METRICS, name="metric"))
    return frame.rename_axis(columns=("driver", None))


def html_of(rows_by_driver: Rows, shown: dict[str, Episode]) -> str:
    """Return the report's table and its picture of all vehicles over time, as HTML for a notebook."""
    rows = table_of([Column(label, rows, None) for label, rows in rows_by_driver.items()])
    cells = [
        [f"{row['label']} [{row['unit']}]" if row["unit"] else row["label"]]
        + [f"{cell['mean']} {cell['interval']}".strip() for cell in row["cells"]]
        for row in rows
    ]
    table = pd.DataFrame(cells, columns=["", *rows_by_driver]).to_html(index=False, border=0)
    if not shown:
        return table
    picture = data_uri(space_time_of([shown_of(label, episode) for label, episode in shown.items()]))
    return f'{table}<img style="max-width: 100%" alt="every vehicle over time, dark is slow" src="{picture}">'
