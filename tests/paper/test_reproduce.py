import json
import math
import pickle
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pandas as pd
import pytest

from unjam.controller import make_driver
from unjam.errors import InputError
from unjam.files import atomic_write, to_json
from unjam.reports.results import PLOT_EPISODES_FILE
from unjam.scenarios import make_scenario
from unjam.scenarios.scenario import Scenario
from unjam.training.config import load_config
from unjam.training.run_folder import read_config
from unjam.worlds.episode import check_can_drive
from unjam.worlds.sumo.backend import SumoBackend
from unjam_paper import reproduce
from unjam_paper.all_roads import measure_road
from unjam_paper.comparison import comparison_study
from unjam_paper.reproduce import drive_references, estimated_seconds, find_studies, make_plan, run_plan
from unjam_paper.results_file import read_parts
from unjam_paper.studies import STUDIES, STUDY_GROUPS
from unjam_paper.study import (
    STUDY_ROADS,
    DriverSource,
    PlannedRun,
    Study,
    StudyFolder,
    evaluate_in_batches,
    evaluate_metrics,
)
from unjam_paper.variants import TUNED_REFERENCES, VARIANTS

Reproduction = tuple[Path, list[str]]
"""folder of studies, and messages"""


@pytest.mark.parametrize("name", STUDIES)
def test_trainings_of_every_study_have_a_valid_configuration(name: str) -> None:
    runs = STUDIES[name].make_runs(2)
    assert len(set(runs)) == len(runs)
    for run in runs:
        config = run.config
        assert config.seed == run.seed
        assert config.make_scenario().horizon > 0


@pytest.mark.parametrize("group", ["unfiltered", "to-the-letter"])
def test_studies_of_the_paper_itself_drive_without_the_safety_filter(group: str) -> None:
    for name, study in find_studies([group]).items():
        configs = [run.config for run in study.make_runs(1)]
        configs += [load_config(changes=STUDY_ROADS[road]) for road in study.roads]
        assert {each.make_scenario().safety.active for each in configs} == {name.endswith("-filtered")}


def test_groups_name_all_studies() -> None:
    assert set(find_studies(["all"])) == set(STUDIES)
    assert set(find_studies(["figure-7"])) == {"table-2"}
    assert set(find_studies(["figure-4"])) == set(find_studies(["table-1"]))
    assert set(find_studies(["table-1"])) == {f"table-1-{road}" for road in ("ring", "figure-eight", "merge")}
    assert {study for names in STUDY_GROUPS.values() for study in names} == set(STUDIES)


def test_an_unknown_study_is_refused_with_the_known_names(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="study: 'table-9' is not allowed; allowed: table-1"):
        make_plan(["table-9"], 1, StudyFolder(tmp_path))


def test_a_training_of_two_studies_is_planned_once(tmp_path: Path) -> None:
    both = make_plan(["table-1", "table-2"], 2, StudyFolder(tmp_path))
    single_plans = [make_plan([name], 2, StudyFolder(tmp_path)) for name in ("table-1", "table-2")]
    assert len(set(both.runs)) == len(both.runs) < sum(len(plan.runs) for plan in single_plans)
    assert both.seconds(2) < sum(plan.seconds(2) for plan in single_plans)
    assert both.seconds(4) < both.seconds(2)


@pytest.mark.long
@pytest.mark.parametrize("name", STUDIES)
def test_drivers_of_every_study_can_drive_its_roads(name: str, tmp_path: Path) -> None:
    """Controllers of trainings are missing here; all other drivers have the control step of their road."""
    parts = STUDIES[name].make_parts(StudyFolder(tmp_path), 1)
    pickle.dumps(parts)  # other processes measure them
    for function, arguments in parts.values():
        scenario: Scenario
        sources: Sequence[DriverSource]
        if function is measure_road:
            _, road, experts, drivers, _, _ = arguments
            scenario, sources = make_scenario(road.scenario, road.options), [*experts, *drivers.values()]
        elif function in (evaluate_metrics, evaluate_in_batches):
            scenario, sources = arguments[0], [*arguments[1].values()]
        else:
            continue
        assert SumoBackend().supports(scenario) == ""
        for source in sources:
            if not isinstance(source, str | Path):
                check_can_drive(source(scenario), scenario)
            elif not str(source).startswith(str(tmp_path)):
                check_can_drive(make_driver(str(source), scenario.control_step), scenario)


def test_the_estimated_time_is_proportional_to_the_steps() -> None:
    short, long = (estimated_seconds(PlannedRun("ring", name, 0)) for name in ("trpo", "trpo-exact"))
    assert long == pytest.approx(short * 4_000_000 / 300_000)


@pytest.mark.slow
def test_a_study_writes_trainings_results_figure_and_manifest(reproduced: Reproduction) -> None:
    folder, messages = reproduced
    for variant in ("plain", "with-model"):
        for seed in (0, 1):
            assert (folder / "runs" / "small" / variant / str(seed) / "report.html").is_file()
    assert {path.name for path in (folder / "small").iterdir()} == {
        *("table.json", "curves.json", "curves.png", "checkpoints.csv", "manifest.json", "controllers")
    }
    table = pd.read_csv(folder / "small/checkpoints.csv")
    assert set(table.iloc[:, 0]) == {"plain", "with a model"}
    one_file = read_parts(folder / "small.json")
    parts = json.dumps(read_parts(folder / "small"))
    assert one_file == json.loads(parts, parse_float=lambda text: float(f"{float(text):.7g}")), "seven digits"
    assert list(one_file) == ["manifest", "curves", "table"]
    assert (folder / "small-curves.png").read_bytes() == (folder / "small/curves.png").read_bytes()
    with ZipFile(folder / "small-controllers.zip") as archive:
        assert {*archive.namelist()} == {path.name for path in (folder / "small/controllers").iterdir()}
    copied, run_folder = folder / "small/controllers/with-model-1.unjam", folder / "runs/small/with-model/1"
    assert copied.read_bytes() == (run_folder / "controller.unjam").read_bytes()
    assert sum("failed" in line for line in messages) == 0
    manifest = json.loads((folder / "small" / "manifest.json").read_text())
    assert manifest["seeds"] == 2
    assert len({entry["weights_sha256"] for entry in manifest["trainings"]}) == 4


@pytest.mark.slow
def test_finished_trainings_are_not_repeated(reproduced: Reproduction) -> None:
    folder, _ = reproduced
    modified = {path: path.stat().st_mtime_ns for path in (folder / "runs").rglob("controller.unjam")}
    plan = make_plan(["small"], 2, StudyFolder(folder))
    assert (plan.runs, plan.finished_count, plan.roads) == ([], 4, [])
    messages: list[str] = []
    run_plan(plan, 2, on_message=messages.append)
    assert {path: path.stat().st_mtime_ns for path in modified} == modified
    assert len(messages) == 1


def test_reference_drivers_are_evaluated_again_after_a_change(
    tmp_path: Path, small_study: pytest.MonkeyPatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(STUDIES, "references", Study("", roads=("small",)))
    studies = StudyFolder(tmp_path)

    def missing_roads() -> list[str]:
        return make_plan(["references"], 0, studies).roads

    drive_references("small", studies, 1)
    assert missing_roads() == []
    for change in (
        lambda patch: patch.setitem(STUDY_ROADS, "small", {**STUDY_ROADS["small"], "scenario_options.horizon": 90}),
        lambda patch: patch.setitem(TUNED_REFERENCES, "small", {"tuned PI": "pi:window=30"}),
        lambda patch: patch.setattr(reproduce, "package_versions", lambda: {"libsumo": "1.0"}),
        lambda patch: patch.setattr(reproduce, "_episode_code_hash", lambda: "of another version"),
    ):
        with monkeypatch.context() as patch:
            change(patch)
            assert missing_roads() == ["small"]
    assert missing_roads() == []
    atomic_write(studies.reference_folder("small") / PLOT_EPISODES_FILE, "of another evaluation")
    assert missing_roads() == ["small"]


def test_the_table_has_the_means_of_the_trainings(reproduced: Reproduction) -> None:
    folder, _ = reproduced
    table = {row["name"]: row for row in json.loads((folder / "small" / "table.json").read_text())}
    assert list(table) == ["human", "PI", "ACC", "tuned PI", "plain", "with a model"]
    experts = {name: table[name]["return"]["mean"] for name in ("PI", "ACC", "tuned PI")}
    best = max(experts, key=lambda name: experts[name])
    assert [name for name in experts if table[name]["best_expert"]] == [best]
    returns = []
    for seed in (0, 1):
        run = folder / "runs" / "small" / "plain" / str(seed)
        rows = json.loads((run / "evaluation.json").read_text())["rows"]
        returns.append(np.mean([row["return"] for row in rows if row["driver"] == "trained"]))
    assert table["plain"]["return"]["mean"] == pytest.approx(np.mean(returns))
    assert [table[name]["feasibility"] for name in ("human", "PI")] == ["", "feasible"]
    assert len(table["plain"]["feasibility"]) == 2
    gain = table["plain"]["gain_over_best_expert"]["mean"]
    assert gain == pytest.approx(np.mean(returns) - experts[best])
    progress = [
        json.loads((folder / "runs/small/plain" / seed / "progress.jsonl").read_text().splitlines()[-1])
        for seed in ("0", "1")
    ]
    assert table[best]["gain_over_best_expert"]["mean"] == 0.0
    assert table["human"]["gain_over_best_expert"]["count"] > 0
    assert math.isnan(gain_entry(table["plain"], "low"))  # two trainings have only a range
    assert gain_entry(table["plain"], "smallest") <= gain <= gain_entry(table["plain"], "largest")
    convention = table["plain"]["paper_convention"]
    assert convention["speed"]["mean"] == pytest.approx(np.mean([row["cav_mean_speed"] for row in progress]))
    assert math.isclose(convention["reward"]["mean"], np.mean([row["return_mean"] for row in progress]))


def gain_entry(row: dict[str, Any], part: str) -> float:
    value = row["gain_over_best_expert"][part]
    return math.nan if value is None else value


def test_the_checkpoint_table_has_the_best_and_the_last_checkpoint(tmp_path: Path) -> None:
    curves = {"trpo": {"return_validation": [[1.0, 9.0, 5.0], [2.0, 3.0, 3.0], [1.0, 6.0, 0.0]]}}
    rows = [
        {"name": "PI", "gains": []},
        {"name": "TRPO", "variant": "trpo", "gains": [0.0, 2.0, 0.0], "untrained_count": 2},
        {"name": "SAC", "variant": "sac", "gains": [1.0, 2.0, 3.0]},  # another reward: returns are not comparable
    ]
    (tmp_path / "curves.json").write_text(json.dumps({"ring": curves}))
    (tmp_path / "table.json").write_text(json.dumps(rows))
    [row] = comparison_study("", ("trpo",)).tables["checkpoints"](tmp_path).to_dict("records")
    assert (row["best trained"], row["last checkpoint"]) == ("6", "3")
    assert row["last − best"] == "-3 [-11, +0]"
    assert row["kept the untrained network"] == "2 of 3"


def test_a_training_with_other_settings_is_refused(reproduced: Reproduction) -> None:
    folder, _ = reproduced
    config = folder / "runs/small/plain/0/config.toml"
    text = config.read_text()
    try:
        atomic_write(config, text.replace("stratified = true", "stratified = false"))
        with pytest.raises(InputError, match="was trained with other settings; allowed: a new folder"):
            make_plan(["small"], 2, StudyFolder(folder))
    finally:
        atomic_write(config, text)


CHANGES: dict[str, Callable[[bytes], bytes]] = {
    "fewer episodes": lambda content: to_json(
        (document := json.loads(content)) | {"rows": document["rows"][:-1]}
    ).encode(),
    "another controller": lambda content: re.sub(rb'"weights": "[0-9a-f]{8}', b'"weights": "00000000', content),
    "damaged": lambda content: content[:-9],
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_training_without_its_own_evaluation_is_evaluated_again(reproduced: Reproduction, change: str) -> None:
    folder, _ = reproduced
    run = PlannedRun("small", "plain", 1)
    file = folder / "runs" / run.name / "evaluation.json"
    before = file.read_bytes()
    changed = CHANGES[change](before)
    assert changed != before
    try:
        atomic_write(file, changed)
        assert make_plan(["small"], 2, StudyFolder(folder)).runs == [run]
    finally:
        atomic_write(file, before)
    assert make_plan(["small"], 2, StudyFolder(folder)).runs == []


def test_a_foreign_controller_in_a_training_is_refused(reproduced: Reproduction) -> None:
    folder, _ = reproduced
    file, other = (folder / "runs/small" / variant / "0/controller.unjam" for variant in ("plain", "with-model"))
    before = file.read_bytes()
    try:
        atomic_write(file, other.read_bytes())
        with pytest.raises(InputError, match=r"^reproduce: '.*controller\.unjam' is not a controller of the newest"):
            make_plan(["small"], 2, StudyFolder(folder))
    finally:
        atomic_write(file, before)


@pytest.mark.parametrize("name", ["runs/small/plain/0/manifest.json", "small/manifest.json"])
def test_a_damaged_manifest_is_named(reproduced: Reproduction, name: str) -> None:
    folder, _ = reproduced
    before = (folder / name).read_bytes()
    try:
        atomic_write(folder / name, before[:-9])
        with pytest.raises(InputError, match=rf"{name}: the file is damaged: .*; allowed: "):
            run_plan(make_plan(["small"], 2, StudyFolder(folder)), 1)
    finally:
        atomic_write(folder / name, before)


def test_a_study_of_fewer_trainings_has_only_their_controllers(reproduced: Reproduction, tmp_path: Path) -> None:
    folder, _ = reproduced
    for seeds in (2, 1):
        StudyFolder(folder).copy_controllers([PlannedRun("small", "plain", seed) for seed in range(seeds)], tmp_path)
        names = sorted(file.name for file in (tmp_path / "controllers").iterdir())
        assert names == [f"plain-{seed}.unjam" for seed in range(seeds)]


@pytest.mark.long
def test_a_stopped_training_is_continued(reproduced: Reproduction, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stopped training has no evaluation and fewer steps than planned."""
    folder, _ = reproduced
    run = PlannedRun("small", "plain", 1)
    monkeypatch.setitem(VARIANTS, "plain", replace(VARIANTS["plain"], steps=480))
    (folder / "runs" / run.name / "evaluation.json").unlink()
    plan = make_plan(["small"], 2, StudyFolder(folder))
    assert run in plan.runs
    run_plan(plan, 2)
    assert read_config(folder / "runs" / run.name).steps == 480
    rows = (folder / "runs" / run.name / "progress.jsonl").read_text().splitlines()
    assert [json.loads(row)["environment_steps"] for row in rows] == [160, 320, 480]
