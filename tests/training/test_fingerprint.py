"""A checkpoint goes on with the training that made it, and with no other."""

import json
import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.training.test_run import small_config
from tests.worlds.sumo.user_networks import straight
from unjam.errors import InputError
from unjam.training.config import MANIFEST_FILE, RunConfig, load_config, to_toml
from unjam.training.export import ControllerStore
from unjam.training.run_folder import (
    append_lineage,
    check_fingerprint,
    check_run_files,
    create_run_folder,
    fingerprint,
    read_config,
    restore_newest_checkpoint,
    resume_run_folder,
    save_checkpoint,
)

EXPERT = "def gentle(state):\n    return 0.1 * (state.leader_speed - state.speed)\n"


def with_checkpoint(folder: Path, config: RunConfig) -> None:
    create_run_folder(folder, config)
    (folder / "progress.jsonl").write_text('{"iteration": 1}\n{"iteration": 2}\n')
    save_checkpoint(folder / "checkpoint", {"iteration": 1, "fingerprint": fingerprint(config)}, {})


def refusal_message(folder: Path, config: RunConfig) -> str:
    before = (folder / "progress.jsonl").read_bytes()
    with pytest.raises(InputError, match=r"^resume: ") as caught:
        restore_newest_checkpoint(folder, {folder}, fingerprint(config))
    assert (folder / "progress.jsonl").read_bytes() == before
    return str(caught.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"seed": 5}, "seed: 5 is not allowed; allowed: 0, as in the checkpoint"),
        ({"trpo__gamma": 0.5}, "trpo.gamma: 0.5 is not allowed"),
        ({"scenario_options__vehicles": 9}, "scenario_options.vehicles: 9 is not allowed"),
    ],
)
def test_checkpoint_of_another_configuration_is_refused(changes: dict[str, Any], words: str, tmp_path: Path) -> None:
    with_checkpoint(tmp_path, small_config())
    (tmp_path / "config.toml").write_text(to_toml(small_config(**changes)))
    assert words in refusal_message(tmp_path, small_config(**changes))


def test_steps_and_workers_do_not_change_the_fingerprint(tmp_path: Path) -> None:
    with_checkpoint(tmp_path, small_config())
    assert restore_newest_checkpoint(tmp_path, {tmp_path}, fingerprint(small_config(steps=9000, workers=2))) is not None


def test_a_long_text_in_a_checkpoint_is_compared_in_time_proportional_to_its_length() -> None:
    now = fingerprint(small_config())
    stored = {**now, "settings": {**now["settings"], "expert": "pi" * 10**6}}
    with pytest.raises(InputError, match=r"^resume: expert: 'pi' is not allowed"):
        check_fingerprint(stored, now)


def of_expert(folder: Path) -> RunConfig:
    (folder / "mine.py").write_text(EXPERT)
    return small_config(expert=f"{folder}/mine.py:gentle")


def of_reward(folder: Path) -> RunConfig:
    (folder / "mine.py").write_text("def gold(outcome):\n    return {'speed': outcome.speeds.mean(1)}\n")
    return small_config(reward=f"{folder}/mine.py:gold")


def of_agent(folder: Path) -> RunConfig:
    (folder / "mine.py").write_text("class Mine:\n    pass\n")
    return small_config(agent=f"{folder}/mine.py:Mine")


def of_network(folder: Path) -> RunConfig:
    path = straight(folder, '<flow id="f" type="car" route="along" begin="0" end="60" period="3"/>')
    road = {"penetration_rate": 0.5, "horizon": 100}
    return load_config(changes={"scenario": str(path), "scenario_options": road, "steps": 100})


@pytest.mark.parametrize(
    ("make", "file"),
    [(of_expert, "mine.py"), (of_reward, "mine.py"), (of_agent, "mine.py"), (of_network, "demand.rou.xml")],
)
def test_changed_files_of_a_training_are_refused(make: Callable[[Path], RunConfig], file: str, tmp_path: Path) -> None:
    config, run = make(tmp_path), tmp_path / "run"
    with_checkpoint(run, config)
    assert restore_newest_checkpoint(run, {run}, fingerprint(config)) is not None
    check_run_files(run, config, "evaluate")
    (run / "progress.jsonl").write_text('{"iteration": 1}\n{"iteration": 2}\n')
    (tmp_path / file).write_text((tmp_path / file).read_text() + " ")
    with pytest.raises(InputError, match=r"evaluate: .* has changed since the checkpoint"):
        check_run_files(run, config, "evaluate")
    assert "has changed since the checkpoint" in refusal_message(run, config)
    for checkpoint in (run / "checkpoint").iterdir():
        checkpoint.write_text("{ torn")
    check_run_files(run, config, "evaluate")  # what is damaged does not tell


def test_changed_settings_of_a_training_are_refused_by_commands_that_read_the_run(tmp_path: Path) -> None:
    config, run = small_config(), tmp_path / "run"
    changed = small_config(scenario_options={**config.scenario_options, "horizon": 300})
    added = small_config(scenario_options={**config.scenario_options, "noise": 0.1})
    removed = small_config(scenario_options={"horizon": config.scenario_options["horizon"]})
    with_checkpoint(run, config)
    for command in ("evaluate", "export", "model"):
        check_run_files(run, small_config(evaluation__episodes=3), command)
        with pytest.raises(InputError, match=rf"^{command}: scenario_options\.horizon: 300 .*; allowed: 100"):
            check_run_files(run, changed, command)
        with pytest.raises(InputError, match=rf"^{command}: scenario_options\.noise: 0\.1 .*; allowed: 'absent'"):
            check_run_files(run, added, command)
        with pytest.raises(InputError, match=rf"^{command}: scenario_options\.\w+: 'absent' is not allowed"):
            check_run_files(run, removed, command)


def test_a_refused_resumption_changes_nothing(tmp_path: Path) -> None:
    config, run = of_network(tmp_path), tmp_path / "run"
    with_checkpoint(run, config)
    (tmp_path / "demand.rou.xml").write_text((tmp_path / "demand.rou.xml").read_text() + " ")
    before = (run / "config.toml").read_bytes()
    with pytest.raises(InputError, match=r"demand\.rou\.xml has changed since the checkpoint"):
        resume_run_folder(run, replace(config, steps=9 * config.steps))
    assert (run / "config.toml").read_bytes() == before


def test_changed_settings_of_a_task_are_refused_by_commands_that_read_its_folder(tmp_path: Path) -> None:
    config = small_config(tasks=[{"name": "first"}, {"name": "second", "weight": 2.0}])
    with_checkpoint(tmp_path, config)
    (tmp_path / "second").mkdir()
    (tmp_path / "second" / "config.toml").write_text(to_toml(config.task_configs()["second"]))
    task = read_config(tmp_path / "second")
    check_run_files(tmp_path / "second", task, "export")
    changed = replace(task, scenario_options={**task.scenario_options, "horizon": 300})
    with pytest.raises(InputError, match=r"^export: scenario_options\.horizon: 300 .*; allowed: 100"):
        check_run_files(tmp_path / "second", changed, "export")


def test_other_packages_and_kernels_give_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    now = fingerprint(small_config())
    check_fingerprint(now, now)
    assert not caplog.records
    with caplog.at_level(logging.WARNING):
        check_fingerprint({**now, "packages": {"numpy": "0"}, "kernels": {}}, now)
    assert ["packages" in caplog.messages[0], "kernels" in caplog.messages[1]] == [True, True]


def test_manifest_has_the_lineage_of_a_run(tmp_path: Path) -> None:
    create_run_folder(tmp_path, small_config())
    for iteration in (3, 7):
        append_lineage(tmp_path, iteration)
    lineage = json.loads((tmp_path / MANIFEST_FILE).read_text())["lineage"]
    assert [each["iteration"] for each in lineage] == [3, 7]
    assert {"packages", "kernels", "command", "started"} <= lineage[0].keys()


@pytest.mark.parametrize(("ended", "content"), [(True, b"last"), (False, b"best")])
def test_longer_run_resumes_with_the_best_scheduled_controller(ended: bool, content: bytes, tmp_path: Path) -> None:
    controllers = ControllerStore([tmp_path])
    controllers.save([b"best"], is_scheduled=True)
    controllers.save([b"last"], is_scheduled=False)
    assert (tmp_path / "controller.unjam").read_bytes() == b"last"
    (tmp_path / "controller.unjam").write_bytes(b"another file")
    tensors = {**controllers.tensors(), "weight": torch.zeros(1)}
    ControllerStore([tmp_path]).restore(tensors, ended)
    assert (tmp_path / "controller.unjam").read_bytes() == content
    assert tensors.keys() == {"weight"}


def test_files_of_equal_names_that_are_exchanged_between_tasks_are_refused(tmp_path: Path) -> None:
    rewards = [tmp_path / folder / "reward.py" for folder in "ab"]
    for number, file in enumerate(rewards):
        file.parent.mkdir()
        file.write_text(f"def constant(outcome):\n    return 0.0 * outcome.speeds.mean(-1) + {number}\n")
    tasks = [{"name": f"task-{number}", "reward": f"{file}:constant"} for number, file in enumerate(rewards)]
    config_file = tmp_path / "mix.toml"
    text = "".join(f"[[tasks]]\nname = '{task['name']}'\nreward = '{task['reward']}'\n" for task in tasks)
    config_file.write_text(to_toml(small_config()).replace("tasks = []\n", "") + text)
    config = load_config(config_file)
    with_checkpoint(tmp_path / "run", config)
    check_fingerprint(fingerprint(config), fingerprint(config))
    first, second = (file.read_text() for file in rewards)
    rewards[0].write_text(second)
    rewards[1].write_text(first)
    assert "reward.py has changed since the checkpoint" in refusal_message(tmp_path / "run", config)
