from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import unjam
from unjam.adapters import PolicyDescription, PolicyInput, PolicyMemory, PolicyOutput, policy_driver
from unjam.drivers.check import random_state
from unjam.drivers.local_state import LocalState
from unjam.drivers.observation import local_observation
from unjam.drivers.pi_saturation import PISaturation
from unjam.drivers.registry import driver_recipe
from unjam.errors import InputError

SHORT: Any = {"horizon": 40, "cavs": 2}


@pytest.fixture
def network() -> torch.nn.Module:
    torch.manual_seed(0)
    return torch.nn.Sequential(torch.nn.Linear(5, 64), torch.nn.Tanh(), torch.nn.Dropout(), torch.nn.Linear(64, 1))


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_a_network_reads_features_and_returns_accelerations(network: torch.nn.Module, kind: torch.dtype) -> None:
    network = network.to(kind)
    driver = policy_driver(network, output=PolicyOutput(scale=2.0))
    unjam.check_driver(driver)
    state = random_state(np.random.default_rng(0), 6)
    found, _ = driver.act(state, driver.initial_memory(6))
    with torch.no_grad():
        expected = 2.0 * network.eval()(torch.as_tensor(local_observation(state), dtype=kind))[:, 0].numpy()
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_a_network_is_added_to_an_expert_within_the_limit(network: torch.nn.Module) -> None:
    driver = policy_driver(network, expert=PISaturation(), output=PolicyOutput(scale=100.0, limits=(-0.5, 0.5)))
    state = random_state(np.random.default_rng(0), 50)
    found, _ = driver.act(state, driver.initial_memory(50))
    assert np.abs(found).max() == 0.5
    assert driver.describe() == "pi + Sequential"


def test_quantities_and_units_are_described_as_for_onnx() -> None:
    network = torch.nn.Linear(2, 1, bias=False, dtype=torch.float64)
    with torch.no_grad():
        network.weight.copy_(torch.tensor([[1.0, 2.0]]))
    inputs = PolicyInput("speed", "km/h", scale=10.0, offset=36.0), PolicyInput("leader_relative_speed")
    driver = policy_driver(network, inputs, output=PolicyOutput("desired_speed", "km/h", limits=(0.0, 54.0)))
    state = LocalState(*(np.array(each) for each in ([20.0, 20.0], [25.0, 60.0], *[[5.0, 5.0]] * 5)))
    found, _ = driver.act(state, driver.initial_memory(2))
    desired = np.array([(72.0 - 36.0) / 10.0 + 2.0 * 5.0, 54.0]) / 3.6
    np.testing.assert_allclose(found, (desired - 20.0) / 0.1)


def test_a_function_of_observations_is_a_policy() -> None:
    driver = policy_driver(lambda rows: rows[:, 0] - 0.1, [PolicyInput("leader_relative_speed")])
    unjam.check_driver(driver)
    state = random_state(np.random.default_rng(0), 6)
    found, _ = driver.act(state, driver.initial_memory(6))
    np.testing.assert_allclose(found, state.leader_speed - state.speed - 0.1)
    with pytest.raises(InputError, match="<lambda>: ZeroDivisionError: division by zero"):
        policy_driver(lambda rows: 1 / 0)


def test_training_a_network_further_does_not_change_its_driver(network: torch.nn.Module) -> None:
    driver = policy_driver(network)
    state = random_state(np.random.default_rng(0), 3)
    before, _ = driver.act(state, driver.initial_memory(3))
    with torch.no_grad():
        network[0].weight.zero_()  # pyright: ignore
    np.testing.assert_array_equal(driver.act(state, driver.initial_memory(3))[0], before)
    assert network.training


def test_a_network_drives_in_this_process(network: torch.nn.Module) -> None:
    driver = policy_driver(network)
    found = unjam.drive("ring", driver, episodes=1, scenario_options=SHORT)
    episode = unjam.run_episode(unjam.make_scenario("ring", SHORT), driver, 0)
    assert float(episode.reward.sum()) == found.rows["Sequential"][0]["return"]


@pytest.mark.parametrize(
    ("module", "words"),
    [
        (torch.nn.Linear(6, 1), "Linear: RuntimeError: mat1 and mat2 shapes cannot be multiplied"),
        (torch.nn.Linear(5, 3), r"driver Linear: returns shape \(2, 3\) for 2 CAVs; allowed: \(2,\) or \(2, 1\)"),
    ],
)
def test_a_network_that_does_not_fit_is_refused(module: torch.nn.Module, words: str) -> None:
    with pytest.raises(InputError, match=words):
        policy_driver(module)


def test_single_precision_is_no_excuse_for_rows_that_influence_each_other() -> None:
    class Mixes(torch.nn.Module):
        def forward(self, observation: Any) -> Any:
            return observation[:, :1] - observation[:, :1].mean()

    with pytest.raises(InputError, match=r"alone and .* among 8 rows"):
        unjam.check_driver(policy_driver(Mixes()))

    def rounds(state: LocalState) -> Any:
        return (0.1 * state.speed).astype(np.float32) + np.float32(1e-7 * len(state.speed))

    unjam.check_driver(rounds)


WRONG: dict[str, tuple[Callable[[], Any], str]] = {
    "a scale of zero": (
        lambda: PolicyInput("speed", scale=0),
        "PolicyInput.scale: 0 is not allowed; allowed: a number other than 0",
    ),
    "a scale by position": (lambda: PolicyInput("speed", "", 0), "PolicyInput.scale: 0 is not allowed"),
    "a text": (
        lambda: PolicyOutput(offset="1"),  # pyright: ignore[reportArgumentType]
        "PolicyOutput.offset: '1' is not allowed; allowed: a valid number",
    ),
    "an unknown name": (lambda: PolicyInput("speed", unitt="m/s"), "unitt: unknown name; did you mean 'unit'?"),  # pyright: ignore[reportCallIssue]
    "an unknown quantity": (
        lambda: PolicyOutput("jerk"),  # pyright: ignore[reportArgumentType]
        "PolicyOutput.quantity: 'jerk' is not allowed; allowed: 'acceleration', ",
    ),
    "a missing name": (lambda: PolicyMemory("h"), "PolicyMemory.output: missing"),  # pyright: ignore[reportCallIssue]
    "reversed limits": (lambda: PolicyOutput(limits=(2, 1)), "PolicyOutput.limits: [2.0, 1.0] is not allowed"),
    "a parameter of a driver": (
        lambda: PISaturation(window=-1),
        "PISaturation.window: -1 is not allowed; allowed: greater than 0",
    ),
    "no inputs": (lambda: PolicyDescription(()), "PolicyDescription.inputs: () is not allowed"),
    "a name as output": (
        lambda: policy_driver(len, output="acceleration"),  # pyright: ignore[reportArgumentType]
        "PolicyDescription.output: 'acceleration' is not allowed",
    ),
    "a name as expert": (
        lambda: policy_driver(len, expert="pi"),  # pyright: ignore[reportArgumentType]
        "driver: 'pi' is not allowed; allowed: an object, such as unjam.make_driver('pi', 0.1)",
    ),
    "a policy in another process": (
        lambda: driver_recipe(policy_driver(lambda rows: rows[:, 0])),
        "in its own process only; allowed: its .onnx file with a description, or, except in export, path.py:name",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_arguments_in_python_get_one_line(name: str) -> None:
    make, words = WRONG[name]
    with pytest.raises(InputError) as caught:
        make()
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
