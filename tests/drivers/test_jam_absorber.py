import numpy as np

from tests.conftest import state_of
from unjam.drivers import JamAbsorber, LocalState


def state_at(position: float, speed: float, leader_speed: float, gap: float) -> LocalState:
    return state_of([speed], [leader_speed], [gap])._replace(route_position=np.array([position]))


def test_it_follows_linearly_where_traffic_flows() -> None:
    driver = JamAbsorber(time_gap=1.0, standstill_gap=2.0, gap_gain=0.1, speed_gain=0.5)
    found, memory = driver.act(state_at(-400.0, 18.0, 20.0, 30.0), driver.initial_memory(1))
    assert found == 0.1 * (30.0 - 2.0 - 18.0) + 0.5 * 2.0
    assert memory["is_waiting"] == 0.0


def test_it_crawls_before_a_jam_until_gap_and_speed_of_the_leader_are_large() -> None:
    driver, memory = JamAbsorber(), JamAbsorber().initial_memory(1)
    found = []
    for leader_speed, gap in [(4.0, 20.0), (9.0, 20.0), (4.0, 50.0), (9.0, 50.0), (12.0, 30.0)]:
        acceleration, memory = driver.act(state_at(-400.0, 8.0, leader_speed, gap), memory)
        found.append((memory["is_waiting"][0], acceleration[0] <= 3.5 - 8.0))
    assert found == [(1.0, True), (1.0, True), (1.0, True), (0.0, False), (0.0, False)]


def test_while_it_waits_it_also_keeps_its_time_gap() -> None:
    driver = JamAbsorber(crawl_speed=9.0)
    crawling, memory = driver.act(state_at(-400.0, 8.0, 0.0, 5.0), driver.initial_memory(1))
    assert memory["is_waiting"] == 1.0
    assert crawling < -8.0


def test_it_begins_to_wait_only_within_its_section_and_ends_after_it() -> None:
    for position, waits in [(-600.0, 0.0), (-500.0, 1.0), (-260.0, 0.0), (np.nan, 0.0)]:
        _, memory = JamAbsorber().act(state_at(position, 8.0, 4.0, 20.0), JamAbsorber().initial_memory(1))
        assert memory["is_waiting"] == waits
    for position, waits in [(-230.0, 1.0), (-210.0, 0.0)]:
        _, memory = JamAbsorber().act(state_at(position, 3.0, 4.0, 20.0), {"is_waiting": np.ones(1)})
        assert memory["is_waiting"] == waits


def test_it_does_not_wait_without_a_leader() -> None:
    _, memory = JamAbsorber().act(state_at(-400.0, 8.0, 8.0, 100.0), {"is_waiting": np.ones(1)})
    assert memory["is_waiting"] == 0.0


def test_with_extra_acceleration_and_no_gap_gain_it_closes_up_unless_its_leader_is_slower() -> None:
    driver = JamAbsorber(gap_gain=0, extra_acceleration=0.9, speed_gain=0.8)
    for leader_speed, gap, expected in [(20.0, 60.0, 0.9), (20.0, 3.0, 0.9), (19.0, 3.0, 0.1), (17.0, 60.0, -1.5)]:
        found, memory = driver.act(state_at(-400.0, 20.0, leader_speed, gap), driver.initial_memory(1))
        np.testing.assert_allclose(found, expected)
        assert memory["is_waiting"] == 0.0
