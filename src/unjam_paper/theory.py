"""What trainings tell beside what they earn: the paper's theorems, and what training costs (Figure 8).

Theorem A1 is about untrained policies, A2 about convergence, A3 about the model and the bound: each has what
can be measured of it. Costs are measured of all variants side by side, in one run.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import replace
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
from unjam.files import atomic_write, to_json
from unjam.measures.statistics import estimate_over_trainings, metric_estimate
from unjam.reports.figures import LINE_COLORS, PLOT_STYLE, new_figure, png_bytes, stacked_bars
from unjam.reports.results import read_progress, seconds_by_part
from unjam.training.evaluate import evaluate
from unjam.training.run_folder import create_run_folder
from unjam.training.seeds import make_test_seeds
from unjam.training.train import Trainer
from unjam.worlds.worker_pool import WorkerPool
from unjam_paper.comparison import estimate_entries
from unjam_paper.results_file import read_part
from unjam_paper.study import PAPER_ROADS, VARIANTS, PlannedRun, Study, StudyFolder, Table, planned_runs

THEORY_ROAD = "ring"
MODEL_VARIANTS = ("proposed", "no-initial-policy", "mb-trpo", "ours")
CONVERGENCE_VARIANTS = ("trpo", "ppo", "sac", "proposed", "ours")
RANDOM_POLICIES, HIDDEN_UNITS = 10, 64
"""networks that nobody has trained, and units of their two hidden layers"""
CONVERGENCE_TOLERANCE = 0.05
"""share of the best known return within which a training counts as converged (A2)"""
TIMED_VARIANTS = (
    *("trpo", "ppo", "sac", "mb-trpo", "without-model"),
    *("proposed", "proposed-ppo", "proposed-sac", "ours"),
)
TIMED_STEPS, TIMING_ROUNDS = 24_000, 3
"""actual steps of each measured training, and how often all take their turn"""
TIMED_START_STEPS = 3_000
EXCLUDED_PART = "validation"
"""the part that is switched off, for it is the same for all"""


def random_network(inputs: int, authority: float, seed: int) -> Network:
    """Return a policy network whose weights nobody has trained, drawn like those of torch's linear layers."""
    generator = np.random.default_rng(np.random.SeedSequence([seed]))
    layers = []
    for rows, columns in pairwise((inputs, HIDDEN_UNITS, HIDDEN_UNITS, 1)):
        width = rows**-0.5
        weight = generator.uniform(-width, width, (rows, columns))
        layers.append((weight, generator.uniform(-width, width, columns)))
    return Network(tuple(layers), authority)


def untrained_rows(roads: Sequence[str] = PAPER_ROADS, policies: int = RANDOM_POLICIES, worker_count: int = 2) -> Table:
    """A1: return of the expert plus a random residual beside a random network alone, on the same seeds."""
    rows = []
    with WorkerPool(worker_count) as workers:
        for road in roads:
            config = PlannedRun(road, "proposed", 0).config
            scenario, expert, parts = config.make_scenario(), config.make_expert(), config.policy.inputs
            limit = scenario.action_limit
            drivers, bases = {"expert alone": expert}, {"expert + random": expert, "random": Constant()}
            for number, (kind, base) in product(range(policies), bases.items()):
                network = random_network(observation_size(parts, base), limit, number)
                drivers[f"{kind} {number}"] = ResidualDriver(base, network, limit, parts)
            found = evaluate(scenario, drivers, make_test_seeds(4), workers)
            returns = {label: metric_estimate(driven, "return").mean for label, driven in found.rows.items()}
            for kind in bases:
                values = [returns[f"{kind} {number}"] for number in range(policies)]
                rows.append(
                    {
                        "road": road,
                        "policy": kind,
                        "returns": values,
                        **estimate_entries(estimate_over_trainings(values)),
                    }
                )
            rows.append({"road": road, "policy": "expert alone", "mean": returns["expert alone"]})
    return rows


def convergence_rows(study_folder: StudyFolder, seeds: int) -> Table:
    """A2: which trainings come to within a share of the best return that is known, and when."""
    runs = {variant: study_folder.trained_runs(THEORY_ROAD, variant, seeds) for variant in CONVERGENCE_VARIANTS}
    best = max(row["return_mean"] for found in runs.values() for run in found for row in run.progress)
    enough = best - CONVERGENCE_TOLERANCE * abs(best)
    rows = []
    for variant, found in runs.items():
        near = [[row for row in run.progress if row["return_mean"] >= enough] for run in found]
        last = [run.final_training_mean("return_mean") for run in found]
        rows.append(
            {
                "variant": variant,
                "name": VARIANTS[variant].label,
                "best_known": best,
                "arrivals": [there[0]["environment_steps"] if there else None for there in near],
                "stayed": sum(value >= enough for value in last),
                "trainings": len(found),
                "last": estimate_entries(estimate_over_trainings(last)),
            }
        )
    return rows


def model_error_history(study_folder: StudyFolder, seeds: int) -> dict[str, list[Table]]:
    """A3: eps_m, k*, the bound, and how far virtual returns are from actual ones; by variant and seed."""
    return {
        variant: [
            [_model_facts(row) for row in run.progress]
            for run in study_folder.trained_runs(THEORY_ROAD, variant, seeds)
        ]
        for variant in MODEL_VARIANTS
    }


def _model_facts(row: dict[str, Any]) -> dict[str, Any]:
    virtual = row["virtual"]
    pair = virtual.get("return_virtual"), virtual.get("return_actual")
    gap = None if None in pair else abs(pair[0] - pair[1])
    names = ("k_star", "eps_m", "eps_m_by_estimator", "bound")
    return {"steps": row["environment_steps"], "gap": gap, **{name: virtual.get(name) for name in names}}


@rc_context(PLOT_STYLE)
def model_error_figure(by_variant: dict[str, list[Table]]) -> Figure:
    """Draw the model error and the rollout length over training, a line per training."""
    figure = new_figure(3.4)
    panels = figure.subplots(1, 2)
    labels = {"eps_m": "model error eps_m (unexplained)", "k_star": "rollout length k* [decisions]"}
    for (name, label), axes in zip(labels.items(), panels, strict=True):
        for (variant, runs), colour in zip(by_variant.items(), LINE_COLORS[1:], strict=False):
            for number, run in enumerate(runs):
                steps = [row["steps"] / 1000.0 for row in run]
                words = VARIANTS[variant].label if number == 0 else None
                axes.plot(steps, [row[name] for row in run], color=colour, lw=1.2, label=words)
        axes.set_title(label)
        axes.set_xlabel("actual simulator steps [thousands]")
    panels[1].set_yscale("log")  # from 2 to 500
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", ncols=5)
    return figure


def _write_theory(study_folder: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    found = {
        "untrained": untrained_rows(worker_count=workers),
        "convergence": convergence_rows(study_folder, seeds),
        "model": model_error_history(study_folder, seeds),
    }
    atomic_write(folder / "theory.json", to_json(found, indent=1))
    atomic_write(folder / "model.png", png_bytes(model_error_figure(found["model"]), reduce_colors=False))


def training_seconds(steps: int = TIMED_STEPS, rounds: int = TIMING_ROUNDS) -> dict[str, list[dict[str, float]]]:
    """Return the wall time of the parts of training per 1,000 actual steps [s], by variant and round.

    The variants take turns, so that what else the machine does meets all of them alike.
    """
    torch.set_num_threads(1)
    found: dict[str, list[dict[str, float]]] = {variant: [] for variant in TIMED_VARIANTS}
    with WorkerPool(1) as workers, tempfile.TemporaryDirectory() as place:
        for turn in range(rounds):
            for variant in TIMED_VARIANTS:
                config = PlannedRun(THEORY_ROAD, variant, turn).config
                config = replace(config, steps=steps, evaluation=replace(config.evaluation, every=0))
                # Or sac would measure hardly more than its start.
                config = replace(config, sac=replace(config.sac, learning_starts=TIMED_START_STEPS))
                folder = Path(place) / f"{variant}-{turn}"
                create_run_folder(folder, config)
                Trainer(folder, config, workers).train()
                rows = read_progress(folder)
                thousands, parts = rows[-1]["environment_steps"] / 1000.0, seconds_by_part(rows)
                parts.pop(EXCLUDED_PART, None)
                found[variant].append({part: seconds / thousands for part, seconds in parts.items()})
    return found


def _write_time(study_folder: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    found = training_seconds()
    # A turn that something else on the machine slowed down does not count.
    medians = {
        variant: sorted(turns, key=lambda parts: sum(parts.values()))[len(turns) // 2]
        for variant, turns in found.items()
    }
    of_trpo = sum(medians["trpo"].values())
    over_trpo = {variant: sum(parts.values()) / of_trpo for variant, parts in medians.items()}
    numbers = {"turns": found, "median": medians, "over_trpo": over_trpo}
    atomic_write(folder / "time.json", to_json(numbers, indent=1))
    atomic_write(folder / "time.png", png_bytes(training_time_bars(medians), reduce_colors=False))


def training_time_bars(seconds: dict[str, dict[str, float]]) -> Figure:
    """Draw the parts of training, a bar per variant."""
    bars = {VARIANTS[variant].label: parts for variant, parts in seconds.items()}
    figure = stacked_bars(bars, "wall time per 1,000 actual steps [s]", height=0.4 * len(bars) + 1.2)
    figure.axes[0].invert_yaxis()
    figure.axes[0].grid(axis="y", visible=False)
    return figure


def _time_table(folder: Path) -> pd.DataFrame:
    """Return the wall time per 1,000 actual steps by variant and part, and how many times TRPO's it is."""
    found = read_part(folder, "time")
    table = []
    for variant, parts in found["median"].items():
        cells = {"": VARIANTS[variant].label}
        cells |= {f"{part} [s]": f"{seconds:.2f}" for part, seconds in parts.items()}
        table.append({**cells, "times TRPO's": f"{found['over_trpo'][variant]:.2f}"})
    return pd.DataFrame(table).fillna("")


THEORY = Study(
    "what can be measured of the theorems A1, A2 and A3",
    lambda seeds: planned_runs([THEORY_ROAD], tuple(dict.fromkeys((*CONVERGENCE_VARIANTS, *MODEL_VARIANTS))), seeds),
    _write_theory,
    minutes=8.0,
)
FIGURE_8 = Study(
    "training time, measured side by side",
    lambda seeds: [],
    _write_time,
    minutes=12.0,
    tables={"training time": _time_table},
)
