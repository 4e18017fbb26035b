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

from unjam.measures.statistics import over_trainings
from unjam.measures.table import cell_of
from unjam.studies.comparison import comparison_of
from unjam.studies.results_file import read_part
from unjam.studies.study import VARIANTS, PlannedRun, Study
from unjam.worlds.record import Floats

LOOKS = (190_000, 380_000, 750_000, 1_500_000, 3_000_000, 6_000_000)
"""actual steps after which trainings are looked at"""
LOOKS_ON_RAMPS = (28_800,)
"""the same on the on-ramp, whose trainings with the model are as long"""
TIMES = (1, 2, 3)
"""how many times the actual steps the method may take without the model"""
WITHOUT = {
    "eight": ("eight-few", "eight-middle", "best-in-batches"),
    "ramp": ("ramp-few",) * len(TIMES) + ("ramp-small",) * len(TIMES),
}
"""who is without it: with few steps, with twice as many, with all; on the on-ramp two go so far"""


def compared_with(prefix: str) -> tuple[str, ...]:
    """Return the variant whose names begin with `prefix` that has the model, and who is without, by `TIMES`.

    On figures eight, which a batch steps in distribution alone, the last is trained in batches, too.
    """
    return (f"{prefix}-imagined", *WITHOUT.get(prefix, (f"{prefix}-few", f"{prefix}-middle", "best")))


def efficiency(road: str, compared: Sequence[str], looks: Sequence[int], folder: Path) -> pd.DataFrame:
    """Return what trainings earn on the validation seeds after so many actual steps, and what more it is.

    Of the variants that are compared the first has the model.
    """
    curves, (modelled, *others) = read_part(folder, "curves")[road], compared
    seen = {name: partial(_returns, curves[name], _first_look(road, name)) for name in compared}
    names = [f"{steps:,}" for steps in looks]
    rows = [
        _row(VARIANTS[name].label, names, [at_each(at) for at in looks]) for name, at_each in seen.items()
    ]
    for name, times in zip(others, cycle(TIMES)):
        beyond = [seen[modelled](at) - seen[name](times * at) for at in looks]
        more = "as many" if times == 1 else f"{times} times as many"
        label = f"with the model beyond “{VARIANTS[name].label}” after {more}"
        rows.append(_row(label, names, beyond, "+"))
    return pd.DataFrame(rows)


def _first_look(road: str, variant: str) -> int:
    """Return after how many steps a training is validated for the first time."""
    config = PlannedRun(road, variant, 0).config
    return config.learner.batch_steps * (config.evaluation.every or 1)


def _returns(curve: dict[str, list[float]], first: int, steps: int) -> Floats:
    """Return what each training earns after so many steps; NaN before it is validated and after its end."""
    trainings = curve["return_validation"]
    if steps < first:
        return np.full(len(trainings), np.nan)
    return np.array([np.interp(steps, curve["steps"], each, np.nan, np.nan) for each in trainings])


def _row(label: str, names: Sequence[str], columns: list[Floats], sign: str = "") -> dict[str, str]:
    cells = [str(cell_of(over_trainings(values.tolist()), 0, sign=sign)) for values in columns]
    return {"": label, **dict(zip(names, cells, strict=True))}


def imagined(road: str, prefix: str, looks: Sequence[int] = LOOKS) -> Study:
    """Return the study of a road and of its variants whose names begin with `prefix`."""
    compared = compared_with(prefix)
    title = f"what a model of the whole road saves, on the {road}"
    study = comparison_of(title, tuple(dict.fromkeys(compared)), road)
    return replace(study, tables={**study.tables, "efficiency": partial(efficiency, road, compared, looks)})
