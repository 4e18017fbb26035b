"""The driver around a policy of another library."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.car_following import Constant
from unjam.drivers.driver import Recipe
from unjam.drivers.observation import FeatureLike, as_features, observation_size
from unjam.drivers.residual import ResidualDriver
from unjam.drivers.user_driver import DriverLike, UserFunction, as_driver
from unjam.errors import InputError
from unjam.tree import Arrays


@dataclass(frozen=True, eq=False)
class PolicyNetwork:
    """A deterministic policy of another library, in the place of a `Network`."""

    policy: Callable[[NDArray[np.float64]], Any]
    """returns actions, shape (n,) or (n, 1), for observations, shape (n, inputs)"""
    scale: float
    """acceleration for an action of one [m/s2]"""
    episode_noise_size: ClassVar[int] = 0

    def __call__(self, observation: NDArray[np.float64]) -> NDArray[Any]:
        """Return the accelerations [m/s2], shape (n,), in the precision of the policy."""
        rows = len(observation)
        if not rows:  # the policy may need a row
            return np.zeros(0)
        actions = np.asarray(self.policy(observation))
        if actions.shape not in ((rows,), (rows, 1)):
            raise InputError(
                f"policy: returns shape {actions.shape} for {rows} CAVs; allowed: ({rows},) or ({rows}, 1)"
            )
        return actions.reshape(rows) * self.scale

    def explore(self, observation: Any, noise: Any) -> Any:
        """Raise `InputError`: exploration belongs to the library that trains the policy."""
        raise InputError("explore: a policy of another library drives without exploration noise; allowed: 0")


@dataclass(frozen=True, eq=False)
class PolicyDriver(ResidualDriver):
    """Adds the action of a policy of another library to an expert; other processes cannot build it."""

    accepts_floats: ClassVar[bool] = False  # pyright: ignore[reportIncompatibleVariableOverride]
    accepts_tensors: ClassVar[bool] = False  # pyright: ignore[reportIncompatibleVariableOverride]

    network: Any
    label: str = ""

    def describe(self) -> str:
        """Return the name of the policy's class, after the expert's description if there is one."""
        return self.label

    def recipe(self) -> Recipe:
        """Return the recipe of a driver without a name, which cannot be built from it."""
        return {"kind": "named", "name": "", "parameters": {}}

    def weights(self) -> Arrays:
        """Return no weights: they belong to the other library."""
        return {}


def policy_driver(
    policy: Callable[[NDArray[np.float64]], Any],
    label: str,
    features: Sequence[FeatureLike],
    expert: DriverLike | None,
    action_scale: float,
    action_limit: float,
    input_size: int | None = None,
) -> PolicyDriver:
    """Return the driver around a policy with `input_size` inputs (None: unknown); arguments as `torch_driver`.

    Raise `InputError` if they do not fit together.
    """
    inner = Constant() if expert is None else as_driver(expert)
    network = PolicyNetwork(UserFunction(policy, label), action_scale)
    inputs: Any = as_features(features)
    size = observation_size(inputs, inner)
    if input_size not in (None, size):
        raise InputError(f"features: {size} numbers are not allowed; allowed: {input_size}, the inputs of {label}")
    network(np.zeros((2, size)))
    name = label if expert is None else f"{inner.describe()} + {label}"
    return PolicyDriver(inner, network, action_limit, inputs, label=name)
