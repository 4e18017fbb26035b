"""Scenarios as Gymnasium and PettingZoo environments, with the same episodes as `run_episode`."""

from gymnasium.envs.registration import register, registry

ENVIRONMENT_ARGUMENTS = {
    "unjam/Ring-v0": {"scenario": "ring"},
    "unjam/FigureEight-v0": {"scenario": "figure-eight"},
    "unjam/Merge-v0": {"scenario": "merge", "cavs": 1},
    "unjam/OnRamp-v0": {"scenario": "on-ramp", "cavs": 1},
    "unjam/Recorded-v0": {"scenario": "recorded"},
    "unjam/UserNetwork-v0": {"scenario": "my.sumocfg", "cavs": 1},
}
"""arguments of `RoadEnv`, by the Gymnasium id of the environment"""


def register_environments() -> None:
    """Register the environments with Gymnasium; their module is imported when one is made."""
    for name, arguments in ENVIRONMENT_ARGUMENTS.items():
        if name not in registry:
            single, vector = (
                f"unjam.environments.{each}" for each in ("gymnasium_env:RoadEnv", "vector_env:RoadVectorEnv")
            )
            register(name, single, vector_entry_point=vector, kwargs=arguments)
