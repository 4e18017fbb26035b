from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from unjam.measures.metrics import METRICS
from unjam.measures.statistics import Estimate, estimate
from unjam.reports.results import Results
from unjam.reports.summary import (
    common_baseline,
    format_difference,
    key_figures,
    main_finding,
    report_columns,
    report_notes,
    report_title,
)

USUAL: dict[str, Any] = {"status": "completed", "reason": "", **dict.fromkeys(METRICS, 1.0), "min_time_gap": 2.0}
USUAL |= {"shield_override_share": 0.0, "collisions": 0.0}


def rows_of(returns: list[float], **changes: Any) -> list[dict[str, Any]]:
    """A row per return, with seeds from zero."""
    return [{**USUAL, "seed": seed, "return": value, **changes} for seed, value in enumerate(returns)]


def failed_rows(count: int) -> list[dict[str, Any]]:
    nothing = dict.fromkeys(METRICS, float("nan"))
    return [{**USUAL, **nothing, "seed": seed, "status": "failed", "reason": "no road"} for seed in range(count)]


def trained_on_pi(trained: list[float], pi: list[float], reward: str = "released", **changes: Any) -> Results:
    rows = {"human": rows_of([0.0] * len(pi)), "pi": rows_of(pi), "trained": rows_of(trained, **changes)}
    about = {"scenario": "ring", "reward": reward, "trained": "trained", "expert": "pi"}
    return Results(Path("runs/ring-001"), about, rows, {})


def driven(folder: str = "runs/drive-001", scenario: str = "ring", **rows: list[dict[str, Any]]) -> Results:
    return Results(Path(folder), {"scenario": scenario, "reward": "released"}, rows, {})


EXPERT = [100.0, 140.0, 180.0, 120.0]


def test_what_everybody_gains_beside_people_alone_comes_first_then_the_expert() -> None:
    nowhere: dict[str, Any] = {"travel_time": float("nan")}  # nobody leaves a ring
    result = trained_on_pi([112.0, 148.0, 190.0, 130.0], EXPERT, mean_speed=1.5, fuel_ml_per_km=0.8, **nowhere)
    lead = main_finding(result)
    assert lead.startswith("Beside people alone on ring, 4 held-out seeds paired: ")
    assert "mean speed +0.50" in lead
    assert "fuel -0.2" in lead
    assert f"Return beyond its expert, pi: {format_difference(estimate([12.0, 8.0, 10.0, 10.0]))}." in lead
    assert lead.endswith("It earns more: that is one training, and a residual pays where 10 show it.")


def test_an_expert_that_earns_more_than_its_own_is_told_of() -> None:
    result = trained_on_pi([112.0, 148.0, 190.0, 130.0], EXPERT)
    result.rows["acc"] = rows_of([500.0] * 4)
    assert "Beyond acc, the expert that earns most: -355" in main_finding(result)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "; a car could drive so."),
        ({"status": "collision", "collisions": 2.0}, "; no car could drive so: 2 vehicles in contact"),
    ],
)
def test_the_lead_says_whether_a_car_could_drive_so(changes: dict[str, Any], words: str) -> None:
    safe: dict[str, Any] = {"cav_min_ttc": 9.0, "overridden": 0.0, "people_beyond_4_5": 0.0, **changes}
    assert words in main_finding(trained_on_pi([1.0, 2.0], [1.0, 2.0], **safe))


def test_a_gain_below_zero_is_said_to_be_less() -> None:
    lead = main_finding(trained_on_pi([90.0, 120.0, 170.0, 100.0], EXPERT))
    assert "-15 [" in lead
    assert "It earns less: that is one training" in lead


@pytest.mark.parametrize("trained", [[125.0, 125.0, 205.0, 110.0], [90.0, 150.0, 155.0, 125.0], EXPERT])
def test_a_gain_that_may_be_zero_is_not_claimed(trained: list[float]) -> None:
    assert main_finding(trained_on_pi(trained, EXPERT)).endswith("No gain is shown: the interval holds zero.")


def test_one_seed_shows_no_gain_and_makes_up_no_interval() -> None:
    result = trained_on_pi([150.0], [100.0])
    lead = main_finding(result)
    assert lead.endswith("+50. There is no interval: nothing is shown.")
    assert "pays" not in lead
    assert "holds zero" not in lead
    assert not any("nan" in text for text in (lead, *(card["detail"] for card in key_figures(result))))


def test_a_network_without_an_expert_is_told_by_its_return() -> None:
    about = {"scenario": "ring", "reward": "released", "trained": "trained", "expert": "none"}
    lead = main_finding(Results(Path("x"), about, {"trained": rows_of([10.0, 20.0])}, {}))
    assert lead == "On 2 held-out seeds the trained controller earns 15 an episode."


def test_seeds_are_those_on_which_both_ran() -> None:
    people = rows_of([1.0] * 3, travel_time=100.0)
    result = driven(human=people, pi=[*rows_of([2.0, 2.0], travel_time=90.0), {**failed_rows(1)[0], "seed": 2}])
    assert main_finding(result).startswith("Beside people alone on ring, 2 episodes with the same seeds paired: ")


def test_drives_are_told_by_speed_and_share_of_the_limit() -> None:
    lead = main_finding(driven(pi=rows_of([1.0, 2.0], mean_speed=4.0, speed_limit_ratio_steady=0.83)))
    assert "pi on ring, 2 episodes" in lead
    assert "4.00 m/s on average" in lead
    assert "83 % of the limit" in lead


def test_where_every_episode_failed_it_says_so_and_shows_no_nan() -> None:
    result = driven(pi=failed_rows(2))
    said = [main_finding(result), *report_notes(result), *(card["value"] for card in key_figures(result))]
    assert not any("nan" in text for text in said)


def test_a_plain_result_has_no_notes() -> None:
    assert report_notes(trained_on_pi([1.0, 2.0], [1.0, 2.0])) == []


def test_early_ends_are_noted_once_of_every_driver() -> None:
    rows = [*rows_of([1.0] * 3), *rows_of([1.0], status="collision"), *failed_rows(1)]
    note = "pi: 1 of 5 episodes ended early: collision; means are over complete episodes only"
    assert report_notes(driven(pi=rows)) == [f"{note}."]
    told = driven(pi=rows)
    told.metadata["notes"] = [note]
    assert report_notes(told) == [f"{note}."]
    result = trained_on_pi([1.0], [1.0])
    result.rows["pi"][0]["status"] = "collision"
    assert [note[:26] for note in report_notes(result)] == ["pi: 1 of 1 episodes ended "]


def test_close_driving_is_noted_with_the_reward_that_does_not_mind() -> None:
    [note] = report_notes(trained_on_pi([1.0], [1.0], min_headway=0.42))
    assert "smallest time headway is 0.42 s" in note
    assert "(released) does not ask for distance" in note


def test_close_driving_is_not_blamed_on_a_reward_that_asks_for_distance() -> None:
    [note] = report_notes(trained_on_pi([1.0], [1.0], reward="eq16", min_headway=0.42))
    assert note == "trained drives close: its smallest time headway is 0.42 s."


@pytest.mark.parametrize("headway", [1.0, float("inf"), float("nan")])
def test_no_note_where_nobody_drove_close(headway: float) -> None:
    assert report_notes(trained_on_pi([1.0], [1.0], min_headway=headway)) == []


def test_leaning_on_the_safety_check_is_noted() -> None:
    [note] = report_notes(trained_on_pi([1.0], [1.0], shield_override_share=0.034, shield_max_braking=5.25))
    assert "overrides 3.4 % of commands" in note
    assert "5.2 m/s² harder" in note
    assert report_notes(trained_on_pi([1.0], [1.0], shield_override_share=0.009)) == []


def test_traffic_beyond_the_limit_is_explained() -> None:
    [note] = report_notes(trained_on_pi([1.0], [1.0], speed_limit_ratio_steady=1.034))
    assert "With trained all vehicles drive at 103 % of the limit" in note
    assert report_notes(trained_on_pi([1.0], [1.0], speed_limit_ratio_steady=1.005)) == []


def test_a_comparison_of_drivers_warns_about_each() -> None:
    found = driven(human=rows_of([1.0]), pi=rows_of([1.0], min_headway=0.3, status="collision"))
    assert [note.split()[0] for note in report_notes(found)] == ["pi:", "pi"]


def test_notes_are_about_the_trained_controller_and_not_its_expert() -> None:
    result = trained_on_pi([1.0], [1.0])
    result.rows["pi"][0]["min_time_gap"] = 0.3
    assert report_notes(result) == []


def test_cards_show_the_humans_beside_first_and_the_gain_on_the_expert_last() -> None:
    result = trained_on_pi([112.0, 148.0, 190.0, 130.0], EXPERT, speed_limit_ratio_steady=0.914)
    cards = key_figures(result)
    assert cards[0]["label"] == "Mean speed / limit, steady"
    assert cards[0]["value"] == "91 %"
    assert cards[0]["detail"] == "all-human: 100 %"
    assert cards[-1]["label"] == "Return beyond the expert"
    assert cards[-1]["value"] == "+10"


def test_cards_of_a_drive_without_humans_compare_with_nothing() -> None:
    cards = key_figures(driven(pi=rows_of([1.0, 2.0])))
    assert len(cards) == 3
    assert all(card["detail"] == "pi" for card in cards)


def test_title_says_what_was_compared() -> None:
    assert report_title([driven(human=rows_of([1.0]), pi=rows_of([1.0]))]) == "ring: human, pi"
    assert report_title([trained_on_pi([1.0], [1.0])]) == "ring: a trained residual on pi"
    both = [driven(pi=rows_of([1.0])), driven(scenario="ring-warm", pi=rows_of([1.0]))]
    assert report_title(both) == "ring, ring-warm: 2 results compared"


def test_a_network_without_an_expert_is_not_titled_a_residual_on_none() -> None:
    about = {"scenario": "ring", "reward": "released", "trained": "trained", "expert": "none"}
    assert "none" not in report_title([Results(Path("x"), about, {"trained": rows_of([1.0])}, {})])


def test_columns_of_one_folder_are_its_drivers() -> None:
    assert [column.name for column in report_columns([trained_on_pi([1.0], [1.0])])] == ["human", "pi", "trained"]


def test_columns_of_several_folders_say_whose_they_are() -> None:
    names = [column.name for column in report_columns([driven("a", pi=rows_of([1.0])), driven("b", pi=rows_of([2.0]))])]
    assert names == ["a: pi", "b: pi"]


def test_drivers_that_runs_have_in_common_are_shown_once() -> None:
    first, second = trained_on_pi([1.0], [5.0]), trained_on_pi([2.0], [5.0])
    second = Results(Path("runs/ring-002"), second.metadata, second.rows, {})
    names = [column.name for column in report_columns([first, second])]
    assert names == ["human", "pi", "ring-001: trained", "ring-002: trained"]


def test_folders_of_the_same_name_are_both_shown() -> None:
    columns = report_columns([driven("old/ring", pi=rows_of([1.0])), driven("new/ring", pi=rows_of([2.0]))])
    assert [column.rows[0]["return"] for column in columns] == [1.0, 2.0]
    assert len({column.name for column in columns}) == 2


def test_the_same_driver_on_another_road_is_not_taken_for_the_same() -> None:
    ring, warm = trained_on_pi([1.0], [5.0]), trained_on_pi([2.0], [9.0])
    warm = Results(Path("runs/warm-001"), {**warm.metadata, "scenario": "ring-warm"}, warm.rows, {})
    returns = [column.rows[0]["return"] for column in report_columns([ring, warm]) if "pi" in column.name]
    assert returns == [5.0, 9.0]


def test_folders_are_compared_with_who_drove_the_same_episodes_in_all() -> None:
    first, second = trained_on_pi([1.0], [5.0]), trained_on_pi([2.0], [5.0])
    second = replace(second, folder=Path("runs/ring-002"))
    assert common_baseline([first]) == common_baseline([first, second]) == "human"
    elsewhere = replace(second, rows={**second.rows, "human": rows_of([9.0])})
    assert common_baseline([first, elsewhere]) == ""
    assert common_baseline([driven("a", human=rows_of([1.0]), pi=rows_of([1.0]))] * 2) == ""
    assert common_baseline([driven(pi=rows_of([1.0]))]) == ""


def test_a_difference_shows_its_sign() -> None:
    assert format_difference(Estimate(3.4, -0.6, 7.0, 5)) == "+3 [-1, +7]"
