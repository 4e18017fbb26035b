"""The protocol of learners, which update the policy in Algorithm 1, and the comparison of two policies."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Normal

from unjam.drivers.network import Network
from unjam.errors import UnjamError
from unjam.learners.algorithm import Agent
from unjam.learners.experience import Experience, join_experience
from unjam.physics.arrays import square_root

MAX_HALVINGS = 4
"""maximum number of times that an update is halved before it is undone"""
MIN_STD = 1e-6
"""smallest standard deviation at which policies are compared [m/s2]"""


class Update(NamedTuple):
    """The data of one update."""

    environment_rows: Experience | None
    """environment rows of this iteration; None in later updates of the iteration"""
    model_rows: Experience | None
    """rows of model rollouts; None without any"""
    share: float
    """1 / number of updates of this iteration, for learners that split a number of gradient steps among them"""
    environment_steps: int
    """number of environment steps of all iterations so far"""

    @property
    def rows(self) -> Experience:
        """Environment rows followed by model rows."""
        return join_experience([rows for rows in (self.environment_rows, self.model_rows) if rows is not None])


class Learner(Agent, Protocol):
    """An agent that updates the policy in Algorithm 1; it may use any library.

    A class of the user, `--agent path.py:Class`, inherits from this class, and has `network`, `learn`, `state` and
    `restore`. It is made with an `AgentSpec`, and with `user.options` as keyword arguments. Before each update, the
    global generators of NumPy and torch are seeded by run, iteration and update.
    """

    def learn(self, update: Update) -> None:
        """Update the policy, the critics, and anything else that learns."""
        ...

    def exploring_network(self, environment_steps: int) -> Network:
        """Return the network that explores in the environment after this number of environment steps."""
        return self.network()

    def is_learning(self, environment_steps: int) -> bool:
        """Return whether updates change the policy after this number of environment steps; if not, no model is used."""
        return True

    def set_value_scale(self, environment_rows: Experience) -> None:
        """Set the scale of the values from the rows of the first iteration."""

    def policy_parameters(self) -> list[Tensor]:
        """Return the parameters of the policy, so that an update can be undone; empty: this is not supported."""
        return []

    def residual_distribution(self, observations: Tensor) -> Normal:
        """Return the distribution of the residual for n observations, before the tanh of SAC, shape (n,)."""
        network = self.network()
        mean = torch.as_tensor(network(observations.numpy().astype(np.float64)[:, : network.input_size]))
        return Normal(mean, torch.full_like(mean, max(network.exploration_std, MIN_STD)))

    def log(self) -> dict[str, float]:
        """Return numbers about the updates of this iteration, by name."""
        return {}

    def check_parameters(self, iteration: int) -> None:
        """Raise `UnjamError` if a parameter is not finite."""
        if not all(np.isfinite(array).all() for layer in self.network().layers for array in layer):
            raise UnjamError(f"learner: a weight is not finite in iteration {iteration}")


def limit_update(learner: Learner, old_parameters: Sequence[Tensor], is_allowed: Callable[[Network], bool]) -> float:
    """Halve the update since `old_parameters` until the policy is allowed; return the remaining share of the update.

    After `MAX_HALVINGS` the update is undone, and the share is zero.
    """
    parameters = learner.policy_parameters()
    changes = [parameter.detach() - old for parameter, old in zip(parameters, old_parameters, strict=True)]
    share = 1.0
    while share and not is_allowed(learner.network()):
        share = share / 2.0 if share > 0.5**MAX_HALVINGS else 0.0
        with torch.no_grad():
            for parameter, old, change in zip(parameters, old_parameters, changes, strict=True):
                parameter.copy_(old + share * change)
    return share


def policy_distance(p: Normal, q: Normal) -> Tensor:
    """Return the total variation distance of n pairs of Gaussians (eps_pi of the paper's bound), (n,), in [0, 1]."""
    p, q = (Normal(normal.mean.double(), normal.stddev.double()) for normal in (p, q))
    m, s, n, t = p.mean, p.stddev, q.mean, q.stddev
    # The densities are equal where (x-m)^2/s^2 - (x-n)^2/t^2 + 2 log(s/t) = 0: these are a x^2 + b x + c = 0.
    a = 1 / s**2 - 1 / t**2
    b = 2 * (n / t**2 - m / s**2)
    c = m**2 / s**2 - n**2 / t**2 + 2 * torch.log(s / t)
    has_equal_width = a.abs() < 1e-9 / s**2  # then the densities are equal only at (m + n) / 2
    root = square_root((b**2 - 4 * a * c).clip(0))
    denominator = 2 * torch.where(has_equal_width, torch.ones_like(a), a)
    low, high = ((-b + sign * root) / denominator for sign in (-1, 1))
    distance = ((p.cdf(high) - p.cdf(low)) - (q.cdf(high) - q.cdf(low))).abs()
    return torch.where(has_equal_width, torch.erf((m - n).abs() / (2 * 2**0.5 * s)), distance)
