"""Studies of the environment steps that a model of the whole road saves."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import cycle
from pathlib import Path

import numpy as np
import pandas as pd

from unjam.worlds.record import Floats
from unjam_paper.comparison import comparison_study
from unjam_paper.results_file import read_part
from unjam_paper.study import PlannedRun, Study, trainings_text
from unjam_paper.variants import VARIANTS

EFFICIENCY_STEPS = (190_000, 380_000, 750_000, 1_500_000, 3_000_000, 6_000_000)
ON_RAMP_EFFICIENCY_STEPS = (28_800,)
"""environment steps after which trainings are compared; on the on-ramp, those of a training with the model"""
STEP_MULTIPLES = (1, 2, 3)
"""multiples of the environment steps that variants without the model use"""
MODEL_FREE_VARIANTS = {
    "eight": ("eight-few", "eight-double", "best-in-batches"),
    "ramp": ("ramp-few",) * len(STEP_MULTIPLES) + ("ramp-small",) * len(STEP_MULTIPLES),
}
"""variants without the model, for `STEP_MULTIPLES`, where they differ from few, double and all steps. On figure eights,
which a batch steps only in distribution, the last is trained in batches, too"""


def road_model_study(road: str, prefix: str) -> Study:
    """Return the study of the environment steps that a model of the whole road saves, for variants with a prefix."""
    variants = compared_variants(prefix)
    title = f"environment steps that a model of the whole road saves, on {road}"
    study = comparison_study(title, tuple(dict.fromkeys(variants)), road)
    step_counts = ON_RAMP_EFFICIENCY_STEPS if road == "on-ramp" else EFFICIENCY_STEPS
    return replace(study, tables={**study.tables, "efficiency": partial(efficiency_table, road, variants, step_counts)})


def compared_variants(prefix: str) -> tuple[str, ...]:
    """Return the variant of a prefix with the model, and those without it by `STEP_MULTIPLES`."""
    return (f"{prefix}-road-model", *MODEL_FREE_VARIANTS.get(prefix, (f"{prefix}-few", f"{prefix}-double", "best")))


def efficiency_table(road: str, variants: Sequence[str], step_counts: Sequence[int], folder: Path) -> pd.DataFrame:
    """Return the validation returns after numbers of environment steps, and the differences to the first variant.

    The first variant is the one with the model.
    """
    curves, (modeled, *others) = read_part(folder, "curves")[road], variants
    returns = {name: partial(_returns_after, curves[name], _first_validation(road, name)) for name in variants}
    rows = [
        {"": VARIANTS[name].label, **{f"{at:,}": trainings_text(after(at), 0) for at in step_counts}}
        for name, after in returns.items()
    ]
    for name, times in zip(others, cycle(STEP_MULTIPLES)):
        more = "as many" if times == 1 else f"{times} times as many"
        gains = {at: returns[modeled](at) - returns[name](times * at) for at in step_counts}
        label = f"with the model, difference to “{VARIANTS[name].label}” after {more}"
        rows.append({"": label, **{f"{at:,}": trainings_text(gain, 0, "+") for at, gain in gains.items()}})
    return pd.DataFrame(rows)


def _first_validation(road: str, variant: str) -> int:
    """Return the number of steps before the first validation of a training."""
    config = PlannedRun(road, variant, 0).config
    return config.learner.steps_per_iteration * (config.evaluation.validation_interval or 1)


def _returns_after(curve: dict[str, list[float]], first_validation: int, steps: int) -> Floats:
    """Return the validation return of each training after some steps; NaN outside of its validated range."""
    trainings = curve["return_validation"]
    if steps < first_validation:
        return np.full(len(trainings), np.nan)
    return np.array([np.interp(steps, curve["steps"], each, np.nan, np.nan) for each in trainings])
