import numpy as np
import pytest

from tests.conftest import state_of
from unjam.drivers import LocalState, PIFromGap, PISaturation
from unjam.drivers.check import random_state
from unjam.drivers.driver import Memory

FLOW = PISaturation(time_constant=0, safe_gap_rule="closing", first_command="zero")
AROUND_A_RING = state_of([5, 7.5, 7.5, 8, 7], [7.5, 7.5, 8, 7, 5], [5, 10, 15, 20, 25])


def test_flows_reference_values_on_the_first_call() -> None:
    found, _ = FLOW.act(AROUND_A_RING, FLOW.initial_memory(5))
    np.testing.assert_allclose(np.minimum(found, 20.0), [20, -36.847826, -35.76087, -37.173913, -31.086957], atol=5e-7)


def literal_pi(states: list[tuple[float, float, float]], constant_gap: bool, from_zero: bool) -> list[float]:
    """PI with saturation written down from Eq. 9-11, one vehicle, a list as its history."""
    history: list[float] = []
    command = 0.0 if from_zero else states[0][0]
    found = []
    for speed, leader, gap in states:
        history.append(speed)
        del history[:-380]
        safe_gap = 4.0 if constant_gap else max(2 * (leader - speed), 4.0)
        target = sum(history) / len(history) + 1.0 * min(max((gap - 7.0) / (30.0 - 7.0), 0.0), 1.0)
        alpha = min(max((gap - safe_gap) / 2.0, 0.0), 1.0)
        beta = 1 - alpha / 2
        command = beta * (alpha * target + (1 - alpha) * leader) + (1 - beta) * command
        found.append((command - speed) / 0.1)
    return found


@pytest.mark.parametrize("constant_gap", [True, False])
@pytest.mark.parametrize("from_zero", [True, False])
def test_agrees_with_a_second_implementation_beyond_its_window(constant_gap: bool, from_zero: bool) -> None:
    generator = np.random.default_rng(0)
    states = [random_state(generator, 1) for _ in range(900)]
    driver = PISaturation(
        time_constant=0,
        safe_gap_rule="constant" if constant_gap else "closing",
        first_command="zero" if from_zero else "own-speed",
    )
    memory, found = driver.initial_memory(1), []
    for state in states:
        acceleration, memory = driver.act(state, memory)
        found.append(float(acceleration[0]))
    rows = [(float(s.speed[0]), float(s.leader_speed[0]), float(s.leader_gap[0])) for s in states]
    np.testing.assert_allclose(found, literal_pi(rows, constant_gap, from_zero), atol=1e-9)


def test_time_constant_spreads_the_change_of_speed() -> None:
    quick, _ = PISaturation(time_constant=0).act(AROUND_A_RING, FLOW.initial_memory(5))
    slow, _ = PISaturation(time_constant=3).act(AROUND_A_RING, FLOW.initial_memory(5))
    np.testing.assert_allclose(slow, quick / 30.0)


def test_first_command_is_the_own_speed() -> None:
    driver = PISaturation(time_constant=0)
    state = state_of([6.0], [6.0], [6.0])  # alpha 1, beta 1/2, at the mean: nothing to change
    found, _ = driver.act(state, driver.initial_memory(1))
    assert found[0] == pytest.approx(0.0, abs=1e-12)


def _drive(driver: PISaturation, speeds: list[float], memory: Memory) -> Memory:
    for speed in speeds:
        _, memory = driver.act(state_of([speed], [speed], [20.0]), memory)
    return memory


@pytest.mark.parametrize("watched", [0, 1, 250, 380, 381, 600])
def test_recalled_warmup_counts_like_own_driving(watched: int) -> None:
    generator = np.random.default_rng(5)
    speeds = generator.uniform(0, 8, watched)
    driver = PISaturation()
    columns = [speeds[None, :]] * 7
    recalled = driver.recall(driver.initial_memory(1), LocalState(*columns))
    driven = _drive(driver, speeds.tolist(), driver.initial_memory(1))
    later = generator.uniform(0, 8, 500)
    for speed in later:
        state = state_of([speed], [5.0], [40.0])
        recalled = {**recalled, "command": np.array([5.0])}
        driven = {**driven, "command": np.array([5.0])}
        first, recalled = driver.act(state, recalled)
        second, driven = driver.act(state, driven)
        assert first[0] == pytest.approx(second[0], abs=1e-12)


def test_from_a_standstill_the_gap_says_how_fast_it_begins_and_that_fades() -> None:
    state = state_of([0.0], [0.0], [8.0])
    quick, plain = PIFromGap(human_time_headway=1.5, human_standstill_gap=2.0, fade_time=3.0), PISaturation()
    memory, plain_memory, gained = quick.initial_memory(1), plain.initial_memory(1), []
    for _ in range(40):
        found, memory = quick.act(state, memory)
        expected, plain_memory = plain.act(state, plain_memory)
        gained.append(float(found[0] - expected[0]))
    assert gained[0] == pytest.approx(0.5 * (8.0 - 2.0) / 1.5 / 3.0)  # half is the last command, over 3 s
    assert gained[10] > gained[20] > gained[29] > 0.0


def test_in_traffic_that_was_watched_it_begins_with_a_share_of_the_mean() -> None:
    watched = state_of([[4.0, 6.0]], [[5.0, 5.0]], [[9.0, 9.0]])
    whole, half = (PIFromGap(history_factor=share) for share in (1.0, 0.5))
    state = state_of([5.0], [5.0], [20.0])
    found = []
    for driver in (PISaturation(), whole, half):
        wanted, _ = driver.act(state, driver.recall(driver.initial_memory(1), watched))
        found.append(float(wanted[0]))
    assert found[1] == pytest.approx(found[0])
    assert found[0] - found[2] == pytest.approx(0.5 * 2.5 / 3.0)
