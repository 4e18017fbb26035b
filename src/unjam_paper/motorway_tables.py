"""Tables of the motorway benchmark: candidates, and comparisons on the test half of the ensemble."""

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from unjam.measures.effect import FLOW_METRIC, TIME_METRIC
from unjam.measures.feasibility import HARD_BRAKING_METRIC, overall_feasibility
from unjam.measures.metric_table import HUMAN_LABEL, estimate_cell
from unjam.measures.statistics import Estimate, estimate, linearized_ratio, pair_rows, regress, relative_difference
from unjam.reports.results import replace_null
from unjam_paper.motorway_ensemble import SETTINGS
from unjam_paper.motorway_methods import METHODS
from unjam_paper.results_file import read_part
from unjam_paper.study import NO_VALUE_TEXT, Table

HUMAN_PART, TUNING_PART, FINAL_PART, TEST_HUMAN_PART, TEST_PART = "human", "tuning", "finals", "test-human", "test"
SENSING_PART, SENSITIVITY_PART, PACKAGED_PART = "sensing", "sensitivity", "packaged"
ACC_ALONE, CONTROLLER, OPPONENT = "ACC alone", "controller", "best opponent"
"""what is compared on the test half, besides human traffic"""
COMPARISONS = {
    "delay, against human": (CONTROLLER, HUMAN_LABEL),
    "delay, against ACC alone": (CONTROLLER, ACC_ALONE),
    "delay, against best opponent": (CONTROLLER, OPPONENT),
    "ACC alone, against human": (ACC_ALONE, HUMAN_LABEL),
    "best opponent, against human": (OPPONENT, HUMAN_LABEL),
}
"""pairs of drivers with the delays that are compared, by heading"""
BENCHMARK_RATES = (0.05, 0.1)
"""penetration rates with which methods are tuned and compared"""
BREAKDOWN_SHARE = 0.5
"""share of the episodes of human traffic with a breakdown from which on a setting counts as one with a breakdown"""


def settings_with_breakdown(episodes: Table) -> list[int]:
    """Return the numbers of the settings that break down in at least half of these episodes of human traffic."""
    by_setting: dict[int, list[bool]] = {}
    for row in episodes:
        by_setting.setdefault(row["setting"], []).append(row["breakdown_time"] is not None)
    return sorted(number for number, each in by_setting.items() if np.mean(each) >= BREAKDOWN_SHARE)


def delay_change(episodes: Table, human: Table) -> float:
    """Return the sum of the changes of travel time relative to human traffic, over the sum of its delays."""
    times = {(row["setting"], str(row["seed"])): row[TIME_METRIC] for row in human}
    changes, delays = list[float](), list[float]()
    for row in episodes:
        time = times[row["setting"], str(row["seed"])]
        changes.append(row[TIME_METRIC] - time)
        delays.append(time - SETTINGS[row["setting"]].free_flow_time)
    return sum(changes) / sum(delays)


def candidates_table(folder: Path) -> pd.DataFrame:
    """Return the candidates of all methods and the change of delays in both rounds."""
    human = read_part(folder, HUMAN_PART)
    finals = {(row["method"], row["candidate"]): row for row in read_part(folder, FINAL_PART)}
    table: Table = []
    for row in read_part(folder, TUNING_PART):
        candidate = METHODS[row["method"]].candidate(row["candidate"])
        settings = ", ".join(f"{name} = {value}" for name, value in candidate.settings.items())
        final = finals.get((row["method"], row["candidate"]))
        table.append(
            {
                "method": row["method"],
                "parameters": "; ".join(filter(None, (candidate.driver.partition(":")[2], settings))),
                "first round": f"{100 * delay_change(row['episodes'], human):+.0f} %",
                "second round": f"{100 * delay_change(final['episodes'], human):+.0f} %" if final else NO_VALUE_TEXT,
            }
        )
    return pd.DataFrame(table)


def parameter_effects_table(folder: Path) -> pd.DataFrame:
    """Return how the delay changes with one standard deviation of each parameter among the candidates of its method.

    By linear regression over all episodes of both rounds on settings with a breakdown; the delay is relative to the
    mean delay of human traffic on the setting. Candidates with default parameters are left out.
    """
    human = read_part(folder, HUMAN_PART)
    times = {
        number: float(np.mean([row[TIME_METRIC] for row in human if row["setting"] == number]))
        for number in settings_with_breakdown(human)
    }
    delays = {number: time - SETTINGS[number].free_flow_time for number, time in times.items()}
    rows = [row for part in (TUNING_PART, FINAL_PART) for row in read_part(folder, part) if row["candidate"]]
    table: Table = []
    for name, method in METHODS.items():
        own = [(method.candidate(row["candidate"]).numbers, row["episodes"]) for row in rows if row["method"] == name]
        samples = [(numbers, each) for numbers, episodes in own for each in episodes if each["setting"] in times]
        if not samples:
            continue
        parameters = list(method.candidate(1).numbers)
        values = np.array([[numbers[parameter] for parameter in parameters] for numbers, _ in samples])
        changes = [(each[TIME_METRIC] - times[each["setting"]]) / delays[each["setting"]] for _, each in samples]
        effects = regress(values, np.array(changes))
        table += [
            {"method": name, "parameter": parameter, "standard deviation": f"{spread:.3g}", "delay": _percent(effect)}
            for parameter, spread, effect in zip(parameters, np.std(values, axis=0), effects, strict=True)
        ]
    return pd.DataFrame(table)


def comparison_table(folder: Path) -> pd.DataFrame:
    """Return the comparison of the controller with others, for each setting with a breakdown and penetration rate.

    Changes of delay are relative to the delay of human traffic.
    """
    table: Table = []
    for number, rate, rows in _test_rows(folder):
        if OPPONENT not in rows:
            continue
        setting, human, own = SETTINGS[number], rows[HUMAN_LABEL], rows[CONTROLLER]
        delay = estimate([row[TIME_METRIC] - setting.free_flow_time for row in human])
        table.append(
            {
                "motorway": number,
                "road": setting.road,
                "demand": setting.demand,
                "CAVs": f"{100 * rate:g} %",
                "delay of human traffic [s]": str(estimate_cell(delay, 0)),
                "of which unavoidable [s]": f"{setting.unavoidable_delay:.0f}",
                "waiting at entrances [s]": f"{np.mean([row['waiting_at_entrances'] for row in human]):.0f}",
                **{name: _percent(_delay_change(rows, *pair, number)) for name, pair in COMPARISONS.items()},
                "flow": _percent(relative_difference(own, human, FLOW_METRIC)),
                "hard braking of human drivers": _percent(relative_difference(own, human, HARD_BRAKING_METRIC)),
                "feasible": overall_feasibility(own, human),
            }
        )
    return pd.DataFrame(table)


def summary_table(folder: Path) -> pd.DataFrame:
    """Return the mean changes over all settings with a breakdown; the intervals are over settings and their seeds."""
    comparisons = [each for each in _test_rows(folder) if OPPONENT in each[2]]
    table: Table = []
    for rate in BENCHMARK_RATES if comparisons else ():
        own = [(number, rows) for number, each, rows in comparisons if each == rate]
        changes = {
            name: [_delay_change(rows, *pair, number).mean for number, rows in own]
            for name, pair in COMPARISONS.items()
        }
        flows = [relative_difference(rows[CONTROLLER], rows[HUMAN_LABEL], FLOW_METRIC).mean for _, rows in own]
        table.append(
            {
                "CAVs": f"{100 * rate:g} %",
                "motorways": len(own),
                **{name: _percent(estimate(values)) for name, values in changes.items()},
                "worst motorway, against human": f"{100 * max(changes['delay, against human'], default=np.nan):+.0f} %",
                "flow": _percent(estimate(flows)),
            }
        )
    return pd.DataFrame(table)


def no_harm_table(folder: Path) -> pd.DataFrame:
    """Return travel time and flow relative to the ACC alone, on the settings without a breakdown."""
    table: Table = []
    for number, rate, rows in _test_rows(folder):
        if OPPONENT not in rows:
            row = {"motorway": number, "road": SETTINGS[number].road, "demand": SETTINGS[number].demand}
            time, flow = (
                relative_difference(rows[CONTROLLER], rows[ACC_ALONE], name) for name in (TIME_METRIC, FLOW_METRIC)
            )
            row |= {"CAVs": f"{100 * rate:g} %", "travel time": _percent(time, 1), "flow": _percent(flow, 1)}
            table.append(row)
    return pd.DataFrame(table)


def sensing_table(folder: Path) -> pd.DataFrame:
    """Return the change of delay against human traffic by the source of the speeds ahead, over the same settings."""
    if not (sensing := _read_measured(folder, SENSING_PART)):
        return pd.DataFrame()
    human = list(map(replace_null, read_part(folder, TEST_HUMAN_PART)))
    rows = [row for row in read_part(folder, TEST_PART) if row["driver"] == CONTROLLER]
    driven = {(row["setting"], str(row["seed"]), row["penetration_rate"]) for row in sensing}
    same = [row for row in rows if (row["setting"], str(row["seed"]), row["penetration_rate"]) in driven]
    table: Table = []
    for source in ("cavs", *dict.fromkeys(row["driver"] for row in sensing)):
        own = same if source == "cavs" else [row for row in sensing if row["driver"] == source]
        by_setting = [
            delay_change([row for row in own if row["setting"] == number], human)
            for number in sorted({row["setting"] for row in own})
        ]
        table.append(
            {"source": source, "motorways": len(by_setting), "delay, against human": _percent(estimate(by_setting))}
        )
    return pd.DataFrame(table)


def sensitivity_table(folder: Path) -> pd.DataFrame:
    """Return the change of travel time with the controller, with one changed assumption in each row."""
    table: Table = []
    for name, rows in _read_measured(folder, SENSITIVITY_PART).items():
        pairs = pair_rows(rows[CONTROLLER], rows[HUMAN_LABEL])
        gains = estimate([own[TIME_METRIC] - each[TIME_METRIC] for own, each in pairs])
        human = estimate([each[TIME_METRIC] for _, each in pairs])
        texts = (str(estimate_cell(human, 0)), str(estimate_cell(gains, 1, sign="+")))
        table.append({"changed": name, "human traffic [s]": texts[0], "change [s]": texts[1]})
    return pd.DataFrame(table)


def packaged_table(folder: Path) -> pd.DataFrame:
    """Return the change of delay with the packaged law for motorways, by the source of the speeds ahead.

    One episode on each setting of the tuning half.
    """
    human, rows = read_part(folder, HUMAN_PART), _read_measured(folder, PACKAGED_PART) or []
    episodes: dict[str, dict[float, Table]] = {}
    for row in rows:
        episodes.setdefault(row["driver"], {}).setdefault(row["penetration_rate"], []).append(row)
    return pd.DataFrame(
        {"source": source}
        | {f"delay, {100 * rate:g} % CAVs": f"{100 * delay_change(each, human):+.0f} %" for rate, each in own.items()}
        for source, own in episodes.items()
    )


def _read_measured(folder: Path, part: str) -> Any:
    """Return a part of a working folder or a results file; an empty object if it is not measured yet."""
    try:
        return read_part(folder, part)
    except (KeyError, FileNotFoundError):
        return {}


def _test_rows(folder: Path) -> Iterator[tuple[int, float, dict[str, Table]]]:
    """Yield each setting and penetration rate of the test half with the rows of its drivers."""
    if not (compared := _read_measured(folder, TEST_PART)):
        return
    rows = list(map(replace_null, [*read_part(folder, TEST_HUMAN_PART), *compared]))
    for number, rate in product(sorted({row["setting"] for row in rows}), BENCHMARK_RATES):
        found: dict[str, Table] = {}
        for row in rows:
            if row["setting"] == number and row["penetration_rate"] in (0.0, rate):
                found.setdefault(row["driver"], []).append(row)
        yield number, rate, found


def _delay_change(rows: dict[str, Table], driver: str, other: str, number: int) -> Estimate:
    """Return the difference of delay between two drivers, relative to the delay of human traffic."""
    free, by_seed = SETTINGS[number].free_flow_time, {str(row["seed"]): row for row in rows[HUMAN_LABEL]}
    values = np.array(
        [
            (own[TIME_METRIC] - each[TIME_METRIC], by_seed[str(own["seed"])][TIME_METRIC] - free)
            for own, each in pair_rows(rows[driver], rows[other])
        ]
    )
    return estimate(linearized_ratio(values[:, 0], values[:, 1]).tolist())


def _percent(share: Estimate, digits: int = 0) -> str:
    percent = Estimate(100 * share.mean, 100 * share.low, 100 * share.high, share.count)
    return f"{estimate_cell(percent, digits, sign='+')} %"
