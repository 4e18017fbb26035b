"""The motorway benchmark: methods are tuned on one half of the ensemble, and compared on the other half.

In the first round each candidate of a method drives on a few random settings with a breakdown. In the second round the
best candidates, the finalists, drive on all settings of the half. The best finalist of both rounds is the tuned method.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import cycle, product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from unjam.controller import make_driver
from unjam.measures.effect import FLOW_METRIC, TIME_METRIC
from unjam.measures.feasibility import HARD_BRAKING_METRIC, overall_feasibility
from unjam.measures.metric_table import HUMAN_LABEL, estimate_cell
from unjam.measures.statistics import Estimate, estimate, linearized_ratio, pair_rows, regress, relative_difference
from unjam.measures.traffic_facts import measure_traffic
from unjam.reports.results import replace_null
from unjam.scenarios import Motorway
from unjam.seeds import held_out_seeds, tuning_seeds
from unjam.worlds.record import Episode
from unjam.worlds.worker_pool import EpisodeTask
from unjam_paper.do_no_harm import HARM_METRICS
from unjam_paper.motorway_ensemble import SETTINGS, SETTINGS_PER_HALF, EnsembleSetting
from unjam_paper.motorway_methods import CANDIDATE_SEED, CANDIDATES_PER_METHOD, METHODS, Candidate
from unjam_paper.results_file import StudyPart, read_part, read_part_or_empty
from unjam_paper.study import NO_VALUE_TEXT, Study, StudyFolder, Table, group_rows, mean_text, measure_tasks

HUMAN_PART, TUNING_PART, FINAL_PART, TEST_HUMAN_PART, TEST_PART = "human", "tuning", "finals", "test-human", "test"
SENSING_PART, SENSITIVITY_PART, PACKAGED_PART = "sensing", "sensitivity", "packaged"
ACC_ALONE, CONTROLLER, OPPONENT = "ACC alone", "controller", "best opponent"
"""labels of the drivers that are compared on the test half, besides human traffic"""
COMPARISONS = {
    "delay, against human": (CONTROLLER, HUMAN_LABEL),
    "delay, against ACC alone": (CONTROLLER, ACC_ALONE),
    "delay, against best opponent": (CONTROLLER, OPPONENT),
    "ACC alone, against human": (ACC_ALONE, HUMAN_LABEL),
    "best opponent, against human": (OPPONENT, HUMAN_LABEL),
}
"""pairs of drivers of which delays are compared, by heading"""
BENCHMARK_RATES = (0.05, 0.1)
"""penetration rates at which methods are tuned and compared"""
STUDY_NAME = "motorway-benchmark"
CONTROLLER_METHOD = "jam-ahead"
TUNING_SETTINGS, TEST_SETTINGS = SETTINGS[:SETTINGS_PER_HALF], range(SETTINGS_PER_HALF, len(SETTINGS))
TEST_SEEDS, HARM_SEEDS, HUMAN_SEEDS = 20, 10, 5
"""episodes on each test setting with and without a breakdown, and of human traffic on each tuning setting"""
FIRST_EPISODES, FINALISTS = 4, 4
"""episodes of each candidate in the first round, one per setting; candidates of each method in the second round"""
EPISODE_METRICS = (*HARM_METRICS, "vehicles", "human_braking_beyond_3_5")
OTHER_SOURCES = ("vehicles", "detectors", "none")
"""sources of the speeds ahead, besides the CAVs, which are the source in the main comparison"""
PACKAGED_DRIVER, PACKAGED_SOURCES = "unjam:on-ramp-tuned", ("cavs", "vehicles")
"""a packaged controller that was tuned on `on-ramp` with exact speeds of all vehicles ahead, and sources for it here"""
SENSING_SEEDS, CHANGE_SEEDS = 8, 10
CHANGED_SETTING = 18
"""number of the setting of which single assumptions are changed"""
COOPERATION = ("lane_changing.cooperation", "lane_changing.speed_cooperation")
CHANGES: dict[str, tuple[float, dict[str, Any]]] = {
    "nothing": (1.0, {}),
    **{
        f"cooperation of all human drivers {value:g}": (
            1.0,
            {**dict.fromkeys(COOPERATION, (value, value)), "lane_changing.uncooperative_share": 0.0},
        )
        for value in (1.0, 0.8, 0.5, 0.0)
    },
    **{f"demand x {factor:g}": (factor, {}) for factor in (0.9, 0.95, 1.05)},
    "human drivers accelerate with 1.5 to 2.5 m/s2": (1.0, {"accelerations": (1.5, 2.5)}),
    "no trucks": (1.0, {"trucks.share": 0.0}),
    "15 % trucks": (1.0, {"trucks.share": 0.15}),
    "30 % ordinary ACC": (1.0, {"ordinary_acc.share": 0.3}),
    **{
        f"simulation step {step:g} s": (1.0, {"simulation_step": step, "steps_per_control_step": round(1.0 / step)})
        for step in (0.25, 1.0)
    },
}
"""factor of the demand and changes to the scenario, by name of the changed assumption"""
Job = tuple[EnsembleSetting, Candidate, float, tuple[int, ...]]
"""setting, candidate, penetration rate and seeds of an episode"""
HUMAN = Candidate(HUMAN_LABEL, {})


def make_job_scenario(setting: EnsembleSetting, candidate: Candidate, rate: float) -> Motorway:
    """Return the scenario of an episode; lane drops have no ramp meter."""
    no_meter = {"ramp_meter.active": False} if setting.road == "lane drop" else {}
    changes = {"penetration_rate": rate, "roadside.source": "cavs", **candidate.settings, **no_meter}
    return setting.scenario(setting.capacity, setting.demand, **changes)


def run_jobs(jobs: Sequence[Job], workers: int) -> Table:
    """Return the metrics of episodes on settings of the ensemble, one row for each episode."""
    scenarios = [make_job_scenario(setting, candidate, rate) for setting, candidate, rate, _ in jobs]
    tasks = [
        EpisodeTask(scenario, make_driver(candidate.driver, scenario.control_step), seed)
        for scenario, (_, candidate, _, seed) in zip(scenarios, jobs, strict=True)
    ]

    def make_row(index: int, episode: Episode, metrics: dict[str, Any]) -> dict[str, Any]:
        setting, _, rate, _ = jobs[index]
        demand = episode.backlog[-1] + len(episode.vehicle_ids)
        return {
            **{"setting": setting.number, "penetration_rate": rate},
            **{name: metrics[name] for name in EPISODE_METRICS},
            "waiting_at_entrances": float(episode.backlog[1:].sum()) * episode.control_step / demand,
            "breakdown_time": measure_traffic(episode, scenarios[index], ramp_index=-1).breakdown_time,
        }

    return measure_tasks(tasks, workers, make_row)


def measure_human(number: int, workers: int) -> Table:
    """Return the episodes of human traffic on a setting of the tuning half."""
    return run_jobs([(SETTINGS[number], HUMAN, 0.0, seed) for seed in tuning_seeds(HUMAN_SEEDS)], workers)


def measure_candidate(method: str, number: int, settings: Sequence[int], workers: int) -> list[dict[str, Any]]:
    """Return the first episodes of a candidate as a list of one row; its number determines settings and seeds."""
    generator, seeds = np.random.default_rng([CANDIDATE_SEED, number]), tuning_seeds(HUMAN_SEEDS)
    drawn_settings = generator.permutation(np.array(settings))[:FIRST_EPISODES].tolist()
    jobs = [
        (SETTINGS[setting], METHODS[method].candidate(number), rate, seeds[(number + index) % HUMAN_SEEDS])
        for index, (setting, rate) in enumerate(zip(drawn_settings, cycle(BENCHMARK_RATES), strict=False))
    ]
    return [{"method": method, "candidate": number, "episodes": run_jobs(jobs, workers)}]


def measure_finalist(method: str, number: int, workers: int) -> list[dict[str, Any]]:
    """Return one episode of a candidate on each setting of the tuning half, as a list of one row."""
    candidate, (seed, *_) = METHODS[method].candidate(number), tuning_seeds(1)
    jobs = [(setting, candidate, BENCHMARK_RATES[(setting.number + number) % 2], seed) for setting in TUNING_SETTINGS]
    return [{"method": method, "candidate": number, "episodes": run_jobs(jobs, workers)}]


def measure_test(label: str, candidate: Candidate, rate: float, number: int, count: int, workers: int) -> Table:
    """Return episodes on a setting of the test half."""
    jobs = [(SETTINGS[number], candidate, rate, seed) for seed in held_out_seeds(count)]
    return [{"driver": label, **row} for row in run_jobs(jobs, workers)]


def measure_packaged(source: str, workers: int) -> Table:
    """Return an episode of the packaged controller on each tuning setting at each penetration rate."""
    candidate, (seed, *_) = Candidate(PACKAGED_DRIVER, {"roadside.source": source}), tuning_seeds(1)
    pairs = product(TUNING_SETTINGS, BENCHMARK_RATES)
    rows = run_jobs([(setting, candidate, rate, seed) for setting, rate in pairs], workers)
    return [{"driver": source, **row} for row in rows]


def measure_change(name: str, controller: Candidate, workers: int) -> dict[str, Table]:
    """Return episodes of human traffic and of the controller on one setting with a changed assumption."""
    demand_factor, changes = CHANGES[name]
    setting, seeds = SETTINGS[CHANGED_SETTING], held_out_seeds(CHANGE_SEEDS)
    setting = replace(setting, demand=demand_factor * setting.demand)
    rows: dict[str, Table] = {}
    for label, candidate, rate in ((HUMAN_LABEL, HUMAN, 0.0), (CONTROLLER, controller, BENCHMARK_RATES[0])):
        changed = replace(candidate, settings={**candidate.settings, **changes})
        rows[label] = run_jobs([(setting, changed, rate, seed) for seed in seeds], workers)
    return rows


def rank_candidates(rows: Table, human: Table, method: str) -> list[int]:
    """Return the numbers of the candidates of a method, ordered by their reduction of delays, the largest first."""
    changes = {row["candidate"]: delay_change(row["episodes"], human) for row in rows if row["method"] == method}
    return sorted(changes, key=lambda number: changes[number])


def make_parts(study_folder: StudyFolder, seeds: int) -> dict[str, StudyPart]:
    """Return the parts that can be measured with the results so far: human traffic, candidates, finalists, tests."""
    folder = study_folder.folder / STUDY_NAME
    parts: dict[str, StudyPart] = {
        f"{HUMAN_PART}/{number}": (measure_human, (number,)) for number in range(SETTINGS_PER_HALF)
    }
    if not (folder / f"{HUMAN_PART}.json").is_file():
        return parts
    human = read_part(folder, HUMAN_PART)
    settings = settings_with_breakdown(human)
    parts |= {
        f"{TUNING_PART}/{method} {number}": (measure_candidate, (method, number, settings))
        for number, method in product(range(CANDIDATES_PER_METHOD), METHODS)
    }
    if not (folder / f"{TUNING_PART}.json").is_file():
        return parts
    first_rows = read_part(folder, TUNING_PART)
    parts |= {
        f"{FINAL_PART}/{method} {number}": (measure_finalist, (method, number))
        for method in METHODS
        for number in rank_candidates(first_rows, human, method)[:FINALISTS]
    }
    parts |= {
        f"{TEST_HUMAN_PART}/{number}": (measure_test, (HUMAN_LABEL, HUMAN, 0.0, number, TEST_SEEDS))
        for number in TEST_SETTINGS
    }
    if not all((folder / f"{part}.json").is_file() for part in (FINAL_PART, TEST_HUMAN_PART)):
        return parts
    tuned = tuned_drivers(first_rows, read_part(folder, FINAL_PART), human)
    congested = settings_with_breakdown(read_part(folder, TEST_HUMAN_PART))
    controller = tuned[CONTROLLER]
    parts |= {
        f"{TEST_PART}/{label} {100 * rate:g} % {number}": (
            measure_test,
            (label, candidate, rate, number, TEST_SEEDS if number in congested else HARM_SEEDS),
        )
        for rate in BENCHMARK_RATES
        for number in TEST_SETTINGS
        for label, candidate in tuned.items()
        if number in congested or label != OPPONENT
    }
    for source, number in product(OTHER_SOURCES, congested):
        candidate = replace(controller, settings={**controller.settings, "roadside.source": source})
        arguments = source, candidate, BENCHMARK_RATES[0], number, SENSING_SEEDS
        parts[f"{SENSING_PART}/{source} {number}"] = measure_test, arguments
    parts |= {f"{SENSITIVITY_PART}/{name}": (measure_change, (name, controller)) for name in CHANGES}
    return parts | {f"{PACKAGED_PART}/{source}": (measure_packaged, (source,)) for source in PACKAGED_SOURCES}


def tuned_drivers(first_rows: Table, finals: Table, human: Table) -> dict[str, Candidate]:
    """Return the drivers for the test half: the ACC alone, the tuned controller, and the best tuned opponent."""
    first_episodes = {(row["method"], row["candidate"]): row["episodes"] for row in first_rows}

    def total_change(row: dict[str, Any]) -> float:
        return delay_change([*first_episodes[row["method"], row["candidate"]], *row["episodes"]], human)

    tuned = {ACC_ALONE: METHODS["ACC"].candidate(0)}
    for label, is_controller in ((CONTROLLER, True), (OPPONENT, False)):
        best = min((row for row in finals if (row["method"] == CONTROLLER_METHOD) == is_controller), key=total_change)
        tuned[label] = METHODS[best["method"]].candidate(best["candidate"])
    return tuned


def settings_with_breakdown(episodes: Table) -> list[int]:
    """Return the numbers of the settings on which traffic breaks down in at least half of the episodes."""
    by_setting = group_rows(episodes, "setting")
    breakdowns = {number: [row["breakdown_time"] is not None for row in rows] for number, rows in by_setting.items()}
    return sorted(number for number, has_breakdown in breakdowns.items() if np.mean(has_breakdown) >= 0.5)


def delay_change(episodes: Table, human: Table) -> float:
    """Return the sum of the changes of travel time to human traffic, relative to the sum of its delays."""
    times = {(row["setting"], str(row["seed"])): row[TIME_METRIC] for row in human}
    pairs = [(row, times[row["setting"], str(row["seed"])]) for row in episodes]
    delay = sum(time - SETTINGS[row["setting"]].free_flow_time for row, time in pairs)
    return sum(row[TIME_METRIC] - time for row, time in pairs) / delay


def candidates_table(folder: Path) -> pd.DataFrame:
    """Return the candidates of all methods and their changes of delay in both rounds."""
    human = read_part(folder, HUMAN_PART)
    finals = {(row["method"], row["candidate"]): row for row in read_part(folder, FINAL_PART)}
    table: Table = []
    for row in read_part(folder, TUNING_PART):
        candidate = METHODS[row["method"]].candidate(row["candidate"])
        settings = ", ".join(f"{name} = {value}" for name, value in candidate.settings.items())
        cells = {"method": row["method"]}
        cells["parameters"] = "; ".join(filter(None, (candidate.driver.partition(":")[2], settings)))
        final = finals.get((row["method"], row["candidate"]))
        for heading, results in (("first round", row), ("second round", final)):
            cells[heading] = f"{100 * delay_change(results['episodes'], human):+.0f} %" if results else NO_VALUE_TEXT
        table.append(cells)
    return pd.DataFrame(table)


def parameter_effects_table(folder: Path) -> pd.DataFrame:
    """Return the relative change of delay per standard deviation of each parameter, by regression over all episodes."""
    human = read_part(folder, HUMAN_PART)
    congested, by_setting = settings_with_breakdown(human), group_rows(human, "setting")
    times = {number: float(np.mean([row[TIME_METRIC] for row in by_setting[number]])) for number in congested}
    delays = {number: time - SETTINGS[number].free_flow_time for number, time in times.items()}
    rows = [row for part in (TUNING_PART, FINAL_PART) for row in read_part(folder, part) if row["candidate"]]
    table: Table = []
    for name, method in METHODS.items():
        samples = [
            (method.candidate(row["candidate"]).regression_values, episode)
            for row in rows
            for episode in row["episodes"]
            if row["method"] == name and episode["setting"] in times
        ]
        if not samples:
            continue
        parameters = list(method.candidate(1).regression_values)
        values = np.array([[numbers[parameter] for parameter in parameters] for numbers, _ in samples])
        changes = [
            (episode[TIME_METRIC] - times[episode["setting"]]) / delays[episode["setting"]] for _, episode in samples
        ]
        effects = regress(values, np.array(changes))
        table += [
            {"method": name, "parameter": parameter, "standard deviation": f"{spread:.3g}", "delay": _percent(effect)}
            for parameter, spread, effect in zip(parameters, np.std(values, axis=0), effects, strict=True)
        ]
    return pd.DataFrame(table)


def comparison_table(folder: Path) -> pd.DataFrame:
    """Return the changes of delay by the controller, relative to human traffic, on each setting with a breakdown."""
    table: Table = []
    for number, rate, rows in _test_rows(folder):
        if OPPONENT not in rows:
            continue
        setting, human, controller = SETTINGS[number], rows[HUMAN_LABEL], rows[CONTROLLER]
        delay = mean_text([row[TIME_METRIC] - setting.free_flow_time for row in human], 0)
        table.append(
            {
                "motorway": number,
                "road": setting.road,
                "demand": setting.demand,
                "CAVs": f"{100 * rate:g} %",
                "delay of human traffic [s]": delay,
                "of which unavoidable [s]": f"{setting.unavoidable_delay:.0f}",
                "waiting at entrances [s]": f"{np.mean([row['waiting_at_entrances'] for row in human]):.0f}",
                **{name: _percent(_estimate_delay_change(rows, *pair, number)) for name, pair in COMPARISONS.items()},
                "flow": _percent(relative_difference(controller, human, FLOW_METRIC)),
                "hard braking of human drivers": _percent(relative_difference(controller, human, HARD_BRAKING_METRIC)),
                "feasible": overall_feasibility(controller, human),
            }
        )
    return pd.DataFrame(table)


def summary_table(folder: Path) -> pd.DataFrame:
    """Return the mean changes over all settings with a breakdown, with confidence intervals over the settings."""
    comparisons = [(number, rate, rows) for number, rate, rows in _test_rows(folder) if OPPONENT in rows]
    table: Table = []
    for rate in BENCHMARK_RATES if comparisons else ():
        rate_rows = [(number, rows) for number, row_rate, rows in comparisons if row_rate == rate]
        changes = {
            name: [_estimate_delay_change(rows, *pair, number).mean for number, rows in rate_rows]
            for name, pair in COMPARISONS.items()
        }
        flows = [relative_difference(rows[CONTROLLER], rows[HUMAN_LABEL], FLOW_METRIC).mean for _, rows in rate_rows]
        table.append(
            {
                "CAVs": f"{100 * rate:g} %",
                "motorways": len(rate_rows),
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
            row["CAVs"] = f"{100 * rate:g} %"
            for name, metric in (("travel time", TIME_METRIC), ("flow", FLOW_METRIC)):
                row[name] = _percent(relative_difference(rows[CONTROLLER], rows[ACC_ALONE], metric), 1)
            table.append(row)
    return pd.DataFrame(table)


def sensing_table(folder: Path) -> pd.DataFrame:
    """Return the change of delay against human traffic by source of the speeds ahead, on the same episodes."""
    if not (sensing := read_part_or_empty(folder, SENSING_PART)):
        return pd.DataFrame()
    human = list(map(replace_null, read_part(folder, TEST_HUMAN_PART)))
    keys = ("setting", "seed", "penetration_rate")
    measured = {str([row[key] for key in keys]) for row in sensing}
    rows = [row for row in read_part(folder, TEST_PART) if row["driver"] == CONTROLLER]
    by_source = {"cavs": [row for row in rows if str([row[key] for key in keys]) in measured]}
    by_source |= group_rows(sensing, "driver")
    table: Table = []
    for source, source_rows in by_source.items():
        changes = [delay_change(rows, human) for _, rows in sorted(group_rows(source_rows, "setting").items())]
        change = _percent(estimate(changes))
        table.append({"source": source, "motorways": len(changes), "delay, against human": change})
    return pd.DataFrame(table)


def sensitivity_table(folder: Path) -> pd.DataFrame:
    """Return the change of travel time with the controller, with one changed assumption in each row."""
    table: Table = []
    for name, rows in read_part_or_empty(folder, SENSITIVITY_PART).items():
        pairs = pair_rows(rows[CONTROLLER], rows[HUMAN_LABEL])
        changes = [controller[TIME_METRIC] - human[TIME_METRIC] for controller, human in pairs]
        row = {"changed": name, "human traffic [s]": mean_text([human[TIME_METRIC] for _, human in pairs], 0)}
        table.append(row | {"change [s]": mean_text(changes, 1, "+")})
    return pd.DataFrame(table)


def packaged_table(folder: Path) -> pd.DataFrame:
    """Return the change of delay with the packaged controller, by source of the speeds ahead and penetration rate."""
    human, table = read_part(folder, HUMAN_PART), list[dict[str, str]]()
    for source, rows in group_rows(read_part_or_empty(folder, PACKAGED_PART), "driver").items():
        by_rate = group_rows(rows, "penetration_rate").items()
        changes = {rate: f"{100 * delay_change(episodes, human):+.0f} %" for rate, episodes in by_rate}
        table.append({"source": source} | {f"delay, {100 * rate:g} % CAVs": text for rate, text in changes.items()})
    return pd.DataFrame(table)


def _test_rows(folder: Path) -> Iterator[tuple[int, float, dict[str, Table]]]:
    """Yield the number of each test setting and each penetration rate with the rows of its drivers."""
    if not (driver_rows := read_part_or_empty(folder, TEST_PART)):
        return
    rows = list(map(replace_null, [*read_part(folder, TEST_HUMAN_PART), *driver_rows]))
    for number, rate in product(sorted({row["setting"] for row in rows}), BENCHMARK_RATES):
        setting_rows = [row for row in rows if row["setting"] == number and row["penetration_rate"] in (0.0, rate)]
        yield number, rate, group_rows(setting_rows, "driver")


def _estimate_delay_change(rows: dict[str, Table], driver: str, baseline: str, number: int) -> Estimate:
    """Return the change of delay by a driver against a baseline, relative to the delay of human traffic."""
    human_times = {str(row["seed"]): row[TIME_METRIC] for row in rows[HUMAN_LABEL]}
    pairs = pair_rows(rows[driver], rows[baseline])
    changes = np.array([row[TIME_METRIC] - baseline_row[TIME_METRIC] for row, baseline_row in pairs])
    delays = np.array([human_times[str(row["seed"])] - SETTINGS[number].free_flow_time for row, _ in pairs])
    return estimate(linearized_ratio(changes, delays).tolist())


def _percent(share: Estimate, digits: int = 0) -> str:
    """Return a share as a text in percent, with its 95 % CI."""
    percent = Estimate(100 * share.mean, 100 * share.low, 100 * share.high, share.count)
    return f"{estimate_cell(percent, digits, sign='+')} %"


MOTORWAY_BENCHMARK = Study(
    title="methods against delays on motorways, tuned on one half of an ensemble and compared on the other",
    make_parts=make_parts,
    minutes=100.0,
    tables={
        **{"candidates": candidates_table, "effects": parameter_effects_table, "comparison": comparison_table},
        **{"summary": summary_table, "no-harm": no_harm_table, "sensing": sensing_table},
        **{"sensitivity": sensitivity_table, "packaged": packaged_table},
    },
)
