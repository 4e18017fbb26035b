"""Training on several roads at once."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.training.test_run import Stop, collected_episodes, learn_with, outcome, progress, small_config, stop_after
from tests.worlds.sumo.user_networks import SPARSE, straight
from unjam.controller import load_controller
from unjam.drivers import PISaturation, ResidualDriver
from unjam.errors import InputError
from unjam.learners.algorithm_1 import Algorithm1
from unjam.learners.experience import environment_experience
from unjam.learners.settings import AGENT_NAMES
from unjam.reports.results import read_progress
from unjam.training.config import RunConfig, TaskConfig, load_config, planned_steps, to_toml
from unjam.training.run_folder import check_config, read_config
from unjam.training.train import Trainer, train
from unjam.worlds.worker_pool import WorkerPool

torch.set_num_threads(1)  # as a training does

EIGHT = {"radius": [30, 31], "vehicles": 8}
SHORT = {"scenario_options": {"length": [90, 100], "vehicles": 6}, "name": "short"}
MIXTURE: list[dict[str, Any]] = [{"weight": 2.0}, SHORT]
MODEL = {"model__members": 2, "model__epochs": 2, "model__hidden": [8]}


def mixture(**changes: Any) -> RunConfig:
    return small_config(**{"tasks": MIXTURE, **MODEL, **changes})


def test_planned_steps_are_whole_iterations() -> None:
    assert planned_steps(load_config(changes={"steps": 10})) == 12_000
    assert planned_steps(load_config(changes={"steps": 24_000})) == 24_000
    assert (
        planned_steps(
            load_config(changes={"steps": 5, "scenario_options.horizon": 80, "trpo.steps_per_iteration": 100})
        )
        == 160
    )


def test_missing_task_entries_are_those_of_the_run() -> None:
    config = mixture(expert="pi:window=30", reward="eq16", tasks=[*MIXTURE, {"scenario": "ring-warm"}, {}])
    roads = config.task_configs()
    assert list(roads) == ["ring", "short", "ring-warm", "ring-2"]
    assert {road.expert for road in roads.values()} == {"pi:window=30"}
    assert roads["short"].scenario_options == {"length": [90, 100], "vehicles": 6, "horizon": 100}
    tasks = config.make_tasks()
    assert [task.weight for task in tasks] == [2.0, 1.0, 1.0, 1.0]
    assert [task.reward for task in tasks] == ["eq16"] * 4
    assert [task.scenario.warmup for task in tasks] == [0, 0, 750, 0]


@pytest.mark.parametrize(("file", "name"), [("..sumocfg", "road"), ("...sumocfg", "road"), ("my.sumocfg", "my")])
def test_a_task_never_has_the_folder_of_the_run_or_its_parent(file: str, name: str, tmp_path: Path) -> None:
    scenario = straight(tmp_path, SPARSE).rename(tmp_path / file)
    config = replace(small_config(), scenario_options={}, tasks=(TaskConfig(str(scenario)),))
    assert list(config.task_configs()) == [name]


def test_single_road_is_one_task() -> None:
    config = small_config()
    assert config.task_configs() == {"": config}
    (task,) = config.make_tasks()
    assert (task.scenario, task.expert, task.name) == (config.make_scenario(), PISaturation(), "")


def test_mixture_survives_toml(tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text(to_toml(mixture()))
    assert load_config(tmp_path / "config.toml") == mixture()


@pytest.mark.parametrize(
    ("task", "words"),
    [
        ({"expert": "follower-stopper"}, "tasks: ring-2 gives the network other inputs than ring; allowed"),
        ({"expert": "magic"}, "driver: 'magic'"),
        ({"reward": "magic"}, "reward: 'magic'"),
    ],
)
def test_incompatible_tasks_are_refused(task: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError) as caught:
        check_config(mixture(tasks=[{}, task]))
    assert str(caught.value).startswith(words)
    assert "\n" not in str(caught.value)


@pytest.mark.long
@pytest.mark.parametrize(
    "agent", [pytest.param(name, marks=pytest.mark.slow) if name != "td3" else name for name in AGENT_NAMES]
)
def test_interrupted_mixture_ends_unchanged(agent: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config, places = mixture(agent=agent), [tmp_path / "one go", tmp_path / "run"]
    episodes = collected_episodes(monkeypatch)
    with WorkerPool(1) as workers:
        learn_with(workers, places[0], config)
        # 300 steps by weight: two episodes of the first road and one of the other, each with its own seed.
        drawn = [(episode.seed, episode.drawn_values["length"]) for episode in episodes]
        assert [seed for seed, _ in drawn] == [(0, i, n) for i in (1, 2) for n in range(3)]
        assert [length > 110 for _, length in drawn] == [True, True, False] * 2
        with pytest.raises(Stop):
            learn_with(workers, places[1], config, stop_after(1))
        learn_with(workers, places[1], config, resume=True)
    for road in ("ring", "short"):
        found = [(progress(place / road), (place / road / "controller.unjam").read_bytes()) for place in places]
        assert found[0] == found[1]
    found = [outcome_of(place) for place in places]
    assert found[0] == found[1]
    assert {"model", "model-1"} <= found[0][0]["algorithm"].keys()


def outcome_of(folder: Path) -> tuple[Any, ...]:
    (folder / "controller.unjam").touch()  # each road has its own
    return outcome(folder)


@pytest.mark.long
def test_progress_covers_the_run_and_each_task(tmp_path: Path) -> None:
    with WorkerPool(1) as workers:
        learn_with(workers, tmp_path / "run", mixture())
    for number, row in enumerate(progress(tmp_path / "run")):
        assert list(row["tasks"]) == ["ring", "short"]
        for name in ("return_mean", "return_expert", "return_validation"):
            each = [row["tasks"][road][name] for road in ("ring", "short")]
            assert row[name] == pytest.approx((2 * each[0] + each[1]) / 3)
            assert each == [progress(tmp_path / "run" / road)[number][name] for road in ("ring", "short")]
        assert all(found["k_star"] > 0 for found in row["tasks"].values())


@pytest.mark.parametrize("sees_road", [True, False])
def test_privileged_critic_has_task_and_drawn_values(tmp_path: Path, sees_road: bool) -> None:
    with WorkerPool(1) as workers:
        trainer = Trainer(tmp_path, mixture(policy__privileged_critic=sees_road), workers)
        episodes = trainer.collect(trainer.network(), 1)
        rows = environment_experience(trainer.spec, episodes, 1)
    privileged = rows.observations[:, trainer.spec.inputs :]
    assert isinstance(trainer.algorithm, Algorithm1)
    learner: Any = trainer.algorithm.learner
    assert learner.sb3.observation_space.shape == rows.observations.shape[1:]
    if not sees_road:
        assert privileged.shape[1] == 0
        return
    scaled = [
        task.scenario.scale_drawn_values(driven[-1].drawn_values)[0]
        for task, driven in zip(trainer.tasks, episodes, strict=True)
    ]
    np.testing.assert_allclose(privileged[0, 1:], [0.0, 1.0, 0.0])
    np.testing.assert_allclose(privileged[-1], [0.0, scaled[1], 0.0, 1.0], rtol=1e-6)
    np.testing.assert_allclose(privileged[19, :2], [scaled[0], 0.0], rtol=1e-6)
    assert (rows.last_observations[:2, -2:] == [1.0, 0.0]).all()


@pytest.mark.long
@pytest.mark.usefixtures("without_pictures")
def test_each_task_is_evaluated_in_its_own_folder(tmp_path: Path) -> None:
    result = train(mixture(), tmp_path / "run")
    assert (result.rows, result.gain) == ({}, None)
    assert list(result.tasks) == ["ring", "short"]
    for name, road in result.tasks.items():
        assert road.folder == tmp_path / "run" / name
        assert list(road.rows) == ["human", "pi", "trained"]
        assert road.gain is not None
        assert read_config(road.folder) == mixture().task_configs()[name]
        assert json.loads((road.folder / "evaluation.json").read_text())["scenario"] == "ring"
        with pytest.raises(InputError, match="is one task of a run"):
            train(read_config(road.folder), road.folder, resume=True)
    networks = [load_controller(road.controller) for road in result.tasks.values()]
    first, second = (driver.network.layers for driver in networks if isinstance(driver, ResidualDriver))
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one[0], other[0])
    page = (tmp_path / "run" / "report.html").read_text()
    assert "short: trained" in page
    assert "comparison of 2 results" in page


@pytest.mark.slow
@pytest.mark.parametrize(
    ("agent", "exploration"), [("trpo", "per_step"), ("trpo", "antithetic"), ("ppo", "antithetic")]
)
def test_batch_training_equals_training_in_sumo(agent: str, exploration: str, tmp_path: Path) -> None:
    mixture = {
        "tasks": [{"scenario_options": {"length": [120, 125]}}, {"scenario_options": {"vehicles": 7}, "name": "fewer"}]
    }
    runs = {}
    for world in ("sumo", "batch"):
        with WorkerPool(1) as workers:
            how = {"backend": world, "agent": agent, "policy.exploration": exploration}
            how |= {"model.model_ratio": 0.0} if exploration == "antithetic" else {}
            learn_with(workers, tmp_path / world, small_config(**mixture, **how))
        runs[world] = read_progress(tmp_path / world)
    for one, other in zip(runs["sumo"], runs["batch"], strict=True):
        assert one["environment_steps"] == other["environment_steps"]
        for name in ("return_mean", "return_validation", "return_expert", "mean_speed"):
            # Rounding differs, and learning in single precision makes more of it.
            learned = name == "return_validation" or one["iteration"] > 1
            assert one[name] == pytest.approx(other[name], rel=1e-9, abs=2e-3 if learned else 0.0)


def test_unsupported_tasks_run_in_sumo(tmp_path: Path) -> None:
    ring = {"length": [120, 130], "vehicles": 8}
    tasks = [
        {"scenario_options": ring},
        {"scenario": "figure-eight", "scenario_options": EIGHT},
        {"scenario_options": ring, "name": "other"},
    ]
    small = {
        "tasks": tasks,
        "scenario_options": {"horizon": 100},
        "trpo.steps_per_iteration": 300,
        "policy.hidden": [8],
    }
    folders = {world: tmp_path / world for world in ("sumo", "batch")}
    driven = {}
    for world, folder in folders.items():
        with WorkerPool(1) as workers:
            trainer = Trainer(folder, load_config(changes=small | {"backend": world}), workers)
            driven[world] = trainer.collect(trainer.network(), 1)
    for one, other in zip(driven["sumo"], driven["batch"], strict=True):
        assert [episode.seed for episode in one] == [episode.seed for episode in other]
        for actual, found in zip(one, other, strict=True):
            np.testing.assert_allclose(found.speeds, actual.speeds, atol=1e-9)


@pytest.mark.slow
def test_regret_increases_the_episodes_of_a_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The short road can be driven far better than it is; a run that was stopped knows, too."""

    def validated(trainer: Trainer, drivers: Any) -> list[float]:
        return [1.0, 1.0 if trainer.collector.iteration else 1e6]  # the expert's were better

    monkeypatch.setattr(Trainer, "validation_returns", validated)
    config = mixture(task_sampling="regret", tasks=[{}, SHORT], trpo__steps_per_iteration=600, steps=1800)
    places = [tmp_path / "one go", tmp_path / "run"]
    with WorkerPool(1) as workers:
        learn_with(workers, places[0], config)
        with pytest.raises(Stop):
            learn_with(workers, places[1], config, stop_after(2))
        learn_with(workers, places[1], config, resume=True)
    one, other = (progress(place) for place in places)
    assert one == other
    counts = [[row["tasks"][road]["episodes"] for road in ("ring", "short")] for row in one]
    assert counts == [[3, 3], [2, 5], [2, 5]]
    assert [row["episodes"] for row in one] == [6, 7, 7]


@pytest.mark.parametrize(
    "changes", [{"tasks": []}, {"evaluation__validation_interval": 0}], ids=["one road", "no validation"]
)
def test_regret_sampling_needs_several_validated_tasks(changes: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="task_sampling: regret is not allowed; allowed: weights"):
        mixture(task_sampling="regret", **changes)


def test_network_output_respects_the_narrowest_limits(tmp_path: Path) -> None:
    config = mixture(
        tasks=[
            {"scenario_options": {"action_limit": 2.0}},
            {"scenario_options": {"action_limit": 0.5}, "name": "gentle"},
        ]
    )
    with WorkerPool(1) as workers:
        trainer = Trainer(tmp_path, config, workers)
        strong, gentle = trainer.make_drivers(trainer.network())
    assert isinstance(strong, ResidualDriver)
    assert isinstance(gentle, ResidualDriver)
    assert (strong.action_limit, gentle.action_limit) == (2.0, 0.5)
    assert strong.network.authority == gentle.network.authority == 0.5
