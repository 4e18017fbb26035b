from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch

from tests.conftest import random_network
from unjam.controller import make_driver
from unjam.drivers import IDM, Driver, FollowerStopper, PISaturation, check_driver
from unjam.drivers.check import random_state
from unjam.drivers.driver import Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.registry import driver_from_recipe, driver_recipe
from unjam.drivers.residual import ResidualDriver
from unjam.drivers.safety import Actuator, SafetyFilter
from unjam.drivers.user_driver import as_driver
from unjam.drivers.wrappers import (
    DriverWrapper,
    FilteredDriver,
    HistoryDriver,
    ImpairedDriver,
    MixedDriver,
    RoadTypeSwitch,
)
from unjam.errors import InputError
from unjam.scenarios import Merge, Ring
from unjam.tree import map_leaves
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend

PI, STOPPER = PISaturation(), FollowerStopper()


def test_each_row_drives_as_its_own_driver_would() -> None:
    mixed, memory = MixedDriver((PI, STOPPER)), MixedDriver((PI, STOPPER)).initial_memory(5)
    alone = [PI.initial_memory(5), STOPPER.initial_memory(5)]
    for moment in range(4):
        state = random_state(np.random.default_rng(moment), 5)
        found, memory = mixed.act(state, memory)
        expected = []
        for number, driver in enumerate((PI, STOPPER)):
            wanted, alone[number] = driver.act(state, alone[number])
            expected.append(wanted)
        np.testing.assert_array_equal(found, np.where(np.arange(5) % 2 == 0, *expected))


def test_wrappers_pass_on_what_is_asked_of_the_cars_own_accs() -> None:
    def asked(driver: Driver) -> Any:
        return driver.decide(state, driver.initial_memory(4)).command.time_gap

    state = random_state(np.random.default_rng(1), 4)
    nan, two, asks = np.nan, 2.0, as_driver(AsksForTwoSeconds())
    everyone = [two] * 4
    np.testing.assert_array_equal(asked(MixedDriver((PI, asks, STOPPER))), [nan, two, nan, nan])
    np.testing.assert_array_equal(asked(ImpairedDriver(asks, delay=0.3)), everyone)
    np.testing.assert_array_equal(asked(HistoryDriver(asks, 0.1)), everyone)
    np.testing.assert_array_equal(asked(ResidualDriver(asks, random_network(5), 1.0)), everyone)
    np.testing.assert_array_equal(asked(RoadTypeSwitch(PI, PI, asks, PI)), everyone)
    np.testing.assert_array_equal(asked(asks), everyone)
    assert asked(MixedDriver((PI, STOPPER))) is None
    assert asked(as_driver(lambda state: state.speed * 0.0)) is None


class AsksForTwoSeconds:
    """A driver as a user may bring it."""

    def initial_memory(self, n: int) -> Memory:
        return {}

    def act(self, state: LocalState, memory: Memory) -> tuple[Any, Memory]:
        return state.speed * 0.0, memory

    def time_gaps(self, state: LocalState, memory: Memory) -> Any:
        return np.full(len(state.speed), 2.0)


def test_it_drives_tensors_as_it_drives_arrays() -> None:
    mixed, state = MixedDriver((PI, IDM())), random_state(np.random.default_rng(1), 4)
    assert not mixed.requirements().needs_numpy
    expected, _ = mixed.act(state, mixed.initial_memory(4))
    tensors = state.map(lambda values: torch.as_tensor(values))
    memory = map_leaves(torch.as_tensor, mixed.initial_memory(4))
    np.testing.assert_allclose(mixed.act(tensors, memory)[0].numpy(), expected, atol=1e-12)


def test_the_first_cav_has_the_first_driver_and_the_second_the_second(sumo: SumoBackend) -> None:
    ring = Ring(length=(260, 260), cavs=2, horizon=80)
    driver = make_driver("pi+constant:acceleration=0.3", 0.1)
    first, second = run_episode(ring, driver, (0,), backend=sumo).trajectories
    np.testing.assert_array_equal(second.applied_acceleration, 0.3)
    assert np.ptp(first.applied_acceleration) > 0.1


def test_where_cavs_come_and_go_drivers_take_turns_as_they_enter(sumo: SumoBackend) -> None:
    driver = make_driver("constant:acceleration=0.1+constant:acceleration=0.2", 1.0)
    episode = run_episode(Merge(horizon=90), driver, (0,), backend=sumo)
    entered = sorted(episode.trajectories, key=lambda stay: (stay.start_step, -stay.states.route_position[0]))
    assert len(entered) > 2
    for number, stay in enumerate(entered):
        assert set(stay.applied_acceleration) == {0.1 if number % 2 == 0 else 0.2}


@dataclass(frozen=True)
class Half(DriverWrapper):
    """A wrapper of a user's, in NumPy."""

    driver: Driver

    def act(self, state: LocalState, memory: Memory) -> tuple[Any, Memory]:
        acceleration, after = self.driver.act(state, memory["inner"])
        return np.clip(0.5 * acceleration, -0.2, 0.2)[: len(state.speed)], {"inner": after}


class NumPyIDM(IDM):
    """A formula of a user's whose answer for a single CAV is a number of NumPy."""

    def act(self, state: LocalState, memory: Memory) -> tuple[Any, Memory]:
        acceleration, after = super().act(state, memory)
        return np.clip(acceleration, -0.2, 0.2), after


@pytest.mark.parametrize("driver", [Half(IDM()), NumPyIDM()])
def test_a_class_of_a_user_in_numpy_drives_a_single_cav(driver: Driver, sumo: SumoBackend) -> None:
    episode = run_episode(Ring(horizon=20), driver, (0,), backend=sumo)
    assert np.abs(episode.trajectories[0].applied_acceleration).max() == pytest.approx(0.2)


def test_a_mixture_is_named_and_written_down_like_any_driver() -> None:
    mixed = make_driver("pi:window=1e+1+follower-stopper+idm", 0.1)
    assert mixed.describe() == "pi:window=10.0+follower-stopper+idm"
    assert driver_from_recipe(*driver_recipe(mixed)) == mixed


@pytest.mark.parametrize(("text", "words"), [("pi+human", "human"), ("pi+nonesuch", "nonesuch")])
def test_what_cannot_be_mixed_is_told_in_one_line(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        make_driver(text, 0.1)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("driver", ["idm", "pi"])
def test_it_keeps_the_contract_of_drivers(driver: str) -> None:
    check_driver(ImpairedDriver(make_driver(driver, 0.1), delay=0.3, gap_noise=0.5))


def test_unimpaired_it_is_the_driver_itself() -> None:
    generator = np.random.default_rng(0)
    mine, other = ImpairedDriver(make_driver("pi", 0.1)), PISaturation()
    memory, theirs = mine.initial_memory(3), other.initial_memory(3)
    for _ in range(20):
        state = random_state(generator, 3)
        found, memory = mine.act(state, memory)
        expected, theirs = other.act(state, theirs)
        np.testing.assert_array_equal(found, expected)


def test_what_it_says_is_carried_out_later() -> None:
    generator = np.random.default_rng(0)
    late = ImpairedDriver(make_driver("idm", 0.1), delay=0.3)
    memory, said, done = late.initial_memory(2), [], []
    for _ in range(20):
        state = random_state(generator, 2)
        said.append(IDM().act(state, {})[0])
        found, memory = late.act(state, memory)
        done.append(found)
    np.testing.assert_array_equal(done[:3], np.zeros((3, 2)))
    np.testing.assert_array_equal(done[3:], said[:-3])


def test_it_sees_gaps_with_noise_of_its_own_for_each_vehicle_and_moment() -> None:
    seen: list[Any] = []

    class Eye(Driver):
        def act(self, state: Any, memory: Any) -> Any:
            seen.append((state.leader_gap, state.follower_gap))
            return state.speed * 0.0, memory

    blurred = ImpairedDriver(Eye(), 0.0, 0.5, 0.1)
    memory = blurred.initial_memory(4)
    state = random_state(np.random.default_rng(0), 4)
    state = state._replace(leader_gap=np.full(4, 20.0), follower_gap=np.full(4, 30.0), speed=np.arange(4.0))
    for _ in range(500):
        _, memory = blurred.act(state, memory)
    errors = np.array(seen) - np.array([20.0, 30.0])[:, None]
    assert errors.std() == pytest.approx(0.5, rel=0.05)
    assert abs(errors.mean()) < 0.05
    assert np.abs(np.corrcoef(errors.reshape(500, 8).T) - np.eye(8)).max() < 0.2


def test_an_impaired_driver_travels_to_another_process() -> None:
    late = ImpairedDriver(make_driver("pi:window=10+idm", 0.1), delay=0.3, gap_noise=0.5)
    assert late.describe() == "pi:window=10.0+idm (delay 0.3 s, gap noise 0.5 m)"
    assert driver_from_recipe(*driver_recipe(late)) == late


@pytest.mark.parametrize("actuator", [Actuator(delay=60.0), Actuator(lag=60.0)])
@pytest.mark.parametrize("step", [1e-3, 1e-9])
def test_a_filter_with_a_response_of_very_many_steps_is_refused(actuator: Actuator, step: float) -> None:
    """Each step of the response takes time and memory in each control step."""
    with pytest.raises(InputError, match=r"actuator.(delay|lag): 60 is not allowed; allowed: at most 1,000 steps of"):
        FilteredDriver(PI, 2.0, SafetyFilter(), step, actuator)
