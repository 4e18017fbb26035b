"""Do the episodes of an iteration go where a policy falls short, and is no road forgotten?"""

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


def test_where_nothing_is_lacking_weights_decide() -> None:
    assert regret_shares([0.25, 0.75], [10.0, 20.0], [10.0, 25.0]) == [0.25, 0.75]


def test_half_goes_to_the_only_road_on_which_the_policy_falls_short() -> None:
    assert regret_shares([0.25, 0.25, 0.5], [10.0, 5.0, 3.0], [10.0, 1.0, 3.0]) == [
        0.125,
        0.125 + REGRET_FRACTION,
        0.25,
    ]


def test_a_road_that_weighs_more_is_followed_more() -> None:
    one, other = regret_shares([0.2, 0.8], [5.0, 5.0], [1.0, 1.0])
    assert (one, other) == pytest.approx((0.2, 0.8))


@given(st.lists(st.tuples(st.floats(0.01, 10.0), RETURNS, RETURNS), min_size=1, max_size=8))
def test_shares_sum_to_one_and_none_falls_below_what_weights_leave_it(roads: list[tuple[float, float, float]]) -> None:
    weights, reached, now = zip(*roads, strict=True)
    by_weight = weight_shares(tasks(*weights))
    found = regret_shares(by_weight, reached, now)
    assert sum(found) == pytest.approx(1.0)
    assert all(
        share >= (1.0 - REGRET_FRACTION) * least * (1 - 1e-9) for share, least in zip(found, by_weight, strict=True)
    )


def test_mirrored_episodes_share_their_seed_and_explore_opposite_ways() -> None:
    driver = PISaturation()
    found = make_episodes(tasks(1.0), [driver], [5], (3, 7), stratified=True, exploration_scales=(1.0, -1.0))
    assert [each.seed for each in found] == [(3, 7, 0), (3, 7, 0), (3, 7, 2), (3, 7, 2), (3, 7, 4)]
    assert [each.explore for each in found] == [1.0, -1.0, 1.0, -1.0, 1.0]
    roads = [each.scenario for each in found]
    assert roads == [tasks(1.0)[0].scenario.stratum(part, 3) for part in (0, 0, 1, 1, 2)]  # which cover all


def test_every_road_has_an_episode_however_small_its_share() -> None:
    assert count_episodes(tasks(1.0, 1.0), 1000, [0.001, 0.999]) == [1, 10]


@pytest.mark.parametrize(
    ("count", "left", "ahead"),
    [(4, 10**6, 8), (4, 2500, 3), (4, 1, 1), (4, 0, 1), (64, 10**6, 8), (300, 10**6, 3), (4000, 10**6, 1)],
)
def test_iterations_are_warmed_up_ahead_as_far_as_they_are_kept(count: int, left: int, ahead: int) -> None:
    assert warm_up_iterations(5, left, 1000, tasks(1.0), [count]) == range(5, 5 + ahead)
