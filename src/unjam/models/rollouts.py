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
from unjam.drivers.residual import EXPERT_KEY, RESIDUAL_AGE_KEY, RESIDUAL_KEY, ResidualDriver
from unjam.errors import UnjamError
from unjam.models.dynamics import CLIPPED_QUANTITIES, Dynamics, tensor_driver, tensor_memory, to_device
from unjam.models.environment_data import EnvironmentData, reconstruct_memory
from unjam.models.settings import ModelSettings
from unjam.worlds.drive import drive_world
from unjam.worlds.world import DriverLog, ProgressCallback


def rollout_length(eps_m: float, settings: ModelSettings) -> int:
    """Return k* = min(k_max, floor(kappa / eps_m)) [decisions], Eq. 15; 0: the model is not to be used."""
    if not isfinite(eps_m):
        return 0
    if eps_m * settings.k_max <= settings.kappa:
        return settings.k_max
    return floor(settings.kappa / eps_m)


def return_bound(eps_pi: float, eps_m: float, k: int, gamma: float, max_reward: float) -> float:
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
    return 2.0 * max_reward * (policy + k * eps_m * far)


class RolloutStarts(NamedTuple):
    """Actual rows from which virtual rollouts begin; n rows."""

    state: LocalState
    """tensors of shape (n,)"""
    memory: Memory
    """of the expert, as `tensor_driver` of it takes it"""
    drawn_values: Tensor
    """what the rows' episodes have drawn, scaled, shape (n, m)"""
    indices: NDArray[np.int64]
    """where they are: rows (recording, decision), shape (n, 2)"""


@dataclass(frozen=True)
class RolloutBatch:
    """Virtual experience: n rows, each of as many choices of the network; tensors."""

    observations: Tensor
    """what the network saw at each choice, and at the end, shape (n, choices + 1, inputs)"""
    actions: Tensor
    """the residual it chose, with its exploration noise, not clipped [m/s2], shape (n, choices)"""
    rewards: Tensor
    """what was earned while each residual was held, zero after a crash, shape (n, choices)"""
    lengths: Tensor
    """choices that each row made: those after its crash mean nothing, shape (n,)"""
    terminated: Tensor
    """whether it crashed; otherwise it was cut, and goes on where it ended, shape (n,)"""
    drawn_values: Tensor
    """what its episode had drawn, scaled, shape (n, m)"""
    start_indices: NDArray[np.int64]
    """where it began: rows (recording, decision), shape (n, 2)"""
    control_steps: int
    """virtual decisions in all"""
    clipped_share: dict[str, float]
    """share of the decisions in which each of BOUNDS had to be enforced"""


def draw_starts(
    data: EnvironmentData,
    rows: int,
    min_control_steps: int,
    seed: Sequence[int],
    first_episode: int = 0,
    *,
    episode_starts_only: bool = False,
) -> NDArray[np.int64]:
    """Return random decisions at which a residual was due, rows (recording, decision), shape (rows, 2).

    At least `ahead` recorded decisions follow each, and its episode is number `since` or a later one; with
    `at_first` they are the first of a recording. Shape (0, 2) where there are none such.
    """
    choices = data.start_indices(min_control_steps, first_episode)
    if episode_starts_only:
        choices = choices[choices[:, 1] == 0]
    if len(choices) == 0:
        return choices
    return choices[np.random.default_rng(list(seed)).integers(len(choices), size=rows)]


def prepare_starts(
    data: EnvironmentData, start_indices: NDArray[np.int64], expert: Driver, device: torch.device | str
) -> RolloutStarts:
    """Return the start of virtual rollouts at `choices`, with what the expert remembered there."""
    drawn = np.stack([data.recordings[place].drawn_values for place in start_indices[:, 0]])
    memory = reconstruct_memory(expert, data.recordings, start_indices)
    return RolloutStarts(
        state=data.states_at(start_indices).map(lambda values: to_device(values, device)),
        memory=tensor_memory(tensor_driver(expert, device), memory, device),
        drawn_values=to_device(drawn, device),
        indices=start_indices,
    )


class ModelWorld:
    """The virtual environment as a world to drive in: n rows from actual states, so many decisions of each.

    Rows that have crashed are driven on, but count no more.
    """

    is_scalar, entered_count, remaining_rows = False, 0, None

    def __init__(
        self,
        dynamics: Dynamics,
        starts: RolloutStarts,
        control_steps: int,
        limits: Limits,
        generator: torch.Generator | None,
    ) -> None:
        """Begin at `starts`; `generator` is of the exploration noise."""
        self.limits, self.cav_count = limits, len(starts.state.speed)
        self.states = [starts.state]
        """one after the other, the last being the present one"""
        self._dynamics, self._starts = dynamics, starts
        self._control_steps, self._generator = control_steps, generator
        like = starts.state.speed
        self._is_running, self._running_log, self._rewards = torch.ones_like(like), [], []
        self._episode_noise: Tensor | None = None
        # Single precision counts to 2^24 only.
        self._step_total = torch.zeros((), dtype=torch.float64, device=like.device)
        self._clipped_totals = torch.zeros(len(CLIPPED_QUANTITIES), dtype=torch.float64, device=like.device)

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> None:
        """Begin; what the driver remembers was recorded with the starts."""

    @property
    def has_ended(self) -> bool:
        """Whether all decisions are made."""
        return len(self._rewards) >= self._control_steps

    def local_state(self) -> LocalState:
        """Return the states now, tensors of shape (n,)."""
        return self.states[-1]

    def advance(self, command: Command | None) -> None:
        """Make one virtual decision in each row."""
        assert command is not None
        applied = self.limits.clip(command.acceleration)
        found = self._dynamics.step(self.states[-1], applied, self._starts.drawn_values)
        self.states.append(found.state)
        self._running_log.append(self._is_running)
        self._rewards.append(found.reward * self._is_running)
        self._clipped_totals += (found.clipped * self._is_running).sum(1)
        self._step_total += self._is_running.sum()
        self._is_running = self._is_running * ~found.crashed

    def noise(self, episode_noise_size: int = 0) -> Tensor:
        """Return standard normal noise, shape (n,), or (n, lasting): each row is a road of its own."""
        like = self.states[-1].speed
        if not episode_noise_size:
            return torch.randn(len(like), generator=self._generator, device=like.device)
        if self._episode_noise is None:
            shape = len(like), episode_noise_size
            drawn = torch.randn(shape, generator=self._generator, device=like.device)
            self._episode_noise = drawn.to(like.dtype)
        return self._episode_noise

    def record(self, driver_log: DriverLog) -> RolloutBatch:
        """Return what happened, choice by choice.

        Raises:
            UnjamError: something of it is not finite.
        """
        hold, nothing = driver_log.action_repeat, self.states[0].speed.new_zeros((self.cav_count, 0))
        choices = range(0, len(self._rewards), hold)
        actions = [driver_log.decisions[choice][1] for choice in choices]
        none = torch.zeros_like(self._is_running)
        rewards = [sum(self._rewards[choice : choice + hold], none) for choice in choices]
        made = sum((self._running_log[choice] for choice in choices), none)
        seen = [*(driver_log.decisions[choice][2] for choice in choices), driver_log.last_observation]
        rollouts = RolloutBatch(
            observations=torch.stack(seen, 1),
            actions=torch.stack(actions, 1) if actions else nothing,
            rewards=torch.stack(rewards, 1) if rewards else nothing,
            lengths=made.long(),
            terminated=self._is_running == 0.0,
            drawn_values=self._starts.drawn_values,
            start_indices=self._starts.indices,
            control_steps=int(self._step_total.item()),
            clipped_share=dict(
                zip(CLIPPED_QUANTITIES, (self._clipped_totals / self._step_total.clip(1.0)).tolist(), strict=True)
            ),
        )
        for name in ("observations", "actions", "rewards"):
            if not getattr(rollouts, name).isfinite().all():
                why = "; speeds of who is not seen are NaN there, too" if name == "rewards" else ""
                raise UnjamError(f"virtual environment: {name} of a rollout are not finite{why}")
        return rollouts


@torch.no_grad()
def roll_out(
    driver: ResidualDriver,
    dynamics: Dynamics,
    starts: RolloutStarts,
    control_steps: int,
    generator: torch.Generator | None,
) -> RolloutBatch:
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
    driver = replace(driver, expert=tensor_driver(driver.expert, like.device))
    memory: Memory = {EXPERT_KEY: starts.memory}
    if driver.action_repeat > 1:
        memory |= {RESIDUAL_KEY: torch.zeros_like(like), RESIDUAL_AGE_KEY: 0.0}  # all rows begin with a choice
    world = ModelWorld(
        dynamics, starts, control_steps // driver.action_repeat * driver.action_repeat, driver.limits, generator
    )
    return drive_world(world, driver, generator is not None, memory)
