"""History features are the means of the past, independent of where the history starts."""

import numpy as np
import pytest

from unjam.drivers import FollowerStopper, PISaturation
from unjam.drivers.check import check_driver
from unjam.drivers.local_state import COMMON_FIELDS, LocalState, state_of_ones
from unjam.drivers.registry import driver_from_recipe, driver_recipe
from unjam.drivers.wrappers import AVERAGING_TIMES, HistoryDriver

STEP = 0.5


def history_features(speeds: np.ndarray, gaps: np.ndarray) -> np.ndarray:
    """What a network sees after moments of one car, shape (3 spans, 3)."""
    driver = HistoryDriver(FollowerStopper(), STEP)
    memory = driver.initial_memory(1)
    for speed, gap in zip(speeds, gaps, strict=True):
        state = state_of_ones(COMMON_FIELDS, np.ones)._replace(speed=np.array([speed]), leader_gap=np.array([gap]))
        _, memory = driver.act(state, memory)
    return np.asarray(driver.memory_features(memory)).reshape(len(AVERAGING_TIMES), 3)


def test_until_a_span_has_passed_all_that_was_watched_counts_alike() -> None:
    generator = np.random.default_rng(0)
    speeds, gaps = generator.uniform(0, 10, 15), generator.uniform(2, 40, 15)
    longest = history_features(speeds, gaps)[-1]
    assert longest == pytest.approx([speeds.mean() / 10, speeds.std() / 2, gaps.mean() / 20], rel=1e-6)


def test_after_a_long_time_what_was_before_is_forgotten_soonest_by_the_shortest_span() -> None:
    speeds = np.repeat([8.0, 2.0], [400, 40])
    means = history_features(speeds, np.full(440, 10.0))[:, 0] * 10
    assert means[0] < means[1] < means[2] < 8.0
    assert means[0] == pytest.approx(2.0 + 6.0 * np.exp(-20.0 / AVERAGING_TIMES[0]), rel=1e-3)


def test_a_warm_up_that_is_recalled_counts_as_if_it_had_been_driven() -> None:
    generator = np.random.default_rng(1)
    speeds = generator.uniform(0, 10, (2, 30))
    history = LocalState(*(speeds + number for number in range(len(COMMON_FIELDS))))
    driver = HistoryDriver(PISaturation(time_step=STEP), STEP)
    recalled = driver.recall(driver.initial_memory(2), history)
    memory = driver.initial_memory(2)
    for moment in range(30):
        _, memory = driver.act(history.select(np.s_[:, moment]), memory)
    for name in ("steps", "mean_speed_10", "mean_square_40", "mean_gap_160"):
        assert np.array_equal(recalled[name], memory[name])


def test_it_drives_as_the_other_does_and_is_made_again_from_its_recipe() -> None:
    driver = HistoryDriver(PISaturation(), 0.1)
    assert driver_from_recipe(*driver_recipe(driver)) == driver
    assert len(driver.memory_inputs) == 2 + 3 * len(AVERAGING_TIMES)
    check_driver(driver)
