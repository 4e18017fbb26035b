"""What was driven as tables of pandas, and as a notebook shows it."""

import pandas as pd

from unjam.measures.metrics import METRICS
from unjam.measures.statistics import summarise
from unjam.measures.table import Rows, baseline_of, headings_of, table_of
from unjam.reports.figures import data_uri
from unjam.reports.lanes import space_time_of
from unjam.reports.results import shown_of
from unjam.worlds.record import Episode


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
    baseline = baseline_of(rows_by_driver)
    cells = [
        [f"{row.label} [{row.unit}]" if row.unit else row.label, *map(str, row.cells)]
        for row in table_of(rows_by_driver, baseline)
    ]
    headings = ["", *headings_of(rows_by_driver, baseline)]
    table = pd.DataFrame(cells, columns=headings).to_html(index=False, border=0)
    if not shown:
        return table
    picture = data_uri(space_time_of([shown_of(label, episode) for label, episode in shown.items()]))
    return f'{table}<img style="max-width: 100%" alt="every vehicle over time, dark is slow" src="{picture}">'
