import numpy as np
import pytest
import torch

from unjam.drivers.speed_history import MIN_SPARE_STEPS, CircularWindow, empty_window, slide_window, window_mean_speed
from unjam.errors import InputError

ROWS = 3


def tensors(memory: dict) -> dict:
    return {key: torch.tensor(values) for key, values in memory.items()}


def record_speeds(steps: int, speeds: np.ndarray) -> dict:
    memory = empty_window(ROWS, float(steps), 1.0)
    for speed in speeds:
        memory = slide_window(memory, speed)
    return memory


@pytest.mark.parametrize("steps", [1, 7, 100])
@pytest.mark.parametrize("before", [0, 3, 250])
def test_tensors_remember_what_arrays_do(steps: int, before: int) -> None:
    generator = np.random.default_rng(0)
    expected = record_speeds(steps, generator.uniform(0, 9, (before, ROWS)))
    found = tensors(expected)
    for speed in generator.uniform(0, 9, (3 * (steps + MIN_SPARE_STEPS), ROWS)):
        expected, found = slide_window(expected, speed), slide_window(found, torch.tensor(speed))
        np.testing.assert_allclose(window_mean_speed(found).numpy(), window_mean_speed(expected), atol=1e-10)


def test_rows_of_different_age_keep_their_own_windows() -> None:
    generator = np.random.default_rng(1)
    ages = [2, 5, 12]
    alone = [record_speeds(5, generator.uniform(0, 9, (age, ROWS))) for age in ages]
    together = {key: np.stack([memory[key][0] for memory in alone]) for key in alone[0]}
    found = tensors(together)
    for speed in generator.uniform(0, 9, (20, ROWS)):
        together, found = slide_window(together, speed), slide_window(found, torch.tensor(speed))
        np.testing.assert_allclose(window_mean_speed(found).numpy(), window_mean_speed(together), atol=1e-12)


@pytest.mark.parametrize("after", [0, 1, MIN_SPARE_STEPS - 1, MIN_SPARE_STEPS, 2 * MIN_SPARE_STEPS])
def test_two_memories_may_follow_from_the_same(after: int) -> None:
    """What one of them sees changes neither the other nor what they came from."""
    generator = np.random.default_rng(2)
    memory = slide_window(tensors(empty_window(ROWS, 9.0, 1.0)), torch.ones(ROWS, dtype=torch.float64))
    for speed in generator.uniform(0, 9, (after, ROWS)):
        memory = slide_window(memory, torch.tensor(speed))
    expected = slide_window(memory, torch.full((ROWS,), 3.0, dtype=torch.float64))
    other = slide_window(memory, torch.full((ROWS,), 8.0, dtype=torch.float64))
    for _ in range(30):
        other = slide_window(other, torch.full((ROWS,), 8.0, dtype=torch.float64))
    again = slide_window(memory, torch.full((ROWS,), 3.0, dtype=torch.float64))
    for speed in generator.uniform(0, 9, (30, ROWS)):
        expected, again = (slide_window(one, torch.tensor(speed)) for one in (expected, again))
        np.testing.assert_array_equal(window_mean_speed(again).numpy(), window_mean_speed(expected).numpy())


@pytest.mark.parametrize("before", [0, 3, 40])
def test_rows_that_share_nothing_remember_what_arrays_do(before: int) -> None:
    generator = np.random.default_rng(3)
    expected = record_speeds(7, generator.uniform(0, 9, (before, ROWS)))
    found = tensors(expected)
    for speed in generator.uniform(0, 9, (30, ROWS)):
        rows, kept = CircularWindow(found["window"], found["count"]), found["window"].clone()
        after = slide_window({**found, "window": rows}, torch.tensor(speed))
        expected = slide_window(expected, speed)
        np.testing.assert_allclose(window_mean_speed(after).numpy(), window_mean_speed(expected), atol=1e-12)
        np.testing.assert_array_equal(found["window"].numpy(), kept.numpy())
        found = {**after, "window": after["window"].rows}
        np.testing.assert_array_equal(found["window"].numpy(), expected["window"])


@pytest.mark.parametrize(("window", "step"), [(1e12, 0.1), (1.0, 1e-9), (1e308, 1e-300)])
def test_a_window_that_would_fill_the_memory_is_refused(window: float, step: float) -> None:
    with pytest.raises(InputError, match=r"window: .* is not allowed; allowed: at most 1,000,000 steps"):
        empty_window(1, window, step)
