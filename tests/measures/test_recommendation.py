"""Do the words say what the numbers say, whichever way they went?"""

from dataclasses import replace

from tests.measures.test_effect import GOOD, between
from unjam.measures.effect import Judged, headline, recommended, shown_beside

HELPS = Judged(0.05, "acc", GOOD)
HELPS_MORE = Judged(0.2, "pi", replace(GOOD, travel_time=between(-12.0, -8.0)))
QUICK_AND_WRONG = Judged(
    0.1, "mine.py:bold", replace(GOOD, travel_time=between(-50, -40), flow=between(-90, -50))
)


def test_what_passes_is_recommended_with_its_numbers() -> None:
    assert HELPS.words == (
        "5 % CAVs that drive as acc: recommended. Travel time -4.0 [-6.0, -2.0] s (-4.0 %), flow "
        "+10 [-10, +30] veh/h, fuel +0.0 [+0.0, +0.0] ml/km, on 20 fresh seeds."
    )


def test_a_refusal_says_why() -> None:
    assert QUICK_AND_WRONG.words == (
        "10 % CAVs that drive as mine.py:bold: not recommended, for flow is lower than people's alone: "
        "-70 [-90, -50] veh/h."
    )


def test_the_answer_is_the_largest_gain_among_those_that_pass() -> None:
    judged = [HELPS, QUICK_AND_WRONG, HELPS_MORE]
    assert recommended(judged) == shown_beside(judged) == HELPS_MORE
    assert headline(judged) == (
        "20 % CAVs are recommended on this road, driving as pi: travel time -10.0 [-12.0, -8.0] s a vehicle "
        "(-10.0 %)."
    )


def test_where_nothing_passes_nothing_is_recommended_and_the_quickest_is_shown() -> None:
    judged = [QUICK_AND_WRONG, Judged(0.2, "pi", replace(GOOD, failed=1))]
    assert recommended(judged) is None
    assert headline(judged) == (
        "No CAVs are recommended on this road: none of the shares judged on fresh seeds passes the rule "
        "(1 of 2 slow traffic or lose flow)."
    )
    assert shown_beside(judged) == QUICK_AND_WRONG


def test_where_nobody_was_judged_nothing_is_recommended_or_shown() -> None:
    assert shown_beside([]) is None
    assert headline([]) == (
        "No CAVs are recommended on this road: all that was tried did worse than people alone on the seeds "
        "that choose, or failed."
    )
