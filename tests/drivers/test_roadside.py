"""A roadside message contains the measured speeds, with the configured latency and smoothing."""

import numpy as np
import pytest

from unjam.drivers.local_state import SECTIONS_AHEAD
from unjam.drivers.roadside import CongestionMonitor, RoadSections, RoadsideMessages, RoadsideSettings
from unjam.physics.idm import IDMParameters, equilibrium_gap

ALLOWED = 30.0
RAMP, RIGHT, LEFT = 0, 1, 2


ROAD = RoadSections(3, 1000.0)


def messages(**how: float) -> RoadsideMessages:
    return RoadsideMessages(RoadsideSettings(**how), 1.0, np.random.default_rng(0))


def measure(roadside: RoadsideMessages, *vehicles: tuple[int, float, float]) -> None:
    ways, places, speeds = zip(*vehicles, strict=True) if vehicles else ((), (), ())
    arrays = np.array(ways, np.intp), np.array(places, float), np.array(speeds, float)
    roadside.send(ROAD.mean_speeds(*arrays, ALLOWED))


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
