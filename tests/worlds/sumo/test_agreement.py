from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest

from unjam.drivers import IDM, Driver, Human, PISaturation
from unjam.measures.metrics import measure
from unjam.scenarios import Ring, make_scenario
from unjam.worlds.record import Episode
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

WARMUP, STEPS = 750, 3000


class Measured(NamedTuple):
    """Speeds of a ring after the warm-up, all vehicles, 3,000 steps [m/s]."""

    mean: float
    std: float
    """across vehicles, averaged over time"""


# What Flow gives on SUMO 1.28 and 1.8.0 with the same parameters: means over two or three seeds.
FLOW_HUMAN = {230: Measured(2.97, 1.76), 260: Measured(4.30, 1.79)}
FLOW_PI = {230: Measured(3.409, 0.066), 260: Measured(4.792, 0.111)}
FLOW_SEEDS = 2


@pytest.fixture(scope="module")
def workers() -> Iterator[WorkerPool]:
    with WorkerPool(2) as pool:
        yield pool


def ring_warm(length: int) -> Ring:
    scenario = make_scenario("ring-warm", {"length": (length, length)})
    assert isinstance(scenario, Ring)
    return scenario


def run(workers: WorkerPool, scenario: Ring, driver: Driver, seeds: Sequence[int]) -> list[Episode]:
    episodes = workers.run([EpisodeTask(scenario, driver, (seed,)) for seed in seeds])
    assert [episode.status for episode in episodes] == ["completed"] * len(seeds)
    return episodes


def measured(episodes: list[Episode]) -> tuple[Measured, Measured]:
    """Mean over episodes, and standard deviation between them."""
    values = np.array([(e.speeds[1:].mean(), e.speeds[1:].std(1).mean()) for e in episodes])
    return Measured(*values.mean(0).tolist()), Measured(*values.std(0, ddof=1).tolist())


@cache
def plain_rings(length: int, rings: int = 150) -> tuple[Measured, Measured]:
    """What Eq. 5-6 give on a ring of humans, written down once more: mean and standard deviation."""
    generator = np.random.default_rng(0)
    position = np.tile(np.arange(22) * length / 22, (rings, 1))
    speed = np.zeros((rings, 22))
    means, stds = np.zeros(rings), np.zeros(rings)
    for step in range(WARMUP + STEPS):
        gap = (np.roll(position, -1, 1) - position) % length - 5.0
        closing = speed - np.roll(speed, -1, 1)
        wanted = 2.0 + np.maximum(speed + speed * closing / (2 * np.sqrt(1.5)), 0.0)
        noise = 0.2 * np.sqrt(0.1) * generator.standard_normal(speed.shape)
        acceleration = 1.0 - (speed / 30.0) ** 4 - (wanted / gap) ** 2 + noise
        speed = np.maximum(speed + 0.1 * acceleration, 0.0)
        position = position + 0.1 * speed
        if step >= WARMUP:
            means, stds = means + speed.mean(1) / STEPS, stds + speed.std(1) / STEPS
    return (Measured(float(means.mean()), float(stds.mean())), Measured(float(means.std()), float(stds.std())))


def slowly(length: int) -> Any:
    return pytest.param(length, marks=pytest.mark.slow)


@pytest.fixture(scope="module", params=[230, slowly(260)])
def human_rings(request: pytest.FixtureRequest, workers: WorkerPool) -> tuple[int, list[Episode]]:
    return request.param, run(workers, ring_warm(request.param), Human(), range(20))


@pytest.mark.slow
def test_human_rings_follow_the_papers_equations(human_rings: tuple[int, list[Episode]]) -> None:
    length, episodes = human_rings
    found, spread = measured(episodes)
    expected, _ = plain_rings(length)
    assert found.mean == pytest.approx(expected.mean, rel=0.05)
    assert found.std == pytest.approx(expected.std, abs=0.05 * expected.mean)
    assert spread.std > 0.1  # waves of different size, or the comparison would say little


@pytest.mark.long
def test_human_rings_agree_with_flow(human_rings: tuple[int, list[Episode]]) -> None:
    length, episodes = human_rings
    flow = FLOW_HUMAN[length]
    found, _ = measured(episodes)
    assert found.mean == pytest.approx(flow.mean, rel=0.05)
    # Waves differ much from seed to seed, and Flow's number comes from two or three of them.
    _, spread = plain_rings(length)
    assert abs(found.std - flow.std) < 0.05 * flow.mean + spread.std / np.sqrt(FLOW_SEEDS)


@pytest.mark.slow
@pytest.mark.parametrize("length", [230, 260])
def test_rings_with_the_papers_pi_agree_with_flow(length: int, workers: WorkerPool) -> None:
    flow = FLOW_PI[length]
    found, _ = measured(run(workers, ring_warm(length), PISaturation(time_constant=0), range(8)))
    assert found.mean == pytest.approx(flow.mean, rel=0.05)
    assert abs(found.std - flow.std) < 0.05 * flow.mean


@pytest.mark.parametrize("length", [220, 270, *map(slowly, range(230, 261, 10))])
def test_pi_holds_a_warm_ring_at_its_limit(length: int, workers: WorkerPool) -> None:
    (episode,) = run(workers, ring_warm(length), PISaturation(), [0])
    row = measure(episode)
    assert row["speed_limit_ratio_steady"] >= 0.98
    assert row["collisions"] == 0.0


def test_idm_leaves_a_jammed_ring_jammed(workers: WorkerPool) -> None:
    scenario = make_scenario("ring-jammed")
    assert isinstance(scenario, Ring)
    for episode in run(workers, scenario, IDM(), range(2)):
        assert measure(episode)["speed_limit_ratio_steady"] < 0.9


def test_a_ring_without_noise_flows_evenly_at_its_limit(workers: WorkerPool) -> None:
    (episode,) = run(workers, replace(ring_warm(230), noise=0.0), Human(), [0])
    assert measure(episode)["speed_std_fleet"] < 1e-6
    assert measure(episode)["speed_limit_ratio_steady"] == pytest.approx(1.0, abs=2e-3)
