"""Evaluation: several drivers on the same seeds, measured and saved for reports, or as tables and in a notebook.

`unjam drive` takes any drivers and seeds; the controller of a run is compared with others on test seeds.
"""

import os
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from safetensors.numpy import save

from unjam.controller import PACKAGED_PREFIX, controller_hash, make_driver
from unjam.controller.domain import controller_notes
from unjam.drivers.driver import Driver
from unjam.drivers.registry import driver_names, unique_label
from unjam.drivers.user_driver import DriverLike, as_driver
from unjam.errors import InputError, error_from_name, invalid_value, unknown_name
from unjam.files import FileWatch, atomic_write, make_folder, remove_leftovers, sha256_of, to_json
from unjam.manifest import manifest
from unjam.measures.effect import effects_by_driver
from unjam.measures.feasibility import feasibility_by_driver
from unjam.measures.metric_table import RowsByDriver, choose_baseline, in_order
from unjam.measures.metrics import METRICS, measure
from unjam.measures.notes import count_early_ends, episode_notes
from unjam.measures.statistics import Estimate, paired_difference, summarize
from unjam.measures.verdict import metric_frame, short_table_metrics, verdicts
from unjam.parameters import check_integer
from unjam.reports.results import (
    EPISODE_ENTRIES,
    EVALUATION_FILE,
    PLOT_EPISODES_FILE,
    PLOT_EPISODES_HASH,
    pack_episode,
    to_plot_episode,
)
from unjam.scenarios import make_scenario, scenario_recipe
from unjam.scenarios.scenario import Scenario
from unjam.seeds import TRAINING_SEED_LIMIT, held_out_seeds
from unjam.training.config import RunConfig
from unjam.training.run_folder import lock_new_folder
from unjam.worlds.backend import BackendLike, backend_notes, check_support, open_backend
from unjam.worlds.checked_world import backend_label
from unjam.worlds.episode import can_drive, check_can_drive, run_episode
from unjam.worlds.record import Episode
from unjam.worlds.reward import RewardLike, make_reward, reward_label
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

if TYPE_CHECKING:  # imported late, so that commands start quickly
    import pandas as pd
    from matplotlib.figure import Figure

EFFECT_ENTRIES = ("travel_time", "delay_reduction", "speed", "flow", "fuel", "hard_braking")
MISSING_ACC_NOTE = "limits the ACC of a CAV, but CAVs have none: --set actuation=cruise --set safety.active=false"
TRAINED_LABEL = "trained"
"""label of the trained controller in tables and figures"""
EvaluationProgress = Callable[[tuple[str, int], int], None]
"""called repeatedly with (label of the driver, index of its episode) and the control steps so far"""


@dataclass(frozen=True)
class Evaluation:
    """Several drivers on the same episodes."""

    rows: RowsByDriver = field(repr=False)
    """by driver: a row of metrics per episode"""
    plot_episodes: dict[str, Episode] = field(default_factory=dict, repr=False)
    """by driver: the episode for figures, the same seed for all"""

    def summary(self, driver: str) -> dict[str, Estimate]:
        """Return the mean and 95 % CI of every metric for a driver."""
        return summarize(self.rows[driver])

    def means(self) -> dict[str, dict[str, float]]:
        """Return the mean of each metric, by driver."""
        return {label: {name: each.mean for name, each in self.summary(label).items()} for label in self.rows}


@dataclass(frozen=True)
class DriveResult(Evaluation):
    """Episodes of one or several drivers on the same traffic, and the files with them."""

    scenario: str = ""
    backend: str = "sumo"
    folder: Path | None = None
    report: Path | None = None
    notes: list[str] = field(default_factory=list)
    """caveats, as controllers on a road that they were not made for"""
    baseline: str = ""
    """label of the driver that the others are compared with; empty: human drivers, or else the best expert"""
    first_driver: str = ""
    """label of the driver that was given first; empty: that of the first rows"""

    @property
    def mean(self) -> dict[str, float]:
        """Mean of every metric over the episodes of the driver that was given first."""
        return self.means()[self.first_driver or next(iter(self.rows))]

    def table(self, brief: bool = False) -> "pd.DataFrame":
        """Return a row per metric with the mean and both ends of the 95 % CI of each driver; `brief`: what matters.

        `result.table().loc["mean_speed", ("pi", "mean")]` is one number.
        """
        import pandas as pd

        names = short_table_metrics(self.rows) if brief else tuple(METRICS)
        summaries = {label: self.summary(label) for label in self.rows}
        numbers = {
            (label, part): [getattr(summary[name], part) for name in names]
            for label, summary in summaries.items()
            for part in ("mean", "low", "high")
        }
        frame = pd.DataFrame(numbers, index=pd.Index(names, name="metric"))
        return frame.rename_axis(columns=("driver", None))

    def episodes(self) -> "pd.DataFrame":
        """Return a row per episode and driver, with seed, status and every metric."""
        return rows_to_frame(self.rows)

    def __str__(self) -> str:
        """Return the verdicts and the table of the metrics that matter, for `print`."""
        lines = (line for each in verdicts(self.rows, self.baseline) for line in each.lines)
        return "\n".join([*lines, metric_frame(self.rows).to_string(index=False)])

    def _repr_html_(self) -> str:
        """Return the verdicts, the metrics that matter, and the trajectories of all vehicles, for notebooks."""
        from unjam.reports.figures import data_uri

        lines = ("<br>".join(map(escape, each.lines)) for each in verdicts(self.rows, self.baseline))
        table = "".join(f"<p>{text}</p>" for text in lines) + metric_frame(self.rows).to_html(index=False, border=0)
        if not self.plot_episodes:
            return table
        attributes = 'style="max-width: 100%" alt="every vehicle over time, dark is slow"'
        return f'{table}<img {attributes} src="{data_uri(self.plot())}">'

    def plot(self, kind: Literal["space-time", "time-series"] = "space-time") -> "Figure":
        """Return a figure of an episode of each driver: positions and speeds of all vehicles, or quantities over time.

        Raise `InputError` if all episodes failed, or for another `kind`.
        """
        from unjam.reports.figures import time_series_figure
        from unjam.reports.space_time import space_time_figure

        figures = {"space-time": space_time_figure, "time-series": time_series_figure}
        if kind not in figures:
            raise unknown_name("kind", kind, figures)
        if not self.plot_episodes:
            raise InputError("plot: all episodes failed; allowed: results with an episode")
        return figures[kind]([to_plot_episode(label, each) for label, each in self.plot_episodes.items()])

    def document(self) -> dict[str, Any]:
        """Return the result as `unjam drive --json` prints it, with a document for each driver, also for one."""
        feasible, effects = feasibility_by_driver(self.rows), effects_by_driver(self.rows)
        baseline, documents = choose_baseline(self.rows, self.baseline), list[dict[str, Any]]()
        for driver, rows in self.rows.items():
            summary, effect, differences = self.summary(driver), effects.get(driver), None
            if baseline and driver != baseline:
                paired = {name: paired_difference(rows, self.rows[baseline], name) for name in METRICS}
                differences = {name: [each.mean, each.low, each.high] for name, each in paired.items()}
            effects_by_entry = {name: getattr(effect, name) for name in EFFECT_ENTRIES} if effect else {}
            documents.append(
                {
                    "scenario": self.scenario,
                    "backend": self.backend,
                    "driver": driver,
                    "feasibility": feasible[driver],
                    "episodes": rows,
                    "mean": {name: summary[name].mean for name in METRICS},
                    "ci95": {name: [summary[name].low, summary[name].high] for name in METRICS},
                    "effect": {name: [each.mean, each.low, each.high] for name, each in effects_by_entry.items()}
                    or None,
                    "early_ends": count_early_ends(rows),
                    "notes": self.notes,
                    "folder": str(self.folder) if self.folder else None,
                    "report": str(self.report) if self.report else None,
                    "baseline": baseline or None,
                    "difference_to_baseline": differences,
                }
            )
        return {"scenario": self.scenario, "drivers": documents}


def rows_to_frame(rows_by_driver: RowsByDriver) -> "pd.DataFrame":
    """Return a row per episode and driver: `driver`, `seed` as text, `status`, and every metric."""
    import pandas as pd

    return pd.DataFrame(
        [{"driver": label, **row, "seed": str(row["seed"])} for label, rows in rows_by_driver.items() for row in rows]
    ).drop(columns="warnings", errors="ignore")


def evaluate(
    scenario: Scenario,
    drivers: dict[str, Driver],
    seeds: Sequence[tuple[int, ...]],
    workers: WorkerPool,
    reward: RewardLike = "",
    progress: EvaluationProgress | None = None,
    backend: BackendLike = "sumo",
) -> Evaluation:
    """Run every driver on every seed, and measure."""
    setups = {label: (scenario, driver) for label, driver in drivers.items()}
    return evaluate_on_roads(setups, seeds, workers, reward, progress, backend=backend)


def evaluate_on_roads(
    drivers: dict[str, tuple[Scenario, Driver]],
    seeds: Sequence[tuple[int, ...]],
    workers: WorkerPool,
    reward: RewardLike = "",
    progress: EvaluationProgress | None = None,
    with_plots: bool = True,
    backend: BackendLike = "sumo",
    watch: FileWatch | None = None,
) -> Evaluation:
    """Run every driver, each on its own road, on every seed, and measure; `with_plots` keeps an episode of each."""
    settings: dict[str, Any] = {"reward": reward, "backend": backend}
    settings |= {"record_details": True, "stop_at_contact": False}
    pairs = [(label, index) for index in range(len(seeds)) for label in drivers]
    tasks = {(label, index): EpisodeTask(*drivers[label], seeds[index], **settings) for label, index in pairs}
    remote = [pair for pair in pairs if tasks[pair].is_serializable]
    local = [pair for pair in pairs if not tasks[pair].is_serializable]
    watch = watch or FileWatch(lambda: {file for scenario, _ in drivers.values() for file in scenario.user_files})
    on_progress = progress or (lambda pair, steps: None)

    def measure_task(pair: tuple[str, int], episode: Episode) -> tuple[dict[str, Any], Episode | None]:
        watch.check()
        return measure(episode), episode if with_plots and pair[1] == 0 and episode.has_run else None

    measured = workers.run_and_map(
        [tasks[pair] for pair in remote],
        lambda index, episode: measure_task(remote[index], episode),
        lambda index, steps: on_progress(remote[index], steps),
    )
    results = dict(zip(remote, measured, strict=True))
    with open_backend(backend) if local else nullcontext(backend) as opened:
        for pair in local:
            task = replace(tasks[pair], backend=opened)
            results[pair] = measure_task(pair, run_episode(**vars(task), on_progress=partial(on_progress, pair)))
    rows = {label: [results[label, index][0] for index in range(len(seeds))] for label in drivers}
    first_episodes = {label: results[label, 0][1] for label in drivers if seeds}
    return Evaluation(rows, {label: each for label, each in first_episodes.items() if each is not None})


def raise_failure(rows: Sequence[dict[str, Any]]) -> None:
    """Raise the first failure among the rows of episodes, as the original kind of error."""
    for row in rows:
        if row["status"] == "failed":
            seed = "" if row["error"] == InputError.__name__ else f" (seed {row['seed']})"
            raise error_from_name(row["error"], f"{row['reason']}{seed}")


def raise_failures(result: Evaluation) -> None:
    """Raise the first failure among the episodes of a result, if any."""
    raise_failure([row for rows in result.rows.values() for row in rows])


def save_evaluation(folder: Path, evaluation: Evaluation, metadata: dict[str, Any]) -> None:
    """Write an evaluation into a folder, for reports.

    `evaluation.json` has `metadata` and rows, `episodes.parquet` the rows as a table, and `plot_episodes.safetensors`
    the episodes for figures. Where these replace others, a process that is killed may leave some of each: so the first
    has the hash of the last.
    """
    make_folder(folder)
    remove_leftovers(folder)
    rows = [{"driver": label, **row} for label, of_driver in evaluation.rows.items() for row in of_driver]
    episodes = [to_plot_episode(label, episode) for label, episode in evaluation.plot_episodes.items()]
    arrays = {
        f"{index}.{name}": array for index, each in enumerate(episodes) for name, array in pack_episode(each).items()
    }
    entries = [{"driver": each.driver, **{name: getattr(each, name) for name in EPISODE_ENTRIES}} for each in episodes]
    packed = save(arrays)
    document = {**metadata, "rows": rows, "plot_episodes": entries, PLOT_EPISODES_HASH: sha256_of(packed)}
    atomic_write(folder / PLOT_EPISODES_FILE, packed)
    atomic_write(folder / "episodes.parquet", rows_to_frame(evaluation.rows).to_parquet())
    atomic_write(folder / EVALUATION_FILE, to_json(document, indent=1))


def drivers_to_compare(config: RunConfig, folder: Path) -> dict[str, Driver]:
    """Return the drivers to compare, by label: the baselines, the run's expert, its trained controller."""
    scenario = config.make_scenario()
    expert = {} if config.expert == "none" else {(made := config.make_expert()).describe(): made}
    drivers: dict[str, Driver] = {}
    for name in config.evaluation.baselines:
        driver = make_driver(name, scenario.control_step)
        if can_drive(driver, scenario):
            # The description of a packaged driver has all tuned parameters: its name is shorter.
            is_packaged = name.startswith(PACKAGED_PREFIX) and name != config.expert
            drivers[name if is_packaged else unique_label(driver, {**expert, **drivers})] = driver
    return in_order({**drivers, **expert, TRAINED_LABEL: make_driver(str(folder), scenario.control_step)})


def evaluation_steps(config: RunConfig, folder: Path) -> int:
    """Return the largest number of control steps of `evaluate_run`."""
    episodes = len(drivers_to_compare(config, folder)) * config.evaluation.episodes
    return episodes * config.make_scenario().max_episode_steps


def evaluate_run(
    folder: Path,
    config: RunConfig,
    workers: WorkerPool,
    progress: EvaluationProgress | None = None,
    out: Path | None = None,
    notes: Sequence[str] = (),
) -> Evaluation:
    """Evaluate a run's controller and others on the same test seeds, and save the results in its folder or in `out`.

    `config.evaluation` may be another than that of the run. The `notes` are stored before all others.
    """
    scenario, drivers = config.make_scenario(), drivers_to_compare(config, folder)
    hashes = _controller_hashes({TRAINED_LABEL: str(folder)})  # now: files may change while episodes run
    seeds = held_out_seeds(config.evaluation.episodes)
    evaluation = evaluate(scenario, drivers, seeds, workers, config.reward, progress, config.episode_backend)
    metadata = {
        "scenario": Path(config.scenario).name,
        "reward": config.reward or scenario.reward,
        "backend": config.episode_backend,
        "trained": TRAINED_LABEL,
        "expert": config.make_expert().describe() if config.expert != "none" else "none",
        "controllers": hashes,
        "notes": [
            *notes,
            *episode_notes(evaluation.rows),
            *backend_notes(config.episode_backend, scenario),
            *scenario.notes,
            *scenario.training_notes,
        ],
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
    road = scenario.interface
    uses_lane_speeds = "lane_speeds" in driver.requirements(road).input_fields and "lane_speeds" in road.provided_fields
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
    reward: RewardLike = "",
    workers: int | None = None,
    out: Path | str | None = None,
    progress: Callable[[Any, int], None] | None = None,
    test_seeds: bool = False,
    backend: BackendLike = "sumo",
    baseline: str = "",
) -> DriveResult:
    """Run episodes and measure them.

    Args:
        scenario: its name.
        driver: a name (`pi`), with parameters (`pi:window=30`), your own (`path.py:name`), a run folder, a `.unjam`
            file; a driver, a function of the state, an object with `act` and `initial_memory` or a class of such
            objects, which run in this process; or a list of them, to be compared on the same traffic.
        episodes: number for each driver; they have the seeds `seed`, `seed + 1`, ...
        seed: of the first episode.
        scenario_options: changes to the scenario, e.g. `{"length": 230}` or `{"length": (220, 270)}`.
        reward: a name or `path.py:name`; a function of an `Outcome`, with which all episodes run in this process;
            empty: the scenario's own.
        workers: processes; all cores by default. The result does not depend on it.
        out: folder for the results and a report.html; None: nothing is written.
        progress: called repeatedly with ((driver, episode), control steps so far).
        test_seeds: whether to use the test seeds instead of `seed` and the following ones.
        backend: the simulator: `sumo`, `batch`, `path.py:name`, or an object, with which all episodes run in this
            process.
        baseline: label of the driver that the others are compared with; empty: human drivers, or else the best expert.

    Raises:
        InputError: an argument is wrong; nothing was started.
    """
    counts = ("episodes", episodes, 1), ("seed", seed, 0), ("workers", 1 if workers is None else workers, 1)
    for name, number, minimum in counts:
        check_integer(name, number, minimum)
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
            made = as_driver(entry, road.control_step)
            drivers[unique_label(made, drivers)] = made
    hashes = _controller_hashes({label: label for label in drivers})  # now: files may change while episodes run
    for name, one in drivers.items():
        check_can_drive(one, road, f"driver {name}")
    if not drivers:
        raise invalid_value("driver", driver, driver_names())
    if baseline and baseline not in drivers:
        raise unknown_name("baseline", baseline, drivers)
    make_reward(reward or road.reward)
    with open_backend(backend) as simulator:
        check_support(simulator, road)
    folder, report = Path(out) if out is not None else None, None
    seeds = held_out_seeds(episodes) if test_seeds else [(seed + index,) for index in range(episodes)]
    pool = WorkerPool(min(workers or os.cpu_count() or 1, episodes * len(drivers)))
    with lock_new_folder(folder) if folder is not None else nullcontext(), pool:
        evaluation = evaluate(road, in_order(drivers), seeds, pool, reward, progress, backend)
        notes = [
            *episode_notes(evaluation.rows),
            *controller_notes(scenario_recipe(road), drivers, evaluation.plot_episodes),
            *(f"{name} {MISSING_ACC_NOTE}" for name, one in drivers.items() if _lacks_acc(one, road)),
            *backend_notes(backend, road),
            *road.notes,
        ]
        has_results = any(row["status"] != "failed" for rows in evaluation.rows.values() for row in rows)
        if folder is not None and has_results:
            name = reward_label(reward or road.reward)
            metadata = {"scenario": Path(scenario).name, "reward": name, "backend": backend_label(backend)}
            contents = {"manifest": manifest(), "controllers": hashes, "notes": notes, "baseline": baseline}
            save_evaluation(folder, evaluation, {**metadata, **contents})
            from unjam.reports.html import write_report_page  # imported late: it draws

            report = write_report_page([folder], folder / "report.html")
    used_folder = folder if has_results else None
    made_by = scenario, backend_label(backend)
    details = used_folder, report, notes, baseline, next(iter(drivers))
    return DriveResult(evaluation.rows, evaluation.plot_episodes, *made_by, *details)
