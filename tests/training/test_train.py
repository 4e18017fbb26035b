import json
import math
import random
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytest
import torch

from tests.pictures import empty_pictures
from tests.torch_defaults import other_default
from tests.training.test_run import STEPS, learn_with, outcome, small_config
from unjam.controller import load_controller
from unjam.drivers import ResidualDriver
from unjam.drivers.car_following import Constant
from unjam.errors import InputError, UnjamError
from unjam.measures.metrics import METRICS
from unjam.reports.results import read_progress, read_results
from unjam.seeds import held_out_seeds
from unjam.training.config import RunConfig
from unjam.training.evaluate import gain_over_expert
from unjam.training.random_state import exclusive_random_state
from unjam.training.run_folder import read_config
from unjam.training.train import TrainResult, train
from unjam.worlds.episode import run_episode
from unjam.worlds.worker_pool import WorkerPool

pytestmark = pytest.mark.usefixtures("without_pictures")

CONTENT = {
    "checkpoint",
    "config.toml",
    "controller.unjam",
    "episodes.parquet",
    "evaluation.json",
    "manifest.json",
    "model.json",
    "progress.jsonl",
    "report.html",
    "plot_episodes.safetensors",
}


class Trained(NamedTuple):
    config: RunConfig
    result: TrainResult
    shown: list[dict[str, Any]]
    judged: list[tuple[tuple[str, int], int]]


@pytest.fixture(scope="module")
def finished_training(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """A finished run of two iterations."""
    folder, config = tmp_path_factory.mktemp("runs") / "finished", small_config()
    shown: list[dict[str, Any]] = []
    judged: list[tuple[tuple[str, int], int]] = []
    with empty_pictures():
        result = train(
            config, folder, on_iteration=shown.append, progress=lambda episode, steps: judged.append((episode, steps))
        )
    return Trained(config, result, shown, judged)


def test_run_folder_is_complete(finished_training: Trained) -> None:
    folder = finished_training.result.folder
    assert {path.name for path in folder.iterdir()} == CONTENT
    assert finished_training.result.controller == folder / "controller.unjam"
    assert finished_training.result.report == folder / "report.html"


def test_run_folder_has_its_configuration_and_manifest(finished_training: Trained) -> None:
    assert read_config(finished_training.result.folder) == finished_training.config
    manifest = json.loads((finished_training.result.folder / "manifest.json").read_text())
    assert manifest["packages"]["torch"]
    assert manifest["started"]


def test_callback_gets_the_rows_of_progress(finished_training: Trained) -> None:
    assert finished_training.shown == read_progress(finished_training.result.folder)
    assert [row["environment_steps"] for row in finished_training.shown] == [STEPS, 2 * STEPS]


def test_every_driver_is_evaluated_on_test_seeds(finished_training: Trained) -> None:
    rows = finished_training.result.rows
    assert list(rows) == ["human", "pi", "trained"]
    for found in rows.values():
        assert [tuple(row["seed"]) for row in found] == held_out_seeds(2)
        assert {row["status"] for row in found} == {"completed"}
        assert {row["steps"] for row in found} == {100}


def test_evaluation_reports_progress(finished_training: Trained) -> None:
    ended = {episode for episode, steps in finished_training.judged if steps == 100}
    assert ended == {(driver, index) for driver in ("human", "pi", "trained") for index in (0, 1)}


def test_controller_has_the_reported_return(finished_training: Trained) -> None:
    scenario, driver = finished_training.config.make_scenario(), load_controller(finished_training.result.controller)
    for seed, row in zip(held_out_seeds(2), finished_training.result.rows["trained"], strict=True):
        (trajectory,) = run_episode(scenario, driver, seed).trajectories
        assert trajectory.reward.sum() == row["return"]


def test_gain_is_the_paired_difference_to_the_expert(finished_training: Trained) -> None:
    rows = finished_training.result.rows
    differences = [ours["return"] - theirs["return"] for ours, theirs in zip(rows["trained"], rows["pi"], strict=True)]
    assert finished_training.result.gain is not None
    assert finished_training.result.gain.mean == pytest.approx(np.mean(differences))
    assert finished_training.result.gain.count == 2
    assert (finished_training.result.gain.smallest, finished_training.result.gain.largest) == (
        min(differences),
        max(differences),
    )


def test_stored_evaluation_equals_the_result(finished_training: Trained) -> None:
    results = read_results(finished_training.result.folder)
    about = results.metadata
    assert (about["scenario"], about["reward"], about["expert"]) == ("ring", "released", "pi")
    assert results.trained_label == "trained"
    for driver, rows in finished_training.result.rows.items():
        for found, expected in zip(results.rows[driver], rows, strict=True):
            for name in METRICS:
                assert found[name] == pytest.approx(expected[name], rel=0, abs=0, nan_ok=True), name
    table = pd.read_parquet(finished_training.result.folder / "episodes.parquet")
    assert table.groupby("driver").size().to_dict() == {"human": 2, "pi": 2, "trained": 2}
    assert table["return"].tolist() == [
        row["return"] for rows in finished_training.result.rows.values() for row in rows
    ]


def test_plot_episode_is_the_first_of_each_driver(finished_training: Trained) -> None:
    shown = read_results(finished_training.result.folder).plot_episodes
    assert list(shown) == ["human", "pi", "trained"]
    expected = run_episode(
        finished_training.config.make_scenario(),
        load_controller(finished_training.result.controller),
        held_out_seeds(1)[0],
    )
    np.testing.assert_array_equal(shown["trained"].speeds, expected.speeds.astype(np.float32))
    assert shown["trained"].speeds.shape == (101, 8)


def test_report_has_the_run(finished_training: Trained) -> None:
    page = finished_training.result.report.read_text()
    assert page.lower().startswith("<!doctype html>")
    assert "trained" in page
    assert len(page) > 20_000


@pytest.mark.slow
def test_finished_run_resumes_with_a_larger_budget(finished_training: Trained, tmp_path: Path) -> None:
    folder, longer = tmp_path / "run", replace(finished_training.config, steps=3 * STEPS)
    shutil.copytree(finished_training.result.folder, folder)
    result = train(longer, folder, resume=True)
    with WorkerPool(1) as workers:
        learn_with(workers, tmp_path / "one go", longer)
    assert outcome(folder) == outcome(tmp_path / "one go")
    assert read_config(folder) == longer
    assert {path.name for path in folder.iterdir()} == CONTENT
    assert same_rows(result.rows["pi"], finished_training.result.rows["pi"])


def same_rows(ours: list[dict[str, Any]], theirs: list[dict[str, Any]]) -> bool:
    return all(
        mine[name] == other[name] or (math.isnan(mine[name]) and math.isnan(other[name]))
        for mine, other in zip(ours, theirs, strict=True)
        for name in METRICS
    )


@pytest.mark.slow
def test_training_works_without_an_expert(tmp_path: Path) -> None:
    config = small_config(expert="none", evaluation__baselines=(), evaluation__validation_interval=0)
    result = train(config, tmp_path / "run")
    assert result.gain is None
    assert list(result.rows) == ["trained"]
    loaded = load_controller(result.controller)
    assert isinstance(loaded, ResidualDriver)
    assert loaded.expert == Constant()
    (trajectory,) = run_episode(config.make_scenario(), loaded, (0,)).trajectories
    assert not trajectory.expert_acceleration.any()
    assert trajectory.applied_acceleration.any()
    assert result.report.is_file()


@pytest.mark.long
def test_code_that_changes_in_a_training_ends_it(tmp_path: Path) -> None:
    code, folder = tmp_path / "mine.py", tmp_path / "run"
    code.write_text("def number(state):\n    return state.speed / 20\n")
    config = small_config(policy__inputs=["local", f"{code}:number"])
    with pytest.raises(
        InputError, match=r"train: .*mine\.py has changed since the checkpoint; allowed: as it was then"
    ):
        train(config, folder, on_iteration=lambda row: code.write_text("def number(state):\n    return state.speed\n"))
    assert [row["iteration"] for row in read_progress(folder)] == [1]


def test_nonempty_run_folder_is_not_changed(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match="is not empty; allowed: a new folder"):
        train(small_config(), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_file_instead_of_a_folder_is_not_changed(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(UnjamError):
        train(small_config(), tmp_path / "file")
    assert (tmp_path / "file").read_text() == "mine"


def test_gain_uses_the_expert_with_its_parameters() -> None:
    config = small_config(expert="pi:window=30")
    expert = config.make_expert().describe()
    rows = {
        "pi": [{"seed": (1, 0), "return": 100.0}],
        expert: [{"seed": (1, 0), "return": 5.0}, {"seed": (1, 1), "return": 6.0}],
        "trained": [{"seed": (1, 1), "return": 9.0}, {"seed": (1, 0), "return": 6.0}],
    }
    gain = gain_over_expert(config, rows)
    assert gain is not None
    assert gain.mean == pytest.approx(2.0)


def test_training_restores_generators_and_threads() -> None:
    def seed_all(seed: int) -> None:
        torch.manual_seed(seed)
        np.random.seed(seed)
        random.seed(seed)

    def draw() -> list[float]:
        return [*torch.rand(2).tolist(), *np.random.rand(2), random.random()]

    seed_all(3)
    threads, expected = torch.get_num_threads(), draw()
    seed_all(3)
    with exclusive_random_state():
        seed_all(8)
        torch.set_num_threads(threads + 1)
    assert draw() == expected
    assert torch.get_num_threads() == threads


def test_training_is_the_same_whatever_defaults_of_torch_the_program_has_set() -> None:
    def make_gradient() -> torch.Tensor:
        with exclusive_random_state():
            weights = torch.ones(2, requires_grad=True)
            loss = (weights @ torch.tensor([[0.1], [0.2]])).sum()
            loss.backward()
            assert weights.grad is not None
            return torch.stack([loss.detach(), *weights.grad])

    expected = make_gradient()
    with other_default(torch.float64), other_default(torch.device("meta")):
        with torch.inference_mode(), torch.autocast("cpu", dtype=torch.bfloat16):
            found = make_gradient()
            assert torch.is_inference_mode_enabled()
        assert torch.get_default_dtype() == torch.float64
        assert torch.get_default_device() == torch.device("meta")
    assert found.dtype == expected.dtype
    assert torch.equal(found, expected)


def test_second_training_in_a_process_is_refused() -> None:
    refused = pytest.raises(UnjamError, match="another training runs in this process")
    for _ in range(2):
        with exclusive_random_state(), refused, exclusive_random_state():
            raise AssertionError


@pytest.mark.parametrize("exists", [False, True])
def test_a_refused_training_leaves_no_folder(tmp_path: Path, exists: bool) -> None:
    folder = tmp_path / "run"
    (tmp_path / "bad.py").write_text("def broken(state): return state.speed * float('nan')")
    if exists:
        folder.mkdir()
    with pytest.raises(InputError, match="acceleration of cav_0 is nan"):
        train(replace(small_config(), expert=f"{tmp_path}/bad.py:broken"), folder)
    assert not folder.exists()


def test_a_result_prints_a_table_of_its_drivers(finished_training: Trained) -> None:
    result = finished_training.result
    head, columns, *rows, gain, controller = str(result).splitlines()
    assert head == f"training run {result.folder}"
    assert columns.split() == list(result.rows)
    assert any(row.strip().startswith("mean speed [m/s]") for row in rows)
    assert gain.startswith("return compared with the expert: ")
    assert controller == f"controller: {result.controller}"
    assert result.plot().axes[0].get_ylabel() == "return of an episode"
