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

from unjam.files import atomic_write, to_json
from unjam.measures.metric_table import estimate_cell
from unjam.measures.statistics import estimate_over_trainings
from unjam.training.config import load_config
from unjam.training.early_stopping import has_converged
from unjam_paper.comparison import comparison_study
from unjam_paper.results_file import read_part
from unjam_paper.study import FINAL_SHARE, VARIANTS, Study, StudyFolder, Table, TrainedRun

PAPER_EXACT_VARIANTS = {
    "ring": ("trpo-exact", "proposed-exact"),
    "figure-eight": ("trpo-exact", "proposed-exact"),
    "merge": ("trpo-exact-million", "proposed-exact-million"),
}
"""what is trained on each road of the paper"""


def paper_convergence(progress: Table) -> dict[str, float] | None:
    """Return after how many steps the paper's rule ends a training, and what it earns then; None: never."""
    rule = load_config(preset="paper-exact")
    span = rule.evaluation.convergence_window
    for made in range(span, len(progress) + 1, span):
        if has_converged(rule, progress[:made]):
            earned = np.mean([row["return_mean"] for row in progress[made - span : made]])
            return {"steps": progress[made - 1]["environment_steps"], "return": float(earned)}
    return None


def transition_model_errors(progress: Table) -> list[float] | None:
    """Return the model error against actual transitions, first and last tenth; None: there is no model."""
    found = [row["virtual"]["eps_m_by_estimator"]["transitions"] for row in progress if row["virtual"]]
    if not found:
        return None
    some = max(1, round(FINAL_SHARE * len(found)))
    return [float(np.mean(found[:some])), float(np.mean(found[-some:]))]


def _run_facts(run: TrainedRun) -> dict[str, Any]:
    return {
        "converged": paper_convergence(run.progress),
        "eps_m": transition_model_errors(run.progress),
        "last": run.final_training_mean("return_mean"),
        "held_out": float(np.mean([row["return"] for row in run.rows])),
    }


def _paper_exact_table(variants: Sequence[str], folder: Path) -> pd.DataFrame:
    """Return when trainings converge by the paper's rule, what they earn then and at the end, and eps_m."""
    found, table = read_part(folder, "letter"), []
    for variant in variants:
        trainings = found[variant]
        ended = [each["converged"] for each in trainings if each["converged"]]
        errors = [each["eps_m"] for each in trainings if each["eps_m"]]
        cells = {"": VARIANTS[variant].label, "trainings": str(len(trainings))}
        cells["converge, by the rule"] = f"{len(ended)} of {len(trainings)}"
        cells["after [steps]"] = f"{np.median([each['steps'] for each in ended]):,.0f}" if ended else "–"
        cells["earn then, in training"] = _trainings_cell([each["return"] for each in ended])
        cells["in the last tenth"] = _trainings_cell([each["last"] for each in trainings])
        cells["last checkpoint, held-out"] = _trainings_cell([each["held_out"] for each in trainings])
        cells["eps_m, first and last tenth"] = (
            " → ".join(f"{mean:.3f}" for mean in np.mean(errors, 0)) if errors else "–"
        )
        cells["eps_m rises in"] = f"{sum(last > first for first, last in errors)} of {len(errors)}" if errors else "–"
        table.append(cells)
    return pd.DataFrame(table)


def _trainings_cell(values: Sequence[float]) -> str:
    return str(estimate_cell(estimate_over_trainings(values), 0)) if values else "–"


def paper_exact_study(road: str) -> Study:
    """Return the study of a road."""
    variants = PAPER_EXACT_VARIANTS[road]
    compared = comparison_study(f"the paper to the letter, on {road}", variants, road)

    def write(study_folder: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
        compared.write(study_folder, seeds, folder, workers)
        found = {name: [_run_facts(run) for run in study_folder.trained_runs(road, name, seeds)] for name in variants}
        atomic_write(folder / "letter.json", to_json(found, indent=1))

    return replace(compared, write=write, tables={"letter": partial(_paper_exact_table, variants)})
