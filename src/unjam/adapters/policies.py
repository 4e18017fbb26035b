"""Policies of Stable-Baselines3 and torch, and functions, as drivers of this process."""

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

    With the features of its Gymnasium environment as `inputs`, and the same expert, a model of Stable-Baselines3 drives
    as in that environment, with its limits and its `VecNormalize`. Its further training changes the driver, too.

    Args:
        policy: a function of observations of n CAVs, shape (n, inputs), that returns numbers, shape (n,) or (n, 1); a
            `torch.nn.Module`, of which a copy in evaluation mode is such a function, and also takes tensors, as in
            `DifferentiableRings`; an algorithm or a policy of Stable-Baselines3 whose actions are a `Box` of one
            number; or the path of the .zip file of a model (without unpickling, and without `VecNormalize`).
        inputs: its observation in order: names of features, `PolicyInput`s, or functions of a `LocalState`.
        expert: a driver to which the accelerations are added; None: the policy drives alone.
        output: what its numbers mean; without limits, those of a model's action space.
        time_step: control step of the road [s].
        policy_time_step: control step of the policy [s], a multiple of that of the road; None: that of the road,
            or for models of `unjam export --sb3` the one with which they were trained on such a road.

    Raises:
        InputError: the policy does not take these inputs, returns another shape, has other actions, or is recurrent;
            or the file is missing, damaged or no `MlpPolicy` with continuous actions and usual exploration.
        MissingPartError: torch is not installed, or cannot read weights safely.
    """
    label, function, size, torch = object_label(policy), policy, None, sys.modules.get("torch")
    kind = PolicyDriver
    if isinstance(policy, str | Path):
        label, policy = Path(policy).name, read_policy(Path(policy))
    if hasattr(policy, "predict"):
        _check_model(label, policy)
        exported = getattr(policy, "unjam", {})  # by `unjam export --sb3`
        added_to, repeat = to_one_line(exported.get("expert", Constant.name)), exported.get("action_repeat")
        if policy_time_step is None and isinstance(repeat, int) and repeat > 1:
            policy_time_step = repeat * time_step
        if expert is None and added_to != Constant.name:
            raise InputError(f"{label}: it is a residual; allowed: policy_driver with its expert, {added_to!r}")
        function, output, size = _predict(policy), _limit_output(output, policy), policy.observation_space.shape[0]
    elif torch is not None and isinstance(policy, torch.nn.Module):
        function, kind = deepcopy(policy).eval().requires_grad_(False), TensorPolicyDriver
    function = replace(UserFunction.from_object(function, "observations"), label=label)
    inner, features = Constant() if expert is None else as_driver(expert, time_step), as_features(inputs)
    described = observation_size(features, inner)
    if size not in (None, described):
        allowed = f"{size}, the inputs of {label}; a Python file that calls policy_driver can name its features"
        raise InputError(f"inputs: {described} numbers are not allowed; allowed: {allowed}")
    description = PolicyDescription(features, output, policy_time_step)
    driver = kind(lambda rows, memory: (function(rows), memory), label, description, inner, time_step)
    driver.evaluate(np.zeros((2, described)), {})
    return driver


def _check_model(label: str, model: Any) -> None:
    observed, acted = model.observation_space, model.action_space
    for name, space, allowed in (("observation", observed, "(n,)"), ("action", acted, "(1,)")):
        is_box = type(space).__name__ == "Box" and len(space.shape) == 1
        if not is_box or (space is acted and space.shape != (1,)):
            raise invalid_value(f"{label}: {name} space", space, f"Box of shape {allowed}")
    if model.predict(np.zeros((1, *observed.shape), observed.dtype), deterministic=True)[1] is not None:
        raise InputError(f"{label}: a recurrent policy is not allowed; allowed: policies without memory")


def _predict(model: Any) -> Callable[[NDArray[np.float64]], Any]:
    space, normalization = model.observation_space, getattr(model, "get_vec_normalize_env", lambda: None)()

    def act(observations: NDArray[np.float64]) -> Any:
        clipped = observations.clip(space.low, space.high).astype(space.dtype)
        normalized = clipped if normalization is None else normalization.normalize_obs(clipped)
        return model.predict(normalized, deterministic=True)[0]

    return act


def _limit_output(output: PolicyOutput, model: Any) -> PolicyOutput:
    ends = (model.action_space.low[0], model.action_space.high[0])
    low, high = sorted(float(number) * output.scale + output.offset for number in ends)
    return output if output.limits or not np.isfinite([low, high]).all() else replace(output, limits=(low, high))
