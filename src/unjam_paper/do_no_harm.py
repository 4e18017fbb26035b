"""Harm check of `unjam:best` on open roads: a verdict on travel time and flow compared with ACC vehicles alone.

Differences are paired by seed. Seeds are added in batches until the confidence intervals allow a verdict, or
`MAX_SEEDS` are used. After several evaluations the coverage of the intervals is smaller than 95 %.
"""

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view

from unjam.controller import make_driver
from unjam.errors import raise_failure
from unjam.measures.effect import FLOW_METRIC, HARD_BRAKING_METRIC, TIME_METRIC
from unjam.measures.feasibility import overall_feasibility
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.measures.metrics import measure
from unjam.measures.statistics import Estimate, format_difference, metric_estimate, relative_difference
from unjam.reports.results import replace_null
from unjam.scenarios import make_scenario
from unjam.scenarios.user_network import ACC_SETTINGS
from unjam.seeds import held_out_seeds
from unjam.training.selection import ACC_DRIVER
from unjam.worlds.record import Episode
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool
from unjam_paper.open_test_roads import OPEN_TEST_ROADS, OpenTestRoad, write_road_files
from unjam_paper.results_file import read_part
from unjam_paper.study import Study, Table

TESTED_CONTROLLER = "unjam:best"
PENETRATION_RATES = (0.05, 0.1)
SEED_BATCH, MAX_SEEDS = 4, 16
"""number of seeds that are added at a time, and their maximum"""
STEPS_PER_CONTROL_STEP = 2
MAX_TIME_INCREASE = {False: 0.005, True: 0.02}
"""upper limit for the CI of the travel time relative to ACC vehicles alone, by whether there is a breakdown"""
MIN_FLOW_CHANGE = -0.01
"""lower limit for the CI of the flow relative to ACC vehicles alone"""
BREAKDOWN_SPEED_SHARE, BREAKDOWN_SECONDS, MIN_FLOW_SHARE = 0.6, 120.0, 0.2
"""a breakdown: largest share of the free-flow speed, shortest duration [s], smallest share of the capacity"""
SECTION_LENGTH, SECTION_SECONDS = 250.0, 30.0
"""length [m] and time [s] over which mean speeds are taken"""
RESULTS_PART = "do-no-harm"
HARM_METRICS = (
    *("seed", "status", TIME_METRIC, FLOW_METRIC, "collisions", "feasibility", "required_time_gap", "has_lanes"),
    *("override_share", HARD_BRAKING_METRIC, "min_time_gap", "share_short_time_gap", "cav_min_ttc"),
    *("cav_max_braking", "cut_in_max_braking"),
)
"""metrics of the comparison and of the feasibility"""
NO_HARM, HARM, HARM_UNDECIDED = "no harm", "harm", "undecided"


class HarmVerdict(NamedTuple):
    """Paired differences of a controller to ACC vehicles alone, relative to the latter, and the verdict."""

    time: Estimate
    flow: Estimate
    verdict: str


def evaluate_harm(rows: Sequence[dict[str, Any]], acc_rows: Sequence[dict[str, Any]], breakdown: bool) -> HarmVerdict:
    """Return the paired differences to ACC vehicles alone, and the verdict."""
    time, flow = (relative_difference(rows, acc_rows, name) for name in (TIME_METRIC, FLOW_METRIC))
    max_increase = MAX_TIME_INCREASE[breakdown]
    if time.high < max_increase and flow.low > MIN_FLOW_CHANGE:
        return HarmVerdict(time, flow, NO_HARM)
    is_harm = time.low > max_increase or flow.high < MIN_FLOW_CHANGE
    return HarmVerdict(time, flow, HARM if is_harm else HARM_UNDECIDED)


def has_breakdown(episode: Episode, road: OpenTestRoad) -> bool:
    """Return whether a section is slow for `BREAKDOWN_SECONDS` while vehicles flow through it; false with signals."""
    if road.has_signals:
        return False
    snapshot_step = episode.snapshot_stride * episode.control_step
    positions, times = episode.positions, np.arange(len(episode.positions)) * snapshot_step
    speeds = episode.speeds[:: episode.snapshot_stride][: len(positions)]
    is_present = np.isfinite(positions) & np.isfinite(speeds)
    length = sum(section.length for section in road.sections)
    shape = int(np.ceil(times[-1] / SECTION_SECONDS)) + 1, int(np.ceil(length / SECTION_LENGTH))
    edges = SECTION_SECONDS * np.arange(shape[0] + 1), SECTION_LENGTH * np.arange(shape[1] + 1)
    points = np.broadcast_to(times[:, None], positions.shape)[is_present], positions[is_present].clip(0, edges[1][-1])
    counts, speed_sums = (np.histogram2d(*points, edges, weights=weights)[0] for weights in (None, speeds[is_present]))
    # Vehicles brake before a lower limit and accelerate after it, so it counts on the adjacent sections, too.
    free = [road.free_speed(SECTION_LENGTH * (index - 1), SECTION_LENGTH * (index + 2)) for index in range(shape[1])]
    flow = 3600.0 * speed_sums / (SECTION_LENGTH * SECTION_SECONDS / snapshot_step)
    is_slow = (speed_sums < BREAKDOWN_SPEED_SHARE * np.array(free) * counts) & (flow > MIN_FLOW_SHARE * road.capacity)
    window = round(BREAKDOWN_SECONDS / SECTION_SECONDS)
    return len(is_slow) >= window and bool(sliding_window_view(is_slow, window, axis=0).all(-1).any())


def _rate_label(driver: str, rate: float) -> str:
    return f"{driver}, {100 * rate:g} %"


def _evaluate_rate(rows: Mapping[str, Table], rate: float) -> HarmVerdict:
    """Return the verdict at a penetration rate; a breakdown counts if human traffic has it on half of the seeds."""
    controller, acc = (rows.get(_rate_label(driver, rate), []) for driver in (TESTED_CONTROLLER, ACC_DRIVER))
    breakdowns = [row["breakdown"] for row in rows.get(HUMAN_LABEL, [])]
    return evaluate_harm(controller, acc, 2 * sum(breakdowns) >= max(len(breakdowns), 1))


def measure_harm(controller: str, road: OpenTestRoad, workers: int) -> dict[str, Any]:
    """Return the rows of all drivers on a road, with as many seeds as the verdicts need."""
    all_rows: dict[str, Table] = {}
    with TemporaryDirectory() as folder, WorkerPool(workers) as pool:
        file = write_road_files(road, Path(folder))
        while rates := [rate for rate in PENETRATION_RATES if _needs_seeds(all_rows, rate)]:
            seed_count = len(all_rows.get(HUMAN_LABEL, ()))
            for label, rows in _run_batch(file, road, seed_count, rates, pool).items():
                all_rows.setdefault(label, []).extend(rows)
    return {"rows": all_rows}


def _needs_seeds(rows: Mapping[str, Table], rate: float) -> bool:
    count = len(rows.get(_rate_label(ACC_DRIVER, rate), ()))
    return count < MAX_SEEDS and _evaluate_rate(rows, rate).verdict == HARM_UNDECIDED


def _run_batch(
    file: Path, road: OpenTestRoad, first_seed: int, rates: list[float], pool: WorkerPool
) -> dict[str, Table]:
    """Return the rows of the next seeds by label: of human drivers, and of both drivers at each penetration rate."""
    seeds = held_out_seeds(SEED_BATCH, first_seed)
    drivers = {HUMAN_LABEL: (HUMAN_LABEL, rates[0])}
    drivers |= {_rate_label(name, rate): (name, rate) for rate in rates for name in (ACC_DRIVER, TESTED_CONTROLLER)}
    tasks = list[EpisodeTask]()
    for name, rate in drivers.values():
        changes = {"penetration_rate": rate, "steps_per_control_step": STEPS_PER_CONTROL_STEP, **ACC_SETTINGS}
        scenario = make_scenario(str(file), changes)
        driver = make_driver(name, scenario.control_step)
        tasks += [EpisodeTask(scenario, driver, seed, record_details=name == HUMAN_LABEL) for seed in seeds]

    def make_row(index: int, episode: Episode) -> dict[str, Any]:
        metrics = measure(episode)
        raise_failure([metrics])
        row = {name: metrics[name] for name in HARM_METRICS}
        return row | {"breakdown": has_breakdown(episode, road)} if index < len(seeds) else row

    rows = pool.run_and_map(tasks, make_row)
    return {label: rows[index * len(seeds) : (index + 1) * len(seeds)] for index, label in enumerate(drivers)}


def harm_table(folder: Path) -> pd.DataFrame:
    """Return the comparison with ACC vehicles alone, and the verdict, for each road and penetration rate."""
    table: Table = []
    for (name, results), rate in product(read_part(folder, RESULTS_PART).items(), PENETRATION_RATES):
        road = OPEN_TEST_ROADS[name]
        rows = {label: list(map(replace_null, episodes)) for label, episodes in results["rows"].items()}
        acc, controller = (rows[_rate_label(driver, rate)] for driver in (ACC_DRIVER, TESTED_CONTROLLER))
        verdict, breakdowns = _evaluate_rate(rows, rate), [row["breakdown"] for row in rows[HUMAN_LABEL]]
        demand = " → ".join(f"{share * road.capacity:,.0f}" for share in road.demand)
        row = {"road": name, "demand [veh/h]": demand, "CAVs": f"{100 * rate:g} %"}
        row["breakdown"] = "signals" if road.has_signals else f"{sum(breakdowns)} of {len(breakdowns)} seeds"
        row["human baseline [s]"] = f"{metric_estimate(rows[HUMAN_LABEL], TIME_METRIC).mean:.1f}"
        row["ACC alone [s]"] = f"{metric_estimate(acc, TIME_METRIC).mean:.1f}"
        row["travel time, difference to the ACC"] = _percent_text(verdict.time)
        row |= {"flow, difference to the ACC": _percent_text(verdict.flow), "seeds": verdict.time.count}
        row |= {"feasible": overall_feasibility(controller, rows[HUMAN_LABEL]), "verdict": verdict.verdict}
        table.append(row)
    return pd.DataFrame(table)


def _percent_text(share: Estimate) -> str:
    percent = Estimate(100 * share.mean, 100 * share.low, 100 * share.high, share.count)
    return f"{format_difference(percent, 2)} %"


DO_NO_HARM = Study(
    title="harm check of unjam:best against the ACC alone on open roads",
    make_parts=lambda study_folder, seeds: {
        f"{RESULTS_PART}/{name}": (measure_harm, (TESTED_CONTROLLER, road)) for name, road in OPEN_TEST_ROADS.items()
    },
    minutes=40.0,
    tables={"harm": harm_table},
)
