"""The paper to the letter: its own steps and settings, and where its rule would have ended the training.

One network as it was drawn, no noise drawn, the last checkpoint, the model error against actual transitions
(preset `paper-exact`). All steps are made; where the rule of convergence would have stopped is read off.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from unjam.files import to_json, write_whole
from unjam.measures.statistics import over_trainings
from unjam.measures.table import cell_of
from unjam.studies.comparison import comparison_of
from unjam.studies.results_file import read_part
from unjam.studies.study import LAST_SHARE, VARIANTS, Study, StudyFolder, Table, TrainedRun
from unjam.training.config import load_config
from unjam.training.stopping import has_converged

VARIANTS_OF = {
    "ring": ("trpo-exact", "proposed-exact"),
    "figure-eight": ("trpo-exact", "proposed-exact"),
    "merge": ("trpo-exact-million", "proposed-exact-million"),
}
"""what is trained on each road of the paper"""


def convergence_of(progress: Table) -> dict[str, float] | None:
    """Return after how many steps the paper's rule ends a training, and what it earns then; None: never."""
    rule = load_config(preset="paper-exact")
    span = rule.evaluation.converged
    for made in range(span, len(progress) + 1, span):
        if has_converged(rule, progress[:made]):
            earned = np.mean([row["return_mean"] for row in progress[made - span : made]])
            return {"steps": progress[made - 1]["actual_steps"], "return": float(earned)}
    return None


def model_errors(progress: Table) -> list[float] | None:
    """Return the model error against actual transitions, first and last tenth; None: there is no model."""
    found = [row["virtual"]["eps_m_by_estimator"]["transitions"] for row in progress if row["virtual"]]
    if not found:
        return None
    some = max(1, round(LAST_SHARE * len(found)))
    return [float(np.mean(found[:some])), float(np.mean(found[-some:]))]


def _facts(run: TrainedRun) -> dict[str, Any]:
    return {
        "converged": convergence_of(run.progress),
        "eps_m": model_errors(run.progress),
        "last": run.in_training("return_mean"),
        "held_out": float(np.mean([row["return"] for row in run.rows])),
    }


def _table(variants: Sequence[str], folder: Path) -> pd.DataFrame:
    """Return when trainings converge by the paper's rule, what they earn then and at the end, and eps_m."""
    found, table = read_part(folder, "letter"), []
    for variant in variants:
        trainings = found[variant]
        ended = [each["converged"] for each in trainings if each["converged"]]
        errors = [each["eps_m"] for each in trainings if each["eps_m"]]
        cells = {"": VARIANTS[variant].label, "trainings": str(len(trainings))}
        cells["converge, by the rule"] = f"{len(ended)} of {len(trainings)}"
        cells["after [steps]"] = f"{np.median([each['steps'] for each in ended]):,.0f}" if ended else "–"
        cells["earn then, in training"] = _cell([each["return"] for each in ended])
        cells["in the last tenth"] = _cell([each["last"] for each in trainings])
        cells["last checkpoint, held-out"] = _cell([each["held_out"] for each in trainings])
        cells["eps_m, first and last tenth"] = (
            " → ".join(f"{mean:.3f}" for mean in np.mean(errors, 0)) if errors else "–"
        )
        cells["eps_m rises in"] = (
            f"{sum(last > first for first, last in errors)} of {len(errors)}" if errors else "–"
        )
        table.append(cells)
    return pd.DataFrame(table)


def _cell(values: Sequence[float]) -> str:
    return str(cell_of(over_trainings(values), 0)) if values else "–"


def to_the_letter(road: str) -> Study:
    """Return the study of a road."""
    variants = VARIANTS_OF[road]
    compared = comparison_of(f"the paper to the letter, on {road}", variants, road)

    def write(studies: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
        compared.write(studies, seeds, folder, workers)
        found = {name: [_facts(run) for run in studies.trained(road, name, seeds)] for name in variants}
        write_whole(folder / "letter.json", to_json(found, indent=1))

    return replace(compared, write=write, tables={"letter": partial(_table, variants)})
