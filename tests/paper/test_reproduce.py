import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pandas as pd
import pytest

from unjam.errors import InputError
from unjam.files import atomic_write
from unjam.training.run_folder import read_config
from unjam_paper import STUDIES, STUDY_GROUPS, study
from unjam_paper.comparison import comparison_study
from unjam_paper.reproduce import estimated_seconds, find_studies, make_plan, run_plan
from unjam_paper.results_file import read_parts
from unjam_paper.study import PlannedRun, StudyFolder

Made = tuple[Path, list[str]]


@pytest.mark.parametrize("name", STUDIES)
def test_every_study_lists_trainings_that_can_be_configured(name: str) -> None:
    runs = STUDIES[name].make_runs(2)
    assert len(set(runs)) == len(runs)
    for run in runs:
        config = run.config
        assert config.seed == run.seed
        assert config.make_scenario().horizon > 0


def test_all_is_every_study_and_figures_are_drawn_with_their_tables() -> None:
    assert set(find_studies(["all"])) == set(STUDIES)
    assert set(find_studies(["figure-7"])) == {"table-2"}
    assert set(find_studies(["figure-4"])) == set(find_studies(["table-1"]))
    assert set(find_studies(["table-1"])) == {f"table-1-{road}" for road in ("ring", "figure-eight", "merge")}
    assert {study for names in STUDY_GROUPS.values() for study in names} == set(STUDIES)


def test_an_unknown_study_lists_the_known(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="study: 'table-9' is not allowed; allowed: table-1"):
        make_plan(["table-9"], 1, StudyFolder(tmp_path))


def test_a_training_that_two_studies_want_is_planned_once(tmp_path: Path) -> None:
    both = make_plan(["table-1", "table-2"], 2, StudyFolder(tmp_path))
    alone = [make_plan([name], 2, StudyFolder(tmp_path)) for name in ("table-1", "table-2")]
    assert len(set(both.runs)) == len(both.runs) < sum(len(part.runs) for part in alone)
    assert both.seconds(2) < sum(part.seconds(2) for part in alone)
    assert both.seconds(4) < both.seconds(2)


def test_a_study_that_was_begun_with_fewer_trainings_does_not_go_on_with_more(tmp_path: Path) -> None:
    (tmp_path / "rings").mkdir()
    (tmp_path / "rings/manifest.json").write_text('{"seeds": 2}')
    assert make_plan(["rings"], 2, StudyFolder(tmp_path)).seeds == 2
    with pytest.raises(InputError, match="seeds: 5 is not allowed; allowed: 2"):
        make_plan(["rings"], 5, StudyFolder(tmp_path))


def test_the_paper_settings_cost_what_their_budget_says() -> None:
    short, long = (estimated_seconds(PlannedRun("ring", name, 0)) for name in ("trpo", "trpo-exact"))
    assert long == pytest.approx(short * 4_000_000 / 300_000)


@pytest.mark.long
def test_a_study_leaves_its_trainings_numbers_picture_and_manifest(reproduced: Made) -> None:
    folder, told = reproduced
    for variant in ("plain", "virtual"):
        for seed in (0, 1):
            assert (folder / "runs" / "little" / variant / str(seed) / "report.html").is_file()
    assert {path.name for path in (folder / "little").iterdir()} == {
        *("table.json", "table.csv", "curves.json", "curves.png", "manifest.json", "controllers")
    }
    one_file = read_parts(folder / "little.json")
    assert one_file == read_parts(folder / "little")
    assert list(one_file) == ["manifest", "curves", "table"]
    assert (folder / "little-curves.png").read_bytes() == (folder / "little/curves.png").read_bytes()
    with ZipFile(folder / "little-controllers.zip") as archive:
        assert {*archive.namelist()} == {path.name for path in (folder / "little/controllers").iterdir()}
    kept, made = folder / "little/controllers/virtual-1.unjam", folder / "runs/little/virtual/1"
    assert kept.read_bytes() == (made / "controller.unjam").read_bytes()
    assert sum("failed" in line for line in told) == 0
    manifest = json.loads((folder / "little" / "manifest.json").read_text())
    assert manifest["seeds"] == 2
    assert len({entry["weights_sha256"] for entry in manifest["trainings"]}) == 4


def test_what_is_there_is_not_trained_again(reproduced: Made) -> None:
    folder, _ = reproduced
    before = {path: path.stat().st_mtime_ns for path in (folder / "runs").rglob("controller.unjam")}
    plan_now = make_plan(["little"], 2, StudyFolder(folder))
    assert (plan_now.runs, plan_now.finished_count, plan_now.roads) == ([], 4, [])
    told: list[str] = []
    run_plan(plan_now, 2, on_message=told.append)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert len(told) == 1


def test_the_table_is_made_of_the_rows_of_its_trainings(reproduced: Made) -> None:
    folder, _ = reproduced
    table = {row["name"]: row for row in json.loads((folder / "little" / "table.json").read_text())}
    assert list(table) == ["human", "PI", "ACC", "tuned PI", "plain", "with a model"]
    experts = {name: table[name]["return"]["mean"] for name in ("PI", "ACC", "tuned PI")}
    best = max(experts, key=lambda name: experts[name])
    assert [name for name in experts if table[name]["best_expert"]] == [best]
    returns = []
    for seed in (0, 1):
        run = folder / "runs" / "little" / "plain" / str(seed)
        rows = json.loads((run / "evaluation.json").read_text())["rows"]
        returns.append(np.mean([row["return"] for row in rows if row["driver"] == "trained"]))
    assert table["plain"]["return"]["mean"] == pytest.approx(np.mean(returns))
    assert [table[name]["drivable"] for name in ("human", "PI")] == ["", "drivable"]
    assert len(table["plain"]["drivable"]) == 2
    beyond = table["plain"]["beyond_best_expert"]["mean"]
    assert beyond == pytest.approx(np.mean(returns) - experts[best])
    progress = [
        json.loads((folder / "runs/little/plain" / seed / "progress.jsonl").read_text().splitlines()[-1])
        for seed in ("0", "1")
    ]
    lengths = table["plain"]["steady_by_draw"]["length"]
    assert list(lengths) == sorted(lengths, key=float)
    assert min(lengths.values()) <= table["plain"]["mean_speed_steady"]["mean"] <= max(lengths.values())
    assert table[best]["beyond_best_expert"]["mean"] == 0.0
    assert table["human"]["beyond_best_expert"]["count"] > 0
    assert math.isnan(beyond_of(table["plain"], "low"))  # two trainings have a range
    assert beyond_of(table["plain"], "smallest") <= beyond <= beyond_of(table["plain"], "largest")
    convention = table["plain"]["paper_convention"]
    assert convention["speed"]["mean"] == pytest.approx(np.mean([row["cav_mean_speed"] for row in progress]))
    assert math.isclose(convention["reward"]["mean"], np.mean([row["return_mean"] for row in progress]))
    assert set(pd.read_csv(folder / "little" / "table.csv")["name"]) == set(table)


def beyond_of(row: dict[str, Any], part: str) -> float:
    value = row["beyond_best_expert"][part]
    return math.nan if value is None else value


def test_the_last_checkpoint_stands_beside_the_one_that_was_chosen(tmp_path: Path) -> None:
    curves = {"trpo": {"return_validation": [[1.0, 9.0, 5.0], [2.0, 3.0, 3.0], [1.0, 6.0, 0.0]]}}
    rows = [
        {"name": "PI", "gains": []},
        {"name": "TRPO", "variant": "trpo", "gains": [0.0, 2.0, 0.0]},
        {"name": "SAC", "variant": "sac", "gains": [1.0, 2.0, 3.0]},  # of another reward: no returns here
    ]
    (tmp_path / "curves.json").write_text(json.dumps({"ring": curves}))
    (tmp_path / "table.json").write_text(json.dumps(rows))
    [row] = comparison_study("", ("trpo",)).tables["checkpoints"](tmp_path).to_dict("records")
    assert (row["best trained"], row["last checkpoint"]) == ("6", "3")
    assert row["last − best"] == "-3 [-11, +0]"
    assert row["kept the untrained network"] == "2 of 3"


def test_a_training_with_other_settings_is_not_taken_for_ours(reproduced: Made) -> None:
    folder, _ = reproduced
    config = folder / "runs/little/plain/0/config.toml"
    before = config.read_text()
    try:
        atomic_write(config, before.replace("gamma = 0.99", "gamma = 0.9"))
        with pytest.raises(InputError, match="was trained with other settings; allowed: a new folder"):
            make_plan(["little"], 2, StudyFolder(folder))
    finally:
        atomic_write(config, before)


@pytest.mark.long
def test_a_stopped_training_goes_on(reproduced: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a stop leaves: no judgement yet, and fewer steps than planned."""
    folder, _ = reproduced
    run = PlannedRun("little", "plain", 1)
    monkeypatch.setitem(study.VARIANTS, "plain", replace(study.VARIANTS["plain"], steps=480))
    (folder / "runs" / run.name / "evaluation.json").unlink()
    to_do = make_plan(["little"], 2, StudyFolder(folder))
    assert run in to_do.runs
    run_plan(to_do, 2)
    assert read_config(folder / "runs" / run.name).steps == 480
    rows = (folder / "runs" / run.name / "progress.jsonl").read_text().splitlines()
    assert [json.loads(row)["environment_steps"] for row in rows] == [160, 320, 480]
