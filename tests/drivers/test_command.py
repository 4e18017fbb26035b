import numpy as np
import pytest

from unjam.drivers.command import (
    Command,
    Limits,
    batch_commanded_accelerations,
    commanded_accelerations,
    commanded_time_gaps,
)
from unjam.errors import InputError

LIMITS = Limits(-1.0, 0.5)


@pytest.mark.parametrize("wanted", [[-3.0, 0.2, 3.0], np.array([-3.0, 0.2, 3.0])])
def test_vehicles_are_told_plain_numbers_within_the_limits(wanted: object) -> None:
    accelerations = commanded_accelerations(Command(wanted), LIMITS, "abc", 0)
    assert accelerations == [-1.0, 0.2, 0.5]
    assert {type(number) for number in accelerations} == {float}


def test_a_plain_number_is_for_one_vehicle() -> None:
    assert commanded_accelerations(Command(2.0), LIMITS, "a", 0) == [0.5]
    with pytest.raises(InputError, match=r"driver: step 4: acceleration has shape \(\); allowed: \(2,\)"):
        commanded_accelerations(Command(2.0), LIMITS, "ab", 4)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("rows", [1, 3, 200])
def test_the_first_that_is_not_finite_is_named(bad: float, rows: int) -> None:
    wanted = np.zeros(rows)
    wanted[rows // 2 :] = bad
    message = f"driver: step 7: acceleration of car {rows // 2} is {bad}; allowed: finite"
    with pytest.raises(InputError) as caught:
        commanded_accelerations(Command(wanted), LIMITS, [f"car {number}" for number in range(rows)], 7)
    assert str(caught.value) == message
    if rows == 1:
        with pytest.raises(InputError, match="acceleration of car 0 is"):
            commanded_accelerations(Command(bad), LIMITS, ["car 0"], 7)


def test_no_command_is_right_where_there_is_nobody() -> None:
    assert commanded_accelerations(None, LIMITS, [], 0) == []
    with pytest.raises(InputError, match=r"driver: step 2: acceleration has shape \(0,\); allowed: \(2,\)"):
        commanded_accelerations(None, LIMITS, "ab", 2)


@pytest.mark.parametrize("command", [None, Command(0.0), Command(np.zeros(3)), Command(np.array([0.0, np.nan]))])
def test_a_batch_requires_a_finite_acceleration_for_each_cav(command: Command | None) -> None:
    with pytest.raises(InputError) as caught:
        batch_commanded_accelerations(command, LIMITS, 2, 4)
    message = "driver: step 4: acceleration is not allowed; allowed: 2 finite numbers, one for each CAV"
    assert str(caught.value) == message


def test_an_answer_without_numbers_is_refused_with_the_allowed_values() -> None:
    with pytest.raises(InputError) as caught:
        commanded_accelerations(Command("fast"), LIMITS, "a", 4)
    assert str(caught.value) == "driver: step 4: acceleration is not numbers: 'fast'; allowed: real numbers"


def test_an_acc_keeps_at_least_its_own_time_headway() -> None:
    assert commanded_time_gaps(Command(np.zeros(3), np.array([np.nan, 0.5, 2.0])), 1.1, "abc", 0) == [1.1, 1.1, 2.0]
    assert commanded_time_gaps(Command(np.zeros(2)), 1.1, "ab", 0) == [1.1, 1.1]
    assert commanded_time_gaps(None, 1.1, [], 0) == []
    with pytest.raises(InputError, match=r"driver: step 4: time gap has shape \(1,\); allowed: \(2,\)"):
        commanded_time_gaps(Command(np.zeros(2), np.ones(1)), 1.1, "ab", 4)


def test_no_acc_keeps_an_infinite_time_headway() -> None:
    asked = Command(np.zeros(2), np.array([2.0, np.inf]))
    with pytest.raises(InputError, match="driver: step 7: time gap of b is inf; allowed: finite, or NaN"):
        commanded_time_gaps(asked, 1.1, "ab", 7)
