"""Policies of Stable-Baselines3, torch networks and functions as drivers of this process."""

import sys
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.adapters.stable_baselines3_file import read_policy
from unjam.drivers.car_following import Constant
from unjam.drivers.observation import FeatureLike, as_features, observation_size
from unjam.drivers.policy import PolicyDescription, PolicyDriver, PolicyOutput, TensorPolicyDriver
from unjam.drivers.user_driver import DriverLike, UserFunction, as_driver, object_label
from unjam.errors import InputError, invalid_value
from unjam.text import to_one_line


def policy_driver(
    policy: Any,
    inputs: Sequence[FeatureLike] = ("local",),
    expert: DriverLike | None = None,
    output: PolicyOutput = PolicyOutput(),  # noqa: B008 - frozen
    time_step: float = 0.1,
    policy_time_step: float | None = None,
) -> PolicyDriver:
    """Return a policy as a driver that runs in this process, without exploration.

    With the features of its Gymnasium environment as `inputs`, and with the same expert, a model of Stable-Baselines3
    drives as in that environment, with the limits and the `VecNormalize` of the model. Further training of the model
    changes the driver, too.

    Args:
        policy: a function of observations of n CAVs, shape (n, inputs), that returns numbers, shape (n,) or (n, 1); a
            `torch.nn.Module`, which is copied in evaluation mode, and also takes tensors, as in
            `DifferentiableRings`; an algorithm or a policy of Stable-Baselines3 with actions in a `Box` of one
            number; or the path of the .zip file of a model (without unpickling, and without `VecNormalize`).
        inputs: names of features, `PolicyInput`s, or functions of a `LocalState`, in the order of the observation.
        expert: a driver to which the accelerations are added; None: the policy drives alone.
        output: the meaning of the numbers; without limits, those of a model's action space.
        time_step: control step of the road [s].
        policy_time_step: control step of the policy [s], a multiple of the road's control step; None: the road's
            control step, or for models of `unjam export --sb3` their action repeat times this step.

    Raises:
        InputError: the policy does not take these inputs, returns another shape, has other actions, or is recurrent;
            or the file is missing, damaged or no `MlpPolicy` with continuous actions and usual exploration.
        MissingPartError: torch is not installed, or cannot read weights safely.
    """
    label, function, input_size, torch = object_label(policy), policy, None, sys.modules.get("torch")
    driver_class = PolicyDriver
    if isinstance(policy, str | Path):
        label, policy = Path(policy).name, read_policy(Path(policy))
    if hasattr(policy, "predict"):
        _check_model(label, policy)
        metadata = getattr(policy, "unjam", {})  # from `unjam export --sb3`
        expert_name, action_repeat = to_one_line(metadata.get("expert", Constant.name)), metadata.get("action_repeat")
        if policy_time_step is None and isinstance(action_repeat, int) and action_repeat > 1:
            policy_time_step = action_repeat * time_step
        if expert is None and expert_name != Constant.name:
            raise InputError(f"{label}: it is a residual; allowed: policy_driver with its expert, {expert_name!r}")
        function, output = _model_function(policy), _limit_output(output, policy)
        input_size = policy.observation_space.shape[0]
    elif torch is not None and isinstance(policy, torch.nn.Module):
        function, driver_class = deepcopy(policy).eval().requires_grad_(False), TensorPolicyDriver
    function = replace(UserFunction.from_object(function, "observations"), label=label)
    expert_driver, features = Constant() if expert is None else as_driver(expert, time_step), as_features(inputs)
    size = observation_size(features, expert_driver)
    if input_size not in (None, size):
        allowed = f"{input_size}, the inputs of {label}; a Python file that calls policy_driver can name its features"
        raise InputError(f"inputs: {size} numbers are not allowed; allowed: {allowed}")
    description = PolicyDescription(features, output, policy_time_step)
    driver = driver_class(lambda rows, memory: (function(rows), memory), label, description, expert_driver, time_step)
    driver.evaluate(np.zeros((2, size)), {})
    return driver


def _check_model(label: str, model: Any) -> None:
    """Raise `InputError` unless a model of Stable-Baselines3 has one-dimensional spaces, one action, and no memory."""
    observation_space, action_space = model.observation_space, model.action_space
    for name, space, allowed in (("observation", observation_space, "(n,)"), ("action", action_space, "(1,)")):
        is_box = type(space).__name__ == "Box" and len(space.shape) == 1
        if not is_box or (space is action_space and space.shape != (1,)):
            raise invalid_value(f"{label}: {name} space", space, f"Box of shape {allowed}")
    observation = np.zeros((1, *observation_space.shape), observation_space.dtype)
    if model.predict(observation, deterministic=True)[1] is not None:
        raise InputError(f"{label}: a recurrent policy is not allowed; allowed: policies without memory")


def _model_function(model: Any) -> Callable[[NDArray[np.float64]], Any]:
    """Return the deterministic actions of a model as a function of observations, which it clips and normalizes."""
    space, normalization = model.observation_space, getattr(model, "get_vec_normalize_env", lambda: None)()

    def predict(observations: NDArray[np.float64]) -> Any:
        clipped = observations.clip(space.low, space.high).astype(space.dtype)
        normalized = clipped if normalization is None else normalization.normalize_obs(clipped)
        return model.predict(normalized, deterministic=True)[0]

    return predict


def _limit_output(output: PolicyOutput, model: Any) -> PolicyOutput:
    """Return the output with the limits of a model's action space, unless it has limits or these are infinite."""
    bounds = (model.action_space.low[0], model.action_space.high[0])
    low, high = sorted(float(bound) * output.scale + output.offset for bound in bounds)
    return output if output.limits or not np.isfinite([low, high]).all() else replace(output, limits=(low, high))
