import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from shutil import copyfile
from typing import Any

import pytest
from typer.testing import CliRunner

from tests.conftest import random_network
from tests.training.test_run import STEPS, small_config
from tests.worlds.sumo.user_networks import straight
from unjam import benchmark
from unjam.cli import app
from unjam.controller import controller_bytes, packaged_file
from unjam.controller.file import add_certificate, read_controller
from unjam.drivers import PISaturation, ResidualDriver
from unjam.errors import InputError
from unjam.processes import lock_folder
from unjam.scenarios.population import population_file
from unjam.training.assessment_request import make_request
from unjam.training.config import load_config
from unjam.training.drive import drive
from unjam.training.export import ControllerStore, export_controller
from unjam.training.fingerprint import fingerprint
from unjam.training.run_folder import (
    check_config,
    check_controller,
    check_run_files,
    create_run_folder,
    read_complete_progress,
    read_config,
    restore_newest_checkpoint,
    resume_run_folder,
    save_checkpoint,
)
from unjam.training.train import train

FLOW = '<flow id="f" type="car" route="along" begin="0" end="60" period="3"/>'


def test_empty_folder_is_allowed(tmp_path: Path) -> None:
    create_run_folder(tmp_path, small_config())
    assert read_config(tmp_path) == small_config()


@pytest.mark.parametrize(
    "changes",
    [
        {"expert": "nonesuch"},
        {"expert": "nowhere.py:nothing"},
        {"reward": "gold"},
        {"evaluation__baselines": ["human", "nonesuch"]},
        {"expert": "none", "policy__inputs": ["expert_memory"]},
        {"scenario": "merge", "scenario_options": {}, "policy__inputs": ["local", "lap_position"]},
        {"scenario": "merge", "scenario_options": {}, "expert": "pacer"},
    ],
    ids=["expert", "file of it", "reward", "baseline", "nothing to observe", "no place", "expert of loops"],
)
def test_impossible_configuration_is_refused_before_writing(tmp_path: Path, changes: dict[str, Any]) -> None:
    with pytest.raises(InputError) as caught:
        train(small_config(**changes), tmp_path / "run")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_row_model_is_refused_for_inputs_that_it_cannot_continue(tmp_path: Path) -> None:
    assert load_config(changes={"scenario": "on-ramp"}).model.model_ratio == 0.0
    assert load_config(changes={"scenario": "on-ramp", "model.kind": "road"}).model.model_ratio > 0.0
    with pytest.raises(InputError, match="not allowed on motorway, where CAVs use their own ACC"):
        check_config(load_config(changes={"scenario": "on-ramp", "model.model_ratio": 5.0}))
    file = straight(tmp_path, FLOW)
    asked = {"scenario": str(file), "scenario_options.penetration_rate": 0.5, "expert": "jam-ahead"}
    with pytest.raises(InputError, match=r"jam-ahead and the network use .*lane_speeds"):
        check_config(load_config(changes=asked))
    check_config(load_config(changes={**asked, "expert": "acc"}))


def test_simulator_is_refused_as_an_expert() -> None:
    with pytest.raises(InputError, match=r"expert: 'human' is not allowed; .* 'idm' drives like a human driver"):
        check_config(load_config(changes={"expert": "human"}))


def test_user_networks_have_no_route_position(tmp_path: Path) -> None:
    file = straight(tmp_path, FLOW)
    changes = {"scenario": str(file), "scenario_options.cav_types": ["car"], "policy.inputs": ["route_position"]}
    with pytest.raises(InputError, match="'route_position' is not allowed on user-network: it needs positions"):
        check_config(load_config(changes=changes))


@pytest.mark.parametrize("content", [{}, {"notes.txt": "mine"}])
def test_only_a_run_can_be_resumed(tmp_path: Path, content: dict[str, str]) -> None:
    for name, text in content.items():
        (tmp_path / name).write_text(text)
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(InputError, match=r"is not a run folder: it has no config\.toml"):
            train(small_config(), folder, resume=True)
    assert {path.name for path in tmp_path.iterdir()} == set(content)


@pytest.mark.parametrize(
    "changes",
    [
        {"seed": 1},
        {"expert": "idm"},
        {"reward": "eq16"},
        {"trpo.gamma": 0.9},
        {"policy.action_duration": 5},
        {"scenario_options.length": [120, 131]},
        {"evaluation.validation_interval": 2},
        {"scenario": "ring-warm"},
    ],
    ids=str,
)
def test_resumed_run_keeps_its_settings(tmp_path: Path, changes: dict[str, Any]) -> None:
    create_run_folder(tmp_path, small_config())
    before = (tmp_path / "config.toml").read_bytes()
    changed = load_config(tmp_path / "config.toml", changes={"steps": 900, **changes})
    with pytest.raises(InputError, match="only steps and workers may change"):
        train(changed, tmp_path, resume=True)
    assert (tmp_path / "config.toml").read_bytes() == before


def test_resumed_run_may_change_steps_and_workers(tmp_path: Path) -> None:
    create_run_folder(tmp_path, small_config())
    changed = replace(small_config(), steps=9 * STEPS, workers=7)
    resume_run_folder(tmp_path, changed)
    assert read_config(tmp_path) == changed


def test_run_out_of_patience_takes_no_more_steps(tmp_path: Path) -> None:
    config = small_config(evaluation__validation_interval=1, evaluation__patience=2)
    create_run_folder(tmp_path, config)
    rows = [{"iteration": n, "return_expert": 5.0, "return_validation": 4.0} for n in (1, 2, 3)]
    (tmp_path / "progress.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    save_checkpoint(tmp_path / "checkpoint", {"iteration": 3}, {})
    resume_run_folder(tmp_path, config)
    with pytest.raises(InputError, match=rf"^steps: {9 * STEPS} is not allowed: evaluation.patience"):
        resume_run_folder(tmp_path, replace(config, steps=9 * STEPS))
    assert read_config(tmp_path) == config


@pytest.mark.parametrize("words", ['title = "mine"\n', "[[tasks]]\nname = 'ring'\n"])
def test_foreign_config_in_the_parent_folder_is_ignored(words: str, tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text(words)
    create_run_folder(tmp_path / "ring", small_config())
    resume_run_folder(tmp_path / "ring", small_config())


def test_run_with_tuple_options_resumes(tmp_path: Path) -> None:
    config = small_config(scenario_options__length=(120, 130))
    create_run_folder(tmp_path, config)
    resume_run_folder(tmp_path, config)
    assert read_config(tmp_path).make_scenario() == config.make_scenario()


CODE = """
from unjam.scenarios import Ring

class Road(Ring):
    length, vehicles, horizon = (120, 130), 8, 100

def gentle(state):
    return 0.1 * (state.leader_speed - state.speed)

def calm(outcome):
    return {"speed": outcome.speeds.mean(1)}

def doubled(state):
    return 2.0 * state.speed[:, None]
"""
NAMES = {
    "scenario": "my+code/mine.py:Road",
    "scenario_options": {"population": "./people.json"},
    "expert": "pi:window=1e+1+my+code/mine.py:gentle+my+code/mine.py:gentle",
    "reward": "my+code/mine.py:calm",
    "policy__inputs": ["local", "my+code/mine.py:doubled"],
    "evaluation__baselines": ["human", "idm+best.unjam"],
    "model__model_ratio": 0.0,
}


@pytest.mark.parametrize("name", ["", "ring"])
def test_names_of_files_are_those_of_the_folder_in_which_the_run_was_started(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project, run = tmp_path / "my project", tmp_path / "my project" / "runs" / "a"
    for folder in (project, tmp_path / "elsewhere" / "deep"):  # which has other files with these names
        (folder / "my+code").mkdir(parents=True)
        (folder / "my+code" / "mine.py").write_text(CODE if folder == project else "")
        (folder / "ring").mkdir()
        copyfile(population_file("unjam:ngsim"), folder / "people.json")
        copyfile(packaged_file("best"), folder / "best.unjam")
    monkeypatch.chdir(project)
    config = small_config(**NAMES, **({"tasks": [{"name": name, "weight": 2.0}]} if name else {}))
    create_run_folder(run, config)
    made, stored = config.make_tasks(), (run / "config.toml").read_text()
    save_checkpoint(run / "checkpoint", {"iteration": 1, "fingerprint": fingerprint(config)}, {})
    (run / "progress.jsonl").write_text('{"iteration": 1}\n')
    monkeypatch.chdir(tmp_path / "elsewhere" / "deep")
    found = read_config(Path("../../my project/runs/a"))
    for task, expected in zip(found.make_tasks(), made, strict=True):
        assert (task.expert, task.weight) == (expected.expert, expected.weight)
        assert replace(task.scenario, population="./people.json") == expected.scenario
    assert found.evaluation.baselines == ("human", f"idm+{project / 'best.unjam'}")
    check_config(found)
    check_run_files(run, found, "evaluate")
    assert restore_newest_checkpoint(run, {run}, fingerprint(found))
    resume_run_folder(run, replace(found, steps=9 * STEPS))
    assert (run / "config.toml").read_text() == stored.replace(f"steps = {2 * STEPS}", f"steps = {9 * STEPS}", 1)
    monkeypatch.chdir(project)
    assert read_config(run) == replace(config, steps=9 * STEPS)


CUT_PROGRESS = [
    ([1, 7, 8], "rows 2 to 6 are missing"),
    ([1, 2, 3], "rows 4 to 8 are missing"),
    ([2, 3, 4, 5, 6, 7, 8, 9], "row 1 is missing"),
    ([1, 2, 3, 3, 4, 5, 6, 7, 8], "row 4 is of iteration 3"),
    ([], "rows 1 to 8 are missing"),
]


@pytest.mark.parametrize(("iterations", "reason"), CUT_PROGRESS)
@pytest.mark.parametrize("part", ["", "second"])
def test_progress_older_than_the_checkpoint_is_refused_and_nothing_changes(
    iterations: list[int], reason: str, part: str, tmp_path: Path
) -> None:
    config = small_config(tasks=[{"name": "first"}, {"name": "second"}])
    create_run_folder(tmp_path, config)
    places = [tmp_path / name for name in ("", "first", "second")]
    for place in places:
        place.mkdir(exist_ok=True)
        found = iterations if place == tmp_path / part else range(1, 10)
        (place / "progress.jsonl").write_text("".join(f'{{"iteration": {each}}}\n' for each in found))
    for iteration in (6, 7, 8):
        save_checkpoint(tmp_path / "checkpoint", {"iteration": iteration, "fingerprint": fingerprint(config)}, {})
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    message = rf"^{tmp_path / part / 'progress.jsonl'}: {reason}; allowed: all rows up to 8"
    with pytest.raises(InputError, match=message):
        restore_newest_checkpoint(tmp_path, places)
    if not part:
        with pytest.raises(InputError, match=message):
            read_complete_progress(tmp_path)
        with pytest.raises(InputError, match=message):
            resume_run_folder(tmp_path, replace(config, steps=9 * STEPS))
    assert {path: path.read_bytes() for path in before} == before


@pytest.mark.parametrize("content", ["two iterations", "evaluation", "evaluation of a task"])
@pytest.mark.parametrize("has_folder", [True, False])
def test_a_run_that_has_lost_its_checkpoint_is_not_started_anew(content: str, has_folder: bool, tmp_path: Path) -> None:
    config = small_config(tasks=[{"name": "first"}] if "task" in content else [])
    create_run_folder(tmp_path, config)
    rows = [f'{{"iteration": {iteration}}}\n' for iteration in range(1, 3 if "two" in content else 2)]
    (tmp_path / "progress.jsonl").write_text("".join(rows))
    if has_folder:
        (tmp_path / "checkpoint").mkdir()
    if len(rows) == 1:
        resume_run_folder(tmp_path, config)  # it was stopped before its first checkpoint
    if "evaluation" in content:
        (tmp_path / "first").mkdir()
        (tmp_path / ("first" if "task" in content else "") / "evaluation.json").write_text("{}")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=r"^resume: .* has no checkpoint .*; allowed: the run with its checkpoint/"):
        resume_run_folder(tmp_path, replace(config, steps=9 * STEPS))
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def controller(seed: int) -> bytes:
    driver = ResidualDriver(PISaturation(), random_network(seed=seed), 3.0)
    return controller_bytes(driver, {"time_step": 0.1, "iteration": seed})


def run_with_controllers(folder: Path, *tasks: str) -> Path:
    """A run whose checkpoint has the best controllers 1, 2, ... of its tasks, and the latest controllers 11, 12, ..."""
    config = small_config(tasks=[{"name": name} for name in tasks])
    create_run_folder(folder, config)
    store = ControllerStore([folder / name for name in tasks or ("",)])
    for first in (1, 11):
        store.save([controller(first + number) for number in range(len(tasks) or 1)], is_scheduled=first == 1)
    state = {"iteration": 1, "fingerprint": fingerprint(config)}
    save_checkpoint(folder / "checkpoint", state, store.tensors())
    return folder


def run_command(*words: str) -> None:
    ran = CliRunner().invoke(app, words)
    if isinstance(ran.exception, InputError):
        raise ran.exception
    pytest.fail(ran.output)


COMMANDS: dict[str, Callable[[Path], Any]] = {
    "evaluate": lambda folder: run_command("evaluate", str(folder)),
    "export": lambda folder: export_controller(folder, folder.parent / "out.unjam"),
    "drive": lambda folder: drive("ring", ["idm", f"pi+{folder}"]),
    "assess": lambda folder: make_request(str(straight(folder.parent, FLOW)), [0.1], 20, 0.1, drivers=[str(folder)]),
    "watch": lambda folder: run_command("watch", "ring", "--driver", str(folder), "--video", str(folder / "a.gif")),
    "benchmark": lambda folder: benchmark(str(folder)),
    "certify": lambda folder: run_command("certify", str(folder / "controller.unjam")),
    "expert": lambda folder: check_config(small_config(expert=str(folder))),
    "baseline": lambda folder: check_config(small_config(evaluation__baselines=[str(folder)])),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_controller_that_is_not_in_the_checkpoint_is_refused_before_anything_runs(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("unjam.worlds.worker_pool.WorkerPool.__init__", lambda *given: pytest.fail("it simulates"))
    folder = run_with_controllers(tmp_path / "run")
    (folder / "controller.unjam").write_bytes(controller(2))
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(
        InputError, match=rf"^{name}: '.*controller\.unjam' is not .*; resume with: unjam train --resume"
    ):
        COMMANDS[name](folder)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    assert not (tmp_path / "out.unjam").exists()


def test_controllers_of_the_checkpoint_are_accepted_also_with_a_certificate(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = run_with_controllers(tmp_path / "run")
    file = folder / "controller.unjam"
    for number in (11, 1):
        file.write_bytes(controller(number))
        check_controller(folder, "evaluate")
        add_certificate(file, read_controller(folder), {"certified": True})
        assert file.read_bytes() != controller(number)
        check_controller(folder, "evaluate")
    file.write_bytes(controller(3))
    with lock_folder(folder):  # a training writes the controller before the checkpoint
        check_controller(folder, "evaluate")
    for checkpoint in (folder / "checkpoint").iterdir():
        checkpoint.unlink()
    check_controller(folder, "evaluate")
    assert not caplog.text
    (folder / "progress.jsonl").write_text('{"iteration": 1}\n')
    check_controller(folder, "evaluate")
    assert "cannot be compared with the training: the run has no checkpoint" in caplog.text
    file.unlink()
    check_controller(folder, "evaluate")
    check_controller(tmp_path / "nowhere", "evaluate")


def test_a_task_has_its_own_controller_in_the_checkpoint_of_its_run(tmp_path: Path) -> None:
    folder = run_with_controllers(tmp_path / "run", "first", "second")
    for name in ("first", "second"):
        check_controller(folder / name, "export")
    copyfile(folder / "first" / "controller.unjam", folder / "second" / "controller.unjam")
    with pytest.raises(InputError, match=f"^export: .*; resume with: unjam train --resume {folder}$"):
        check_controller(folder / "second", "export")
