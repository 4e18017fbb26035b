"""Settings of scenarios that are far too large or small: no file of a few bytes may take all memory, or a year."""

from dataclasses import asdict
from itertools import chain
from typing import Any

import numpy as np
import pytest

from unjam.errors import InputError
from unjam.parameters import flatten_keys
from unjam.scenarios import SCENARIOS, make_scenario

EXTREMES = 1e300, 1e-300
LARGE_INTEGERS = 2**62, 10**9
ROADS = "ring", "figure-eight", "merge", "on-ramp", "recorded"


def extreme_values(value: Any) -> list[Any]:
    if isinstance(value, bool):
        return []
    if isinstance(value, int | float):
        return list(LARGE_INTEGERS if isinstance(value, int) else EXTREMES)
    if isinstance(value, tuple) and value and isinstance(value[0], int | float):
        return [[each] * len(value) for each in extreme_values(value[0])]
    return []


def settings_of(road: str) -> dict[str, Any]:
    scenario = asdict(SCENARIOS[road])
    ramps = [flatten_keys({"ramps": {"0": ramp}}) for ramp in scenario.get("ramps", ())]
    return flatten_keys(scenario) | dict(chain.from_iterable(each.items() for each in ramps))


@pytest.mark.long
@pytest.mark.parametrize("road", ROADS)
def test_a_road_of_extreme_settings_is_refused_or_drawn_at_once(road: str) -> None:
    accepted = 0
    for name, value in settings_of(road).items():
        for extreme in extreme_values(value):
            try:
                scenario = make_scenario(road, {name: extreme})
                scenario.draw(np.random.default_rng(0))
                ids, summary = scenario.possible_cav_ids(), scenario.summary()
            except (InputError, ArithmeticError):  # one line, too
                continue
            assert len(ids) <= 1_000_000
            assert summary
            accepted += 1
    assert accepted > 10  # a setting without influence on time and memory


@pytest.mark.parametrize(
    ("road", "changes", "message"),
    [
        ("merge", {"inflow": 1e12}, "vehicles of an episode: 1.66"),
        ("merge", {"ramp_flow": 1e12}, "vehicles of an episode: 1.66"),
        ("merge", {"humans.max_acceleration": 1e-9, "humans.desired_speed": 1e-3}, "at most 3600 s for 7"),
        ("motorway", {"min_entry_headway": 0.0, "inflow": 1e12}, "vehicles of an episode: 1.3"),
        ("motorway", {"peak": [1e12, 1e12], "peak_rise": 1e12}, "peak_rise: 1000000000000.0 is not allowed"),
        ("motorway", {"roadside.detector_spacing": 1e-9}, "detector_spacing: 1e-09 is not allowed"),
        ("ring", {"vehicles": 10**8, "length": 10**7}, "vehicles of an episode|length: "),
        ("ring", {"warmup": 10**12}, "steps_per_control_step, warmup: 1.0"),
        ("ring", {"steps_per_control_step": 10**12}, "steps_per_control_step, warmup: 3e"),
        *(
            ("ring", {"simulation_step": 0.001, f"actuator.{name}": 60.0}, f"actuator.{name}: 60")
            for name in ("delay", "lag")
        ),
        ("ring", {"horizon": 10**7, "humans.desired_speed": 1e6}, "meters of an episode at top speed: 1e"),
        *((road, {"horizon": 10**9}, "horizon: 1000000000 is not allowed") for road in ROADS),
        *((road, {"simulation_step": 0.0014}, "simulation_step: 0.0014 is not allowed") for road in ROADS),
        *((road, {"simulation_step": 1e-300}, "simulation_step: 1e-300 is not allowed") for road in ROADS),
    ],
)
def test_a_road_without_end_or_of_all_memory_is_refused(road: str, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_scenario(road, changes).draw(np.random.default_rng(0))
