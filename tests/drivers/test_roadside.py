"""A roadside message contains the measured speeds, with the configured latency and smoothing."""

from typing import Any

import numpy as np
import pytest

from unjam.drivers.local_state import SECTIONS_AHEAD
from unjam.drivers.roadside import (
    CongestionMonitor,
    MeasuredVehicles,
    RoadSections,
    RoadsideMessages,
    RoadsideSettings,
    SpeedMeasurement,
)
from unjam.physics.idm import IDMParameters, equilibrium_gap

ALLOWED = 30.0
RAMP, RIGHT, LEFT = 0, 1, 2


ROAD = RoadSections(3, 1000.0)


def messages(**settings: Any) -> RoadsideMessages:
    return RoadsideMessages(RoadsideSettings(**settings), 1.0, np.random.default_rng(0))


def vehicles_of(*vehicles: tuple[int, float, float], are_cavs: bool = False) -> MeasuredVehicles:
    lanes, positions, speeds = zip(*vehicles, strict=True) if vehicles else ((), (), ())
    arrays = np.array(lanes, np.intp), np.array(positions, float), np.array(speeds, float)
    return MeasuredVehicles(*arrays, np.full(len(lanes), are_cavs))


def measurement(**settings: Any) -> SpeedMeasurement:
    return SpeedMeasurement(RoadsideSettings(**settings), ROAD, ALLOWED, 1.0)


def measure(roadside: RoadsideMessages, *vehicles: tuple[int, float, float]) -> None:
    roadside.send(measurement().update(vehicles_of(*vehicles)))


def ahead(roadside: RoadsideMessages, way: int, place: float) -> tuple[np.ndarray, np.ndarray]:
    lane, road = ROAD.speeds_ahead(roadside.latest, np.array([way]), np.array([place]))
    return lane[0], road[0]


def test_the_mean_of_each_section_of_the_own_lane_counts_from_the_own_section() -> None:
    roadside = messages()
    measure(roadside, (RIGHT, 110.0, 10.0), (RIGHT, 190.0, 20.0), (LEFT, 150.0, 24.0), (RIGHT, 305.0, 8.0))
    lane, road = ahead(roadside, RIGHT, 20.0)
    assert lane[:4].tolist() == [ALLOWED, 15.0, ALLOWED, 8.0]
    assert road[:4].tolist() == [ALLOWED, 18.0, ALLOWED, 8.0]
    assert len(lane) == len(road) == SECTIONS_AHEAD
    lane, _ = ahead(roadside, LEFT, 150.0)
    assert lane[:2].tolist() == [24.0, ALLOWED]


def test_the_ramp_is_no_part_of_the_road_and_beyond_the_end_all_is_free() -> None:
    roadside = messages()
    measure(roadside, (RAMP, 50.0, 3.0), (RIGHT, 950.0, 9.0))
    lane, road = ahead(roadside, RAMP, 50.0)
    assert (lane[0], road[0]) == (3.0, ALLOWED)
    lane, _ = ahead(roadside, RIGHT, 950.0)
    assert lane.tolist() == [9.0] + [ALLOWED] * (SECTIONS_AHEAD - 1)


def test_a_message_arrives_late_and_smoothed() -> None:
    late, smooth = messages(latency=2.0), messages(smoothing_time=10.0)
    for step in range(6):
        speed = 20.0 if step == 0 else 10.0
        for roadside in (late, smooth):
            measure(roadside, (RIGHT, 50.0, speed))
        assert ahead(late, RIGHT, 0.0)[0][0] == (20.0 if step <= 2 else 10.0)
        expected = 10.0 + 10.0 * np.exp(-step / 10.0)
        assert ahead(smooth, RIGHT, 0.0)[0][0] == pytest.approx(expected)


def test_a_lost_message_leaves_the_one_before() -> None:
    roadside, heard = messages(loss_rate=0.5), []
    for step in range(400):
        measure(roadside, (RIGHT, 50.0, float(step)))
        heard.append(ahead(roadside, RIGHT, 0.0)[0][0])
    came = np.array(heard) == np.arange(400)
    assert came[0]
    assert came.mean() == pytest.approx(0.5, abs=0.08)
    assert (np.diff(heard) >= 0).all()


def test_cavs_share_their_speeds_of_the_last_minute_and_no_other_vehicle_is_known() -> None:
    measured = measurement(source="cavs")
    means = measured.update(vehicles_of((RIGHT, 150.0, 8.0)))
    assert (means == ALLOWED).all()
    means = measured.update(vehicles_of((RIGHT, 150.0, 10.0), are_cavs=True))
    assert means[0, RIGHT, 1] == 10.0
    assert means[0, LEFT, 1] == 10.0  # of a lane without a CAV, all lanes are the best estimate
    assert means[0, LEFT, 2] == ALLOWED
    means = measured.update(vehicles_of((LEFT, 150.0, 20.0), are_cavs=True))
    assert (means[0, RIGHT, 1], means[0, LEFT, 1], means[0, -1, 1]) == (10.0, 20.0, 15.0)
    for _ in range(60):
        means = measured.update(vehicles_of())
    assert (means == ALLOWED).all()


def test_detectors_publish_means_of_passing_vehicles_a_minute_late() -> None:
    measured, published = measurement(source="detectors"), []
    for second in range(240):
        # One vehicle passes the detector at 750 m every ten seconds, first at 20 m/s, then at 10 m/s; another stands.
        speed = 20.0 if second < 60 else 10.0
        moving = [(RIGHT, 750.0 + 0.5 * speed, speed)] if second % 10 == 0 else []
        published.append(measured.update(vehicles_of(*moving, (RIGHT, 550.0, 0.0)))[0, RIGHT])
    assert published[118][7] == ALLOWED
    assert published[119][7] == 20.0
    assert published[178][7] == 20.0
    assert published[179][5:10].tolist() == [10.0] * 5  # every section next to the detector
    assert published[239][0] == ALLOWED
    assert measured.update(vehicles_of())[0, LEFT, 7] == ALLOWED


HUMANS = IDMParameters(desired_speed=40.0, time_headway=1.5)
FREE, FULL, JAM = 30.0, 23.0, 5.0
"""speeds: of calm traffic, near capacity, and in a jam [m/s]"""


def observe(monitor: CongestionMonitor, speed: float, seconds: int, density: float | None = None) -> bool:
    """Whether a section is congested after so long in equilibrium, or at a density [veh/m]."""
    density = 1.0 / (5.0 + equilibrium_gap(speed, HUMANS)) if density is None else density
    counts = np.array([100.0 * density])
    return [bool(monitor.update(counts, counts * speed)[0]) for _ in range(seconds)][-1]


def test_flow_that_rises_with_density_is_free_however_slow_it_is() -> None:
    monitor = CongestionMonitor(1, 1.0)
    for speed in np.arange(38.0, FULL, -0.5):
        assert not observe(monitor, float(speed), 60)
    assert 0.6 * HUMANS.desired_speed > FULL
    assert not observe(monitor, FREE, 300)
    assert not observe(monitor, FULL, 300)


@pytest.mark.parametrize("before", [FREE, FULL])
def test_denser_and_much_slower_than_at_the_highest_flow_is_congestion_until_it_has_gone(before: float) -> None:
    monitor = CongestionMonitor(1, 1.0)
    assert not observe(monitor, before, 600)
    assert observe(monitor, JAM, 120)
    assert observe(monitor, JAM, 3600)
    assert not observe(monitor, before, 600)


def test_what_begins_as_a_jam_is_known_as_one_once_more_flow_was_seen() -> None:
    monitor = CongestionMonitor(1, 1.0)
    assert not observe(monitor, JAM, 1800)
    assert not observe(monitor, FULL, 600)
    assert observe(monitor, JAM, 300)


def test_few_slow_vehicles_are_no_congestion() -> None:
    monitor = CongestionMonitor(1, 1.0)
    observe(monitor, FREE, 600)
    assert not observe(monitor, JAM, 600, density=0.01)


def test_each_section_is_judged_by_itself_and_an_empty_one_is_free() -> None:
    monitor, found = CongestionMonitor(3, 1.0), np.zeros(3, bool)
    for step in range(900):
        counts = np.array([2.0, 2.0 if step < 600 else 9.0, 0.0])
        found = monitor.update(counts, counts * [25.0, 25.0 if step < 600 else 4.0, 0.0])
    assert found.tolist() == [False, True, False]
