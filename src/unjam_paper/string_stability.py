"""Cost of string stability on closed roads: experts in usual cars are tuned with several limits of their string gain.

The study also compares packaged controllers in ideal and usual cars.
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from optuna.distributions import FloatDistribution

from unjam.controller import PACKAGED_PREFIX, make_driver
from unjam.drivers.registry import driver_from_name
from unjam.drivers.safety import INSTANT_ACTUATOR, STANDARD_ACTUATOR
from unjam.measures.feasibility import FEASIBLE
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.measures.statistics import estimate, metric_estimate, paired_difference
from unjam.reports.figures import LINE_COLORS, new_figure
from unjam.road_family import FAMILY, FAMILY_PREFIX, IDEAL_VEHICLES, SHARED_RINGS_GROUP
from unjam.scenarios import make_scenario
from unjam.scenarios.family import family_roads
from unjam.scenarios.scenario import Scenario
from unjam.training.search_space import SearchSpace, default_search_space
from unjam.training.string_limit import MAX_STRING_GAIN, find_operating_points
from unjam.training.tune import tune
from unjam.worlds.worker_pool import WorkerPool
from unjam_paper.results_file import read_part
from unjam_paper.study import (
    NO_VALUE_TEXT,
    DriverSource,
    Study,
    Table,
    estimate_text,
    evaluate_drivers,
    evaluate_in_batches,
    evaluate_metrics,
    make_drivers,
    number_text,
)

OTHER_EXPERT = {"ring": "pi-from-gap", "ring-jammed": "pi-from-gap", "figure-eight": "pacer"}
"""expert, besides `smooth-acc`, that is tuned without a limit, by road"""
STRING_ROADS = tuple(OTHER_EXPERT)
GAIN_LIMITS = {"ring": (1.02, 0.0, 1.1, 1.3), "ring-jammed": (1.02, 0.0, 1.1, 1.3), "figure-eight": (1.02, 0.0)}
"""limits of the string gain by road; 0: no limit"""
PACKAGED = {
    "ring": ("ring-tuned", "ring-gap-tuned", "rings-tuned", "shared-rings-tuned", "ring-best-ideal", "ring-best"),
    "ring-jammed": ("ring-jammed-tuned-ideal", "ring-jammed-best-ideal", "ring-jammed-tuned", "ring-jammed-best"),
    "figure-eight": ("figure-eight-tuned-ideal", "figure-eight-best-ideal", "figure-eight-tuned", "figure-eight-best"),
}
"""packaged controllers, by the road on which they are compared"""
EXPERT_COLUMNS = "largest gain allowed", "string gain", "set time gap [s]"
"""headings of columns that have no values for human drivers"""
TABLE_METRICS = ("return", "return", 0), ("mean_speed", "mean speed [m/s]", 2)
"""metrics of tables, with headings and digits"""
CARS = {"ideal": INSTANT_ACTUATOR, "usual": STANDARD_ACTUATOR}
"""actuators of CAVs by kind of car"""
STRING_SEEDS = 20
"""test seeds of each tuned expert"""
SMOOTH_ACC_SPACE: SearchSpace = {
    "averaging_time": FloatDistribution(1.0, 240.0, log=True),
    "leader_weight": FloatDistribution(0.0, 0.6),
    "time_gap": FloatDistribution(0.5, 24.0, log=True),
    "standstill_gap": FloatDistribution(0.0, 5.0),
    "gap_gain": FloatDistribution(0.02, 0.6, log=True),
    "catch_up_speed": FloatDistribution(0.5, 5.0, log=True),
    "time_constant": FloatDistribution(0.3, 4.0, log=True),
    "history_factor": FloatDistribution(0.0, 1.1),
}
TUNING_STEPS = {"ring": 3_000_000, "ring-jammed": 3_000_000, "figure-eight": 1_500_000}
"""control steps of each tuning, for 113 sets of parameters"""
FAMILY_SEEDS = 10
"""test seeds of each road of the family"""
FAMILY_METRIC = "mean_speed_steady"
FAMILY_CONTROLLER = "unjam:best"
RETUNED = {
    "rings": "pi-from-gap:window=41.13,catch_up_speed=0.8373,gap_lower=3.455,gap_upper=23.68,time_constant=2.431,"
    "safe_gap=3.192,fade_time=79.28,history_factor=0.2589,human_time_headway=1.154",
    "shared-rings": "pi-from-gap:window=26.6,catch_up_speed=0.6622,gap_lower=3.143,gap_upper=16.74,safe_gap=10.73,"
    "time_constant=4.2,first_command=zero,human_time_headway=1.186,human_standstill_gap=1.397,fade_time=97.99,"
    "history_factor=0.8567",
}
"""experts of `unjam:best`, tuned again for usual cars (results/tuned.json), by group of roads"""
FAMILY_PART = "family"
STORED_METRICS = ("seed", "return", "mean_speed", "speed_std_fleet_steady", "min_time_gap", "feasibility")


def closed_road(name: str, car: str = "usual") -> Scenario:
    """Return a closed road with one of the `CARS`."""
    return replace(make_scenario(name), actuator=CARS[car])


def measure_tuned(road: str, expert: str, limit: float, workers: int) -> Table:
    """Tune an expert with a limit of its string gain; return its gain and test episodes as a list of one row."""
    scenario = closed_road(road)
    space = SMOOTH_ACC_SPACE if expert == "smooth-acc" else default_search_space(expert, scenario.control_step)
    with WorkerPool(workers) as pool, tempfile.TemporaryDirectory() as folder:
        out, options = Path(folder, "tuned"), {"screen": True, "max_string_gain": limit}
        tuned = tune({road: scenario}, expert, space, TUNING_STEPS[road], out, pool, **options)
        driver = driver_from_name(tuned.best.driver, scenario.control_step)
        gain = find_operating_points({road: scenario}, pool)[road].string_gain(driver)
    episodes = measure_episodes(scenario, tuned.best.driver, workers)
    return [{"expert": expert, "limit": limit, "driver": tuned.best.driver, "gain": gain, "episodes": episodes}]


def measure_episodes(scenario: Scenario, driver: str, workers: int) -> Table:
    """Return the metrics of a driver on test seeds."""
    rows = evaluate_drivers(scenario, {driver: driver}, STRING_SEEDS, workers)[driver]
    return [{name: row[name] for name in STORED_METRICS} for row in rows]


def measure_human_baseline(road: str, workers: int) -> Table:
    """Return the test episodes of the human baseline as a list of one row."""
    episodes = measure_episodes(closed_road(road), HUMAN_LABEL, workers)
    return [{"expert": HUMAN_LABEL, "limit": 0.0, "episodes": episodes}]


def measure_car(road: str, car: str, workers: int) -> Table:
    """Return the test episodes of `pi` and of packaged controllers with one of the `CARS`, and their string gains."""
    scenario = closed_road(road, car)
    rows: Table = []
    with WorkerPool(workers) as pool:
        point = find_operating_points({road: scenario}, pool)[road]
    for name in ("pi", *(f"{PACKAGED_PREFIX}{name}" for name in PACKAGED[road]), "unjam:best"):
        driver = make_driver(name, scenario.control_step)
        gain = None if name == "unjam:best" else point.string_gain(driver)  # no single formula
        rows.append({"car": car, "driver": name, "gain": gain, "episodes": measure_episodes(scenario, name, workers)})
    return rows


def family_groups() -> dict[str, list[str]]:
    """Return the closed roads of the family with ideal cars, by group; each group has an expert of `unjam:best`."""
    shared, groups = family_roads(SHARED_RINGS_GROUP), dict[str, list[str]]()
    for group in ("rings", SHARED_RINGS_GROUP, "figure-eights"):
        names = (name for name in family_roads(group) if group != "rings" or name not in shared)
        groups[group] = [name for name in names if FAMILY[name].options["actuator"] == IDEAL_VEHICLES["actuator"]]
    return groups


def measure_family(group: str, name: str, workers: int) -> Table:
    """Return the speeds on a family road: of human drivers, of `unjam:best` with both cars, of the retuned expert."""
    road, rows = make_scenario(f"{FAMILY_PREFIX}{name}"), list[dict[str, Any]]()
    usual_car_drivers = {FAMILY_CONTROLLER: FAMILY_CONTROLLER, HUMAN_LABEL: HUMAN_LABEL}
    usual_car_drivers |= {"retuned": RETUNED[group]} if group in RETUNED else {}
    evaluate_road = evaluate_in_batches if group in RETUNED else evaluate_metrics  # figure eights run in SUMO
    for car, drivers in {"ideal": {FAMILY_CONTROLLER: FAMILY_CONTROLLER}, "usual": usual_car_drivers}.items():
        scenario = replace(road, actuator=CARS[car])
        for label, results in evaluate_road(scenario, drivers, FAMILY_SEEDS, (FAMILY_METRIC,), workers).items():
            speeds = [row[FAMILY_METRIC] for row in results["episodes"]]
            rows.append({"group": group, "road": name, "car": car, "driver": label, "speeds": speeds})
    return rows


def measure_string_gains(road: str, drivers: Mapping[str, DriverSource], workers: int) -> dict[str, float]:
    """Return the string gains of drivers in usual cars on a closed road, by label."""
    scenario = closed_road(road)
    with WorkerPool(workers) as pool:
        point = find_operating_points({road: scenario}, pool)[road]
    return {label: point.string_gain(driver) for label, driver in make_drivers(scenario, drivers).items()}


def car_table(road: str, folder: Path) -> pd.DataFrame:
    """Return gain, return and mean speed of packaged controllers with both cars, and the differences to ideal cars."""
    _, human = tuned_rows(road, folder)
    measured = read_part(folder, f"packaged-{road}")
    ideal = {row["driver"]: row["episodes"] for row in measured if row["car"] == "ideal"}
    rows: Table = []
    for row in [{"driver": HUMAN_LABEL, "car": NO_VALUE_TEXT, "gain": None, "episodes": human}, *measured]:
        cells = {"driver": row["driver"], "car": row["car"], "string gain": number_text(row["gain"], 3)}
        baselines = {"ideal car": ideal[row["driver"]] if row["car"] == "usual" else None, "human": human}
        rows.append(cells | _mean_cells(row["episodes"], baselines))
    return pd.DataFrame(rows).drop(columns="return, difference to human")


def tuned_rows(road: str, folder: Path) -> tuple[list[dict[str, Any]], Table]:
    """Return the tuned experts of a road, and the test episodes of the human baseline."""
    rows = read_part(folder, road)
    (human,) = (row for row in rows if row["expert"] == HUMAN_LABEL)
    return [row for row in rows if row is not human], human["episodes"]


def string_table(road: str, folder: Path) -> pd.DataFrame:
    """Return gain, time gap, return and mean speed, with differences to the human baseline, by expert and limit."""
    rows, human = tuned_rows(road, folder)
    cells = dict.fromkeys(EXPERT_COLUMNS, NO_VALUE_TEXT)
    table = [{"expert": HUMAN_LABEL, **cells, **_mean_cells(human, {"human": human})}]
    for row in rows:
        time_gap = getattr(driver_from_name(row["driver"], 0.1), "time_gap", None)
        limit = f"{row['limit']:g}" if row["limit"] else "any"
        texts = limit, number_text(row["gain"], 3), number_text(time_gap, 1)
        cells = dict(zip(EXPERT_COLUMNS, texts, strict=True))
        table.append({"expert": row["expert"], **cells, **_mean_cells(row["episodes"], {"human": human})})
    return pd.DataFrame(table)


def _mean_cells(episodes: Table, baselines: Mapping[str, Table | None]) -> dict[str, str]:
    """Return mean return and speed, their differences to other episodes, the smallest time gap and the feasibility."""
    cells: dict[str, str] = {}
    for metric, heading, digits in TABLE_METRICS:
        cells[heading] = f"{metric_estimate(episodes, metric).mean:.{digits}f}"
        for name, baseline in baselines.items():
            difference = None if baseline in (None, episodes) else paired_difference(episodes, baseline, metric)
            cells[f"{heading}, difference to {name}"] = estimate_text(difference, digits, "+")
    feasible_count = sum(row["feasibility"] == FEASIBLE for row in episodes)
    cells["min time gap [s]"] = f"{min(row['min_time_gap'] for row in episodes):.2f}"
    is_human = baselines["human"] is episodes
    return cells | {"feasible episodes": NO_VALUE_TEXT if is_human else f"{feasible_count} of {len(episodes)}"}


def family_table(folder: Path) -> pd.DataFrame:
    """Return the gain in speed of `unjam:best` and the retuned experts, with both cars, by group of roads."""
    rows, table = read_part(folder, FAMILY_PART), list[dict[str, Any]]()
    speed = {(row["road"], row["car"], row["driver"]): np.mean(row["speeds"]) for row in rows}
    for group, roads in family_groups().items():

        def difference(car: str, driver: str, baseline: tuple[str, str], roads: list[str] = roads) -> str:
            values = [speed[road, car, driver] - speed[(road, *baseline)] for road in roads]
            return estimate_text(estimate(values), 2, "+")

        best, human = FAMILY_CONTROLLER, HUMAN_LABEL
        cells = {"roads": f"{len(roads)} {group}"}
        cells |= {f"{best}, {car} cars": difference(car, best, ("usual", human)) for car in CARS}
        cells["usual to ideal cars"] = difference("usual", best, ("ideal", best))
        retuned = difference("usual", "retuned", ("usual", best)) if group in RETUNED else NO_VALUE_TEXT
        table.append({**cells, f"retuned expert to {best}, usual cars": retuned})
    return pd.DataFrame(table)


def string_figure(folder: Path) -> Figure:
    """Draw the mean speed of all vehicles over the string gain of the tuned experts on each road."""
    figure = new_figure(3.0)
    panels: Sequence[Any] = figure.subplots(1, len(STRING_ROADS), squeeze=False)[0]
    for axes, road in zip(panels, STRING_ROADS, strict=True):
        rows, human = tuned_rows(road, folder)
        human_speed = np.mean([row["mean_speed"] for row in human])
        axes.axhline(human_speed, color=LINE_COLORS[2], ls="--", label="human drivers")
        for color, expert in zip(LINE_COLORS, dict.fromkeys(row["expert"] for row in rows), strict=False):
            expert_rows = sorted((row for row in rows if row["expert"] == expert), key=lambda row: row["gain"])
            speeds = [metric_estimate(row["episodes"], "mean_speed") for row in expert_rows]
            bars = [[speed.mean - speed.low for speed in speeds], [speed.high - speed.mean for speed in speeds]]
            gains, means = [row["gain"] for row in expert_rows], [speed.mean for speed in speeds]
            axes.errorbar(gains, means, bars, color=color, ls="", marker="o", label=expert)
        axes.axvline(MAX_STRING_GAIN, color="0.7", lw=0.8)
        axes.set(title=road, xlabel="largest string gain", ylabel="mean speed [m/s]")
    for axes in (panels[0], panels[-1]):
        axes.legend()
    return figure


STRING_STABILITY = Study(
    title="what string stability costs on closed roads: experts tuned with limits on their string gain",
    make_parts=lambda study_folder, seeds: {
        **{f"{road}/{HUMAN_LABEL}": (measure_human_baseline, (road,)) for road in STRING_ROADS},
        **{
            f"{road}/smooth-acc {limit:g}": (measure_tuned, (road, "smooth-acc", limit))
            for road, limits in GAIN_LIMITS.items()
            for limit in limits
        },
        **{f"packaged-{road}/{car}": (measure_car, (road, car)) for road, car in product(PACKAGED, CARS)},
        **{
            f"{FAMILY_PART}/{name}": (measure_family, (group, name))
            for group, roads in family_groups().items()
            for name in roads
        },
        **{f"{road}/{expert} 0": (measure_tuned, (road, expert, 0.0)) for road, expert in OTHER_EXPERT.items()},
    },
    minutes=70.0,
    tables={
        **{road: partial(string_table, road) for road in STRING_ROADS},
        **{f"packaged-{road}": partial(car_table, road) for road in PACKAGED},
        "family": family_table,
    },
    figures={"trade-off": string_figure},
)
