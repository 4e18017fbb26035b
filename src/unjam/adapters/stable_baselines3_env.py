"""A vector environment of Gymnasium as the `VecEnv` of Stable-Baselines3."""

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers.vector import DictInfoToList
from stable_baselines3.common.vec_env import VecEnv

from unjam.errors import InputError, invalid_value
from unjam.physics.arrays import Array


class SB3VecEnv(VecEnv):
    """A `VectorEnv` of Gymnasium as a `VecEnv` of Stable-Baselines3.

    In Stable-Baselines3 the step that ends an episode also starts the next one; in Gymnasium the following step does,
    and ignores the action. Therefore `step_wait` resets ended environments at once. The info contains the last
    observation of the ended episode as `terminal_observation`.
    """

    def __init__(self, environment: VectorEnv[Any, Any, Any]) -> None:
        """Store the environment; raise `InputError` if it has a device, another mode or several CAVs."""
        mode = environment.metadata.get("autoreset_mode")
        if mode not in (AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED):
            raise invalid_value("environment: autoreset_mode", mode, "NEXT_STEP or DISABLED")
        if device := getattr(environment.unwrapped, "device", ""):
            raise invalid_value("environment: device", device, "none, so that observations are NumPy arrays")
        if (shape := environment.single_action_space.shape) != (1,):
            reason = f"actions of shape {shape} are not allowed; allowed: (1,), one CAV for each environment"
            raise InputError(f"environment: {reason}; for several CAVs: PettingZoo with a policy that they share")
        self._environment = DictInfoToList(environment)
        self._actions = np.zeros(0)
        super().__init__(environment.num_envs, environment.single_observation_space, environment.single_action_space)

    def reset(self) -> Array:
        """Start an episode in each environment, with the seeds and the options that were set before."""
        options = self._options[0]
        if any(other_options != options for other_options in self._options):
            raise InputError("options: different options are not allowed; allowed: the same for all environments")
        seeds: Any = None if all(seed is None for seed in self._seeds) else self._seeds
        observations, self.reset_infos = self._environment.reset(seed=seeds, options=dict(options))
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: Array) -> None:
        """Store the actions of the next step, shape (environments, 1)."""
        self._actions = actions

    def step_wait(self) -> tuple[Array, Array, Array, list[dict[str, Any]]]:
        """Advance one control step, and start the next episode of environments whose episode has ended."""
        observations, rewards, terminated, truncated, infos = self._environment.step(self._actions)
        has_ended = terminated | truncated
        for info, is_truncated in zip(infos, truncated & ~terminated, strict=True):
            info["TimeLimit.truncated"] = bool(is_truncated)
        if has_ended.any():
            last_observations = observations
            observations, reset_infos = self._environment.reset(options={"reset_mask": has_ended.copy()})
            for row in np.flatnonzero(has_ended):
                infos[row]["terminal_observation"] = last_observations[row]
                self.reset_infos[row] = reset_infos[row]
        return observations, rewards.astype(np.float32), has_ended, infos

    def close(self) -> None:
        """Close the environments; a second call has no effect."""
        self._environment.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the vector environment, once for each of the environments `indices`."""
        return [getattr(self._environment, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Raise `InputError`, because one object contains all environments."""
        raise invalid_value("set_attr", attr_name, "arguments of gymnasium.make_vec")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Raise `InputError`, because one object contains all environments."""
        raise invalid_value("env_method", method_name, "methods of the vector environment")

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Return False for each of the environments `indices`, because single environments have no wrappers."""
        return [False for _ in self._get_indices(indices)]
