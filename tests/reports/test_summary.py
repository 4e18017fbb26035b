from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from unjam.measures.metrics import METRICS
from unjam.measures.statistics import Estimate, estimate
from unjam.measures.verdict import Verdict, short_table_metrics
from unjam.reports.results import Results
from unjam.reports.summary import (
    baseline_differences,
    command_differences,
    common_baseline,
    compare_networks,
    csv_text,
    first_network_column,
    format_difference,
    key_figures,
    main_finding,
    mismatch_warning,
    name_baselines,
    report_columns,
    report_notes,
    report_title,
)

USUAL: dict[str, Any] = {"status": "completed", "reason": "", **dict.fromkeys(METRICS, 1.0), "min_time_gap": 2.0}
USUAL |= {"shield_override_share": 0.0, "collisions": 0.0, "time_behind_leader": float("nan")}


def rows_of(returns: list[float], **changes: Any) -> list[dict[str, Any]]:
    """A row per return, with seeds from zero."""
    return [{**USUAL, "seed": seed, "return": value, **changes} for seed, value in enumerate(returns)]


def failed_rows(count: int) -> list[dict[str, Any]]:
    undefined = dict.fromkeys(METRICS, float("nan"))
    return [{**USUAL, **undefined, "seed": seed, "status": "failed", "reason": "no road"} for seed in range(count)]


def trained_on_pi(trained: list[float], pi: list[float], reward: str = "released", **changes: Any) -> Results:
    rows = {"human": rows_of([0.0] * len(pi)), "pi": rows_of(pi), "trained": rows_of(trained, **changes)}
    metadata = {"scenario": "ring", "reward": reward, "trained": "trained", "expert": "pi"}
    return Results(Path("runs/ring-001"), metadata, rows, {})


def drive_results(folder: str = "runs/drive-001", scenario: str = "ring", **rows: list[dict[str, Any]]) -> Results:
    return Results(Path(folder), {"scenario": scenario, "reward": "released"}, rows, {})


EXPERT = [100.0, 140.0, 180.0, 120.0]


def test_finding_compares_with_the_expert() -> None:
    finding = main_finding(trained_on_pi([112.0, 148.0, 190.0, 130.0], EXPERT))
    gain = format_difference(estimate([12.0, 8.0, 10.0, 10.0]))
    assert finding.startswith(f"Return difference to its expert, pi (return 135), on 4 test seeds: {gain}. ")
    assert "The return increases in one training; a verdict on the residual needs 10 trainings. " in finding
    assert finding.endswith("Difference of travel time to pi: +0.0 [+0.0, +0.0] s (no difference is shown).")


def test_finding_says_which_network_was_kept() -> None:
    result = trained_on_pi([112.0, 148.0, 190.0, 130.0], EXPERT)
    validations = {100: None, 200: 90.0, 300: 130.0, 400: 120.0}
    result.progress.extend(
        {"environment_steps": step, "return_validation": value, "return_expert": 100.0}
        for step, value in validations.items()
    )
    assert "The network is that after 300 environment steps, the best in validation." in main_finding(result)


def test_finding_compares_with_the_expert_of_highest_return() -> None:
    result = trained_on_pi([112.0, 148.0, 190.0, 130.0], EXPERT)
    result.rows["acc"] = rows_of([500.0] * 4)
    assert "Return difference to acc, the expert with the highest return: -355" in main_finding(result)


def test_finding_reports_a_negative_gain() -> None:
    finding = main_finding(trained_on_pi([90.0, 120.0, 170.0, 100.0], EXPERT))
    assert "-15 [" in finding
    assert "The return decreases in one training" in finding


@pytest.mark.parametrize("trained", [[125.0, 125.0, 205.0, 110.0], [90.0, 150.0, 155.0, 125.0]])
def test_finding_claims_no_gain_that_may_be_zero(trained: list[float]) -> None:
    finding = main_finding(trained_on_pi(trained, EXPERT))
    assert "No gain is shown: the confidence interval contains zero." in finding


def test_finding_says_that_the_controller_is_its_expert() -> None:
    assert "+0 [+0, +0]. The trained controller drives exactly as its expert" in main_finding(
        trained_on_pi(EXPERT, EXPERT)
    )


@pytest.mark.parametrize(
    ("other", "words"),
    [
        ({"scenario": "ring", "pi": rows_of([1.0, 2.0])}, "different seeds: differences between them are not effects"),
        ({"scenario": "merge", "pi": rows_of([1.0])}, "different roads: "),
        ({"scenario": "ring", "idm": rows_of([5.0])}, ""),
    ],
)
def test_folders_of_other_roads_or_seeds_are_compared_with_a_warning(other: dict[str, Any], words: str) -> None:
    results = [drive_results("a", pi=rows_of([1.0])), drive_results("b", **other)]
    assert words in (found := mismatch_warning(results))
    assert bool(found) == bool(words)
    assert mismatch_warning(results[:1]) == ""


def test_roads_of_one_training_are_compared_without_a_warning(tmp_path: Path) -> None:
    results = [drive_results(str(tmp_path / road), road, pi=rows_of([1.0])) for road in ("ring", "merge")]
    assert "different roads" in mismatch_warning(results)
    (tmp_path / "config.toml").write_text("steps = 1")
    assert mismatch_warning(results) == ""


def test_finding_on_one_seed_has_no_interval() -> None:
    result = trained_on_pi([150.0], [100.0])
    finding = main_finding(result)
    assert "+50. No conclusion: there is no confidence interval." in finding
    assert "verdict" not in finding
    assert "contains zero" not in finding
    assert not any("nan" in text for text in (finding, *(card["detail"] for card in key_figures(result))))


def test_finding_without_an_expert_has_the_return() -> None:
    metadata = {"scenario": "ring", "reward": "released", "trained": "trained", "expert": "none"}
    finding = main_finding(Results(Path("x"), metadata, {"trained": rows_of([10.0, 20.0])}, {}))
    assert finding == "On 2 test seeds the mean return of the trained controller is 15."


def column_verdicts(results: list[Results]) -> list[Verdict]:
    return [column.verdict for column in report_columns(results) if column.verdict is not None]


def test_drivers_are_compared_with_the_baseline_of_their_folder() -> None:
    times = {"human": 90.0, "pi": 80.0, "mine": 85.0}
    rows = {
        name: [row | {"travel_time": time + number} for number, row in enumerate(rows_of([1.0] * 4))]
        for name, time in times.items()
    }
    result = drive_results(human=rows["human"], pi=rows["pi"], mine=rows["mine"])
    requested = replace(result, metadata={**result.metadata, "baseline": "pi"})
    found = column_verdicts([requested])
    assert [(each.driver, each.is_better) for each in found] == [("human", False), ("mine", False)]
    assert found[1].comparison == "travel time worse than that of pi, 4 paired seeds"
    assert common_baseline([requested]) == name_baselines([requested]) == "pi"
    assert name_baselines([result]) == "the human baseline"
    unknown = replace(result, metadata={**result.metadata, "baseline": "gone"})
    assert [column_verdict.driver for column_verdict in column_verdicts([unknown])] == ["pi", "mine"]


def test_drivers_that_are_compared_with_human_drivers_have_verdicts_and_no_finding() -> None:
    human = rows_of([1.0] * 3, travel_time=100.0)
    result = drive_results(human=human, pi=[*rows_of([2.0, 2.0], travel_time=90.0), {**failed_rows(1)[0], "seed": 2}])
    assert main_finding(result) == ""
    (verdict,) = column_verdicts([result])
    assert (verdict.driver, verdict.is_better) == ("pi", None)
    assert "2 paired seeds" in verdict.comparison


def test_each_folder_is_compared_with_its_own_human_drivers() -> None:
    closed = {"travel_time": float("nan")}

    def result(folder: str, human: float) -> Results:
        others = rows_of([1.0] * 4, mean_speed=5.0, **closed)
        varied = [{**row, "mean_speed": human + 0.01 * number} for number, row in enumerate(others)]
        return drive_results(folder, human=varied, pi=others)

    found = column_verdicts([result("runs/slow", 1.0), result("runs/fast", 9.0)])
    assert [(each.driver, each.is_better) for each in found] == [("slow: pi", True), ("fast: pi", False)]


CLOSED: dict[str, Any] = {"travel_time": float("nan"), "mean_speed": 4.0, "speed_limit_ratio_steady": 0.83}
OPEN: dict[str, Any] = {"travel_time": 61.2, "outflow_veh_per_h": 1827.0}
RECORDED: dict[str, Any] = {**CLOSED, "time_behind_leader": 9.0, "fuel_by_power": 60.0, "outflow_veh_per_h": 900.0}


@pytest.mark.parametrize(
    ("road", "means"),
    [
        (CLOSED, "mean speed 4.00 m/s, mean speed / limit 0.830 (steady)"),
        (OPEN, "travel time 61.2 s (departure delay included), flow 1827 veh/h"),
        (RECORDED, "fuel by power 60.0 ml/km, flow 900 veh/h"),
    ],
)
def test_finding_without_a_comparison_has_what_matters_on_the_road(road: dict[str, Any], means: str) -> None:
    assert main_finding(drive_results(pi=rows_of([1.0, 2.0], **road))) == f"Means of 2 episodes on ring: pi: {means}."
    several = drive_results(pi=rows_of([1.0], **road), acc=failed_rows(1))
    assert main_finding(several) == f"Means of 1 episode on ring: pi: {means}; acc: all episodes failed."


@pytest.mark.parametrize("road", [CLOSED, OPEN, RECORDED])
def test_key_figures_and_differences_have_fuel_by_power_alone(road: dict[str, Any]) -> None:
    assert [card["label"] for card in key_figures(drive_results(pi=rows_of([1.0], **road))) if "fuel" in card["label"]]
    columns = report_columns([drive_results(human=rows_of([1.0], **road), pi=rows_of([1.0], **road))])
    labels = [row["label"] for row in baseline_differences(columns)["rows"]]
    assert [label for label in labels if "fuel" in label] == ["fuel by power"]
    assert [name for name in short_table_metrics({"pi": rows_of([1.0], **road)}) if "ml_per_km" in name] == []


def test_human_drivers_have_no_notes_about_cavs() -> None:
    assert report_notes(drive_results(human=rows_of([1.0], min_time_gap=0.3, speed_limit_ratio_steady=1.1))) == []


def test_columns_have_the_order_of_all_tables() -> None:
    names = "runs/ring-002", "pi", "unjam:best", "human", "runs/ring-001", "acc:time_headway=1"
    expected = ["human", "pi", "acc:time_headway=1", "runs/ring-002", "unjam:best", "runs/ring-001"]
    rows: dict[str, Any] = {name: rows_of([1.0]) for name in names}
    result = drive_results(**rows)
    assert [column.name for column in report_columns([result])] == expected
    folders = [replace(result, folder=Path(f"runs/{name}")) for name in "ab"]
    assert [column.name for column in report_columns(folders)][:4] == [
        *("a: human", "b: human", "a: pi", "a: acc:time_headway=1")
    ]


def test_results_of_failed_episodes_show_no_nan() -> None:
    result = drive_results(pi=failed_rows(2))
    texts = [main_finding(result), *report_notes(result), *(card["value"] for card in key_figures(result))]
    assert not any("nan" in text for text in texts)


def test_results_without_caveats_have_no_notes() -> None:
    assert report_notes(trained_on_pi([1.0, 2.0], [1.0, 2.0])) == []


def test_early_ends_of_each_driver_are_noted_once() -> None:
    rows = [*rows_of([1.0] * 3), *rows_of([1.0], status="collision"), *failed_rows(1)]
    note = "pi: 1 of 5 episodes ended early: collision; means are over complete episodes only"
    assert report_notes(drive_results(pi=rows)) == [f"{note}."]
    noted = drive_results(pi=rows)
    noted.metadata["notes"] = [note]
    assert report_notes(noted) == [f"{note}."]
    result = trained_on_pi([1.0], [1.0])
    result.rows["pi"][0]["status"] = "collision"
    assert [note[:26] for note in report_notes(result)] == ["pi: 1 of 1 episode ended e"]


def test_close_following_is_noted_with_a_reward_without_distance() -> None:
    [note] = report_notes(trained_on_pi([1.0], [1.0], min_time_gap=0.42))
    assert "min time gap is 0.42 s" in note
    assert "(released) has no term for distance" in note


def test_close_following_is_not_attributed_to_a_reward_with_distance() -> None:
    [note] = report_notes(trained_on_pi([1.0], [1.0], reward="eq16", min_time_gap=0.42))
    assert note == "trained follows closely: its min time gap is 0.42 s."


@pytest.mark.parametrize("time_gap", [1.0, float("inf"), float("nan")])
def test_larger_time_gaps_are_not_noted(time_gap: float) -> None:
    assert report_notes(trained_on_pi([1.0], [1.0], min_time_gap=time_gap)) == []


def test_overrides_of_the_safety_check_are_noted() -> None:
    [note] = report_notes(trained_on_pi([1.0], [1.0], shield_override_share=0.034, shield_max_braking=5.25))
    assert "overrides 3.4 % of commands" in note
    assert "adds up to 5.2 m/s² of braking" in note
    assert report_notes(trained_on_pi([1.0], [1.0], shield_override_share=0.009)) == []


def test_traffic_above_the_limit_is_explained() -> None:
    [note] = report_notes(trained_on_pi([1.0], [1.0], speed_limit_ratio_steady=1.034))
    assert "With trained the mean speed is 103 % of the limit" in note
    assert report_notes(trained_on_pi([1.0], [1.0], speed_limit_ratio_steady=1.005)) == []


def test_a_comparison_has_notes_about_each_driver() -> None:
    found = drive_results(human=rows_of([1.0]), pi=rows_of([1.0], min_time_gap=0.3, status="collision"))
    assert [note.split()[0] for note in report_notes(found)] == ["pi:", "pi"]


def test_notes_are_about_the_trained_controller_only() -> None:
    result = trained_on_pi([1.0], [1.0])
    result.rows["pi"][0]["min_time_gap"] = 0.3
    assert report_notes(result) == []


def test_only_a_driver_alone_has_key_figures() -> None:
    cards = key_figures(drive_results(pi=rows_of([1.0, 2.0], **CLOSED)))
    assert [card["value"] for card in cards] == ["4.00 m/s", "0.830", "1.00 m/s", "1.0 ml/km"]
    assert {card["detail"] for card in cards} == {"pi"}
    assert key_figures(trained_on_pi([112.0, 148.0], [1.0, 2.0])) == []


def test_title_names_what_was_compared() -> None:
    assert report_title([drive_results(human=rows_of([1.0]), pi=rows_of([1.0]))]) == "ring: human, pi"
    assert report_title([trained_on_pi([1.0], [1.0])]) == "ring: a trained residual on pi"
    both = [drive_results(pi=rows_of([1.0])), drive_results(scenario="ring-warm", pi=rows_of([1.0]))]
    assert report_title(both) == "ring, ring-warm: comparison of 2 results"


def test_a_comparison_names_the_options_in_which_the_commands_differ() -> None:
    def result(name: str, *words: str) -> Results:
        return Results(Path(name), {"manifest": {"command": ["unjam", "drive", "ring", *words]}}, {}, {})

    first = result("a", "-d", "pi", "--length", "230", "--out", "a")
    assert command_differences([first, result("b", "-d", "pi", "--length", "250", "--workers", "2")]) == [
        ("a", "--length 230"),
        ("b", "--length 250"),
    ]
    assert command_differences([first, result("b", "-d", "pi", "--length", "230", "-n", "2")])[0] == ("a", "")
    assert command_differences([first, result("b", "-d", "pi", "--length", "230", "--out", "b")]) == []
    assert command_differences([result("a", "--all", "x"), result("b", "--all", "y")]) == [("a", "x"), ("b", "y")]
    assert command_differences([first, Results(Path("b"), {}, {}, {})]) == [], "it is unknown"


def test_title_without_an_expert_names_no_residual() -> None:
    metadata = {"scenario": "ring", "reward": "released", "trained": "trained", "expert": "none"}
    assert "none" not in report_title([Results(Path("x"), metadata, {"trained": rows_of([1.0])}, {})])


def test_columns_of_one_folder_are_its_drivers() -> None:
    assert [column.name for column in report_columns([trained_on_pi([1.0], [1.0])])] == ["human", "pi", "trained"]


def test_columns_of_several_folders_have_their_names() -> None:
    names = [
        column.name
        for column in report_columns([drive_results("a", pi=rows_of([1.0])), drive_results("b", pi=rows_of([2.0]))])
    ]
    assert names == ["a: pi", "b: pi"]


def test_common_drivers_of_runs_have_one_column() -> None:
    first, second = trained_on_pi([1.0], [5.0]), trained_on_pi([2.0], [5.0])
    second = Results(Path("runs/ring-002"), second.metadata, second.rows, {})
    names = [column.name for column in report_columns([first, second])]
    assert names == ["human", "pi", "ring-001: trained", "ring-002: trained"]


def test_folders_of_the_same_name_have_different_columns() -> None:
    columns = report_columns(
        [drive_results("old/ring", pi=rows_of([1.0])), drive_results("new/ring", pi=rows_of([2.0]))]
    )
    assert [column.rows[0]["return"] for column in columns] == [1.0, 2.0]
    assert len({column.name for column in columns}) == 2


def test_the_same_driver_on_another_road_has_its_own_column() -> None:
    ring, warm = trained_on_pi([1.0], [5.0]), trained_on_pi([2.0], [9.0])
    warm = Results(Path("runs/warm-001"), {**warm.metadata, "scenario": "ring-warm"}, warm.rows, {})
    returns = [column.rows[0]["return"] for column in report_columns([ring, warm]) if "pi" in column.name]
    assert returns == [5.0, 9.0]


def test_two_configurations_of_a_network_are_compared_on_the_same_seeds() -> None:
    plain = drive_results("runs/plain", "a.sumocfg", human=rows_of([1.0, 2.0]))
    limited = drive_results("runs/limited", "b.sumocfg", human=rows_of([5.0, 7.0]))
    assert first_network_column([plain, limited]) == "plain: human"
    assert mismatch_warning([plain, limited]).endswith("so compare travel times.")
    _, column = report_columns([plain, limited])
    verdict = compare_networks(column, plain.rows["human"]).verdict
    assert verdict is not None
    assert verdict.driver == "limited: human"
    assert "human drivers of the first network, 2 paired seeds" in verdict.comparison
    longer = drive_results("runs/longer", "b.sumocfg", human=rows_of([5.0, 7.0, 9.0]))
    assert first_network_column([plain, longer]) == "plain: human"
    column = compare_networks(report_columns([plain, longer])[1], plain.rows["human"])
    assert (len(column.rows), len(column.baseline_rows or ())) == (2, 2), "seeds of both"
    others = {
        "other seeds": drive_results("runs/c", "c.sumocfg", human=rows_of([1.0])),
        "no humans": drive_results("d", "d.sumocfg", pi=[]),
        "a built-in road": drive_results("e", "ring", human=rows_of([5.0, 7.0])),
    }
    assert [first_network_column([plain, other]) for other in others.values()] == [""] * 3
    assert first_network_column([plain]) == ""
    same = drive_results("runs/limited", "b.sumocfg", human=rows_of([1.0, 2.0]))
    assert first_network_column([plain, same]) == "", "the same human traffic"


def test_the_baseline_of_several_folders_ran_the_same_episodes() -> None:
    first, second = trained_on_pi([1.0], [5.0]), trained_on_pi([2.0], [5.0])
    second = replace(second, folder=Path("runs/ring-002"))
    assert common_baseline([first]) == common_baseline([first, second]) == "human"
    elsewhere = replace(second, rows={**second.rows, "human": rows_of([9.0])})
    assert common_baseline([first, elsewhere]) == ""
    assert common_baseline([drive_results("a", human=rows_of([1.0]), pi=rows_of([1.0]))] * 2) == ""
    assert common_baseline([drive_results(pi=rows_of([1.0]))]) == ""


def test_a_difference_shows_its_sign() -> None:
    assert format_difference(Estimate(3.4, -0.6, 7.0, 5)) == "+3 [-1, +7]"


def test_csv_has_no_cells_that_a_spreadsheet_calculates() -> None:
    table = pd.DataFrame({"=a": ["+1", "@x", "-", "\t=1", "plain"], "number": [-1.0, 2.0, 3.0, 4.0, 5.0]})
    text = csv_text(table)
    assert text == "'=a,number\n'+1,-1.0\n'@x,2.0\n'-,3.0\n'?=1,4.0\nplain,5.0\n"
