"""An ensemble of 24 motorways with different roads, demands and human traffic, one half for tuning, one for tests.

The settings are a balanced random design that was drawn before any tuning. The demand of a setting is relative to its
capacity, the flow that the same traffic reaches before it breaks down.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from unjam.drivers import Human
from unjam.measures.effect import TIME_METRIC
from unjam.measures.metrics import measure
from unjam.scenarios import Motorway, make_scenario
from unjam.seeds import tuning_seeds
from unjam.worlds.episode import run_episode
from unjam_paper.human_traffic import POPULATIONS, TARGETS, fact_values, measure_scenario
from unjam_paper.results_file import read_part
from unjam_paper.study import Study, Table, mean_text

SETTINGS_PER_HALF, DESIGN_SEED = 12, 20261128
CAPACITY_SEEDS = 5
"""number of episodes from which the capacity of a setting is measured"""
RAMP_SHARE, OFF_PEAK_SHARE = 0.15, 0.6
"""share of all ramps in the demand; demand before and after the peak, relative to the capacity"""
ROADS: dict[str, dict[str, Any]] = {
    "two lanes": {"ramps": [{"position": 3000.0}]},
    "three lanes": {"lanes": 3, "ramps": [{"position": 3000.0}]},
    "two ramps": {"length": 5500.0, "ramps": [{"position": 3000.0}, {"position": 4500.0}]},
    "lane drop": {"ramps": [{**{"position": 2500.0, "merging_length": 500.0, "length": 2000.0}, "speed_limit": 27.78}]},
}
"""a closing lane is a long ramp with the speed limit of the motorway, which vehicles leave in its last 500 m"""
CAPACITY_GUESS, MAX_DEMAND, FREE_DEMAND = 1900.0, 1.3, 0.2
"""flow of a lane [veh/h]; demands relative to it: the highest in measurements of capacity, and one without delays"""
RISING_DEMAND = {"peak": (1800.0, 2400.0), "peak_rise": 1800.0, "horizon": 2400, "penetration_rate": 0.0}
LEVELS: dict[str, Sequence[Any]] = {
    "road": (*("two lanes",) * 5, *("three lanes",) * 3, *("two ramps",) * 2, *("lane drop",) * 2),
    "population": (0, 1, 2) * 4,
    "uncooperative_share": (*(0.0,) * 6, *(0.3,) * 3, *(0.6,) * 3),
    "acceleration": (*(0.0,) * 7, *(0.3,) * 3, *(-0.15,) * 2),
    "trucks": (*(0.08,) * 5, *(0.12,) * 5, *(0.15,) * 2),
    "ordinary_acc": (*(0.0,) * 7, *(0.1,) * 3, *(0.3,) * 2),
    "merging_length": (*(300.0,) * 6, *(200.0,) * 3, *(400.0,) * 3),
    "demand": (*(0.9,) * 2, *(1.02,) * 3, *(1.05,) * 3, *(1.08,) * 2, *(1.15,) * 2),
}
"""levels of each factor in the settings of one half of the ensemble"""


@dataclass(frozen=True)
class EnsembleSetting:
    """One motorway of the ensemble."""

    number: int
    road: str
    population: int
    uncooperative_share: float
    acceleration: float
    """change of all drivers' accelerations [m/s2]"""
    trucks: float
    """share of trucks"""
    ordinary_acc: float
    """share of cars with an ordinary ACC"""
    merging_length: float
    """length of acceleration lanes [m]; lane drops have their own"""
    demand: float
    """demand in the peak, relative to the capacity"""

    @property
    def is_test(self) -> bool:
        """Whether the setting is for tests, and not for tuning."""
        return self.number >= SETTINGS_PER_HALF

    @property
    def capacity(self) -> float:
        """The measured flow of all lanes before a breakdown [veh/h]."""
        return CAPACITIES[self.number] * self.traffic["lanes"]

    @property
    def free_flow_time(self) -> float:
        """The measured mean travel time with little demand [s]."""
        return SETTING_FREE_FLOW_TIMES[self.number]

    @cached_property
    def traffic(self) -> dict[str, Any]:
        """Road and human traffic as settings of a scenario, without the demand."""
        population, road = POPULATIONS[self.population], ROADS[self.road]
        accelerations = tuple(round(limit + self.acceleration, 2) for limit in population["accelerations"])
        # Ramp vehicles enter with the speed of the last one, because a queue may reach the entrance.
        common = {"merging_length": self.merging_length, "entry_speed": "last"}
        ramps = [{**common, **ramp} for ramp in road["ramps"]]
        changes = {
            "accelerations": accelerations,
            "lane_changing": {**population["lane_changing"], "uncooperative_share": self.uncooperative_share},
            "trucks": {"share": self.trucks},
            "ordinary_acc": {"share": self.ordinary_acc},
        }
        return {"length": 4000.0, "lanes": 2, **population, **changes, **road, "ramps": ramps}

    @property
    def unavoidable_delay(self) -> float:
        """Mean delay if the bottleneck always discharged at its capacity, with a queue that has no length [s]."""
        scenario = self.scenario(self.capacity, self.demand)
        seconds = np.arange(scenario.horizon * scenario.control_step)
        is_peak = (seconds >= scenario.peak[0]) & (seconds < scenario.peak[1])
        arrivals = self.capacity / 3600.0 * np.where(is_peak, self.demand, OFF_PEAK_SHARE)
        excess = np.cumsum(arrivals - self.capacity / 3600.0)
        queue = excess - np.minimum(np.minimum.accumulate(excess), 0.0)
        return float(queue.sum() / arrivals.sum())

    def scenario(self, capacity: float, demand: float, **changes: Any) -> Motorway:
        """Return the scenario with a demand in the peak relative to the `capacity` of all lanes [veh/h]."""
        ramps, lanes = self.traffic["ramps"], self.traffic["lanes"]
        # The closing lane has the same flow as each other lane.
        ramp_share = 1.0 / (lanes + 1) if self.road == "lane drop" else RAMP_SHARE / len(ramps)

        main_flows, ramp_flows = (
            {"inflow": round(demand * share * capacity), "off_peak_inflow": round(OFF_PEAK_SHARE * share * capacity)}
            for share in (1.0 - ramp_share * len(ramps), ramp_share)
        )
        settings = {**self.traffic, **main_flows, "ramps": [{**ramp, **ramp_flows} for ramp in ramps]}
        scenario = make_scenario("on-ramp", {**settings, **changes})
        assert isinstance(scenario, Motorway)
        return scenario


def _draw_settings() -> list[EnsembleSetting]:
    """Return the balanced random design: each half has all levels of each factor, in random order."""
    generator, settings = np.random.default_rng(DESIGN_SEED), list[EnsembleSetting]()
    for half in range(2):
        columns = {name: generator.permutation(np.array(levels, object)) for name, levels in LEVELS.items()}
        settings += [
            EnsembleSetting(half * SETTINGS_PER_HALF + row, **{name: values[row] for name, values in columns.items()})
            for row in range(SETTINGS_PER_HALF)
        ]
    return settings


CAPACITIES: tuple[float, ...] = (
    *(1926, 1806, 1627, 1694, 1836, 1758, 1757, 1644, 1766, 1721, 1670, 1579),
    *(1710, 1657, 1717, 1655, 1742, 1744, 1781, 1736, 1787, 1612, 1507, 1877),
)
"""flow of each setting before a breakdown, from the part `capacity` [veh/h per lane]"""
SETTING_FREE_FLOW_TIMES: tuple[float, ...] = (
    *(132.2, 140.7, 133.9, 134.0, 184.4, 136.3, 141.2, 134.1, 136.5, 135.7, 183.9, 134.9),
    *(137.1, 136.5, 137.1, 142.3, 143.1, 185.4, 132.1, 180.1, 131.8, 133.2, 132.5, 133.5),
)
"""travel time of each setting with little demand, from the part `free-flow` [s]"""
SETTINGS = _draw_settings()
"""settings of the ensemble: first the tuning half, then the test half"""


def measure_capacity(number: int, workers: int) -> dict[str, Table]:
    """Return facts of a setting while its demand rises until traffic breaks down, one row for each seed."""
    setting = SETTINGS[number]
    capacity = CAPACITY_GUESS * setting.traffic["lanes"]
    scenario = setting.scenario(capacity, MAX_DEMAND, **RISING_DEMAND)
    return {"episodes": measure_scenario(scenario, tuning_seeds(CAPACITY_SEEDS), workers)}


def measure_free_flow(number: int, workers: int) -> dict[str, float]:
    """Return the mean travel time of a setting with human drivers and little demand [s]."""
    setting = SETTINGS[number]
    capacity = CAPACITY_GUESS * setting.traffic["lanes"]
    scenario = setting.scenario(capacity, FREE_DEMAND, peak=(0.0, 2400.0), penetration_rate=0.0)
    return {"travel_time": measure(run_episode(scenario, Human(), tuning_seeds(1)[0]))[TIME_METRIC]}


def settings_table(folder: Path) -> pd.DataFrame:
    """Return for each setting its factors, flow before a breakdown, capacity drop, speed of waves, and delays."""
    capacities, table = read_part(folder, CAPACITY_PART), list[dict[str, Any]]()
    for setting in SETTINGS:
        rows = capacities[str(setting.number)]["episodes"]
        targets = {name: TARGETS[name] for name in ("highest_flow", "discharge", "capacity_drop")}
        facts = {target.name: mean_text(fact_values(rows, name), target.digits) for name, target in targets.items()}
        # The median is insensitive to single episodes with unrealistic estimates.
        wave, speeds = TARGETS["wave_speed"], fact_values(rows, "wave_speed")
        facts[f"{wave.name}: median (episodes)"] = f"{np.median(speeds):.{wave.digits}f} ({len(speeds)})"
        factors = {field.name.replace("_", " "): getattr(setting, field.name) for field in fields(setting)[1:]}
        times = {"free travel time [s]": setting.free_flow_time, "unavoidable delay [s]": setting.unavoidable_delay}
        texts = {name: f"{value:.0f}" for name, value in times.items()}
        table.append({"half": "test" if setting.is_test else "tuning", **factors, **facts, **texts})
    return pd.DataFrame(table)


CAPACITY_PART, FREE_FLOW_PART = "capacity", "free-flow"
MOTORWAY_ENSEMBLE = Study(
    title="ensemble of motorways: the flow of each setting before it breaks down",
    make_parts=lambda study_folder, seeds: {
        f"{part}/{setting.number}": (function, (setting.number,))
        for part, function in ((CAPACITY_PART, measure_capacity), (FREE_FLOW_PART, measure_free_flow))
        for setting in SETTINGS
    },
    minutes=30.0,
    tables={"settings": settings_table},
)
