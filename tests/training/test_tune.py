"""Tuning finds better parameters within its step budget, and writes a controller that every command accepts."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from unjam.controller import load_controller
from unjam.drivers import PISaturation
from unjam.drivers.driver import label_with_parameters
from unjam.drivers.registry import driver_from_name
from unjam.errors import InputError
from unjam.measures.feasibility import overall_feasibility
from unjam.measures.gain import MAX_GAIN, MEAN_GAIN_OBJECTIVE, MIN_GAIN
from unjam.measures.metrics import measure
from unjam.scenarios import FigureEight, Merge, Ring
from unjam.scenarios.motorway import ON_RAMP
from unjam.seeds import TUNING_SEED, tuning_seeds
from unjam.training import tune as tuning
from unjam.training.search_space import SearchSpace, default_search_space, expert_search_space
from unjam.training.trial_log import TRIALS_FILE
from unjam.training.tune import TUNING_EPISODES, TUNING_EPISODES_PER_ROAD, TUNING_FILE, TUNING_FINALISTS, tune
from unjam.worlds.batch.run import run_batches
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

SMALL = Ring(horizon=60)
FINAL = (TUNING_FINALISTS + 1) * 2 * TUNING_EPISODES * 60
STEPS = FINAL + 4 * TUNING_EPISODES * 60
RAMP_SPACE: SearchSpace = {"speed_margin": FloatDistribution(-4.0, 4.0)}
SPACE: SearchSpace = {
    "catch_up_speed": FloatDistribution(0.5, 3.0),
    "safe_gap_rule": CategoricalDistribution(("constant", "closing")),
}


@pytest.mark.long
def test_tuned_expert_is_written_and_not_worse(tmp_path: Path) -> None:
    with WorkerPool(1) as workers:
        lines: list[str] = []
        found = tune({"ring": SMALL}, "pi", SPACE, STEPS, tmp_path, workers, on_message=lines.append)
    assert found.environment_steps <= STEPS
    assert len(found.trials) == len(lines) == 4
    assert found.best.score is not None
    assert found.default.score is not None
    assert found.best.score >= found.default.score
    driver = load_controller(Path(found.driver))
    assert isinstance(driver, PISaturation)
    assert found.best.values.items() <= vars(driver).items()
    written = json.loads((tmp_path / TUNING_FILE).read_text())
    assert written["best"]["driver"] == found.best.driver
    assert len(written["trials"]) == 4


@pytest.mark.slow
def test_trials_do_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    tried = []
    for count in (1, 2):
        with WorkerPool(count) as workers:
            (folder := tmp_path / str(count)).mkdir()
            tried.append(tune({"ring": SMALL}, "pi", SPACE, STEPS, folder, workers).trials)
    assert tried[0] == tried[1]


@pytest.mark.slow
def test_interrupted_tuning_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with WorkerPool(1) as workers:
        whole = tune({"ring": SMALL}, "pi", SPACE, STEPS, tmp_path / "whole", workers)
        folder, lines, driven = tmp_path / "stopped", list[str](), list[int]()

        def stop(line: str) -> None:
            lines.append(line)
            if len(lines) == 2:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            tune({"ring": SMALL}, "pi", SPACE, STEPS, folder, workers, on_message=stop)
        run = WorkerPool.run_and_map
        monkeypatch.setattr(
            WorkerPool, "run_and_map", lambda pool, tasks, keep: driven.append(len(tasks)) or run(pool, tasks, keep)
        )
        with (folder / TRIALS_FILE).open("a") as file:
            file.write('{"first_seed": 0, "driver": "cut sho')
        found = tune({"ring": SMALL}, "pi", SPACE, STEPS, folder, workers)
        assert (found.trials, found.best, found.default) == (whole.trials, whole.best, whole.default)
        assert driven == [
            TUNING_EPISODES,
            TUNING_EPISODES,
            (TUNING_FINALISTS - 1 + 1) * 2 * TUNING_EPISODES,
        ]  # the last two, finalists
        assert len(json.loads((folder / TUNING_FILE).read_text())["manifest"]["starts"]) == 2
        with pytest.raises(InputError, match="was made with other settings"):
            tune({"ring": SMALL}, "pi", SPACE, STEPS, folder, workers, seed=1)
    assert tune({"ring": SMALL}, "pi", SPACE, STEPS, folder, workers).best == whole.best  # no episode runs


@pytest.mark.slow
def test_screened_scores_equal_those_of_sumo(tmp_path: Path, sumo: SumoBackend) -> None:
    steps = FINAL + 10 * TUNING_EPISODES * 60
    with WorkerPool(1) as workers:
        found = tune({"ring": SMALL}, "pi", SPACE, steps, tmp_path, workers, screen=True)
    assert (found.environment_steps, found.batch_steps) == (FINAL, 10 * TUNING_EPISODES * 60)
    assert len(found.trials) == 10
    for setting in (found.trials[1], found.trials[9]):  # of two batches
        driver = driver_from_name(setting.driver, 0.1)
        rows = [
            measure(run_episode(SMALL.stratum(part, TUNING_EPISODES), driver, seed, backend=sumo))
            for part, seed in enumerate(tuning_seeds(TUNING_EPISODES))
        ]
        assert setting.score == pytest.approx(np.mean([row["return"] for row in rows]), rel=1e-9)
        assert setting.verdict == overall_feasibility(rows)
    written = json.loads((tmp_path / TUNING_FILE).read_text())
    assert written["batch_steps"] == found.batch_steps


def test_unsupported_roads_are_not_screened(tmp_path: Path) -> None:
    with WorkerPool(1) as workers, pytest.raises(InputError, match=r"screen: .*not a ring"):
        tune({"merge": Merge()}, "pi", SPACE, 10**9, tmp_path, workers, screen=True)


@pytest.mark.slow
def test_on_ramps_are_screened_in_batches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("unjam.training.tune.TUNING_EPISODES", 2)
    monkeypatch.setattr("unjam.training.tune.TUNING_FINALISTS", 1)
    road = replace(ON_RAMP, horizon=60, penetration_rate=0.5)
    with WorkerPool(1) as workers:
        found = tune({"on-ramp": road}, "jam-ahead", RAMP_SPACE, (8 + 4) * 60, tmp_path, workers, screen=None)
    assert (found.environment_steps, found.batch_steps) == (8 * 60, 2 * 2 * 60)
    for setting in found.trials:
        driver = driver_from_name(setting.driver, 1.0)
        tasks = [EpisodeTask(road.stratum(part, 2), driver, seed) for part, seed in enumerate(tuning_seeds(2))]
        rows = [measure(episode) for episode in run_batches(tasks, allow_statistical=True)]
        assert setting.score == pytest.approx(np.mean([row["return"] for row in rows]), rel=1e-12)


def test_trials_of_another_backend_are_not_screened(tmp_path: Path) -> None:
    with WorkerPool(1) as workers, pytest.raises(InputError, match="screen: trials run in batch"):
        tune({"ring": SMALL}, "pi", SPACE, 10**9, tmp_path, workers, backend="batch", screen=True)


@pytest.mark.slow
def test_trials_run_in_the_backend(tmp_path: Path) -> None:
    with WorkerPool(1) as workers:
        found, driven = (
            tune({"ring": SMALL}, "pi", SPACE, STEPS, tmp_path / backend, workers, backend=backend)
            for backend in ("batch", "sumo")
        )
    assert [one.score for one in found.trials] == pytest.approx([one.score for one in driven.trials])
    assert found.batch_steps == 0


def test_too_few_steps_are_refused(tmp_path: Path) -> None:
    with WorkerPool(1) as workers, pytest.raises(InputError, match=f"steps: {FINAL} is not allowed; allowed: >= "):
        tune({"ring": SMALL}, "pi", SPACE, FINAL, tmp_path, workers)


def test_default_space_has_numbers_words_and_booleans() -> None:
    space = default_search_space("pi", 0.1)
    assert space["catch_up_speed"] == FloatDistribution(0.25, 4.0, log=True)
    assert space["safe_gap_rule"] == CategoricalDistribution(("constant", "closing"))
    assert "time_step" not in space
    assert default_search_space("pacer", 0.1)["use_tuned"] == CategoricalDistribution((False, True))
    first = default_search_space("jam-ahead", 1.0)["first_section"]  # zero by default
    assert first == IntDistribution(0, 4)
    for name in ("human", "nonesuch"):
        with pytest.raises(InputError):
            default_search_space(name, 0.1)


def test_integer_limits_of_a_float_parameter_are_floats() -> None:
    asked = ["gathering_speed=1..3", "use_tuned=true,false"]
    space = expert_search_space(asked, default_search_space("pacer", 0.1))
    assert space == {
        "gathering_speed": FloatDistribution(1.0, 3.0),
        "use_tuned": CategoricalDistribution((True, False)),
    }
    defaults = default_search_space("jam-ahead", 1.0)
    assert expert_search_space(["first_section=1..3"], defaults) == {"first_section": IntDistribution(1, 3)}


def test_finalists_use_new_seeds() -> None:
    assert not set(tuning_seeds(TUNING_EPISODES)) & set(tuning_seeds(2 * TUNING_EPISODES, TUNING_EPISODES))
    assert {first for first, _ in tuning_seeds(3)} == {TUNING_SEED}


@pytest.mark.long
def test_several_roads_maximize_the_mean_gain(tmp_path: Path) -> None:
    roads = {"short": SMALL, "full": Ring(horizon=80, length=(200, 210))}
    each = TUNING_EPISODES_PER_ROAD * (60 + 80)
    steps = each * ((TUNING_FINALISTS + 1) * 2 + 3) + 2 * each
    with WorkerPool(1) as workers:
        found = tune(roads, "pi", SPACE, steps, tmp_path, workers)
    unused = (TUNING_FINALISTS - 2) * 2 * each  # two settings were tried, so no more than two are finalists
    assert (len(found.trials), found.environment_steps) == (2, steps - unused)
    assert all(one.score is not None and MIN_GAIN <= one.score <= MAX_GAIN for one in found.trials)
    assert found.best.verdict.startswith("worst on ")
    written = json.loads((tmp_path / TUNING_FILE).read_text())
    assert written["reward"] == MEAN_GAIN_OBJECTIVE
    assert set(written["scenario"]) == set(roads)


@pytest.mark.slow
def test_only_supported_roads_are_screened(tmp_path: Path) -> None:
    roads = {"ring": SMALL, "eight": FigureEight(horizon=80)}
    each = TUNING_EPISODES_PER_ROAD * (60 + 80)
    final = each * ((TUNING_FINALISTS + 1) * 2 + 3)
    with WorkerPool(1) as workers:
        found, driven = (
            tune(roads, "pi", SPACE, final + 2 * each, tmp_path / str(screen), workers, screen=screen)
            for screen in (True, False)
        )
    final -= (TUNING_FINALISTS - 2) * 2 * each  # two settings were tried, so no more than two are finalists
    assert (found.environment_steps, found.batch_steps) == (
        final + 2 * TUNING_EPISODES_PER_ROAD * 80,
        2 * TUNING_EPISODES_PER_ROAD * 60,
    )
    assert (driven.environment_steps, driven.batch_steps) == (final + 2 * each, 0)
    assert [one.score for one in found.trials] == pytest.approx([one.score for one in driven.trials])


def test_unknown_parameter_is_refused(tmp_path: Path) -> None:
    with WorkerPool(1) as workers, pytest.raises(InputError, match="vary: 'catch_up' is not allowed"):
        tune({"ring": SMALL}, "pi", {"catch_up": FloatDistribution(0.5, 3.0)}, STEPS, tmp_path, workers)


OWN_CODE = """
class Calm:
    def __init__(self, gain=0.2, time_gap=2.0):
        self.gain, self.time_gap = gain, time_gap
    def initial_memory(self, n):
        return {}
    def act(self, state, memory):
        return self.gain * (state.leader_gap - self.time_gap * state.speed), memory

def calm(outcome):
    return {"speed": outcome.speeds.mean(-1)}
"""


@pytest.mark.parametrize("part", ["reward", "expert"])
def test_own_file_is_tuned_and_not_continued_after_a_change(part: str, tmp_path: Path) -> None:
    file, folder = tmp_path / "mine.py", tmp_path / "tuned"
    file.write_text(OWN_CODE)
    expert, reward = (f"{file}:Calm", "") if part == "expert" else ("pi", f"{file}:calm")
    space = default_search_space(expert, 0.1) if part == "expert" else SPACE
    with WorkerPool(1) as workers:
        result = tune({"ring": SMALL}, expert, space, STEPS, folder, workers, reward)
        if part == "expert":
            assert set(result.best.values) == set(space) == {"gain", "time_gap"}
            assert result.driver == result.best.driver
            values = json.loads((folder / TUNING_FILE).read_text())["best"]["values"]
            assert driver_from_name(result.driver, 0.1).describe() == label_with_parameters("mine.py:Calm", values)
        file.write_text(f"{OWN_CODE}# changed")
        with pytest.raises(InputError, match=r"other settings \(.*mine\.py has changed\)"):
            tune({"ring": SMALL}, expert, space, STEPS, folder, workers, reward)


def test_ranges_of_an_own_class_are_around_its_defaults(tmp_path: Path) -> None:
    arguments = "gain=1, lanes: int = 2, time_gap=-2, limit=float('inf'), name='x'"
    (tmp_path / "mine.py").write_text(OWN_CODE.replace("gain=0.2, time_gap=2.0", arguments))
    assert default_search_space(f"{tmp_path / 'mine.py'}:Calm", 0.1) == {
        "gain": FloatDistribution(0.25, 4.0, log=True),
        "lanes": IntDistribution(1, 8, log=True),
        "time_gap": FloatDistribution(-8.0, -0.5),
    }


def test_a_class_that_cannot_be_made_is_refused_before_the_trials(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(OWN_CODE.replace("gain=0.2, time_gap=2.0", "gain, time_gap=2.0"))
    with pytest.raises(InputError, match=r"mine\.py:Calm: TypeError when made: "):
        default_search_space(f"{tmp_path / 'mine.py'}:Calm", 0.1)


def test_function_of_a_file_has_nothing_to_tune(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(OWN_CODE)
    with pytest.raises(InputError, match=r"expert: '.*mine\.py:calm' has nothing to tune"):
        default_search_space(f"{tmp_path / 'mine.py'}:calm", 0.1)


@pytest.mark.slow
def test_finalists_are_different_and_run_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    driven: list[str] = []
    actual = tuning._run_drivers

    def noted(roads: Any, drivers: Any, *rest: Any) -> Any:
        driven.extend(f"{rest[0]} {driver}" for driver in drivers)
        return actual(roads, drivers, *rest)

    monkeypatch.setattr(tuning, "_run_drivers", noted)
    two: SearchSpace = {"safe_gap_rule": CategoricalDistribution(("constant", "closing"))}
    with WorkerPool(1) as workers:
        found = tune({"ring": SMALL}, "pi", two, STEPS, tmp_path, workers)
    assert len(found.trials) == 4
    assert len(driven) == len(set(driven)) <= 2 + 3
    assert found.environment_steps == sum(
        60 * (TUNING_EPISODES if each[0] == "0" else 2 * TUNING_EPISODES) for each in driven
    )
