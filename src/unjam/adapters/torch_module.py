"""A `torch.nn.Module` as a driver."""

from collections.abc import Sequence
from copy import deepcopy
from math import inf
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from unjam.adapters.policy_driver import PolicyDriver, policy_driver
from unjam.drivers.observation import FeatureLike
from unjam.drivers.user_driver import DriverLike, object_label


def torch_driver(
    module: torch.nn.Module,
    features: Sequence[FeatureLike] = ("local",),
    expert: DriverLike | None = None,
    action_scale: float = 1.0,
    action_limit: float = inf,
) -> PolicyDriver:
    """Return a copy of a network, in evaluation mode, as a driver that runs in this process.

    Args:
        module: returns actions, shape (n,) or (n, 1), for observations of n CAVs, shape (n, inputs), in the precision
            and on the device of its parameters.
        features: its inputs in order: names such as `local`, or functions of a `LocalState`.
        expert: a driver to which the actions are added; None: the network drives alone.
        action_scale: acceleration for an action of one [m/s2].
        action_limit: limit of the expert's acceleration and of the sum [m/s2]; the road has its own in addition.

    Raises:
        InputError: the network does not take these features, or returns another shape.
    """
    network = deepcopy(module).eval()
    like = next(network.parameters(), torch.zeros(()))

    def act(observations: NDArray[np.float64]) -> Any:
        with torch.no_grad():
            answer = network(torch.as_tensor(observations, dtype=like.dtype, device=like.device))
        return answer.cpu().numpy()

    return policy_driver(act, object_label(module), features, expert, action_scale, action_limit)
