from typing import Any

import numpy as np
import pytest

from unjam import check_driver
from unjam.drivers import PISaturation
from unjam.drivers.driver import Driver
from unjam.errors import InputError


class Good(Driver):
    def act(self, state: Any, memory: Any) -> Any:
        return 0.1 * state.speed, memory


class RemembersItself(Good):
    calls = 0

    def act(self, state: Any, memory: Any) -> Any:
        self.calls += 1
        return state.speed + self.calls, memory


class MixesRows(Good):
    def act(self, state: Any, memory: Any) -> Any:
        return state.speed - state.speed.mean(), memory


class WritesIntoMemory(Good):
    def initial_memory(self, n: int) -> Any:
        return {"last": np.zeros(n)}

    def act(self, state: Any, memory: Any) -> Any:
        memory["last"] += 0.0 * state.speed + 1.0
        return state.speed * 0.0, memory


class WritesIntoState(Good):
    def act(self, state: Any, memory: Any) -> Any:
        state.leader_gap.fill(7.0)
        return state.speed * 0.0, memory


class RemembersNoDict(Good):
    def initial_memory(self, n: int) -> Any:
        return np.zeros(n)


class Forgets:
    def initial_memory(self, n: int) -> Any:
        return {}

    def act(self, state: Any, memory: Any) -> Any:
        return 0.0 * state.speed


class NotFinite(Good):
    def act(self, state: Any, memory: Any) -> Any:
        return np.log(state.speed), memory  # some vehicles stand


class WrongShape(Good):
    def act(self, state: Any, memory: Any) -> Any:
        return state.speed[:, None], memory


class Words(Good):
    def act(self, state: Any, memory: Any) -> Any:
        return "full speed", memory


class Nothing:
    pass


@pytest.mark.parametrize("driver", [Good(), PISaturation()])
def test_accepts_good_drivers(driver: Any) -> None:
    check_driver(driver)


@pytest.mark.filterwarnings("ignore:divide by zero")
@pytest.mark.parametrize(
    ("driver", "words"),
    [
        (RemembersItself(), "step 0: the same state and memory gave another acceleration"),
        (MixesRows(), "step 0: row 0 gave .* alone and .* among 8 rows"),
        (WritesIntoMemory(), r"step 0: act\(\) changed the memory"),
        (WritesIntoState(), r"step 0: act\(\) changed the state"),
        (RemembersNoDict(), r"initial_memory\(8\) returns the memory .*; allowed: a dict of arrays"),
        (Forgets(), r"act\(\) returns .*; allowed: \(accelerations, memory\)"),
        (NotFinite(), r"step \d: acceleration is -inf"),
        (WrongShape(), r"step 0: acceleration has shape \(8, 1\)"),
        (Words(), "step 0: acceleration is not numbers"),
        (Nothing(), "neither a function nor a class"),
    ],
)
def test_names_what_is_wrong_and_in_which_step(driver: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        check_driver(driver)


def test_what_motorways_tell_is_there_where_it_is_asked_for() -> None:
    def as_allowed(state: Any) -> Any:
        return 0.3 * (state.allowed_speed - state.speed)

    check_driver(as_allowed, optional_fields=True)
    with pytest.raises(InputError, match="driver: step 0: TypeError: "):
        check_driver(as_allowed)
