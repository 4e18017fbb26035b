import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from unjam.drivers import IDM, Driver, PISaturation
from unjam.drivers.user_driver import FileDriver
from unjam.errors import DiskError, EpisodeError, InputError, MissingPartError, UnjamError, raise_failure
from unjam.measures.metrics import METRICS
from unjam.reports.results import read_results
from unjam.scenarios import Ring
from unjam.seeds import TUNING_SEED, VALIDATION_SEED, held_out_seeds, tuning_seeds
from unjam.training.evaluate import Evaluation, evaluate, save_evaluation
from unjam.worlds.episode import run_episode
from unjam.worlds.worker_pool import WorkerPool

RING = Ring(length=(120, 130), vehicles=8, horizon=60)
SEEDS = [(7, 0), (7, 1), (7, 2)]


@pytest.fixture(scope="module")
def pool() -> Iterator[WorkerPool]:
    with WorkerPool(1) as workers:
        yield workers


@pytest.fixture(scope="module")
def found(pool: WorkerPool) -> Evaluation:
    return evaluate(RING, {"mine": PISaturation(), "other": IDM()}, SEEDS, pool)


def test_rows_follow_the_order_of_seeds(found: Evaluation) -> None:
    assert list(found.rows) == ["mine", "other"]
    for rows in found.rows.values():
        assert [tuple(row["seed"]) for row in rows] == SEEDS
        assert {row["status"] for row in rows} == {"completed"}
        assert all(METRICS.keys() <= row.keys() for row in rows)


def test_row_measures_the_episode_of_its_driver_and_seed(found: Evaluation) -> None:
    drivers: dict[str, Driver] = {"mine": PISaturation(), "other": IDM()}
    for label, driver in drivers.items():
        for seed, row in zip(SEEDS, found.rows[label], strict=True):
            episode = run_episode(RING, driver, seed)
            assert row["return"] == episode.trajectories[0].reward.sum()
            assert row["mean_speed"] == np.mean(episode.speeds[1:])


def test_drivers_have_the_same_traffic(found: Evaluation) -> None:
    assert found.plot_episodes["mine"].drawn_values == found.plot_episodes["other"].drawn_values
    assert found.plot_episodes["mine"].seed == found.plot_episodes["other"].seed == SEEDS[0]
    assert not np.array_equal(found.plot_episodes["mine"].speeds, found.plot_episodes["other"].speeds)


def test_fuel_is_measured(found: Evaluation) -> None:
    fuel = [name for name in METRICS if "fuel" in name]
    assert fuel
    assert all(row[name] > 0 for rows in found.rows.values() for row in rows for name in fuel)


def test_means_are_over_the_seeds(found: Evaluation) -> None:
    expected = np.mean([row["return"] for row in found.rows["mine"]])
    assert found.means()["mine"]["return"] == pytest.approx(expected)


def test_another_reward_changes_only_the_return(found: Evaluation, pool: WorkerPool) -> None:
    other = evaluate(RING, {"mine": PISaturation()}, SEEDS, pool, reward="eq16")
    for row, before in zip(other.rows["mine"], found.rows["mine"], strict=True):
        assert row["return"] == pytest.approx(before["return_eq16"])
        assert row["return"] != before["return"]
        assert row["mean_speed"] == before["mean_speed"]


def test_progress_names_driver_and_episode_of_evaluations(pool: WorkerPool) -> None:
    messages: list[tuple[tuple[str, int], int]] = []
    evaluate(
        RING,
        {"a": IDM(), "b": IDM()},
        SEEDS[:2],
        pool,
        progress=lambda episode, steps: messages.append((episode, steps)),
    )
    assert {episode for episode, steps in messages if steps == 60} == {("a", 0), ("a", 1), ("b", 0), ("b", 1)}


def test_failed_driver_does_not_stop_the_others(pool: WorkerPool, my_drivers: Path) -> None:
    found = evaluate(RING, {"bad": FileDriver(my_drivers, "raises"), "good": IDM()}, SEEDS[:2], pool)
    assert [row["status"] for row in found.rows["bad"]] == ["failed", "failed"]
    assert [tuple(row["seed"]) for row in found.rows["bad"]] == SEEDS[:2]
    assert all("lost the map" in row["reason"] for row in found.rows["bad"])
    assert all(math.isnan(row["return"]) for row in found.rows["bad"])
    assert [row["status"] for row in found.rows["good"]] == ["completed", "completed"]
    assert list(found.plot_episodes) == ["good"]
    assert math.isnan(found.means()["bad"]["return"])


@pytest.mark.parametrize("kind", [InputError, MissingPartError, DiskError, EpisodeError, UnjamError])
def test_failure_is_raised_as_the_original_kind(kind: type[UnjamError]) -> None:
    rows = [
        {"status": "completed", "seed": (1,)},
        {"status": "failed", "seed": (2,), "reason": "no way", "error": kind.__name__},
        {"status": "failed", "seed": (3,), "reason": "never", "error": "UnjamError"},
    ]
    with pytest.raises(kind, match="no way") as caught:
        raise_failure(rows)
    assert type(caught.value) is kind
    assert ("seed (2,)" in str(caught.value)) is (kind is not InputError)


def test_successful_rows_raise_nothing(found: Evaluation) -> None:
    raise_failure([row for rows in found.rows.values() for row in rows])


def test_unknown_error_name_gives_an_unjam_error() -> None:
    with pytest.raises(UnjamError, match="no way"):
        raise_failure([{"status": "failed", "seed": (2,), "reason": "no way", "error": "Surprise"}])


def numbers_of(seed: tuple[int, ...]) -> tuple[int, ...]:
    """What a seed means to NumPy, which takes (1, 2) and (1, 2, 0) for the same."""
    return tuple(np.random.SeedSequence(list(seed)).generate_state(4).tolist())


def test_seed_families_are_disjoint() -> None:
    judging = {numbers_of(seed) for seed in held_out_seeds(500)}
    choosing = {numbers_of((VALIDATION_SEED, index)) for index in range(500)}
    tuning = {numbers_of(seed) for seed in tuning_seeds(500)}
    training = {
        numbers_of((run, iteration, index))
        for run in (0, 1, 2, 3, 42, 1_000_002, 1_000_004)
        for iteration in range(1, 60)
        for index in range(4)
    }
    assert len(judging) == len(choosing) == len(tuning) == 500
    assert len(judging | choosing | tuning) == 1500
    assert training.isdisjoint(judging | choosing | tuning)
    assert TUNING_SEED < VALIDATION_SEED + 500  # a seed that only counted up from one would meet the other


def test_more_test_seeds_contain_fewer() -> None:
    assert held_out_seeds(20)[:5] == held_out_seeds(5)


def strict(text: str) -> Any:
    """JSON as its standard has it."""

    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    return json.loads(text, parse_constant=refuse)


def test_saved_evaluation_is_read_back(found: Evaluation, tmp_path: Path) -> None:
    save_evaluation(tmp_path / "new", found, {"scenario": "ring", "reward": "released", "limit": float("inf")})
    assert {path.name for path in (tmp_path / "new").iterdir()} == {
        "evaluation.json",
        "episodes.parquet",
        "plot_episodes.safetensors",
    }
    document = strict((tmp_path / "new" / "evaluation.json").read_text())
    assert document["scenario"] == "ring"
    assert document["limit"] is None
    assert len(document["rows"]) == 6
    results = read_results(tmp_path / "new")
    for label, rows in found.rows.items():
        for row, expected in zip(results.rows[label], rows, strict=True):
            for name in METRICS:
                same = row[name] == expected[name] or (math.isnan(row[name]) and not math.isfinite(expected[name]))
                assert same, name
    for label, episode in found.plot_episodes.items():
        np.testing.assert_array_equal(results.plot_episodes[label].positions, episode.positions.astype(np.float32))
        np.testing.assert_array_equal(results.plot_episodes[label].outline, episode.outline.astype(np.float32))
        assert results.plot_episodes[label].drawn_values == episode.drawn_values
        assert tuple(results.plot_episodes[label].cav_ids) == episode.cav_ids


def test_the_table_has_the_rows(found: Evaluation, tmp_path: Path) -> None:
    save_evaluation(tmp_path, found, {})
    table = pd.read_parquet(tmp_path / "episodes.parquet")
    assert table["driver"].tolist() == ["mine"] * 3 + ["other"] * 3
    assert table["seed"].tolist() == [str(row["seed"]) for rows in found.rows.values() for row in rows]
    np.testing.assert_array_equal(
        table["mean_speed"], [row["mean_speed"] for rows in found.rows.values() for row in rows]
    )


def test_evaluation_with_only_failures_can_be_saved(pool: WorkerPool, my_drivers: Path, tmp_path: Path) -> None:
    found = evaluate(RING, {"bad": FileDriver(my_drivers, "broken")}, SEEDS[:1], pool)
    save_evaluation(tmp_path, found, {})
    (row,) = strict((tmp_path / "evaluation.json").read_text())["rows"]
    assert (row["status"], row["return"]) == ("failed", None)
    assert read_results(tmp_path).plot_episodes == {}
    assert pd.read_parquet(tmp_path / "episodes.parquet")["status"].tolist() == ["failed"]


def test_new_evaluation_replaces_the_old_one(found: Evaluation, tmp_path: Path, pool: WorkerPool) -> None:
    save_evaluation(tmp_path, found, {})
    save_evaluation(tmp_path, evaluate(RING, {"one": IDM()}, SEEDS[:1], pool), {})
    assert list(read_results(tmp_path).rows) == ["one"]
    assert list(read_results(tmp_path).plot_episodes) == ["one"]
