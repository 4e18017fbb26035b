"""Figure 5: space-time pictures of people alone, the paper's method and ours, on three roads."""

from dataclasses import replace
from pathlib import Path

from unjam.reports.figures import space_time
from unjam.reports.results import Shown, read_results
from unjam.studies.plan import PAPERS_ROADS, VARIANTS, PlannedRun, planned
from unjam.studies.pool import Pool
from unjam.studies.study import Study
from unjam.studies.table import best_expert

LEARNED = ("proposed", "ours")


def _write(pool: Pool, seeds: int, folder: Path, workers: int) -> None:
    """Draw a picture per road; all drivers of one meet the same traffic."""
    for road in PAPERS_ROADS:
        space_time(shown_on(pool, road)).savefig(folder / f"{road}.png", dpi=130)


def shown_on(pool: Pool, road: str) -> list[Shown]:
    """Return the episodes to show: people, the best expert, and what was trained, first seed of each."""
    drives = read_results(pool.drives_of(road)).shown
    episodes = [drives["human"], drives[best_expert(pool.references(road))]]
    for variant in LEARNED:
        results = pool.results(PlannedRun(road, variant, 0))
        trained = results.shown[results.trained or ""]
        episodes.append(replace(trained, driver=VARIANTS[variant].label))
    return episodes


FIGURE_5 = Study(
    "space-time pictures", lambda seeds: planned(PAPERS_ROADS, LEARNED, 1), _write, PAPERS_ROADS, minutes=0.5
)
