"""Theory, robustness and Figure 5, on a ring so small that a training takes a second."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from unjam.reports.results import read_rows
from unjam_paper import comparison, robustness, theory
from unjam_paper.comparison import comparison_rows, training_curves
from unjam_paper.study import PlannedRun, StudyFolder
from unjam_paper.variants import VARIANTS

Reproduction = tuple[Path, list[str]]
"""folder of studies, and messages"""
SMALL_VARIANTS = ("plain", "with-model")


@pytest.mark.slow
def test_training_time_is_measured_for_all_variants_in_turn(
    monkeypatch: pytest.MonkeyPatch, small_study: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(theory, "TIMED_ROAD", "small")
    monkeypatch.setattr(theory, "TIMED_VARIANTS", SMALL_VARIANTS)
    results = theory.measure_training_time(320, 2, workers=1)
    rounds = results["rounds"]
    assert [len(rounds[variant]) for variant in SMALL_VARIANTS] == [2, 2]
    assert results["relative_to_trpo"]["plain"] == 1.0
    plain, model = (rounds[variant][0] for variant in SMALL_VARIANTS)
    assert set(model) - set(plain) == {"fit", "roll_out"}
    assert min(plain["collect"], plain["update"], model["fit"], model["roll_out"]) > 0
    axes = theory.training_time_bars({variant: rounds[variant][0] for variant in SMALL_VARIANTS}).axes[0]
    longest = max(sum(plain.values()), sum(model.values()))
    assert longest < axes.get_xlim()[1] < 1.2 * longest


@pytest.mark.slow
def test_controllers_are_evaluated_in_other_traffic(monkeypatch: pytest.MonkeyPatch, reproduced: Reproduction) -> None:
    folder, _ = reproduced
    road = {
        "scenario": "ring",
        "scenario_options.length": [80, 80],
        "scenario_options.vehicles": 6,
        "scenario_options.horizon": 60,
    }
    monkeypatch.setattr(robustness, "TRANSFER_ROADS", {"six": road})
    monkeypatch.setattr(robustness, "TRANSFER_VARIANTS", ("plain",))
    monkeypatch.setattr(robustness, "TRANSFER_SOURCE", "small")
    monkeypatch.setattr(robustness, "TRANSFER_EPISODES", 2)
    [(measure, arguments)] = robustness.FIGURE_10.make_parts(StudyFolder(folder), 2).values()
    rows = measure(*arguments, 2)
    assert [row["driver"] for row in rows] == ["human", "pi", "plain 0", "plain 1"]
    assert all(row["road"] == "six" and np.isfinite(row["mean_speed"]["mean"]) for row in rows)


@pytest.mark.slow
def test_controllers_and_experts_are_evaluated_under_other_conditions(reproduced: Reproduction) -> None:
    folder, _ = reproduced
    run = folder / "runs" / "small" / "plain" / "0"
    conditions = {"as in training": {}, "noise": {"noise": 0.4}, "delay": {"impairments": {"delay": 0.3}}}
    rows = [
        row
        for condition, changes in conditions.items()
        for row in robustness.condition_rows("small", condition, changes, (str(run), "pi"), episodes=2, workers=2)
    ]
    assert [(row["condition"], row["driver"]) for row in rows] == [
        (condition, driver) for condition in conditions for driver in ("human", "tuned expert", "trained")
    ]
    speeds = {(row["condition"], row["driver"]): row["mean_speed"]["mean"] for row in rows}
    driven = read_rows(run)["trained"]
    assert speeds["as in training", "trained"] == np.mean([row["mean_speed"] for row in driven])
    assert speeds["noise", "human"] != speeds["as in training", "human"] == speeds["delay", "human"]
    assert speeds["delay", "tuned expert"] != speeds["as in training", "tuned expert"]
    ours, theirs = (speeds["noise", driver] for driver in ("trained", "tuned expert"))
    gain = {(row["condition"], row["driver"]): row["speed_gain_over_expert"]["mean"] for row in rows}
    assert gain["noise", "trained"] == pytest.approx(ours - theirs)


@pytest.mark.long
def test_all_episodes_of_figure_5_have_the_same_traffic(
    monkeypatch: pytest.MonkeyPatch, reproduced: Reproduction
) -> None:
    folder, _ = reproduced
    monkeypatch.setattr(comparison, "FIGURE_5_VARIANTS", SMALL_VARIANTS)
    episodes = comparison.figure_5_episodes(StudyFolder(folder), "small")
    human, expert, *learned = (episode.driver for episode in episodes)
    assert human == "human"
    assert expert in ("PI", "ACC", "tuned PI")
    assert learned == ["plain", "with a model"]
    assert len({episode.loop_length for episode in episodes}) == 1
    assert len({episode.speeds.shape for episode in episodes}) == 1


def test_a_variant_with_another_reward_is_compared_by_that_return(
    monkeypatch: pytest.MonkeyPatch, reproduced: Reproduction
) -> None:
    folder, _ = reproduced
    plain_row = comparison_rows(StudyFolder(folder), "small", SMALL_VARIANTS, 2)[-1]
    assert (plain_row["gain_reference"]["metric"], math.isnan(plain_row["return"]["mean"])) == ("return", False)
    variant = VARIANTS["with-model"]
    other = replace(variant, changes={**variant.changes, "reward": "eq16"})
    monkeypatch.setitem(VARIANTS, "with-model", other)
    row = comparison_rows(StudyFolder(folder), "small", SMALL_VARIANTS, 2)[-1]
    assert (row["gain_reference"]["metric"], math.isnan(row["return"]["mean"])) == ("return_eq16", True)
    expert = np.mean(
        [row["return_eq16"] for row in StudyFolder(folder).reference_rows("small")[row["gain_reference"]["expert"]]]
    )
    mean = np.mean([row["return_eq16"] for seed in range(2) for row in read_run_rows(folder, seed)])
    assert row["gain_over_best_expert"]["mean"] == pytest.approx(mean - expert)
    curves = training_curves(StudyFolder(folder), "small", SMALL_VARIANTS, 2)
    assert "return_mean" in curves["plain"]
    assert "return_mean" not in curves["with-model"]
    assert "cav_mean_speed" in curves["with-model"]


def read_run_rows(folder: Path, seed: int) -> list[dict[str, Any]]:
    return read_rows(folder / "runs" / "small" / "with-model" / str(seed))["trained"]


@pytest.mark.long
def test_untrained_policies_are_compared_on_the_same_seeds(small_study: pytest.MonkeyPatch) -> None:
    rows = theory.untrained_rows("small", policies=2, workers=2)
    assert [row["policy"] for row in rows] == ["expert + random", "random", "expert alone"]
    assert [len(row["returns"]) for row in rows[:2]] == [2, 2]
    assert rows[0]["mean"] == pytest.approx(np.mean(rows[0]["returns"]))


def test_a_random_network_is_initialized_as_in_torch() -> None:
    network = theory.random_network(5, 1.0, seed=3)
    for weight, bias in network.layers:
        width = len(weight) ** -0.5
        assert np.abs(weight).max() <= width
        assert np.abs(bias).max() <= width
        assert weight.std() == pytest.approx(torch.nn.Linear(*weight.shape).weight.std().item(), rel=0.25)
    observations = np.random.default_rng(0).normal(size=(50, 5))
    assert np.abs(network(observations)).max() <= 1.0
    assert theory.random_network(5, 1.0, seed=4)(observations) != pytest.approx(network(observations))


def test_convergence_is_counted_against_the_best_known_return(
    monkeypatch: pytest.MonkeyPatch, reproduced: Reproduction
) -> None:
    folder, _ = reproduced
    monkeypatch.setattr(theory, "CONVERGENCE_VARIANTS", SMALL_VARIANTS)
    rows = theory.convergence_rows(StudyFolder(folder), "small", 2)
    progress = [
        json.loads(line)["return_mean"]
        for variant in SMALL_VARIANTS
        for seed in range(2)
        for line in (folder / f"runs/small/{variant}/{seed}/progress.jsonl").read_text().splitlines()
    ]
    assert rows[0]["best_known"] == max(progress)
    assert sum(steps is not None for row in rows for steps in row["convergence_steps"]) >= 1
    assert all(0 <= row["converged_at_end"] <= row["trainings"] == 2 for row in rows)


def test_model_errors_are_recorded_over_training(monkeypatch: pytest.MonkeyPatch, reproduced: Reproduction) -> None:
    folder, _ = reproduced
    monkeypatch.setattr(theory, "MODEL_VARIANTS", ("with-model",))
    history = theory.model_error_history(StudyFolder(folder), "small", 2)
    run = PlannedRun("small", "with-model", 1)
    rows = (folder / "runs" / run.name / "progress.jsonl").read_text().splitlines()
    last = json.loads(rows[-1])
    assert history["with-model"][1][-1]["eps_m"] == last["eps_m"]
    assert history["with-model"][1][-1]["bound"] == last["model"]["bound"]
    lines = theory.model_error_figure(history).axes[0].lines
    assert [len(line.get_xdata()) for line in lines] == [len(rows), len(rows)]  # pyright: ignore[reportArgumentType]
