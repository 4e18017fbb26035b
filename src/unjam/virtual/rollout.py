"""Virtual rollouts: how long they may be (Eq. 15), and driving them with the full policy."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import floor, isfinite
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.residual import ResidualDriver, observe
from unjam.errors import UnjamError
from unjam.physics.arrays import clip
from unjam.virtual.data import ActualData
from unjam.virtual.expert import memory_on, on_tensors, remembered
from unjam.virtual.settings import VirtualSettings
from unjam.virtual.world import BOUNDS, World
from unjam.worlds.record import Floats


def rollout_length(eps_m: float, settings: VirtualSettings) -> int:
    """Return k* = min(k_max, floor(kappa / eps_m)) [decisions], Eq. 15; 0: the model is not to be used."""
    if not isfinite(eps_m):
        return 0
    if eps_m * settings.k_max <= settings.kappa:
        return settings.k_max
    return floor(settings.kappa / eps_m)


def return_bound(eps_pi: float, eps_m: float, k: int, gamma: float, largest_reward: float) -> float:
    """Return C, by how much the actual return may fall short of the virtual one (paper, below Eq. 13).

    Args:
        eps_pi: total variation between the policy and the one that collected the data.
        eps_m: total variation between virtual and actual next state.
        k: rollout length [decisions].
        gamma: discount for a decision.
        largest_reward: R_max, the largest |reward| of a decision.
    """
    far = 1.0 / (1.0 - gamma)
    policy = gamma ** (k + 1) * eps_pi * far**2 + gamma**k * eps_pi * far
    return 2.0 * largest_reward * (policy + k * eps_m * far)


class Starts(NamedTuple):
    """Actual rows from which virtual rollouts begin; n rows."""

    state: LocalState
    """tensors of shape (n,)"""
    memory: Memory
    """of the expert, as `on_tensors` of it takes it"""
    drawn: Tensor
    """what the rows' episodes have drawn, scaled, shape (n, m)"""
    looks: NDArray[np.int64]
    """where they are: rows (recording, decision), shape (n, 2)"""


@dataclass(frozen=True)
class Rollouts:
    """Virtual experience: n rows, each of as many looks of the network; tensors."""

    observations: Tensor
    """what the network saw at each look, and at the end, shape (n, looks + 1, inputs)"""
    actions: Tensor
    """the residual it chose, with its exploration noise, not clipped [m/s2], shape (n, looks)"""
    rewards: Tensor
    """what was earned while each residual was held, zero after a crash, shape (n, looks)"""
    made: Tensor
    """looks that each row made: those after its crash mean nothing, shape (n,)"""
    terminated: Tensor
    """whether it crashed; otherwise it was cut, and goes on where it ended, shape (n,)"""
    drawn: Tensor
    """what its episode had drawn, scaled, shape (n, m)"""
    start: NDArray[np.int64]
    """where it began: rows (recording, decision), shape (n, 2)"""
    decisions: int
    """virtual decisions in all"""
    bounded: dict[str, float]
    """share of the decisions in which each of BOUNDS had to be enforced"""


def draw_starts(data: ActualData, rows: int, ahead: int, seed: Sequence[int]) -> NDArray[np.int64]:
    """Return random decisions at which a residual was due, rows (recording, decision), shape (rows, 2).

    At least `ahead` recorded decisions follow each; shape (0, 2) where there are none such.
    """
    looks = data.looks(ahead)
    generator = np.random.default_rng(np.random.SeedSequence(list(seed)))
    return looks[generator.integers(len(looks), size=rows)] if len(looks) else looks


def begin(data: ActualData, looks: NDArray[np.int64], expert: Driver, device: torch.device | str) -> Starts:
    """Return the start of virtual rollouts at `looks`, with what the expert remembered there."""
    drawn = np.stack([data.recordings[place].drawn for place in looks[:, 0]])
    memory = remembered(expert, data.recordings, looks)
    return Starts(
        state=LocalState(*(_tensor(values, device) for values in data.states_at(looks))),
        memory=memory_on(on_tensors(expert, device), memory, device),
        drawn=_tensor(drawn, device),
        looks=looks,
    )


def _tensor(values: Floats, device: torch.device | str) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float32, device=device)


@torch.no_grad()
def imagine(
    driver: ResidualDriver,
    world: World,
    starts: Starts,
    decisions: int,
    generator: torch.Generator | None,
) -> Rollouts:
    """Drive with the full policy, expert plus residual, for `decisions` from actual states.

    `decisions` is rounded down to whole looks of the network; the expert decides in each of them, and what
    it remembers is rolled forward. Rows that have crashed are driven on, but count no more.

    Args:
        driver: expert, network, and for how long a residual is held.
        world: the virtual environment.
        starts: where to begin.
        decisions: k*.
        generator: of the exploration noise; None: no exploration.

    Raises:
        UnjamError: the world gave something that is not finite.
        InputError: so did a driver of the user's.
    """
    state, memory, like = starts.state, starts.memory, starts.state.speed
    expert, limit = on_tensors(driver.expert, like.device), driver.action_limit
    n, looks = len(like), decisions // driver.hold
    observations, actions, rewards = [], [], []
    running, made = torch.ones_like(like), torch.zeros_like(like)
    lived = torch.zeros((), dtype=torch.float64, device=like.device)  # single precision counts to 2^24 only
    bounded = torch.zeros(len(BOUNDS), dtype=torch.float64, device=like.device)
    for _ in range(looks):
        made += running
        earned, residual = torch.zeros_like(like), None
        for _ in range(driver.hold):
            wanted, memory = expert.act(state, memory)
            wanted = clip(wanted, -limit, limit)
            if residual is None:
                seen = observe(driver.parts, state, wanted, expert, memory)
                residual = _residual(driver, seen, generator)
                observations.append(seen)
                actions.append(residual)
            step = world.step(state, clip(wanted + residual, -limit, limit), starts.drawn)
            state = step.state
            earned += step.reward * running
            bounded += (step.bounded * running).sum(1)
            lived += running.sum()
            running = running * ~step.crashed
        rewards.append(earned)
    wanted, memory = expert.act(state, memory)
    observations.append(observe(driver.parts, state, clip(wanted, -limit, limit), expert, memory))
    rollouts = Rollouts(
        observations=torch.stack(observations, 1),
        actions=torch.stack(actions, 1) if looks else like.new_zeros((n, 0)),
        rewards=torch.stack(rewards, 1) if looks else like.new_zeros((n, 0)),
        made=made.long(),
        terminated=running == 0.0,
        drawn=starts.drawn,
        start=starts.looks,
        decisions=int(lived.item()),
        bounded=dict(zip(BOUNDS, (bounded / lived.clip(1.0)).tolist(), strict=True)),
    )
    for name in ("observations", "actions", "rewards"):
        if not getattr(rollouts, name).isfinite().all():
            raise UnjamError(f"virtual environment: {name} of a rollout are not finite")
    return rollouts


def _residual(driver: ResidualDriver, seen: Tensor, generator: torch.Generator | None) -> Tensor:
    """Return the network's residual, with exploration noise where there is a generator of it."""
    if generator is None:
        return driver.network(seen)
    noise = torch.randn(len(seen), generator=generator, device=seen.device)
    return driver.network.explore(seen, noise)
