"""The motorway benchmark: methods tuned on one half of the ensemble, and compared on the other.

Each candidate of a method first drives a few episodes, on settings with a breakdown that are assigned at random. The
best of them then drive on all settings of this half, and the best of these in both rounds is the tuned one.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import cycle, product
from typing import Any

import numpy as np

from unjam.controller import make_driver
from unjam.measures.metric_table import HUMAN_LABEL
from unjam.measures.metrics import measure
from unjam.measures.traffic_facts import measure_traffic
from unjam.scenarios import Motorway
from unjam.seeds import held_out_seeds, tuning_seeds
from unjam.training.evaluate import raise_failure
from unjam.worlds.record import Episode
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool
from unjam_paper.do_no_harm import HARM_METRICS
from unjam_paper.motorway_ensemble import SETTINGS, SETTINGS_PER_HALF, EnsembleSetting
from unjam_paper.motorway_methods import CANDIDATE_SEED, CANDIDATES_PER_METHOD, METHODS, Candidate
from unjam_paper.motorway_tables import (
    ACC_ALONE,
    BENCHMARK_RATES,
    CONTROLLER,
    FINAL_PART,
    HUMAN_PART,
    OPPONENT,
    PACKAGED_PART,
    SENSING_PART,
    SENSITIVITY_PART,
    TEST_HUMAN_PART,
    TEST_PART,
    TUNING_PART,
    candidates_table,
    comparison_table,
    delay_change,
    no_harm_table,
    packaged_table,
    parameter_effects_table,
    sensing_table,
    sensitivity_table,
    settings_with_breakdown,
    summary_table,
)
from unjam_paper.results_file import StudyPart, read_part
from unjam_paper.study import Study, StudyFolder, Table

STUDY_NAME = "motorway-benchmark"
CONTROLLER_METHOD = "jam-ahead"
TEST_SETTINGS = range(SETTINGS_PER_HALF, len(SETTINGS))
TEST_SEEDS, HARM_SEEDS = 20, 10
"""number of episodes of each driver on a setting of the test half with and without a breakdown"""
HUMAN_SEEDS = 5
"""number of episodes of human traffic on each setting of the tuning half"""
FIRST_EPISODES = 4
"""number of episodes of each candidate in the first round, on as many settings"""
FINALISTS = 4
"""number of candidates of each method in the second round"""
EPISODE_METRICS = (*HARM_METRICS, "vehicles", "human_braking_beyond_3_5")
OTHER_SOURCES = ("vehicles", "detectors", "none")
"""sources of the speeds ahead, besides the CAVs of the main comparison"""
PACKAGED_LAW, PACKAGED_SOURCES = "unjam:on-ramp-tuned", ("cavs", "vehicles")
"""a packaged law that was tuned on `on-ramp`, with exact speeds of all vehicles ahead"""
SENSING_SEEDS, CHANGE_SEEDS = 8, 10
CHANGED_SETTING = 18
"""the setting of which one assumption at a time is changed"""
CHANGES: dict[str, tuple[float, dict[str, Any]]] = {
    "nothing": (1.0, {}),
    **{
        f"cooperation of all human drivers {value:g}": (
            1.0,
            {
                **{f"lane_changing.{name}": (value, value) for name in ("cooperation", "speed_cooperation")},
                "lane_changing.uncooperative_share": 0.0,
            },
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
"""factor of the demand and changed settings of each changed assumption"""
Job = tuple[EnsembleSetting, Candidate, float, tuple[int, ...]]
"""setting, candidate, penetration rate and seeds of an episode"""
HUMAN = Candidate(HUMAN_LABEL, {})


def make_job_scenario(setting: EnsembleSetting, candidate: Candidate, rate: float) -> Motorway:
    """Return the scenario of an episode; a lane that closes has no meter."""
    no_meter = {"ramp_meter.active": False} if setting.road == "lane drop" else {}
    changes = {"penetration_rate": rate, "roadside.source": "cavs", **candidate.settings, **no_meter}
    return setting.scenario(setting.capacity, setting.demand, **changes)


def run_jobs(jobs: Sequence[Job], workers: int) -> Table:
    """Return the metrics of episodes on settings of the ensemble, one row for each."""
    scenarios = [make_job_scenario(setting, candidate, rate) for setting, candidate, rate, _ in jobs]
    tasks = [
        EpisodeTask(scenario, make_driver(candidate.driver, scenario.control_step), seed)
        for scenario, (_, candidate, _, seed) in zip(scenarios, jobs, strict=True)
    ]

    def episode_row(number: int, episode: Episode) -> dict[str, Any]:
        row = measure(episode)
        raise_failure([row])
        setting, _, rate, _ = jobs[number]
        demand = episode.backlog[-1] + len(episode.vehicle_ids)
        return {
            **{"setting": setting.number, "penetration_rate": rate},
            **{name: row[name] for name in EPISODE_METRICS},
            "waiting_at_entrances": float(episode.backlog[1:].sum()) * episode.control_step / demand,
            "breakdown_time": measure_traffic(episode, scenarios[number], ramp_number=-1).breakdown_time,
        }

    with WorkerPool(workers) as pool:
        return pool.run_and_map(tasks, episode_row)


def measure_human(number: int, workers: int) -> Table:
    """Return the episodes of human traffic on a setting of the tuning half."""
    return run_jobs([(SETTINGS[number], HUMAN, 0.0, seed) for seed in tuning_seeds(HUMAN_SEEDS)], workers)


def measure_candidate(method: str, number: int, settings: Sequence[int], workers: int) -> list[dict[str, Any]]:
    """Return the first episodes of a candidate, on some of these settings, as a list of one row.

    Candidates of different methods with the same number drive on the same settings, with the same seeds.
    """
    generator, seeds = np.random.default_rng([CANDIDATE_SEED, number]), tuning_seeds(HUMAN_SEEDS)
    numbers = generator.permutation(np.array(settings))[:FIRST_EPISODES].tolist()
    jobs = [
        (SETTINGS[each], METHODS[method].candidate(number), rate, seeds[(number + index) % HUMAN_SEEDS])
        for index, (each, rate) in enumerate(zip(numbers, cycle(BENCHMARK_RATES), strict=False))
    ]
    return [{"method": method, "candidate": number, "episodes": run_jobs(jobs, workers)}]


def measure_finalist(method: str, number: int, workers: int) -> list[dict[str, Any]]:
    """Return one episode of a candidate on each setting of the tuning half, as a list of one row."""
    candidate, (seed, *_) = METHODS[method].candidate(number), tuning_seeds(1)
    jobs = [
        (setting, candidate, BENCHMARK_RATES[(setting.number + number) % 2], seed)
        for setting in SETTINGS[:SETTINGS_PER_HALF]
    ]
    return [{"method": method, "candidate": number, "episodes": run_jobs(jobs, workers)}]


def measure_test(label: str, candidate: Candidate, rate: float, number: int, count: int, workers: int) -> Table:
    """Return episodes on a setting of the test half."""
    jobs = [(SETTINGS[number], candidate, rate, seed) for seed in held_out_seeds(count)]
    return [{"driver": label, **row} for row in run_jobs(jobs, workers)]


def measure_packaged(source: str, workers: int) -> Table:
    """Return one episode of the packaged law for motorways on each setting of the tuning half and penetration rate."""
    candidate, (seed, *_) = Candidate(PACKAGED_LAW, {"roadside.source": source}), tuning_seeds(1)
    pairs = product(SETTINGS[:SETTINGS_PER_HALF], BENCHMARK_RATES)
    rows = run_jobs([(setting, candidate, rate, seed) for setting, rate in pairs], workers)
    return [{"driver": source, **row} for row in rows]


def measure_change(name: str, controller: Candidate, workers: int) -> dict[str, Table]:
    """Return the episodes of human traffic and of the controller on one setting with one changed assumption."""
    demand_factor, changes = CHANGES[name]
    setting, seeds = SETTINGS[CHANGED_SETTING], held_out_seeds(CHANGE_SEEDS)
    setting = replace(setting, demand=demand_factor * setting.demand)
    drivers = {HUMAN_LABEL: (HUMAN, 0.0), CONTROLLER: (controller, BENCHMARK_RATES[0])}
    return {
        label: run_jobs(
            [(setting, replace(each, settings={**each.settings, **changes}), rate, seed) for seed in seeds], workers
        )
        for label, (each, rate) in drivers.items()
    }


def rank_candidates(rows: Table, human: Table, method: str) -> list[int]:
    """Return the numbers of the candidates of a method, that with the largest reduction of delays first."""
    changes = {row["candidate"]: delay_change(row["episodes"], human) for row in rows if row["method"] == method}
    return sorted(changes, key=lambda number: changes[number])


def make_parts(study_folder: StudyFolder, seeds: int) -> dict[str, StudyPart]:
    """Return what can be measured with the results so far: first human traffic, then candidates, then finalists."""
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
        for number in range(CANDIDATES_PER_METHOD)
        for method in METHODS
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
    hard = settings_with_breakdown(read_part(folder, TEST_HUMAN_PART))
    own = tuned[CONTROLLER]
    parts |= {
        f"{TEST_PART}/{label} {100 * rate:g} % {number}": (
            measure_test,
            (label, candidate, rate, number, TEST_SEEDS if number in hard else HARM_SEEDS),
        )
        for rate in BENCHMARK_RATES
        for number in TEST_SETTINGS
        for label, candidate in tuned.items()
        if number in hard or label != OPPONENT
    }
    sensing = {source: replace(own, settings={**own.settings, "roadside.source": source}) for source in OTHER_SOURCES}
    parts |= {
        f"{SENSING_PART}/{source} {number}": (measure_test, (source, each, BENCHMARK_RATES[0], number, SENSING_SEEDS))
        for source, each in sensing.items()
        for number in hard
    }
    parts |= {f"{SENSITIVITY_PART}/{name}": (measure_change, (name, own)) for name in CHANGES}
    return parts | {f"{PACKAGED_PART}/{source}": (measure_packaged, (source,)) for source in PACKAGED_SOURCES}


def tuned_drivers(first_rows: Table, finals: Table, human: Table) -> dict[str, Candidate]:
    """Return what is compared on the test half: the ACC alone, the tuned controller, and the best tuned opponent."""
    first_episodes = {(row["method"], row["candidate"]): row["episodes"] for row in first_rows}

    def change(row: dict[str, Any]) -> float:
        return delay_change([*first_episodes[row["method"], row["candidate"]], *row["episodes"]], human)

    own = min((row for row in finals if row["method"] == CONTROLLER_METHOD), key=change)
    other = min((row for row in finals if row["method"] != CONTROLLER_METHOD), key=change)
    best = {
        label: METHODS[row["method"]].candidate(row["candidate"])
        for label, row in ((CONTROLLER, own), (OPPONENT, other))
    }
    return {ACC_ALONE: METHODS["ACC"].candidate(0), **best}


MOTORWAY_BENCHMARK = Study(
    title="methods against delays on motorways, tuned on one half of an ensemble and compared on the other",
    make_parts=make_parts,
    minutes=100.0,
    tables={
        "candidates": candidates_table,
        "effects": parameter_effects_table,
        "comparison": comparison_table,
        "summary": summary_table,
        "no-harm": no_harm_table,
        "sensing": sensing_table,
        "sensitivity": sensitivity_table,
        "packaged": packaged_table,
    },
)
