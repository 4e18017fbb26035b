"""Policies of other libraries as drivers, and environments for other libraries."""

from typing import TYPE_CHECKING, Any

from gymnasium.vector import VectorEnv

from unjam.adapters.onnx_export import write_onnx_policy
from unjam.adapters.onnx_file import onnx_driver
from unjam.adapters.policies import policy_driver
from unjam.drivers.observation import PolicyInput
from unjam.drivers.policy import PolicyDescription, PolicyMemory, PolicyOutput
from unjam.errors import invalid_value, missing_package_error

if TYPE_CHECKING:
    from unjam.adapters.stable_baselines3_env import SB3VecEnv

__all__ = ["PolicyDescription", "PolicyInput", "PolicyMemory", "PolicyOutput", "onnx_driver", "policy_driver"]
__all__ += ["to_sb3_vec_env", "write_onnx_policy"]


def to_sb3_vec_env(environment: VectorEnv[Any, Any, Any]) -> "SB3VecEnv":
    """Return a vector environment of `gymnasium.make_vec` as a `VecEnv` of Stable-Baselines3.

    With equal seeds, it returns the same as a `DummyVecEnv` of `gymnasium.make`, without Gymnasium's step between two
    episodes.

    Raises:
        InputError: the environment starts the next episode in the step that ends an episode, or returns tensors.
        MissingPartError: Stable-Baselines3 is not installed.
    """
    if not isinstance(environment, VectorEnv):
        raise invalid_value("environment", environment, "an environment of gymnasium.make_vec")
    try:
        from unjam.adapters.stable_baselines3_env import SB3VecEnv
    except ImportError as error:
        raise missing_package_error(error) from None
    return SB3VecEnv(environment)
