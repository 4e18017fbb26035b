from itertools import pairwise

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import norm

from unjam.learners.divergence import Gaussians, total_variation

means = st.floats(-3, 3)
stds = st.floats(0.05, 3)


def of(mean: float, std: float) -> Gaussians:
    return Gaussians(torch.tensor([mean]), torch.tensor([std]))


@given(means, stds, means, stds)
def test_is_half_the_integral_of_the_difference_of_the_densities(
    m: float, s: float, n: float, t: float
) -> None:
    def difference(x: float) -> float:
        return float(abs(norm.pdf(x, m, s) - norm.pdf(x, n, t)))

    low, high = min(m - 9 * s, n - 9 * t), max(m + 9 * s, n + 9 * t)
    points = np.unique(np.concatenate([[low, high], m + s * np.arange(-3, 4), n + t * np.arange(-3, 4)]))
    expected = 0.5 * sum(quad(difference, a, b)[0] for a, b in pairwise(points))
    assert abs(float(total_variation(of(m, s), of(n, t))) - expected) < 1e-5


@given(means, stds)
def test_is_zero_for_the_same_policy_and_one_for_policies_far_apart(mean: float, std: float) -> None:
    assert float(total_variation(of(mean, std), of(mean, std))) == 0.0
    assert float(total_variation(of(mean, std), of(mean + 100 * std, std))) > 0.999


@given(means, stds, means, stds)
def test_is_the_same_both_ways(m: float, s: float, n: float, t: float) -> None:
    there, back = total_variation(of(m, s), of(n, t)), total_variation(of(n, t), of(m, s))
    torch.testing.assert_close(there, back, atol=1e-6, rtol=0)
