"""Whether `unjam:best` does worse than the ACC alone: a verdict on each of several users' own open roads.

Seeds are paired, and added in batches until the confidence intervals allow a verdict, or `MOST_SEEDS` are
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
from unjam.files import to_json, write_whole
from unjam.measures.drivable import drivable_in_all
from unjam.measures.effect import FLOW, HARD, TIME
from unjam.measures.metrics import measure
from unjam.measures.statistics import Estimate, around_ratio, estimate, estimate_of, paired, signed
from unjam.measures.table import PEOPLE
from unjam.scenarios import make_scenario
from unjam.scenarios.own_network import WITH_OWN_ACC
from unjam.studies.harm_roads import HARM_ROADS, HarmRoad, write_road
from unjam.studies.parts import file_of
from unjam.studies.results_file import read_part
from unjam.studies.study import Study, StudyFolder, Table
from unjam.training.evaluate import raise_failure
from unjam.training.seeds import held_out_seeds
from unjam.worlds.record import Episode
from unjam.worlds.workers import EpisodeTask, Workers

CONTROLLER, ACC = "unjam:best", "cruise"
PENETRATION_RATES = (0.05, 0.1)
BATCH, MOST_SEEDS = 4, 16
"""seeds that are added at a time, and at most"""
STEPS_PER_DECISION = 2
TIME_LIMITS = {False: 0.005, True: 0.02}
"""share of the ACC's travel time that the interval must stay below, without and with a breakdown"""
FLOW_LIMIT = -0.01
"""share of the ACC's flow that the interval must stay above"""
SLOW, PATIENCE = 0.6, 120.0
"""a breakdown: mean speed below this share of the free speed, for so long [s]"""
LEAST_FLOW = 0.2
"""share of the capacity that must flow there meanwhile: a few slow vehicles are no breakdown"""
PLACE, PERIOD = 250.0, 30.0
"""length [m] and time [s] over which mean speeds are taken"""
RESULTS = "do-no-harm"
KEPT = (
    *("seed", "status", TIME, FLOW, "collisions", "drivable", "floor", "lanes", "overridden", HARD),
    *("min_headway", "share_short_headway", "cav_min_ttc", "cav_max_braking", "cut_in_max_braking"),
)
"""of what is measured of an episode: the comparison, and what its feasibility follows from"""
PASSED, FAILED, UNDECIDED = "no harm", "harm", "undecided"


class Judgment(NamedTuple):
    """What is known of a controller compared with the ACC alone, on a road at a penetration rate."""

    time: Estimate
    """paired difference in travel time, as a share of the ACC's"""
    flow: Estimate
    """paired difference in flow, as a share of the ACC's"""
    verdict: str


def judge_harm(
    rows: Sequence[dict[str, Any]], acc_rows: Sequence[dict[str, Any]], breakdown: bool
) -> Judgment:
    """Return the paired differences to the ACC alone, and what they say of harm."""
    time, flow = (_relative_difference(rows, acc_rows, name) for name in (TIME, FLOW))
    limit = TIME_LIMITS[breakdown]
    if time.high < limit and flow.low > FLOW_LIMIT:
        verdict = PASSED
    elif time.low > limit or flow.high < FLOW_LIMIT:
        verdict = FAILED
    else:
        verdict = UNDECIDED
    return Judgment(time, flow, verdict)


def _relative_difference(
    rows: Sequence[dict[str, Any]], acc_rows: Sequence[dict[str, Any]], name: str
) -> Estimate:
    """Return the paired difference in a metric as a share of the ACC's."""
    values = np.array([(row[name], acc[name]) for row, acc in paired(rows, acc_rows)]).reshape(-1, 2)
    shares = around_ratio(values[:, 0] - values[:, 1], values[:, 1]) if len(values) else values[:, 0]
    return estimate(shares.tolist())


def breaks_down(episode: Episode, road: HarmRoad) -> bool:
    """Return whether a section is slow for `PATIENCE` seconds while vehicles flow through it.

    On a road with signals there is no such thing: queues at red lights would count.
    """
    if road.has_signals:
        return False
    place, moment = episode.positions, np.arange(len(episode.positions)) * episode.every * episode.step
    speeds = episode.speeds[:: episode.every][: len(place)]
    there = np.isfinite(place) & np.isfinite(speeds)
    length = sum(stretch.length for stretch in road.stretches)
    shape = int(np.ceil(moment[-1] / PERIOD)) + 1, int(np.ceil(length / PLACE))
    period = np.broadcast_to((moment // PERIOD)[:, None], place.shape)[there].astype(int)
    section = (place[there] // PLACE).clip(0, shape[1] - 1).astype(int)
    cells = period * shape[1] + section
    count, total = (
        np.bincount(cells, weight, shape[0] * shape[1]).reshape(shape) for weight in (None, speeds[there])
    )
    # Vehicles brake before a lower limit, and accelerate behind it: it counts on the adjacent sections, too.
    free = [road.free_speed(PLACE * (number - 1), PLACE * (number + 2)) for number in range(shape[1])]
    looks = PERIOD / (episode.every * episode.step)
    flow = 3600.0 * total / (PLACE * looks)
    slow = (total < SLOW * np.array(free) * count) & (flow > LEAST_FLOW * road.capacity)
    window = round(PATIENCE / PERIOD)
    return len(slow) >= window and bool(sliding_window_view(slow, window, axis=0).all(-1).any())


def _label(driver: str, rate: float) -> str:
    return f"{driver}, {100 * rate:g} %"


def _judgment(found: Mapping[str, Any], rate: float) -> Judgment:
    """Return what the rows of a road say at a penetration rate."""
    rows, acc_rows = (found["rows"].get(_label(driver, rate), []) for driver in (CONTROLLER, ACC))
    return judge_harm(rows, acc_rows, _has_breakdown(found))


def _has_breakdown(found: Mapping[str, Any]) -> bool:
    """Return whether human-only traffic breaks down on at least half of the seeds."""
    slow = [row["breakdown"] for row in found["rows"].get(PEOPLE, [])]
    return 2 * sum(slow) >= max(len(slow), 1)


def _write(studies: StudyFolder, seeds: int, folder: Path, workers: int) -> None:
    """Drive what is missing; what is there stays, unless the controller or the road is another one now."""
    path = folder / f"{RESULTS}.json"
    results = _read_results(folder) if path.is_file() else {}
    with TemporaryDirectory() as place, Workers(workers) as pool:
        for number, (name, road) in enumerate(HARM_ROADS.items()):
            about = {"controller": file_of(CONTROLLER), "road": json.loads(to_json(asdict(road)))}
            if results.get(name, {}).get("about") != about:
                results[name] = {"about": about, "rows": {}}
            found, files = results[name], Path(place, str(number))
            files.mkdir()
            file = write_road(road, files)
            while rates := [rate for rate in PENETRATION_RATES if _is_open(found, rate)]:
                for label, rows in _drive_batch(file, road, found, rates, pool).items():
                    found["rows"].setdefault(label, []).extend(rows)
                write_whole(path, to_json(results, indent=1))


def _read_results(study: Path) -> dict[str, Any]:
    """Return what is known of each road; numbers that are null in the file are NaN."""
    results: dict[str, Any] = read_part(study, RESULTS)
    for row in (row for found in results.values() for rows in found["rows"].values() for row in rows):
        row |= {name: nan for name, value in row.items() if value is None}
    return results


def _is_open(found: Mapping[str, Any], rate: float) -> bool:
    """Return whether more seeds are needed, and allowed."""
    driven = len(found["rows"].get(_label(ACC, rate), ()))
    return driven < MOST_SEEDS and _judgment(found, rate).verdict == UNDECIDED


def _drive_batch(
    file: Path, road: HarmRoad, found: Mapping[str, Any], rates: Sequence[float], pool: Workers
) -> dict[str, Table]:
    """Return the rows of the next seeds, by label: human drivers, and at these rates both others."""
    seeds = held_out_seeds(BATCH, first=len(found["rows"].get(PEOPLE, ())))
    driven = {PEOPLE: (PEOPLE, rates[0])}
    driven |= {_label(driver, rate): (driver, rate) for rate in rates for driver in (ACC, CONTROLLER)}
    labels, tasks = list[str](), list[EpisodeTask]()
    for label, (driver, rate) in driven.items():
        changes = {"cav_share": rate, "steps_per_decision": STEPS_PER_DECISION, **WITH_OWN_ACC}
        scenario = make_scenario(str(file), changes)
        made = make_driver(driver, scenario.decision_step)
        labels += [label] * len(seeds)
        tasks += [EpisodeTask(scenario, made, seed, full=label == PEOPLE) for seed in seeds]

    def keep(number: int, episode: Episode) -> dict[str, Any]:
        measured = measure(episode)
        raise_failure([measured])
        row = {name: measured[name] for name in KEPT}
        return row | {"breakdown": breaks_down(episode, road)} if labels[number] == PEOPLE else row

    rows: dict[str, Table] = {}
    for label, row in zip(labels, pool.run_each(tasks, keep), strict=True):
        rows.setdefault(label, []).append(row)
    return rows


def harm_table(folder: Path) -> pd.DataFrame:
    """Return the comparison with the ACC alone and the verdict, for each road and penetration rate."""
    table: Table = []
    for (name, found), rate in product(_read_results(folder).items(), PENETRATION_RATES):
        road, rows = HARM_ROADS[name], found["rows"]
        acc, own = (rows[_label(driver, rate)] for driver in (ACC, CONTROLLER))
        judged, slow = _judgment(found, rate), [row["breakdown"] for row in rows[PEOPLE]]
        table.append(
            {
                "road": name,
                "demand [veh/h]": " → ".join(f"{share * road.capacity:,.0f}" for share in road.demand),
                "CAVs": f"{100 * rate:g} %",
                "breakdown": "signals" if road.has_signals else f"{sum(slow)} of {len(slow)} seeds",
                "human baseline [s]": f"{estimate_of(rows[PEOPLE], TIME).mean:.1f}",
                "ACC alone [s]": f"{estimate_of(acc, TIME).mean:.1f}",
                "travel time, difference to the ACC": _in_percent(judged.time),
                "flow, difference to the ACC": _in_percent(judged.flow),
                "seeds": judged.time.count,
                "feasible": drivable_in_all(own, rows[PEOPLE]),
                "verdict": judged.verdict,
            }
        )
    return pd.DataFrame(table)


def _in_percent(share: Estimate) -> str:
    percent = Estimate(100 * share.mean, 100 * share.low, 100 * share.high, share.count)
    return f"{signed(percent, 2)} %"


DO_NO_HARM = Study(
    title="whether unjam:best does worse than the ACC alone on any open road of a user's own",
    runs=lambda seeds: [],
    write=_write,
    minutes=40.0,
    goes_on=True,
    tables={"harm": harm_table},
)
