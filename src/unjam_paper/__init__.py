"""The studies of `unjam reproduce`: the paper's tables and figures."""

from unjam.training.road_family import ALL_ROADS_GROUP, SHARED_RINGS_GROUP
from unjam_paper.adaptation import ADAPTATION
from unjam_paper.all_roads import ALL_ROADS_STUDY, FAMILY_TEST_SEEDS
from unjam_paper.comparison import FIGURE_5, comparison_study
from unjam_paper.do_no_harm import DO_NO_HARM
from unjam_paper.envelope import ENVELOPE
from unjam_paper.feasible import FEASIBLE_FIGURE_EIGHT, FEASIBLE_RING, FEASIBLE_RING_JAMMED
from unjam_paper.figure_6 import FIGURE_6
from unjam_paper.joint_training import (
    ALL_ROADS_BASELINES,
    FRESH_TEST_SEEDS,
    SHARED_RING_BASELINES,
    SHARED_RING_ROADS,
    joint_training_study,
)
from unjam_paper.on_ramp import on_ramp_study
from unjam_paper.paper_exact import paper_exact_study
from unjam_paper.road_model import ON_RAMP_EFFICIENCY_STEPS, road_model_study
from unjam_paper.robustness import FIGURE_10, ROBUSTNESS
from unjam_paper.study import PAPER_ROADS, Study
from unjam_paper.theory import FIGURE_8, THEORY

TABLE_1_STUDIES: dict[str, Study] = {
    f"table-1-{road}": comparison_study(
        f"TRPO, PPO, SAC, the proposed method and ours on {road}",
        ("trpo", "ppo", "sac", "proposed", "without-model", "ours"),
        road,
    )
    for road in PAPER_ROADS
}
PAPER_EXACT_STUDIES = {f"to-the-letter-{road}": paper_exact_study(road) for road in PAPER_ROADS}
STUDIES: dict[str, Study] = {
    **TABLE_1_STUDIES,
    "figure-5": FIGURE_5,
    "table-2": comparison_study(
        "what each part of the method is worth, on the ring",
        ("trpo", "mb-trpo", "no-initial-policy", "without-model", "proposed", "ours-without-model", "ours"),
    ),
    "figure-6": FIGURE_6,
    "figure-8": FIGURE_8,
    "figure-9": comparison_study(
        "PPO and SAC within the framework, on the ring",
        ("ppo", "sac", "proposed-ppo", "proposed-sac", "proposed", "without-model"),
    ),
    "figure-10": FIGURE_10,
    "theory": THEORY,
    "imagined": road_model_study("ring", "best"),
    "imagined-jammed": road_model_study("ring-jammed", "jammed"),
    "imagined-eight": road_model_study("figure-eight", "eight"),
    "imagined-ramp": road_model_study("on-ramp", "ramp", ON_RAMP_EFFICIENCY_STEPS),
    "eq16": comparison_study(
        "Eq. 16 as it is printed and as it is meant, on the ring",
        ("trpo-eq16", "trpo-as-printed", "proposed-eq16", "proposed-as-printed"),
    ),
    **PAPER_EXACT_STUDIES,
    "robustness": ROBUSTNESS,
    "drivable": FEASIBLE_RING,
    "drivable-eight": FEASIBLE_FIGURE_EIGHT,
    "drivable-jammed": FEASIBLE_RING_JAMMED,
    "on-ramp-trained": on_ramp_study({"ramp-long": "residual on the one tuned longer"}),
    "on-ramp-in-turn": on_ramp_study({"ramp-in-turn": "residual on unjam:on-ramp-tuned, learned in turn"}),
    "envelope": ENVELOPE,
    "do-no-harm": DO_NO_HARM,
    "everywhere": ALL_ROADS_STUDY,
    "adaptation": ADAPTATION,
    "rings": joint_training_study(
        "what one residual, trained on all rings of the family together, gains on each", {"rings": 10}
    ),
    "shared-rings": joint_training_study(
        "what is tuned and what is learned where several CAVs share a ring, seen and new",
        {"shared-rings": 10},
        *(SHARED_RINGS_GROUP, SHARED_RING_BASELINES, SHARED_RING_ROADS, FRESH_TEST_SEEDS),
    ),
    "rings-alone": joint_training_study(
        "what TRPO and PPO gain on the rings of the family without an expert", {"rings-trpo": 5, "rings-ppo": 5}
    ),
    "everywhere-trained": joint_training_study(
        "what one residual, and TRPO and PPO without an expert, gain on all roads of the family",
        {"everywhere": 10, "everywhere-trpo": 5, "everywhere-ppo": 5},
        *(ALL_ROADS_GROUP, ALL_ROADS_BASELINES, None, FAMILY_TEST_SEEDS[:5]),  # of each of twenty trainings
    ),
}
"""every study by name"""

STUDY_GROUPS: dict[str, tuple[str, ...]] = {
    "table-1": tuple(TABLE_1_STUDIES),
    "figure-4": tuple(TABLE_1_STUDIES),
    "figure-7": ("table-2",),
    "to-the-letter": tuple(PAPER_EXACT_STUDIES),
    "all": tuple(STUDIES),
}
"""names of the paper for one study or several: figures are drawn with their table, of the same trainings"""
