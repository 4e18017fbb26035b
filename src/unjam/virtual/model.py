"""The model of the virtual environment: a base, and an ensemble of networks for its residual; Eq. 4."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from math import nan, sqrt

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from unjam.drivers.car_following import ACC, IDM, OVM, SMALLEST_GAP
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LARGEST_GAP, LocalState
from unjam.physics.arrays import Array, as_column, at_least, namespace, stack_columns
from unjam.physics.idm import idm_acceleration
from unjam.physics.kinematics import next_position, next_speed
from unjam.scenarios.population import as_calibrated
from unjam.scenarios.scenario import Scenario
from unjam.virtual.settings import BaseName, VirtualSettings
from unjam.worlds.reward import Outcome, Reward, time_headway

SPEEDS = ("speed", "leader_speed", "follower_speed")
GAPS = ("leader_gap", "follower_gap")
NUMBERS = (*SPEEDS, *GAPS)
"""the five numbers of the state that are predicted"""
TARGETS = (*NUMBERS, "reward")
"""what the networks answer: by how much each differs from what the base says [m/s, m, reward]"""
NOISE_ROWS = 4096
"""errors on the holdout that are kept, to draw the noise of virtual steps from"""
BLOCK = 64
"""virtual rows that ask the same member of the ensemble in a step"""

BASES: dict[str, Callable[[Scenario], Driver] | None] = {
    "idm": lambda scenario: IDM(**asdict(scenario.humans)),
    "population": lambda scenario: TypicalPerson(scenario),
    "acc": lambda scenario: ACC(set_speed=scenario.humans.desired_speed),
    "ovm": lambda scenario: OVM(largest_speed=scenario.humans.desired_speed),
    "none": None,
}
"""Who is taken to drive behind the CAV, a driver without memory; None: nothing is known."""

Layers = list[tuple[Tensor, Tensor]]
"""(weight of shape (members, inputs, outputs), bias of shape (members, 1, outputs)) of each layer"""


def torch_generator(seed: Sequence[int], device: torch.device | str) -> torch.Generator:
    """Return a generator of random numbers on `device` that depends on `seed` alone."""
    state = np.random.SeedSequence(list(seed)).generate_state(1, np.uint64)[0]
    return torch.Generator(device).manual_seed(int(state >> np.uint64(1)))


def model_inputs(state: LocalState, applied: Array, drawn: Array) -> Array:
    """Return what the networks see, SI units, shape (n, 6 + m).

    The five numbers of the state, the applied acceleration, and what the episode has drawn, scaled.
    """
    xp = namespace(applied)
    numbers = [getattr(state, name) for name in NUMBERS]
    return xp.concatenate([xp.stack([*numbers, applied], 1), drawn], 1)


def largest_gap(state: LocalState) -> Array:
    """Return the largest gap that there can be [m], shape (n,): on a closed road its length."""
    xp = namespace(state.speed)
    return xp.where(xp.isnan(state.loop_length), LARGEST_GAP, state.loop_length)


def absent(state: LocalState) -> tuple[Array, Array]:
    """Return whether nobody is ahead, and whether nobody is behind, each of shape (n,)."""
    largest = largest_gap(state)
    return state.leader_gap >= largest, state.follower_gap >= largest


def base_step(base: str, scenario: Scenario, state: LocalState, applied: Array) -> LocalState:
    """Return the state after one decision as the base model has it; Eq. 2 of the paper.

    The CAV moves by its acceleration and the follower by the base's car-following model; the leader, whose
    own leader is not seen, keeps its speed. All take `scenario.steps_per_decision` Euler steps, as SUMO
    moves them. Where nobody is ahead (behind), nobody will be. The base `none` expects no change.

    Args:
        base: a name in BASES.
        scenario: whose steps and people these are.
        state: n rows.
        applied: the acceleration that was commanded, within the action limit [m/s2], shape (n,).

    Returns:
        The state, its place on the route as before.
    """
    make = BASES[base]
    if make is None:
        return state
    xp, step, behind = namespace(state.speed), scenario.simulation_step, make(scenario)
    speed, follower_speed = state.speed, state.follower_speed
    leader_gap, follower_gap = state.leader_gap, state.follower_gap
    for _ in range(scenario.steps_per_decision):
        seen = state._replace(speed=follower_speed, leader_speed=speed, leader_gap=follower_gap)
        following, _ = behind.act(seen, {})
        speed = next_speed(speed, applied, step)
        follower_speed = next_speed(follower_speed, following, step)
        leader_gap = next_position(leader_gap, state.leader_speed - speed, step)
        follower_gap = next_position(follower_gap, speed - follower_speed, step)
    nobody_ahead, nobody_behind = absent(state)
    return state._replace(
        speed=speed,
        leader_speed=xp.where(nobody_ahead, speed, state.leader_speed),
        leader_gap=xp.where(nobody_ahead, state.leader_gap, leader_gap),
        follower_speed=xp.where(nobody_behind, speed, follower_speed),
        follower_gap=xp.where(nobody_behind, state.follower_gap, follower_gap),
    )


def base_reward(base: str, reward: Reward, following: LocalState, applied: Array, crashed: Array) -> Array:
    """Return the reward of a decision as far as the next state tells it, shape (n,).

    The mean speed of all vehicles is approximated by that of the three that are seen. The base `none`
    knows nothing of it.

    Args:
        base: a name in BASES.
        reward: of the road.
        following: the next state, n rows.
        applied: the acceleration that was commanded [m/s2], shape (n,).
        crashed: whether the decision ended in a collision, shape (n,).
    """
    if BASES[base] is None:
        return applied * 0.0
    xp = namespace(applied)
    nobody_ahead, nobody_behind = absent(following)
    speeds = (
        following.speed,
        xp.where(nobody_ahead, nan, following.leader_speed),
        xp.where(nobody_behind, nan, following.follower_speed),
    )
    headway = time_headway(following.leader_gap, following.speed)
    outcome = Outcome(stack_columns(speeds), as_column(applied), as_column(headway), crashed, 0.0 * applied)
    return sum(reward(outcome).values())


def predict(layers: Layers, inputs: Tensor, members: Tensor) -> Tensor:
    """Return the residual of the base, SI units, shape (n, 6).

    Args:
        layers: of `EnvironmentModel.layers`.
        inputs: of `model_inputs`, shape (n, 6 + m).
        members: the member that answers each block of rows; the blocks are equally long but for the end.
    """
    n, blocks = len(inputs), len(members)
    size = -(-n // blocks)
    blocked = pad(inputs, (0, 0, 0, blocks * size - n)).view(blocks, size, -1)
    chosen = [(weight[members], bias[members]) for weight, bias in layers]
    return _through(chosen, blocked).view(blocks * size, -1)[:n]


def random_members(members: int, rows: int, generator: torch.Generator) -> Tensor:
    """Return a random member for each block of `rows` rows."""
    return torch.randint(members, (-(-rows // BLOCK),), generator=generator, device=generator.device)


def _through(layers: Layers, inputs: Tensor) -> Tensor:
    *hidden_layers, (weight, bias) = layers
    for hidden_weight, hidden_bias in hidden_layers:
        inputs = torch.baddbmm(hidden_bias, inputs, hidden_weight).relu_()
    return torch.baddbmm(bias, inputs, weight)


@dataclass(frozen=True)
class TypicalPerson(Driver):
    """The typical driver of a road's calibrated population, with its residual; without one, its IDM alone."""

    scenario: Scenario

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return how such a driver accelerates; nothing is remembered."""
        gap = at_least(state.leader_gap, SMALLEST_GAP)
        seen = (state.speed, state.leader_speed, gap)
        acceleration = idm_acceleration(*seen, self.scenario.humans)
        return as_calibrated(self.scenario.calibrated, acceleration, *seen), memory


class EnvironmentModel(nn.Module):
    """An ensemble of networks as one batched network, with all that a virtual step needs besides.

    The last layers start at zero, so that a new model is its base alone. What it remembers of its fits is
    in its buffers: `state_dict` is all of it.
    """

    input_mean: Tensor
    input_scale: Tensor
    target_mean: Tensor
    target_scale: Tensor
    learned: Tensor
    noise: Tensor
    reward_range: Tensor

    def __init__(
        self, settings: VirtualSettings, drawn: int, seed: Sequence[int], device: torch.device | str = "cpu"
    ) -> None:
        """Make the model of a road whose episodes draw `drawn` numbers."""
        super().__init__()
        self.base: BaseName = settings.base
        self.members = settings.members
        generator = torch_generator(seed, "cpu")
        sizes = [len(NUMBERS) + 1 + drawn, *settings.hidden, len(TARGETS)]
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for inputs, outputs in itertools.pairwise(sizes):
            # as torch.nn.Linear begins
            draws = torch.rand((self.members, inputs + 1, outputs), generator=generator) * 2.0 - 1.0
            draws /= sqrt(inputs)
            self.weights.append(nn.Parameter(draws[:, :-1].contiguous()))
            self.biases.append(nn.Parameter(draws[:, -1:].contiguous()))
        nn.init.zeros_(self.weights[-1])
        nn.init.zeros_(self.biases[-1])
        self.register_buffer("input_mean", torch.zeros(sizes[0]))
        self.register_buffer("input_scale", torch.ones(sizes[0]))
        self.register_buffer("target_mean", torch.zeros(len(TARGETS)))
        self.register_buffer("target_scale", torch.ones(len(TARGETS)))
        self.register_buffer("learned", torch.zeros(len(TARGETS)))  # 1 where the networks beat the base
        self.register_buffer("noise", torch.zeros((NOISE_ROWS, len(TARGETS))))
        self.register_buffer("reward_range", torch.zeros(2))  # of the residual of the reward
        self.to(device)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return each member's answers, (members, n, 6), to inputs of its own, (members, n, 6 + m).

        Or to the same, (n, 6 + m). Both are normalised: in units of their scale, from their mean.
        """
        layers = list(zip(self.weights, self.biases, strict=True))
        return _through(layers, inputs.expand(self.members, -1, -1))

    def seen(self, inputs: Tensor) -> Tensor:
        """Return inputs in SI units as the networks take them."""
        return (inputs.float() - self.input_mean) / self.input_scale

    @torch.no_grad()
    def normalise(self, inputs: Tensor, targets: Tensor, smallest: float) -> None:
        """Take mean and standard deviation of `inputs` and `targets` as the new units, (rows, ...) in SI.

        First and last layers are written in the new units, so that the networks answer what they did. A
        standard deviation of a target below `smallest` counts as that. An input that varies by less, as the
        length of the ring does in a single episode, counts as constant: its normalised value is zero, for
        Adam would make long steps of rounding errors, and another value on the holdout would be far away.
        """
        varies = inputs.std(0) >= smallest
        mean = torch.where(varies, inputs.mean(0), inputs[0]).float()
        scale = torch.where(varies, inputs.std(0), 1.0).float()
        first, bias = self.weights[0], self.biases[0]
        bias += ((mean - self.input_mean) / self.input_scale)[None] @ first
        first *= (scale / self.input_scale)[:, None]
        self.input_mean.copy_(mean)
        self.input_scale.copy_(scale)

        mean, scale = targets.mean(0).float(), targets.std(0).clip(smallest).float()
        last, bias = self.weights[-1], self.biases[-1]
        last *= self.target_scale / scale
        bias.copy_((self.target_mean + self.target_scale * bias - mean) / scale)
        self.target_mean.copy_(mean)
        self.target_scale.copy_(scale)

    @torch.no_grad()
    def layers(self) -> Layers:
        """Return the layers in SI units, zero where the base is better: for `predict`."""
        weights = [weight.detach() for weight in self.weights]
        biases = [bias.detach() for bias in self.biases]
        biases[0] = biases[0] - (self.input_mean / self.input_scale)[None] @ weights[0]
        weights[0] = weights[0] / self.input_scale[:, None]
        weights[-1] = weights[-1] * (self.target_scale * self.learned)
        biases[-1] = (biases[-1] * self.target_scale + self.target_mean) * self.learned
        return list(zip(weights, biases, strict=True))
