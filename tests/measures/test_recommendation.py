"""Texts of assessments: they match the numbers in every case."""

from dataclasses import replace
from math import inf, nan

import pytest

from tests.measures.test_effect import GOOD, between
from unjam.measures.recommendation import (
    MIN_VERDICT_SEEDS,
    NOT_RECOMMENDED,
    RECOMMENDED,
    UNDECIDED,
    AccResult,
    ControllerResult,
    acc_finding,
    plotted_result,
    recommended_result,
    required_seeds,
    road_verdict,
)
from unjam.measures.statistics import Estimate
from unjam.text import format_count

BEYOND = between(-3.0, -1.0)
MORE_FLOW = between(-20.0, 40.0)
HELPS = ControllerResult(0.05, "acc", GOOD, BEYOND, MORE_FLOW)
HELPS_MORE = ControllerResult(0.2, "pi", replace(GOOD, travel_time=between(-12.0, -8.0)), BEYOND, MORE_FLOW)
QUICK_AND_WRONG = ControllerResult(
    0.1, "mine.py:bold", replace(GOOD, travel_time=between(-50, -40), flow=between(-90, -50)), BEYOND, MORE_FLOW
)
OPEN = replace(HELPS, difference_to_acc=between(-5.0, 3.0), missing_seeds=10.0)
ACC_HELPS = AccResult(0.2, GOOD)
ACC_CHANGES_NOTHING = AccResult(0.2, replace(GOOD, travel_time=between(-1.0, 1.0)))


def test_recommendation_has_its_numbers() -> None:
    assert HELPS.summary == (
        "acc at a penetration rate of 5 %: recommended. Travel time -4.0 [-6.0, -2.0] s (-4.0 %), flow "
        "+10 [-10, +30] veh/h, fuel +0.0 [+0.0, +0.0] ml/km compared with the human baseline; travel time "
        "-2.0 [-3.0, -1.0] s compared with ACC vehicles alone; 20 test seeds."
    )


def test_a_controller_that_sacrifices_its_cavs_is_not_recommended() -> None:
    slow = replace(HELPS, cav_speed_change=between(-0.97, -0.93))
    assert slow.verdict == "not recommended"
    assert slow.reasons == ["the CAVs themselves are 95 % slower than ACC vehicles alone (limit 10 %)"]
    assert not replace(HELPS, cav_speed_change=between(-0.5, -0.05)).reasons


def test_rejection_has_its_reason() -> None:
    assert QUICK_AND_WRONG.summary == (
        "mine.py:bold at a penetration rate of 10 %: not recommended: flow is lower than that of the human "
        "baseline: -70 [-90, -50] veh/h."
    )


@pytest.mark.parametrize(
    ("beyond", "shown"),
    [
        (between(-1.0, 3.0), "not shown to be shorter than with ACC vehicles alone"),
        (between(1.0, 3.0), "longer than with ACC vehicles alone"),
        (Estimate(nan, nan, nan, 0), "not shown to be shorter than with ACC vehicles alone"),
    ],
)
def test_controller_must_be_better_than_acc_vehicles(beyond: Estimate, shown: str) -> None:
    found = replace(HELPS, difference_to_acc=beyond)
    assert [shown in reason for reason in found.reasons] == [True]
    assert recommended_result([found]) is None


def test_difference_to_acc_vehicles_must_not_be_too_small() -> None:
    found = replace(HELPS, difference_to_acc=between(-0.4, -0.2))
    assert found.reasons == [
        "travel time differs from that with ACC vehicles alone at this penetration rate by less than 0.5 %, "
        "which is too small to matter: -0.3 [-0.4, -0.2] s"
    ]
    assert recommended_result([found]) is None


@pytest.mark.parametrize("time", [between(0.1, 0.3), between(-0.3, -0.1)])
def test_too_small_effect_of_acc_vehicles_is_reported(time: Estimate) -> None:
    little = AccResult(0.2, replace(GOOD, travel_time=time))
    small = "by less than 0.5 %, which is too small to matter"
    assert acc_finding([little]) == f"ACC vehicles alone change travel time {small}."
    assert f"travel time differs {small}, compared with the human baseline." in little.summary
    assert acc_finding([little, ACC_HELPS]).endswith("-4.0 [-6.0, -2.0] s (-4.0 %) at 20 %.")


def test_largest_gain_is_recommended_in_one_sentence() -> None:
    judged = [HELPS, QUICK_AND_WRONG, HELPS_MORE, OPEN]
    assert recommended_result(judged) == plotted_result(judged) == HELPS_MORE
    assert road_verdict(judged) == (
        RECOMMENDED,
        "Recommended: pi at a penetration rate of 20 %, because travel time is 10.0 s (10.0 %) shorter than in "
        "human-only traffic and 2.0 s shorter than with ACC vehicles alone.",
    )


def test_without_recommendation_the_shortest_travel_time_is_named_and_plotted() -> None:
    judged = [QUICK_AND_WRONG, replace(HELPS_MORE, effect=replace(GOOD, failed_episodes=1))]
    assert recommended_result(judged) is None
    assert road_verdict(judged) == (
        NOT_RECOMMENDED,
        "Not recommended: no controller passes the rule; the fastest is mine.py:bold at a penetration rate of 10 %, "
        "but flow is lower than that of the human baseline: -70 [-90, -50] veh/h.",
    )
    assert plotted_result(judged) == QUICK_AND_WRONG
    assert acc_finding([ACC_HELPS]).startswith("ACC vehicles alone shorten travel time: -4.0 [-6.0, -2.0] s (-4.0 %)")


def test_without_tested_controllers_nothing_is_recommended_or_plotted() -> None:
    assert plotted_result([]) is None
    worse = AccResult(0.1, replace(GOOD, travel_time=between(1.0, 2.0)))
    assert road_verdict([]).sentence == (
        "Not recommended: no controller was tested, or all were rejected on the tuning seeds."
    )
    assert acc_finding([worse, ACC_CHANGES_NOTHING]) == (
        "ACC vehicles alone lengthen travel time: +1.5 [+1.0, +2.0] s (+1.5 %) at 10 %."
    )


def test_few_test_seeds_show_nothing_of_acc_vehicles() -> None:
    few = AccResult(0.1, replace(GOOD, travel_time=replace(between(1.0, 2.0), count=MIN_VERDICT_SEEDS - 1)))
    assert acc_finding([few]) == "ACC vehicles alone have fewer than 10 test seeds."
    assert "is not shown to differ (9 test seeds, where 10 are needed)" in few.summary


def test_infeasible_cavs_are_rejected_with_few_test_seeds() -> None:
    few = replace(GOOD, travel_time=between(-6.0, -2.0, 1), feasibility="brakes with 9.0 m/s2")
    assert replace(HELPS, effect=few).reasons == ["infeasible: brakes with 9.0 m/s2"]
    assert replace(HELPS, effect=replace(few, feasibility=GOOD.feasibility)).reasons[0].startswith("1 test seed, where")


def test_counts_of_one_are_singular() -> None:
    one = replace(GOOD, failed_episodes=1, early_ends=1, teleports=1, collisions=1.0)
    reasons = replace(HELPS, effect=one).reasons
    starts = ["1 episode failed", "1 episode ended early", "1 more vehicle teleported", "1 more vehicle in contact"]
    assert [reason.startswith(start) for reason, start in zip(reasons, starts, strict=True)] == [True] * 4
    assert format_count(2_000, "episode") == "2,000 episodes"


def test_infeasible_acc_vehicles_are_reported() -> None:
    braking = AccResult(0.1, replace(GOOD, feasibility="brakes with 7.0 m/s2"))
    assert braking.summary.endswith(" ACC vehicles are infeasible themselves: brakes with 7.0 m/s2.")


def test_controller_that_changes_nothing_is_reported() -> None:
    idle = replace(HELPS, difference_to_acc=between(0.0, 0.0))
    assert idle.reasons == ["the controller never intervened: all travel times are those of ACC vehicles alone"]


@pytest.mark.parametrize(
    ("result", "question"),
    [
        (OPEN, "with 20 test seeds, the difference of travel time to ACC vehicles alone is -1.0 [-5.0, +3.0] s"),
        (
            replace(OPEN, effect=replace(GOOD, travel_time=between(-12.0, 2.0))),
            "with 20 test seeds, the difference of travel time to the human baseline is -5.0 [-12.0, +2.0] s",
        ),
        (
            replace(OPEN, effect=replace(GOOD, travel_time=between(-20.0, -2.0))),
            "with 20 test seeds, the difference of travel time to ACC vehicles alone is -1.0 [-5.0, +3.0] s",
        ),
        (
            replace(
                OPEN, difference_to_acc=between(-8.0, 12.0), effect=replace(GOOD, travel_time=between(-40.0, 24.0))
            ),
            "with 20 test seeds, the difference of travel time to ACC vehicles alone is +2.0 [-8.0, +12.0] s",
        ),
        (
            replace(OPEN, difference_to_acc=between(-1.0, 1.0, 4)),
            "with 4 test seeds, where a verdict needs 10, "
            "the difference of travel time to ACC vehicles alone is +0.0 [-1.0, +1.0] s",
        ),
        (
            replace(
                OPEN, difference_to_acc=between(0.7, 4.7, 4), effect=replace(GOOD, travel_time=between(-7.0, 13.0))
            ),
            "with 4 test seeds, where a verdict needs 10, "
            "the difference of travel time to ACC vehicles alone is +2.7 [+0.7, +4.7] s, so far longer",
        ),
    ],
)
def test_open_question_names_its_comparison(result: ControllerResult, question: str) -> None:
    assert result.summary == f"acc at a penetration rate of 5 %: not yet known: {question}."
    assert road_verdict([QUICK_AND_WRONG, result]) == (
        UNDECIDED,
        f"Not yet known whether to recommend acc at a penetration rate of 5 %: {question}.",
    )


@pytest.mark.parametrize(
    ("low", "high", "count", "narrow", "needed"),
    [
        (-5.0, 3.0, 20, 0.1, 20 * 4.0**2),  # ±4 around -1: as wide as the mean with a quarter of the width
        (-5.0, 3.0, 20, 2.0, 20 * 2.0**2),  # narrow enough before it excludes zero
        (-3.0, -1.0, 40, 0.1, MIN_VERDICT_SEEDS),
        (0.0, 0.0, 3, 0.1, MIN_VERDICT_SEEDS),
    ],
)
def test_required_seeds_follow_from_the_interval_width(
    low: float, high: float, count: int, narrow: float, needed: float
) -> None:
    assert required_seeds(between(low, high, count), narrow) == needed
    assert required_seeds(Estimate(-1.0, nan, nan, 2), narrow) == inf


def test_property_effect_is_reported_only_if_properties_are_set() -> None:
    split = replace(ACC_HELPS, property_effect=between(-4.0, -2.0))
    assert split.summary.endswith("change -3.0 [-4.0, -2.0] s of travel time.")
    assert "properties" not in ACC_HELPS.summary


def test_nearly_free_road_has_nothing_to_gain() -> None:
    free = [{"status": "completed", "travel_time": 103.2, "delay": 3.2} for _ in range(3)]
    for results in ([QUICK_AND_WRONG], [OPEN], []):
        assert road_verdict(results, free) == (
            NOT_RECOMMENDED,
            "Not recommended: there is nothing to gain, because human-only traffic is within 4 % of free flow.",
        )
    assert road_verdict([HELPS], free).verdict == RECOMMENDED
    for busy in ([{**row, "delay": 20.0} for row in free], [{**row, "delay": nan} for row in free], []):
        assert road_verdict([OPEN], busy).verdict == UNDECIDED


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"baseline_teleport_share": 0.02},
            "nothing can be concluded: in the human baseline SUMO teleports or removes 2.0 %",
        ),
        ({"teleports": 3}, "3 more vehicles teleported or removed than without CAVs"),
    ],
)
def test_teleports_prevent_a_recommendation(changes: dict[str, float], words: str) -> None:
    assert words in replace(HELPS, effect=replace(GOOD, **changes)).reasons[0]  # pyright: ignore[reportArgumentType]
    assert not replace(HELPS, effect=replace(GOOD, baseline_teleport_share=0.01, teleports=-3)).reasons
