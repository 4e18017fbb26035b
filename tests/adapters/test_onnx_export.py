"""Networks of torch are written as ONNX files that describe themselves."""

import logging
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import unjam
from unjam.adapters import PolicyInput, PolicyOutput, onnx_driver, policy_driver, write_onnx_policy
from unjam.drivers import LocalState
from unjam.errors import DiskError, InputError

INPUTS = [PolicyInput("speed", scale=10.0), PolicyInput("leader_relative_speed"), PolicyInput("leader_gap", unit="m")]


def test_a_written_network_drives_as_in_torch(tmp_path: Path) -> None:
    torch.manual_seed(1)
    network = nn.Sequential(nn.Linear(3, 8), nn.Tanh(), nn.Dropout(0.9), nn.Linear(8, 1)).train()
    with warnings.catch_warnings():
        warnings.simplefilter("error", FutureWarning)
        write_onnx_policy(network, tmp_path / "policy.onnx", INPUTS, PolicyOutput(scale=0.5, limits=(-1, 1)), 1.0)
    assert network.training, "the training can go on"
    assert logging.getLogger("torch.onnx").level == logging.NOTSET
    assert [path.name for path in tmp_path.iterdir()] == ["policy.onnx"]
    driver = onnx_driver(tmp_path / "policy.onnx", time_step=0.1)
    assert driver.action_repeat == 10
    speed, leader, gap = np.array([[3.0, 20.0, 8.0], [4.0, 15.0, 8.0], [9.0, 60.0, 30.0]])
    unused = dict.fromkeys(("follower_speed", "follower_gap", "route_position", "loop_length"), np.zeros(3))
    state = LocalState(speed=speed, leader_speed=leader, leader_gap=gap, **unused)
    found, _ = driver.act(state, driver.initial_memory(3))
    observations = torch.as_tensor(np.column_stack([speed / 10.0, leader - speed, gap]), dtype=torch.float32)
    expected = (0.5 * network.eval()(observations)[:, 0].detach().numpy()).clip(-1.0, 1.0)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_features_and_an_expert_are_those_of_the_environment(tmp_path: Path) -> None:
    torch.manual_seed(1)
    network, expert = nn.Linear(6, 1), unjam.make_driver("pi", 0.1)
    inputs = ["local", "expert_acceleration"]
    write_onnx_policy(network, tmp_path / "policy.onnx", inputs, expert="pi")
    written = onnx_driver(tmp_path / "policy.onnx", time_step=0.1)
    expected = policy_driver(network, inputs, expert, PolicyOutput())
    speed, leader, gap = np.array([[3.0, 5.0], [4.0, 5.0], [9.0, 12.0]])
    unused = {"route_position": np.zeros(2), "loop_length": np.full(2, 250.0)}
    state = LocalState(
        speed=speed, leader_speed=leader, leader_gap=gap, follower_speed=leader, follower_gap=gap, **unused
    )
    found, wanted = (each.act(state, each.initial_memory(2))[0] for each in (written, expected))
    np.testing.assert_allclose(found, wanted, rtol=1e-5)
    assert not np.allclose(found, expert.act(state, expert.initial_memory(2))[0])


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (nn.Linear(4, 1), "network: it does not take 5 inputs: mat1 and mat2 shapes cannot be multiplied"),
        (nn.Linear(5, 2), r"network: shape of its output for 2 rows: \(2, 2\) is not allowed; allowed: \(2,\), "),
    ],
)
def test_a_network_that_does_not_fit_its_inputs_is_refused(network: nn.Module, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        write_onnx_policy(network.train(), tmp_path / "policy.onnx", ["local"])
    assert network.training
    assert not list(tmp_path.iterdir())


def test_a_written_network_has_no_paths_of_this_machine(tmp_path: Path) -> None:
    write_onnx_policy(nn.Linear(3, 1), tmp_path / "policy.onnx", INPUTS)
    assert str(Path(__file__).parent).encode() not in (tmp_path / "policy.onnx").read_bytes()


def test_other_names_and_missing_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"file: .*policy\.pt' is not allowed; allowed: a name that ends in \.onnx"):
        write_onnx_policy(nn.Linear(3, 1), tmp_path / "policy.pt", INPUTS)
    with pytest.raises(DiskError):
        write_onnx_policy(nn.Linear(3, 1), tmp_path / "missing" / "policy.onnx", INPUTS)
