"""Drivers on fixed seeds, several on the same traffic: driven, judged, saved for reports.

`unjam drive` takes any drivers and seeds; a run's controller is judged beside others on held-out seeds.
"""

import os
from collections.abc import Callable, Container, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from safetensors.numpy import save

from unjam.controller import PACKAGED_PREFIX, controller_hash, make_driver
from unjam.controller.domain import controller_notes
from unjam.drivers.driver import Driver
from unjam.drivers.registry import driver_names, is_serializable, unique_label
from unjam.drivers.user_driver import DriverLike, as_driver
from unjam.errors import InputError, error_from_name, invalid_value
from unjam.files import atomic_write, make_folder, to_json
from unjam.manifest import manifest
from unjam.measures.metrics import measure
from unjam.measures.notes import episode_notes
from unjam.measures.statistics import Estimate, paired_difference, summarize
from unjam.reports.results import EPISODE_ENTRIES, EVALUATION_FILE, pack_episode, to_plot_episode
from unjam.scenarios import make_scenario, scenario_recipe
from unjam.scenarios.scenario import Scenario
from unjam.training.config import RunConfig
from unjam.training.drive_result import DriveResult, RowsByDriver, rows_to_frame
from unjam.training.run_folder import lock_new_folder
from unjam.training.seeds import TRAINING_SEED_LIMIT, make_test_seeds
from unjam.worlds.episode import can_drive, run_episode
from unjam.worlds.record import Episode
from unjam.worlds.reward import make_reward
from unjam.worlds.sumo.sandboxed import open_simulation
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

MISSING_ACC_NOTE = "holds back a car's own ACC, which none has: --set actuation=cruise --set safety.active=false"
TRAINED_LABEL = "trained"
"""label of the trained controller in tables and pictures"""
EvaluationProgress = Callable[[tuple[str, int], int], None]
"""called now and then with (the driver's label, the index of its episode), and the decisions made so far"""


@dataclass(frozen=True)
class Evaluation:
    """Several drivers on the same episodes."""

    rows: RowsByDriver
    plot_episodes: dict[str, Episode] = field(repr=False)
    """by driver: the episode that pictures show, the same seed for all"""

    def means(self) -> dict[str, dict[str, float]]:
        """Return the mean of each metric, by driver."""
        return {
            label: {name: found.mean for name, found in summarize(rows).items()} for label, rows in self.rows.items()
        }


def evaluate(
    scenario: Scenario,
    drivers: dict[str, Driver],
    seeds: Sequence[tuple[int, ...]],
    workers: WorkerPool,
    reward: str = "",
    progress: EvaluationProgress | None = None,
) -> Evaluation:
    """Run every driver on every seed, and measure."""
    on_road = {label: (scenario, driver) for label, driver in drivers.items()}
    return evaluate_on_roads(on_road, seeds, workers, reward, progress)


def evaluate_on_roads(
    drivers: dict[str, tuple[Scenario, Driver]],
    seeds: Sequence[tuple[int, ...]],
    workers: WorkerPool,
    reward: str = "",
    progress: EvaluationProgress | None = None,
    with_plots: bool = True,
) -> Evaluation:
    """Run every driver, each on a road of its own, on every seed, and measure.

    An episode of each is kept for pictures; not so where none are `pictured`, for it needs much memory.
    """
    pairs = [(label, index) for index in range(len(seeds)) for label in drivers]
    how: dict[str, Any] = {"reward": reward, "record_details": True, "stop_at_contact": False}
    tasks = [EpisodeTask(*drivers[label], seeds[index], **how) for label, index in pairs]

    def on_progress(task: int, steps: int) -> None:
        if progress is not None:
            progress(pairs[task], steps)

    def measure_task(task: int, episode: Episode) -> tuple[dict[str, Any], Episode | None]:
        _, index = pairs[task]
        return measure(episode), episode if with_plots and index == 0 and episode.has_run else None

    away = [index for index, (label, _) in enumerate(pairs) if is_serializable(drivers[label][1])]
    found = dict(
        zip(
            away,
            workers.run_and_map(
                [tasks[index] for index in away],
                lambda number, episode: measure_task(away[number], episode),
                lambda number, steps: on_progress(away[number], steps),
            ),
            strict=True,
        )
    )
    found |= _run_in_process(tasks, found.keys(), measure_task, on_progress)
    rows: RowsByDriver = {label: [] for label in drivers}
    shown: dict[str, Episode] = {}
    for index, (label, _) in enumerate(pairs):
        row, episode = found[index]
        rows[label].append(row)
        if episode is not None:
            shown[label] = episode
    return Evaluation(rows, shown)


def _run_in_process(
    tasks: Sequence[EpisodeTask],
    finished: Container[int],
    process: Callable[[int, Episode], Any],
    on_progress: Callable[[int, int], None],
) -> dict[int, Any]:
    """Run those tasks that are not done in this process; return what `keep` makes of each, by index."""
    left = {index: task for index, task in enumerate(tasks) if index not in finished}
    if not left:
        return {}
    with open_simulation(*(task.scenario for task in left.values())) as simulation:
        return {
            index: process(
                index,
                run_episode(
                    *(task.scenario, task.driver, task.seed, task.reward, task.explore, task.record_details),
                    simulation=simulation,
                    on_progress=partial(on_progress, index),
                    stop_at_contact=task.stop_at_contact,
                ),
            )
            for index, task in left.items()
        }


def raise_failure(rows: Sequence[dict[str, Any]]) -> None:
    """Raise the first failure among the rows of episodes, as the error that it was."""
    for row in rows:
        if row["status"] == "failed":
            again = "" if row["error"] == InputError.__name__ else f" (seed {row['seed']})"
            raise error_from_name(row["error"], f"{row['reason']}{again}")


def raise_failures(result: "Evaluation | DriveResult") -> None:
    """Raise the first failure among the episodes of a result, if there is one."""
    raise_failure([row for rows in result.rows.values() for row in rows])


def save_evaluation(folder: Path, evaluation: Evaluation, metadata: dict[str, Any]) -> None:
    """Write an evaluation into a folder: what reports are made of.

    `evaluation.json` (rows, and `about`), `episodes.parquet` (the rows as a table), and
    `plot_episodes.safetensors` with the episode that pictures show.
    """
    make_folder(folder)
    rows = [{"driver": label, **row} for label, found in evaluation.rows.items() for row in found]
    shown = [to_plot_episode(label, episode) for label, episode in evaluation.plot_episodes.items()]
    arrays = {
        f"{number}.{name}": array for number, each in enumerate(shown) for name, array in pack_episode(each).items()
    }
    about_shown = [{"driver": each.driver, **{name: getattr(each, name) for name in EPISODE_ENTRIES}} for each in shown]
    atomic_write(folder / "plot_episodes.safetensors", save(arrays))
    atomic_write(folder / "episodes.parquet", rows_to_frame(evaluation.rows).to_parquet())
    atomic_write(
        folder / "evaluation.json", to_json({**metadata, "rows": rows, "plot_episodes": about_shown}, indent=1)
    )


def drivers_to_compare(config: RunConfig, folder: Path, baselines: Sequence[str]) -> dict[str, Driver]:
    """Return the drivers to compare, by label: the baselines, the run's expert, its trained controller."""
    scenario = config.make_scenario()
    expert = {} if config.expert == "none" else {(made := config.make_expert()).describe(): made}
    drivers: dict[str, Driver] = {}
    for name in baselines:
        driver = make_driver(name, scenario.control_step)
        if can_drive(driver, scenario):
            # The description of a shipped driver has every parameter that was tuned.
            shipped = name.startswith(PACKAGED_PREFIX) and name != config.expert
            drivers[name if shipped else unique_label(driver, {**expert, **drivers})] = driver
    return {**drivers, **expert, TRAINED_LABEL: make_driver(str(folder), scenario.control_step)}


def evaluation_steps(
    config: RunConfig, folder: Path, baselines: Sequence[str] | None = None, episodes: int | None = None
) -> int:
    """Return how many decisions `judge` makes at most."""
    chosen = config.evaluation
    drivers = drivers_to_compare(config, folder, chosen.baselines if baselines is None else baselines)
    return len(drivers) * (episodes or chosen.episodes) * config.make_scenario().horizon


def evaluate_run(
    folder: Path,
    config: RunConfig,
    workers: WorkerPool,
    baselines: Sequence[str] | None = None,
    episodes: int | None = None,
    progress: EvaluationProgress | None = None,
    out: Path | None = None,
) -> Evaluation:
    """Evaluate a run's controller beside others on the same held-out seeds, and save it all in its folder.

    `baselines` and `episodes` are the configuration's where they are not given; with `out` that is the folder
    where it is saved.
    """
    scenario = config.make_scenario()
    drivers = drivers_to_compare(config, folder, config.evaluation.baselines if baselines is None else baselines)
    seeds = make_test_seeds(episodes or config.evaluation.episodes)
    found = evaluate(scenario, drivers, seeds, workers, config.reward, progress)
    about = {
        "scenario": Path(config.scenario).name,
        "reward": config.reward or scenario.reward,
        "trained": TRAINED_LABEL,
        "expert": config.make_expert().describe() if config.expert != "none" else "none",
        "controllers": _controller_hashes({TRAINED_LABEL: str(folder)}),
        "notes": episode_notes(found.rows),
        "manifest": manifest(),
    }
    target = out or folder
    if (target / EVALUATION_FILE).is_file():  # what was judged before is not written over by less
        raise_failure(found.rows[TRAINED_LABEL])
    save_evaluation(target, found, about)
    raise_failures(found)
    return found


def gain_over_expert(config: RunConfig, rows: RowsByDriver) -> Estimate | None:
    """Return what the trained controller earns beyond its expert, same seeds paired."""
    if config.expert == "none":
        return None
    return paired_difference(rows[TRAINED_LABEL], rows[config.make_expert().describe()], "return")


def _lacks_acc(driver: Driver, scenario: Scenario) -> bool:
    """Whether a driver is told of the road ahead to hold back an ACC which CAVs have not got."""
    told = "lane_speeds" in driver.input_fields and "lane_speeds" in scenario.provided_fields
    return told and scenario.actuation != "cruise"


def _controller_hashes(controllers: dict[str, str]) -> dict[str, str]:
    """Return the hashes of the files that were judged, by the driver's label; others are none."""
    found = {label: controller_hash(text) for label, text in controllers.items()}
    return {label: sha256 for label, sha256 in found.items() if sha256}


def drive(
    scenario: str = "ring",
    driver: str | DriverLike | Sequence[str | DriverLike] = "pi",
    episodes: int = 5,
    seed: int = 0,
    scenario_options: dict[str, Any] | None = None,
    reward: str = "",
    workers: int | None = None,
    out: Path | str | None = None,
    progress: Callable[[Any, int], None] | None = None,
    test_seeds: bool = False,
) -> DriveResult:
    """Run episodes and measure them.

    Args:
        scenario: its name.
        driver: a name (`pi`), with parameters (`pi:window=30`), your own (`path.py:name`), a run folder, a
            `.unjam` file; a driver, a function of the state or an object with `act` and `initial_memory`,
            which drive in this process; or a list of them, to be compared on the same traffic.
        episodes: of each driver; they have the seeds `seed`, `seed + 1`, ...
        seed: of the first episode.
        road: changes to the scenario's parameters, e.g. `{"length": 230}` or `{"length": (220, 270)}`.
        reward: a name or `path.py:name`; empty: the scenario's own.
        workers: processes; all cores by default. The result does not depend on it.
        out: folder for the results and a report.html; None: nothing is written.
        progress: told now and then how many decisions an episode has made.
        held_out: on the seeds that judge trainings, instead of `seed` and those after it.

    Raises:
        InputError: something is wrong with the arguments; nothing was started.
    """
    for name, number, least in (("episodes", episodes, 1), ("seed", seed, 0), ("workers", workers, 1)):
        if number is not None and number < least:
            raise invalid_value(name, number, f">= {least}")
    if seed + episodes > TRAINING_SEED_LIMIT:
        raise invalid_value("seed", seed, f"<= {TRAINING_SEED_LIMIT - episodes}: those above choose or judge")
    if test_seeds and seed:
        raise invalid_value("seed", seed, "none with held-out seeds")
    made = make_scenario(scenario, scenario_options)
    drivers: dict[str, Driver] = {}
    if isinstance(driver, str) or not isinstance(driver, Sequence):
        driver = [driver]
    for entry in driver:
        if isinstance(entry, str):
            drivers[entry] = make_driver(entry, made.control_step)
        else:
            one = as_driver(entry)
            drivers[unique_label(one, drivers)] = one
    if not drivers:
        raise invalid_value("driver", driver, driver_names())
    make_reward(reward or made.reward)
    folder = Path(out) if out is not None else None
    seeds = make_test_seeds(episodes) if test_seeds else [(seed + index,) for index in range(episodes)]
    pool = WorkerPool(min(workers or os.cpu_count() or 1, episodes * len(drivers)))
    with lock_new_folder(folder) if folder is not None else nullcontext(), pool:
        found = evaluate(made, drivers, seeds, pool, reward, progress)
        report, notes = None, controller_notes(scenario_recipe(made), drivers, found.plot_episodes)
        notes += [f"{name} {MISSING_ACC_NOTE}" for name, one in drivers.items() if _lacks_acc(one, made)]
        notes = [*episode_notes(found.rows), *notes, *made.notes]
        ran = any(row["status"] != "failed" for rows in found.rows.values() for row in rows)
        if folder is not None and ran:
            about = {"scenario": Path(scenario).name, "reward": reward or made.reward, "manifest": manifest()}
            named = {label: label for label in drivers}
            save_evaluation(folder, found, {**about, "controllers": _controller_hashes(named), "notes": notes})
            from unjam.reports.html import write_report_page  # draws: so late that what is wrong is told at once

            report = write_report_page([folder], folder / "report.html")
    kept = folder if ran else None  # there is nothing to look at
    return DriveResult(scenario, found.rows, kept, report, found.plot_episodes, notes)
