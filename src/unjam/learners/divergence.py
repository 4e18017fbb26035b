"""How far an update has moved the policy: eps_pi of the paper's bound."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Normal

from unjam.physics.arrays import square_root


class Gaussians(NamedTuple):
    """The distribution of the residual at each state, before bounds and squashing; tensors of shape (n,)."""

    mean: Tensor
    std: Tensor


def total_variation(one: Gaussians, other: Gaussians) -> Tensor:
    """Return the total variation between Gaussians, row by row, shape (n,), in [0, 1].

    Half the integral of |p - q|: between the places where the densities cross, the difference of the
    probabilities. It is the same after any squashing that keeps the order.
    """
    (m, s), (n, t) = (tuple(part.double() for part in each) for each in (one, other))
    # p = q where (x-m)^2/s^2 - (x-n)^2/t^2 + 2 log(s/t) = 0
    a = 1 / s**2 - 1 / t**2
    b = 2 * (n / t**2 - m / s**2)
    c = m**2 / s**2 - n**2 / t**2 + 2 * torch.log(s / t)
    same = a.abs() < 1e-9 / s**2
    root = square_root((b**2 - 4 * a * c).clip(0))
    # Of equal widths they cross once, half-way.
    low, high = ((-b + sign * root) / (2 * torch.where(same, torch.ones_like(a), a)) for sign in (-1, 1))
    between = (_mass(m, s, low, high) - _mass(n, t, low, high)).abs()
    once = torch.erf((m - n).abs() / (2 * 2**0.5 * s))
    return torch.where(same, once, between)


def _mass(mean: Tensor, std: Tensor, low: Tensor, high: Tensor) -> Tensor:
    normal = Normal(mean, std)
    return normal.cdf(high) - normal.cdf(low)
