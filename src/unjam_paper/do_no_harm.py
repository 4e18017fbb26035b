"""Whether `unjam:best` does worse than the ACC alone: a verdict on each of several users' own open roads.

Seeds are paired, and added in batches until the confidence intervals allow a verdict, or `MAX_SEEDS` are
driven. Of several looks at an interval some err: its 95 % hold for each look by itself.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import product
from math import nan
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view

from unjam.controller import make_driver
from unjam.files import atomic_write, to_json
from unjam.measures.effect import FLOW_METRIC, HARD_BRAKING_METRIC, TIME_METRIC
from unjam.measures.feasibility import overall_feasibility
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.measures.metrics import measure
from unjam.measures.statistics import (
    Estimate,
    estimate,
    format_difference,
    linearized_ratio,
    metric_estimate,
    pair_rows,
)
from unjam.scenarios import make_scenario
from unjam.scenarios.user_network import ACC_SETTINGS
from unjam.training.evaluate import raise_failure
from unjam.training.seeds import make_test_seeds
from unjam.worlds.record import Episode
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool
from unjam_paper.open_test_roads import OPEN_TEST_ROADS, OpenTestRoad, write_road_files
from unjam_paper.parts import controller_digest
from unjam_paper.results_file import read_part
from unjam_paper.study import Study, StudyFolder, Table

TESTED_CONTROLLER, ACC_BASELINE = "unjam:best", "cruise"
PENETRATION_RATES = (0.05, 0.1)
SEED_BATCH, MAX_SEEDS = 4, 16
"""seeds that are added at a time, and at most"""
STEPS_PER_CONTROL_STEP = 2
MAX_TIME_INCREASE = {False: 0.005, True: 0.02}
"""share of the ACC's travel time that the interval must stay below, without and with a breakdown"""
MIN_FLOW_CHANGE = -0.01
"""share of the ACC's flow that the interval must stay above"""
BREAKDOWN_SPEED_SHARE, BREAKDOWN_SECONDS = 0.6, 120.0
"""a breakdown: mean speed below this share of the free speed, for so long [s]"""
MIN_FLOW_SHARE = 0.2
"""share of the capacity that must flow there meanwhile: a few slow vehicles are no breakdown"""
SECTION_LENGTH, SECTION_SECONDS = 250.0, 30.0
"""length [m] and time [s] over which mean speeds are taken"""
RESULTS = "do-no-harm"
HARM_METRICS = (
    *(
        "seed",
        "status",
        TIME_METRIC,
        FLOW_METRIC,
        "collisions",
        "drivable",
        "floor",
        "lanes",
        "overridden",
        HARD_BRAKING_METRIC,
    ),
    *("min_time_gap", "share_short_time_gap", "cav_min_ttc", "cav_max_braking", "cut_in_max_braking"),
)
"""of what is measured of an episode: the comparison, and what its feasibility follows from"""
NO_HARM, HARM, UNDECIDED = "no harm", "harm", "undecided"


class HarmVerdict(NamedTuple):
    """What is known of a controller compared with the ACC alone, on a road at a penetration rate."""

    time: Estimate
    """paired difference in travel time, as a share of the ACC's"""
    flow: Estimate
    """paired difference in flow, as a share of the ACC's"""
    verdict: str


def evaluate_harm(rows: Sequence[dict[str, Any]], acc_rows: Sequence[dict[str, Any]], breakdown: bool) -> HarmVerdict:
    """Return the paired differences to the ACC alone, and what they say of harm."""
    time, flow = (_relative_difference(rows, acc_rows, name) for name in (TIME_METRIC, FLOW_METRIC))
    limit = MAX_TIME_INCREASE[breakdown]
    if time.high < limit and flow.low > MIN_FLOW_CHANGE:
        verdict = NO_HARM
    elif time.low > limit or flow.high < MIN_FLOW_CHANGE:
        verdict = HARM
    else:
        verdict = UNDECIDED
    return HarmVerdict(time, flow, verdict)


def _relative_difference(rows: Sequence[dict[str, Any]], acc_rows: Sequence[dict[str, Any]], name: str) -> Estimate:
    """Return the paired difference in a metric as a share of the ACC's."""
    values = np.array([(row[name], acc[name]) for row, acc in pair_rows(rows, acc_rows)]).reshape(-1, 2)
    shares = linearized_ratio(values[:, 0] - values[:, 1], values[:, 1]) if len(values) else values[:, 0]
    return estimate(shares.tolist())


def has_breakdown(episode: Episode, road: OpenTestRoad) -> bool:
    """Return whether a section is slow for `PATIENCE` seconds while vehicles flow through it.

    On a road with signals there is no such thing: queues at red lights would count.
    """
    if road.has_signals:
        return False
    place, moment = (
        episode.positions,
        np.arange(len(episode.positions)) * episode.snapshot_stride * episode.control_step,
    )
    speeds = episode.speeds[:: episode.snapshot_stride][: len(place)]
    there = np.isfinite(place) & np.isfinite(speeds)
    length = sum(stretch.length for stretch in road.sections)
    shape = int(np.ceil(moment[-1] / SECTION_SECONDS)) + 1, int(np.ceil(length / SECTION_LENGTH))
    period = np.broadcast_to((moment // SECTION_SECONDS)[:, None], place.shape)[there].astype(int)
    section = (place[there] // SECTION_LENGTH).clip(0, shape[1] - 1).astype(int)
    cells = period * shape[1] + section
    count, total = (np.bincount(cells, weight, shape[0] * shape[1]).reshape(shape) for weight in (None, speeds[there]))
    # Vehicles brake before a lower limit, and accelerate behind it: it counts on the adjacent sections, too.
    free = [road.free_speed(SECTION_LENGTH * (number - 1), SECTION_LENGTH * (number + 2)) for number in range(shape[1])]
    looks = SECTION_SECONDS / (episode.snapshot_stride * episode.control_step)
    flow = 3600.0 * total / (SECTION_LENGTH * looks)
    slow = (total < BREAKDOWN_SPEED_SHARE * np.array(free) * count) & (flow > MIN_FLOW_SHARE * road.capacity)
    window = round(BREAKDOWN_SECONDS / SECTION_SECONDS)
    return len(slow) >= window and bool(sliding_window_view(slow, window, axis=0).all(-1).any())


def _rate_label(driver: str, rate: float) -> str:
    return f"{driver}, {100 * rate:g} %"


def _evaluate_rate(results: Mapping[str, Any], rate: float) -> HarmVerdict:
    """Return what the rows of a road say at a penetration rate."""
    rows, acc_rows = (
        results["rows"].get(_rate_label(driver, rate), []) for driver in (TESTED_CONTROLLER, ACC_BASELINE)
    )
    return evaluate_harm(rows, acc_rows, _human_breakdown(results))


def _human_breakdown(results: Mapping[str, Any]) -> bool:
    """Return whether human-only traffic breaks down on at least half of the seeds."""
    slow = [row["breakdown"] for row in results["rows"].get(HUMAN_LABEL, [])]
    return 2 * sum(slow) >= max(len(slow), 1)


def _write_harm(study_folder: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    """Drive what is missing; what is there stays, unless the controller or the road is another one now."""
    path = folder / f"{RESULTS}.json"
    results = _read_results(folder) if path.is_file() else {}
    with TemporaryDirectory() as place, WorkerPool(workers) as pool:
        for number, (name, road) in enumerate(OPEN_TEST_ROADS.items()):
            about = {"controller": controller_digest(TESTED_CONTROLLER), "road": json.loads(to_json(asdict(road)))}
            if results.get(name, {}).get("about") != about:
                results[name] = {"about": about, "rows": {}}
            found, files = results[name], Path(place, str(number))
            files.mkdir()
            file = write_road_files(road, files)
            while rates := [rate for rate in PENETRATION_RATES if _needs_seeds(found, rate)]:
                for label, rows in _drive_batch(file, road, found, rates, pool).items():
                    found["rows"].setdefault(label, []).extend(rows)
                atomic_write(path, to_json(results, indent=1))


def _read_results(study: Path) -> dict[str, Any]:
    """Return what is known of each road; numbers that are null in the file are NaN."""
    results: dict[str, Any] = read_part(study, RESULTS)
    for row in (row for found in results.values() for rows in found["rows"].values() for row in rows):
        row |= {name: nan for name, value in row.items() if value is None}
    return results


def _needs_seeds(results: Mapping[str, Any], rate: float) -> bool:
    """Return whether more seeds are needed, and allowed."""
    driven = len(results["rows"].get(_rate_label(ACC_BASELINE, rate), ()))
    return driven < MAX_SEEDS and _evaluate_rate(results, rate).verdict == UNDECIDED


def _drive_batch(
    file: Path, road: OpenTestRoad, results: Mapping[str, Any], rates: Sequence[float], pool: WorkerPool
) -> dict[str, Table]:
    """Return the rows of the next seeds, by label: human drivers, and at these rates both others."""
    seeds = make_test_seeds(SEED_BATCH, first=len(results["rows"].get(HUMAN_LABEL, ())))
    driven = {HUMAN_LABEL: (HUMAN_LABEL, rates[0])}
    driven |= {
        _rate_label(driver, rate): (driver, rate) for rate in rates for driver in (ACC_BASELINE, TESTED_CONTROLLER)
    }
    labels, tasks = list[str](), list[EpisodeTask]()
    for label, (driver, rate) in driven.items():
        changes = {"penetration_rate": rate, "steps_per_control_step": STEPS_PER_CONTROL_STEP, **ACC_SETTINGS}
        scenario = make_scenario(str(file), changes)
        made = make_driver(driver, scenario.control_step)
        labels += [label] * len(seeds)
        tasks += [EpisodeTask(scenario, made, seed, record_details=label == HUMAN_LABEL) for seed in seeds]

    def episode_row(number: int, episode: Episode) -> dict[str, Any]:
        measured = measure(episode)
        raise_failure([measured])
        row = {name: measured[name] for name in HARM_METRICS}
        return row | {"breakdown": has_breakdown(episode, road)} if labels[number] == HUMAN_LABEL else row

    rows: dict[str, Table] = {}
    for label, row in zip(labels, pool.run_and_map(tasks, episode_row), strict=True):
        rows.setdefault(label, []).append(row)
    return rows


def harm_table(folder: Path) -> pd.DataFrame:
    """Return the comparison with the ACC alone and the verdict, for each road and penetration rate."""
    table: Table = []
    for (name, found), rate in product(_read_results(folder).items(), PENETRATION_RATES):
        road, rows = OPEN_TEST_ROADS[name], found["rows"]
        acc, own = (rows[_rate_label(driver, rate)] for driver in (ACC_BASELINE, TESTED_CONTROLLER))
        judged, slow = _evaluate_rate(found, rate), [row["breakdown"] for row in rows[HUMAN_LABEL]]
        table.append(
            {
                "road": name,
                "demand [veh/h]": " → ".join(f"{share * road.capacity:,.0f}" for share in road.demand),
                "CAVs": f"{100 * rate:g} %",
                "breakdown": "signals" if road.has_signals else f"{sum(slow)} of {len(slow)} seeds",
                "human baseline [s]": f"{metric_estimate(rows[HUMAN_LABEL], TIME_METRIC).mean:.1f}",
                "ACC alone [s]": f"{metric_estimate(acc, TIME_METRIC).mean:.1f}",
                "travel time, difference to the ACC": _percent_text(judged.time),
                "flow, difference to the ACC": _percent_text(judged.flow),
                "seeds": judged.time.count,
                "feasible": overall_feasibility(own, rows[HUMAN_LABEL]),
                "verdict": judged.verdict,
            }
        )
    return pd.DataFrame(table)


def _percent_text(share: Estimate) -> str:
    percent = Estimate(100 * share.mean, 100 * share.low, 100 * share.high, share.count)
    return f"{format_difference(percent, 2)} %"


DO_NO_HARM = Study(
    title="whether unjam:best does worse than the ACC alone on any open road of a user's own",
    make_runs=lambda seeds: [],
    write=_write_harm,
    minutes=40.0,
    is_resumable=True,
    tables={"harm": harm_table},
)
