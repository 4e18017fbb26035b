"""Comparisons of learners: Tables 1 and 2, Figures 4, 5, 7 and 9 of the paper, its exact settings, and road models.

Tables have results in the convention of the paper, next to the numbers of the paper, and in that of unjam: on test
seeds, with paired differences and confidence intervals. Curves are the mean and the range over trainings of a variant.
"""

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import cycle
from math import ceil, inf, isfinite, nan
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.figure import Figure

from unjam.measures import statistics
from unjam.measures.feasibility import feasibility_by_driver, overall_feasibility
from unjam.measures.metrics import METRICS
from unjam.reports.figures import LINE_COLORS, PLOT_STYLE, TEXT_COLOR, new_figure
from unjam.reports.results import PlotEpisode, read_results, validation_gains
from unjam.reports.space_time import trajectory_figure
from unjam.training.config import RunConfig, load_config
from unjam.worlds.record import Floats
from unjam_paper.results_file import read_part, read_part_or_empty, write_figure, write_part
from unjam_paper.study import (
    FILTERED_ROADS,
    FINAL_SHARE,
    NO_VALUE_TEXT,
    PAPER_ROADS,
    PlannedRun,
    Study,
    StudyFolder,
    Table,
    TrainedRun,
    estimate_text,
    number_text,
    planned_runs,
    trainings_text,
)
from unjam_paper.variants import NON_EXPERTS, VARIANTS

PAPER_RESULTS: dict[tuple[str, str], tuple[float, float, float]] = {
    ("ring", "trpo"): (1699.15, 3.42, 0.55),
    ("ring", "ppo"): (1057.14, 3.43, 0.75),
    ("ring", "sac"): (1048.97, 3.24, 0.38),
    ("ring", "proposed"): (1753.66, 4.04, 0.48),
    ("ring", "mb-trpo"): (1717.45, 3.55, 0.73),
    ("ring", "no-initial-policy"): (1633.28, 3.53, 0.57),
    ("figure-eight", "trpo"): (542.42, 1.84, 1.43),
    ("figure-eight", "ppo"): (228.86, 1.60, 1.20),
    ("figure-eight", "sac"): (435.72, 2.30, 1.94),
    ("figure-eight", "proposed"): (862.81, 6.41, 2.04),
    ("merge", "trpo"): (420.07, 15.26, 2.46),
    ("merge", "ppo"): (415.02, 14.67, 2.77),
    ("merge", "sac"): (449.72, 16.47, 2.38),
    ("merge", "proposed"): (492.93, 17.44, 2.22),
}
"""Tables 1 and 2 of the paper, by road and variant: reward, mean (`average speed`) and standard deviation over time
(`speed std`) of the CAV's speed [m/s], both including the start of the episode and exploration"""
PAPER_COLUMNS = {
    "reward": ("return", "return_mean"),
    "speed": ("cav_mean_speed", "cav_mean_speed"),
    "std": ("speed_std_cav", "speed_std_cav"),
}
"""columns of the paper: the metric of episodes and the entry of the progress of each"""
COMPARISON_METRICS = (
    *("return", "return_eq16", "mean_speed", "mean_speed_steady", "speed_limit_ratio_steady", "speed_std_fleet"),
    *("time_to_dissolve", "outflow_veh_per_h", "insertion_backlog_veh", "min_time_gap", "collisions"),
    "cav_max_braking",
)
"""metrics of the deterministic policy on test seeds"""
TRIMMED_SHARE = 0.25
"""share of trainings left out at either end: Agarwal et al. 2021, `Deep RL at the edge of the statistical precipice`"""
MAX_LEGEND_ROW_LENGTH, LEGEND_ENTRY_OVERHEAD = 155, 8
"""characters in a row of a legend; width of the line and margins of an entry, in characters"""
CURVE_POINTS = 100
CURVE_LABELS = {"return_mean": "return, in training", "cav_mean_speed": "CAV's mean speed, in training [m/s]"}
RETURN_COLUMNS, SPEED_COLUMNS = ("return_mean", "return_validation"), ("cav_mean_speed", "speed_std_cav")
FIGURE_5_VARIANTS = ("proposed", "ours")
EFFICIENCY_STEPS = (190_000, 380_000, 750_000, 1_500_000, 3_000_000, 6_000_000)
ON_RAMP_EFFICIENCY_STEPS = (28_800,)
"""environment steps after which trainings are compared; on the on-ramp, the steps of a training with the model"""
STEP_MULTIPLES = (1, 2, 3)
"""multiples of environment steps with which variants without the model are compared"""
MODEL_FREE_VARIANTS = {
    "best": ("best-few", "best-double", "best"),
    "jammed": ("jammed-few", "jammed-double", "jammed-ideal"),
    "eight": ("eight-few", "eight-double", "best-in-batches"),
    "ramp": ("ramp-few",) * len(STEP_MULTIPLES) + ("ramp-small",) * len(STEP_MULTIPLES),
}
"""variants without the model, for `STEP_MULTIPLES`, by prefix. On figure eights, where batches equal SUMO only in
distribution, the last variant is trained in batches, too"""


def comparison_study(title: str, variants: Sequence[str], road: str = "ring") -> Study:
    """Return the study that compares variants on a road."""

    def write(study_folder: StudyFolder, seeds: int, folder: Path) -> None:
        write_part(folder, "table", comparison_rows(study_folder, road, variants, seeds))
        curves, metric = training_curves(study_folder, road, variants, seeds), return_metric(road, variants[0])
        rows = study_folder.reference_rows(road)
        references = {"human baseline": rows["human"], "best expert": rows[best_expert(rows, metric)]}
        write_part(folder, "curves", {road: curves})
        write_figure(folder, "curves", curve_figure(road, curves, references, metric))
        study_folder.copy_controllers(planned_runs([road], variants, seeds), folder)

    tables = {"checkpoints": partial(_checkpoint_table, road)}
    return Study(title, lambda seeds: planned_runs([road], variants, seeds), write=write, roads=(road,), tables=tables)


def best_expert(reference_rows: dict[str, Table], metric: str = "return") -> str:
    """Return the label of the expert with the largest mean of a metric."""
    experts = [label for label in reference_rows if label not in NON_EXPERTS]
    return max(experts, key=lambda label: statistics.metric_estimate(reference_rows[label], metric).mean)


def return_metric(road: str, variant: str) -> str:
    """Return the metric that has the return of a variant's reward for all drivers; for Eq. 16 the intended reward."""
    return "return_eq16" if PlannedRun(road, variant, 0).config.reward.startswith("eq16") else "return"


def comparison_rows(study_folder: StudyFolder, road: str, variants: Sequence[str], seeds: int) -> Table:
    """Return a row for each reference driver and each variant on a road."""
    references, metric = study_folder.reference_rows(road), return_metric(road, variants[0])
    best, verdicts = best_expert(references, metric), feasibility_by_driver(references)
    rows: Table = []
    for label, episodes in references.items():
        row = {"road": road, "name": label, "is_learned": False, "trainings": 0, "episodes": len(episodes)}
        row |= {"best_expert": label == best, "feasibility": verdicts[label]}
        row |= estimate_metrics(episodes, COMPARISON_METRICS)
        row["gain_over_best_expert"] = asdict(statistics.paired_difference(episodes, references[best], metric))
        columns = {key: [episode[name] for episode in episodes] for key, (name, _) in PAPER_COLUMNS.items()}
        finite = {key: list(filter(isfinite, values)) for key, values in columns.items()}
        rows.append({**row, "paper_convention": {key: _mean_and_std(values) for key, values in finite.items()}})
    trained = study_folder.trained_runs(road, variants, seeds)
    return [*rows, *(_variant_row(road, variant, runs, references) for variant, runs in trained.items())]


def _variant_row(road: str, variant: str, runs: list[TrainedRun], reference_rows: dict[str, Table]) -> dict[str, Any]:
    paper_values = PAPER_RESULTS.get((FILTERED_ROADS.get(road, road), VARIANTS[variant].paper_variant or variant))
    metric = return_metric(road, variant)
    best = best_expert(reference_rows, metric)
    row: dict[str, Any] = {"road": road, "name": VARIANTS[variant].label, "variant": variant, "is_learned": True}
    row |= {"trainings": len(runs), "episodes": len(runs[0].rows), "steps": runs[0].run.config.steps}
    row["paper"] = dict(zip(PAPER_COLUMNS, paper_values, strict=True)) if paper_values else None
    for name in COMPARISON_METRICS:
        is_comparable = name != "return" or metric == "return"  # returns of another reward are not comparable
        values = [statistics.estimate([row[name] for row in run.rows]).mean if is_comparable else nan for run in runs]
        row[name] = asdict(statistics.estimate_over_trainings(values, TRIMMED_SHARE, METRICS[name].bounds))
    differences = statistics.paired_differences([run.rows for run in runs], reference_rows[best], metric)
    all_gains = [gains for run in runs if (gains := validation_gains(run.progress))]
    final_means = {key: [run.final_training_mean(name) for run in runs] for key, (_, name) in PAPER_COLUMNS.items()}
    return {
        **row,
        "paper_convention": {key: _mean_and_std(means) for key, means in final_means.items()},
        "gain_reference": {"expert": best, "metric": metric},
        "gain_over_best_expert": asdict(statistics.estimate_crossed(differences)),
        "probability_of_improvement": asdict(statistics.probability_of_improvement(differences)),
        "untrained_count": sum(best_gain <= 0 for best_gain, _ in all_gains),
        "feasibility": [overall_feasibility(run.rows, reference_rows["human"]) for run in runs],
        "seconds": float(np.mean([run.seconds for run in runs])),
        "gains": differences.mean(1).tolist(),
    }


def estimate_metrics(rows: Table, names: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return the mean of metrics over episodes with its confidence interval, by metric."""
    return {name: asdict(statistics.metric_estimate(rows, name)) for name in names}


def _mean_and_std(values: Sequence[float]) -> dict[str, float]:
    return {"mean": float(np.mean(values)), "std": float(np.std(values))} if values else {"mean": nan, "std": nan}


def training_curves(study_folder: StudyFolder, road: str, variants: Sequence[str], seeds: int) -> dict[str, Any]:
    """Return the curves of a road by variant: environment steps, and quantities at these steps, one list per seed.

    Quantities that were not measured, and returns of another reward than that of the first variant, are left out.
    """

    def resample(progress: Table, name: str) -> list[float]:
        points = [(row["environment_steps"], row[name]) for row in progress if row[name] is not None]
        steps, values = np.array(points, float).T
        return [float(f"{value:.5g}") for value in np.interp(grid, steps, values)]

    curves: dict[str, Any] = {}
    reward = PlannedRun(road, variants[0], 0).config.reward
    for variant, runs in study_folder.trained_runs(road, variants, seeds).items():
        first = max(run.progress[0]["environment_steps"] for run in runs)
        last = min(run.progress[-1]["environment_steps"] for run in runs)
        grid = np.linspace(first, last, CURVE_POINTS)
        curves[variant] = {"steps": grid.round().tolist()}
        has_same_reward = PlannedRun(road, variant, 0).config.reward == reward
        for name in (*RETURN_COLUMNS, *SPEED_COLUMNS) if has_same_reward else SPEED_COLUMNS:
            if any(row[name] is not None for row in runs[0].progress):
                curves[variant][name] = [resample(run.progress, name) for run in runs]
    return curves


def _checkpoint_table(road: str, folder: Path) -> pd.DataFrame:
    """Return the returns of the best and the last checkpoint in validation, and how often training did not help.

    The table is empty for results without curves.
    """
    curves, table = read_part_or_empty(folder, "curves").get(road, {}), []
    for row in read_part(folder, "table"):
        if "return_validation" in curves.get(row.get("variant"), {}):
            values = np.array(curves[row["variant"]]["return_validation"])
            best, last = values.max(1), values[:, -1]
            difference = statistics.estimate_over_trainings(last - best, bounds=(-inf, 0.0))
            cells = {"": VARIANTS[row["variant"]].label, "trainings": len(values)}
            cells |= {"best trained": number_text(best.mean(), 0), "last checkpoint": number_text(last.mean(), 0)}
            cells |= {"last − best": estimate_text(difference, 0, "+")}
            table.append({**cells, "kept the untrained network": f"{row['untrained_count']} of {len(values)}"})
    return pd.DataFrame(table)


@rc_context(PLOT_STYLE)
def curve_figure(road: str, curves: dict[str, Any], reference_rows: dict[str, Table], metric: str = "return") -> Figure:
    """Draw return and speed in training over environment steps; horizontal lines are the means of reference drivers."""
    figure = new_figure(3.1)
    for (name, heading), axes in zip(CURVE_LABELS.items(), figure.subplots(1, len(CURVE_LABELS)), strict=True):
        for (variant, curve), color in zip(curves.items(), LINE_COLORS[1:], strict=False):
            if name in curve:
                steps, values = np.array(curve["steps"]) / 1000.0, np.array(curve[name])
                axes.fill_between(steps, values.min(0), values.max(0), color=color, alpha=0.15, lw=0)
                axes.plot(steps, values.mean(0), color=color, lw=1.5, label=VARIANTS[variant].label)
        for (label, rows), style in zip(reference_rows.items(), ("--", ":"), strict=False):
            value = statistics.metric_estimate(rows, metric if name == "return_mean" else name).mean
            axes.axhline(value, color=TEXT_COLOR, lw=1.0, ls=style, label=label)
        axes.margins(x=0.01)
        axes.set(title=f"{road}: {heading}", xlabel="environment steps [thousands]")
    lines, labels = figure.axes[-1].get_legend_handles_labels()
    rows = ceil(sum(len(label) + LEGEND_ENTRY_OVERHEAD for label in labels) / MAX_LEGEND_ROW_LENGTH)
    figure.legend(lines, labels, loc="outside upper left", ncols=ceil(len(labels) / rows))
    return figure


def _write_figure_5(study_folder: StudyFolder, seeds: int, folder: Path) -> None:
    for road in PAPER_ROADS:
        write_figure(folder, road, trajectory_figure(figure_5_episodes(study_folder, road)))


def figure_5_episodes(study_folder: StudyFolder, road: str) -> list[PlotEpisode]:
    """Return episodes with the same traffic: of humans, the best expert, and the first training of two variants."""
    references = read_results(study_folder.reference_folder(road)).plot_episodes
    episodes = [references["human"], references[best_expert(study_folder.reference_rows(road))]]
    for variant in FIGURE_5_VARIANTS:
        results = read_results(study_folder.run_folder(PlannedRun(road, variant, 0)))
        trained = results.plot_episodes[results.trained_label or ""]
        episodes.append(replace(trained, driver=VARIANTS[variant].label))
    return episodes


FIGURE_5 = Study(
    title="space-time figures",
    write=_write_figure_5,
    make_runs=lambda seeds: planned_runs(PAPER_ROADS, FIGURE_5_VARIANTS, 1),
    roads=PAPER_ROADS,
    minutes=0.5,
)


def paper_exact_study(road: str) -> Study:
    """Return the study of the exact settings of the paper, with the steps after which its convergence rule holds."""
    suffix = {"merge": "-million", "ring": "-filtered", "figure-eight": "-filtered"}.get(road, "")
    variants = (f"trpo-exact{suffix}", f"proposed-exact{suffix}")
    study = comparison_study(f"exact settings of the paper, on {road}", variants, road)

    def write(study_folder: StudyFolder, seeds: int, folder: Path) -> None:
        study.write(study_folder, seeds, folder)
        trained = study_folder.trained_runs(road, variants, seeds)
        results = {name: list(map(_paper_exact_results, runs)) for name, runs in trained.items()}
        write_part(folder, "paper-exact", results)

    return replace(study, write=write, tables={"paper-exact": _paper_exact_table})


def _paper_exact_results(run: TrainedRun) -> dict[str, Any]:
    return {
        "converged": paper_convergence(run.progress),
        "eps_m": transition_model_errors(run.progress),
        "last": run.final_training_mean("return_mean"),
        "test_return": float(np.mean([row["return"] for row in run.rows])),
    }


def paper_convergence(progress: Table) -> dict[str, float] | None:
    """Return steps and return when the rule of the paper ends a training; None if the rule never does."""
    rule = load_config(preset="paper-exact").evaluation
    window = rule.convergence_window
    for count in range(window, len(progress) + 1, window):
        if rule.has_converged(progress[:count]):
            mean = np.mean([row["return_mean"] for row in progress[count - window : count]])
            return {"steps": progress[count - 1]["environment_steps"], "return": float(mean)}
    return None


def transition_model_errors(progress: Table) -> list[float] | None:
    """Return the model error on environment transitions in the first and last tenth of a training; None: no model."""
    errors = [row["model"]["eps_m_by_estimator"]["transitions"] for row in progress if row["model"]]
    if not errors:
        return None
    count = max(1, round(FINAL_SHARE * len(errors)))
    return [float(np.mean(errors[:count])), float(np.mean(errors[-count:]))]


def _paper_exact_table(folder: Path) -> pd.DataFrame:
    """Return when trainings converge by the rule of the paper, their returns at this time and at the end, and eps_m."""
    table = []
    for variant, trainings in read_part(folder, "paper-exact").items():
        ends = [training["converged"] for training in trainings if training["converged"]]
        errors = [training["eps_m"] for training in trainings if training["eps_m"]]
        change = " → ".join(f"{mean:.3f}" for mean in np.mean(errors, 0)) if errors else NO_VALUE_TEXT
        rises = sum(last > first for first, last in errors)
        cells = {"": VARIANTS[variant].label, "trainings": str(len(trainings))}
        cells["converge, by the rule"] = f"{len(ends)} of {len(trainings)}"
        cells["after [steps]"] = f"{np.median([end['steps'] for end in ends]):,.0f}" if ends else NO_VALUE_TEXT
        cells["return then, in training"] = trainings_text([end["return"] for end in ends], 0)
        cells["return in the last tenth"] = trainings_text([training["last"] for training in trainings], 0)
        test_returns = [training["test_return"] for training in trainings]
        cells["last checkpoint, test seeds"] = trainings_text(test_returns, 0)
        cells["eps_m, first and last tenth"] = change
        cells["eps_m rises in"] = f"{rises} of {len(errors)}" if errors else NO_VALUE_TEXT
        table.append(cells)
    return pd.DataFrame(table)


def road_model_study(road: str, prefix: str) -> Study:
    """Return the study of environment steps that a model of the whole road saves, for the variants with a prefix."""
    variants = compared_variants(prefix)
    title = f"environment steps that a model of the whole road saves, on {road}"
    study = comparison_study(title, tuple(dict.fromkeys(variants)), road)
    step_counts = ON_RAMP_EFFICIENCY_STEPS if road == "on-ramp" else EFFICIENCY_STEPS
    return replace(study, tables={**study.tables, "efficiency": partial(efficiency_table, road, variants, step_counts)})


def compared_variants(prefix: str) -> tuple[str, ...]:
    """Return the variant with the model, and the variants without it in the order of `STEP_MULTIPLES`."""
    return (f"{prefix}-road-model", *MODEL_FREE_VARIANTS[prefix])


def efficiency_table(road: str, variants: Sequence[str], step_counts: Sequence[int], folder: Path) -> pd.DataFrame:
    """Return validation returns after environment steps, and the differences of the first variant to the others."""
    curves, (model_variant, *other_variants) = read_part(folder, "curves")[road], variants
    returns = {name: partial(_returns_after, PlannedRun(road, name, 0).config, curves[name]) for name in variants}
    rows = [
        {"": VARIANTS[name].label, **{f"{steps:,}": trainings_text(after(steps), 0) for steps in step_counts}}
        for name, after in returns.items()
    ]
    for name, factor in zip(other_variants, cycle(STEP_MULTIPLES)):
        multiple = "as many" if factor == 1 else f"{factor} times as many"
        gains = {steps: returns[model_variant](steps) - returns[name](factor * steps) for steps in step_counts}
        label = f"with the model, difference to “{VARIANTS[name].label}” after {multiple}"
        rows.append({"": label, **{f"{steps:,}": trainings_text(gain, 0, "+") for steps, gain in gains.items()}})
    return pd.DataFrame(rows)


def _returns_after(config: RunConfig, curve: dict[str, list[float]], steps: int) -> Floats:
    """Return the validation return of each training after some steps; NaN outside of the validated steps."""
    trainings = curve["return_validation"]
    if steps < config.learner.steps_per_iteration * (config.evaluation.validation_interval or 1):
        return np.full(len(trainings), np.nan)
    return np.array([np.interp(steps, curve["steps"], values, np.nan, np.nan) for values in trainings])
