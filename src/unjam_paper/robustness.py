"""What controllers are worth where they have not trained: on other roads, with other sensors and people.

Three studies: the shipped controllers under single changes (`robustness`); other numbers of vehicles
(Figure 10); and calibrated people on the ring: are their waves like real ones, and does a CAV still calm
them? In the experiment of Sugiyama et al. (2008), 22 cars on 230 m, a jam arose by itself and travelled
against the traffic at about 20 km/h, 5.6 m/s; on motorways it is 15 to 20 km/h.
"""

from dataclasses import dataclass, field
from functools import partial
from math import nan
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from unjam.controller import make_driver
from unjam.drivers.wrappers import ImpairedDriver
from unjam.files import atomic_write, make_folder, to_json
from unjam.manifest import manifest
from unjam.measures.feasibility import overall_feasibility
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.measures.metrics import measure
from unjam.measures.statistics import Estimate, paired_difference
from unjam.reports.figures import png_bytes, trajectory_figure
from unjam.reports.results import read_results
from unjam.scenarios import make_scenario
from unjam.training.config import load_config
from unjam.training.evaluate import TRAINED_LABEL, Evaluation, evaluate, raise_failure, save_evaluation
from unjam.training.road_family import NGSIM_IDM
from unjam.training.seeds import make_test_seeds
from unjam.worlds.record import Episode, Floats
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool
from unjam_paper.comparison import (
    COMPARISON_METRICS,
    comparison_rows,
    estimate_entries,
    estimate_metrics,
    interval_text,
    number_text,
    write_comparison_table,
)
from unjam_paper.parts import PartCallback
from unjam_paper.results_file import read_part
from unjam_paper.study import STUDY_ROADS, PlannedRun, Study, StudyFolder, Table, planned_runs

CONDITION_EPISODES = 10
"""of each driver under each condition"""
TUNED_EXPERT = "tuned expert"
"""label of the best tuned expert of a road"""
ROBUSTNESS_METRICS = (
    "mean_speed",
    "mean_speed_steady",
    "speed_std_fleet",
    "min_time_gap",
    "collisions",
    "insertion_backlog_veh",
)
WAVE_CELLS = 512
"""places along the road at which the speed is looked at"""
WAVE_LAG = 8.0
"""time between the two moments that are compared [s]: a wave moves far less than half a lap in it"""
MIN_WAVE_STD = 0.5
"""standard deviation of speed along the road below which there is no wave to follow [m/s]"""


@dataclass(frozen=True)
class Condition:
    """What differs from training."""

    name: str
    scenario_changes: dict[str, Any] = field(default_factory=dict)
    impairments: dict[str, float] = field(default_factory=dict)
    """arguments of `ImpairedDriver`"""


COMMON_CONDITIONS = (
    Condition("as in training"),
    Condition("twice the noise", {"noise": 0.4}),
    Condition("people of NGSIM", {"humans": NGSIM_IDM}),
    Condition("gaps ± 0.5 m", impairments={"gap_noise": 0.5}),
)
DELAY_CONDITION = Condition("0.3 s late", impairments={"delay": 0.3})
RING_CONDITIONS = (
    *COMMON_CONDITIONS,
    DELAY_CONDITION,
    Condition("two CAVs", {"cavs": 2}),
    Condition("one CAV in 44, 520 m", {"vehicles": 44, "length": [520, 520]}),
    Condition("200 to 219 m", {"length": [200, 219]}),
    Condition("271 to 300 m", {"length": [271, 300]}),
)
ROAD_CONDITIONS: dict[str, tuple[Condition, ...]] = {
    "ring": (*RING_CONDITIONS, Condition("after ten minutes of jam", {"warmup": 6000})),
    "ring-jammed": (*RING_CONDITIONS, Condition("before there is a jam", {"warmup": 0})),
    "figure-eight": (
        *COMMON_CONDITIONS,
        DELAY_CONDITION,
        Condition("two CAVs", {"cavs": 2}),
        Condition("radius 30 m", {"radius": [30, 30]}),
        Condition("radius 36 to 38 m", {"radius": [36, 38]}),
        Condition("twice as long", {"horizon": 3000}),
    ),
}
ROAD_CONTROLLERS = {
    "ring": ("unjam:ring-best", "unjam:ring-gap-tuned"),
    "ring-jammed": ("unjam:ring-jammed-best", "unjam:ring-jammed-tuned"),
    "figure-eight": ("unjam:figure-eight-best", "unjam:figure-eight-tuned"),
}
"""the shipped controller of a road, and the best tuned expert there"""
VOLUME_ROADS = ("ring-5", "ring-11", "ring")
"""of Figure 10; controllers of the last are carried over to OTHER_ROADS"""
VOLUME_VARIANTS = ("trpo", "ppo", "sac", "without-model", "proposed", "ours")
TRANSFER_VARIANTS = ("proposed", "ours")
TRANSFER_SOURCE = "ring"
TRANSFER_ROADS: dict[str, dict[str, Any]] = {
    "5 vehicles": STUDY_ROADS["ring-5"],
    "11 vehicles": STUDY_ROADS["ring-11"],
    "22 vehicles": STUDY_ROADS["ring"],
    "44 vehicles on 520 m": {
        "scenario": "ring",
        "scenario_options.vehicles": 44,
        "scenario_options.length": [520, 520],
    },
}
TRANSFER_EPISODES = 20
"""of each driver on each of them"""
EXPERIMENT_RING: dict[str, Any] = {"length": (230, 230)}
"""changes to `ring-jammed` for calibrated people: as long as in the experiment [m]"""
PAPER_HUMANS = "paper's IDM"
"""label of the people among whom the trained controller learned"""
DRIVER_TITLES = {"human": "no CAV", "pi": "PI", TRAINED_LABEL: "PI + residual"}


def condition_rows(road: str, worker_count: int, episodes: int = CONDITION_EPISODES) -> Table:
    """Return a row per condition and driver: people alone, the tuned expert, the trained controller."""
    rows = []
    trained, tuned = ROAD_CONTROLLERS[road]
    names = {HUMAN_LABEL: HUMAN_LABEL, TUNED_EXPERT: tuned, TRAINED_LABEL: trained}
    with WorkerPool(worker_count) as workers:
        for condition in ROAD_CONDITIONS[road]:
            changes = {f"road.{key}": value for key, value in condition.scenario_changes.items()}
            found = _drive_named({**STUDY_ROADS[road], **changes}, names, episodes, workers, **condition.impairments)
            for label, driven in found.items():
                row: dict[str, Any] = {"road": road, "condition": condition.name, "driver": label}
                row["drivable"] = overall_feasibility(driven, found[HUMAN_LABEL])
                gain = paired_difference(driven, found[TUNED_EXPERT], "mean_speed")
                rows.append(
                    {
                        **row,
                        **estimate_metrics(driven, ROBUSTNESS_METRICS),
                        "faster_than_expert": estimate_entries(gain),
                    }
                )
    return rows


def _drive_named(
    changes: dict[str, Any], names: dict[str, str], episodes: int, workers: WorkerPool, **impairments: float
) -> dict[str, Table]:
    """Return the rows of drivers with these names on a road, by label; all but people are `impaired`."""
    scenario = load_config(changes=changes).make_scenario()
    step = scenario.control_step
    drivers = {label: make_driver(name, step) for label, name in names.items()}
    for label, driver in drivers.items():
        if impairments and not driver.is_native:
            drivers[label] = ImpairedDriver(driver, **impairments, time_step=step)
    return evaluate(scenario, drivers, make_test_seeds(episodes), workers).rows


def _write_robustness(study_folder: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    rows = [row for road in ROAD_CONDITIONS for row in condition_rows(road, workers)]
    atomic_write(folder / "robustness.json", to_json(rows, indent=1))


def _robustness_table(road: str, folder: Path) -> pd.DataFrame:
    """Return the mean speed of all vehicles by condition and driver, and what training has added."""
    table: dict[str, dict[str, str]] = {}
    for row in read_part(folder, "robustness"):
        if row["road"] == road:
            cells = table.setdefault(row["condition"], {"": row["condition"]})
            label = {HUMAN_LABEL: "people alone"}.get(row["driver"], row["driver"])
            cells[f"{label} [m/s]"] = number_text(row["mean_speed"]["mean"], 2)
            if row["driver"] == TRAINED_LABEL:
                cells["beyond it [m/s]"] = interval_text(row["faster_than_expert"], 2, "+")
                cells["smallest headway [s]"] = number_text(row["min_time_gap"]["smallest"], 2)
                cells["drivable"] = row["drivable"]
    return pd.DataFrame(table.values())


def transfer_rows(study_folder: StudyFolder, seeds: int, worker_count: int = 2) -> Table:
    """Return what controllers that were trained among 22 vehicles do among others, without training."""
    names = {"human": "human", "pi": "pi"}
    for run in (PlannedRun(TRANSFER_SOURCE, variant, seed) for variant in TRANSFER_VARIANTS for seed in range(seeds)):
        names[f"{run.variant} {run.seed}"] = str(study_folder.run_folder(run))
    rows = []
    with WorkerPool(worker_count) as workers:
        for road, changes in TRANSFER_ROADS.items():
            found = _drive_named(changes, names, TRANSFER_EPISODES, workers).items()
            rows += [
                {"road": road, "driver": label, **estimate_metrics(driven, COMPARISON_METRICS)}
                for label, driven in found
            ]
    return rows


def _write_figure_10(study_folder: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    """Train for 5, 11 and 22 vehicles, as in the paper; and carry controllers over without training."""
    write_comparison_table(
        [row for road in VOLUME_ROADS for row in comparison_rows(study_folder, road, VOLUME_VARIANTS, seeds)], folder
    )
    atomic_write(folder / "carried-over.json", to_json(transfer_rows(study_folder, seeds, workers), indent=1))


def _transfer_table(folder: Path) -> pd.DataFrame:
    """Return the mean speed by driver and traffic: over trainings, with the smallest and the largest."""
    rows = pd.json_normalize(read_part(folder, "carried-over"))
    rows["trained as"] = rows["driver"].str.rstrip(" 0123456789")
    speeds = rows.pivot_table("mean_speed.mean", "road", "trained as", _mean_and_range, sort=False)
    return speeds.rename_axis(index="", columns=None).reset_index()


def _mean_and_range(values: pd.Series) -> str:
    return interval_text(
        estimate_entries(Estimate(values.mean(), nan, nan, len(values), values.min(), values.max())), 2
    )


def humans_on_ring(
    folder: Path,
    populations: dict[str, Path],
    controller: Path,
    workers: int = 2,
    on_part: PartCallback = lambda name: None,
) -> None:
    """Write `ring.json` and `ring.png` into `folder`: people alone, with PI, and with a trained controller.

    Populations are files of `unjam fit-drivers` by their label; the controller is a run folder or a .unjam
    file; `on_progress` is told the name of each finished group of episodes.
    """
    make_folder(folder)
    about, rows = manifest(), []
    roads: dict[str, dict[str, Any]] = {PAPER_HUMANS: {}}
    roads |= {label: {"population": str(file.absolute())} for label, file in populations.items()}
    names = {"human": "human", "pi": "pi", TRAINED_LABEL: str(controller)}
    shown: dict[str, Episode] = {}
    largest = 0
    with WorkerPool(workers) as pool:
        for people, changes in roads.items():
            scenario = make_scenario("ring-jammed", {**EXPERIMENT_RING, **changes})
            for label, name in names.items():
                driver = make_driver(name, scenario.control_step)
                tasks = [
                    EpisodeTask(scenario, driver, (seed,), record_details=True) for seed in range(CONDITION_EPISODES)
                ]
                episodes = pool.run(tasks)
                found = [measure(episode) for episode in episodes]
                raise_failure(found)
                for episode, row in zip(episodes, found, strict=True):
                    rows.append({"people": people, "driver": label, **row, "wave_speed": wave_speed(episode)})
                if label == "human":  # shown is where people alone make the largest wave
                    largest = int(np.argmax([row["speed_std_fleet_steady"] for row in found]))
                shown[f"{people}: {DRIVER_TITLES[label]}"] = episodes[largest]
                on_part(f"{people}, {label}")
    atomic_write(folder / "ring.json", to_json({"manifest": about, "rows": rows}, indent=1))
    save_evaluation(folder / "shown", Evaluation({}, shown), {})
    pictured = list(read_results(folder / "shown").plot_episodes.values())
    atomic_write(folder / "ring.png", png_bytes(trajectory_figure(pictured), dpi=90))


ROBUSTNESS = Study(
    "the shipped controllers on roads, among people and with sensors that they have not trained with",
    lambda seeds: [],
    _write_robustness,
    minutes=20.0,
    tables={road: partial(_robustness_table, road) for road in ROAD_CONDITIONS},
)
FIGURE_10 = Study(
    "5, 11 and 22 vehicles, trained for each, and carried over",
    lambda seeds: planned_runs(VOLUME_ROADS, VOLUME_VARIANTS, seeds),
    _write_figure_10,
    VOLUME_ROADS,
    minutes=3.0,
    tables={"carried over": _transfer_table},
)


def wave_speed(episode: Episode) -> float:
    """Return how fast the pattern of speeds travels along a closed road [m/s]; NaN where there is no wave.

    Negative: against the direction of travel, as real stop-and-go waves do. It is the shift at which the
    speeds along the road are most like those `WAVE_LAG` seconds before, averaged over the second half of the
    episode: the peak of their circular cross-correlation.
    """
    half = len(episode.speeds) // 2
    field = speed_along_road(episode.speeds[half:], episode.positions[half:], episode.loop_length)
    if field.std(1).mean() < MIN_WAVE_STD:
        return float("nan")
    steps = round(WAVE_LAG / episode.control_step)
    spectrum = np.fft.rfft(field - field.mean(1, keepdims=True), axis=1)
    correlation = np.fft.irfft((spectrum[:-steps].conj() * spectrum[steps:]).mean(0), n=WAVE_CELLS)
    shift = (np.argmax(correlation) + WAVE_CELLS / 2) % WAVE_CELLS - WAVE_CELLS / 2
    return float(shift * episode.loop_length / WAVE_CELLS / WAVE_LAG)


def speed_along_road(speeds: Floats, positions: Floats, loop_length: float) -> Floats:
    """Return the speed at each of `WAVE_CELLS` places of a closed road, shape (moments, CELLS) [m/s].

    Between vehicles it is interpolated. Speeds and positions have the shape (moments, vehicles).
    """
    places = np.arange(WAVE_CELLS) * (loop_length / WAVE_CELLS)
    moments = zip(speeds, positions, strict=True)
    return np.array([np.interp(places, there % loop_length, speed, period=loop_length) for speed, there in moments])
