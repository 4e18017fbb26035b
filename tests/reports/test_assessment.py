"""The page of an assessment shows the content of its folder."""

import json
import re
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.measures.test_effect import GOOD, between
from unjam.errors import InputError
from unjam.manifest import manifest
from unjam.measures.metrics import METRICS
from unjam.measures.recommendation import AccResult, ControllerResult, acc_finding, recommended_result, road_verdict
from unjam.measures.statistics import Estimate
from unjam.reports.assessment import (
    ASSESSMENT_FILE,
    archive_assessment,
    effect_figure,
    feasibility_text,
    render_assessment,
    write_assessment,
)
from unjam.scenarios import Motorway, Ring, scenario_recipe
from unjam.training.evaluate import Evaluation, save_evaluation
from unjam.worlds.record import Episode

TO_ACC = between(-3.0, -1.0)
FLOW_TO_ACC = between(-15.0, 25.0)
HELPS = ControllerResult(0.1, "acc", GOOD, TO_ACC, FLOW_TO_ACC)
WITH_ACC = [AccResult(0.1, GOOD), AccResult(0.2, GOOD)]
HARMS = ControllerResult(
    0.2,
    "idm:time_headway=1,max_acceleration=2.5,b=<2>",
    replace(GOOD, travel_time=between(3, 5), feasibility="brakes with 9 m/s2"),
    TO_ACC,
    FLOW_TO_ACC,
)
UNKNOWN = replace(GOOD, travel_time=Estimate(float("nan"), float("nan"), float("nan"), 0), feasibility="")


def episode(generator: np.random.Generator) -> Episode:
    speeds = generator.uniform(1, 9, (50, 3))
    return Episode((1,), "completed", vehicle_ids=("a", "b", "c"), speeds=speeds, positions=speeds.cumsum(0))


def assessment_folder(folder: Path, results: list[ControllerResult]) -> Path:
    """Write a folder like `unjam assess`, with made-up numbers."""
    best, generator = recommended_result(results), np.random.default_rng(0)
    candidates = [
        {
            "penetration_rate": each.penetration_rate,
            "driver": each.driver,
            "rejection_reason": "",
            "is_finalist": True,
            "effect": asdict(GOOD),
        }
        for each in (HELPS, HARMS)
    ]
    candidates[0]["rejection_reason"] = "slower than the human baseline"
    candidates.append(
        {**candidates[0], "driver": "pi", "rejection_reason": "failed: no CAV", "effect": asdict(UNKNOWN)}
    )
    baseline: dict[str, Any] = dict.fromkeys(METRICS, asdict(Estimate(78.5, 70.0, 80.0, 20)))
    document = {
        "scenario": "my & road.sumocfg",
        "verdict": road_verdict(results).verdict,
        "headline": road_verdict(results).sentence,
        "acc_finding": acc_finding(WITH_ACC),
        "recommended": best and {"penetration_rate": best.penetration_rate, "driver": best.driver},
        "controller_results": [
            {**asdict(result), "reasons": result.reasons, "verdict": result.verdict, "summary": result.summary}
            for result in results
        ],
        "acc_results": [{**asdict(each), "driver": "cruise", "summary": each.summary} for each in WITH_ACC],
        "candidates": candidates,
        "baseline": baseline,
        "road": {**scenario_recipe(Ring()), "cav_classes": ["passenger"]},
        "human_drivers": "as the vehicle types of its files say",
        "drivers": {"acc": {"time_gap": 1.1}, "pi": {}, HARMS.driver: {}},
        "penetration_rates": [0.1, 0.2],
        "precision": 0.02,
        "budget": {"episodes": 400, "minutes": 30.0},
        "episodes": {"selection": 60, "total": 120},
        "seeds": {"selection": 12, "test": 20},
        "manifest": manifest(),
    }
    rows = [{"seed": 1, "status": "completed", **dict.fromkeys(METRICS, 1.0)}]
    plot_episodes = {label: episode(generator) for label in ("human", "acc, 10 %")}
    about = {key: document[key] for key in ("scenario", "manifest")}
    save_evaluation(folder, Evaluation({"human": rows, "acc, 10 %": rows}, plot_episodes), about)
    (folder / ASSESSMENT_FILE).write_text(json.dumps(document, default=float).replace("NaN", "null"))
    return folder


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    return render_assessment(assessment_folder(tmp_path_factory.mktemp("both"), [HELPS, HARMS]))


def cells_of(page: str, label: str) -> list[str]:
    row = re.search(rf"<tr><th scope=\"row\">{label}.*?</tr>", page, re.DOTALL)
    assert row is not None, label
    return [re.sub(r"<.*?>", "", cell) for cell in re.findall(r"<td.*?>(.*?)</td>", row[0])]


def test_page_starts_with_the_recommendation(page: str) -> None:
    lead = f"{road_verdict([HELPS, HARMS]).sentence} {acc_finding(WITH_ACC)}"
    assert f'<p class="badge recommended">recommended</p>\n  <p class="lead">{lead}</p>' in page
    assert WITH_ACC[1].summary in page
    assert HELPS.summary in page
    assert "b=&lt;2&gt; at a penetration rate of 20 %: not recommended: travel time is longer" in page
    assert "The CAVs have the recommended controller." in page


def test_main_table_has_a_row_per_option_with_differences_to_both_baselines(page: str) -> None:
    table = page[page.index('<table class="options">') : page.index("</table>")]
    rows = [re.findall(r"<td.*?>(.*?)</td>", row) for row in table.split("<tr>")[2:]]
    assert rows[0] == ["none", "human baseline", "78.5 s", "–", "78 veh/h", "–", "–", "–"]
    to_human = ["-4.0 [-6.0, -2.0]", "+10 [-10, +30]"]
    assert rows[1] == ["10 %", "ACC alone", to_human[0], "–", to_human[1], "–", "feasible", "–"]
    to_acc = ["-2.0 [-3.0, -1.0]", "+5 [-15, +25]"]
    assert rows[2] == ["10 %", "acc", to_human[0], to_acc[0], to_human[1], to_acc[1], "feasible", "recommended"]
    assert (rows[4][0], rows[4][-1]) == ("20 %", "not recommended")
    assert "<h1>" in page[: page.index("<table")]
    assert page.index("<details>") > page.index("</table>")


@pytest.mark.parametrize(
    ("feasibility", "more_braking", "text"),
    [
        ("feasible", 0.0, "feasible"),
        ("feasible", 0.2, "feasible, but human drivers brake hard more often in the mean"),
        ("brakes with 9.0 m/s2", 0.2, "brakes with 9.0 m/s2"),
        ("", 0.0, "–"),
    ],
)
def test_feasibility_says_if_human_drivers_brake_hard_more_often(
    feasibility: str, more_braking: float, text: str
) -> None:
    effect = {"feasibility": feasibility, "hard_braking": Estimate(more_braking, -1.0, 1.0, 3)}
    assert feasibility_text(effect) == text


def test_page_describes_the_acc_of_cavs(tmp_path: Path, page: str) -> None:
    assert "its own ACC" not in page
    folder = assessment_folder(tmp_path, [HELPS])
    document = json.loads((folder / ASSESSMENT_FILE).read_text())
    document["road"] = {**scenario_recipe(Motorway()), "cav_classes": ["passenger"]}
    (folder / ASSESSMENT_FILE).write_text(json.dumps(document, default=float).replace("NaN", "null"))
    text = " ".join(render_assessment(folder).split())
    assert "Each CAV has its own ACC, with a time gap of 1.1 s and at most 2.5 m/s²" in text
    assert "There is no safety filter." in text


def test_tables_have_the_human_baseline_and_differences_to_it(page: str) -> None:
    assert cells_of(page, "verdict") == ["", "–", "recommended", "–", "not recommended"]
    assert cells_of(page, "feasibility") == ["", "feasible", "feasible", "feasible", "brakes with 9 m/s2"]
    helps, harms = "-4.0 [-6.0, -2.0]", "+4.0 [+3.0, +5.0]"
    assert cells_of(page, "travel time, departure") == ["78.5", helps, helps, helps, harms]
    assert cells_of(page, "travel time, relative to") == ["", "-4.0", "-4.0", "-4.0", "+4.0"]
    assert cells_of(page, "travel time, compared with ACC") == ["", *["–", "-2.0 [-3.0, -1.0]"] * 2]
    assert cells_of(page, "flow")[1:] == ["+10 [-10, +30]"] * 4
    assert cells_of(page, "test seeds") == ["20"] * 5
    *numbers, seeds, verdict, decision = cells_of(page, "10 %:<wbr> pi")
    assert numbers == ["–", "+10 [-10, +30]", "+0.0 [+0.0, +0.0]", "0"]
    assert (seeds, verdict, decision) == ("0", "–", "failed: no CAV")


def test_page_lists_assumptions_and_works_offline(page: str) -> None:
    for text in (
        "as the vehicle types of its files say",
        "time_gap 1.1",
        "12 tuning seeds, 20 test seeds; 120 episodes (including those of the pictures) of at most 400 or 30 minutes",
        "±2 % of that of the human baseline",
        "time gap of 1 s",
    ):
        assert text in page.replace("&#39;", "'"), text
    assert page.count("data:image/svg+xml;base64,") == 2
    assert "my &amp; road.sumocfg" in page
    assert not re.search(r"(src|href)=\"(?!data:)", page)


def test_page_explains_why_nothing_is_recommended(tmp_path: Path) -> None:
    page = render_assessment(assessment_folder(tmp_path, [HARMS]))
    assert '<p class="badge not-recommended">not recommended</p>' in page
    assert "ACC alone has no panel" in page
    assert "10 % CAVs: no controller is recommended, because all were rejected" in page
    assert "Reason for the fastest, acc: slower than the human baseline." in page


def test_page_without_an_evaluated_controller_has_acc_vehicles(tmp_path: Path) -> None:
    page = render_assessment(assessment_folder(tmp_path, []))
    assert cells_of(page, "verdict") == ["", "–", "–"]
    assert WITH_ACC[0].summary in page


def test_figure_without_outflow_omits_its_relative_differences() -> None:
    result = {"penetration_rate": 0.1, "driver": "acc", "effect": {**vars(GOOD), "baseline_flow": 0.0}}
    groups = {"candidates": [], "acc_results": [], "controller_results": [result]}
    time, flow = effect_figure({"drivers": {"acc": {}}, "penetration_rates": [0.1], **groups}).axes
    assert len(time.lines) > len([line for line in flow.lines if np.isfinite(line.get_ydata()).any()]) == 1


def test_a_folder_without_an_assessment_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has no assessment.json"):
        write_assessment(tmp_path, tmp_path / "page.html")


def test_names_of_drivers_have_no_hidden_characters(tmp_path: Path) -> None:
    path = assessment_folder(tmp_path, [HELPS, HARMS]) / ASSESSMENT_FILE
    path.write_text(path.read_text().replace(f'"{HELPS.driver}"', '"p\\u202ei"'))
    page = render_assessment(tmp_path)
    assert "p?i" in page
    assert "\u202e" not in page


@pytest.mark.parametrize(
    ("rates", "drivers", "seeds", "is_archived"),
    [
        ([0.1], {"pi": {"window": 30.0}}, 10, False),
        ([0.1], {"pi": {"window": 30.0}}, 9, True),
        ([0.2], {"pi": {"window": 30.0}}, 10, True),
        ([0.1], {"pi": {}}, 10, True),
    ],
)
def test_the_answer_to_another_question_or_with_more_seeds_is_archived(
    rates: list[float], drivers: dict[str, Any], seeds: int, is_archived: bool, tmp_path: Path
) -> None:
    stored = {"penetration_rates": [0.1], "drivers": {"pi": {"window": 30.0}}, "seeds": {"test": 10}}
    (tmp_path / "assessment.json").write_text(json.dumps(stored))
    (tmp_path / "assessment.html").write_text("page")
    (tmp_path / "assessment-1.html").write_text("of an interrupted call")
    archived = archive_assessment(tmp_path, rates, drivers, seeds)
    assert archived == (tmp_path / "assessment-2.html" if is_archived else None)
    names = {path.name for path in tmp_path.iterdir()} - {"assessment-1.html"}
    assert names == {f"assessment{'-2' if is_archived else ''}.{suffix}" for suffix in ("json", "html")}
