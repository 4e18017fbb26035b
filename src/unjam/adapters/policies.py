"""The driver around a policy of another library that is an object of this process."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.car_following import Constant
from unjam.drivers.observation import FeatureLike, as_features, observation_size
from unjam.drivers.policy import MemorylessPolicy, PolicyDriver, PolicyOutput, action_limits, assumed_time_step
from unjam.drivers.user_driver import DriverLike, UserFunction, as_driver
from unjam.errors import InputError


def policy_driver(
    policy: Callable[[NDArray[np.float64]], Any],
    label: str,
    inputs: Sequence[FeatureLike],
    expert: DriverLike | None,
    output: PolicyOutput,
    time_step: float,
    input_size: int | None = None,
) -> PolicyDriver:
    """Return the driver around a policy with `input_size` inputs (None: unknown); arguments as `torch_driver`.

    Raise `InputError` if they do not fit together.
    """
    inner, features = Constant() if expert is None else as_driver(expert, time_step), as_features(inputs)
    size = observation_size(features, inner)
    if input_size not in (None, size):
        raise InputError(f"inputs: {size} numbers are not allowed; allowed: {input_size}, the inputs of {label}")
    function, limits = MemorylessPolicy(UserFunction(policy, label)), action_limits(output, inner)
    step = assumed_time_step(output, None, time_step)
    driver = PolicyDriver(function, label, features, output, inner, step, limits=limits)
    driver.evaluate(np.zeros((2, size)), {})
    return driver


def limited_output(output: PolicyOutput, low: float, high: float) -> PolicyOutput:
    """Return an output with the limits of an action space, unless it has its own."""
    if output.limits is not None or not np.isfinite([low, high]).all():
        return output
    ends = sorted(float(number) * output.scale + output.offset for number in (low, high))
    return replace(output, limits=(ends[0], ends[1]))
