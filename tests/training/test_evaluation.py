import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from tests.adapters.onnx_policies import follower, write
from tests.pictures import empty_pictures
from tests.training.test_run import STEPS, learn_with, small_config
from unjam.controller import controller_bytes, load_controller
from unjam.drivers import PISaturation, ResidualDriver
from unjam.errors import InputError
from unjam.reports.html import render_report
from unjam.reports.results import read_results
from unjam.seeds import held_out_seeds
from unjam.training.config import RunConfig
from unjam.training.evaluate import TRAINED_LABEL, drivers_to_compare, evaluate_run
from unjam.worlds.episode import run_episode
from unjam.worlds.worker_pool import WorkerPool


@pytest.fixture(scope="module")
def pool() -> Iterator[WorkerPool]:
    with WorkerPool(1) as workers:
        yield workers


def train_small_run(pool: WorkerPool, folder: Path, **changes: object) -> tuple[Path, RunConfig]:
    """A run of one iteration that is not evaluated yet."""
    config = small_config(**{"steps": STEPS, "evaluation__validation_interval": 0, **changes})
    learn_with(pool, folder, config)
    return folder, config


def with_evaluation(config: RunConfig, baselines: Sequence[str] | None = None) -> RunConfig:
    """The configuration with one test episode, and other baselines."""
    settings = config.evaluation
    baselines = settings.baselines if baselines is None else tuple(baselines)
    return replace(config, evaluation=replace(settings, baselines=baselines, episodes=1))


@pytest.fixture(scope="module")
def run(pool: WorkerPool, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RunConfig]:
    return train_small_run(pool, tmp_path_factory.mktemp("runs") / "run")


def test_comparison_has_baselines_expert_and_trained_controller(run: tuple[Path, RunConfig]) -> None:
    folder, config = run
    drivers = drivers_to_compare(with_evaluation(config, ["human", "pi:window=30"]), folder)
    assert next(iter(drivers)) == "human"
    assert list(drivers)[-2:] == ["pi", TRAINED_LABEL]
    assert len(drivers) == 4
    assert drivers["pi"] == PISaturation()
    trained = drivers[TRAINED_LABEL]
    assert isinstance(trained, ResidualDriver)
    assert trained.expert == PISaturation()


def test_results_and_report_have_the_hash_of_the_controller(
    run: tuple[Path, RunConfig], pool: WorkerPool, tmp_path: Path
) -> None:
    folder, config = run
    evaluate_run(folder, with_evaluation(config, []), pool, out=tmp_path)
    sha256 = hashlib.sha256((folder / "controller.unjam").read_bytes()).hexdigest()
    found = read_results(tmp_path)
    assert found.metadata["controllers"] == {TRAINED_LABEL: sha256}
    with empty_pictures():
        assert f"Controller {TRAINED_LABEL}: SHA-256 {sha256}" in render_report([found])


def test_expert_among_the_baselines_is_compared_once(run: tuple[Path, RunConfig]) -> None:
    folder, config = run
    assert list(drivers_to_compare(with_evaluation(config, ["pi", "human"]), folder)) == ["human", "pi", TRAINED_LABEL]


def test_packaged_baseline_has_its_short_name(run: tuple[Path, RunConfig]) -> None:
    folder, config = run
    name = "unjam:ring-jammed-tuned"
    assert list(drivers_to_compare(with_evaluation(config, ["human", name]), folder)) == [
        "human",
        "pi",
        name,
        TRAINED_LABEL,
    ]


def test_baselines_with_different_parameters_are_all_compared(run: tuple[Path, RunConfig], my_drivers: Path) -> None:
    folder, config = run
    names = [f"{my_drivers}:Keeper:gain={gain}" for gain in (0.1, 0.2)]
    assert len(drivers_to_compare(with_evaluation(config, names), folder)) == 4


def test_evaluation_uses_test_seeds_and_is_saved(run: tuple[Path, RunConfig], pool: WorkerPool) -> None:
    folder, config = run
    found = evaluate_run(folder, config, pool)
    assert list(found.rows) == ["human", "pi", TRAINED_LABEL]
    for rows in found.rows.values():
        assert [tuple(row["seed"]) for row in rows] == held_out_seeds(2)
    saved = read_results(folder)
    assert list(saved.rows) == list(found.rows)
    assert saved.metadata["expert"] == "pi"
    assert saved.metadata["manifest"]["unjam"]
    scenario = config.make_scenario()
    (trajectory,) = run_episode(scenario, load_controller(folder), held_out_seeds(1)[0]).trajectories
    assert found.rows[TRAINED_LABEL][0]["return"] == trajectory.reward.sum()


def test_baselines_and_episodes_can_be_overridden(run: tuple[Path, RunConfig], pool: WorkerPool) -> None:
    folder, config = run
    found = evaluate_run(folder, with_evaluation(config, ["idm"]), pool)
    assert list(found.rows) == ["idm", "pi", TRAINED_LABEL]
    assert {len(rows) for rows in found.rows.values()} == {1}
    assert list(evaluate_run(folder, with_evaluation(config, []), pool).rows) == ["pi", TRAINED_LABEL]


def test_no_expert_is_compared_without_one(pool: WorkerPool, tmp_path: Path) -> None:
    folder, config = train_small_run(pool, tmp_path / "run", expert="none")
    found = evaluate_run(folder, with_evaluation(config), pool)
    assert list(found.rows) == ["human", TRAINED_LABEL]
    assert read_results(folder).metadata["expert"] == "none"


def test_trained_controller_can_be_the_next_expert(
    run: tuple[Path, RunConfig], pool: WorkerPool, tmp_path: Path
) -> None:
    first, _ = run
    folder, config = train_small_run(pool, tmp_path / "next", expert=str(first), policy__action_duration=3)
    found = evaluate_run(folder, with_evaluation(config), pool)
    assert list(found.rows) == ["human", "pi + residual", TRAINED_LABEL]
    trained, expert = load_controller(folder), load_controller(first)
    assert isinstance(trained, ResidualDriver)
    assert controller_bytes(trained.expert, {}) == controller_bytes(expert, {})
    (trajectory,) = run_episode(config.make_scenario(), expert, held_out_seeds(1)[0]).trajectories
    assert found.rows["pi + residual"][0]["return"] == trajectory.reward.sum()


def test_baseline_with_the_description_of_the_expert_is_kept(
    run: tuple[Path, RunConfig], pool: WorkerPool, tmp_path: Path
) -> None:
    first, _ = run
    second, _ = train_small_run(pool, tmp_path / "second", seed=1)
    folder, config = train_small_run(pool, tmp_path / "next", expert=str(first))
    assert len(drivers_to_compare(with_evaluation(config, [str(second)]), folder)) == 3


def test_user_expert_and_reward_are_used(pool: WorkerPool, tmp_path: Path, my_drivers: Path) -> None:
    changes = {"expert": f"{my_drivers}:gentle", "reward": f"{my_drivers}:calm"}
    folder, config = train_small_run(pool, tmp_path / "run", **changes)
    found = evaluate_run(folder, with_evaluation(config), pool)
    assert list(found.rows) == ["human", "mine.py:gentle", TRAINED_LABEL]
    about = json.loads((folder / "evaluation.json").read_text())
    assert about["reward"] == f"{my_drivers}:calm"
    driver, seed = load_controller(folder), held_out_seeds(1)[0]
    (trajectory,) = run_episode(config.make_scenario(), driver, seed, config.reward).trajectories
    assert set(trajectory.reward_terms) == {"speed", "push"}
    assert found.rows[TRAINED_LABEL][0]["return"] == trajectory.reward.sum()


@pytest.mark.long
def test_an_onnx_expert_is_trained_with_and_stored_as_data(pool: WorkerPool, tmp_path: Path) -> None:
    graph = write(tmp_path, follower())
    folder, config = train_small_run(pool, tmp_path / "run", expert=str(graph), model__model_ratio=0.0)
    found = evaluate_run(folder, with_evaluation(config), pool)
    assert list(found.rows) == ["human", "policy.onnx", TRAINED_LABEL]
    graph.unlink()
    driver = load_controller(folder)
    assert driver.describe() == "policy.onnx + residual"
    seed = held_out_seeds(1)[0]
    episode = run_episode(config.make_scenario(), driver, seed, config.reward)
    assert found.rows[TRAINED_LABEL][0]["return"] == episode.trajectories[0].reward.sum()


def test_failed_baseline_is_reported_and_the_rest_is_saved(
    run: tuple[Path, RunConfig], pool: WorkerPool, my_drivers: Path
) -> None:
    folder, config = run
    with pytest.raises(InputError, match="acceleration of cav_0 is nan"):
        evaluate_run(folder, with_evaluation(config, [f"{my_drivers}:broken"]), pool)
    rows = read_results(folder).rows
    assert [row["status"] for row in rows["mine.py:broken"]] == ["failed"]
    assert [row["status"] for row in rows[TRAINED_LABEL]] == ["completed"]


def test_folder_without_a_controller_is_refused(tmp_path: Path, pool: WorkerPool) -> None:
    with pytest.raises(InputError, match=r"controller\.unjam' does not exist"):
        evaluate_run(tmp_path, small_config(), pool)
