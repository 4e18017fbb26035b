"""Evaluate several drivers on the same seeds, for instance the controller of a run, and save the results."""

from collections.abc import Callable, Collection, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors.numpy import save

from unjam.controller import PACKAGED_PREFIX, controller_hash, make_driver
from unjam.drivers.driver import Driver
from unjam.drivers.registry import unique_label
from unjam.errors import InputError, raise_failure
from unjam.files import FileWatch, atomic_write, make_folder, remove_leftovers, sha256_of, to_json
from unjam.manifest import manifest
from unjam.measures.metric_table import RowsByDriver, order_by_rank
from unjam.measures.metrics import measure
from unjam.measures.notes import episode_notes
from unjam.measures.statistics import Estimate, paired_difference, summarize
from unjam.reports.results import (
    CONTROLLER_FILE,
    EPISODE_ENTRIES,
    EVALUATION_FILE,
    PLOT_EPISODES_FILE,
    PLOT_EPISODES_HASH,
    pack_episode,
    to_plot_episode,
    weights_id,
)
from unjam.scenarios.file_watch import watch_files
from unjam.scenarios.scenario import Scenario
from unjam.seeds import held_out_seeds
from unjam.training.config import RunConfig
from unjam.worlds.backend import BackendLike, backend_notes, open_backend
from unjam.worlds.episode import can_drive, run_episode
from unjam.worlds.record import Episode
from unjam.worlds.reward import RewardLike
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

if TYPE_CHECKING:  # imported late, so that commands start quickly
    import pandas as pd

TRAINED_LABEL = "trained"
"""label of the trained controller in tables and figures"""
DriverAndEpisode = tuple[str, int]
"""label of a driver, and index of an episode"""
EvaluationProgress = Callable[[DriverAndEpisode, int], None]
"""called repeatedly with an episode and its control steps so far"""


@dataclass(frozen=True)
class Evaluation:
    """Results of several drivers on the same seeds."""

    rows: RowsByDriver = field(repr=False)
    """rows of metrics by driver, one per episode"""
    plot_episodes: dict[str, Episode] = field(default_factory=dict, repr=False)
    """episode for figures by driver, with the same seed for all drivers"""

    def summary(self, driver: str) -> dict[str, Estimate]:
        """Return the mean and 95 % CI of every metric for a driver."""
        return summarize(self.rows[driver])

    def means(self) -> dict[str, dict[str, float]]:
        """Return the mean of each metric, by driver."""
        return {label: {name: estimate.mean for name, estimate in self.summary(label).items()} for label in self.rows}


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
    watch: FileWatch | None = None,
) -> Evaluation:
    """Run every driver on every seed, and measure the episodes."""
    setups = {label: (scenario, driver) for label, driver in drivers.items()}
    return evaluate_on_roads(setups, seeds, workers, reward, progress, backend=backend, watch=watch)


def evaluate_on_roads(
    drivers: dict[str, tuple[Scenario, Driver]],
    seeds: Sequence[tuple[int, ...]],
    workers: WorkerPool,
    reward: RewardLike = "",
    progress: EvaluationProgress | None = None,
    with_plots: bool = True,
    backend: BackendLike = "sumo",
    watch: FileWatch | None = None,
    skipped: Collection[DriverAndEpisode] = (),
    on_row: Callable[[DriverAndEpisode, dict[str, Any]], None] = lambda pair, row: None,
) -> Evaluation:
    """Run every driver on its own road with every seed, and measure the episodes.

    `with_plots` keeps the first episode of each driver. The episodes in `skipped` do not run. `on_row` is called with
    each row when its episode has ended, from several threads.
    """
    settings: dict[str, Any] = {"reward": reward, "backend": backend}
    settings |= {"record_details": True, "stop_at_contact": False}
    pairs = [(label, index) for index in range(len(seeds)) for label in drivers]
    pairs = [pair for pair in pairs if pair not in skipped]
    tasks = {(label, index): EpisodeTask(*drivers[label], seeds[index], **settings) for label, index in pairs}
    remote_pairs = [pair for pair in pairs if tasks[pair].is_serializable]
    local_pairs = [pair for pair in pairs if not tasks[pair].is_serializable]
    watch = watch or watch_files((scenario for scenario, _ in drivers.values()), reward, backend)
    on_progress = progress or (lambda pair, steps: None)

    def measure_episode(pair: DriverAndEpisode, episode: Episode) -> tuple[dict[str, Any], Episode | None]:
        watch.check()
        on_row(pair, row := measure(episode))
        return row, episode if with_plots and pair[1] == 0 and episode.has_run else None

    measured = workers.run_and_map(
        [tasks[pair] for pair in remote_pairs],
        lambda index, episode: measure_episode(remote_pairs[index], episode),
        lambda index, steps: on_progress(remote_pairs[index], steps),
    )
    results = dict(zip(remote_pairs, measured, strict=True))
    with open_backend(backend) if local_pairs else nullcontext(backend) as open_simulator:
        for pair in local_pairs:
            task = replace(tasks[pair], backend=open_simulator)
            results[pair] = measure_episode(pair, run_episode(**vars(task), on_progress=partial(on_progress, pair)))
    rows = {label: [results[pair][0] for pair in pairs if pair[0] == label] for label in drivers}
    return Evaluation(rows, {label: episode for (label, _), (_, episode) in results.items() if episode is not None})


def raise_failures(evaluation: Evaluation) -> None:
    """Raise the error of the first failed episode of an evaluation, if there is one."""
    raise_failure([row for rows in evaluation.rows.values() for row in rows])


def save_evaluation(folder: Path, evaluation: Evaluation, metadata: dict[str, Any]) -> None:
    """Write an evaluation into a folder, for reports.

    `evaluation.json` has `metadata` and rows, `episodes.parquet` has the rows as a table, and
    `plot_episodes.safetensors` has the episodes for figures. `evaluation.json` also has the hash of the episodes,
    because a process that is killed may leave files of two evaluations.
    """
    make_folder(folder)
    remove_leftovers(folder)
    rows = [{"driver": label, **row} for label, driver_rows in evaluation.rows.items() for row in driver_rows]
    episodes = [to_plot_episode(label, episode) for label, episode in evaluation.plot_episodes.items()]
    arrays = {
        f"{index}.{name}": array
        for index, episode in enumerate(episodes)
        for name, array in pack_episode(episode).items()
    }
    entries = [
        {"driver": episode.driver, **{name: getattr(episode, name) for name in EPISODE_ENTRIES}} for episode in episodes
    ]
    packed = save(arrays)
    document = {**metadata, "rows": rows, "plot_episodes": entries, PLOT_EPISODES_HASH: sha256_of(packed)}
    atomic_write(folder / PLOT_EPISODES_FILE, packed)
    atomic_write(folder / "episodes.parquet", rows_to_frame(evaluation.rows).to_parquet())
    atomic_write(folder / EVALUATION_FILE, to_json(document, indent=1))


def drivers_to_compare(config: RunConfig, folder: Path) -> dict[str, Driver]:
    """Return the drivers to compare by label: the baselines, the expert of the run, and the trained controller."""
    scenario = config.make_scenario()
    experts = [] if config.expert == "none" else [config.make_expert()]
    expert_by_label = {expert.describe(): expert for expert in experts}
    drivers: dict[str, Driver] = {}
    for name in config.evaluation.baselines:
        driver = make_driver(name, scenario.control_step)
        if can_drive(driver, scenario):
            # The name of a packaged driver is shorter than its description, which has all tuned parameters.
            is_packaged = name.startswith(PACKAGED_PREFIX) and name != config.expert
            drivers[name if is_packaged else unique_label(driver, {**expert_by_label, **drivers})] = driver
    return order_by_rank({**drivers, **expert_by_label, TRAINED_LABEL: make_driver(str(folder), scenario.control_step)})


def evaluation_steps(config: RunConfig, folder: Path) -> int:
    """Return the maximum number of control steps in `evaluate_run`."""
    episodes = len(drivers_to_compare(config, folder)) * config.evaluation.episodes
    return episodes * config.make_scenario().max_episode_steps


def evaluate_run(
    folder: Path,
    config: RunConfig,
    workers: WorkerPool,
    progress: EvaluationProgress | None = None,
    out: Path | None = None,
    notes: Sequence[str] = (),
    watch: FileWatch | None = None,
) -> Evaluation:
    """Evaluate the controller of a run and the compared drivers on test seeds, and save the results.

    They are saved in `out`, by default the folder of the run. `config.evaluation` may differ from that of the run.
    The `notes` are stored before all others.
    """
    scenario, drivers = config.make_scenario(), drivers_to_compare(config, folder)
    hashes = controller_hashes({TRAINED_LABEL: str(folder)})  # before the episodes: files may change meanwhile
    weights = weights_id(folder / CONTROLLER_FILE)
    seeds = held_out_seeds(config.evaluation.episodes)
    evaluation = evaluate(scenario, drivers, seeds, workers, config.reward, progress, config.episode_backend, watch)
    metadata = {
        "scenario": Path(config.scenario).name,
        "reward": config.reward or scenario.reward,
        "backend": config.episode_backend,
        "trained": TRAINED_LABEL,
        "expert": config.make_expert().describe() if config.expert != "none" else "none",
        "controllers": hashes,
        "weights": weights,
        "notes": [
            *notes,
            *filter(None, [duration_note(config)]),
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


def duration_note(config: RunConfig) -> str:
    """Return a note if episodes of a training are shorter or longer than those of its scenario; else an empty text."""
    options = {name: value for name, value in config.scenario_options.items() if name != "horizon"}
    with suppress(InputError):  # a user network may need the horizon
        scenarios = config.make_scenario(), replace(config, scenario_options=options).make_scenario()
        seconds, usual_seconds = (scenario.max_episode_steps * scenario.control_step for scenario in scenarios)
        is_usual = seconds == usual_seconds
        return "" if is_usual else f"episodes of {seconds:g} s, where the scenario has {usual_seconds:g} s"
    return ""


def gain_over_expert(config: RunConfig, rows: RowsByDriver) -> Estimate | None:
    """Return the paired difference of return between the trained controller and its expert; None without expert."""
    if config.expert == "none":
        return None
    return paired_difference(rows[TRAINED_LABEL], rows[config.make_expert().describe()], "return")


def controller_hashes(controllers: dict[str, str]) -> dict[str, str]:
    """Return the hashes of the controller files that drivers have, by label; `controllers` has the names by label."""
    return {label: sha256 for label, name in controllers.items() if (sha256 := controller_hash(name))}
