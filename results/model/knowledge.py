"""What knowledge is worth: how well IDM, IDM plus residual networks, and networks alone predict the road.

    python results/model/knowledge.py FOLDER

writes FOLDER/knowledge.json and FOLDER/knowledge.png. Data are those with which `unjam train` begins: PI and
a residual network that has learned nothing, with the exploration of the defaults. The first steps are part of
the later ones. The episodes that judge have seeds of their own, and no network ever sees them.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from unjam.drivers.residual import ResidualDriver
from unjam.files import to_json, write_whole
from unjam.learners.algorithm_1 import begin_training
from unjam.learners.imagination import full_policy
from unjam.manifest import manifest
from unjam.measures.metrics import measure
from unjam.reports.figures import INK, LINES, STYLE
from unjam.scenarios.scenario import Scenario
from unjam.training.config import RunConfig, load_config
from unjam.training.evaluate import raise_failure
from unjam.virtual.comparison import one_step_errors, open_loop
from unjam.virtual.data import ActualData
from unjam.virtual.fitting import fit, unexplained
from unjam.virtual.model import NUMBERS, EnvironmentModel
from unjam.virtual.rollout import draw_starts
from unjam.virtual.settings import BaseName, VirtualSettings
from unjam.worlds.record import Episode
from unjam.worlds.workers import EpisodeTask, Workers

ROADS = ("ring", "figure-eight")
PASSES = {6_000: 200, 24_000: 100, 100_000: 40}
"""actual steps, and passes over them that a fit may make: more data have more gradient steps in a pass"""
STEPS = tuple(PASSES)
SEEDS = range(5)
TEST_EPISODES, TEST_SEED = 12, 2_000_000
STARTS, SECONDS = 500, 5.0
BASES: dict[str, BaseName] = {"IDM + residual": "idm", "networks alone": "none"}
ALONE: dict[str, BaseName] = {"IDM alone": "idm", "nothing changes": "none"}
WORKERS = 1


def settings_for(base: BaseName, passes: int = 1) -> VirtualSettings:
    """Return the defaults, but all rows are learned from, until the holdout has not improved for long."""
    return VirtualSettings(base=base, fit_rows=200_000, rows=200_000, epochs=passes, patience=10)


def untrained(config: RunConfig) -> ResidualDriver:
    """Return the policy with which a training begins."""
    tasks = config.make_tasks()
    training = begin_training(tasks, config.policy, config.learner, config.virtual, config.seed)
    return full_policy(tasks[0], config.policy, training.learner.network())


def driven(
    workers: Workers, scenario: Scenario, driver: ResidualDriver, count: int, seed: tuple[int, ...]
) -> list[Episode]:
    """Return `count` episodes with exploration that cover the range of what the scenario draws."""
    episodes = workers.run(
        [
            EpisodeTask(scenario.part(index, count), driver, (*seed, index), "", explore=True)
            for index in range(count)
        ]
    )
    raise_failure([measure(episode) for episode in episodes if not episode.ok])
    return episodes


def data_of(episodes: list[Episode], scenario: Scenario) -> ActualData:
    """Return all of these episodes as actual data."""
    data = ActualData(sum(episode.steps for episode in episodes))
    data.add(episodes, scenario)
    return data


def judged(model: EnvironmentModel, test: ActualData, scenario: Scenario) -> dict[str, Any]:
    """Return the errors of a model on the test episodes."""
    errors = one_step_errors(model, test.transitions(0.5), scenario, "").by_number()
    decisions = round(SECONDS / scenario.decision_step)
    looks = draw_starts(test, STARTS, decisions, (TEST_SEED,))
    later = open_loop(model, test, looks, decisions, scenario)
    return {
        "unexplained": unexplained([errors[name] for name in NUMBERS]),
        "one_step": {name: error.model for name, error in errors.items()},
        "change": {name: error.change for name, error in errors.items()},
        "gap_later": float(later.error["leader_gap"][-1]),
        "follower_gap_later": float(later.error["follower_gap"][-1]),
    }


def measured(workers: Workers, road: str) -> list[dict[str, Any]]:
    """Return the rows of a road: one for each model, number of steps and seed."""
    scenario = load_config(changes={"scenario": road}).make_scenario()
    drawn = len(scenario.drawn_ranges)
    driver = untrained(load_config(changes={"scenario": road, "seed": TEST_SEED % 1_000_000}))
    test = data_of(driven(workers, scenario, driver, TEST_EPISODES, (TEST_SEED,)), scenario)
    rows: list[dict[str, Any]] = []
    for name, base in ALONE.items():
        model = EnvironmentModel(settings_for(base), drawn, (0,))
        rows.append({"road": road, "model": name, "steps": 0, "seed": None, **judged(model, test, scenario)})
    for seed in SEEDS:
        driver = untrained(load_config(changes={"scenario": road, "seed": seed}))
        episodes: list[Episode] = []
        for steps in STEPS:
            missing = -(-steps // scenario.horizon) - len(episodes)
            episodes += driven(workers, scenario, driver, missing, (seed, steps))
            actual = data_of(episodes, scenario).transitions(0.2)
            for name, base in BASES.items():
                settings = settings_for(base, PASSES[steps])
                model = EnvironmentModel(settings, drawn, (seed,))
                found = fit(model, actual, settings, scenario, "", (seed, steps))
                rows.append(
                    {
                        "road": road,
                        "model": name,
                        "steps": steps,
                        "seed": seed,
                        **judged(model, test, scenario),
                        "learned": list(found.learned),
                        "passes": found.epochs,
                    }
                )
                print(road, name, steps, seed, f"{rows[-1]['unexplained']:.4f}", found.epochs, flush=True)
    return rows


PANELS = {
    "unexplained": "unexplained share of\na 0.1 s change, mean of 5 numbers",
    "gap_later": "error of the gap ahead\nafter 5 s [m]",
    "follower_gap_later": "error of the gap behind\nafter 5 s [m]",
}


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Return the errors by the number of actual steps: a row of panels per road, a dot per seed."""
    with rc_context(STYLE):
        figure = Figure(figsize=(10.5, 5.8), layout="constrained", dpi=130)
        panels = figure.subplots(len(ROADS), len(PANELS), sharex=True, squeeze=False)
        for road, line in zip(ROADS, panels, strict=True):
            here = [row for row in rows if row["road"] == road]
            for (name, label), axes in zip(PANELS.items(), line, strict=True):
                errors(axes, here, name)
                axes.set_title(f"{road}: {label}", loc="left", fontsize=9, color=INK)
        for axes in panels[-1]:
            axes.set_xlabel("actual steps")
        figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=4)
        return figure


def errors(axes: Axes, rows: list[dict[str, Any]], name: str) -> None:
    """Draw one error of all models on a road."""
    for alone, style in zip(ALONE, ("--", ":"), strict=True):
        (value,) = (row[name] for row in rows if row["model"] == alone)
        axes.axhline(value, color=INK, lw=1.1, ls=style, label=alone)
    for (model, colour), shift in zip(zip(BASES, LINES[2:0:-1], strict=True), (0.95, 1.05), strict=True):
        found = np.array(
            [[row[name] for row in rows if (row["model"], row["steps"]) == (model, n)] for n in STEPS]
        )
        places = np.array(STEPS) * shift
        axes.plot(places, found.mean(1), color=colour, lw=1.6, label=model)
        axes.plot(places, found, color=colour, lw=0, marker="o", ms=3, alpha=0.5)
    axes.set_xscale("log")
    axes.set_xticks(STEPS, [f"{steps:,}" for steps in STEPS])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())


def main(folder: Path) -> None:
    """Measure, and write the numbers and their picture."""
    torch.set_num_threads(1)
    about = manifest()
    with Workers(WORKERS) as workers:
        rows = [row for road in ROADS for row in measured(workers, road)]
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / "knowledge.json", to_json({"manifest": about, "rows": rows}, indent=1))
    picture(rows).savefig(folder / "knowledge.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
