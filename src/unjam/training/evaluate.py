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

from unjam.controller import SHIPPED, hash_of_controller, make_driver
from unjam.controller.domain import notes_on_controllers
from unjam.drivers.driver import Driver
from unjam.drivers.from_file import DriverLike, as_driver
from unjam.drivers.registry import driver_names, free_label, travels
from unjam.errors import InputError, error_named, wrong
from unjam.files import make_folder, to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.metrics import measure
from unjam.measures.notes import notes_of_rows
from unjam.measures.statistics import Estimate, paired_difference, summarise
from unjam.reports.results import ABOUT_SHOWN, EVALUATION_FILE, packed, shown_of
from unjam.scenarios import make_scenario, scenario_recipe
from unjam.scenarios.scenario import Scenario
from unjam.training.config import RunConfig
from unjam.training.drive_result import DriveResult, Rows, frame_of_rows
from unjam.training.folder import new_and_owned
from unjam.training.seeds import TRAINING_BELOW, held_out_seeds
from unjam.worlds.episode import can_drive, run_episode
from unjam.worlds.record import Episode
from unjam.worlds.reward import make_reward
from unjam.worlds.sumo.apart import simulation_for
from unjam.worlds.workers import EpisodeTask, Workers

WANTS_ACC = "holds back a car's own ACC, which none has: --set actuation=cruise --set safety.active=false"
TRAINED = "trained"
"""label of the trained controller in tables and pictures"""
Progress = Callable[[tuple[str, int], int], None]
"""called now and then with (the driver's label, the index of its episode), and the decisions made so far"""


@dataclass(frozen=True)
class Evaluation:
    """Several drivers on the same episodes."""

    rows: Rows
    shown: dict[str, Episode] = field(repr=False)
    """by driver: the episode that pictures show, the same seed for all"""

    def means(self) -> dict[str, dict[str, float]]:
        """Return the mean of each metric, by driver."""
        return {
            label: {name: found.mean for name, found in summarise(rows).items()}
            for label, rows in self.rows.items()
        }


def evaluate(
    scenario: Scenario,
    drivers: dict[str, Driver],
    seeds: Sequence[tuple[int, ...]],
    workers: Workers,
    reward: str = "",
    progress: Progress | None = None,
) -> Evaluation:
    """Run every driver on every seed, and measure."""
    on_road = {label: (scenario, driver) for label, driver in drivers.items()}
    return evaluate_each(on_road, seeds, workers, reward, progress)


def evaluate_each(
    drivers: dict[str, tuple[Scenario, Driver]],
    seeds: Sequence[tuple[int, ...]],
    workers: Workers,
    reward: str = "",
    progress: Progress | None = None,
    pictured: bool = True,
) -> Evaluation:
    """Run every driver, each on a road of its own, on every seed, and measure.

    An episode of each is kept for pictures; not so where none are `pictured`, for it needs much memory.
    """
    pairs = [(label, index) for index in range(len(seeds)) for label in drivers]
    how: dict[str, Any] = {"reward": reward, "full": True, "stop_at_contact": False}
    tasks = [EpisodeTask(*drivers[label], seeds[index], **how) for label, index in pairs]

    def on_progress(task: int, steps: int) -> None:
        if progress is not None:
            progress(pairs[task], steps)

    def measured(task: int, episode: Episode) -> tuple[dict[str, Any], Episode | None]:
        _, index = pairs[task]
        return measure(episode), episode if pictured and index == 0 and episode.ok else None

    away = [index for index, (label, _) in enumerate(pairs) if travels(drivers[label][1])]
    found = dict(
        zip(
            away,
            workers.run_each(
                [tasks[index] for index in away],
                lambda number, episode: measured(away[number], episode),
                lambda number, steps: on_progress(away[number], steps),
            ),
            strict=True,
        )
    )
    found |= _driven_here(tasks, found.keys(), measured, on_progress)
    rows: Rows = {label: [] for label in drivers}
    shown: dict[str, Episode] = {}
    for index, (label, _) in enumerate(pairs):
        row, episode = found[index]
        rows[label].append(row)
        if episode is not None:
            shown[label] = episode
    return Evaluation(rows, shown)


def _driven_here(
    tasks: Sequence[EpisodeTask],
    done: Container[int],
    keep: Callable[[int, Episode], Any],
    on_progress: Callable[[int, int], None],
) -> dict[int, Any]:
    """Run those tasks that are not done in this process; return what `keep` makes of each, by index."""
    left = {index: task for index, task in enumerate(tasks) if index not in done}
    if not left:
        return {}
    with simulation_for(*(task.scenario for task in left.values())) as simulation:
        return {
            index: keep(
                index,
                run_episode(
                    *(task.scenario, task.driver, task.seed, task.reward, task.explore, task.full),
                    simulation=simulation,
                    progress=partial(on_progress, index),
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
            raise error_named(row["error"], f"{row['reason']}{again}")


def raise_failures(result: "Evaluation | DriveResult") -> None:
    """Raise the first failure among the episodes of a result, if there is one."""
    raise_failure([row for rows in result.rows.values() for row in rows])


def save_evaluation(folder: Path, evaluation: Evaluation, about: dict[str, Any]) -> None:
    """Write an evaluation into a folder: what reports are made of.

    `evaluation.json` (rows, and `about`), `episodes.parquet` (the rows as a table), and
    `shown.safetensors` with the episode that pictures show.
    """
    make_folder(folder)
    rows = [{"driver": label, **row} for label, found in evaluation.rows.items() for row in found]
    shown = [shown_of(label, episode) for label, episode in evaluation.shown.items()]
    arrays = {
        f"{number}.{name}": array for number, each in enumerate(shown) for name, array in packed(each).items()
    }
    about_shown = [
        {"driver": each.driver, **{name: getattr(each, name) for name in ABOUT_SHOWN}} for each in shown
    ]
    write_whole(folder / "shown.safetensors", save(arrays))
    write_whole(folder / "episodes.parquet", frame_of_rows(evaluation.rows).to_parquet())
    write_whole(folder / "evaluation.json", to_json({**about, "rows": rows, "shown": about_shown}, indent=1))


def comparison(config: RunConfig, folder: Path, baselines: Sequence[str]) -> dict[str, Driver]:
    """Return the drivers to compare, by label: the baselines, the run's expert, its trained controller."""
    scenario = config.make_scenario()
    expert = {} if config.expert == "none" else {(made := config.make_expert()).describe(): made}
    drivers: dict[str, Driver] = {}
    for name in baselines:
        driver = make_driver(name, scenario.decision_step)
        if can_drive(driver, scenario):
            # The description of a shipped driver has every parameter that was tuned.
            shipped = name.startswith(SHIPPED) and name != config.expert
            drivers[name if shipped else free_label(driver, {**expert, **drivers})] = driver
    return {**drivers, **expert, TRAINED: make_driver(str(folder), scenario.decision_step)}


def steps_to_judge(
    config: RunConfig, folder: Path, baselines: Sequence[str] | None = None, episodes: int | None = None
) -> int:
    """Return how many decisions `judge` makes at most."""
    chosen = config.evaluation
    drivers = comparison(config, folder, chosen.baselines if baselines is None else baselines)
    return len(drivers) * (episodes or chosen.episodes) * config.make_scenario().horizon


def judge(
    folder: Path,
    config: RunConfig,
    workers: Workers,
    baselines: Sequence[str] | None = None,
    episodes: int | None = None,
    progress: Progress | None = None,
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
        "expert": config.make_expert().describe() if config.expert != "none" else "none",
        "controllers": _hashes({TRAINED: str(folder)}),
        "notes": notes_of_rows(found.rows),
        "manifest": manifest(),
    }
    target = out or folder
    if (target / EVALUATION_FILE).is_file():  # what was judged before is not written over by less
        raise_failure(found.rows[TRAINED])
    save_evaluation(target, found, about)
    raise_failures(found)
    return found


def gain_of(config: RunConfig, rows: Rows) -> Estimate | None:
    """Return what the trained controller earns beyond its expert, same seeds paired."""
    if config.expert == "none":
        return None
    return paired_difference(rows[TRAINED], rows[config.make_expert().describe()], "return")


def _lacks_acc(driver: Driver, scenario: Scenario) -> bool:
    """Whether a driver is told of the road ahead to hold back an ACC which CAVs have not got."""
    told = "lane_speeds" in driver.perceives and "lane_speeds" in scenario.tells
    return told and scenario.actuation != "cruise"


def _hashes(controllers: dict[str, str]) -> dict[str, str]:
    """Return the hashes of the files that were judged, by the driver's label; others are none."""
    found = {label: hash_of_controller(text) for label, text in controllers.items()}
    return {label: sha256 for label, sha256 in found.items() if sha256}


def drive(
    scenario: str = "ring",
    driver: str | DriverLike | Sequence[str | DriverLike] = "pi",
    episodes: int = 5,
    seed: int = 0,
    road: dict[str, Any] | None = None,
    reward: str = "",
    workers: int | None = None,
    out: Path | str | None = None,
    progress: Callable[[Any, int], None] | None = None,
    held_out: bool = False,
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
            raise wrong(name, number, f">= {least}")
    if seed + episodes > TRAINING_BELOW:
        raise wrong("seed", seed, f"<= {TRAINING_BELOW - episodes}: those above choose or judge")
    if held_out and seed:
        raise wrong("seed", seed, "none with held-out seeds")
    made = make_scenario(scenario, road)
    drivers: dict[str, Driver] = {}
    if isinstance(driver, str) or not isinstance(driver, Sequence):
        driver = [driver]
    for entry in driver:
        if isinstance(entry, str):
            drivers[entry] = make_driver(entry, made.decision_step)
        else:
            one = as_driver(entry)
            drivers[free_label(one, drivers)] = one
    if not drivers:
        raise wrong("driver", driver, driver_names())
    make_reward(reward or made.reward)
    folder = Path(out) if out is not None else None
    seeds = held_out_seeds(episodes) if held_out else [(seed + index,) for index in range(episodes)]
    pool = Workers(min(workers or os.cpu_count() or 1, episodes * len(drivers)))
    with new_and_owned(folder) if folder is not None else nullcontext(), pool:
        found = evaluate(made, drivers, seeds, pool, reward, progress)
        report, notes = None, notes_on_controllers(scenario_recipe(made), drivers, found.shown)
        notes += [f"{name} {WANTS_ACC}" for name, one in drivers.items() if _lacks_acc(one, made)]
        notes = [*notes_of_rows(found.rows), *notes, *made.notes]
        ran = any(row["status"] != "failed" for rows in found.rows.values() for row in rows)
        if folder is not None and ran:
            about = {"scenario": Path(scenario).name, "reward": reward or made.reward, "manifest": manifest()}
            named = {label: label for label in drivers}
            save_evaluation(folder, found, {**about, "controllers": _hashes(named), "notes": notes})
            from unjam.reports.html import write_report  # draws: so late that what is wrong is told at once

            report = write_report([folder], folder / "report.html")
    kept = folder if ran else None  # there is nothing to look at
    return DriveResult(scenario, found.rows, kept, report, found.shown, notes)
