"""Regret-weighted task sampling prefers tasks on which the policy falls short, and omits no task."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from unjam.drivers import PISaturation
from unjam.scenarios import Ring
from unjam.training.task_sampling import (
    REGRET_FRACTION,
    count_episodes,
    make_episodes,
    regret_shares,
    warm_up_iterations,
    weight_shares,
)
from unjam.worlds.episode import Task

RING = Ring(horizon=100)
RETURNS = st.floats(-1e4, 1e4, allow_nan=False)


def tasks(*weights: float) -> list[Task]:
    return [Task(RING, PISaturation(), weight=weight) for weight in weights]


def test_shares_are_those_of_the_weights() -> None:
    assert weight_shares(tasks(1.0, 3.0)) == [0.25, 0.75]


def test_weights_decide_without_regret() -> None:
    assert regret_shares([0.25, 0.75], [10.0, 20.0], [10.0, 25.0]) == [0.25, 0.75]


def test_half_of_the_steps_go_to_the_only_task_with_regret() -> None:
    assert regret_shares([0.25, 0.25, 0.5], [10.0, 5.0, 3.0], [10.0, 1.0, 3.0]) == [
        0.125,
        0.125 + REGRET_FRACTION,
        0.25,
    ]


def test_regret_is_multiplied_by_weights() -> None:
    one, other = regret_shares([0.2, 0.8], [5.0, 5.0], [1.0, 1.0])
    assert (one, other) == pytest.approx((0.2, 0.8))


@given(st.lists(st.tuples(st.floats(0.01, 10.0), RETURNS, RETURNS), min_size=1, max_size=8))
def test_shares_sum_to_one_and_keep_a_minimum(roads: list[tuple[float, float, float]]) -> None:
    weights, reached, now = zip(*roads, strict=True)
    by_weight = weight_shares(tasks(*weights))
    found = regret_shares(by_weight, reached, now)
    assert sum(found) == pytest.approx(1.0)
    assert all(
        share >= (1.0 - REGRET_FRACTION) * least * (1 - 1e-9) for share, least in zip(found, by_weight, strict=True)
    )


def test_antithetic_episodes_share_their_seed() -> None:
    driver = PISaturation()
    found = make_episodes(tasks(1.0), [driver], [5], (3, 7), stratified=True, exploration_scales=(1.0, -1.0))
    assert [each.seed for each in found] == [(3, 7, 0), (3, 7, 0), (3, 7, 2), (3, 7, 2), (3, 7, 4)]
    assert [each.explore for each in found] == [1.0, -1.0, 1.0, -1.0, 1.0]
    roads = [each.scenario for each in found]
    assert roads == [tasks(1.0)[0].scenario.stratum(part, 3) for part in (0, 0, 1, 1, 2)]  # which cover all


def test_every_task_has_at_least_one_episode() -> None:
    assert count_episodes(tasks(1.0, 1.0), 1000, [0.001, 0.999]) == [1, 10]


@pytest.mark.parametrize(
    ("count", "left", "ahead"),
    [(4, 10**6, 8), (4, 2500, 3), (4, 1, 1), (4, 0, 1), (64, 10**6, 8), (300, 10**6, 3), (4000, 10**6, 1)],
)
def test_common_warm_up_is_limited_by_the_cache(count: int, left: int, ahead: int) -> None:
    assert warm_up_iterations(5, left, 1000, tasks(1.0), [count]) == range(5, 5 + ahead)
