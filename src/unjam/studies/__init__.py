"""The studies of `unjam reproduce`: the paper's tables and figures."""

from unjam.studies.comparison import FIGURE_9, JAMMED, LONG, ON_EXPERTS, TABLE_1, TABLE_2
from unjam.studies.figure_5 import FIGURE_5
from unjam.studies.figure_6 import run as run_figure_6
from unjam.studies.figure_8 import FIGURE_8
from unjam.studies.figure_10 import FIGURE_10
from unjam.studies.robustness import ROBUSTNESS
from unjam.studies.study import Study
from unjam.studies.theory import THEORY

FIGURE_6 = Study(
    "networks that learn how people drive, with knowledge and without",
    lambda seeds: [],
    lambda pool, seeds, folder, workers: run_figure_6(folder, workers),
    minutes=25.0,
)

STUDIES: dict[str, Study] = {
    **TABLE_1,
    "figure-5": FIGURE_5,
    "table-2": TABLE_2,
    "figure-6": FIGURE_6,
    "figure-8": FIGURE_8,
    "figure-9": FIGURE_9,
    "figure-10": FIGURE_10,
    "theory": THEORY,
    "long": LONG,
    "on-experts": ON_EXPERTS,
    "jammed": JAMMED,
    "robustness": ROBUSTNESS,
}
"""every study by name"""

TOGETHER: dict[str, tuple[str, ...]] = {
    "table-1": tuple(TABLE_1),
    "figure-4": tuple(TABLE_1),
    "figure-7": ("table-2",),
    "all": tuple(STUDIES),
}
"""names of the paper for one study or several: figures are drawn with their table, of the same trainings"""
