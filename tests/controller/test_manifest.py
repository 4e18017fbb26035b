import json
from pathlib import Path

import numpy as np
import pytest

from tests.controller.test_file import ALL_PARTS, residual
from unjam.controller.manifest import driver_interface
from unjam.drivers import IDM, Driver, FollowerStopper, LocalState, Pacer, PISaturation
from unjam.drivers.check import random_state
from unjam.drivers.local_state import COMMON_FIELDS
from unjam.drivers.observation import observation_inputs
from unjam.drivers.user_driver import FileDriver
from unjam.drivers.wrappers import MixedDriver
from unjam.tree import leaves

DRIVERS: dict[str, Driver] = {
    "expert": PISaturation(window=20),
    "nothing remembered": IDM(),
    "residual": residual(PISaturation()),
    "held": residual(Pacer(), hold=7),
    "nested": residual(residual(PISaturation(), 1, hold=3), 2),
    "mixed": MixedDriver((residual(FollowerStopper()), IDM())),
}


@pytest.mark.parametrize("name", DRIVERS)
def test_memory_is_what_the_driver_starts_with(name: str) -> None:
    driver, said = DRIVERS[name], driver_interface(DRIVERS[name])["memory"]
    memory = dict(leaves(driver.initial_memory(1)))
    assert [entry["name"] for entry in said] == list(memory)
    for entry in said:
        first = np.nan if entry["initial"] is None else entry["initial"]
        np.testing.assert_array_equal(np.full((1, *entry["shape"]), first), memory[entry["name"]])


@pytest.mark.parametrize("name", DRIVERS)
def test_it_is_plain_json(name: str) -> None:
    said = driver_interface(DRIVERS[name], 1.5)
    assert json.loads(json.dumps(said, allow_nan=False)) == said


def test_what_is_observed_is_in_the_order_of_a_local_state() -> None:
    said = driver_interface(IDM())["observation"]
    assert [entry["name"] for entry in said] == list(COMMON_FIELDS)
    assert {entry["unit"] for entry in said} == {"m", "m/s"}


def test_what_a_network_sees_is_told_with_its_scale() -> None:
    """A local state in which every number is its scale is seen as ones."""
    said = driver_interface(residual(PISaturation()))["networks"]
    assert list(said) == [""]
    scales = {entry["name"]: entry["scale"] for entry in said[""]}
    speed, loop = np.array([scales["own speed"]]), np.array([scales["loop length"]])
    state = LocalState(
        speed,
        speed + scales["leader speed - own speed"],
        np.array([scales["leader gap"]]),
        speed + scales["follower speed - own speed"],
        np.array([scales["follower gap"]]),
        np.array([scales["route position"]]),
        loop,
    )
    driver = residual(PISaturation())
    seen = driver.observation(state, driver.initial_memory(1))[0]
    expected = [1.0] * len(said[""])
    for index, entry in enumerate(said[""]):
        if "sine" in entry["name"] or entry["name"] in ("expert acceleration", "commanded speed"):
            expected[index] = seen[index]  # what the expert makes of it; the mean of one speed is that speed
    np.testing.assert_allclose(seen, expected)


def test_the_networks_are_named_as_their_weights_are() -> None:
    assert list(driver_interface(DRIVERS["nested"])["networks"]) == ["", "expert."]
    assert list(driver_interface(DRIVERS["mixed"])["networks"]) == ["0."]
    assert driver_interface(IDM())["networks"] == {}


@pytest.mark.parametrize("expert", [PISaturation(), Pacer(), IDM(), residual(PISaturation())])
def test_as_many_numbers_are_named_as_are_seen(expert: Driver) -> None:
    driver = residual(expert)
    state = random_state(np.random.default_rng(0), 1)
    seen = driver.observation(state, driver.initial_memory(1))
    assert seen.shape == (1, len(observation_inputs(ALL_PARTS, expert)))


def test_what_a_users_own_expert_remembers_has_numbers_for_names(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        "import numpy as np\n"
        "class Own:\n"
        "    def initial_memory(self, n): return {}\n"
        "    def act(self, state, memory): return state.speed * 0.0, memory\n"
        "    def memory_features(self, memory): return np.zeros((1, 2))\n"
    )
    expert = FileDriver(tmp_path / "own.py", "Own")
    assert [str(number) for number in observation_inputs(("expert_memory",), expert)] == [
        "expert memory 0 / 1",
        "expert memory 1 / 1",
    ]


def test_the_bounds_are_the_drivers_own_or_the_roads() -> None:
    assert driver_interface(residual(IDM()), 9.0)["action"]["high"] == 1.0
    assert driver_interface(IDM(), 1.5)["action"] | {} == {
        "name": "acceleration",
        "unit": "m/s2",
        "low": -1.5,
        "high": 1.5,
    }
    assert driver_interface(IDM())["action"]["low"] is None
    assert driver_interface(residual(IDM(), hold=7))["action_repeat"] == 7
