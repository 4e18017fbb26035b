from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unjam.measures.metrics import METRICS
from unjam.measures.statistics import crossed_estimate, digits_of, estimate, paired_difference, summarise

NUMBERS = st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=12)


def test_interval_covers_the_true_mean_about_as_often_as_it_says() -> None:
    generator = np.random.default_rng(0)
    found = [estimate(list(generator.normal(3.0, 2.0, 20))) for _ in range(200)]
    covered = np.mean([each.low <= 3.0 <= each.high for each in found])
    assert 0.85 <= covered <= 0.99


def test_interval_is_as_wide_as_theory_says() -> None:
    values = np.random.default_rng(1).normal(0.0, 1.0, 400)
    found = estimate(list(values))
    assert found.mean == pytest.approx(values.mean())
    assert found.high - found.low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.1)


def test_more_values_give_a_narrower_interval() -> None:
    values = np.random.default_rng(2).normal(0.0, 1.0, 320)
    few, many = estimate(list(values[:20])), estimate(list(values))
    assert many.high - many.low < (few.high - few.low) / 2


def test_a_mean_that_would_be_rounded_away_gets_more_digits() -> None:
    assert digits_of(estimate([0.0] * 23 + [1.0, 1.0]), 0) == 2
    assert digits_of(estimate([0.0, 0.0]), 0) == 0
    assert digits_of(estimate([1.0, 0.0]), 1) == 1
    assert digits_of(estimate([]), 0) == 0


def test_values_that_are_no_numbers_are_left_out_and_not_counted() -> None:
    assert estimate([1.0, float("nan"), 2.0, float("inf"), 4.0]) == estimate([1.0, 2.0, 4.0])
    assert estimate([1.0, float("nan"), 2.0, 4.0]).count == 3


def test_one_value_has_no_interval() -> None:
    found = estimate([3.0, float("nan")])
    assert (found.mean, found.count) == (3.0, 1)
    assert np.isnan([found.low, found.high]).all()


def test_equal_values_have_an_interval_of_no_width() -> None:
    found = estimate([0.1] * 6)
    assert found.low == found.mean == found.high == pytest.approx(0.1)
    assert found.count == 6


@pytest.mark.parametrize("values", [[], [float("nan")] * 3])
def test_nothing_to_average_is_not_a_number(values: list[float]) -> None:
    found = estimate(values)
    assert found.count == 0
    assert np.isnan([found.mean, found.low, found.high]).all()


@given(NUMBERS)
def test_the_same_values_give_the_same_interval(values: list[float]) -> None:
    assert estimate(values) == estimate(values)


@given(NUMBERS)
def test_interval_holds_its_mean_and_stays_within_the_values(values: list[float]) -> None:
    found = estimate(values)
    slack = 1e-9 * (1 + max(map(abs, values)))
    assert min(values) - slack <= found.low <= found.mean + slack
    assert found.mean - slack <= found.high <= max(values) + slack


def test_does_not_touch_the_generator_that_others_use() -> None:
    np.random.seed(5)
    untouched = np.random.random()
    np.random.seed(5)
    estimate([1.0, 2.0, 4.0])
    assert np.random.random() == untouched


def rows_of(**by_seed: float) -> list[dict[str, Any]]:
    return [{"seed": int(seed.removeprefix("s")), "return": value} for seed, value in by_seed.items()]


def test_differences_are_paired_by_seed_and_not_by_order() -> None:
    ours = rows_of(s1=11.0, s2=22.0, s3=33.0)
    others = rows_of(s3=30.0, s1=10.0, s2=20.0)
    found = paired_difference(ours, others, "return")
    assert found == estimate([1.0, 2.0, 3.0])
    assert found.low > 0  # by order, the differences would be -19, 12 and 13


def test_pairing_takes_the_traffic_out_of_the_difference() -> None:
    traffic = np.random.default_rng(3).normal(0.0, 100.0, 20)
    ours = [{"seed": [9, seed], "return": value + 1.0} for seed, value in enumerate(traffic)]
    others = [{"seed": [9, seed], "return": value} for seed, value in enumerate(traffic)]
    found = paired_difference(ours, others, "return")
    assert found.mean == pytest.approx(1.0)
    assert found.high - found.low < 1e-6


def test_seeds_that_only_one_side_has_are_left_out() -> None:
    found = paired_difference(rows_of(s1=3.0, s2=5.0, s9=100.0), rows_of(s1=1.0, s2=1.0, s5=7.0), "return")
    assert (found.mean, found.count) == (3.0, 2)


def test_a_failed_episode_takes_its_pair_out() -> None:
    found = paired_difference(rows_of(s1=3.0, s2=float("nan")), rows_of(s1=1.0, s2=1.0), "return")
    assert (found.mean, found.count) == (2.0, 1)


def test_summary_has_an_estimate_of_every_metric() -> None:
    rows = [{"seed": seed, **dict.fromkeys(METRICS, float(seed))} for seed in range(4)]
    found = summarise(rows)
    assert list(found) == list(METRICS)
    assert set(found.values()) == {estimate([0.0, 1.0, 2.0, 3.0])}


@pytest.mark.parametrize(("between", "shared"), [(1.0, 0.5), (0.3, 2.0), (1.0, 0.0)])
@pytest.mark.parametrize("trainings", [3, 5, 10, 20])
def test_crossed_intervals_cover_what_they_say(trainings: int, between: float, shared: float) -> None:
    generator, seeds, repeats = np.random.default_rng(trainings), 20, 2000
    tables = (
        between * generator.standard_normal((repeats, trainings, 1))
        + shared * generator.standard_normal((repeats, 1, seeds))
        + generator.standard_normal((repeats, trainings, seeds))
    )
    found = [crossed_estimate(table) for table in tables]
    covered = np.mean([each.low <= 0.0 <= each.high for each in found])
    assert 0.93 <= covered <= 0.97


def test_a_crossed_interval_of_equal_numbers_is_a_point() -> None:
    found = crossed_estimate(np.full((3, 4), 2.5))
    assert (found.mean, found.low, found.high, found.count) == (2.5, 2.5, 2.5, 3)
