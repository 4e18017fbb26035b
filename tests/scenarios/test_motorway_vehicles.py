"""Trucks, ordinary ACC cars and ways to change lanes on a motorway: who drives what."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unjam.errors import InputError
from unjam.scenarios import Motorway, make_scenario
from unjam.scenarios.motorway import ON_RAMP
from unjam.scenarios.motorway_road import MotorwayRoad
from unjam.scenarios.motorway_vehicles import LaneChanging, OrdinaryACC, Trucks


def drawn(seed: int = 0, **changes: object) -> MotorwayRoad:
    scenario = replace(ON_RAMP, **changes)
    assert isinstance(scenario, Motorway)
    return scenario.draw(np.random.default_rng(seed))


def test_trucks_and_ordinary_acc_cars_replace_humans_and_change_nothing_else() -> None:
    people = drawn()
    mixed = drawn(trucks=Trucks(share=0.2), ordinary_acc=OrdinaryACC(share=0.3))
    for before, after in zip(people.entries, mixed.entries, strict=True):
        assert after._replace(vehicle_type="") == before._replace(vehicle_type="")
        assert after.vehicle_type.startswith("truck_") or after.vehicle_type.endswith(before.vehicle_type)
    humans = {name: kind for name, kind in mixed.vehicle_types.items() if name.startswith("human_")}
    assert humans == people.vehicle_types
    kinds = [entry.vehicle_type.split("_")[0] for entry in mixed.entries]
    assert kinds.count("truck") / len(kinds) == pytest.approx(0.2, abs=0.03)
    assert kinds.count("acc") / len(kinds) == pytest.approx(0.3, abs=0.03)


def test_no_truck_becomes_a_cav_and_the_rate_is_that_of_cars() -> None:
    road = drawn(trucks=Trucks(share=0.5), penetration_rate=0.2)
    trucks = {entry.name for entry in road.entries if road.vehicle_types[entry.vehicle_type].vehicle_class == "truck"}
    assert trucks
    assert not trucks & road.cav_ids
    assert len(road.cav_ids) / (len(road.entries) - len(trucks)) == pytest.approx(0.2, abs=0.03)


def test_an_ordinary_acc_keeps_the_desired_speed_and_lane_changing_of_its_driver() -> None:
    acc = OrdinaryACC(share=1.0, time_gap=1.9)
    road = drawn(ordinary_acc=acc, lane_changing=LaneChanging(assertiveness=(1.0, 2.0)))
    for entry in road.entries:
        own, human = (
            road.vehicle_types[name] for name in (entry.vehicle_type, entry.vehicle_type.removeprefix("acc_"))
        )
        assert (own.time_headway, own.model) == (1.9, "IDM")
        assert (own.speed_factor, own.parameters, own.length) == (human.speed_factor, human.parameters, human.length)


@given(low=st.floats(0.1, 2.0), width=st.floats(0.0, 2.0), share=st.floats(0.0, 1.0), seed=st.integers(0, 2**32))
def test_drivers_change_lanes_within_the_ranges_and_some_never_cooperate(
    low: float, width: float, share: float, seed: int
) -> None:
    changing = LaneChanging(assertiveness=(low, low + width), cooperation=(0.5, 0.7), uncooperative_share=share)
    generator = np.random.default_rng(seed)
    drivers = [dict(changing.draw(generator)) for _ in range(200)]
    assert all(low - 1e-4 <= driver["lcAssertive"] <= low + width + 1e-4 for driver in drivers)
    uncooperative = [driver for driver in drivers if driver["lcCooperative"] == 0.0]
    assert all(each["lcCooperativeSpeed"] == 0.0 for each in uncooperative)
    assert all(0.5 <= driver["lcCooperative"] <= 0.7 for driver in drivers if driver not in uncooperative)
    assert len(uncooperative) / 200 == pytest.approx(share, abs=0.15)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trucks.share": 1.5}, "trucks.share: 1.5"),
        ({"trucks.accelerations": [0.8, 0.5]}, r"accelerations: \(0.8, 0.5\) is not allowed; allowed: 0 < low <= high"),
        ({"trucks.share": 0.7, "ordinary_acc.share": 0.6}, "trucks.share [+] ordinary_acc.share: 1.3 is not allowed"),
        ({"lane_changing.cooperation": [0.5, 1.5]}, "lane_changing.cooperation"),
        ({"lane_changing.speed_gain": [2.0, 1.0]}, r"speed_gain: \(2, 1\) is not allowed; allowed: low <= high"),
        ({"peak_rise": 400}, "peak_rise: 400 is not allowed; allowed: <= 300"),
        ({"roadside.source": "radar"}, "roadside.source: 'radar'"),
    ],
)
def test_invalid_values_are_reported_in_one_line(changes: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_scenario("on-ramp", changes)


def test_demand_rises_before_the_peak_and_falls_after_it() -> None:
    times = np.array(
        [
            entry.time
            for seed in range(6)
            for entry in drawn(seed, peak=(900.0, 1200.0), peak_rise=600.0, inflow=3600.0).entries
            if entry.route == "motorway"
        ]
    )

    def flow(begin: float, end: float) -> float:
        return float(((times >= begin) & (times < end)).sum()) / 6 * 3600.0 / (end - begin)

    assert flow(0.0, 300.0) == pytest.approx(1800.0, rel=0.1)
    assert flow(540.0, 660.0) == pytest.approx(2700.0, rel=0.1)
    assert flow(900.0, 1200.0) == pytest.approx(3600.0, rel=0.07)
    assert flow(1440.0, 1560.0) == pytest.approx(2700.0, rel=0.1)
    assert flow(1800.0, 2400.0) == pytest.approx(1800.0, rel=0.1)
