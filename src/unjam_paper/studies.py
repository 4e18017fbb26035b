"""All studies by name, and the names of the paper's tables and figures."""

from unjam.road_family import ALL_ROADS_GROUP, SHARED_RINGS_GROUP
from unjam_paper import all_roads
from unjam_paper.adaptation import ADAPTATION
from unjam_paper.assess_examples import ASSESS_EXAMPLES
from unjam_paper.comparison import FIGURE_5, comparison_study, paper_exact_study, road_model_study
from unjam_paper.do_no_harm import DO_NO_HARM
from unjam_paper.envelope import ENVELOPE
from unjam_paper.feasible import feasible_study, on_ramp_study
from unjam_paper.figure_6 import FIGURE_6
from unjam_paper.fuel import FUEL
from unjam_paper.human_traffic import HUMAN_TRAFFIC_STUDY
from unjam_paper.information_ahead import INFORMATION_AHEAD
from unjam_paper.motorway_benchmark import MOTORWAY_BENCHMARK
from unjam_paper.motorway_ensemble import MOTORWAY_ENSEMBLE
from unjam_paper.recorded_gaps import RECORDED_GAPS
from unjam_paper.recorded_roads import RECORDED_ROADS
from unjam_paper.robustness import FIGURE_10, FIGURE_10_UNFILTERED, ROBUSTNESS
from unjam_paper.string_stability import STRING_STABILITY
from unjam_paper.study import PAPER_ROADS, UNFILTERED_ROADS, UNSCALED_NOISE_ROAD, Study
from unjam_paper.theory import FIGURE_8, theory_study
from unjam_paper.variants import WRONG_BASES

TABLE_1_VARIANTS = ("trpo", "ppo", "sac", "proposed", "without-model", "ours")
TABLE_2_VARIANTS = ("trpo", "mb-trpo", "no-initial-policy", "without-model", "proposed", "ours-without-model", "ours")
FIGURE_9_VARIANTS = ("ppo", "sac", "proposed-ppo", "proposed-sac", "proposed", "without-model")
TABLE_1_TITLE = "TRPO, PPO, SAC, the proposed method and an unjam residual on"
TABLE_2_TITLE = "contribution of each part of the method, on the ring"
FIGURE_9_TITLE = "PPO and SAC within the framework, on the ring"
THEORY_TITLE = "measurable quantities of the theorems A1, A2 and A3"
TABLE_1_STUDIES = {
    f"table-1-{road}": comparison_study(f"{TABLE_1_TITLE} {road}", TABLE_1_VARIANTS, road) for road in PAPER_ROADS
}
RING, FIGURE_EIGHT = UNFILTERED_ROADS["ring"], UNFILTERED_ROADS["figure-eight"]
UNFILTERED_STUDIES = {
    **{
        f"table-1-{road}": comparison_study(f"{TABLE_1_TITLE} {road}", TABLE_1_VARIANTS, road)
        for road in (RING, FIGURE_EIGHT)
    },
    **{
        f"proposed-{road}": comparison_study(f"TRPO and the proposed method on {road}", ("trpo", "proposed"), road)
        for road in (RING, FIGURE_EIGHT)
    },
    "table-2-unfiltered": comparison_study(f"{TABLE_2_TITLE}, without the safety filter", TABLE_2_VARIANTS, RING),
    "table-2-unscaled-noise": comparison_study(
        f"{TABLE_2_TITLE}, without the safety filter, noise not scaled", TABLE_2_VARIANTS, UNSCALED_NOISE_ROAD
    ),
    "figure-9-unfiltered": comparison_study(f"{FIGURE_9_TITLE}, without the safety filter", FIGURE_9_VARIANTS, RING),
    "theory-unfiltered": theory_study(f"{THEORY_TITLE}, without the safety filter", RING, (RING, FIGURE_EIGHT)),
    "figure-10-unfiltered": FIGURE_10_UNFILTERED,
}
"""studies of the tables and figures without the safety filter, as in the paper; merges never have a filter"""
PAPER_EXACT_STUDIES = {
    **{f"to-the-letter-{road}": paper_exact_study(UNFILTERED_ROADS.get(road, road)) for road in PAPER_ROADS},
    **{f"to-the-letter-{road}-filtered": paper_exact_study(road) for road in ("ring", "figure-eight")},
}
STUDIES: dict[str, Study] = {
    **TABLE_1_STUDIES,
    "figure-5": FIGURE_5,
    "table-2": comparison_study(TABLE_2_TITLE, TABLE_2_VARIANTS),
    "figure-6": FIGURE_6,
    "figure-8": FIGURE_8,
    "figure-9": comparison_study(FIGURE_9_TITLE, FIGURE_9_VARIANTS),
    "figure-10": FIGURE_10,
    "theory": theory_study(THEORY_TITLE, "ring", PAPER_ROADS),
    "road-model": road_model_study("ring", "best"),
    "road-model-wrong-base": comparison_study(
        "environment steps that a model of the whole ring saves where its human drivers are wrong",
        tuple(f"best-road-model-{name}" for name in WRONG_BASES),
    ),
    "road-model-jammed": road_model_study("ring-jammed", "jammed"),
    "road-model-figure-eight": road_model_study("figure-eight", "eight"),
    "road-model-on-ramp": road_model_study("on-ramp", "ramp"),
    "eq16": comparison_study(
        "Eq. 16 as printed and as intended, on the ring",
        ("trpo-eq16", "trpo-as-printed", "proposed-eq16", "proposed-as-printed"),
    ),
    **PAPER_EXACT_STUDIES,
    **UNFILTERED_STUDIES,
    "robustness": ROBUSTNESS,
    "human-traffic": HUMAN_TRAFFIC_STUDY,
    "motorway-ensemble": MOTORWAY_ENSEMBLE,
    "motorway-benchmark": MOTORWAY_BENCHMARK,
    "feasible-ring": feasible_study(
        "feasible residual compared with tuned experts in usual cars, on the ring and the jammed ring",
        {"ring-usual-car": "best", "ring-jammed-usual-car": "best"},
        minutes=20.0,
    ),
    "feasible-ring-ideal": feasible_study(
        "feasible residual compared with tuned experts in ideal cars, on the ring and the jammed ring",
        {"ring": "best", "ring-jammed": "jammed-ideal"},
        minutes=20.0,
    ),
    "feasible-figure-eight": feasible_study(
        "feasible residual compared with tuned experts in usual cars, on the figure eight",
        {"figure-eight-usual-car": "best"},
        minutes=5.0,
    ),
    "feasible-figure-eight-ideal": feasible_study(
        "feasible residual compared with tuned experts in ideal cars, on the figure eight",
        {"figure-eight": "eight-ideal"},
        minutes=5.0,
    ),
    "on-ramp-trained": on_ramp_study({"ramp-long": "residual on the expert tuned with the larger budget"}),
    "on-ramp-alternating": on_ramp_study({"ramp-alternating": "residual on unjam:on-ramp-tuned, alternating updates"}),
    "envelope": ENVELOPE,
    "fuel": FUEL,
    "string-stability": STRING_STABILITY,
    "recorded-roads": RECORDED_ROADS,
    "recorded-gaps": RECORDED_GAPS,
    "information-ahead": INFORMATION_AHEAD,
    "do-no-harm": DO_NO_HARM,
    "assess-examples": ASSESS_EXAMPLES,
    "all-roads": all_roads.ALL_ROADS_STUDY,
    "adaptation": ADAPTATION,
    "rings": all_roads.joint_training_study(
        "gain of one residual, trained on all rings of the family, on each ring", {"rings": 10}
    ),
    "shared-rings": all_roads.joint_training_study(
        "tuned and learned controllers where several CAVs share a ring, training rings and unseen rings",
        {"shared-rings": 10},
        *(SHARED_RINGS_GROUP, all_roads.SHARED_RING_BASELINES, all_roads.SHARED_RING_ROADS, all_roads.FRESH_TEST_SEEDS),
    ),
    "rings-single": all_roads.joint_training_study(
        "gain of TRPO and PPO without an expert on the rings of the family", {"rings-trpo": 5, "rings-ppo": 5}
    ),
    "all-roads-trained": all_roads.joint_training_study(
        "gain of one residual, and of TRPO and PPO without an expert, on all roads of the family",
        {"all-roads": 10, "all-roads-trpo": 5, "all-roads-ppo": 5},
        # five seeds for each of twenty trainings
        *(ALL_ROADS_GROUP, all_roads.ALL_ROADS_BASELINES, None, all_roads.FAMILY_TEST_SEEDS[:5]),
    ),
}
STUDY_GROUPS: dict[str, tuple[str, ...]] = {
    "table-1": tuple(TABLE_1_STUDIES),
    "figure-4": tuple(TABLE_1_STUDIES),
    "figure-7": ("table-2",),
    "to-the-letter": tuple(PAPER_EXACT_STUDIES),
    "unfiltered": tuple(UNFILTERED_STUDIES),
    "all": tuple(STUDIES),
}
"""names of groups of studies, and other names of a study; figures 4 and 7 are drawn with tables 1 and 2"""
