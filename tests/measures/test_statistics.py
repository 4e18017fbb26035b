from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from unjam.measures.metrics import METRICS
from unjam.measures.statistics import (
    MIN_INTERVAL_VALUES,
    Estimate,
    display_digits,
    estimate,
    estimate_crossed,
    format_difference,
    gain_verdict,
    is_bimodal,
    linearized_ratio,
    metric_estimate,
    paired_difference,
    paired_differences,
    probability_of_improvement,
    regress,
    relative_difference,
    summarize,
)
from unjam_paper.results_file import read_part

COUNTS = (3, 5, 10, 20)
REPEATS = 500
FEASIBLE_RING = Path(__file__).parents[2] / "results" / "feasible-ring-ideal.json"
NUMBERS = st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=12)


def coverage(found: Sequence[Estimate], true: float) -> float:
    return float(np.mean([each.low <= true <= each.high for each in found]))


@pytest.mark.parametrize("trim", [0.0, 0.25])
@pytest.mark.parametrize("count", COUNTS)
def test_intervals_of_normal_values_have_the_stated_coverage(count: int, trim: float) -> None:
    drawn = np.random.default_rng(count).normal(3.0, 2.0, (2 * REPEATS, count))
    assert 0.93 <= coverage([estimate(values, trim=trim) for values in drawn], 3.0) <= 0.97


@pytest.mark.parametrize("count", COUNTS)
def test_intervals_of_ratios_have_the_stated_coverage(count: int) -> None:
    generator = np.random.default_rng(count)
    scales = 48.0 + 14.0 * generator.standard_normal((2 * REPEATS, count))
    values = 0.6 * scales + 9.0 * generator.standard_normal(scales.shape)
    found = [estimate(linearized_ratio(*each).tolist()) for each in zip(values, scales, strict=True)]
    assert 0.93 <= coverage(found, 0.6) <= 0.97
    assert found[0].mean == pytest.approx(values[0].mean() / scales[0].mean())


def returns_on_ring() -> dict[str, np.ndarray]:
    """The returns of each driver that was measured on the ring, a row per length of it."""
    found = read_part(FEASIBLE_RING, "ring")
    return {
        driver: np.array([[row["return"] for row in lengths[driver]["episodes"]] for lengths in found.values()])
        for driver in found["220"]
    }


def coverage_of_resampled(pools: Sequence[np.ndarray], count: int) -> float:
    generator = np.random.default_rng(count)
    repeats = 2 * REPEATS // len(pools)
    drawn = [(generator.choice(pool, (repeats, count)), float(pool.mean())) for pool in pools]
    return float(np.mean([coverage([estimate(each) for each in values], true) for values, true in drawn]))


def coverage_by_kind(returns: dict[str, np.ndarray], count: int) -> dict[str, float]:
    """How often intervals of values about the mean of their length cover it; all trainings are one kind."""
    pools: dict[str, list[np.ndarray]] = {}
    for driver, values in returns.items():
        kind = "trainings" if driver.startswith("training") else driver
        pools.setdefault(kind, []).append((values - values.mean(1, keepdims=True)).ravel())
    return {kind: coverage_of_resampled(of, count) for kind, of in pools.items()}


@pytest.mark.long
@pytest.mark.parametrize("count", COUNTS)
def test_intervals_of_real_returns_have_the_stated_coverage(count: int) -> None:
    returns = returns_on_ring()
    found = coverage_by_kind(returns, count)
    assert 0.93 <= np.mean(list(found.values())) <= 0.97
    beyond = {driver: of - returns["human"] for driver, of in returns.items() if driver != "human"}
    assert 0.93 <= np.mean(list(coverage_by_kind(beyond, count).values())) <= 0.97


@pytest.mark.long
@pytest.mark.parametrize("count", COUNTS)
def test_intervals_of_residual_returns_cover_slightly_less(count: int) -> None:
    """On each length they earn all but the same, and now and then less: few values of such are too sure."""
    assert 0.85 <= coverage_by_kind(returns_on_ring(), count)["trainings"] <= 0.97


@pytest.mark.parametrize("count", COUNTS)
def test_intervals_of_few_episodes_over_all_lengths_cover_slightly_less(count: int) -> None:
    """Lengths drawn evenly make returns flat, for which Student's t of three values covers 92 %."""
    found = coverage_of_resampled([values.ravel() for values in returns_on_ring().values()], count)
    assert (0.93 if count >= 10 else 0.90) <= found <= 0.97


@pytest.mark.parametrize("count", [5, 10, 20])
@pytest.mark.parametrize("share", [0.05, 0.5, 0.9])
def test_intervals_of_shares_cover_and_stay_within_bounds(share: float, count: int) -> None:
    drawn = np.where(np.random.default_rng(count).random((REPEATS, 1, count)) < share, 1.0, -1.0)
    found = [probability_of_improvement(values) for values in drawn]
    assert all(0.0 <= each.low <= each.mean <= each.high <= 1.0 for each in found)
    assert coverage(found, share) >= 0.90


def test_interval_is_clipped_at_the_bounds() -> None:
    values = [0.0, 0.0, 0.0, 0.9]
    assert estimate(values).low < 0.0
    cut = estimate(values, bounds=(0.0, 1.0))
    assert (cut.low, cut.high) == (0.0, pytest.approx(estimate(values).high))
    rows = [{"collisions": value, "return": -value} for value in values]
    assert metric_estimate(rows, "collisions").low == 0.0
    assert metric_estimate(rows, "return").low < -0.9


def test_trimmed_mean_leaves_the_ends_out() -> None:
    found = estimate([1.0, 2.0, 3.0, 4.0, 100.0], trim=0.25)
    assert (found.mean, found.largest) == (3.0, 100.0)
    # Winsorised 2 2 3 4 4: squares 4, over h (h - 1) = 6, times t of two degrees of freedom.
    assert found.high == pytest.approx(3.0 + 4.30265 * np.sqrt(4 / 6), rel=1e-5)
    assert np.isnan(estimate([0.0, 0.0, 0.0, 0.0, 6.0], trim=0.25).low)


def test_interval_width_matches_theory() -> None:
    values = np.random.default_rng(1).normal(0.0, 1.0, 400)
    found = estimate(list(values))
    assert found.mean == pytest.approx(values.mean())
    assert found.high - found.low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.1)


def test_more_values_narrow_the_interval() -> None:
    values = np.random.default_rng(2).normal(0.0, 1.0, 320)
    few, many = estimate(list(values[:20])), estimate(list(values))
    assert many.high - many.low < (few.high - few.low) / 2


def test_mean_that_would_round_to_zero_gets_more_digits() -> None:
    assert display_digits(estimate([0.0] * 23 + [1.0, 1.0]), 0) == 2
    assert display_digits(estimate([0.0, 0.0]), 0) == 0
    assert display_digits(estimate([1.0, 0.0]), 1) == 1
    assert display_digits(estimate([]), 0) == 0


def test_nonfinite_values_are_left_out() -> None:
    assert estimate([1.0, float("nan"), 2.0, float("inf"), 4.0]) == estimate([1.0, 2.0, 4.0])
    assert estimate([1.0, float("nan"), 2.0, 4.0]).count == 3


@pytest.mark.parametrize(("values", "words"), [([3.0], "+3"), ([3.0, 5.0], "+4 (+3 to +5)")])
def test_few_values_have_a_range_and_no_interval(values: list[float], words: str) -> None:
    found = estimate([*values, float("nan")])
    assert (found.mean, found.count) == (np.mean(values), len(values))
    assert np.isnan([found.low, found.high]).all()
    assert format_difference(found) == words


def test_equal_values_have_an_interval_of_no_width() -> None:
    found = estimate([0.1] * 6)
    assert found.low == found.mean == found.high == pytest.approx(0.1)
    assert found.count == 6


@pytest.mark.parametrize("values", [[], [float("nan")] * 3])
def test_estimate_of_nothing_is_nan(values: list[float]) -> None:
    found = estimate(values)
    assert found.count == 0
    assert np.isnan([found.mean, found.low, found.high]).all()


@given(NUMBERS)
def test_the_same_values_give_the_same_interval(values: list[float]) -> None:
    np.testing.assert_equal(asdict(estimate(values)), asdict(estimate(values)))


@given(NUMBERS)
def test_interval_contains_its_mean_and_has_the_range(values: list[float]) -> None:
    found = estimate(values)
    slack = 1e-9 * (1 + max(map(abs, values)))
    assert (found.smallest, found.largest) == (min(values), max(values))
    if len(values) >= MIN_INTERVAL_VALUES:
        assert found.mean - found.low == pytest.approx(found.high - found.mean, abs=slack)
        assert found.low <= found.mean <= found.high


def test_global_random_state_is_not_changed() -> None:
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
    assert found == estimate([1.0, 2.0, 3.0])  # by order, the differences would be -19, 12 and 13


def test_pairing_removes_the_variance_of_traffic() -> None:
    traffic = np.random.default_rng(3).normal(0.0, 100.0, 20)
    ours = [{"seed": [9, seed], "return": value + 1.0} for seed, value in enumerate(traffic)]
    others = [{"seed": [9, seed], "return": value} for seed, value in enumerate(traffic)]
    found = paired_difference(ours, others, "return")
    assert found.mean == pytest.approx(1.0)
    assert found.high - found.low < 1e-6


def test_seeds_of_one_side_only_are_left_out() -> None:
    found = paired_difference(rows_of(s1=3.0, s2=5.0, s9=100.0), rows_of(s1=1.0, s2=1.0, s5=7.0), "return")
    assert (found.mean, found.count) == (3.0, 2)


def test_failed_episode_removes_its_pair() -> None:
    found = paired_difference(rows_of(s1=3.0, s2=float("nan")), rows_of(s1=1.0, s2=1.0), "return")
    assert (found.mean, found.count) == (2.0, 1)


def test_summary_has_an_estimate_of_every_metric() -> None:
    rows = [{"seed": seed, **dict.fromkeys(METRICS, float(seed))} for seed in range(4)]
    found = summarize(rows)
    assert list(found) == list(METRICS)
    values = [0.0, 1.0, 2.0, 3.0]
    assert all(found[name] == estimate(values, bounds=METRICS[name].bounds) for name in METRICS)


@pytest.mark.parametrize(("between", "shared"), [(1.0, 0.5), (0.3, 2.0), (1.0, 0.0)])
@pytest.mark.parametrize("trainings", [3, 5, 10, 20])
def test_crossed_intervals_have_the_stated_coverage(trainings: int, between: float, shared: float) -> None:
    generator, seeds, repeats = np.random.default_rng(trainings), 20, 2000
    tables = (
        between * generator.standard_normal((repeats, trainings, 1))
        + shared * generator.standard_normal((repeats, 1, seeds))
        + generator.standard_normal((repeats, trainings, seeds))
    )
    found = [estimate_crossed(table) for table in tables]
    covered = np.mean([each.low <= 0.0 <= each.high for each in found])
    assert 0.93 <= covered <= 0.97


def test_crossed_interval_of_equal_values_is_a_point() -> None:
    found = estimate_crossed(np.full((3, 4), 2.5))
    assert (found.mean, found.low, found.high, found.count) == (2.5, 2.5, 2.5, 3)


def test_bimodal_or_few_trainings_have_a_range_and_no_interval() -> None:
    seeds = np.random.default_rng(0).normal(0.0, 1.0, 20)
    modes = np.array([0.0, 1.0, 2.0, 80.0, 81.0])[:, None] + seeds
    found = estimate_crossed(modes)
    assert np.isnan(found.low)
    assert np.isnan(found.high)
    assert format_difference(found) == "+33 (-0 to +81)"
    assert np.isnan(estimate_crossed(modes[:2]).low)
    assert estimate_crossed(np.array([0.0, 10.0, 20.0, 30.0, 40.0])[:, None] + seeds).low < 20.0


@pytest.mark.parametrize("count", [4, 5, 8, 10, 20])
def test_bimodality_is_detected_with_few_false_positives(count: int) -> None:
    generator = np.random.default_rng(count)
    normal = generator.normal(0.0, 1.0, (REPEATS, count))
    assert np.mean([is_bimodal(values) for values in normal]) < 0.03
    apart = normal + 30.0 * (np.arange(count) >= count // 2)
    assert np.mean([is_bimodal(values) for values in apart]) > 0.9


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [
        (1.0, 3.0, "The return increases in one training; a verdict on the residual needs 10 trainings."),
        (-3.0, -1.0, "The return decreases in one training; a verdict on the residual needs 10 trainings."),
        (-1.0, 3.0, "No gain is shown: the confidence interval contains zero."),
        (0.0, 2.0, "No gain is shown: the confidence interval contains zero."),
        (0.0, 0.0, "The trained controller drives exactly as its expert: no network was better in validation."),
        (np.nan, np.nan, "No conclusion: there is no confidence interval."),
    ],
)
def test_gain_verdict_of_a_training_follows_from_its_interval(low: float, high: float, words: str) -> None:
    assert gain_verdict(Estimate((low + high) / 2, low, high, 20)) == words


def test_bimodality_needs_two_values_per_group() -> None:
    assert not is_bimodal([0.0, 0.0, 0.0, 0.0, 6.0])
    assert not is_bimodal([0.0, 0.0, 6.0])
    assert not is_bimodal([1.0] * 5)
    assert is_bimodal([0.0, 0.0, 0.0, 6.0, 6.0])


def test_differences_of_trainings_use_common_seeds() -> None:
    runs = [rows_of(s1=3.0, s2=5.0, s3=1.0), rows_of(s2=6.0, s1=4.0, s3=float("nan"))]
    found = paired_differences(runs, rows_of(s1=1.0, s2=2.0, s3=0.0, s4=9.0), "return")
    assert found.tolist() == [[2.0, 3.0], [3.0, 4.0]]


def test_probability_of_improvement_counts_ties_half_and_stays_within_bounds() -> None:
    assert probability_of_improvement(np.array([[1.0, 0.0, -1.0, 2.0]])).mean == 0.625
    never = probability_of_improvement(-np.ones((1, 10)))
    assert (never.mean, never.low) == (0.0, 0.0)
    assert never.high == pytest.approx(0.2775, abs=1e-4)  # z^2 / (n + z^2)
    better = probability_of_improvement(np.array([[1.0] * 10, [1.0] * 10, [1.0] * 9 + [-1.0]]))
    assert better.mean == pytest.approx(29 / 30)
    assert 0.0 < better.low < better.mean < better.high <= 1.0


def test_unanimous_trainings_have_an_interval_and_two_have_none() -> None:
    found = probability_of_improvement(np.ones((3, 20)))
    assert (found.mean, found.high) == (1.0, 1.0)
    assert found.low < 0.2
    assert np.isnan(probability_of_improvement(np.ones((2, 20))).low)


@pytest.mark.parametrize("trainings", [3, 5, 10, 20])
@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_probability_of_improvement_has_the_stated_coverage(shift: float, trainings: int) -> None:
    generator = np.random.default_rng(trainings)
    tables = (
        shift
        + generator.standard_normal((REPEATS, trainings, 1))
        + generator.standard_normal((REPEATS, 1, 20))
        + generator.standard_normal((REPEATS, trainings, 20))
    )
    true = float(np.mean(generator.normal(shift, np.sqrt(3.0), 400_000) > 0))
    assert coverage([probability_of_improvement(table) for table in tables], true) >= 0.92


def test_trimming_keeps_enough_values_for_an_interval() -> None:
    found = estimate([100.0, 107.0, 113.0, 120.0], trim=0.25)
    assert found == estimate([100.0, 107.0, 113.0, 120.0])
    assert estimate([100.0, 107.0, 113.0, 120.0, 200.0], trim=0.25).mean == pytest.approx(340.0 / 3)


@pytest.mark.parametrize("status", ["collision", "teleports"])
def test_episodes_that_ended_early_are_not_averaged_with_complete_ones(status: str) -> None:
    complete = {**dict.fromkeys(METRICS, 10.0), "status": "completed"}
    early = {**dict.fromkeys(METRICS, 2.0), "status": status, "seed": 2}
    rows, others = [{**complete, "seed": 1}, early], [{**complete, "seed": seed} for seed in (1, 2)]
    counts = {name: metric_estimate(rows, name).count for name in METRICS}
    assert counts["mean_speed"] == counts["travel_time"] == counts["fuel_ml_per_km"] == 1
    assert metric_estimate(rows, "mean_speed").mean == 10.0
    assert counts["collisions"] == counts["cav_min_ttc"] == counts["human_max_braking"] == 2
    assert counts["return"] == counts["return_eq16"] == (2 if status == "collision" else 1)
    assert paired_difference(rows, others, "travel_time").count == 1
    assert paired_differences([rows], others, "mean_speed").shape == (1, 1)


@given(values=arrays(float, (5, 2), elements=st.floats(1.0, 99.0)), early=arrays(bool, (5, 2)))
def test_a_relative_difference_is_of_the_seeds_of_the_difference(values: Any, early: Any) -> None:
    ours, others = (
        [
            {"seed": seed, "mean_speed": value, "status": "collision" if is_early else "completed"}
            for seed, (value, is_early) in enumerate(zip(values[:, column], early[:, column], strict=True))
        ]
        for column in range(2)
    )
    difference, relative = (each(ours, others, "mean_speed") for each in (paired_difference, relative_difference))
    complete = ~early.any(axis=1)
    assert relative.count == difference.count == complete.sum()
    if complete.any():
        assert relative.mean == pytest.approx(difference.mean / values[complete, 1].mean())


def test_a_relative_difference_is_that_of_the_means_and_unknown_relative_to_zero() -> None:
    ours = [{"seed": seed, "flow": 110.0 + seed} for seed in range(4)]
    others = [{"seed": seed, "flow": 100.0 + seed} for seed in range(1, 5)]
    found = relative_difference(ours, others, "flow")
    assert found.count == 3
    assert found.mean == pytest.approx(10.0 / 102.0)
    assert relative_difference(ours, [{**row, "flow": 0.0} for row in others], "flow").count == 0
    assert relative_difference([], others, "flow").count == 0


def test_regression_finds_the_effect_of_one_standard_deviation_in_95_percent() -> None:
    generator, truth, found = np.random.default_rng(0), np.array([2.0, 0.0, -1.0]), 0
    for _ in range(200):
        predictors = generator.normal(5.0, [1.0, 3.0, 0.5], (30, 3))
        spreads = predictors.std(0)
        effects = regress(predictors, predictors / spreads @ truth + generator.normal(0.0, 4.0, 30))
        found += sum(each.low <= true <= each.high for each, true in zip(effects, truth, strict=True))
    assert 0.92 < found / 600 < 0.98
    exact = regress(np.arange(6.0)[:, None], 3.0 * np.arange(6.0))
    assert exact[0].mean == pytest.approx(3.0 * np.std(np.arange(6.0)))
    assert np.isnan(regress(np.ones((6, 1)), np.arange(6.0))[0].low)
