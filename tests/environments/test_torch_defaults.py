"""Other defaults of torch in the program of the user change no number."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

import unjam
from tests.torch_defaults import other_default
from unjam.adapters import PolicyInput, write_onnx_policy
from unjam.controller import make_driver
from unjam.controller.onnx_graph import onnx_graph
from unjam.drivers.user_driver import as_driver

CPU: Any = {"dtype": torch.float32, "device": "cpu"}


def drive_rings() -> Any:
    rings = unjam.DifferentiableRings("ring", seeds=range(3))
    return [rings.step(torch.zeros(3, dtype=torch.float64, device="cpu")) for _ in range(50)]


def drive_environments(name: str, exact: bool) -> Any:
    environment = gymnasium.make_vec(name, num_envs=3, device="cpu", exact=exact, horizon=50)
    environment.reset(seed=1)
    return [part for _ in range(49) for part in environment.step(torch.zeros((3, 1), **CPU))[:2]]


def drive_module() -> Any:
    module = torch.nn.Linear(1, 1, **CPU)
    with torch.no_grad():
        module.weight.fill_(0.1)
        module.bias.fill_(0.0)

    class Follow(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.layer = module

        def forward(self, state: Any) -> torch.Tensor:
            return self.layer((state.leader_speed - state.speed)[:, None])[:, 0]

    episode = unjam.run_episode(
        unjam.make_scenario("ring", {"horizon": 300}), as_driver(Follow(), 0.1), 1, backend="batch"
    )
    return [torch.as_tensor(episode.speeds, device="cpu")]


def export(folder: Path) -> Any:
    network = torch.nn.Linear(1, 1, **CPU)
    torch.nn.init.ones_(network.weight)
    torch.nn.init.zeros_(network.bias)
    write_onnx_policy(network, folder / "policy.onnx", [PolicyInput("speed")])
    graphs = (folder / "policy.onnx").read_bytes(), onnx_graph(make_driver("pi", 0.1), 1.0)
    return [torch.as_tensor(np.frombuffer(graph, np.uint8).copy(), device="cpu") for graph in graphs]


CASES: dict[str, Callable[[Path], Any]] = {
    "differentiable rings": lambda folder: drive_rings(),
    **{
        f"{name}, exact={exact}": lambda folder, name=name, exact=exact: drive_environments(f"unjam/{name}", exact)
        for name in ("Ring-v0", "FigureEight-v0", "Recorded-v0")
        for exact in (True, False)
    },
    "module": lambda folder: drive_module(),
    "ONNX": export,
}


@pytest.mark.parametrize("default", [torch.float64, torch.float16, torch.device("meta")], ids=str)
@pytest.mark.parametrize("name", CASES)
def test_results_do_not_depend_on_defaults_of_torch(
    name: str, default: torch.dtype | torch.device, tmp_path: Path
) -> None:
    expected = CASES[name](tmp_path)
    with other_default(default):
        found = CASES[name](tmp_path)
    for one, other in zip(found, expected, strict=True):
        assert (one.dtype, one.device) == (other.dtype, other.device)
        assert torch.equal(one, other)
