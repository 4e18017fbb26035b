"""Virtual rollouts: how long they may be (Eq. 15), and driving them with the full policy."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import floor, isfinite
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from unjam.drivers.command import Command, Limits
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.residual import AGE, EXPERT, RESIDUAL, ResidualDriver
from unjam.errors import UnjamError
from unjam.virtual.data import ActualData, remembered
from unjam.virtual.settings import VirtualSettings
from unjam.virtual.world import BOUNDS, Dynamics, memory_on, on_device, on_tensors
from unjam.worlds.drive import drive
from unjam.worlds.world import Driven, OnProgress


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
    choices: NDArray[np.int64]
    """where they are: rows (recording, decision), shape (n, 2)"""


@dataclass(frozen=True)
class Rollouts:
    """Virtual experience: n rows, each of as many choices of the network; tensors."""

    observations: Tensor
    """what the network saw at each choice, and at the end, shape (n, choices + 1, inputs)"""
    actions: Tensor
    """the residual it chose, with its exploration noise, not clipped [m/s2], shape (n, choices)"""
    rewards: Tensor
    """what was earned while each residual was held, zero after a crash, shape (n, choices)"""
    made: Tensor
    """choices that each row made: those after its crash mean nothing, shape (n,)"""
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


def draw_starts(
    data: ActualData, rows: int, ahead: int, seed: Sequence[int], since: int = 0, *, at_first: bool = False
) -> NDArray[np.int64]:
    """Return random decisions at which a residual was due, rows (recording, decision), shape (rows, 2).

    At least `ahead` recorded decisions follow each, and its episode is number `since` or a later one; with
    `at_first` they are the first of a recording. Shape (0, 2) where there are none such.
    """
    choices = data.choices(ahead, since)
    if at_first:
        choices = choices[choices[:, 1] == 0]
    if len(choices) == 0:
        return choices
    return choices[np.random.default_rng(list(seed)).integers(len(choices), size=rows)]


def begin(data: ActualData, choices: NDArray[np.int64], expert: Driver, device: torch.device | str) -> Starts:
    """Return the start of virtual rollouts at `choices`, with what the expert remembered there."""
    drawn = np.stack([data.recordings[place].drawn for place in choices[:, 0]])
    memory = remembered(expert, data.recordings, choices)
    return Starts(
        state=data.states_at(choices).each(lambda values: on_device(values, device)),
        memory=memory_on(on_tensors(expert, device), memory, device),
        drawn=on_device(drawn, device),
        choices=choices,
    )


class ImaginedWorld:
    """The virtual environment as a world to drive in: n rows from actual states, so many decisions of each.

    Rows that have crashed are driven on, but count no more.
    """

    single, entered, kept = False, 0, None

    def __init__(
        self,
        dynamics: Dynamics,
        starts: Starts,
        decisions: int,
        limits: Limits,
        generator: torch.Generator | None,
    ) -> None:
        """Begin at `starts`; `generator` is of the exploration noise."""
        self.limits, self.rows = limits, len(starts.state.speed)
        self.states = [starts.state]
        """one after the other, the last being the present one"""
        self._dynamics, self._starts = dynamics, starts
        self._decisions, self._generator = decisions, generator
        like = starts.state.speed
        self._running, self._ran, self._rewards = torch.ones_like(like), [], []
        self._lasting: Tensor | None = None
        # Single precision counts to 2^24 only.
        self._lived = torch.zeros((), dtype=torch.float64, device=like.device)
        self._bounded = torch.zeros(len(BOUNDS), dtype=torch.float64, device=like.device)

    def start(self, controlled: bool, on_progress: OnProgress | None = None) -> None:
        """Begin; what the driver remembers was recorded with the starts."""

    @property
    def ended(self) -> bool:
        """Whether all decisions are made."""
        return len(self._rewards) >= self._decisions

    def perceive(self) -> LocalState:
        """Return the states now, tensors of shape (n,)."""
        return self.states[-1]

    def advance(self, command: Command | None) -> None:
        """Make one virtual decision in each row."""
        assert command is not None
        applied = self.limits.keep(command.acceleration)
        found = self._dynamics.step(self.states[-1], applied, self._starts.drawn)
        self.states.append(found.state)
        self._ran.append(self._running)
        self._rewards.append(found.reward * self._running)
        self._bounded += (found.bounded * self._running).sum(1)
        self._lived += self._running.sum()
        self._running = self._running * ~found.crashed

    def noise(self, lasting: int = 0) -> Tensor:
        """Return standard normal noise, shape (n,), or (n, lasting): each row is a road of its own."""
        like = self.states[-1].speed
        if not lasting:
            return torch.randn(len(like), generator=self._generator, device=like.device)
        if self._lasting is None:
            shape = len(like), lasting
            drawn = torch.randn(shape, generator=self._generator, device=like.device)
            self._lasting = drawn.to(like.dtype)
        return self._lasting

    def record(self, driven: Driven) -> Rollouts:
        """Return what happened, choice by choice.

        Raises:
            UnjamError: something of it is not finite.
        """
        hold, nothing = driven.hold, self.states[0].speed.new_zeros((self.rows, 0))
        choices = range(0, len(self._rewards), hold)
        actions = [driven.decisions[choice][1] for choice in choices]
        none = torch.zeros_like(self._running)
        rewards = [sum(self._rewards[choice : choice + hold], none) for choice in choices]
        made = sum((self._ran[choice] for choice in choices), none)
        seen = [*(driven.decisions[choice][2] for choice in choices), driven.last_observation]
        rollouts = Rollouts(
            observations=torch.stack(seen, 1),
            actions=torch.stack(actions, 1) if actions else nothing,
            rewards=torch.stack(rewards, 1) if rewards else nothing,
            made=made.long(),
            terminated=self._running == 0.0,
            drawn=self._starts.drawn,
            start=self._starts.choices,
            decisions=int(self._lived.item()),
            bounded=dict(zip(BOUNDS, (self._bounded / self._lived.clip(1.0)).tolist(), strict=True)),
        )
        for name in ("observations", "actions", "rewards"):
            if not getattr(rollouts, name).isfinite().all():
                why = "; speeds of who is not seen are NaN there, too" if name == "rewards" else ""
                raise UnjamError(f"virtual environment: {name} of a rollout are not finite{why}")
        return rollouts


@torch.no_grad()
def imagine(
    driver: ResidualDriver,
    dynamics: Dynamics,
    starts: Starts,
    decisions: int,
    generator: torch.Generator | None,
) -> Rollouts:
    """Drive with the full policy, expert plus residual, for `decisions` from actual states.

    `decisions` is rounded down to whole choices of the network; the expert decides in each of them, and what
    it remembers is rolled forward.

    Args:
        driver: expert, network, and for how long a residual is held.
        dynamics: of the virtual environment.
        starts: where to begin.
        decisions: k*.
        generator: of the exploration noise; None: no exploration.

    Raises:
        UnjamError: the virtual environment gave something that is not finite.
        InputError: so did a driver of the user's.
    """
    like = starts.state.speed
    driver = replace(driver, expert=on_tensors(driver.expert, like.device))
    memory: Memory = {EXPERT: starts.memory}
    if driver.hold > 1:
        memory |= {RESIDUAL: torch.zeros_like(like), AGE: 0.0}  # all rows begin with a choice
    world = ImaginedWorld(dynamics, starts, decisions // driver.hold * driver.hold, driver.limits, generator)
    return drive(world, driver, generator is not None, memory)
