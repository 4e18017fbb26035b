import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.training.test_run import STEPS, learn_with, small_config
from unjam.errors import InputError
from unjam.files import to_json
from unjam.reports.model import wave_figure, wave_rows
from unjam.reports.results import MODEL_FILE, read_progress
from unjam.training import model_facts
from unjam.training.config import RunConfig
from unjam.training.model_facts import measure_model, replay_length, update_model_facts
from unjam.training.run_folder import read_config
from unjam.worlds.worker_pool import WorkerPool

CONFIG = small_config(model__model_ratio=1.0, model__epochs=4, model__members=3, steps=2 * STEPS)
NUMBERS = ["speed", "leader_speed", "follower_speed", "leader_gap", "follower_gap"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two iterations of three episodes, 100 control steps each; episodes 0, 2 and 5 are the holdout."""
    folder = tmp_path_factory.mktemp("runs") / "with-model"
    with WorkerPool(1) as workers:
        learn_with(workers, folder, CONFIG)
    return folder


@pytest.fixture(scope="module")
def facts(run: Path) -> dict[str, Any]:
    return measure_model(run, CONFIG)


def test_facts_use_only_holdout_steps(facts: dict[str, Any]) -> None:
    held_out = [0, 5]
    assert facts["validation_steps"] == 100 * len(held_out)
    for found in facts["by_state"].values():
        assert sum(found["control_steps"]) == facts["validation_steps"]


def test_errors_in_bins_add_up_to_the_total(facts: dict[str, Any]) -> None:
    for found in facts["by_state"].values():
        assert found["values"] == sorted(found["values"])
        for name, error in facts["one_step"].items():
            for kind in ("base", "model"):
                squares = np.square(found[kind][name])
                whole = np.sqrt(np.average(squares, weights=found["control_steps"]))
                assert whole == pytest.approx(error[kind], rel=5e-3, abs=1e-12), (name, kind)


def test_replays_cover_half_of_a_trip(facts: dict[str, Any]) -> None:
    replay = facts["replay"]
    assert replay["times"][-1] == pytest.approx(5.0)
    assert list(replay["quantities"]) == NUMBERS
    for found in replay["quantities"].values():
        assert {len(values) for values in found.values()} == {len(replay["times"])}
    assert max(replay["quantities"]["speed"]["base"]) < 1e-4
    assert 0 < replay["starts"] <= model_facts.MAX_REPLAYS


def test_examples_start_at_recorded_states(facts: dict[str, Any]) -> None:
    examples = facts["replay"]["examples"]
    assert len(examples) == model_facts.EXAMPLE_COUNT
    for example in examples:
        for found in example["quantities"].values():
            assert len(found["members"]) == 3
            assert all(abs(member[0] - found["recorded"][0]) < 0.2 for member in found["members"])
            assert {len(line) for line in (found["recorded"], found["base"], *found["members"])} == {50}


def test_bound_matches_progress(run: Path, facts: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    newest = read_progress(run)[-1]
    monkeypatch.setattr(model_facts, "ROLLOUT_LENGTHS", (newest["k_star"],))
    found = measure_model(run, CONFIG)["bound"]
    assert found["bound"][0] == pytest.approx(newest["model"]["bound"], rel=1e-3)
    assert facts["bound"]["largest_return"] > found["max_reward"]
    assert facts["k_star"] == newest["k_star"]


def test_runs_without_the_error_have_no_bound(run: Path, tmp_path: Path) -> None:
    lone = shutil.copytree(run, tmp_path / "lone")
    rows = read_progress(lone)
    del rows[-1]["model"]["eps_m_by_estimator"]["transitions"]
    (lone / "progress.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert measure_model(lone, CONFIG)["bound"] is None


def test_facts_are_small_and_reproducible(run: Path, facts: dict[str, Any]) -> None:
    assert measure_model(run, CONFIG) == facts
    assert len(json.dumps(facts)) < 60_000


@pytest.mark.parametrize("kept", [None, "{", "[]", '{"iteration": 1}'])
def test_missing_damaged_and_old_facts_are_measured_again(kept: str | None, run: Path, facts: dict[str, Any]) -> None:
    (run / MODEL_FILE).unlink(missing_ok=True)
    if kept is not None:
        (run / MODEL_FILE).write_text(kept)
    assert update_model_facts(run, CONFIG) == json.loads(json.dumps(facts))


def test_current_facts_are_read(run: Path) -> None:
    (run / MODEL_FILE).write_text('{"iteration": 2, "base": "stored"}')
    assert update_model_facts(run, CONFIG)["base"] == "stored"


def without_virtual() -> RunConfig:
    return small_config(model__model_ratio=0.0)


def test_run_without_a_model_is_refused(run: Path) -> None:
    with pytest.raises(InputError, match="has no model"):
        update_model_facts(run, without_virtual())


def test_run_without_a_checkpoint_is_refused(run: Path, tmp_path: Path) -> None:
    shutil.copy(run / "config.toml", tmp_path)
    with pytest.raises(InputError, match="has no checkpoint yet"):
        update_model_facts(tmp_path, read_config(tmp_path))


@given(st.lists(st.integers(1, 5000), min_size=1, max_size=50))
def test_half_of_the_trips_are_long_enough_for_replays(trips: list[int]) -> None:
    ahead = replay_length(trips)
    assert 1 <= ahead <= model_facts.MAX_REPLAY_STEPS
    assert np.mean([trip >= ahead for trip in trips]) >= 0.5


def test_road_model_has_waves(tmp_path: Path) -> None:
    changes = {"model__model_ratio": 1.0, "model__kind": "road", "model__base": "none"}
    config = small_config(**changes, model__members=2, steps=STEPS)
    with WorkerPool(1) as workers:
        learn_with(workers, tmp_path / "run", config)
    found = json.loads(to_json(measure_model(tmp_path / "run", config)))
    shapes = [np.shape(found["waves"]["recorded"][name]) for name in ("speeds", "positions")]
    assert shapes == [(10, 8)] * 2  # a moment a second, for ten seconds
    assert found["control_step"] == pytest.approx(1.0)
    assert len(found["waves"]["recorded"]["cav_columns"]) == 1
    titles = [axes.get_title(loc="left") or axes.get_title() for axes in wave_figure(found).axes[:3]]
    assert titles == ["recorded", "model", "no change"]
    assert update_model_facts(tmp_path / "run", config) == found
    rows = dict(wave_rows(found))
    speeds = np.array(found["waves"]["model"]["speeds"])
    speeds = speeds[len(speeds) // 2 :]
    assert rows["model"] == [f"{n:.2f}" for n in (speeds.mean(), speeds.std(1).mean(), speeds.min(1).mean())]


RAMP: dict[str, Any] = {
    "scenario": "on-ramp",
    "scenario_options": {"horizon": 30, "penetration_rate": 0.5, "peak": [0, 30]},
    "expert": "jam-ahead",
    "backend": "batch",
    "policy__inputs": ["local"],
    "policy__exploration": "antithetic",
    "policy__reward_after_exit": True,
    "model__rollout_starts": "first",
    "evaluation__baselines": [],
}


@pytest.mark.slow
@pytest.mark.parametrize("world", ["batch", "sumo"])
def test_on_ramp_model_has_waves_by_lane(world: str, tmp_path: Path) -> None:
    changes = {"model__model_ratio": 1.0, "model__kind": "road", "model__members": 2, **RAMP}
    config = small_config(**{**changes, "backend": world}, steps=STEPS)
    with WorkerPool(1) as workers:
        learn_with(workers, tmp_path / "run", config)
    found = json.loads(to_json(measure_model(tmp_path / "run", config)))
    assert found["control_step"] == pytest.approx(10.0)
    roads = {label: np.array(road["speeds"], float) for label, road in found["waves"].items()}
    assert list(roads) == ["recorded", "model", "base"]
    came = {label: (~np.isnan(speeds)).sum() for label, speeds in roads.items()}
    assert came["model"] == came["base"] > 0  # the same vehicles at the same times
    alike = 0.0 if world == "batch" else 0.1  # SUMO lets some enter a second sooner or later than the batch
    assert came["recorded"] == pytest.approx(came["base"], rel=alike)
    assert not np.array_equal(roads["recorded"], roads["base"], equal_nan=True)  # their errors are drawn again
    drawn = wave_figure(found)
    titles = [axes.get_title(loc="left") or axes.get_title() for axes in drawn.axes]
    assert [title for title in titles if title] == ["recorded", "model", "IDM alone"]
    assert {axes.get_ylabel() for axes in drawn.axes} >= {f"{name}\n[m]" for name in found["lane_names"]}
    assert all("nan" not in cell for _, row in wave_rows(found) for cell in row)


@pytest.mark.slow
@pytest.mark.parametrize("road", [{}, RAMP])
def test_run_with_a_road_model_resumes_unchanged(road: dict[str, Any], tmp_path: Path) -> None:
    changes = {"model__model_ratio": 1.0, "model__kind": "road", "model__members": 2, **road}
    ends = []
    for stops in ([2 * STEPS], [STEPS, 2 * STEPS]):
        folder = tmp_path / str(len(stops))
        for steps in stops:
            with WorkerPool(1) as workers:
                learn_with(workers, folder, small_config(**changes, steps=steps), resume=steps != stops[0])
        ends.append([row["model"]["return_model"] for row in read_progress(folder)])
    assert ends[0] == ends[1]
    assert len(ends[0]) == 2
