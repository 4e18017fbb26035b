import os
from collections.abc import Iterator

import pytest
import torch

from unjam.drivers import PISaturation
from unjam.drivers.check import check_driver
from unjam.errors import MissingPartError
from unjam.training import benchmark
from unjam.training.benchmark import benchmark_batches, benchmark_episodes, make_benchmark_driver

RATES = ("sumo_steps_per_s", "episode_steps_per_s", "traci_steps_per_s", "every_step_steps_per_s")


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measures less, and so less exactly."""
    monkeypatch.setattr(benchmark, "TRACI_STEPS", 50)
    monkeypatch.setattr(benchmark, "ROLLOUT_SIZES", {"long": (500, 20), "short": (50, 10)})
    monkeypatch.setattr(benchmark, "RING_SIZES", {22: 200, 66: 100})
    monkeypatch.setattr(benchmark, "BATCH_VEHICLES", 2200)
    monkeypatch.setattr(benchmark, "STEPS_PER_ROUND", 20)


@pytest.fixture(autouse=True)
def cores() -> Iterator[None]:
    """Gives the other tests back the cores that they had."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    yield
    os.sched_setaffinity(0, before)


@pytest.mark.parametrize("hold", [1, 10])
def test_benchmark_driver_is_valid(hold: int) -> None:
    driver = make_benchmark_driver(hold)
    check_driver(driver)
    assert driver.expert == PISaturation()
    assert driver.action_repeat == hold
    assert [weight.shape for weight, _ in driver.network.layers] == [(5, 64), (64, 64), (64, 1)]


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_benchmark_has_rates_and_ratios_and_restores_cores() -> None:
    messages: list[str] = []
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    found = benchmark_episodes(1, messages.append)
    assert found["rounds"] == 1
    assert min(found[name] for name in RATES) > 0
    assert found["relative_to_sumo"] == pytest.approx(found["episode_steps_per_s"] / found["sumo_steps_per_s"])
    assert found["relative_to_sumo_every_step"] == pytest.approx(
        found["every_step_steps_per_s"] / found["sumo_steps_per_s"]
    )
    assert found["relative_to_traci"] > 2.0
    for rollouts in found["model"].values():
        assert rollouts["relative_to_environment"] == pytest.approx(
            rollouts["steps_per_s"] / found["episode_steps_per_s"]
        )
    assert found["model"]["long"]["relative_to_environment"] > 2.0
    batch = found["batch"]
    assert batch["rings"] == 100
    assert batch["relative_to_sumo"] == pytest.approx(batch["steps_per_s"] / found["sumo_steps_per_s"])
    assert [entry["vehicles"] for entry in batch["scaling"]] == [22, 66]
    for road in found["scenarios"].values():
        assert road["relative_to_sumo"] == pytest.approx(road["episode_steps_per_s"] / road["sumo_steps_per_s"])
    costs = [entry["us_per_vehicle_step"] for entry in found["scaling"]]
    assert [entry["vehicles"] for entry in found["scaling"]] == [22, 66]
    assert found["cost_growth"] == max(costs) / costs[0]
    assert messages == ["round 1 of 1", "larger roads"]
    assert cores is None or os.sched_getaffinity(0) == cores


def test_batches_are_measured_with_both_human_models(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark, "STEPS_PER_ROUND", 3)
    monkeypatch.setattr(benchmark, "BATCH_SIZES", {"cpu": (2, 5)})
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
