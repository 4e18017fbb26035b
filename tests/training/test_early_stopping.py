"""When a training ends before its steps, and where its numbers go while it runs."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.training.test_run import STEPS, controller_manifest, learn_with, outcome, small_config
from unjam.errors import MissingPartError
from unjam.reports.results import read_progress, validation_gains
from unjam.training.run_folder import check_controller
from unjam.training.tensorboard import TENSORBOARD_FOLDER, tensorboard_writer
from unjam.training.train import Trainer
from unjam.worlds.worker_pool import WorkerPool


@pytest.mark.parametrize(
    ("validations", "patience", "over"),
    [
        ([], 1, False),
        ([10.0], 1, True),  # the expert alone is better
        ([12.0, 13.0], 1, False),
        ([12.0, 11.5], 1, True),
        ([12.0, None, 11.5, None], 2, False),
        ([12.0, 11.5, 11.9], 2, True),
        ([9.0, 10.0], 2, True),
        ([12.0, 11.5, 11.9], 0, False),
    ],
)
def test_patience_counts_validations_since_the_best(validations: list[float | None], patience: int, over: bool) -> None:
    rows = [
        {"iteration": number, "return_validation": value, "return_expert": 11.0}
        for number, value in enumerate(validations, 1)
    ]
    assert small_config(evaluation__patience=patience).evaluation.is_out_of_patience(rows) is over


@pytest.mark.parametrize(
    ("returns", "span", "over"),
    [
        ([1.0, 2.0, 2.0], 2, False),  # not yet twice as many
        ([1.0, 2.0, 2.0, 0.9], 2, True),
        ([1.0, 2.0, 2.0, 1.1], 2, False),
        ([1.0, 2.0, 2.0, 1.1, 0.0], 2, False),  # looked at every second iteration
        ([1.0, 2.0, 2.0, 1.1, 0.0, 0.0], 2, True),
        ([1.0, 1.0, 1.0, 1.0], 0, False),
    ],
)
def test_convergence_compares_two_windows(returns: list[float], span: int, over: bool) -> None:
    rows = [{"return_mean": value} for value in returns]
    assert small_config(evaluation__convergence_window=span).evaluation.has_converged(rows) is over


def test_converged_policy_is_the_controller(tmp_path: Path) -> None:
    config = small_config(steps=20 * STEPS, evaluation__validation_interval=0, evaluation__convergence_window=1)
    with WorkerPool(1) as workers:
        learn_with(workers, tmp_path / "run", config)
    returns = [row["return_mean"] for row in read_progress(tmp_path / "run")]
    assert returns[-1] <= returns[-2]
    assert controller_manifest(tmp_path / "run")["iteration"] == len(returns) < 20


def test_validation_at_convergence_is_in_progress_and_counts_for_trials(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    returns = iter([5.0, 7.5])  # of the expert, and where it ends: before any validation was due
    monkeypatch.setattr(Trainer, "validation_returns", lambda *given: [next(returns)])
    config = small_config(steps=20 * STEPS, evaluation__validation_interval=50, evaluation__convergence_window=1)
    with WorkerPool(1) as workers:
        learn_with(workers, tmp_path / "run", config)
    found = [row["return_validation"] for row in read_progress(tmp_path / "run")]
    assert found == [None] * (len(found) - 1) + [7.5]
    assert validation_gains(read_progress(tmp_path / "run")) == (2.5, 2.5)


@pytest.mark.long
def test_training_ends_when_patience_is_over(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    returns = iter([5.0, 6.0, 5.5, 5.8, 9.0])
    monkeypatch.setattr(Trainer, "validation_returns", lambda *given: [next(returns)])
    config = small_config(steps=20 * STEPS, evaluation__patience=2)
    with WorkerPool(1) as workers:
        learn_with(workers, tmp_path / "run", config)
    found = [row["return_validation"] for row in read_progress(tmp_path / "run")]
    assert found == [6.0, 5.5, 5.8]


@pytest.mark.slow
def test_callback_can_end_the_training(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    returns = iter([5.0, 4.0, 6.0])  # of the expert, after two iterations, and where it ends
    monkeypatch.setattr(Trainer, "validation_returns", lambda *given: [next(returns)])
    config = small_config(steps=20 * STEPS, evaluation__validation_interval=2)
    with WorkerPool(1) as workers:
        learn_with(workers, tmp_path / "run", config, lambda row: row["iteration"] < 3)
    assert [row["return_validation"] for row in read_progress(tmp_path / "run")] == [None, 4.0, None]
    assert controller_manifest(tmp_path / "run")["iteration"] == 3


@pytest.mark.long
def test_training_ended_by_a_callback_resumes_unchanged(tmp_path: Path) -> None:
    config = small_config(steps=2 * STEPS, evaluation__validation_interval=2)
    with WorkerPool(1) as workers:
        learn_with(workers, tmp_path / "stopped", config, lambda row: False)
        check_controller(tmp_path / "stopped", "evaluate")
        learn_with(workers, tmp_path / "stopped", config, resume=True)
        learn_with(workers, tmp_path / "one go", config)
    assert outcome(tmp_path / "stopped") == outcome(tmp_path / "one go")


def test_tensorboard_has_every_number_by_environment_step(tmp_path: Path) -> None:
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    write = tensorboard_writer(str(tmp_path))
    for step in (300, 600):
        row: dict[str, Any] = {"iteration": step // 300, "environment_steps": step, "return_mean": step / 10}
        write({**row, "return_validation": None, "learner": {"kl": 0.5}, "seconds": {"collect": 1}})
    board = events.EventAccumulator(str(tmp_path / TENSORBOARD_FOLDER))
    board.Reload()
    assert set(board.Tags()["scalars"]) == {"return_mean", "learner/kl", "seconds/collect"}
    assert [(event.step, event.value) for event in board.Scalars("return_mean")] == [(300, 30.0), (600, 60.0)]


def test_missing_tensorboard_is_reported_before_training(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    with pytest.raises(MissingPartError, match=r"pip install 'unjam\[train\]'"):
        tensorboard_writer(tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_early_stop_persists_when_resumed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    returns = iter([5.0, 6.0, 5.5, 5.8, 9.0, 9.5])
    monkeypatch.setattr(Trainer, "validation_returns", lambda *given: [next(returns)])
    for name, settings in (
        ("gave up", {"evaluation__patience": 2}),
        ("converged", {"evaluation__validation_interval": 0, "evaluation__convergence_window": 1}),
    ):
        config, folder = small_config(steps=20 * STEPS, **settings), tmp_path / name
        with WorkerPool(1) as workers:
            learn_with(workers, folder, config)
            before = outcome(folder), len(read_progress(folder))
            learn_with(workers, folder, config, resume=True)
        assert (outcome(folder), len(read_progress(folder))) == before


def test_unscheduled_validation_does_not_count_for_patience() -> None:
    rows = [{"iteration": number, "return_expert": 10.0} for number in range(1, 5)]
    for row, found in zip(rows, (None, 12.0, 11.0, 11.5), strict=True):
        row["return_validation"] = found  # pyright: ignore[reportArgumentType]
    config = small_config(evaluation__validation_interval=2, evaluation__patience=2)
    assert not config.evaluation.is_out_of_patience(rows)


@pytest.mark.parametrize("changed", [{"environment_steps": "x"}, {"return_validation": []}, {"iteration": None}])
def test_rows_of_progress_with_other_kinds_of_values_are_left_out(changed: dict[str, Any], tmp_path: Path) -> None:
    row = {"iteration": 1, "environment_steps": 300, "return_validation": None, "return_expert": 2.0}
    (tmp_path / "progress.jsonl").write_text(f"{json.dumps(row)}\n{json.dumps(row | changed)}\n")
    assert read_progress(tmp_path) == [row]
