"""Calibration of human drivers on a motorway with empirical facts: a search for settings, and a comparison of the best.

Each candidate, a set of settings, drives on a road with one on-ramp, where the demand rises until traffic breaks down.
The candidate with the smallest deviation from the targets is then measured on test seeds with two simulation steps.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from math import inf, isfinite, nan
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from unjam.drivers import Human
from unjam.measures.traffic_facts import TrafficFacts, measure_traffic
from unjam.scenarios import Motorway, make_scenario
from unjam.seeds import held_out_seeds, tuning_seeds
from unjam.worlds.record import Episode
from unjam.worlds.worker_pool import EpisodeTask
from unjam_paper.results_file import read_part
from unjam_paper.study import NO_VALUE_TEXT, Study, Table, mean_text, measure_tasks

CANDIDATES, CANDIDATE_SEEDS, FINAL_SEEDS = 60, 3, 20
"""numbers of candidates, of episodes of each one, and of episodes of the best one with each simulation step"""
SIMULATION_STEPS = (0.5, 0.25)
"""simulation steps of the comparison [s]"""
TRUCK_SHARE = 0.1
CANDIDATES_PART, BEST_PART = "candidates", "best"
CAPACITY_ROAD: dict[str, Any] = {
    "length": 4000.0,
    "ramps": [{"position": 3000.0, "inflow": 700.0, "off_peak_inflow": 250.0}],
    "inflow": 4500.0,
    "off_peak_inflow": 1800.0,
    "peak": (1800.0, 2700.0),
    "peak_rise": 1800.0,
    "horizon": 2700,
}
"""a road with a demand that rises for half an hour, from far below to far above the capacity"""


@dataclass(frozen=True)
class Target:
    """An empirical fact of motorways that simulated traffic should match: a value and an accepted range."""

    name: str
    value: float
    accepted: tuple[float, float]
    digits: int
    source: str
    factor: float = 1.0
    """factor that converts a simulated fact into the unit of the value"""

    def deviation(self, value: float) -> float:
        """Return the absolute difference to the target, relative to half the width of the accepted range."""
        low, high = self.accepted
        return abs(value - self.value) / ((high - low) / 2.0)


TARGETS: dict[str, Target] = {
    "highest_flow": Target(
        "highest flow in 5 min before a breakdown [veh/h per lane]",
        *(1950.0, (1800.0, 2200.0), 0),
        "10 % trucks: 2,205 (ROA2017, table 4.3); mean capacity of 38 bottlenecks 1,800 to 2,100 (Geistefeldt and "
        "Shojaat 2019)",
    ),
    "discharge": Target(
        "discharge of the queue [veh/h per lane]",
        *(1780.0, (1650.0, 1950.0), 0),
        "2,016 passenger cars on average, 5 % below capacity (Zhang and Levinson 2004)",
    ),
    "capacity_drop": Target(
        "capacity drop [%]",
        *(8.0, (4.0, 13.0), 1),
        factor=100.0,
        source="2 to 11 % at 27 sites (Zhang and Levinson 2004); up to 10 % (Cassidy and Bertini 1999)",
    ),
    "wave_speed": Target(
        "speed of waves, upstream [km/h]",
        *(17.0, (14.0, 20.0), 1),
        factor=-3.6,
        source="14 to 20 (Zielke, Bertini and Treiber 2008)",
    ),
    "free_time_gap": Target(
        "median net time gap in dense free traffic [s]",
        *(1.3, (1.0, 1.6), 2),
        "1.3 to 1.8 on average (Nishinari, Treiber and Helbing 2003)",
    ),
    "congested_time_gap": Target(
        "median net time gap in congestion [s]",
        *(1.65, (1.4, 2.0), 2),
        "1.65 at 6 to 9 m/s, 1.94 at 3 to 6 m/s (NGSIM I-80)",
    ),
    "lane_changes_per_km": Target(
        "lane changes per vehicle and km in dense free traffic",
        *(0.4, (0.2, 0.6), 2),
        "0.5, most just below the critical density (Knoop et al. 2012); at least 0.12 in light traffic (highD, 2018)",
    ),
    "merge_ratio": Target(
        "ramp : right lane in congestion",
        *(0.9, (0.5, 1.3), 2),
        "nearly fixed, independent of the discharge (Cassidy and Ahn 2005); about 1 : 1",
    ),
    "hardest_braking": Target(
        "99.9 % quantile of decelerations near the merge [m/s²]", *(3.0, (2.4, 4.0), 2), "2.6 (NGSIM I-80)"
    ),
}


def make_candidate(number: int) -> dict[str, Any]:
    """Return the settings of a candidate, drawn from wide ranges; candidate 0 has the default lane changing of SUMO."""
    generator = np.random.default_rng((20_261_128, number))

    def draw(low: float, high: float) -> float:
        return round(float(generator.uniform(low, high)), 2)

    headway, acceleration, assertiveness = draw(0.95, 1.35), draw(0.8, 1.3), draw(1.0, 2.2)
    settings = {
        "time_headways": (round(headway - 0.4, 2), round(headway + 0.4, 2)),
        "accelerations": (round(acceleration - 0.25, 2), round(acceleration + 0.25, 2)),
        "lane_changing": {
            "assertiveness": (round(max(assertiveness - 0.4, 0.8), 2), round(assertiveness + 0.4, 2)),
            "speed_gain": (1.0, draw(1.5, 6.0)),
            "keep_right": (draw(0.0, 0.8), 1.0),
            "speed_cooperation": (draw(0.2, 0.9), 1.0),
            "uncooperative_share": draw(0.0, 0.5),
        },
    }
    if number == 0:
        settings = {"time_headways": (1.0, 1.8), "accelerations": (1.0, 1.5), "lane_changing": {}}
    return {**settings, "trucks": {"share": TRUCK_SHARE}}


POPULATIONS = tuple(make_candidate(number) for number in (17, 56, 49))
"""the three candidates with the smallest deviations, the best one first"""


def capacity_road(settings: Mapping[str, Any]) -> Motorway:
    """Return the scenario with rising demand and these settings of human traffic."""
    scenario = make_scenario("on-ramp", {**CAPACITY_ROAD, "penetration_rate": 0.0, **settings})
    assert isinstance(scenario, Motorway)
    return scenario


def measure_traffic_candidate(number: int, workers: int) -> list[dict[str, Any]]:
    """Return the settings of a candidate and the facts of its episodes, as a list of one row."""
    settings = make_candidate(number)
    episodes = measure_scenario(capacity_road(settings), tuning_seeds(CANDIDATE_SEEDS), workers)
    return [{"settings": settings, "episodes": episodes}]


def measure_step(settings: Mapping[str, Any], step: float, workers: int) -> dict[str, Table]:
    """Return the facts of human traffic on test seeds with a simulation step [s], and a control step of 1 s."""
    changes = {"simulation_step": step, "steps_per_control_step": round(1.0 / step)}
    road = capacity_road({**settings, **changes})
    return {"episodes": measure_scenario(road, held_out_seeds(FINAL_SEEDS), workers)}


def measure_scenario(scenario: Motorway, seeds: Sequence[tuple[int, ...]], workers: int) -> Table:
    """Return the facts at the last ramp of a motorway with human drivers only, one row for each seed."""

    def make_row(index: int, episode: Episode, metrics: dict[str, Any]) -> dict[str, Any]:
        facts = asdict(measure_traffic(episode, scenario, ramp_index=-1))
        return {**facts, "delay": metrics["delay"], "status": metrics["status"]}

    return measure_tasks([EpisodeTask(scenario, Human(), seed) for seed in seeds], workers, make_row)


def mean_facts(rows: Table) -> dict[str, float]:
    """Return the mean of each fact of `TARGETS` over the episodes that have it; NaN if no episode has it."""
    values_by_fact = {name: fact_values(rows, name) for name in TARGETS}
    return {name: float(np.mean(values)) if values else nan for name, values in values_by_fact.items()}


def fact_values(rows: Table, target: str) -> list[float]:
    """Return the values of a fact in the unit of its target, from the episodes that have it."""
    names = [field.name for field in fields(TrafficFacts)]
    episodes = (TrafficFacts(**{name: nan if row[name] is None else row[name] for name in names}) for row in rows)
    return [value for facts in episodes if isfinite(value := TARGETS[target].factor * getattr(facts, target))]


def total_deviation(rows: Table) -> float:
    """Return the root mean square deviation from the targets; infinity if no episode has one of the facts."""
    deviations = [TARGETS[name].deviation(value) for name, value in mean_facts(rows).items()]
    return float(np.sqrt(np.mean(np.square(deviations)))) if np.isfinite(deviations).all() else inf


def facts_table(folder: Path) -> pd.DataFrame:
    """Return each fact of the best candidate, its target and the source of the target."""
    rows_by_step = {step: read_part(folder, BEST_PART)[f"{step:g} s"]["episodes"] for step in SIMULATION_STEPS}
    table: Table = []
    for name, target in TARGETS.items():
        row: dict[str, Any] = {"fact": target.name, "target": "{:g} to {:g}".format(*target.accepted)}
        for step, rows in rows_by_step.items():
            row[f"step of {step:g} s"] = mean_text(fact_values(rows, name), target.digits)
        table.append({**row, "source": target.source})
    row = {"fact": "mean delay with that at the entrance [s]", "target": "within 10 % of each other"}
    for step, rows in rows_by_step.items():
        row[f"step of {step:g} s"] = mean_text([episode["delay"] for episode in rows], 0)
    table.append({**row, "source": NO_VALUE_TEXT})
    return pd.DataFrame(table)


def traffic_candidates_table(folder: Path) -> pd.DataFrame:
    """Return the settings and facts of all candidates, ordered by their deviation."""
    candidates = read_part(folder, CANDIDATES_PART)
    candidates.sort(key=lambda candidate: total_deviation(candidate["episodes"]))
    return pd.DataFrame(map(_candidate_row, candidates))


def _candidate_row(candidate: Mapping[str, Any]) -> dict[str, Any]:
    settings, deviation = candidate["settings"], total_deviation(candidate["episodes"])
    facts = {
        TARGETS[name].name: f"{value:.{TARGETS[name].digits}f}" if isfinite(value) else NO_VALUE_TEXT
        for name, value in mean_facts(candidate["episodes"]).items()
    }
    lane_changing = {
        name: "{:g} to {:g}".format(*value) if isinstance(value, Sequence) else f"{value:g}"
        for name, value in settings["lane_changing"].items()
    }
    return {
        "deviation": f"{deviation:.2f}" if isfinite(deviation) else NO_VALUE_TEXT,
        "time headways [s]": "{:g} to {:g}".format(*settings["time_headways"]),
        "accelerations [m/s²]": "{:g} to {:g}".format(*settings["accelerations"]),
        **{name.replace("_", " "): lane_changing.get(name, NO_VALUE_TEXT) for name in CHANGING_COLUMNS},
        **facts,
    }


def effects_table(folder: Path) -> pd.DataFrame:
    """Return the change of each fact per standard deviation of each setting, by regression without candidate 0."""
    candidates = read_part(folder, CANDIDATES_PART)[1:]
    columns = [np.array([read_factor(row["settings"]) for row in candidates]) for read_factor in FACTORS.values()]
    standardized = np.array([(values - values.mean()) / values.std() for values in columns])
    facts = [mean_facts(candidate["episodes"]) for candidate in candidates]
    table: Table = []
    for name, target in TARGETS.items():
        values = np.array([means[name] for means in facts])
        is_known = np.isfinite(values)
        design = np.vstack([np.ones(is_known.sum()), standardized[:, is_known]]).T
        coefficients = np.linalg.lstsq(design, values[is_known], rcond=None)[0]
        explained = 1.0 - np.var(values[is_known] - design @ coefficients) / np.var(values[is_known])
        changes = {name: f"{value:+.{target.digits}f}" for name, value in zip(FACTORS, coefficients[1:], strict=True)}
        table.append({"fact": target.name, **changes, "explained": f"{100 * explained:.0f} %"})
    return pd.DataFrame(table)


FACTORS: dict[str, Callable[[Mapping[str, Any]], float]] = {
    "time headway": lambda settings: settings["time_headways"][0],
    "acceleration": lambda settings: settings["accelerations"][0],
    "assertiveness": lambda settings: settings["lane_changing"]["assertiveness"][1],
    "speed gain": lambda settings: settings["lane_changing"]["speed_gain"][1],
    "keep right": lambda settings: settings["lane_changing"]["keep_right"][0],
    "speed cooperation": lambda settings: settings["lane_changing"]["speed_cooperation"][0],
    "uncooperative share": lambda settings: settings["lane_changing"]["uncooperative_share"],
}
"""functions that return a varied setting of a candidate, by name in the table"""
CHANGING_COLUMNS = ("assertiveness", "speed_cooperation", "uncooperative_share")
HUMAN_TRAFFIC_STUDY = Study(
    title="human traffic on a motorway compared with empirical facts",
    make_parts=lambda study_folder, seeds: {
        **{f"{CANDIDATES_PART}/{number}": (measure_traffic_candidate, (number,)) for number in range(CANDIDATES)},
        **{f"{BEST_PART}/{step:g} s": (measure_step, (POPULATIONS[0], step)) for step in SIMULATION_STEPS},
    },
    minutes=45.0,
    tables={"facts": facts_table, "candidates": traffic_candidates_table, "effects": effects_table},
)
