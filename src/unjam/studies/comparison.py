"""The paper's comparisons of learners: Table 1 and Figure 4, Table 2 and Figure 7, Figure 9."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from unjam.files import to_json, write_whole
from unjam.studies.curves import curves_of, draw_curves
from unjam.studies.plan import PAPERS_ROADS, planned
from unjam.studies.pool import Pool
from unjam.studies.study import Study
from unjam.studies.table import best_expert, metric_of, table_rows, write_table

LEARNERS = ("trpo", "ppo", "sac", "proposed", "without-model", "ours")
ABLATION = (
    *("trpo", "mb-trpo", "no-initial-policy", "without-model", "proposed"),
    *("ours-without-model", "ours"),
)
FRAMEWORK = ("ppo", "sac", "proposed-ppo", "proposed-sac", "proposed", "without-model")


def _write(
    variants: Sequence[str], roads: Sequence[str], pool: Pool, seeds: int, folder: Path, workers: int
) -> None:
    """Write table and curves of some variants on some roads."""
    write_table([row for road in roads for row in table_rows(pool, road, variants, seeds)], folder)
    by_road = {road: curves_of(pool, road, variants, seeds) for road in roads}
    references, metric = {}, metric_of(roads[0], variants[0])
    for road in roads:
        found = pool.references(road)
        best = best_expert(found, metric)
        references[road] = {"all human": found["human"], "best expert": found[best]}
    write_whole(folder / "curves.json", to_json(by_road))
    draw_curves(by_road, references, metric).savefig(folder / "curves.png")


def comparison(title: str, variants: Sequence[str], roads: Sequence[str]) -> Study:
    """Return the study that compares some variants on some roads."""
    return Study(
        title,
        partial(planned, roads, variants),  # pyright: ignore[reportArgumentType]
        partial(_write, variants, roads),
        tuple(roads),
    )


TABLE_1 = {
    f"table-1-{road}": comparison(
        f"TRPO, PPO, SAC, the proposed method and ours on {road}", LEARNERS, (road,)
    )
    for road in PAPERS_ROADS
}
TABLE_2 = comparison("what each part of the method is worth, on the ring", ABLATION, ("ring",))
LONG = comparison(
    "the paper's four million steps, and ours trained on, on the ring",
    ("trpo-long", "proposed-long", "best"),
    ("ring",),
)
ON_EXPERTS = comparison(
    "ours on the figure eight: on the best expert and on PI, with model and without",
    ("ours", "ours-with-model", "ours-on-pi"),
    ("figure-eight",),
)
JAMMED = comparison(
    "ours on a ring whose wave has grown before the CAV takes over",
    ("best", "ours-with-model"),
    ("ring-jammed",),
)
FIGURE_9 = comparison("PPO and SAC within the framework, on the ring", FRAMEWORK, ("ring",))
