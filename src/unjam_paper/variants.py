"""Reference drivers that do not learn, and variants of training: those of the paper with its settings, and of unjam."""

from dataclasses import dataclass, replace
from typing import Any

from unjam.models.settings import ModelSettings

STEP_BUDGET, MILLION_STEPS, PAPER_STEP_BUDGET = 300_000, 1_000_000, 4_000_000
"""environment steps of a training: usually, where a million takes less than an hour, and in the authors' code"""
RINGS_EXPERT, SHARED_RINGS_EXPERT = "unjam:rings-tuned", "unjam:shared-rings-tuned"
"""best experts for all rings of the family, and for rings that several CAVs share"""
JAMMED_IDEAL: dict[str, Any] = {
    "expert": "unjam:ring-jammed-tuned-ideal",
    **{"policy.exploration_std": 0.013, "trpo.target_kl": 0.0086},
}
"""changes to the preset `best`, which is for usual cars, for ideal cars on the jammed ring"""
ON_RAMP_JAM_AHEAD = (
    "jam-ahead:first_section=3,last_section=4,speed_margin=-1.536,margin_by_penetration=19.83,min_speed=2.568,"
    "max_deceleration=1.106,time_constant=1.681"
)
"""result of `unjam tune on-ramp --expert jam-ahead --set penetration_rate=0.05 --steps 4608000`, mostly in batches;
the result of 710,400 steps, all in SUMO, is `unjam:on-ramp-tuned`"""


@dataclass(frozen=True)
class Variant:
    """A variant of training: a preset, and changes to it."""

    label: str
    preset: str
    changes: dict[str, Any]
    steps: int | None = STEP_BUDGET
    """None: the steps of the preset"""
    paper_variant: str = ""
    """name of the variant in the tables of the paper; empty: the name of this variant"""


def reduced_step_variants(
    prefix: str, batch_steps: int, steps: int, horizon: int = 3000, **common: Any
) -> dict[str, Variant]:
    """Return variants of `best` with few steps, with twice as many, and with few steps and a model of the road.

    With the model, seven eighths of each iteration are model steps, in episodes of `horizon` control steps.
    """
    few = {"backend": "batch", **common, "trpo.steps_per_iteration": batch_steps}
    double = {**few, "trpo.steps_per_iteration": 2 * batch_steps}
    model = {"model.model_ratio": 7.0, "model.kind": "road", "model.rollout_starts": "first", "model.k_max": horizon}
    return {
        f"{prefix}-few": Variant("unjam residual, few steps", "best", few, steps),
        f"{prefix}-double": Variant("unjam residual, double steps", "best", double, 2 * steps),
        f"{prefix}-road-model": Variant("unjam residual, few steps and road model", "best", {**few, **model}, steps),
    }


BEST_VARIANTS = reduced_step_variants("best", 12_000, 756_000)
ROAD_MODEL = BEST_VARIANTS["best-road-model"]
WRONG_BASES: dict[str, tuple[str, dict[str, Any]]] = {
    "slow": ("other IDM parameters", {"model.humans": {"time_headway": 1.5, "max_acceleration": 2.0}}),
    "ovm": ("OVM", {"model.base": "ovm"}),
    "no-base": ("nothing", {"model.base": "none"}),
}
"""labels and settings of bases of the road model that differ from the human drivers of the simulator, which have a time
headway of 1 s and accelerate with 1 m/s2; with the other IDM parameters no waves arise"""
NO_MODEL = {
    **{f"model.{name}": getattr(ModelSettings, name) for name in ("kind", "rollout_starts", "k_max", "update_mode")},
    "model.model_ratio": 0.0,
}
WEAK_EXPERT = {"expert": "jam-ahead:speed_margin=2,margin_by_penetration=0", "backend": "sumo"}
"""changes for an expert without effect on the on-ramp, since the tuned one leaves little to learn"""
ON_RAMP_VARIANTS = reduced_step_variants("ramp", 9_600, 86_400, horizon=2400, **WEAK_EXPERT, **NO_MODEL)
SMALL_ITERATIONS = {
    **ON_RAMP_VARIANTS["ramp-few"].changes,
    **{"trpo.steps_per_iteration": 4_800, "evaluation.validation_interval": 6},
}
"""changes for twice as many updates with the same steps; alternating updates need three times the steps for them"""
LONG_TRAINING = {
    **{"expert": ON_RAMP_JAM_AHEAD, "backend": "batch", "trpo.steps_per_iteration": 153_600, **NO_MODEL},
    **{"evaluation.validation_interval": 10, "evaluation.validation_episodes": 128},
}
NO_EXPERT = {"expert": "none", "model.model_ratio": 0.0}
NO_EARLY_STOPPING = {"evaluation.convergence_window": 0}
TWO_EPISODES_PER_ROAD = {"evaluation.episodes": 2}
"""few, since the studies evaluate the controllers again, on training roads and unseen roads"""
FROM_SCRATCH = {
    **{"expert": "none", "policy.exploration_std": 0.5, **TWO_EPISODES_PER_ROAD},
    **{f"{agent}.steps_per_iteration": 60_000 for agent in ("trpo", "ppo")},
    **{f"{agent}.gamma": 0.99 for agent in ("trpo", "ppo")},
    **{"trpo.target_kl": 0.01, "ppo.epochs": 20},
    **{"evaluation.validation_interval": 5, "evaluation.validation_episodes": 4},
}
"""changes for learning without an expert on many roads; with the exploration of a residual, CAVs learn to stand"""
EXACT_VERSIONS: tuple[tuple[str, dict[str, Any], int], ...] = (
    *(("", {}, PAPER_STEP_BUDGET), ("-filtered", {"scenario_options.safety.active": True}, PAPER_STEP_BUDGET)),
    ("-million", {}, MILLION_STEPS),
)
"""variants with the exact settings of the paper: suffix of the name, changes and environment steps"""
EXACT_TRPO = {**NO_EXPERT, **NO_EARLY_STOPPING}
PPO_AGENT, SAC_AGENT = {"agent": "ppo"}, {"agent": "sac"}
VARIANTS: dict[str, Variant] = {
    "trpo": Variant("TRPO", "paper", NO_EXPERT),
    "ppo": Variant("PPO", "paper", {**PPO_AGENT, **NO_EXPERT}),
    "sac": Variant("SAC", "paper", {**SAC_AGENT, **NO_EXPERT}),
    "mb-trpo": Variant("MB-TRPO", "paper", {"expert": "none", "model.base": "none"}),
    "no-initial-policy": Variant("no initial policy", "paper", {"expert": "none"}),
    "without-model": Variant("residual without model", "paper", {"model.model_ratio": 0.0}),
    "proposed": Variant("proposed", "paper", {}),
    "proposed-ppo": Variant("proposed with PPO", "paper", PPO_AGENT),
    "proposed-sac": Variant("proposed with SAC", "paper", SAC_AGENT),
    "trpo-eq16": Variant("TRPO, Eq. 16 as meant", "paper", {**NO_EXPERT, "reward": "eq16"}),
    "trpo-as-printed": Variant("TRPO, Eq. 16 as printed", "paper", {**NO_EXPERT, "reward": "eq16-as-printed"}),
    "proposed-eq16": Variant("proposed, Eq. 16 as meant", "paper", {"reward": "eq16"}),
    "proposed-as-printed": Variant("proposed, Eq. 16 as printed", "paper", {"reward": "eq16-as-printed"}),
    **{
        f"{name}-exact{suffix}": Variant(label, "paper-exact", {**changes, **filter_changes}, steps, name)
        for suffix, filter_changes, steps in EXACT_VERSIONS
        for name, label, changes in (("trpo", "TRPO", EXACT_TRPO), ("proposed", "proposed", NO_EARLY_STOPPING))
    },
    "ours": Variant("unjam residual", "quick", {}),
    "ours-without-model": Variant("unjam residual without model", "quick", {"model.model_ratio": 0.0}),
    "best": Variant("unjam residual, all steps", "best", {}, None),
    "jammed-ideal": Variant("unjam residual, all steps", "best", JAMMED_IDEAL, None),
    "eight-ideal": Variant("unjam residual, all steps", "best", {"backend": "sumo"}, None),
    **BEST_VARIANTS,
    **{
        f"best-road-model-{name}": replace(
            ROAD_MODEL, label=f"{ROAD_MODEL.label} on {base}", changes={**ROAD_MODEL.changes, **changes}
        )
        for name, (base, changes) in WRONG_BASES.items()
    },
    **reduced_step_variants("jammed", 24_000, 768_000, **JAMMED_IDEAL),
    **reduced_step_variants("eight", 6_000, 612_000, horizon=1500),
    **ON_RAMP_VARIANTS,
    "ramp-road-model": replace(ON_RAMP_VARIANTS["ramp-road-model"], changes=WEAK_EXPERT, steps=28_800),
    "ramp-alternating": Variant("unjam residual, alternating updates", "best", {}, None),
    "ramp-long": Variant("unjam residual, expert tuned with the larger budget", "best", LONG_TRAINING, 4_608_000),
    "ramp-small": Variant("unjam residual, few steps in small iterations", "best", SMALL_ITERATIONS, 86_400),
    "best-in-batches": Variant("unjam residual, all steps", "best", {"backend": "batch"}, None),
    **{name: Variant("residual", name, TWO_EPISODES_PER_ROAD, None) for name in ("rings", "shared-rings", "all-roads")},
    "rings-trpo": Variant("TRPO", "rings", FROM_SCRATCH, 1_200_000),
    "rings-ppo": Variant("PPO", "rings", {**PPO_AGENT, **FROM_SCRATCH}, 1_200_000),
    "all-roads-trpo": Variant("TRPO", "all-roads", FROM_SCRATCH, MILLION_STEPS),
    "all-roads-ppo": Variant("PPO", "all-roads", {**PPO_AGENT, **FROM_SCRATCH}, MILLION_STEPS),
}
REFERENCE_DRIVERS: dict[str, str] = {
    **{"human": "human", "zero": "constant", "constant +0.1": "constant:acceleration=0.1"},
    **{"PI (paper)": "pi:time_constant=0", "PI": "pi", "FollowerStopper": "follower-stopper"},
    **{"IDM": "idm", "ACC": "acc", "LACC": "lacc", "BCM": "bcm", "OVM": "ovm"},
    **{"pacer": "pacer", "varying pacer": "pacer:use_tuned=true"},
    "gentle varying pacer": "pacer:use_tuned=true,time_constant=1",
    "jam absorber": "jam-absorber",
    "closing jam absorber": "jam-absorber:gap_gain=0,extra_acceleration=0.9,speed_gain=0.8",
}
"""drivers for all roads: names as in `unjam drive`, by label; the last one is the best expert on the merge"""
TUNED_REFERENCES: dict[str, dict[str, str]] = {
    "ring": {"tuned PI": "unjam:ring-tuned", "tuned gap PI": "unjam:ring-gap-tuned"},
    "ring-jammed": {"tuned gap PI": "unjam:ring-jammed-tuned-ideal"},
    "ring-5": {
        "tuned jam absorber": "jam-absorber:gap_gain=0.2656,speed_gain=0.9472,time_gap=0.7288,"
        "standstill_gap=8.556,extra_acceleration=0.4562"
    },
    "ring-11": {
        "tuned jam absorber": "jam-absorber:gap_gain=0.4263,speed_gain=1.443,time_gap=0.7305,"
        "standstill_gap=4.266,extra_acceleration=0.09394"
    },
    "figure-eight": {
        "tuned pacer": "pacer:lap_time=88.83,gap_gain=0.006993,target_gap=0.4577,time_constant=0.2108",
        "tuned varying pacer": "unjam:figure-eight-tuned-ideal",
    },
    "on-ramp": {"tuned jam-ahead": "unjam:on-ramp-tuned"},
}
"""drivers that `unjam tune` found with at least the steps of a training (results/tuned.json), by road; on the merge no
setting is feasible, so none is tuned"""
NON_EXPERTS = ("human", "zero", "constant +0.1")
"""reference drivers to which no residual is added"""
