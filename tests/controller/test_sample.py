import numpy as np
import pytest
from safetensors.numpy import load, save

from tests.controller.test_file import residual
from unjam.controller.file import read_sample, replay_states, sample_bytes
from unjam.drivers import LocalState, PISaturation
from unjam.drivers.check import random_state
from unjam.errors import InputError


def perceived(decisions: int = 40, seed: int = 0) -> LocalState:
    """What one CAV perceives, one moment after the other."""
    return random_state(np.random.default_rng(seed), decisions, optional_fields=True)


def test_a_sample_comes_back_with_what_the_driver_answers() -> None:
    driver, states = residual(PISaturation(), hold=3), perceived()
    found, answers = read_sample(sample_bytes(driver, states, 1.0))
    for ours, theirs in zip(found, states, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(answers, replay_states(driver, states, 1.0))


def test_answers_are_those_of_a_driver_that_remembers() -> None:
    driver, states = residual(PISaturation(), hold=3), perceived()
    memory, expected = driver.initial_memory(1), []
    for step in range(len(states.speed)):
        answer, memory = driver.act(states.select([step]), memory)
        expected.append(answer[0])
    np.testing.assert_array_equal(replay_states(driver, states, 1.0), np.clip(expected, -1.0, 1.0))


def test_answers_are_within_the_limit() -> None:
    wild = PISaturation(time_constant=0)
    assert np.abs(replay_states(wild, perceived(), 1e9)).max() > 5.0
    assert np.abs(replay_states(wild, perceived(), 0.5)).max() == 0.5


@pytest.mark.parametrize(
    ("name", "array", "words"),
    [
        ("speed", None, "'speed' is missing"),
        ("weight", np.zeros(40), "'weight' is unknown"),
        ("leader_gap", np.zeros(39), "'leader_gap' has shape"),
        ("leader_gap", np.zeros((40, 1)), "'leader_gap' has shape"),
        ("leader_gap", np.zeros(40, np.float32), "of float32"),
        ("acceleration", np.full(40, np.nan), "not finite"),
        ("acceleration", np.full(40, np.inf), "not finite"),
    ],
)
def test_what_is_no_sample_is_refused(name: str, array: np.ndarray | None, words: str) -> None:
    arrays = load(sample_bytes(PISaturation(), perceived(), 1.0))
    arrays.pop(name, None)
    with pytest.raises(InputError, match="sample: ") as caught:
        read_sample(save(arrays if array is None else {**arrays, name: array}))
    assert words in str(caught.value)
