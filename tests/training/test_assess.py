"""Assessments: checks of the request, stored rows and documents."""

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.measures.test_recommendation import OPEN
from tests.worlds.sumo.user_networks import SPARSE, network, straight
from unjam.adapters import policy_driver
from unjam.errors import InputError, UnjamError
from unjam.measures.metrics import METRICS
from unjam.reports.assessment import render_assessment
from unjam.reports.results import read_results, read_rows
from unjam.training.assess import SELECTION_FOLDER, Assessment, assess, budget_lines, missing_budget, sensing_notes
from unjam.training.assessment_request import DEFAULT_CONTROLLERS, AssessmentRequest, make_request
from unjam.training.episode_log import EPISODES_FILE, EpisodeLog
from unjam.training.selection import (
    ACC_DRIVER,
    HUMAN_BASELINE,
    UNCHANGED_ACC_DRIVER,
    AssessmentFindings,
    EpisodeBudget,
    Option,
    verdict_episodes,
)
from unjam.worlds.worker_pool import WorkerPool

HELD = {"horizon": 150, "actuation": "shielded", "safety.active": True}
"""on so short a road an ACC of its own gains nothing"""
FLOW = '<flow id="f" type="car" route="along" begin="0" end="40" period="2"/>'


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = straight(tmp_path_factory.mktemp("road"), FLOW, length=200.0, end=30.0)
    path.write_text(path.read_text().replace("<end ", '<seed value="7"/><end '))
    return str(path)


@pytest.fixture(scope="module")
def example_request(file: str) -> AssessmentRequest:
    return make_request(file, [0.5], 40, 0.02, None, ["acc", "idm"], HELD)


@pytest.fixture(scope="module")
def answer(example_request: AssessmentRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Assessment]:
    with WorkerPool(2) as workers:
        yield assess(example_request, tmp_path_factory.mktemp("answer") / "out", workers)


def test_request_has_all_penetration_rates_controllers_and_two_baselines(file: str) -> None:
    usual = make_request(file, [0.2, 0.0, 0.1], 400, 0.02)
    assert usual.penetration_rates == (0.1, 0.2)
    assert len(usual.options) == 2 * len(DEFAULT_CONTROLLERS)
    road, driver = usual.make_setup(HUMAN_BASELINE)
    assert (road, driver.is_driven_by_simulator) == (usual.network, True)
    assert set(make_request(file, [0.1], 400, 0.02, None, ["cruise", "pi"]).drivers) == {"pi"}
    road, driver = usual.make_setup(Option(0.2, "pi"))
    assert road.penetration_rate == 0.2  # pyright: ignore[reportAttributeAccessIssue]
    assert driver.name == "pi"


def test_an_assessment_says_what_its_controllers_know_of_the_traffic_ahead(file: str) -> None:
    delayed = {"roadside.latency": 30.0, "roadside.loss_rate": 0.1}
    (note,) = sensing_notes(make_request(file, [0.1], 400, 0.02, None, ["unjam:best", "pi"], delayed))
    assert note.startswith("unjam:best: assumed to know the speeds of all vehicles, late by 30 s, 10 % of the messages")
    assert sensing_notes(make_request(file, [0.1], 400, 0.02, None, ["follower-stopper", "pi"])) == []


def test_acc_baseline_uses_an_acc_even_if_controllers_do_not(file: str) -> None:
    road, driver = make_request(file, [0.1], 400, 0.02, None, ["pi"], HELD).make_setup(Option(0.1, ACC_DRIVER))
    assert (road.actuation, road.safety.active, driver.name) == ("cruise", False, "cruise")
    assert (road.cruise.acceleration, road.cruise.deceleration) == (None, None)


@pytest.mark.parametrize("name", ["acceleration", "deceleration", "keep_right", "speed_gain"])
def test_acc_property_is_compared_with_unchanged_vehicles(name: str, file: str) -> None:
    plain = make_request(file, [0.1], 400, 0.02, None, ["pi"], {"cruise.time_gap": 1.5})
    assert not plain.has_acc_properties
    found = make_request(file, [0.1], 400, 0.02, None, ["pi"], {f"cruise.{name}": 3.0, "cruise.minimum_gap": 2.5})
    assert found.has_acc_properties
    roads = [found.make_setup(Option(0.1, driver))[0].cruise for driver in (ACC_DRIVER, UNCHANGED_ACC_DRIVER)]
    assert [getattr(road, name) for road in roads] == [3.0, None]
    assert [road.minimum_gap for road in roads] == [2.5, 2.5]


def test_lines_at_the_start_have_one_estimate_and_a_smaller_question(file: str) -> None:
    request = make_request(file, [0.1, 0.2], 60, 0.02, 5.0, ["acc", "unjam:best"])
    budget = EpisodeBudget(59, 5.0, 2, clock=iter([0.0, *[6.0] * 99]).__next__)
    budget.spend(1)
    assert budget_lines(request, budget) == [
        "a verdict needs at least 10 test seeds: 86 episodes, about 4 min",
        "the budget is at most 60 episodes, about 3 min or 5 min, which is too small for a verdict",
        "a smaller question, --penetration-rates 0.2 -d acc, needs at least 32 episodes, about 96 s",
    ]
    assert len(budget_lines(request.smallest_request, budget)) == 2
    assert budget_lines(request, budget, 50)[0].endswith("86 episodes, 50 of them stored, about 2 min")


def test_a_time_that_is_too_short_for_an_answer_is_said_at_the_start(file: str) -> None:
    request = make_request(file, [0.1, 0.2], 60, 0.02, 1.0, ["acc"])
    budget = EpisodeBudget(59, 1.0, 2, clock=iter([0.0, *[12.0] * 9]).__next__)
    budget.spend(1)
    expected = "an answer takes longer than 1 min: about 96 s, as each option is simulated at least once"
    assert expected in budget_lines(request, budget)


def test_missing_budget_keeps_all_penetration_rates_and_the_undecided_controllers(file: str) -> None:
    request = make_request(file, [0.1, 0.2, 0.3], 400, 0.02, None, ["acc", "idm", "pi"])
    undecided = replace(OPEN, penetration_rate=0.1, missing_seeds=15.4)
    rejected = replace(OPEN, penetration_rate=0.2, driver="idm", missing_seeds=0.0)
    unknown = replace(OPEN, penetration_rate=0.3, missing_seeds=inf)
    findings = AssessmentFindings({}, [undecided, rejected, unknown], [])
    missing = missing_budget(request, findings, EpisodeBudget(400))
    assert (missing["test_seeds"], missing["min_test_seeds"], missing["drivers"]) == (36, 36, ["acc"])
    assert missing["episodes"] == missing["min_episodes"] == verdict_episodes(3, 1, False, 36, 2) + 2


def test_missing_budget_estimated_from_few_seeds_begins_with_the_fewest_of_a_verdict(file: str) -> None:
    request = make_request(file, [0.1], 400, 0.02, None, ["acc"])
    few = replace(OPEN, difference_to_acc=replace(OPEN.difference_to_acc, count=3), missing_seeds=90.0)
    missing = missing_budget(request, AssessmentFindings({}, [few], []), EpisodeBudget(400))
    assert (missing["min_test_seeds"], missing["test_seeds"]) == (10, 93)
    assert missing["min_episodes"] == verdict_episodes(1, 1, False, 10, 1) + 2


def test_page_of_the_documentation_has_the_budgets_of_verdicts(file: str) -> None:
    text = (Path(__file__).parents[2] / "docs" / "assess.md").read_text()
    rows = re.findall(r"^\| (\d) \| (\d) \| (\d+) \|$", text, re.MULTILINE)
    names = [*DEFAULT_CONTROLLERS]
    assert len(rows) == 4
    for rates, controllers, episodes in rows:
        rate_list = [0.1 * (number + 1) for number in range(int(rates))]
        request = make_request(file, rate_list, 400, 0.02, None, names[: int(controllers)])
        assert request.verdict_episodes == int(episodes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"penetration_rates": [0.1], "drivers": ["pi"], "episodes": 1},
            ">= 11 for 1 penetration rate and 1 controller$",
        ),
        ({"penetration_rates": [0.1, 1.2]}, "penetration_rates: 1.2 is not allowed; allowed: shares from 0 to 1"),
        ({"penetration_rates": [float("nan")]}, "penetration_rates: nan"),
        ({"penetration_rates": [0.0]}, "penetration_rates: '0' is not allowed; allowed: one above 0"),
        ({"episodes": 23}, "episodes: 23 is not allowed; allowed: >= 24 for 2 penetration rates and 3 control"),
        ({"minutes": 0.0}, "minutes: 0.0"),
        ({"precision": 1.0}, "precision: 1.0"),
        ({"drivers": ["human"]}, "driver: 'human' is not allowed; allowed: the human baseline is always included"),
        ({"drivers": ["pacer"]}, "driver pacer is not allowed on user-network: it needs a closed road"),
        ({"drivers": ["ghost"]}, "driver: 'ghost'"),
        ({"options": {"penetration_rate": 0.5}}, "penetration_rate: it is not allowed here"),
        ({"options": {"cavs": 1}}, "cavs: it is not allowed here"),
        ({"options": {"penetration": 0.5}}, "penetration: unknown name"),
        ({"options": {"ghost": 1}}, "ghost: unknown name"),
    ],
)
def test_wrong_request_is_refused(changes: dict[str, Any], words: str, file: str) -> None:
    with pytest.raises(InputError, match=words.replace("+", r"\+")):
        make_request(file, **{"penetration_rates": [0.1, 0.2], "episodes": 400, "precision": 0.02, **changes})


def test_packaged_scenario_is_refused() -> None:
    with pytest.raises(InputError, match=r"scenario: 'ring' is not allowed; allowed: your own .sumocfg file"):
        make_request("ring", [0.1], 400, 0.02)


@pytest.mark.slow
def test_rows_of_selection_and_test_are_stored_separately(
    example_request: AssessmentRequest, answer: Assessment
) -> None:
    folder = answer.page.parent
    chose, judged = read_rows(folder / SELECTION_FOLDER), read_rows(folder)
    (found,) = answer.controller_results
    assert set(chose) == {"human", "acc, 50 %", "idm, 50 %"}
    assert set(judged) == {"human", "cruise, 50 %", f"{found.driver}, 50 %"}
    assert not {str(row["seed"]) for row in chose["human"]} & {str(row["seed"]) for row in judged["human"]}
    driven = sum(map(len, [*chose.values(), *judged.values()])) + 2
    assert answer.document["episodes"]["total"] == driven <= example_request.episodes
    assert all(row["status"] == "completed" for rows in judged.values() for row in rows)
    assert [*read_results(folder).plot_episodes] == ["human", f"{found.driver}, 50 %"]


@pytest.mark.long
def test_document_equals_the_file_and_has_all_results(answer: Assessment) -> None:
    written = json.loads((answer.page.parent / "assessment.json").read_text())
    assert written == answer.document
    (found,) = answer.controller_results
    (said,) = written["controller_results"]
    assert (said["driver"], said["reasons"], said["summary"]) == (found.driver, found.reasons, found.summary)
    assert said["effect"]["travel_time"]["mean"] == found.effect.travel_time.mean
    assert said["difference_to_acc"]["mean"] == found.difference_to_acc.mean
    (acc,) = written["acc_results"]
    assert (acc["penetration_rate"], acc["summary"]) == (0.5, answer.acc_results[0].summary)
    assert (written["recommended"] is None) == bool(found.reasons)
    assert written["baseline"]["travel_time"]["count"] == written["seeds"]["test"] >= 5
    assert written["manifest"]["packages"]["libsumo"]
    unfinished, replaced = written["notes"]
    assert unfinished.startswith("human; cruise, 50 %; acc, 50 %: up to 62 % of the vehicles are under way or waiting")
    assert replaced == "straight.sumocfg: replaced by values of unjam: seed"
    page = render_assessment(answer.page.parent)
    lifted = "acc, 50 %: SUMO lifted 3 vehicles"
    (answer.page.parent / "assessment.json").write_text(json.dumps({**written, "notes": [lifted]}))
    assert lifted not in page
    assert lifted in render_assessment(answer.page.parent)
    (answer.page.parent / "assessment.json").write_text(json.dumps(written))


@pytest.mark.long
def test_an_interrupted_assessment_resumes_with_the_same_result_on_any_number_of_workers(
    example_request: AssessmentRequest, answer: Assessment, tmp_path: Path
) -> None:
    stages: list[list[str]] = [[], []]

    def interrupt_in_the_test(name: str, steps: int) -> None:
        stages[0].append(name)
        if "test seed" in name:
            raise KeyboardInterrupt

    with WorkerPool(1) as workers:
        with pytest.raises(KeyboardInterrupt):
            assess(example_request, tmp_path / "out", workers, on_stage=interrupt_in_the_test)
        resumed = assess(example_request, tmp_path / "out", workers, on_stage=lambda name, _: stages[1].append(name))
    assert sum("tuning" in name for name in stages[0]) > 0
    assert not any("tuning" in name for name in stages[1])
    assert repr(resumed.controller_results) == repr(answer.controller_results)  # NaN is not equal to itself
    for name in ("candidates", "episodes", "seeds", "baseline", "notes"):
        assert resumed.document[name] == answer.document[name]
    for part in (Path(), Path(SELECTION_FOLDER)):
        assert repr(read_rows(tmp_path / "out" / part)) == repr(read_rows(answer.page.parent / part))


@pytest.mark.long
def test_each_finished_episode_is_stored_and_each_round_leaves_an_answer(file: str, tmp_path: Path) -> None:
    request, folder = make_request(file, [0.5], 22, 0.02, None, ["acc"], HELD), tmp_path / "out"
    ended, messages = set[Any](), list[str]()

    def interrupt_in_the_second_round(episode: Any, steps: int) -> None:
        if steps == request.network.horizon:
            ended.add(episode)
        if len(ended) == 1 + 9 + 3:  # the baseline's picture, three test seeds of three options, and three episodes
            raise KeyboardInterrupt

    with WorkerPool(1) as workers, pytest.raises(KeyboardInterrupt):
        assess(request, folder, workers, interrupt_in_the_second_round, messages.append)
    assert len((folder / EPISODES_FILE).read_text().splitlines()) in (11, 12)
    assert f"the answer so far is in {folder / 'assessment.html'}" in messages
    assert not json.loads((folder / "assessment.json").read_text())["is_complete"]
    assert "This is the answer so far" in (folder / "assessment.html").read_text()
    steps = list[int]()
    with WorkerPool(1) as workers:
        finished = assess(request, folder, workers, on_stage=lambda _, count: steps.append(count))
    assert finished.document["is_complete"]
    assert "This is the answer so far" not in finished.page.read_text()
    tested = 3 * finished.document["seeds"]["test"]
    assert sum(steps) in [(2 + tested - stored) * request.network.horizon for stored in (11, 12)]


@pytest.mark.long
def test_no_seed_begins_that_does_not_fit_into_the_time(
    file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(EpisodeBudget, "affordable_seeds", lambda *_: 10)
    request = make_request(file, [0.5], 100, 0.02, 1e-3, ["acc"], HELD)
    with WorkerPool(1) as workers:
        found = assess(request, tmp_path / "out", workers)
    assert found.document["seeds"]["test"] == 3, "the fewest of an answer"


@pytest.mark.long
def test_an_assessment_continues_with_other_controllers_and_more_episodes(file: str, tmp_path: Path) -> None:
    folder, stages = tmp_path / "out", list[str]()
    with WorkerPool(2) as workers:
        assess(make_request(file, [0.5], 13, 0.02, None, ["acc"], HELD), folder, workers)
        more = make_request(file, [0.5], 20, 0.02, None, ["acc"], HELD)
        assess(more, folder, workers, on_stage=lambda name, _: stages.append(name))
        fresh = assess(more, tmp_path / "fresh", workers)
        assert repr(read_rows(folder)) == repr(read_rows(fresh.page.parent))
        assert stages[1].startswith("simulating test seed")
        assert not stages[1].startswith("simulating test seeds 1 ")
        assert not (folder / "assessment-1.html").exists()  # the question was the same
        document, messages = (folder / "assessment.json").read_text(), list[str]()
        lower = make_request(file, [0.4], 20, 0.02, None, ["acc"], HELD)
        assess(lower, folder, workers, on_message=messages.append)
        assert (folder / "assessment-1.json").read_text() == document
        assert f"the earlier answer is now in {folder / 'assessment-1.html'}" in messages
        assert json.loads((folder / "assessment.json").read_text())["penetration_rates"] == [0.4]
        other = make_request(file, [0.5], 20, 0.02, None, ["acc"], {**HELD, "horizon": 140})
        with pytest.raises(InputError, match=r"other settings \(scenario\.horizon: 150 there, 140 now\)"):
            assess(other, folder, workers)


@pytest.mark.long
def test_a_policy_of_this_process_is_assessed_and_never_taken_from_the_log(file: str, tmp_path: Path) -> None:
    request, times = make_request(file, [0.5], 13, 0.02, None, ["acc"], HELD), list[float]()

    def assess_policy(acceleration: float) -> Assessment:
        policy = policy_driver(lambda observations: np.full(len(observations), acceleration))
        with WorkerPool(1) as workers:
            return assess(replace(request, drivers={"mine": policy}), tmp_path / "out", workers)

    for acceleration in (0.5, -0.5):
        (found,) = assess_policy(acceleration).controller_results
        times.append(found.effect.travel_time.mean)
        assert "mine" in render_assessment(tmp_path / "out")
    assert times[1] > times[0] + 0.1


def test_failed_episodes_are_tried_again(example_request: AssessmentRequest, tmp_path: Path) -> None:
    row = {**dict.fromkeys(METRICS, 1.0), "status": "completed", "error": ""}
    rows = [
        row,
        {**row, "status": "failed", "error": "MemoryError"},
        {**row, "status": "failed", "error": "NoCavError"},
    ]
    first = EpisodeLog(tmp_path / "out", example_request.network)
    for number, each in enumerate(rows, 1):
        first.add("setup", (number,), each)
    assert len(first.episodes) == 3
    assert [*EpisodeLog(tmp_path / "out", example_request.network).episodes] == [("setup", (1,)), ("setup", (3,))]


@pytest.mark.long
def test_a_controller_whose_every_episode_fails_ends_the_assessment(file: str, tmp_path: Path) -> None:
    def fail(observations: Any) -> Any:
        if observations.any():  # an actual episode
            raise RuntimeError("no weights")
        return observations[:, 0]

    request = replace(make_request(file, [0.5], 13, 0.02, None, ["acc"], HELD), drivers={"mine": policy_driver(fail)})
    with WorkerPool(1) as workers, pytest.raises(UnjamError, match="no weights"):
        assess(request, tmp_path / "out", workers)


@pytest.mark.parametrize(
    "entry",
    [
        *({}, {"setup": "a", "seed": 1, "row": {}}, {"setup": "a", "seed": [1], "row": 3}),
        *({"setup": [], "seed": [1], "row": {}}, {"setup": "a", "seed": [1], "row": {"mean_speed": "fast"}}),
    ],
)
def test_a_damaged_log_of_episodes_is_refused(
    entry: dict[str, Any], example_request: AssessmentRequest, tmp_path: Path
) -> None:
    EpisodeLog(tmp_path / "out", example_request.network)
    (tmp_path / "out" / EPISODES_FILE).write_text(json.dumps(entry) + "\n")
    with pytest.raises(InputError, match=r"out: episodes.jsonl in .* is damaged; allowed: a new folder"):
        EpisodeLog(tmp_path / "out", example_request.network)


@pytest.mark.slow
@pytest.mark.parametrize(
    "vehicle",
    ['<vType id="own" sigma="0"/>', '<vType id="own" vClass="truck" accel="0.5" maxSpeed="18" sigma="0"/>'],
    ids=["drawn desired speeds", "weak engines"],
)
def test_vehicle_properties_alone_give_no_gain(vehicle: str, tmp_path: Path) -> None:
    file, changes = network(tmp_path, vehicle + SPARSE), {"cav_classes": ["passenger", "truck"]}
    alone = make_request(file, [0.5], 12, 0.02, None, ["cruise"], changes)
    with WorkerPool(2) as workers:
        found = assess(alone, tmp_path / "out", workers)
    assert found.document["recommended"] is None
    assert found.document["headline"].startswith("Not recommended: there is nothing to gain, because")
    assert found.acc_results[0].effect.travel_time.mean >= -0.1


@pytest.mark.long
def test_seeds_without_a_cav_use_the_human_baseline(file: str, tmp_path: Path) -> None:
    few = make_request(file, [0.06], 20, 0.02, None, ["acc"], HELD)
    with WorkerPool(2) as workers:
        assess(few, tmp_path / "out", workers)
    human_rows, acc, driven = read_rows(tmp_path / "out").values()
    for found in (acc, driven):
        assert not any(row["status"] == "failed" for row in found)
    pairs = zip(human_rows, driven, strict=False)
    assert any(one["travel_time"] == other["travel_time"] for one, other in pairs)


def test_nonempty_folder_is_not_changed(example_request: AssessmentRequest, tmp_path: Path) -> None:
    (tmp_path / "precious.txt").write_text("keep me")
    with WorkerPool(1) as workers, pytest.raises(InputError, match="is not empty"):
        assess(example_request, tmp_path, workers)
    assert [path.name for path in tmp_path.iterdir()] == ["precious.txt"]
