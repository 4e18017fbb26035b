"""Does the page of an assessment say what its folder says, alone and in full?"""

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
from unjam.measures.effect import AccResult, ControllerResult, assessment_headline, recommended_result
from unjam.measures.metrics import METRICS
from unjam.measures.statistics import Estimate
from unjam.reports.assessment import ASSESSMENT_FILE, effect_figure, render_assessment, write_assessment
from unjam.scenarios import OnRamp, Ring, scenario_recipe
from unjam.training.evaluate import Evaluation, save_evaluation
from unjam.worlds.record import Episode

BEYOND = between(-3.0, -1.0)
HELPS = ControllerResult(0.1, "acc", GOOD, BEYOND)
WITH_ACC = [AccResult(0.1, GOOD), AccResult(0.2, GOOD)]
HARMS = ControllerResult(
    0.2,
    "idm:time_headway=1,max_acceleration=2.5,b=<2>",
    replace(GOOD, travel_time=between(3, 5), drivable="brakes with 9 m/s2"),
    BEYOND,
)
UNKNOWN = replace(GOOD, travel_time=Estimate(float("nan"), float("nan"), float("nan"), 0), drivable="")


def episode(generator: np.random.Generator) -> Episode:
    speeds = generator.uniform(1, 9, (50, 3))
    return Episode((1,), "completed", vehicle_ids=("a", "b", "c"), speeds=speeds, positions=speeds.cumsum(0))


def folder_of(folder: Path, judged: list[ControllerResult]) -> Path:
    """A folder as `unjam assess` writes it, of made-up numbers."""
    best, generator = recommended_result(judged), np.random.default_rng(0)
    tried = [
        {
            "share": each.penetration_rate,
            "driver": each.driver,
            "rejection_reasons": "",
            "chosen": True,
            "effect": asdict(GOOD),
        }
        for each in (HELPS, HARMS)
    ]
    tried[0]["rejection_reasons"] = "slower than people"
    tried.append({**tried[0], "driver": "pi", "rejection_reasons": "failed: no CAV", "effect": asdict(UNKNOWN)})
    people: dict[str, Any] = dict.fromkeys(METRICS, asdict(Estimate(78.5, 70.0, 80.0, 20)))
    document = {
        "scenario": "my & road.sumocfg",
        "headline": assessment_headline(judged, WITH_ACC),
        "recommended": best and {"share": best.penetration_rate, "driver": best.driver},
        "judged": [{**asdict(each), "reasons": each.reasons, "words": each.summary} for each in judged],
        "acc": [{**asdict(each), "driver": "cruise", "words": each.summary} for each in WITH_ACC],
        "tried": tried,
        "people": people,
        "road": {**scenario_recipe(Ring()), "cav_classes": ["passenger"]},
        "people_drive": "as the vehicle types of its files say",
        "drivers": {"acc": {"time_gap": 1.1}, "pi": {}, HARMS.driver: {}},
        "shares": [0.1, 0.2],
        "precision": 0.02,
        "budget": {"episodes": 400, "minutes": 30.0},
        "episodes": {"choosing": 60, "all": 120},
        "seeds": {"choosing": 12, "judging": 20},
        "manifest": manifest(),
    }
    rows = [{"seed": 1, "status": "completed", **dict.fromkeys(METRICS, 1.0)}]
    shown = {label: episode(generator) for label in ("human", "acc, 10 %")}
    about = {key: document[key] for key in ("scenario", "manifest")}
    save_evaluation(folder, Evaluation({"human": rows, "acc, 10 %": rows}, shown), about)
    (folder / ASSESSMENT_FILE).write_text(json.dumps(document, default=float).replace("NaN", "null"))
    return folder


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    return render_assessment(folder_of(tmp_path_factory.mktemp("both"), [HELPS, HARMS]))


def cells_of(page: str, label: str) -> list[str]:
    row = re.search(rf"<tr><th scope=\"row\">{label}.*?</tr>", page, re.DOTALL)
    assert row is not None, label
    return [re.sub(r"<.*?>", "", cell) for cell in re.findall(r"<td.*?>(.*?)</td>", row[0])]


def test_the_page_leads_with_the_words_of_the_rule(page: str) -> None:
    assert assessment_headline([HELPS, HARMS], WITH_ACC) in page
    assert WITH_ACC[1].summary in page
    assert HELPS.summary in page
    assert "b=&lt;2&gt; at a penetration rate of 20 %: not recommended: travel time is longer" in page
    assert "The CAVs are those recommended." in page


def test_the_page_says_that_cavs_have_accs_of_their_own_where_they_have(tmp_path: Path, page: str) -> None:
    assert "an ACC of its own" not in page
    folder = folder_of(tmp_path, [HELPS])
    found = json.loads((folder / ASSESSMENT_FILE).read_text())
    found["road"] = {**scenario_recipe(OnRamp()), "cav_classes": ["passenger"]}
    (folder / ASSESSMENT_FILE).write_text(json.dumps(found, default=float).replace("NaN", "null"))
    said = " ".join(render_assessment(folder).split())
    assert "Each has an ACC of its own that follows, with a time headway of 1.1 s and at most 2.5 m/s²" in said
    assert "There is no safety filter." in said


def test_the_tables_have_people_as_they_are_and_cavs_beside_them(page: str) -> None:
    assert cells_of(page, "recommended") == ["", "–", "yes", "–", "no"]
    assert cells_of(page, "feasible") == ["", "drivable", "drivable", "drivable", "brakes with 9 m/s2"]
    helps, harms = "-4.0 [-6.0, -2.0]", "+4.0 [+3.0, +5.0]"
    assert cells_of(page, "travel time, waiting") == ["78.5", helps, helps, helps, harms]
    assert cells_of(page, "travel time, relative to") == ["", "-4.0", "-4.0", "-4.0", "+4.0"]
    assert cells_of(page, "travel time, compared with ACC") == ["", *["–", "-2.0 [-3.0, -1.0]"] * 2]
    assert cells_of(page, "flow")[1:] == ["+10 [-10, +30]"] * 4
    assert cells_of(page, "test seeds") == ["20"] * 5
    *numbers, seeds, drives, became = cells_of(page, "10 %:<wbr> pi")
    assert numbers == ["–", "+10 [-10, +30]", "+0.0 [+0.0, +0.0]", "0"]
    assert (seeds, drives, became) == ("0", "–", "failed: no CAV")


def test_the_page_says_what_was_assumed_and_needs_no_network(page: str) -> None:
    for words in (
        "as the vehicle types of its files say",
        "time_gap 1.1",
        "12 tuning seeds, 20 test seeds; 120 episodes of at most 400 or 30 minutes",
        "±2 % of that of the human baseline",
        "time headway of 1 s",
    ):
        assert words in page.replace("&#39;", "'"), words
    assert page.count("data:image/svg+xml;base64,") == 2
    assert "my &amp; road.sumocfg" in page
    assert not re.search(r"(src|href)=\"(?!data:)", page)


def test_where_nothing_is_recommended_the_page_says_so_and_why(tmp_path: Path) -> None:
    page = render_assessment(folder_of(tmp_path, [HARMS]))
    assert "No controller is recommended on this road" in page
    assert "it is not recommended" in page
    assert "10 % CAVs: no controller is recommended; each was set aside" in page
    assert "The quickest, acc: slower than people." in page


def test_without_a_tested_controller_the_page_has_the_acc_vehicles(tmp_path: Path) -> None:
    page = render_assessment(folder_of(tmp_path, []))
    assert cells_of(page, "recommended") == ["", "–", "–"]
    assert WITH_ACC[0].summary in page


def test_where_nobody_reached_the_end_there_is_still_a_picture() -> None:
    judged = {"share": 0.1, "driver": "acc", "effect": {**vars(GOOD), "baseline_flow": 0.0}}
    found = {"drivers": {"acc": {}}, "shares": [0.1], "tried": [], "acc": [], "judged": [judged]}
    time, flow = effect_figure(found).axes
    assert len(time.lines) > len([line for line in flow.lines if np.isfinite(line.get_ydata()).any()]) == 1


def test_a_folder_without_an_assessment_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has no assessment.json"):
        write_assessment(tmp_path, tmp_path / "page.html")
