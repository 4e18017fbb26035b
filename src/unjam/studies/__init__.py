"""The studies of `unjam reproduce`: the paper's tables and figures."""

from unjam.studies.adaptation import ADAPTATION
from unjam.studies.comparison import FIGURE_5, comparison_of
from unjam.studies.do_no_harm import DO_NO_HARM
from unjam.studies.drivable import (
    DRIVABLE_EIGHT,
    DRIVABLE_JAMMED,
    DRIVABLE_STUDY,
)
from unjam.studies.envelope import ENVELOPE
from unjam.studies.everywhere import EVERYWHERE_STUDY, JUDGING
from unjam.studies.figure_6 import FIGURE_6
from unjam.studies.imagined import LOOKS_ON_RAMPS, imagined
from unjam.studies.ramp_trained import ramp_trained
from unjam.studies.roads_together import (
    BESIDE_EVERYWHERE,
    BESIDE_SHARED,
    FRESH,
    SHARED,
    trained_together,
)
from unjam.studies.robustness import FIGURE_10, ROBUSTNESS
from unjam.studies.study import PAPERS_ROADS, Study
from unjam.studies.theory import FIGURE_8, THEORY
from unjam.studies.to_the_letter import to_the_letter
from unjam.training.family import ALL_ROADS, SHARED_RINGS

TABLE_1: dict[str, Study] = {
    f"table-1-{road}": comparison_of(
        f"TRPO, PPO, SAC, the proposed method and ours on {road}",
        ("trpo", "ppo", "sac", "proposed", "without-model", "ours"),
        road,
    )
    for road in PAPERS_ROADS
}
LETTER = {f"to-the-letter-{road}": to_the_letter(road) for road in PAPERS_ROADS}
STUDIES: dict[str, Study] = {
    **TABLE_1,
    "figure-5": FIGURE_5,
    "table-2": comparison_of(
        "what each part of the method is worth, on the ring",
        ("trpo", "mb-trpo", "no-initial-policy", "without-model", "proposed", "ours-without-model", "ours"),
    ),
    "figure-6": FIGURE_6,
    "figure-8": FIGURE_8,
    "figure-9": comparison_of(
        "PPO and SAC within the framework, on the ring",
        ("ppo", "sac", "proposed-ppo", "proposed-sac", "proposed", "without-model"),
    ),
    "figure-10": FIGURE_10,
    "theory": THEORY,
    "imagined": imagined("ring", "best"),
    "imagined-jammed": imagined("ring-jammed", "jammed"),
    "imagined-eight": imagined("figure-eight", "eight"),
    "imagined-ramp": imagined("on-ramp", "ramp", LOOKS_ON_RAMPS),
    "eq16": comparison_of(
        "Eq. 16 as it is printed and as it is meant, on the ring",
        ("trpo-eq16", "trpo-as-printed", "proposed-eq16", "proposed-as-printed"),
    ),
    **LETTER,
    "robustness": ROBUSTNESS,
    "drivable": DRIVABLE_STUDY,
    "drivable-eight": DRIVABLE_EIGHT,
    "drivable-jammed": DRIVABLE_JAMMED,
    "on-ramp-trained": ramp_trained({"ramp-long": "residual on the one tuned longer"}),
    "on-ramp-in-turn": ramp_trained({"ramp-in-turn": "residual on unjam:on-ramp-tuned, learned in turn"}),
    "envelope": ENVELOPE,
    "do-no-harm": DO_NO_HARM,
    "everywhere": EVERYWHERE_STUDY,
    "adaptation": ADAPTATION,
    "rings": trained_together(
        "what one residual, trained on all rings of the family together, gains on each", {"rings": 10}
    ),
    "shared-rings": trained_together(
        "what is tuned and what is learned where several CAVs share a ring, seen and new",
        {"shared-rings": 10},
        *(SHARED_RINGS, BESIDE_SHARED, SHARED, FRESH),
    ),
    "rings-alone": trained_together(
        "what TRPO and PPO gain on the rings of the family without an expert",
        {"rings-trpo": 5, "rings-ppo": 5},
    ),
    "everywhere-trained": trained_together(
        "what one residual, and TRPO and PPO without an expert, gain on all roads of the family",
        {"everywhere": 10, "everywhere-trpo": 5, "everywhere-ppo": 5},
        *(ALL_ROADS, BESIDE_EVERYWHERE, None, JUDGING[:5]),  # of each of twenty trainings
    ),
}
"""every study by name"""

TOGETHER: dict[str, tuple[str, ...]] = {
    "table-1": tuple(TABLE_1),
    "figure-4": tuple(TABLE_1),
    "figure-7": ("table-2",),
    "to-the-letter": tuple(LETTER),
    "all": tuple(STUDIES),
}
"""names of the paper for one study or several: figures are drawn with their table, of the same trainings"""
