"""Gradients through rings: finite differences, one-sided ones at kinks, truncation, and the same episodes as others."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from unjam.adapters import policy_driver
from unjam.drivers import PISaturation
from unjam.drivers.car_following import Constant
from unjam.drivers.driver import Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import Actuator, FollowingState, SafetyFilter
from unjam.drivers.sensors import Sensors
from unjam.drivers.user_driver import as_driver
from unjam.errors import InputError
from unjam.models.differentiable_rings import DifferentiableRings
from unjam.physics.kinematics import next_speed
from unjam.scenarios import Ring
from unjam.worlds.batch.human_idm import human_idm_speed
from unjam.worlds.batch.run import run_batch
from unjam.worlds.worker_pool import EpisodeTask

SMALL = Ring(vehicles=6, length=(60, 70), horizon=60)
LAGGING = Actuator(delay=0.2, lag=0.3)


def difference(function: Callable[[Tensor], Tensor], at: Tensor, direction: Tensor, step: float = 1e-6) -> float:
    """The central difference of a function of one number."""
    return float(function(at + step * direction) - function(at - step * direction)) / (2.0 * step)


def assert_gradient_is_that_of_differences(function: Callable[[Tensor], Tensor], at: Tensor, tolerance: float) -> None:
    at = at.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(at), at)
    assert gradient.isfinite().all()
    assert gradient.abs().max() > 0.01
    generator = torch.Generator().manual_seed(1)
    for _ in range(3):
        direction = torch.randn(at.shape, generator=generator, dtype=at.dtype)
        expected = difference(function, at.detach(), direction)
        assert float((gradient * direction).sum()) == pytest.approx(expected, rel=tolerance)


def follow_with_bias(scenario: Ring, bias: Tensor, **options: Any) -> Tensor:
    """The sum of final speeds and rewards of rings; CAVs follow, with a bias for each ring and second."""
    rings, total = DifferentiableRings(scenario, range(bias.shape[1]), **options), torch.zeros((), dtype=bias.dtype)
    for step in range(10 * len(bias)):
        state = rings.local_state()
        wanted = 0.3 * (state.leader_speed - state.speed) + 0.02 * (state.leader_gap - 2.0 * state.speed)
        total = total + rings.step(wanted + bias[step // 10].repeat(scenario.cavs)).sum()
    return total + rings.speeds.sum()


@pytest.mark.parametrize(
    ("changes", "quick"),
    [
        ({}, False),
        ({}, True),
        ({"cavs": 2}, False),
        ({"actuator": LAGGING}, False),
        ({"safety": SafetyFilter(time_gap=2.5)}, False),
        ({"safety": SafetyFilter(time_gap=2.5), "actuator": LAGGING}, True),
        ({"simulation_step": 0.1, "steps_per_control_step": 2, "horizon": 100}, False),
    ],
    ids=["exact", "quick", "two CAVs", "delay and lag", "filter acts", "filter with delay and lag", "two steps"],
)
def test_gradients_of_the_return_are_those_of_finite_differences(changes: dict[str, Any], quick: bool) -> None:
    bias = 0.3 + 0.3 * torch.randn((4, 2), generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def total(bias: Tensor) -> Tensor:
        generator = torch.Generator().manual_seed(2) if quick else None
        return follow_with_bias(replace(SMALL, **changes), bias, generator=generator)

    assert_gradient_is_that_of_differences(total, bias, 1e-4)


@pytest.mark.parametrize("reward", ["released", "eq16", "fuel"])
def test_gradients_reach_the_first_state(reward: str) -> None:
    first = DifferentiableRings(SMALL, [0, 1])
    motion = torch.stack([first.speeds + 2.0, first.positions])

    def total(motion: Tensor) -> Tensor:
        rings = DifferentiableRings(SMALL, [0, 1], reward=reward)
        rings.set_state(*motion)
        rewards = [rings.step(0.2 * (rings.local_state().leader_speed - 2.0)) for _ in range(20)]
        return torch.stack(rewards).sum() + rings.speeds.sum()

    assert_gradient_is_that_of_differences(total, motion, 1e-4)


def test_the_filter_passes_the_gradient_of_what_it_decides_by() -> None:
    safety, step = SafetyFilter(), 0.1
    state = torch.tensor([[9.0, 6.0, 10.0], [5.0, 8.0, 40.0], [3.0, 0.0, 2.5]], dtype=torch.float64).T
    wanted = torch.full((3,), 0.5, dtype=torch.float64)
    inputs = torch.cat([state, wanted[None]]).requires_grad_()

    def limited(inputs: Tensor) -> Tensor:
        return safety.limit(inputs[3], FollowingState(*inputs[:3]), step)

    found = limited(inputs)
    (gradient,) = torch.autograd.grad(found.sum(), inputs)
    assert (found < 0.5).tolist() == [True, False, True]
    assert gradient[:, 1].tolist() == [0.0, 0.0, 0.0, 1.0]  # not limited: the command alone
    assert gradient[3].tolist() == [0.0, 1.0, 0.0]
    assert torch.autograd.gradcheck(limited, inputs)


def one_sided(function: Callable[[Tensor], Tensor], at: float) -> tuple[float, float, float]:
    """The left and the right difference of a function of one number, and the gradient of autograd."""
    point, step = torch.tensor(at, dtype=torch.float64, requires_grad=True), 1e-6
    value = function(point)
    (gradient,) = torch.autograd.grad(value, point)
    with torch.no_grad():
        left, right = (float(function(point + sign * step) - value) / (sign * step) for sign in (-1.0, 1.0))
    return round(left, 4), round(right, 4), round(float(gradient), 4)


def test_gradients_at_kinks_are_those_of_one_side() -> None:
    assert one_sided(lambda a: next_speed(torch.zeros(()) + 0.0, a, 0.1), 0.0) == (0.0, 0.1, 0.1)  # can drive off
    stopped = one_sided(lambda a: next_speed(torch.ones(()) * 0.05, a, 0.1), -0.6)
    assert stopped == (0.0, 0.0, 0.0)  # brakes to standstill within the step
    speed, state = torch.tensor(5.0, dtype=torch.float64), (5.0, 5.0, 8.0)
    limit = float(SafetyFilter().max_acceleration(FollowingState(*(speed * 0 + each for each in state)), 0.1))
    filtered = one_sided(
        lambda a: SafetyFilter().limit(a, FollowingState(*(0 * a + each for each in state)), 0.1), limit
    )
    assert filtered == (1.0, 0.0, 1.0)  # exactly at the limit: as if it did not act
    assert one_sided(standing_human_speed, 2.0) == (0.0, 0.0, 0.0)  # stands until it accelerates by more than 1e-4 m/s2
    left, right, gradient = one_sided(standing_human_speed, 3.0)
    assert left == right == gradient > 0.0


def standing_human_speed(gap: Tensor) -> Tensor:
    """The speed after a step of a human driver who stands behind a standing leader."""
    return human_idm_speed(0.0 * gap, 0.0 * gap, gap, SMALL.humans, 0.1)


@pytest.mark.parametrize("reward", ["released", "eq16", "fuel", "released:comfort=1,time_gap=0.5"])
@pytest.mark.parametrize("actuator", [Actuator(), LAGGING], ids=["instant", "delay and lag"])
@pytest.mark.parametrize("is_filtered", [True, False])
def test_gradients_are_finite_at_standstill_and_in_contact(reward: str, actuator: Actuator, is_filtered: bool) -> None:
    road = replace(SMALL, actuator=actuator, safety=SafetyFilter(active=is_filtered), actuation="raw", noise=0.0)
    rings = DifferentiableRings(road, [0, 1], reward=reward)
    cav, spacing = rings.roads[0].vehicle_ids.index("cav_0"), torch.linspace(0.0, 50.0, 6, dtype=torch.float64)
    positions = torch.stack([spacing, spacing * 0.502], 1)  # in the second ring bumpers almost touch
    speeds = torch.zeros_like(positions).requires_grad_()
    rings.set_state(speeds, positions)
    command = torch.ones(2, dtype=torch.float64, requires_grad=True)
    total = torch.zeros((), dtype=torch.float64)
    for step in range(30):
        total = total + rings.step(command if step < 25 else -command).sum()
    assert bool(rings.crashed_roads.any()) != is_filtered
    gradients = torch.autograd.grad(total + rings.speeds.sum() + rings.gaps[cav].sum(), (command, speeds))
    assert all(bool(gradient.isfinite().all()) for gradient in gradients)
    assert gradients[0].abs().max() > 0.0


def test_after_detach_no_gradient_flows_to_earlier_steps() -> None:
    road = replace(SMALL, actuator=LAGGING)
    rings, driver = DifferentiableRings(road, [0, 1]), PISaturation(window=1.0)
    memory, bias = rings.initial_memory(driver), torch.zeros(2, dtype=torch.float64, requires_grad=True)

    def drive(memory: Memory) -> tuple[Tensor, Memory]:
        reward = torch.zeros(2)
        for _ in range(15):
            acceleration, memory = driver.act(rings.local_state(), memory)
            reward = rings.step(acceleration + bias)
        return reward, memory

    reward, memory = drive(memory)
    assert reward.requires_grad
    memory, bias = rings.detach(memory), torch.zeros(2, dtype=torch.float64)
    reward, _ = drive(memory)
    assert not any(each.requires_grad for each in (rings.speeds, rings.positions, rings.gaps, reward))


FILTERED = {"safety": SafetyFilter(time_gap=2.5), "steps_per_control_step": 2, "actuator": LAGGING}


@pytest.mark.parametrize(
    ("changes", "is_filtered"),
    [({}, False), (FILTERED, True), ({"warmup": 100}, False), ({"cavs": 2, "warmup": 20}, False)],
    ids=["start", "filter acts", "warm-up", "two CAVs"],
)
def test_an_episode_is_that_of_a_batch_with_rewards(changes: dict[str, Any], is_filtered: bool) -> None:
    road, seeds = replace(SMALL, **changes), [(3, 1), (3, 2)]
    driver = Constant(acceleration=0.8) if is_filtered else PISaturation(window=5.0)
    rings = DifferentiableRings(road, seeds)
    memory, rewards, speeds = rings.initial_memory(driver), [], [rings.speeds]
    with torch.no_grad():
        while not rings.has_ended:
            acceleration, memory = driver.act(rings.local_state(), memory)
            rewards.append(rings.step(acceleration))
            speeds.append(rings.speeds)
    episodes = run_batch([EpisodeTask(road, driver, seed) for seed in seeds])
    assert is_filtered == any(
        (trajectory.filter_braking > 0.0).any() for one in episodes for trajectory in one.trajectories
    )
    for ring, episode in enumerate(episodes):
        assert np.abs(episode.reward - torch.stack(rewards)[:, ring].numpy()).max() < 1e-9
        assert np.abs(episode.speeds - torch.stack(speeds)[..., ring].numpy()).max() < 1e-9


def test_rings_with_a_noise_generator_have_a_warm_up_too() -> None:
    road, driver, generator = replace(SMALL, warmup=20), PISaturation(window=5.0), torch.Generator().manual_seed(0)
    rings = DifferentiableRings(road, [0, 1], dtype=torch.float32, generator=generator)
    memory = rings.initial_memory(driver)
    assert not rings.speeds.requires_grad
    assert rings.speeds.dtype == memory["total"].dtype == torch.float32
    assert memory["count"].tolist() == [20.0, 20.0]
    assert rings.speeds.min() > 0.0
    assert rings.step(driver.act(rings.local_state(), memory)[0]).shape == (2,)


def test_a_reward_in_numpy_is_refused() -> None:
    rings = DifferentiableRings("ring", [0], reward=lambda outcome: np.zeros(1))
    with pytest.raises(InputError, match=r"a ndarray is not allowed for the term 'reward'; allowed: a tensor"):
        rings.step(torch.zeros(1))


def test_a_ring_counts_until_its_collision() -> None:
    road = replace(SMALL, safety=SafetyFilter(active=False), actuation="raw", horizon=400)
    rings = DifferentiableRings(road, [0, 1], reward="eq16")
    command = torch.tensor([1.0, 0.0], dtype=torch.float64)
    while not rings.crashed_roads[0] and not rings.has_ended:
        rings.step(command)
    rings.step(command)
    terms = rings.reward_terms
    assert rings.crashed_roads.tolist() == [True, False]
    assert terms["speed"][0] == 0.0
    assert terms["speed"][1] > 0.0


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("ring", []), r"seeds: \[\] is not allowed"),
        (("figure-eight", [0]), "scenario: 'figure-eight' is not allowed; allowed: a ring"),
        ((replace(SMALL, actuation="flow"), [0]), "actuation: flow is not allowed in a batch"),
        ((replace(SMALL, sensors=Sensors(dropout=0.1)), [0]), "sensors: errors have no gradient"),
        (("rign", [0]), "did you mean 'ring'"),
        (("ring", [0], "cpu", torch.int64), "dtype: 'torch.int64' is not allowed; allowed: torch.float32"),
        (("ring", [-1]), "seed: -1 is not allowed"),
        (("ring", 5), "seeds: 5 is not allowed; allowed: one or more"),
    ],
)
def test_what_is_not_supported_is_refused_in_one_line(arguments: Any, reason: str) -> None:
    with pytest.raises(InputError, match=reason) as error:
        DifferentiableRings(*arguments)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda speeds, positions: (speeds[:, 0], positions), r"speeds: shape: \(6,\) is not allowed; allowed: \(6"),
        (lambda speeds, positions: (speeds / 0.0, positions), "speeds: nan of ring 0 is not allowed; allowed: finite"),
        (lambda speeds, positions: (speeds, positions / 0.0), "positions: .* is not allowed; allowed: finite numbers"),
        (lambda speeds, positions: (speeds - 1.0, positions), "speeds: -1.0 is not allowed; allowed: >= 0"),
        (lambda speeds, positions: ("fast", positions), "speeds is not numbers: 'fast'; allowed: finite numbers"),
        (
            lambda speeds, positions: (speeds, torch.stack([positions[:, 0], positions[:, 1].flip(0)], 1)),
            "positions: those of ring 1 are not in order; allowed: each vehicle behind the next",
        ),
    ],
)
def test_a_state_that_no_ring_has_is_refused(change: Callable[..., Any], reason: str) -> None:
    rings = DifferentiableRings(SMALL, [0, 1])
    with pytest.raises(InputError, match=reason):
        rings.set_state(*change(rings.speeds, rings.positions))
    rings.set_state(rings.speeds.numpy() + 1.0, rings.positions.float())  # pyright: ignore[reportArgumentType]
    assert rings.speeds.tolist() == [[1.0, 1.0]] * 6


@pytest.mark.parametrize(
    ("accelerations", "reason"),
    [
        ([0.0, 0.0, 0.0, math.nan], r"step: acceleration: nan of ring 1 is not allowed; allowed: .* shape \(4,\)"),
        ([0.0], r"step: acceleration: shape: \(1,\) is not allowed; allowed: \(4,\)"),
        (["a"] * 4, r"step: acceleration is not numbers: .*; allowed: finite numbers of shape \(4,\)"),
    ],
)
def test_wrong_accelerations_are_refused(accelerations: Any, reason: str) -> None:
    rings = DifferentiableRings(replace(SMALL, cavs=2), [0, 1])
    with pytest.raises(InputError, match=reason):
        rings.step(accelerations)
    assert rings.step([0.0] * 4).shape == (2,)  # pyright: ignore[reportArgumentType]


def test_a_torch_module_drives_as_in_numpy_and_passes_gradients() -> None:
    torch.manual_seed(0)
    driver = policy_driver(torch.nn.Linear(5, 1), expert=PISaturation(window=1.0))
    rings = DifferentiableRings(SMALL, [0, 1])
    speeds = (rings.speeds + 1.0).requires_grad_()
    rings.set_state(speeds, rings.positions)
    memory, state = rings.initial_memory(driver), rings.local_state()
    found, _ = driver.act(state, memory)
    arrays = state.map(lambda values: values.detach().numpy())
    np.testing.assert_allclose(found.detach(), driver.act(arrays, driver.initial_memory(2))[0], atol=1e-6)
    (gradient,) = torch.autograd.grad(found.sum(), speeds)
    assert (gradient.abs().sum(1) > 0.0).tolist() == [True, True, False, False, False, True]
    for name, other in {"<lambda>": policy_driver(lambda rows: rows[:, 0]), "mine": as_driver(mine)}.items():
        with pytest.raises(InputError, match=f"driver: '{name}' is not allowed; allowed: a driver that"):
            rings.initial_memory(other)


def mine(state: LocalState) -> Any:
    return state.speed


def test_the_example_of_the_documentation_runs(capsys: pytest.CaptureFixture[str]) -> None:
    page = (Path(__file__).parents[2] / "docs/differentiable.md").read_text()
    code = page.partition("```python\n")[2].partition("```")[0]
    exec(compile(code, "differentiable.md", "exec"), {})
    gradient, *others = capsys.readouterr().out.split(maxsplit=1)
    assert float(gradient) != 0.0
    assert others == ["torch.Size([22, 16]) False\n"]
