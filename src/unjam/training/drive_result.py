"""The result of `unjam.drive`: rows of metrics by driver, as numbers, pandas tables, and in a notebook.

pandas and matplotlib are imported late, so that commands start quickly.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unjam.measures.effect import Effect, effects_by_driver
from unjam.measures.feasibility import feasibility_by_driver
from unjam.measures.metric_table import RowsByDriver, choose_baseline, metric_table, table_headings
from unjam.measures.metrics import METRICS
from unjam.measures.notes import count_early_ends
from unjam.measures.statistics import Estimate, paired_difference, summarize
from unjam.reports.results import to_plot_episode
from unjam.worlds.record import Episode

if TYPE_CHECKING:
    import pandas as pd

EFFECT_ENTRIES = ("travel_time", "delay_reduction", "speed", "flow", "fuel", "hard_braking")


def rows_to_frame(rows_by_driver: RowsByDriver) -> "pd.DataFrame":
    """Return a row per episode and driver: `driver`, `seed` as text, `status`, and every metric."""
    import pandas as pd

    return pd.DataFrame(
        [{"driver": label, **row, "seed": str(row["seed"])} for label, rows in rows_by_driver.items() for row in rows]
    ).drop(columns="warnings", errors="ignore")


@dataclass(frozen=True)
class DriveResult:
    """Episodes of one or several drivers on the same traffic."""

    scenario: str
    rows: RowsByDriver = field(repr=False)
    """by driver: a row of metrics per episode"""
    folder: Path | None = None
    """folder of the results"""
    report: Path | None = None
    plot_episodes: dict[str, Episode] = field(default_factory=dict, repr=False)
    """by driver: the episode for figures, the same seed for all"""
    notes: list[str] = field(default_factory=list)
    """caveats, as controllers on a road that they were not made for"""

    @property
    def mean(self) -> dict[str, float]:
        """Mean of every metric over the episodes of the first driver."""
        return {name: each.mean for name, each in self.summary(next(iter(self.rows))).items()}

    def summary(self, driver: str) -> dict[str, Estimate]:
        """Return the mean and 95 % CI of every metric for a driver."""
        return summarize(self.rows[driver])

    def table(self) -> "pd.DataFrame":
        """Return a row per metric with the mean and both ends of the 95 % CI of each driver.

        `result.table().loc["mean_speed", ("pi", "mean")]` is one number.
        """
        import pandas as pd

        numbers = {
            (label, part): [getattr(estimate, part) for estimate in self.summary(label).values()]
            for label in self.rows
            for part in ("mean", "low", "high")
        }
        frame = pd.DataFrame(numbers, index=pd.Index(METRICS, name="metric"))
        return frame.rename_axis(columns=("driver", None))

    def episodes(self) -> "pd.DataFrame":
        """Return a row per episode and driver, with seed, status and every metric."""
        return rows_to_frame(self.rows)

    def _repr_html_(self) -> str:
        """Return every metric with its CI, and the trajectories of all vehicles, for notebooks."""
        import pandas as pd

        from unjam.reports.figures import data_uri, space_time_figure

        baseline = choose_baseline(self.rows)
        cells = [
            [f"{row.label} [{row.unit}]" if row.unit else row.label, *map(str, row.cells)]
            for row in metric_table(self.rows, baseline)
        ]
        headings = ["", *table_headings(self.rows, baseline)]
        table = pd.DataFrame(cells, columns=headings).to_html(index=False, border=0)
        if not self.plot_episodes:
            return table
        episodes = [to_plot_episode(label, each) for label, each in self.plot_episodes.items()]
        attributes = 'style="max-width: 100%" alt="every vehicle over time, dark is slow"'
        return f'{table}<img {attributes} src="{data_uri(space_time_figure(episodes))}">'

    def document(self) -> dict[str, Any]:
        """Return the result as `unjam drive --json` prints it; with several drivers, a list of documents."""
        verdicts, effects = feasibility_by_driver(self.rows), effects_by_driver(self.rows)
        baseline = choose_baseline(self.rows)
        documents = [
            {
                **self._document(driver, verdicts[driver], effects.get(driver)),
                "baseline": baseline or None,
                "difference_to_baseline": self._baseline_differences(driver, baseline),
            }
            for driver in self.rows
        ]
        return documents[0] if len(documents) == 1 else {"scenario": self.scenario, "drivers": documents}

    def _baseline_differences(self, driver: str, baseline: str) -> dict[str, list[float]] | None:
        """Return the paired differences of all metrics; None for the baseline itself, and without one."""
        if driver == baseline or not baseline:
            return None
        rows, others = self.rows[driver], self.rows[baseline]
        return {name: _mean_and_interval(paired_difference(rows, others, name)) for name in METRICS}

    def _document(self, driver: str, verdict: str, effect: Effect | None) -> dict[str, Any]:
        summary = self.summary(driver)
        return {
            "scenario": self.scenario,
            "driver": driver,
            "feasibility": verdict,
            "episodes": self.rows[driver],
            "mean": {name: summary[name].mean for name in METRICS},
            "ci95": {name: [summary[name].low, summary[name].high] for name in METRICS},
            "effect": {name: _mean_and_interval(getattr(effect, name)) for name in EFFECT_ENTRIES} if effect else None,
            "early_ends": count_early_ends(self.rows[driver]),
            "notes": self.notes,
            "folder": str(self.folder) if self.folder else None,
            "report": str(self.report) if self.report else None,
        }


def _mean_and_interval(estimate: Estimate) -> list[float]:
    return [estimate.mean, estimate.low, estimate.high]
