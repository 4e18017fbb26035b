"""Named starting points of a training run: what differs from the defaults, and why."""

from typing import Any

from unjam.errors import invalid_value, unknown_name
from unjam.parameters import merge_changes
from unjam.scenarios.ring import LoopScenario
from unjam.scenarios.scenario import Scenario
from unjam.training.road_family import ALL_ROADS_GROUP, FAMILY, SHARED_RINGS_GROUP, family_scenarios

PRESETS: dict[str, dict[str, Any]] = {
    # What the paper says, where it says something: Tables B2 to B5, section 4.1.
    "paper": {
        "expert": "pi:time_constant=0",
        "steps": 4_000_000,
        "stratified": False,
        "policy": {
            "inputs": ["local"],
            "exploration_std": 1.0,
            "action_duration": 0,
            "privileged_critic": False,
            "normalize_value": False,
        },
        "trpo": {"steps_per_iteration": 6000, "gamma": 0.995, "target_kl": 0.01},
        "ppo": {
            "steps_per_iteration": 6000,
            "gamma": 0.99,
            "clip_range": 0.2,
            "epochs": 80,
            "actor_learning_rate": 3e-4,
            "critic_learning_rate": 1e-3,
        },
        "sac": {
            "gamma": 0.99,
            "tau": 5e-3,
            "learning_rate": 3e-4,
            "temperature": 0.2,
            "learn_temperature": False,
            "reward_scale": 1.0,
            "batch_size": 256,
            "learning_starts": 10_000,
            "start_policy": "uniform",
        },
        "model": {"k_max": 500, "kappa": 2.0, "model_ratio": 1.0},
    },
    # Also where it says less, as it would have been done: one network as it was drawn, whose mean is taken,
    # no best of several looks, and an end where nothing gets better.
    "paper-exact": {},
    # Ends within about five minutes on two cores, evaluation included.
    "demo": {"steps": 300_000, "evaluation": {"validation_interval": 2}},
}

PRESETS["paper-exact"] = merge_changes(
    PRESETS["paper"],
    {
        "policy": {"zero_init": False},
        "model": {"members": 1, "fallback_to_base": False, "add_noise": False, "error_estimator": "transitions"},
        "evaluation": {"validation_interval": 0, "convergence_window": 50},
    },
)

RINGS_EXPERT = "unjam:rings-tuned"
"""the expert that gets furthest on all rings of the family together"""
SHARED_RINGS_EXPERT = "unjam:shared-rings-tuned"
"""the expert that gets furthest where several CAVs share a ring"""
BRAKING_COST = 0.0075
"""weight of the acceleration's term where the speed's is such that the limit earns 1"""


ON_RAMP_TASK_WEIGHT = 0.3333
"""of a task: an episode there has as many CAVs as twenty on rings, and takes as long"""


def _family_task(name: str, scenario: Scenario) -> dict[str, Any]:
    """Return a road of the family as a task; on loops one earns the share of what people could drive."""
    reward = ""
    if isinstance(scenario, LoopScenario):
        limits = [scenario.limit_speed(size) for size in scenario.drawn_ranges[scenario.size_parameter]]
        speed = round(5.0 * len(limits) / sum(limits), 4)
        reward = f"released:speed={speed},acceleration={BRAKING_COST}"
    found = {"scenario": FAMILY[name].scenario, "scenario_options": FAMILY[name].options, "reward": reward, "name": name}
    return found if isinstance(scenario, LoopScenario) else {**found, "weight": ON_RAMP_TASK_WEIGHT}


# One residual for all rings of the family that may be seen. An iteration has four episodes of each, for the
# roads differ. Of six pilots, most of which differ in more than one setting, this one got furthest for its
# steps in validation: results/tried/rings-settings.json. What helps a wave to dissolve pays for minutes.
PRESETS["rings"] = {
    "expert": RINGS_EXPERT,
    "steps": 4_800_000,
    "simulator": "batch",
    "policy": {"history_features": True},
    "trpo": {"steps_per_iteration": 120_000, "gamma": 0.996, "target_kl": 0.02},
    "ppo": {"steps_per_iteration": 120_000, "gamma": 0.996},
    "model": {"model_ratio": 0.0},
    "evaluation": {"validation_interval": 10, "validation_episodes": 8, "episodes": 10, "baselines": ["human", "pi"]},
    "tasks": [_family_task(name, ring) for name, ring in family_scenarios("rings", "training").items()],
}

# Where several CAVs share a ring: a residual on all rings helps them and harms one that is alone. On the law
# for all rings large iterations are the steadier ones; on the law that is tuned for shared rings nothing is
# left to learn: results/tried/shared-rings-settings.json, results/shared-rings.
PRESETS["shared-rings"] = merge_changes(
    PRESETS["rings"],
    {
        "expert": SHARED_RINGS_EXPERT,
        "steps": 1_440_000,
        "trpo": {"steps_per_iteration": 240_000},
        "ppo": {"steps_per_iteration": 240_000},
        "evaluation": {"validation_interval": 2, "validation_episodes": 16},
        "tasks": [_family_task(name, ring) for name, ring in family_scenarios(SHARED_RINGS_GROUP, "training").items()],
    },
)

# One residual for all roads of the family that may be seen, on the law for each: what such roads have in
# common is what the CAV sees next to it, and how many others there are.
PRESETS["all-roads"] = {
    "expert": "unjam:best",
    "steps": 1_000_000,
    "simulator": "batch",
    "policy": {"inputs": ["local", "expert_acceleration", "penetration_rate"]},
    "trpo": {"steps_per_iteration": 75_000, "gamma": 0.996, "target_kl": 0.01, "critic_batch_size": 1000},
    "ppo": {"steps_per_iteration": 75_000, "gamma": 0.996},
    "model": {"model_ratio": 0.0},
    "evaluation": {"validation_interval": 5, "validation_episodes": 4, "episodes": 10, "baselines": ["human"]},
    "tasks": [_family_task(name, road) for name, road in family_scenarios(ALL_ROADS_GROUP, "training").items()],
}

FIGURE_EIGHT_PACER = "pacer:use_tuned=true,gathering_speed=1.934,gathering_gap=0.445,regathering_gap=0.6469"
"""the expert that was tuned on the figure eight, but for its time constant"""

ON_RAMP_JAM_AHEAD = (
    "jam-ahead:first_section=3,last_section=4,speed_margin=-1.536,margin_by_penetration=19.83,min_speed=2.568,max_deceleration=1.106,time_constant=1.681"
)
"""what `unjam tune on-ramp --expert jam-ahead --set penetration_rate=0.05 --steps 4608000` finds, mostly in batches;
with 710,400 steps, all in SUMO, it is `unjam:on-ramp-tuned`"""

MERGE_JAM_ABSORBER = "jam-absorber:gap_gain=0,extra_acceleration=0.9,speed_gain=0.8"
"""the expert that gets furthest on the merge"""

EXPERT_INPUTS = ["local", "expert_acceleration", "expert_memory"]
"""features where what to add depends on what the expert is about"""

LOW_EXPLORATION = {"exploration_std": 0.015, "learn_exploration_std": False}
"""exploration that neither grows nor vanishes, on experts that much of it upsets"""
BEST_BY_SCENARIO: dict[str, dict[str, Any]] = {
    # Much of what is learned from few episodes is their noise: iterations are large, and the batch affords
    # them. More exploration makes another task of it: PI answers noise with braking. Less vanishes too soon.
    # The expert knows how to start; a residual on PI spends twice the steps on learning just that.
    "ring": {
        "steps": 6_000_000,
        "simulator": "batch",
        "expert": "unjam:ring-gap-tuned",
        "policy": {"history_features": True, **LOW_EXPLORATION},
        "trpo": {"steps_per_iteration": 96_000, "target_kl": 0.02},
        "model": {"model_ratio": 0.0},
        "evaluation": {"validation_interval": 5, "validation_episodes": 32},
    },
    # A wave that has grown: what ends it sooner may leave a slower flow for minutes, so it takes whole
    # episodes, and hardly any noise. Settings that a search found: results/tried/ring-jammed-search.
    "ring-jammed": {
        "steps": 6_000_000,
        "simulator": "batch",
        "expert": "unjam:ring-jammed-tuned",
        "policy": {"history_features": True, "exploration_std": 0.013, "learn_exploration_std": False, "action_duration": 2.1},
        "trpo": {"steps_per_iteration": 192_000, "target_kl": 0.0086, "gamma": 0.99, "gae_lambda": 0.966},
        "model": {"model_ratio": 0.0},
        "evaluation": {"validation_interval": 6, "validation_episodes": 32},
    },
    # The pacer alone holds the queue; the residual gathers it sooner. It needs room: with the time constant
    # that was tuned the pacer cancels whatever is added. What is done to gather them shows half a lap later,
    # and one episode in forty breaks the queue: what is better is seen in many, and goes on for long.
    "figure-eight": {
        "expert": f"{FIGURE_EIGHT_PACER},time_constant=1",
        "reward": "eq16",
        "steps": 4_860_000,
        "policy": {
            "inputs": [*EXPERT_INPUTS, "lap_position"],
            "history_features": True,
            "exploration_std": 0.2,
            "learn_exploration_std": False,
        },
        "trpo": {"steps_per_iteration": 45_000, "gamma": 0.998, "target_kl": 0.02},
        "model": {"model_ratio": 0.0},
        "evaluation": {"validation_interval": 6, "validation_episodes": 64},
    },
    # One CAV in twenty, whose commands all vanish in people's noise: an episode explores with one change for
    # all of them, and another with its opposite. What they did shows when they have left. Four episodes
    # tell little: seven times as many are imagined, and learned from in turn.
    "on-ramp": {
        "steps": 28_800,
        "scenario_options": {"penetration_rate": 0.05},
        "expert": "unjam:on-ramp-tuned",
        "policy": {
            "inputs": ["merge_proximity"],
            "exploration": "antithetic",
            "exploration_std": 0.12,
            "learn_exploration_std": False,
            "reward_after_exit": True,
            "action_duration": 5.0,
        },
        "trpo": {
            "steps_per_iteration": 9_600,
            "gamma": 0.995,
            "gae_lambda": 0.99,
            "target_kl": 0.05,
            "critic_batch_size": 2000,
        },
        "model": {
            "kind": "road",
            "model_ratio": 7.0,
            "rollout_starts": "first",
            "k_max": 2400,
            "kappa": 10_000.0,
            "update_mode": "sequential",
        },
        "evaluation": {"validation_interval": 3, "validation_episodes": 16},
    },
    # A jam comes or does not: what a CAV did shows minutes later, and only in the mean of many episodes.
    "merge": {
        "expert": MERGE_JAM_ABSORBER,
        "steps": 300_000,
        "policy": {"inputs": EXPERT_INPUTS, "exploration_std": 0.4},
        "trpo": {"steps_per_iteration": 6000, "gamma": 0.998, "gae_lambda": 0.99},
        "model": {"model_ratio": 0.0},
        "evaluation": {"validation_interval": 10, "validation_episodes": 32},
    },
}
"""the preset `best`: what is known to reach furthest, road by road"""

QUICK_BY_SCENARIO: dict[str, dict[str, Any]] = {
    "merge": BEST_BY_SCENARIO["merge"],
    # The expert is tuned: what a residual on it gains, no parameter does. It is easily upset: seven times the
    # noise makes the first 40 iterations unlearn what it can, and noise that is learned vanishes too soon.
    "ring": {
        **PRESETS["demo"],
        "steps": 1_500_000,
        "expert": "unjam:ring-tuned",
        "policy": LOW_EXPLORATION,
        "trpo": {"target_kl": 0.02},
    },
    # Larger steps of the policy unlearn what the expert can, and no wave comes in the virtual environment of
    # rows, where the leader's own leader is unseen.
    "ring-jammed": {
        "steps": 600_000,
        "trpo": {"target_kl": 0.01},
        "model": {"model_ratio": 0.0},
        "evaluation": {"validation_interval": 3, "validation_episodes": 8},
    },
    # The virtual environment of rows does not know the crossing.
    "figure-eight": {
        "expert": "pacer:use_tuned=true,time_constant=1",
        "reward": "eq16",
        "steps": 300_000,
        "policy": {"inputs": [*EXPERT_INPUTS, "lap_position"], "exploration_std": 0.3},
        "model": {"model_ratio": 0.0},
        "evaluation": {"validation_interval": 2, "validation_episodes": 8},
    },
}
"""the preset `quick`: what reaches furthest within a million actual steps or so, road by road"""


DEMO_BY_SCENARIO: dict[str, dict[str, Any]] = {
    # People have made a wave, and one CAV dissolves it: half a minute of training. Rows imagine no wave, and
    # iterations are large, for the batch affords them.
    "ring-jammed": {
        "steps": 288_000,
        "simulator": "batch",
        "scenario_options": {"horizon": 1500},
        "trpo": {"steps_per_iteration": 48_000},
        "model": {"model_ratio": 0.0},
        "evaluation": {
            "validation_interval": 2,
            "validation_episodes": 16,
            "episodes": 8,
            "baselines": ["human", "unjam:ring-jammed-tuned"],
        },
    }
}
"""the preset `demo` where it is another: on the road that a first visit sees"""
PRESETS_BY_SCENARIO = {"best": BEST_BY_SCENARIO, "quick": QUICK_BY_SCENARIO, "demo": DEMO_BY_SCENARIO}
"""presets that differ from road to road"""


def preset_values(preset: str, scenario: str) -> dict[str, Any]:
    """Return what a preset changes on a scenario; raise `InputError` where there is no such preset."""
    by_road = PRESETS_BY_SCENARIO.get(preset, {})
    if scenario in by_road:
        return by_road[scenario]
    if preset in PRESETS:
        return PRESETS[preset]
    if by_road:
        raise invalid_value("scenario", scenario, f"with the preset {preset}: {', '.join(by_road)}")
    raise unknown_name("preset", preset, dict.fromkeys([*PRESETS, *PRESETS_BY_SCENARIO]))
