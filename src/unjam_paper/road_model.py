"""What a virtual environment of whole roads saves: the same return from how many actual steps.

The best method of a road, with the model and without it: on as few actual steps, on twice as many, and on all
that it takes.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import cycle
from pathlib import Path

import numpy as np
import pandas as pd

from unjam.measures.metric_table import estimate_cell
from unjam.measures.statistics import estimate_over_trainings
from unjam.worlds.record import Floats
from unjam_paper.comparison import comparison_study
from unjam_paper.results_file import read_part
from unjam_paper.study import VARIANTS, PlannedRun, Study

EFFICIENCY_STEPS = (190_000, 380_000, 750_000, 1_500_000, 3_000_000, 6_000_000)
"""actual steps after which trainings are looked at"""
ON_RAMP_EFFICIENCY_STEPS = (28_800,)
"""the same on the on-ramp, whose trainings with the model are as long"""
STEP_MULTIPLES = (1, 2, 3)
"""how many times the actual steps the method may take without the model"""
MODEL_FREE_VARIANTS = {
    "eight": ("eight-few", "eight-middle", "best-in-batches"),
    "ramp": ("ramp-few",) * len(STEP_MULTIPLES) + ("ramp-small",) * len(STEP_MULTIPLES),
}
"""who is without it: with few steps, with twice as many, with all; on the on-ramp two go so far"""


def compared_variants(prefix: str) -> tuple[str, ...]:
    """Return the variant whose names begin with `prefix` that has the model, and who is without, by `TIMES`.

    On figures eight, which a batch steps in distribution alone, the last is trained in batches, too.
    """
    return (f"{prefix}-imagined", *MODEL_FREE_VARIANTS.get(prefix, (f"{prefix}-few", f"{prefix}-middle", "best")))


def efficiency_table(road: str, variants: Sequence[str], step_counts: Sequence[int], folder: Path) -> pd.DataFrame:
    """Return what trainings earn on the validation seeds after so many actual steps, and what more it is.

    Of the variants that are compared the first has the model.
    """
    curves, (modelled, *others) = read_part(folder, "curves")[road], variants
    seen = {name: partial(_returns_after, curves[name], _first_validation(road, name)) for name in variants}
    names = [f"{steps:,}" for steps in step_counts]
    rows = [
        _efficiency_row(VARIANTS[name].label, names, [at_each(at) for at in step_counts])
        for name, at_each in seen.items()
    ]
    for name, times in zip(others, cycle(STEP_MULTIPLES)):
        beyond = [seen[modelled](at) - seen[name](times * at) for at in step_counts]
        more = "as many" if times == 1 else f"{times} times as many"
        label = f"with the model beyond “{VARIANTS[name].label}” after {more}"
        rows.append(_efficiency_row(label, names, beyond, "+"))
    return pd.DataFrame(rows)


def _first_validation(road: str, variant: str) -> int:
    """Return after how many steps a training is validated for the first time."""
    config = PlannedRun(road, variant, 0).config
    return config.learner.steps_per_iteration * (config.evaluation.validation_interval or 1)


def _returns_after(curve: dict[str, list[float]], first_validation: int, steps: int) -> Floats:
    """Return what each training earns after so many steps; NaN before it is validated and after its end."""
    trainings = curve["return_validation"]
    if steps < first_validation:
        return np.full(len(trainings), np.nan)
    return np.array([np.interp(steps, curve["steps"], each, np.nan, np.nan) for each in trainings])


def _efficiency_row(label: str, names: Sequence[str], columns: list[Floats], sign: str = "") -> dict[str, str]:
    cells = [str(estimate_cell(estimate_over_trainings(values.tolist()), 0, sign=sign)) for values in columns]
    return {"": label, **dict(zip(names, cells, strict=True))}


def road_model_study(road: str, prefix: str, step_counts: Sequence[int] = EFFICIENCY_STEPS) -> Study:
    """Return the study of a road and of its variants whose names begin with `prefix`."""
    compared = compared_variants(prefix)
    title = f"what a model of the whole road saves, on the {road}"
    study = comparison_study(title, tuple(dict.fromkeys(compared)), road)
    return replace(study, tables={**study.tables, "efficiency": partial(efficiency_table, road, compared, step_counts)})
