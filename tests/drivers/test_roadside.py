"""Does a message say what was measured, as late and as smooth as it should?"""

import numpy as np
import pytest

from unjam.drivers.local_state import SECTIONS_AHEAD
from unjam.drivers.roadside import MainRoad, Messages, Roadside

ALLOWED = 30.0
RAMP, RIGHT, LEFT = 0, 1, 2


ROAD = MainRoad(3, 1000.0)


def messages(**how: float) -> Messages:
    return Messages(Roadside(**how), 1.0, np.random.default_rng(0))


def measure(told: Messages, *vehicles: tuple[int, float, float]) -> None:
    ways, places, speeds = zip(*vehicles, strict=True) if vehicles else ((), (), ())
    arrays = np.array(ways, np.intp), np.array(places, float), np.array(speeds, float)
    told.send(ROAD.means(*arrays, ALLOWED))


def ahead(told: Messages, way: int, place: float) -> tuple[np.ndarray, np.ndarray]:
    lane, road = ROAD.ahead(told.arrived, np.array([way]), np.array([place]))
    return lane[0], road[0]


def test_the_mean_of_each_section_of_the_own_lane_counts_from_the_own_section() -> None:
    told = messages()
    measure(told, (RIGHT, 110.0, 10.0), (RIGHT, 190.0, 20.0), (LEFT, 150.0, 24.0), (RIGHT, 305.0, 8.0))
    lane, road = ahead(told, RIGHT, 20.0)
    assert lane[:4].tolist() == [ALLOWED, 15.0, ALLOWED, 8.0]
    assert road[:4].tolist() == [ALLOWED, 18.0, ALLOWED, 8.0]
    assert len(lane) == len(road) == SECTIONS_AHEAD
    lane, _ = ahead(told, LEFT, 150.0)
    assert lane[:2].tolist() == [24.0, ALLOWED]


def test_the_ramp_is_no_part_of_the_road_and_beyond_the_end_all_is_free() -> None:
    told = messages()
    measure(told, (RAMP, 50.0, 3.0), (RIGHT, 950.0, 9.0))
    lane, road = ahead(told, RAMP, 50.0)
    assert (lane[0], road[0]) == (3.0, ALLOWED)
    lane, _ = ahead(told, RIGHT, 950.0)
    assert lane.tolist() == [9.0] + [ALLOWED] * (SECTIONS_AHEAD - 1)


def test_a_message_arrives_late_and_smoothed() -> None:
    late, smooth = messages(age=2.0), messages(smoothing=10.0)
    for step in range(6):
        speed = 20.0 if step == 0 else 10.0
        for told in (late, smooth):
            measure(told, (RIGHT, 50.0, speed))
        assert ahead(late, RIGHT, 0.0)[0][0] == (20.0 if step <= 2 else 10.0)
        expected = 10.0 + 10.0 * np.exp(-step / 10.0)
        assert ahead(smooth, RIGHT, 0.0)[0][0] == pytest.approx(expected)


def test_a_lost_message_leaves_the_one_before() -> None:
    told, heard = messages(loss=0.5), []
    for step in range(400):
        measure(told, (RIGHT, 50.0, float(step)))
        heard.append(ahead(told, RIGHT, 0.0)[0][0])
    came = np.array(heard) == np.arange(400)
    assert came[0]
    assert came.mean() == pytest.approx(0.5, abs=0.08)
    assert (np.diff(heard) >= 0).all()
