"""Evaluation: several drivers on the same seeds, measured and saved for reports.

`unjam drive` takes any drivers and seeds; the controller of a run is compared with others on test seeds.
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

MISSING_ACC_NOTE = "limits the ACC of a CAV, but CAVs have none: --set actuation=cruise --set safety.active=false"
TRAINED_LABEL = "trained"
"""label of the trained controller in tables and figures"""
EvaluationProgress = Callable[[tuple[str, int], int], None]
"""called repeatedly with (label of the driver, index of its episode) and the control steps so far"""


@dataclass(frozen=True)
class Evaluation:
    """Several drivers on the same episodes."""

    rows: RowsByDriver
    plot_episodes: dict[str, Episode] = field(repr=False)
    """by driver: the episode for figures, the same seed for all"""

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
    setups = {label: (scenario, driver) for label, driver in drivers.items()}
    return evaluate_on_roads(setups, seeds, workers, reward, progress)


def evaluate_on_roads(
    drivers: dict[str, tuple[Scenario, Driver]],
    seeds: Sequence[tuple[int, ...]],
    workers: WorkerPool,
    reward: str = "",
    progress: EvaluationProgress | None = None,
    with_plots: bool = True,
) -> Evaluation:
    """Run every driver, each on its own road, on every seed, and measure.

    With `with_plots` one episode of each is kept for figures, which needs much memory.
    """
    pairs = [(label, index) for index in range(len(seeds)) for label in drivers]
    settings: dict[str, Any] = {"reward": reward, "record_details": True, "stop_at_contact": False}
    tasks = [EpisodeTask(*drivers[label], seeds[index], **settings) for label, index in pairs]

    def on_progress(task: int, steps: int) -> None:
        if progress is not None:
            progress(pairs[task], steps)

    def measure_task(task: int, episode: Episode) -> tuple[dict[str, Any], Episode | None]:
        _, index = pairs[task]
        return measure(episode), episode if with_plots and index == 0 and episode.has_run else None

    remote = [index for index, (label, _) in enumerate(pairs) if is_serializable(drivers[label][1])]
    measured = workers.run_and_map(
        [tasks[index] for index in remote],
        lambda number, episode: measure_task(remote[number], episode),
        lambda number, steps: on_progress(remote[number], steps),
    )
    results = dict(zip(remote, measured, strict=True))
    results |= _run_in_process(tasks, results.keys(), measure_task, on_progress)
    rows: RowsByDriver = {label: [] for label in drivers}
    plot_episodes: dict[str, Episode] = {}
    for index, (label, _) in enumerate(pairs):
        row, episode = results[index]
        rows[label].append(row)
        if episode is not None:
            plot_episodes[label] = episode
    return Evaluation(rows, plot_episodes)


def _run_in_process(
    tasks: Sequence[EpisodeTask],
    finished: Container[int],
    process: Callable[[int, Episode], Any],
    on_progress: Callable[[int, int], None],
) -> dict[int, Any]:
    """Run the tasks that are not `finished` in this process; return the results of `process` by index."""
    remaining = {index: task for index, task in enumerate(tasks) if index not in finished}
    if not remaining:
        return {}
    results: dict[int, Any] = {}
    with open_simulation(*(task.scenario for task in remaining.values())) as simulation:
        for index, task in remaining.items():
            episode = run_episode(
                *(task.scenario, task.driver, task.seed, task.reward, task.explore, task.record_details),
                simulation=simulation,
                on_progress=partial(on_progress, index),
                stop_at_contact=task.stop_at_contact,
            )
            results[index] = process(index, episode)
    return results


def raise_failure(rows: Sequence[dict[str, Any]]) -> None:
    """Raise the first failure among the rows of episodes, as the original kind of error."""
    for row in rows:
        if row["status"] == "failed":
            seed = "" if row["error"] == InputError.__name__ else f" (seed {row['seed']})"
            raise error_from_name(row["error"], f"{row['reason']}{seed}")


def raise_failures(result: "Evaluation | DriveResult") -> None:
    """Raise the first failure among the episodes of a result, if any."""
    raise_failure([row for rows in result.rows.values() for row in rows])


def save_evaluation(folder: Path, evaluation: Evaluation, metadata: dict[str, Any]) -> None:
    """Write an evaluation into a folder, for reports.

    `evaluation.json` has `metadata` and rows, `episodes.parquet` the rows as a table, and `plot_episodes.safetensors`
    the episodes for figures.
    """
    make_folder(folder)
    rows = [{"driver": label, **row} for label, of_driver in evaluation.rows.items() for row in of_driver]
    episodes = [to_plot_episode(label, episode) for label, episode in evaluation.plot_episodes.items()]
    arrays = {
        f"{index}.{name}": array for index, each in enumerate(episodes) for name, array in pack_episode(each).items()
    }
    entries = [{"driver": each.driver, **{name: getattr(each, name) for name in EPISODE_ENTRIES}} for each in episodes]
    atomic_write(folder / "plot_episodes.safetensors", save(arrays))
    atomic_write(folder / "episodes.parquet", rows_to_frame(evaluation.rows).to_parquet())
    atomic_write(folder / EVALUATION_FILE, to_json({**metadata, "rows": rows, "plot_episodes": entries}, indent=1))


def drivers_to_compare(config: RunConfig, folder: Path, baselines: Sequence[str]) -> dict[str, Driver]:
    """Return the drivers to compare, by label: the baselines, the run's expert, its trained controller."""
    scenario = config.make_scenario()
    expert = {} if config.expert == "none" else {(made := config.make_expert()).describe(): made}
    drivers: dict[str, Driver] = {}
    for name in baselines:
        driver = make_driver(name, scenario.control_step)
        if can_drive(driver, scenario):
            # The description of a packaged driver has all tuned parameters: its name is shorter.
            is_packaged = name.startswith(PACKAGED_PREFIX) and name != config.expert
            drivers[name if is_packaged else unique_label(driver, {**expert, **drivers})] = driver
    return {**drivers, **expert, TRAINED_LABEL: make_driver(str(folder), scenario.control_step)}


def evaluation_steps(
    config: RunConfig, folder: Path, baselines: Sequence[str] | None = None, episodes: int | None = None
) -> int:
    """Return the largest number of control steps of `evaluate_run`."""
    settings = config.evaluation
    drivers = drivers_to_compare(config, folder, settings.baselines if baselines is None else baselines)
    return len(drivers) * (episodes or settings.episodes) * config.make_scenario().horizon


def evaluate_run(
    folder: Path,
    config: RunConfig,
    workers: WorkerPool,
    baselines: Sequence[str] | None = None,
    episodes: int | None = None,
    progress: EvaluationProgress | None = None,
    out: Path | None = None,
) -> Evaluation:
    """Evaluate a run's controller and others on the same test seeds, and save the results in its folder or in `out`.

    `baselines` and `episodes` are those of the configuration by default.
    """
    scenario = config.make_scenario()
    drivers = drivers_to_compare(config, folder, config.evaluation.baselines if baselines is None else baselines)
    seeds = make_test_seeds(episodes or config.evaluation.episodes)
    evaluation = evaluate(scenario, drivers, seeds, workers, config.reward, progress)
    metadata = {
        "scenario": Path(config.scenario).name,
        "reward": config.reward or scenario.reward,
        "trained": TRAINED_LABEL,
        "expert": config.make_expert().describe() if config.expert != "none" else "none",
        "controllers": _controller_hashes({TRAINED_LABEL: str(folder)}),
        "notes": episode_notes(evaluation.rows),
        "manifest": manifest(),
    }
    target = out or folder
    if (target / EVALUATION_FILE).is_file():  # a failure must not overwrite earlier results
        raise_failure(evaluation.rows[TRAINED_LABEL])
    save_evaluation(target, evaluation, metadata)
    raise_failures(evaluation)
    return evaluation


def gain_over_expert(config: RunConfig, rows: RowsByDriver) -> Estimate | None:
    """Return the paired difference of return between the trained controller and its expert; None without one."""
    if config.expert == "none":
        return None
    return paired_difference(rows[TRAINED_LABEL], rows[config.make_expert().describe()], "return")


def _lacks_acc(driver: Driver, scenario: Scenario) -> bool:
    """Return whether a driver uses the speeds ahead to limit the ACC of CAVs on a road where they have none."""
    uses_lane_speeds = "lane_speeds" in driver.input_fields and "lane_speeds" in scenario.provided_fields
    return uses_lane_speeds and scenario.actuation != "cruise"


def _controller_hashes(controllers: dict[str, str]) -> dict[str, str]:
    """Return the hashes of the controller files by the label of the driver."""
    return {label: sha256 for label, text in controllers.items() if (sha256 := controller_hash(text))}


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
        driver: a name (`pi`), with parameters (`pi:window=30`), your own (`path.py:name`), a run folder, a `.unjam`
            file; a driver, a function of the state or an object with `act` and `initial_memory`, which run in this
            process; or a list of them, to be compared on the same traffic.
        episodes: number for each driver; they have the seeds `seed`, `seed + 1`, ...
        seed: of the first episode.
        scenario_options: changes to the scenario, e.g. `{"length": 230}` or `{"length": (220, 270)}`.
        reward: a name or `path.py:name`; empty: the scenario's own.
        workers: processes; all cores by default. The result does not depend on it.
        out: folder for the results and a report.html; None: nothing is written.
        progress: called repeatedly with ((driver, episode), control steps so far).
        test_seeds: whether to use the test seeds instead of `seed` and the following ones.

    Raises:
        InputError: an argument is wrong; nothing was started.
    """
    for name, number, minimum in (("episodes", episodes, 1), ("seed", seed, 0), ("workers", workers, 1)):
        if number is not None and number < minimum:
            raise invalid_value(name, number, f">= {minimum}")
    if seed + episodes > TRAINING_SEED_LIMIT:
        raise invalid_value("seed", seed, f"<= {TRAINING_SEED_LIMIT - episodes}: larger ones are reserved")
    if test_seeds and seed:
        raise invalid_value("seed", seed, "none with test seeds")
    road = make_scenario(scenario, scenario_options)
    drivers: dict[str, Driver] = {}
    for entry in [driver] if isinstance(driver, str) or not isinstance(driver, Sequence) else driver:
        if isinstance(entry, str):
            drivers[entry] = make_driver(entry, road.control_step)
        else:
            made = as_driver(entry)
            drivers[unique_label(made, drivers)] = made
    if not drivers:
        raise invalid_value("driver", driver, driver_names())
    make_reward(reward or road.reward)
    folder, report = Path(out) if out is not None else None, None
    seeds = make_test_seeds(episodes) if test_seeds else [(seed + index,) for index in range(episodes)]
    pool = WorkerPool(min(workers or os.cpu_count() or 1, episodes * len(drivers)))
    with lock_new_folder(folder) if folder is not None else nullcontext(), pool:
        evaluation = evaluate(road, drivers, seeds, pool, reward, progress)
        notes = [
            *episode_notes(evaluation.rows),
            *controller_notes(scenario_recipe(road), drivers, evaluation.plot_episodes),
            *(f"{name} {MISSING_ACC_NOTE}" for name, one in drivers.items() if _lacks_acc(one, road)),
            *road.notes,
        ]
        has_results = any(row["status"] != "failed" for rows in evaluation.rows.values() for row in rows)
        if folder is not None and has_results:
            metadata = {"scenario": Path(scenario).name, "reward": reward or road.reward, "manifest": manifest()}
            hashes = _controller_hashes({label: label for label in drivers})
            save_evaluation(folder, evaluation, {**metadata, "controllers": hashes, "notes": notes})
            from unjam.reports.html import write_report_page  # imported late: it draws

            report = write_report_page([folder], folder / "report.html")
    used_folder = folder if has_results else None
    return DriveResult(scenario, evaluation.rows, used_folder, report, evaluation.plot_episodes, notes)
