"""The roads as Gymnasium and PettingZoo environments: they step what `run_episode` steps."""

from gymnasium.envs.registration import register, registry

SCENARIO_OF = {"unjam/Ring-v0": "ring", "unjam/FigureEight-v0": "figure-eight"}
"""the scenario of each environment that Gymnasium makes by name"""


def register_all() -> None:
    """Tell Gymnasium of the environments; they are imported when one is made."""
    for name, scenario in SCENARIO_OF.items():
        if name not in registry:
            register(name, "unjam.environments.single:RoadEnv", kwargs={"scenario": scenario})
