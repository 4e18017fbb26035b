import json
import shutil
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save

from unjam.controller import load_controller
from unjam.drivers import PISaturation, ResidualDriver
from unjam.drivers.network import Network
from unjam.errors import InputError
from unjam.files import sha256_of
from unjam.learners.algorithm import TaskEpisodes
from unjam.learners.settings import unused_tables
from unjam.reports.results import read_progress
from unjam.seeds import TEST_SEED, VALIDATION_SEED
from unjam.training.config import RunConfig, load_config
from unjam.training.run_folder import (
    CHECKPOINT_FORMAT,
    create_run_folder,
    load_checkpoint,
    resume_run_folder,
    save_checkpoint,
)
from unjam.training.train import IterationCallback, Trainer
from unjam.worlds.record import Episode
from unjam.worlds.worker_pool import WorkerPool

torch.set_num_threads(1)  # as a training does

STEPS = 300
"""environment steps of an iteration of a small run: three episodes"""


def small_config(**changes: Any) -> RunConfig:
    """A run of two iterations on a ring of eight vehicles; with a dot in a key written as two underscores."""
    small = {
        "scenario_options": {"length": [120, 130], "vehicles": 8, "horizon": 100},
        "policy": {"hidden": [8]},
        "trpo": {"steps_per_iteration": STEPS, "critic_epochs": 2, "critic_batch_size": 16},
        "ppo": {"steps_per_iteration": STEPS, "epochs": 3},
        "sac": {"steps_per_iteration": STEPS, "learning_starts": 400, "gradient_steps_per_step": 0.02, "batch_size": 8},
        "td3": {"steps_per_iteration": STEPS, "learning_starts": 400, "gradient_steps_per_step": 0.02, "batch_size": 8},
        "evaluation": {"validation_interval": 1, "validation_episodes": 2, "episodes": 2, "baselines": ["human"]},
        "steps": 2 * STEPS,
        "workers": 1,
    }
    unused = unused_tables(changes.get("agent", "trpo"))
    small = {key: value for key, value in small.items() if key not in unused}
    return load_config(changes={**small, **{key.replace("__", "."): value for key, value in changes.items()}})


class Stop(Exception):
    """Stands for whatever ends a run in the middle."""


def stop_after(iterations: int) -> IterationCallback:
    def stop(row: dict[str, Any]) -> None:
        if row["iteration"] == iterations:
            raise Stop

    return stop


def learn_with(
    workers: WorkerPool,
    folder: Path,
    config: RunConfig,
    on_iteration: IterationCallback | None = None,
    resume: bool = False,
) -> Trainer:
    """Train without the final judgement and the report."""
    if resume:
        resume_run_folder(folder, config)
    else:
        create_run_folder(folder, config)
    run = Trainer(folder, config, workers, on_iteration)
    run.train()
    return run


def collected_episodes(monkeypatch: pytest.MonkeyPatch) -> list[Episode]:
    """The episodes that are driven from now on for an iteration, as they come."""
    episodes: list[Episode] = []
    collect = Trainer.collect

    def kept(self: Trainer, network: Network, iteration: int) -> TaskEpisodes:
        driven = collect(self, network, iteration)
        episodes.extend(episode for of_task in driven for episode in of_task)
        return driven

    monkeypatch.setattr(Trainer, "collect", kept)
    return episodes


Learn = Callable[..., Trainer]


@pytest.fixture(scope="module")
def learn() -> Iterator[Learn]:
    """`learn_with` a worker that all tests of this file share."""
    with WorkerPool(1) as workers:
        yield partial(learn_with, workers)


def progress(folder: Path) -> list[dict[str, Any]]:
    """The rows of progress without what differs from one run to the next."""
    return [{key: value for key, value in row.items() if key != "seconds"} for row in read_progress(folder)]


def outcome(folder: Path) -> tuple[Any, ...]:
    """All that a run must repeat to the last bit."""
    found = load_checkpoint(folder / "checkpoint")
    assert found is not None
    state, tensors = found
    weights = {name: tensor.numpy().tobytes() for name, tensor in tensors.items()}
    return state, weights, (folder / "controller.unjam").read_bytes(), progress(folder)


def controller_manifest(folder: Path) -> dict[str, Any]:
    with zipfile.ZipFile(folder / "controller.unjam") as archive:
        return json.loads(archive.read("manifest.json"))


@pytest.fixture(scope="module")
def uninterrupted_run(tmp_path_factory: pytest.TempPathFactory, learn: Learn) -> Path:
    """A run of four iterations."""
    folder = tmp_path_factory.mktemp("runs") / "uninterrupted"
    learn(folder, small_config(steps=4 * STEPS))
    return folder


def test_progress_counts_environment_steps_by_iteration(uninterrupted_run: Path) -> None:
    rows = progress(uninterrupted_run)
    assert [row["iteration"] for row in rows] == [1, 2, 3, 4]
    assert [row["environment_steps"] for row in rows] == [300, 600, 900, 1200]
    assert all(row["model_steps"] >= row["environment_steps"] for row in rows if row["k_star"] >= 10)


def test_progress_row_is_complete(uninterrupted_run: Path) -> None:
    for row in read_progress(uninterrupted_run):
        numbers = [
            row[name] for name in ("return_mean", "return_expert", "return_validation", "mean_speed", "mean_abs_accel")
        ]
        assert np.isfinite(numbers).all()
        assert set(row["seconds"]) == {"collect", "fit", "roll_out", "update", "validation"}
        assert row["eps_m"] == row["model"]["eps_m_by_estimator"]["unexplained_variance"] > 0
        assert 0.0 < row["learner"]["kl_divergence_loss"] <= 0.03
        assert row["collisions"] == 0
        assert 0.0 <= row["shield_override_share"] <= 1.0
        assert 0.0 < row["mean_speed"] < 30.0


def test_steps_are_rounded_up_to_whole_iterations(tmp_path: Path, learn: Learn) -> None:
    run = learn(tmp_path / "run", small_config(trpo__steps_per_iteration=101, steps=201))
    assert [row["environment_steps"] for row in progress(tmp_path / "run")] == [200, 400]
    assert run.collector.environment_steps == 400


@pytest.mark.long
def test_same_configuration_repeats_bit_for_bit(uninterrupted_run: Path, tmp_path: Path, learn: Learn) -> None:
    learn(tmp_path / "again", small_config(steps=4 * STEPS))
    assert outcome(tmp_path / "again") == outcome(uninterrupted_run)


def test_other_seed_gives_another_run(uninterrupted_run: Path, tmp_path: Path, learn: Learn) -> None:
    learn(tmp_path / "other", small_config(steps=STEPS, seed=1))
    assert progress(tmp_path / "other")[0]["return_mean"] != progress(uninterrupted_run)[0]["return_mean"]


@pytest.mark.slow
def test_number_of_workers_does_not_change_the_result(uninterrupted_run: Path, tmp_path: Path) -> None:
    with WorkerPool(2) as two:
        learn_with(two, tmp_path / "two", small_config(steps=4 * STEPS, workers=2))
    assert outcome(tmp_path / "two") == outcome(uninterrupted_run)


@pytest.mark.long
@pytest.mark.parametrize("iterations", [pytest.param(1, marks=pytest.mark.slow), 3])
def test_interrupted_run_ends_unchanged(uninterrupted_run: Path, tmp_path: Path, iterations: int, learn: Learn) -> None:
    folder, config = tmp_path / "run", small_config(steps=4 * STEPS)
    with pytest.raises(Stop):
        learn(folder, config, stop_after(iterations))
    assert len(progress(folder)) == iterations
    learn(folder, config, resume=True)
    assert outcome(folder) == outcome(uninterrupted_run)


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["ppo", "sac", "td3"])
def test_interrupted_run_of_any_learner_ends_unchanged(tmp_path: Path, agent: str, learn: Learn) -> None:
    config = small_config(agent=agent, steps=4 * STEPS, policy__hidden=[8, 8])
    learn(tmp_path / "one go", config)
    for iterations in (1, 3):
        with pytest.raises(Stop):
            learn(tmp_path / "run", config, stop_after(iterations), resume=iterations > 1)
    learn(tmp_path / "run", config, resume=True)
    assert outcome(tmp_path / "run") == outcome(tmp_path / "one go")


@pytest.mark.slow
def test_learners_give_different_results(uninterrupted_run: Path, tmp_path: Path, learn: Learn) -> None:
    for agent, key in {"ppo": "clip_fraction", "sac": "critic_loss", "td3": "critic_loss"}.items():
        learn(tmp_path / agent, small_config(agent=agent))
        rows = progress(tmp_path / agent)
        assert rows[0]["return_expert"] == progress(uninterrupted_run)[0]["return_expert"]
        assert key in rows[1]["learner"]
        assert [row["environment_steps"] for row in rows] == [STEPS, 2 * STEPS]
        loaded = load_controller(tmp_path / agent)
        assert isinstance(loaded, ResidualDriver)
        assert loaded.network.squashes_noise is (agent == "sac")


@pytest.mark.slow
def test_repeatedly_interrupted_run_ends_unchanged(uninterrupted_run: Path, tmp_path: Path, learn: Learn) -> None:
    folder, config = tmp_path / "run", small_config(steps=4 * STEPS)
    for iterations in (1, 2, 3):
        with pytest.raises(Stop):
            learn(folder, config, stop_after(iterations), resume=iterations > 1)
    learn(folder, config, resume=True)
    assert outcome(folder) == outcome(uninterrupted_run)


@pytest.mark.long
def test_extended_run_equals_one_long_run(uninterrupted_run: Path, tmp_path: Path, learn: Learn) -> None:
    folder = tmp_path / "run"
    learn(folder, small_config(steps=2 * STEPS))
    learn(folder, small_config(steps=4 * STEPS, workers=2), resume=True)
    assert outcome(folder) == outcome(uninterrupted_run)


def test_fewer_steps_than_done_are_refused(tmp_path: Path, learn: Learn) -> None:
    learn(tmp_path / "run", small_config(steps=2 * STEPS))
    with pytest.raises(InputError, match=f"steps: {STEPS} is not allowed; allowed: >= {2 * STEPS}, which"):
        resume_run_folder(tmp_path / "run", small_config(steps=STEPS))


@pytest.mark.slow
def test_final_validation_does_not_change_learning(tmp_path: Path, learn: Learn) -> None:
    longer, folder = small_config(steps=4 * STEPS, evaluation__validation_interval=2), tmp_path / "run"
    learn(folder, replace(longer, steps=3 * STEPS))
    learn(folder, longer, resume=True)
    learn(tmp_path / "one go", longer)
    (_, found, controller, _), (_, expected, other, _) = outcome(folder), outcome(tmp_path / "one go")
    assert found == expected
    assert controller == other


@pytest.mark.slow
def test_run_without_a_checkpoint_starts_again(uninterrupted_run: Path, tmp_path: Path, learn: Learn) -> None:
    folder, config = tmp_path / "run", small_config(steps=4 * STEPS)
    with pytest.raises(Stop):
        learn(folder, config, stop_after(1))
    shutil.rmtree(folder / "checkpoint")
    (folder / "progress.jsonl").unlink()
    learn(folder, config, resume=True)
    assert outcome(folder) == outcome(uninterrupted_run)


DAMAGE: dict[str, Callable[[Path], object]] = {
    "killed before the checkpoint": lambda folder: next((folder / "checkpoint").glob("000003-*")).unlink(),
    "damaged checkpoint": lambda folder: next((folder / "checkpoint").glob("000003-*")).write_bytes(b"lost"),
    "line cut short": lambda folder: (folder / "progress.jsonl").open("a").write('{"iteration": 4, "actu'),
}
KILLED, *OTHERS = DAMAGE


@pytest.mark.slow
@pytest.mark.parametrize("name", [KILLED, *(pytest.param(name, marks=pytest.mark.slow) for name in OTHERS)])
def test_leftovers_of_a_crash_do_not_change_the_result(
    uninterrupted_run: Path, tmp_path: Path, name: str, learn: Learn
) -> None:
    folder, config = tmp_path / "run", small_config(steps=4 * STEPS)
    with pytest.raises(Stop):
        learn(folder, config, stop_after(3))
    DAMAGE[name](folder)
    learn(folder, config, resume=True)
    assert outcome(folder) == outcome(uninterrupted_run)


def test_run_keeps_two_checkpoints(uninterrupted_run: Path) -> None:
    names = sorted(path.name for path in (uninterrupted_run / "checkpoint").iterdir())
    assert [name[:7] for name in names] == ["000003-", "000004-"]


def test_controller_is_the_best_on_validation_seeds(uninterrupted_run: Path) -> None:
    rows = progress(uninterrupted_run)
    best = max(rows, key=lambda row: row["return_validation"])
    expected = best["iteration"] if best["return_validation"] > best["return_expert"] else 0
    assert controller_manifest(uninterrupted_run)["iteration"] == expected
    assert controller_manifest(uninterrupted_run)["environment_steps"] == expected * STEPS


def test_earlier_controller_stays_if_it_is_the_best(tmp_path: Path, learn: Learn) -> None:
    learn(tmp_path, small_config(steps=STEPS))
    before = (tmp_path / "controller.unjam").read_bytes()
    found = load_checkpoint(tmp_path / "checkpoint")
    assert found is not None
    save_checkpoint(tmp_path / "checkpoint", {**found[0], "best_validation": 1e9}, found[1])
    learn(tmp_path, small_config(steps=2 * STEPS), resume=True)
    assert (tmp_path / "controller.unjam").read_bytes() == before
    assert len(progress(tmp_path)) == 2


def test_expert_stays_the_controller_if_it_is_the_best(tmp_path: Path, learn: Learn) -> None:
    # The residual is almost zero: only its exploration has an effect.
    config = small_config(policy__authority=1e-30, policy__exploration_std=1e-12, steps=STEPS)
    learn(tmp_path / "run", config)
    (row,) = progress(tmp_path / "run")
    assert row["return_validation"] == row["return_expert"]
    assert controller_manifest(tmp_path / "run")["iteration"] == 0


def test_initial_controller_is_the_expert(tmp_path: Path, learn: Learn) -> None:
    with pytest.raises(Stop):
        learn(tmp_path / "run", small_config(evaluation__validation_interval=5), stop_after(1))
    loaded = load_controller(tmp_path / "run")
    assert isinstance(loaded, ResidualDriver)
    assert loaded.expert == PISaturation()
    assert not loaded.network.layers[-1][0].any()


def test_last_policy_is_the_controller_without_validations(tmp_path: Path, learn: Learn) -> None:
    run = learn(tmp_path / "run", small_config(evaluation__validation_interval=0))
    assert {row["return_validation"] for row in progress(tmp_path / "run")} == {None}
    loaded = load_controller(tmp_path / "run")
    assert isinstance(loaded, ResidualDriver)
    for found, expected in zip(loaded.network.layers, run.network().layers, strict=True):
        np.testing.assert_array_equal(found[0], expected[0])
        np.testing.assert_array_equal(found[1], expected[1])
    assert controller_manifest(tmp_path / "run")["iteration"] == 2


@pytest.mark.long
def test_validations_are_scheduled_and_at_the_end(tmp_path: Path, learn: Learn) -> None:
    learn(tmp_path / "run", small_config(evaluation__validation_interval=2, steps=3 * STEPS))
    validated = [row["return_validation"] is not None for row in progress(tmp_path / "run")]
    assert validated == [False, True, True]


@pytest.mark.parametrize("spread", [True, False])
def test_stratified_episodes_cover_all_lengths(
    tmp_path: Path, spread: bool, learn: Learn, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = small_config(
        stratified=spread,
        trpo__steps_per_iteration=11 * 20,
        steps=20,
        scenario_options__horizon=20,
        evaluation__validation_interval=0,
    )
    episodes = collected_episodes(monkeypatch)
    learn(tmp_path / "run", config)
    lengths = [episode.drawn_values["length"] for episode in episodes]
    assert (sorted(lengths) == list(range(120, 131))) is spread
    assert set(lengths) <= set(range(120, 131))


def test_training_seeds_are_unique_and_not_reserved(
    tmp_path: Path, learn: Learn, monkeypatch: pytest.MonkeyPatch
) -> None:
    episodes = collected_episodes(monkeypatch)
    learn(tmp_path, small_config(seed=5))
    seeds = [episode.seed for episode in episodes]
    assert len(seeds) == len(set(seeds)) == 6
    assert {seed[0] for seed in seeds} == {5}
    assert not {TEST_SEED, VALIDATION_SEED} & {number for seed in seeds for number in seed}


def test_training_explores_and_validation_does_not(
    tmp_path: Path, learn: Learn, monkeypatch: pytest.MonkeyPatch
) -> None:
    episodes = collected_episodes(monkeypatch)
    run = learn(tmp_path / "run", small_config(policy__exploration_std=0.3))
    (trajectory,) = episodes[-1].trajectories
    assert np.std(trajectory.residual) > 0.1
    again = run.make_drivers(run.network())
    assert run.validation_returns(again) == [progress(tmp_path / "run")[-1]["return_validation"]]


@pytest.mark.parametrize("name", ["broken", "short", "raises"])
def test_invalid_expert_is_reported(tmp_path: Path, my_drivers: Path, learn: Learn, name: str) -> None:
    with pytest.raises(InputError) as caught:
        learn(tmp_path / "run", small_config(expert=f"{my_drivers}:{name}"))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run" / "checkpoint").exists()


def test_invalid_reward_is_reported(tmp_path: Path, my_drivers: Path, learn: Learn) -> None:
    with pytest.raises(InputError, match=r"reward mine\.py:wrong_reward: step 0: term 'speed' is nan"):
        learn(tmp_path / "run", small_config(reward=f"{my_drivers}:wrong_reward"))


@pytest.fixture(scope="module")
def stored_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stored") / "run"
    with WorkerPool(1) as workers, pytest.raises(Stop):
        learn_with(workers, folder, small_config(), stop_after(1))
    return folder


@pytest.mark.parametrize(
    "change",
    [
        *({name: value} for name in ("iteration", "environment_steps") for value in ("x", None, -1, 1e30, 0.5, [])),
        *({name: value} for name in ("algorithm", "sampler", "fingerprint") for value in ("x", None, {}, [1])),
        {"sampler": {"best_returns": "x", "shares": [1.0]}},
        {"fingerprint": {"settings": {}, "files": {"a": []}, "packages": {}, "kernels": {}}},
        *({"expert_returns": value} for value in ("x", ["x"], [], [1.0, 2.0])),
        {"best_validation": "x"},
        {"ghost": 1},
    ],
    ids=str,
)
def test_a_checkpoint_with_values_that_unjam_does_not_write_is_refused(
    change: dict[str, Any], stored_run: Path, learn: Learn, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(stored_run, folder)
    checkpoint = load_checkpoint(folder / "checkpoint")
    assert checkpoint is not None
    shutil.rmtree(folder / "checkpoint")
    state, tensors = checkpoint
    content = save(tensors, {"state": json.dumps({**state, "format": CHECKPOINT_FORMAT, **change})})
    (folder / "checkpoint").mkdir()
    (folder / "checkpoint" / f"000001-{sha256_of(content)}.safetensors").write_bytes(content)
    with pytest.raises(InputError, match=r"^(checkpoint|resume): "):
        learn(folder, small_config(steps=4 * STEPS), resume=True)
