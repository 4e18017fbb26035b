"""Measurable quantities of the theorems of the paper, and training times (Figure 8).

Theorem A1 is about untrained policies, A2 about convergence, and A3 about the model and its bound.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from matplotlib import rc_context
from matplotlib.figure import Figure

from unjam.drivers.car_following import Constant
from unjam.drivers.network import Network
from unjam.drivers.observation import observation_size
from unjam.drivers.residual import ResidualDriver
from unjam.measures.statistics import estimate_over_trainings, metric_estimate
from unjam.reports.figures import LINE_COLORS, PLOT_STYLE, new_figure, stacked_bar_figure
from unjam.reports.results import read_progress, seconds_by_part
from unjam.seeds import held_out_seeds
from unjam.training.evaluate import evaluate
from unjam.training.run_folder import create_run_folder
from unjam.training.train import Trainer
from unjam.worlds.worker_pool import WorkerPool
from unjam_paper.results_file import read_part, write_part
from unjam_paper.study import PlannedRun, Study, StudyFolder, Table, planned_runs
from unjam_paper.variants import VARIANTS

MODEL_VARIANTS = ("proposed", "no-initial-policy", "mb-trpo", "ours")
CONVERGENCE_VARIANTS = ("trpo", "ppo", "sac", "proposed", "ours")
RANDOM_POLICIES, HIDDEN_UNITS = 10, 64
"""number of untrained networks, and units of each of their two hidden layers"""
CONVERGENCE_TOLERANCE = 0.05
"""share of the best known return within which a training counts as converged (A2)"""
TIMED_ROAD = "ring"
TIMED_VARIANTS = ("trpo", "ppo", "sac", "mb-trpo", "without-model", "proposed", "proposed-ppo", "proposed-sac", "ours")
TIMED_STEPS, TIMED_START_STEPS, TIMING_ROUNDS = 24_000, 3_000, 3
"""environment steps of each timed training and before the first update of SAC; rounds over all variants"""


def random_network(inputs: int, authority: float, seed: int) -> Network:
    """Return an untrained policy network with the initialization of torch's linear layers."""
    generator = np.random.default_rng(np.random.SeedSequence([seed]))
    layers = []
    for rows, columns in pairwise((inputs, HIDDEN_UNITS, HIDDEN_UNITS, 1)):
        width = rows**-0.5
        weight = generator.uniform(-width, width, (rows, columns))
        layers.append((weight, generator.uniform(-width, width, columns)))
    return Network(tuple(layers), authority)


def untrained_rows(road: str, policies: int, workers: int) -> Table:
    """Return the returns of the expert, of the expert with random residuals, and of random networks alone (A1)."""
    config = PlannedRun(road, "proposed", 0).config
    scenario, expert, inputs = config.make_scenario(), config.make_expert(), config.policy.inputs
    limit = scenario.action_limit
    drivers, bases = {"expert alone": expert}, {"expert + random": expert, "random": Constant()}
    for number, (kind, base) in product(range(policies), bases.items()):
        network = random_network(observation_size(inputs, base), limit, number)
        drivers[f"{kind} {number}"] = ResidualDriver(base, network, limit, inputs)
    with WorkerPool(workers) as pool:
        evaluation = evaluate(scenario, drivers, held_out_seeds(4), pool)
    returns = {label: metric_estimate(rows, "return").mean for label, rows in evaluation.rows.items()}
    rows: Table = []
    for kind in bases:
        values = [returns[f"{kind} {number}"] for number in range(policies)]
        row = {"road": road, "policy": kind, "returns": values}
        rows.append(row | asdict(estimate_over_trainings(values)))
    return [*rows, {"road": road, "policy": "expert alone", "mean": returns["expert alone"]}]


def convergence_rows(study_folder: StudyFolder, road: str, seeds: int) -> Table:
    """Return the steps after which trainings come within a tolerance of the best known return, by variant (A2)."""
    runs = study_folder.trained_runs(road, CONVERGENCE_VARIANTS, seeds)
    best = max(row["return_mean"] for trainings in runs.values() for run in trainings for row in run.progress)
    threshold = best - CONVERGENCE_TOLERANCE * abs(best)
    rows = []
    for variant, trainings in runs.items():
        steps = [
            next((row["environment_steps"] for row in run.progress if row["return_mean"] >= threshold), None)
            for run in trainings
        ]
        last = [run.final_training_mean("return_mean") for run in trainings]
        row = {"variant": variant, "name": VARIANTS[variant].label, "best_known": best, "convergence_steps": steps}
        row |= {"converged_at_end": sum(value >= threshold for value in last), "trainings": len(trainings)}
        rows.append({**row, "last": asdict(estimate_over_trainings(last))})
    return rows


def model_error_history(study_folder: StudyFolder, road: str, seeds: int) -> dict[str, list[Table]]:
    """Return eps_m, k*, the bound and the gap between returns in model and environment, by variant and seed (A3)."""
    runs = study_folder.trained_runs(road, MODEL_VARIANTS, seeds)
    return {
        variant: [[_model_quantities(row) for row in run.progress] for run in trainings]
        for variant, trainings in runs.items()
    }


def _model_quantities(row: dict[str, Any]) -> dict[str, Any]:
    model = row["model"]
    returns = model.get("return_model"), model.get("return_environment")
    gap = None if None in returns else abs(returns[0] - returns[1])
    names = ("k_star", "eps_m", "eps_m_by_estimator", "bound")
    return {"steps": row["environment_steps"], "gap": gap, **{name: model.get(name) for name in names}}


@rc_context(PLOT_STYLE)
def model_error_figure(by_variant: dict[str, list[Table]]) -> Figure:
    """Draw model error and rollout length over environment steps, one line per training."""
    figure = new_figure(3.4)
    panels = figure.subplots(1, 2)
    titles = {"eps_m": "model error eps_m (unexplained variance)", "k_star": "rollout length k* [control steps]"}
    for (name, title), axes in zip(titles.items(), panels, strict=True):
        for (variant, runs), color in zip(by_variant.items(), LINE_COLORS[1:], strict=False):
            for seed, run in enumerate(runs):
                steps = [row["steps"] / 1000.0 for row in run]
                label = VARIANTS[variant].label if seed == 0 else None
                axes.plot(steps, [row[name] for row in run], color=color, lw=1.2, label=label)
        axes.set(title=title, xlabel="environment steps [thousands]")
    panels[1].set_yscale("log")  # from 2 to 500
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", ncols=5)
    return figure


def theory_study(title: str, road: str, untrained_roads: Sequence[str]) -> Study:
    """Return the study of trainings on a road, and of untrained policies on several roads."""
    variants = tuple(dict.fromkeys((*CONVERGENCE_VARIANTS, *MODEL_VARIANTS)))

    def write(study_folder: StudyFolder, seeds: int, folder: Path) -> None:
        model = model_error_history(study_folder, road, seeds)
        results = {"untrained": read_part(folder, "theory"), "convergence": convergence_rows(study_folder, road, seeds)}
        write_part(folder, "theory", {**results, "model": model})

    return Study(
        title,
        make_runs=lambda seeds: planned_runs([road], variants, seeds),
        make_parts=lambda study_folder, seeds: {
            f"theory/{untrained_road}": (untrained_rows, (untrained_road, RANDOM_POLICIES))
            for untrained_road in untrained_roads
        },
        write=write,
        minutes=8.0,
        figures={"model": lambda folder: model_error_figure(read_part(folder, "theory")["model"])},
    )


def measure_training_time(steps: int, rounds: int, workers: int) -> dict[str, Any]:
    """Return the wall time of each part of training per 1,000 environment steps [s], by variant and round.

    The variants are trained in turn, so that other load on the machine affects all of them. Figures show median rounds.
    """
    torch.set_num_threads(1)
    times: dict[str, list[dict[str, float]]] = {variant: [] for variant in TIMED_VARIANTS}
    with WorkerPool(1) as pool, tempfile.TemporaryDirectory() as parent:
        for number, variant in product(range(rounds), TIMED_VARIANTS):
            config = PlannedRun(TIMED_ROAD, variant, number).config
            # With an earlier first update, less of the time is that of the start of SAC.
            sac = replace(config.sac, learning_starts=TIMED_START_STEPS)
            evaluation = replace(config.evaluation, validation_interval=0)
            config = replace(config, steps=steps, sac=sac, evaluation=evaluation)
            folder = Path(parent) / f"{variant}-{number}"
            create_run_folder(folder, config)
            Trainer(folder, config, pool).train()
            rows = read_progress(folder)
            thousands, parts = rows[-1]["environment_steps"] / 1000.0, seconds_by_part(rows)
            parts.pop("validation", None)  # switched off, because it is the same for all variants
            times[variant].append({part: seconds / thousands for part, seconds in parts.items()})
    medians = {
        variant: sorted(seconds, key=lambda parts: sum(parts.values()))[len(seconds) // 2]
        for variant, seconds in times.items()
    }
    totals = {variant: sum(parts.values()) for variant, parts in medians.items()}
    relative = {variant: total / totals[TIMED_VARIANTS[0]] for variant, total in totals.items()}
    return {"rounds": times, "median": medians, "relative_to_trpo": relative}


def training_time_bars(seconds: dict[str, dict[str, float]]) -> Figure:
    """Draw the times of the parts of training as a stacked bar for each variant."""
    bars = {VARIANTS[variant].label: parts for variant, parts in seconds.items()}
    figure = stacked_bar_figure(bars, "wall time per 1,000 environment steps [s]", height=0.4 * len(bars) + 1.2)
    figure.axes[0].invert_yaxis()
    figure.axes[0].grid(axis="y", visible=False)
    return figure


def _time_table(folder: Path) -> pd.DataFrame:
    """Return the wall time per 1,000 environment steps by variant and part, and relative to TRPO."""
    results = read_part(folder, "time")
    rows = [
        {"": VARIANTS[variant].label, **{f"{part} [s]": f"{seconds:.2f}" for part, seconds in parts.items()}}
        for variant, parts in results["median"].items()
    ]
    relative = (f"{value:.2f}" for value in results["relative_to_trpo"].values())
    return pd.DataFrame(rows).assign(**{"relative to TRPO": list(relative)}).fillna("")


FIGURE_8 = Study(
    title="training time, measured side by side",
    make_parts=lambda study_folder, seeds: {"time": (measure_training_time, (TIMED_STEPS, TIMING_ROUNDS))},
    minutes=12.0,
    tables={"training time": _time_table},
    figures={"time": lambda folder: training_time_bars(read_part(folder, "time")["median"])},
)
