"""Presets with the settings of the paper, which unjam loads through an entry point."""

from typing import Any

from unjam.parameters import merge_changes
from unjam.road_family import NO_LATENCY

PAPER: dict[str, Any] = {
    **{"expert": "pi:time_constant=0", "steps": 4_000_000, "stratified": False},
    "scenario_options": {"actuator": NO_LATENCY},
    "policy": {
        **{"inputs": ["local"], "exploration_std": 1.0, "action_duration": 0},
        **{"privileged_critic": False, "normalize_value": False},
    },
    "trpo": {"steps_per_iteration": 6000, "gamma": 0.995, "target_kl": 0.01},
    "ppo": {
        **{"steps_per_iteration": 6000, "gamma": 0.99, "clip_range": 0.2, "epochs": 80},
        **{"actor_learning_rate": 3e-4, "critic_learning_rate": 1e-3},
    },
    "sac": {
        **{"gamma": 0.99, "tau": 5e-3, "learning_rate": 3e-4, "temperature": 0.2, "learn_temperature": False},
        **{"reward_scale": 1.0, "batch_size": 256, "learning_starts": 10_000, "start_policy": "uniform"},
    },
    "model": {"k_max": 500, "kappa": 2.0, "model_ratio": 1.0},
}
"""settings of Tables B2 to B6 and section 4.1 of the paper, and others from its authors' code; CAVs carry out commands
at once"""
PAPER_EXACT = {
    "scenario_options": {"safety": {"active": False}},
    "policy": {"zero_init": False},
    "model": {"members": 1, "fallback_to_base": False, "add_noise": False, "error_estimator": "transitions"},
    "evaluation": {"validation_interval": 0, "convergence_window": 50},
}
"""additional settings of the method as printed: no safety filter, a randomly initialized policy, a model of one network
without noise, the last checkpoint instead of the best validated one, and an end when the return stops increasing. The
noise of human drivers follows Flow: 0.2 m/s2 times the square root of the step"""
PAPER_PRESETS: dict[str, dict[str, Any]] = {"paper": PAPER, "paper-exact": merge_changes(PAPER, PAPER_EXACT)}
"""changes to the run configuration, by name of the preset"""
