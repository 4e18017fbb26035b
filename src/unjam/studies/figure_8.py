"""Figure 8: what training costs, all variants side by side in one run."""

import json
import tempfile
from dataclasses import replace
from pathlib import Path

import pandas as pd
import torch
from matplotlib import rc_context
from matplotlib.figure import Figure

from unjam.files import to_json, write_whole
from unjam.reports.figures import LINES, STYLE
from unjam.reports.results import read_progress
from unjam.studies.study import VARIANTS, PlannedRun, Study, StudyFolder
from unjam.training.folder import start_folder
from unjam.training.train import Trainer
from unjam.worlds.workers import Workers

ROAD = "ring"
MEASURED = (
    *("trpo", "ppo", "sac", "mb-trpo", "without-model"),
    *("proposed", "proposed-ppo", "proposed-sac", "ours"),
)
STEPS, ROUNDS = 24_000, 3
"""actual steps of each measured training, and how often all take their turn"""
START_STEPS = 3_000
NOT_MEASURED = "validation"
"""the part that is switched off, for it is the same for all"""


def measured_seconds(steps: int = STEPS, rounds: int = ROUNDS) -> dict[str, list[dict[str, float]]]:
    """Return the wall time of the parts of training per 1,000 actual steps [s], by variant and round.

    The variants take turns, so that what else the machine does meets all of them alike.
    """
    torch.set_num_threads(1)
    found: dict[str, list[dict[str, float]]] = {variant: [] for variant in MEASURED}
    with Workers(1) as workers, tempfile.TemporaryDirectory() as place:
        for turn in range(rounds):
            for variant in MEASURED:
                config = PlannedRun(ROAD, variant, turn).config
                config = replace(config, steps=steps, evaluation=replace(config.evaluation, every=0))
                # Or sac would measure hardly more than its start.
                config = replace(config, sac=replace(config.sac, start_steps=START_STEPS))
                folder = Path(place) / f"{variant}-{turn}"
                start_folder(folder, config)
                Trainer(folder, config, workers).train()
                found[variant].append(_per_thousand(folder))
    return found


def _per_thousand(folder: Path) -> dict[str, float]:
    rows = read_progress(folder)
    thousands = rows[-1]["actual_steps"] / 1000.0
    parts = dict.fromkeys(part for row in rows for part in row["seconds"] if part != NOT_MEASURED)
    return {part: sum(row["seconds"].get(part, 0.0) for row in rows) / thousands for part in parts}


def _write(studies: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    found = measured_seconds()
    # A turn that something else on the machine slowed down does not count.
    medians = {
        variant: sorted(turns, key=lambda parts: sum(parts.values()))[len(turns) // 2]
        for variant, turns in found.items()
    }
    of_trpo = sum(medians["trpo"].values())
    over_trpo = {variant: sum(parts.values()) / of_trpo for variant, parts in medians.items()}
    numbers = {"turns": found, "median": medians, "over_trpo": over_trpo}
    write_whole(folder / "time.json", to_json(numbers, indent=1))
    draw(medians).savefig(folder / "time.png")


def draw(seconds: dict[str, dict[str, float]]) -> Figure:
    """Draw the parts of training, a bar per variant."""
    with rc_context(STYLE):
        figure = Figure(figsize=(10.5, 0.4 * len(seconds) + 1.2), layout="constrained", dpi=130)
        axes = figure.subplots()
        parts = list(dict.fromkeys(part for found in seconds.values() for part in found))
        labels = [VARIANTS[variant].label for variant in seconds]
        left = [0.0] * len(seconds)
        for part, colour in zip(parts, LINES, strict=False):
            widths = [found.get(part, 0.0) for found in seconds.values()]
            axes.barh(labels, widths, left=left, color=colour, label=part)
            left = [start + width for start, width in zip(left, widths, strict=True)]
        axes.invert_yaxis()
        axes.grid(axis="y", visible=False)
        axes.set_xlabel("wall time per 1,000 actual steps [s]")
        figure.legend(loc="outside upper left", ncols=6)
        return figure


def _table(folder: Path) -> pd.DataFrame:
    """Return the wall time per 1,000 actual steps by variant and part, and how many times TRPO's it is."""
    found = json.loads((folder / "time.json").read_text())
    table = []
    for variant, parts in found["median"].items():
        cells = {"": VARIANTS[variant].label}
        cells |= {f"{part} [s]": f"{seconds:.2f}" for part, seconds in parts.items()}
        table.append({**cells, "times TRPO's": f"{found['over_trpo'][variant]:.2f}"})
    return pd.DataFrame(table).fillna("")


FIGURE_8 = Study(
    "training time, measured side by side",
    lambda seeds: [],
    _write,
    minutes=12.0,
    tables={"training time": _table},
)
