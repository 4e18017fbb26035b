"""Facts of motorway traffic, from traffic whose facts are known."""

from math import isnan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unjam.measures.traffic_facts import TrafficFacts, measure_traffic, wave_speed
from unjam.scenarios.motorway import ON_RAMP
from unjam.worlds.record import Episode

FREE, SLOW, LENGTH = 25.0, 8.0, 4.8
HEADWAYS = 2.0, 3.0
"""before and after the breakdown, in each lane [s]"""
BREAKDOWN, DURATION = 1200, 2400


def make_episode(breaks_down: bool = True) -> Episode:
    """Return two lanes of equal vehicles that are slow upstream of the ramp after the breakdown.

    Every fifth vehicle changes lanes at -1,000 m.
    """
    entries = np.concatenate([np.arange(0.0, BREAKDOWN, HEADWAYS[0]), np.arange(BREAKDOWN, DURATION, HEADWAYS[1])])
    lanes = np.repeat([0, 1], len(entries))
    entries = np.tile(entries, 2)
    positions = np.full((DURATION + 1, len(entries)), np.nan)
    speeds = np.full_like(positions, np.nan)
    now = np.full(len(entries), -2000.0)
    for second in range(DURATION + 1):
        on_road = (entries <= second) & (now < 1000.0)
        speed = np.where((now < 0.0) & (second >= BREAKDOWN) & breaks_down, SLOW, FREE)
        positions[second], speeds[second] = np.where(on_road, now, np.nan), np.where(on_road, speed, np.nan)
        now = np.where(on_road, now + speed, now)
    changes = (np.arange(len(entries)) % 5 == 0) & (positions > -1000.0)
    lane_indices = np.where(np.isnan(positions), np.nan, np.where(changes, 1 - lanes, lanes))
    spacing = np.where(np.arange(len(entries)) % (len(entries) // 2) == 0, np.nan, speeds * 0.0)
    leaders = np.roll(positions, 1, axis=1) + spacing
    return Episode(
        seed=(0,),
        status="completed",
        control_step=1.0,
        speeds=speeds,
        positions=positions,
        gaps=leaders - LENGTH - positions,
        lane_indices=lane_indices,
    )


@pytest.fixture(scope="module")
def facts() -> TrafficFacts:
    return measure_traffic(make_episode(), ON_RAMP)


def test_a_breakdown_shows_capacity_and_its_drop(facts: TrafficFacts) -> None:
    assert facts.breakdown_time == pytest.approx(BREAKDOWN, abs=60.0)
    assert facts.highest_flow == pytest.approx(3600.0 / HEADWAYS[0], rel=0.01)
    assert facts.flow_before == pytest.approx(3600.0 / HEADWAYS[0], rel=0.01)
    assert facts.discharge == pytest.approx(3600.0 / HEADWAYS[1], rel=0.01)
    assert facts.capacity_drop == pytest.approx(1.0 - HEADWAYS[0] / HEADWAYS[1], abs=0.01)
    assert facts.congested_speed == pytest.approx(SLOW)


def test_time_gaps_are_those_of_followers(facts: TrafficFacts) -> None:
    assert facts.free_time_gap == pytest.approx(HEADWAYS[0] - LENGTH / FREE, rel=0.01)
    assert facts.congested_time_gap == pytest.approx(HEADWAYS[1] - LENGTH / SLOW, rel=0.01)


def test_lane_changes_are_counted_per_vehicle_and_km_far_from_the_ramp(facts: TrafficFacts) -> None:
    assert facts.lane_changes_per_km == pytest.approx(0.2 / 1.2, rel=0.1)


def test_without_a_breakdown_only_the_flow_is_known() -> None:
    facts = measure_traffic(make_episode(breaks_down=False), ON_RAMP)
    assert facts.highest_flow == pytest.approx(3600.0 / HEADWAYS[0], rel=0.01)
    unknown = ("breakdown_time", "flow_before", "discharge", "capacity_drop", "wave_speed", "congested_time_gap")
    assert all(isnan(getattr(facts, name)) for name in unknown)


@given(speed=st.floats(3.0, 8.0), wavelength=st.floats(1500.0, 2500.0), phase=st.floats(0.0, 6.0))
def test_the_speed_of_a_wave_is_that_with_which_it_moves_upstream(
    speed: float, wavelength: float, phase: float
) -> None:
    places, times = np.arange(-1690.0, 0.0, 20.0), np.arange(0.0, 1200.0, 1.0)
    angle = 2.0 * np.pi * (places + speed * times[:, None]) / wavelength + phase
    found = wave_speed(np.broadcast_to(places, angle.shape), 10.0 + 5.0 * np.sin(angle), 1.0)
    assert found == pytest.approx(-speed, rel=0.05)


def test_steady_traffic_has_no_waves() -> None:
    places = np.broadcast_to(np.arange(-1690.0, 0.0, 20.0), (1200, 85))
    assert isnan(wave_speed(places, np.full(places.shape, 10.0), 1.0))
