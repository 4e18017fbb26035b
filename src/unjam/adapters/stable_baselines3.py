"""A Stable-Baselines3 model as a driver."""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from unjam.adapters.policies import limited_output, policy_driver
from unjam.drivers.observation import FeatureLike
from unjam.drivers.policy import PolicyDriver, PolicyOutput
from unjam.drivers.user_driver import DriverLike, object_label
from unjam.errors import InputError, invalid_value


class PredictingModel(Protocol):
    """What a driver needs of a Stable-Baselines3 algorithm or policy."""

    observation_space: Any
    action_space: Any

    def predict(self, observation: Any, *, deterministic: bool = False) -> tuple[Any, Any]:
        """Return actions and, for recurrent policies, the next state."""
        ...


def stable_baselines3_driver(
    model: PredictingModel,
    inputs: Sequence[FeatureLike] = ("local",),
    expert: DriverLike | None = None,
    output: PolicyOutput = PolicyOutput(),  # noqa: B008 - frozen
    time_step: float = 0.1,
) -> PolicyDriver:
    """Return a model as a driver that runs in this process, without exploration.

    With the features of its Gymnasium environment as `inputs`, and the same expert, it drives as in that environment.
    Observations are clipped to the model's observation space, and normalized by its `VecNormalize` environment if it
    has one. Expert and sum are limited as the actions.

    Args:
        model: an algorithm or a policy with `predict` whose actions are a `Box` of one number. Further training
            of it changes the driver, too.
        inputs: its observation in order: names of features such as `local`, `PolicyInput`s, or functions of a
            `LocalState`.
        expert: a driver to which the accelerations are added; None: the model drives alone.
        output: what its actions mean; without limits, those of the action space.
        time_step: control step of the road [s].

    Raises:
        InputError: the model has other actions or observations, or is recurrent.
    """
    label = object_label(model)
    observed, acted = model.observation_space, model.action_space
    for name, space, allowed in (("observation", observed, "(n,)"), ("action", acted, "(1,)")):
        is_box = type(space).__name__ == "Box" and len(space.shape) == 1
        if not is_box or (space is acted and space.shape != (1,)):
            raise invalid_value(f"{label}: {name} space", space, f"Box of shape {allowed}")
    normalization = getattr(model, "get_vec_normalize_env", lambda: None)()

    def act(observations: NDArray[np.float64]) -> Any:
        clipped = observations.clip(observed.low, observed.high).astype(observed.dtype)
        normalized = clipped if normalization is None else normalization.normalize_obs(clipped)
        return model.predict(normalized, deterministic=True)[0]

    if model.predict(np.zeros((1, *observed.shape), observed.dtype), deterministic=True)[1] is not None:
        raise InputError(f"{label}: a recurrent policy is not allowed; allowed: policies without memory")
    output = limited_output(output, acted.low[0], acted.high[0])
    return policy_driver(act, label, inputs, expert, output, time_step, observed.shape[0])
