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
from unjam.drivers.wrappers import Impaired
from unjam.files import make_folder, to_json, write_whole
from unjam.manifest import manifest
from unjam.measures.drivable import drivable_in_all
from unjam.measures.metrics import measure
from unjam.measures.statistics import Estimate, paired_difference
from unjam.measures.table import PEOPLE
from unjam.reports.figures import png_bytes, space_time
from unjam.reports.results import read_results
from unjam.scenarios import make_scenario
from unjam.studies.comparison import HONEST, entries, estimates, interval, number, table_rows, write_table
from unjam.studies.parts import OnProgress
from unjam.studies.results_file import read_part
from unjam.studies.study import ROADS, PlannedRun, Study, StudyFolder, Table, planned
from unjam.training.config import load_config
from unjam.training.evaluate import TRAINED, Evaluation, evaluate, raise_failure, save_evaluation
from unjam.training.family import MEASURED
from unjam.training.seeds import held_out_seeds
from unjam.worlds.record import Episode, Floats
from unjam.worlds.workers import EpisodeTask, Workers

EPISODES = 10
"""of each driver under each condition"""
TUNED = "tuned expert"
"""label of the best tuned expert of a road"""
SHOWN = ("mean_speed", "mean_speed_steady", "speed_std_fleet", "min_headway", "collisions", "backlog_veh")
CELLS = 512
"""places along the road at which the speed is looked at"""
LATER = 8.0
"""time between the two moments that are compared [s]: a wave moves far less than half a lap in it"""
SMALLEST_WAVE = 0.5
"""standard deviation of speed along the road below which there is no wave to follow [m/s]"""


@dataclass(frozen=True)
class Condition:
    """What differs from training."""

    name: str
    scenario_changes: dict[str, Any] = field(default_factory=dict)
    impaired: dict[str, float] = field(default_factory=dict)
    """arguments of `Impaired`"""


EVERYWHERE = (
    Condition("as in training"),
    Condition("twice the noise", {"noise": 0.4}),
    Condition("people of NGSIM", {"humans": MEASURED}),
    Condition("gaps ± 0.5 m", impaired={"gap_noise": 0.5}),
)
LATE = Condition("0.3 s late", impaired={"delay": 0.3})
RINGS = (
    *EVERYWHERE,
    LATE,
    Condition("two CAVs", {"cavs": 2}),
    Condition("one CAV in 44, 520 m", {"vehicles": 44, "length": [520, 520]}),
    Condition("200 to 219 m", {"length": [200, 219]}),
    Condition("271 to 300 m", {"length": [271, 300]}),
)
CONDITIONS: dict[str, tuple[Condition, ...]] = {
    "ring": (*RINGS, Condition("after ten minutes of jam", {"warmup": 6000})),
    "ring-jammed": (*RINGS, Condition("before there is a jam", {"warmup": 0})),
    "figure-eight": (
        *EVERYWHERE,
        LATE,
        Condition("two CAVs", {"cavs": 2}),
        Condition("radius 30 m", {"radius": [30, 30]}),
        Condition("radius 36 to 38 m", {"radius": [36, 38]}),
        Condition("twice as long", {"horizon": 3000}),
    ),
}
CONTROLLERS = {
    "ring": ("unjam:ring-best", "unjam:ring-gap-tuned"),
    "ring-jammed": ("unjam:ring-jammed-best", "unjam:ring-jammed-tuned"),
    "figure-eight": ("unjam:figure-eight-best", "unjam:figure-eight-tuned"),
}
"""the shipped controller of a road, and the best tuned expert there"""
VOLUMES = ("ring-5", "ring-11", "ring")
"""of Figure 10; controllers of the last are carried over to OTHER_ROADS"""
AMONG_VOLUMES = ("trpo", "ppo", "sac", "without-model", "proposed", "ours")
CARRIED = ("proposed", "ours")
TRAINED_ON = "ring"
OTHER_ROADS: dict[str, dict[str, Any]] = {
    "5 vehicles": ROADS["ring-5"],
    "11 vehicles": ROADS["ring-11"],
    "22 vehicles": ROADS["ring"],
    "44 vehicles on 520 m": {"scenario": "ring", "road.vehicles": 44, "road.length": [520, 520]},
}
OTHER_EPISODES = 20
"""of each driver on each of them"""
RING_CHANGES: dict[str, Any] = {"length": (230, 230)}
"""changes to `ring-jammed` for calibrated people: as long as in the experiment [m]"""
PAPERS = "paper's IDM"
"""label of the people among whom the trained controller learned"""
TITLES = {"human": "no CAV", "pi": "PI", TRAINED: "PI + residual"}


def under_conditions(road: str, processes: int, episodes: int = EPISODES) -> Table:
    """Return a row per condition and driver: people alone, the tuned expert, the trained controller."""
    rows = []
    trained, tuned = CONTROLLERS[road]
    names = {PEOPLE: PEOPLE, TUNED: tuned, TRAINED: trained}
    with Workers(processes) as workers:
        for condition in CONDITIONS[road]:
            changes = {f"road.{key}": value for key, value in condition.scenario_changes.items()}
            found = _driven({**ROADS[road], **changes}, names, episodes, workers, **condition.impaired)
            for label, driven in found.items():
                row: dict[str, Any] = {"road": road, "condition": condition.name, "driver": label}
                row["drivable"] = drivable_in_all(driven, found[PEOPLE])
                gain = paired_difference(driven, found[TUNED], "mean_speed")
                rows.append({**row, **estimates(driven, SHOWN), "faster_than_expert": entries(gain)})
    return rows


def _driven(
    changes: dict[str, Any], names: dict[str, str], episodes: int, workers: Workers, **impaired: float
) -> dict[str, Table]:
    """Return the rows of drivers with these names on a road, by label; all but people are `impaired`."""
    scenario = load_config(changes=changes).make_scenario()
    step = scenario.decision_step
    drivers = {label: make_driver(name, step) for label, name in names.items()}
    for label, driver in drivers.items():
        if impaired and not driver.native:
            drivers[label] = Impaired(driver, **impaired, time_step=step)
    return evaluate(scenario, drivers, held_out_seeds(episodes), workers).rows


def _write(studies: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    rows = [row for road in CONDITIONS for row in under_conditions(road, workers)]
    write_whole(folder / "robustness.json", to_json(rows, indent=1))


def _table(road: str, folder: Path) -> pd.DataFrame:
    """Return the mean speed of all vehicles by condition and driver, and what training has added."""
    table: dict[str, dict[str, str]] = {}
    for row in read_part(folder, "robustness"):
        if row["road"] == road:
            cells = table.setdefault(row["condition"], {"": row["condition"]})
            label = {PEOPLE: "people alone"}.get(row["driver"], row["driver"])
            cells[f"{label} [m/s]"] = number(row["mean_speed"]["mean"], 2)
            if row["driver"] == TRAINED:
                cells["beyond it [m/s]"] = interval(row["faster_than_expert"], 2, "+")
                cells["smallest headway [s]"] = number(row["min_headway"]["smallest"], 2)
                cells["drivable"] = row["drivable"]
    return pd.DataFrame(table.values())


def carried_over(studies: StudyFolder, seeds: int, processes: int = 2) -> Table:
    """Return what controllers that were trained among 22 vehicles do among others, without training."""
    names = {"human": "human", "pi": "pi"}
    for run in (PlannedRun(TRAINED_ON, variant, seed) for variant in CARRIED for seed in range(seeds)):
        names[f"{run.variant} {run.seed}"] = str(studies.folder_of(run))
    rows = []
    with Workers(processes) as workers:
        for road, changes in OTHER_ROADS.items():
            found = _driven(changes, names, OTHER_EPISODES, workers).items()
            rows += [{"road": road, "driver": label, **estimates(driven, HONEST)} for label, driven in found]
    return rows


def _figure_10(studies: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    """Train for 5, 11 and 22 vehicles, as in the paper; and carry controllers over without training."""
    write_table([row for road in VOLUMES for row in table_rows(studies, road, AMONG_VOLUMES, seeds)], folder)
    write_whole(folder / "carried-over.json", to_json(carried_over(studies, seeds, workers), indent=1))


def _carried_over_table(folder: Path) -> pd.DataFrame:
    """Return the mean speed by driver and traffic: over trainings, with the smallest and the largest."""
    rows = pd.json_normalize(read_part(folder, "carried-over"))
    rows["trained as"] = rows["driver"].str.rstrip(" 0123456789")
    speeds = rows.pivot_table("mean_speed.mean", "road", "trained as", _mean_and_range, sort=False)
    return speeds.rename_axis(index="", columns=None).reset_index()


def _mean_and_range(values: pd.Series) -> str:
    return interval(entries(Estimate(values.mean(), nan, nan, len(values), values.min(), values.max())), 2)


def people_on_ring(
    folder: Path,
    populations: dict[str, Path],
    controller: Path,
    workers: int = 2,
    on_progress: OnProgress = lambda name: None,
) -> None:
    """Write `ring.json` and `ring.png` into `folder`: people alone, with PI, and with a trained controller.

    Populations are files of `unjam fit-drivers` by their label; the controller is a run folder or a .unjam
    file; `on_progress` is told the name of each finished group of episodes.
    """
    make_folder(folder)
    about, rows = manifest(), []
    roads: dict[str, dict[str, Any]] = {PAPERS: {}}
    roads |= {label: {"population": str(file.absolute())} for label, file in populations.items()}
    names = {"human": "human", "pi": "pi", TRAINED: str(controller)}
    shown: dict[str, Episode] = {}
    largest = 0
    with Workers(workers) as pool:
        for people, changes in roads.items():
            scenario = make_scenario("ring-jammed", {**RING_CHANGES, **changes})
            for label, name in names.items():
                driver = make_driver(name, scenario.decision_step)
                tasks = [EpisodeTask(scenario, driver, (seed,), full=True) for seed in range(EPISODES)]
                episodes = pool.run(tasks)
                found = [measure(episode) for episode in episodes]
                raise_failure(found)
                for episode, row in zip(episodes, found, strict=True):
                    rows.append({"people": people, "driver": label, **row, "wave_speed": wave_speed(episode)})
                if label == "human":  # shown is where people alone make the largest wave
                    largest = int(np.argmax([row["speed_std_fleet_steady"] for row in found]))
                shown[f"{people}: {TITLES[label]}"] = episodes[largest]
                on_progress(f"{people}, {label}")
    write_whole(folder / "ring.json", to_json({"manifest": about, "rows": rows}, indent=1))
    save_evaluation(folder / "shown", Evaluation({}, shown), {})
    pictured = list(read_results(folder / "shown").shown.values())
    write_whole(folder / "ring.png", png_bytes(space_time(pictured), dpi=90))


ROBUSTNESS = Study(
    "the shipped controllers on roads, among people and with sensors that they have not trained with",
    lambda seeds: [],
    _write,
    minutes=20.0,
    tables={road: partial(_table, road) for road in CONDITIONS},
)
FIGURE_10 = Study(
    "5, 11 and 22 vehicles, trained for each, and carried over",
    lambda seeds: planned(VOLUMES, AMONG_VOLUMES, seeds),
    _figure_10,
    VOLUMES,
    minutes=3.0,
    tables={"carried over": _carried_over_table},
)


def wave_speed(episode: Episode) -> float:
    """Return how fast the pattern of speeds travels along a closed road [m/s]; NaN where there is no wave.

    Negative: against the direction of travel, as real stop-and-go waves do. It is the shift at which the
    speeds along the road are most like those `LATER` seconds before, averaged over the second half of the
    episode: the peak of their circular cross-correlation.
    """
    half = len(episode.speeds) // 2
    field = speed_along_road(episode.speeds[half:], episode.positions[half:], episode.loop_length)
    if field.std(1).mean() < SMALLEST_WAVE:
        return float("nan")
    steps = round(LATER / episode.step)
    spectrum = np.fft.rfft(field - field.mean(1, keepdims=True), axis=1)
    correlation = np.fft.irfft((spectrum[:-steps].conj() * spectrum[steps:]).mean(0), n=CELLS)
    shift = (np.argmax(correlation) + CELLS / 2) % CELLS - CELLS / 2
    return float(shift * episode.loop_length / CELLS / LATER)


def speed_along_road(speeds: Floats, positions: Floats, loop_length: float) -> Floats:
    """Return the speed at each of `CELLS` places of a closed road, shape (moments, CELLS) [m/s].

    Between vehicles it is interpolated. Speeds and positions have the shape (moments, vehicles).
    """
    places = np.arange(CELLS) * (loop_length / CELLS)
    moments = zip(speeds, positions, strict=True)
    return np.array(
        [np.interp(places, there % loop_length, speed, period=loop_length) for speed, there in moments]
    )
