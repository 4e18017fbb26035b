"""The final judgement of a run: its controller beside its expert and others, on held-out seeds."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from unjam.controller import make_driver
from unjam.drivers.driver import Driver
from unjam.drivers.registry import describe, free_label
from unjam.manifest import manifest
from unjam.training.config import RunConfig
from unjam.training.evaluate import Evaluation, evaluate, held_out_seeds, raise_failure, save_evaluation
from unjam.worlds.episode import can_drive
from unjam.worlds.workers import Workers

TRAINED = "trained"
"""label of the trained controller in tables and pictures"""


def among(config: RunConfig, humans: Path | None) -> RunConfig:
    """Return a run's configuration with other people on its road: those of a population's file, if any."""
    if humans is None:
        return config
    return replace(config, road={**config.road, "population": str(humans.absolute())})


def comparison(config: RunConfig, folder: Path, baselines: Sequence[str]) -> dict[str, Driver]:
    """Return the drivers to compare, by label: the baselines, the run's expert, its trained controller."""
    scenario = config.make_scenario()
    time_step = scenario.decision_step
    expert = {} if config.expert == "none" else {describe(made := config.make_expert()): made}
    drivers: dict[str, Driver] = {}
    for name in baselines:
        driver = make_driver(name, time_step)
        if not can_drive(driver, scenario):
            continue
        drivers[free_label(driver, {**expert, **drivers})] = driver
    return {**drivers, **expert, TRAINED: make_driver(str(folder), time_step)}


def judge(
    folder: Path,
    config: RunConfig,
    workers: Workers,
    baselines: Sequence[str] | None = None,
    episodes: int | None = None,
    progress: Callable[[tuple[str, int], int], None] | None = None,
    out: Path | None = None,
) -> Evaluation:
    """Evaluate a run's controller beside others on the same held-out seeds, and save it all in its folder.

    `baselines` and `episodes` are the configuration's where they are not given; with `out` that is the folder
    where it is saved.
    """
    scenario = config.make_scenario()
    drivers = comparison(config, folder, config.evaluation.baselines if baselines is None else baselines)
    seeds = held_out_seeds(episodes or config.evaluation.episodes)
    found = evaluate(scenario, drivers, seeds, workers, config.reward, progress)
    about = {
        "scenario": Path(config.scenario).name,
        "reward": config.reward or scenario.reward,
        "trained": TRAINED,
        "expert": describe(config.make_expert()) if config.expert != "none" else "none",
        "manifest": manifest(),
    }
    save_evaluation(out or folder, found, about)
    raise_failure([row for rows in found.rows.values() for row in rows])
    return found
