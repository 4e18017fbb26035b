import os
from collections.abc import Iterator

import pytest
import torch

from unjam.drivers import PISaturation
from unjam.drivers.check import check_driver
from unjam.errors import MissingPartError
from unjam.training import speed
from unjam.training.speed import benchmark_batches, benchmark_episodes, make_benchmark_driver


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measures less, and so less exactly."""
    monkeypatch.setattr(speed, "TRACI_STEPS", 50)
    monkeypatch.setattr(speed, "ROLLOUT_SIZES", ((500, 20), (50, 10)))
    monkeypatch.setattr(speed, "RING_SIZES", {22: 200, 66: 100})
    monkeypatch.setattr(speed, "BATCH_VEHICLES", 2200)
    monkeypatch.setattr(speed, "STEPS_PER_ROUND", 20)
    monkeypatch.setattr(speed, "MOTORWAYS", 20)
    monkeypatch.setattr(speed, "VECTOR_ENVIRONMENTS", ((50, False),))


@pytest.fixture(autouse=True)
def cores() -> Iterator[None]:
    """Gives the other tests back the cores that they had."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    yield
    os.sched_setaffinity(0, before)


@pytest.mark.parametrize(("time_step", "duration", "repeat"), [(0.1, 0.0, 1), (0.1, 1.0, 10), (1.0, 1.0, 1)])
def test_benchmark_driver_is_valid(time_step: float, duration: float, repeat: int) -> None:
    driver = make_benchmark_driver(time_step, duration)
    check_driver(driver)
    assert driver.expert == PISaturation(time_step=time_step)
    assert driver.action_repeat == repeat
    assert [weight.shape for weight, _ in driver.network.layers] == [(5, 64), (64, 64), (64, 1)]


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_benchmark_has_rates_and_ratios_and_restores_cores() -> None:
    messages: list[str] = []
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    found = benchmark_episodes(1, messages.append)
    parts = {part["name"]: part for part in found["parts"]}
    assert len(parts) == len(found["parts"])
    assert min(part["steps_per_s"] for part in parts.values()) > 0
    for part in parts.values():
        if part["reference"]:
            assert part["ratio"] == pytest.approx(part["steps_per_s"] / parts[part["reference"]]["steps_per_s"])
    assert parts["driving loop over TraCI"]["ratio"] < 0.5
    assert parts["learned model: 500 rollouts of 20 control steps"]["ratio"] > 2.0
    assert parts["batch of 100 rings of 22 vehicles"]["vehicles"] == 22
    assert {"figure-eight: run_episode", "merge: run_episode", "driving loop, ring of 66 vehicles"} <= parts.keys()
    vector = parts["vector environment of 50 rings"]
    assert vector["reference"] == "vector environment of 50 rings: batch alone"
    assert parts["vector environment of 50 rings, compared with SUMO"]["ratio"] > 2.0
    assert parts["vector environment of 20 on-ramps"]["ratio"] > 1.0
    assert (found["rounds"], messages) == (1, ["round 1 of 1"])
    assert cores is None or os.sched_getaffinity(0) == cores


def test_batches_are_measured_with_both_human_models(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "STEPS_PER_ROUND", 3)
    monkeypatch.setattr(speed, "BATCH_SIZES", {"cpu": (2, 5)})
    messages: list[str] = []
    found = benchmark_batches("cpu", messages.append)
    assert found["device"] == "one core"
    assert list(found["batches"]) == ["human drivers by IDM", "human drivers by IDM and networks"]
    for rates in found["batches"].values():
        assert [entry["rings"] for entry in rates] == [2, 5]
        assert all(entry["vehicle_steps_per_s"] == pytest.approx(22 * entry["steps_per_s"]) for entry in rates)
    assert len(messages) == 4


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU")
def test_missing_gpu_is_refused() -> None:
    with pytest.raises(MissingPartError, match="device: cuda is not available; allowed: cpu"):
        benchmark_batches("cuda")
