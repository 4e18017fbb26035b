"""Scenarios as Gymnasium and PettingZoo environments, with the same episodes as `run_episode`."""

from gymnasium.envs.registration import register, registry

from unjam.road_family import FAMILY, FAMILY_PREFIX

ENVIRONMENT_ARGUMENTS = {
    "unjam/Ring-v0": {"scenario": "ring"},
    "unjam/FigureEight-v0": {"scenario": "figure-eight"},
    "unjam/Merge-v0": {"scenario": "merge"},
    "unjam/OnRamp-v0": {"scenario": "on-ramp"},
    "unjam/Recorded-v0": {"scenario": "recorded"},
    "unjam/UserNetwork-v0": {"scenario": "my.sumocfg", "cavs": 1},
    **{
        f"unjam/{name}-v1": {"scenario": f"{FAMILY_PREFIX}{name}"} | ({"cavs": 1} if "cavs" in road.options else {})
        for name, road in FAMILY.items()
    },
}
"""arguments of `RoadEnv` by Gymnasium id; closed benchmark roads have one CAV"""


def register_environments() -> None:
    """Register the environments with Gymnasium, which imports their module when it makes the first environment."""
    for name, arguments in ENVIRONMENT_ARGUMENTS.items():
        if name not in registry:
            vector = "unjam.environments.slotted_vector_env:make_vector_env"
            register(name, "unjam.environments.gymnasium_env:RoadEnv", vector_entry_point=vector, kwargs=arguments)
