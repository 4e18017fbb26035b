"""The model of the virtual environment: a base, and an ensemble of networks for its residual; Eq. 4."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from math import nan

import torch
from torch import Tensor

from unjam.drivers.car_following import ACC, IDM, OVM, SMALLEST_GAP
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LARGEST_GAP, LocalState
from unjam.physics.arrays import Array, as_column, at_least, namespace, stack_columns
from unjam.physics.idm import idm_acceleration
from unjam.physics.kinematics import next_position, next_speed
from unjam.scenarios.population import as_calibrated
from unjam.scenarios.scenario import Scenario
from unjam.virtual.ensemble import Ensemble
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
BASES: dict[str, Callable[[Scenario], Driver] | None] = {
    "idm": lambda scenario: IDM(**asdict(scenario.humans)),
    "population": lambda scenario: TypicalPerson(scenario),
    "acc": lambda scenario: ACC(set_speed=scenario.humans.desired_speed),
    "ovm": lambda scenario: OVM(largest_speed=scenario.humans.desired_speed),
    "none": None,
}
"""Who is taken to drive behind the CAV, a driver without memory; None: nothing is known."""


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


class EnvironmentModel(Ensemble):
    """An ensemble of networks for what a base leaves of a row, with all that a virtual step needs besides."""

    noise: Tensor
    reward_range: Tensor

    def __init__(
        self, settings: VirtualSettings, drawn: int, seed: Sequence[int], device: torch.device | str = "cpu"
    ) -> None:
        """Make the model of a road whose episodes draw `drawn` numbers."""
        super().__init__(settings, len(NUMBERS) + 1 + drawn, len(TARGETS), seed)
        self.base: BaseName = settings.base
        self.register_buffer("noise", torch.zeros((NOISE_ROWS, len(TARGETS))))
        self.register_buffer("reward_range", torch.zeros(2))  # of the residual of the reward
        self.to(device)
