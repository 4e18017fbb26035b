"""A `torch.nn.Module` as a driver."""

from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from unjam.adapters.policies import policy_driver
from unjam.drivers.observation import FeatureLike
from unjam.drivers.policy import PolicyDriver, PolicyOutput
from unjam.drivers.user_driver import DriverLike, object_label


def torch_driver(
    module: torch.nn.Module,
    inputs: Sequence[FeatureLike] = ("local",),
    expert: DriverLike | None = None,
    output: PolicyOutput = PolicyOutput(),  # noqa: B008 - frozen
    time_step: float = 0.1,
) -> PolicyDriver:
    """Return a copy of a network, in evaluation mode, as a driver that runs in this process.

    Args:
        module: returns numbers, shape (n,) or (n, 1), for observations of n CAVs, shape (n, inputs), in the precision
            and on the device of its parameters.
        inputs: its inputs in order: names of features such as `local`, `PolicyInput`s, or functions of a `LocalState`.
        expert: a driver to which the accelerations are added; None: the network drives alone.
        output: what its numbers mean.
        time_step: control step of the road [s].

    Raises:
        InputError: the network does not take these inputs, or returns another shape.
    """
    network = deepcopy(module).eval()
    like = next(network.parameters(), torch.zeros(()))

    def act(observations: NDArray[np.float64]) -> Any:
        with torch.no_grad():
            answer = network(torch.as_tensor(observations, dtype=like.dtype, device=like.device))
        return answer.cpu().numpy()

    return policy_driver(act, object_label(module), inputs, expert, output, time_step)
