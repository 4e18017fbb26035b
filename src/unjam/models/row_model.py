"""The model of the virtual environment: a base, and an ensemble of networks for its residual; Eq. 4."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from math import nan

import torch
from torch import Tensor

from unjam.drivers.car_following import _MIN_GAP, ACC, IDM, OVM
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import MAX_OBSERVED_GAP, LocalState
from unjam.models.ensemble import Ensemble
from unjam.models.settings import BaseName, ModelSettings
from unjam.physics.arrays import Array, as_column, clamp_min, namespace, stack_columns
from unjam.physics.idm import idm_acceleration
from unjam.physics.kinematics import next_position, next_speed
from unjam.scenarios.population import apply_population
from unjam.scenarios.scenario import Scenario
from unjam.worlds.reward import Outcome, Reward, time_gap

SPEED_FIELDS = ("speed", "leader_speed", "follower_speed")
GAP_FIELDS = ("leader_gap", "follower_gap")
STATE_FIELDS = (*SPEED_FIELDS, *GAP_FIELDS)
"""the five numbers of the state that are predicted"""
TARGET_NAMES = (*STATE_FIELDS, "reward")
"""what the networks answer: by how much each differs from what the base says [m/s, m, reward]"""
NOISE_SAMPLES = 4096
"""errors on the holdout that are kept, to draw the noise of virtual steps from"""
BASE_DRIVERS: dict[str, Callable[[Scenario], Driver] | None] = {
    "idm": lambda scenario: IDM(**asdict(scenario.humans)),
    "population": lambda scenario: TypicalDriver(scenario),
    "acc": lambda scenario: ACC(set_speed=scenario.humans.desired_speed),
    "ovm": lambda scenario: OVM(max_speed=scenario.humans.desired_speed),
    "none": None,
}
"""Who is taken to drive behind the CAV, a driver without memory; None: nothing is known."""


def model_inputs(state: LocalState, acceleration: Array, drawn_values: Array) -> Array:
    """Return what the networks see, SI units, shape (n, 6 + m).

    The five numbers of the state, the applied acceleration, and what the episode has drawn, scaled.
    """
    xp = namespace(acceleration)
    numbers = [getattr(state, name) for name in STATE_FIELDS]
    return xp.concatenate([xp.stack([*numbers, acceleration], 1), drawn_values], 1)


def max_gap(state: LocalState) -> Array:
    """Return the largest gap that there can be [m], shape (n,): on a closed road its length."""
    xp = namespace(state.speed)
    return xp.where(xp.isnan(state.loop_length), MAX_OBSERVED_GAP, state.loop_length)


def missing_neighbors(state: LocalState) -> tuple[Array, Array]:
    """Return whether nobody is ahead, and whether nobody is behind, each of shape (n,)."""
    largest = max_gap(state)
    return state.leader_gap >= largest, state.follower_gap >= largest


def base_step(base: str, scenario: Scenario, state: LocalState, acceleration: Array) -> LocalState:
    """Return the state after one decision as the base model has it; Eq. 2 of the paper.

    The CAV moves by its acceleration and the follower by the base's car-following model; the leader, whose
    own leader is not seen, keeps its speed. All take `scenario.steps_per_control_step` Euler steps, as SUMO
    moves them. Where nobody is ahead (behind), nobody will be. The base `none` expects no change.

    Args:
        base: a name in BASES.
        scenario: whose steps and people these are.
        state: n rows.
        applied: the acceleration that was commanded, within the action limit [m/s2], shape (n,).

    Returns:
        The state, its place on the route as before.
    """
    make = BASE_DRIVERS[base]
    if make is None:
        return state
    xp, step, behind = namespace(state.speed), scenario.simulation_step, make(scenario)
    speed, follower_speed = state.speed, state.follower_speed
    leader_gap, follower_gap = state.leader_gap, state.follower_gap
    for _ in range(scenario.steps_per_control_step):
        seen = state._replace(speed=follower_speed, leader_speed=speed, leader_gap=follower_gap)
        following, _ = behind.act(seen, {})
        speed = next_speed(speed, acceleration, step)
        follower_speed = next_speed(follower_speed, following, step)
        leader_gap = next_position(leader_gap, state.leader_speed - speed, step)
        follower_gap = next_position(follower_gap, speed - follower_speed, step)
    nobody_ahead, nobody_behind = missing_neighbors(state)
    return state._replace(
        speed=speed,
        leader_speed=xp.where(nobody_ahead, speed, state.leader_speed),
        leader_gap=xp.where(nobody_ahead, state.leader_gap, leader_gap),
        follower_speed=xp.where(nobody_behind, speed, follower_speed),
        follower_gap=xp.where(nobody_behind, state.follower_gap, follower_gap),
    )


def base_reward(base: str, reward: Reward, next_state: LocalState, acceleration: Array, crashed: Array) -> Array:
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
    if BASE_DRIVERS[base] is None:
        return acceleration * 0.0
    xp = namespace(acceleration)
    nobody_ahead, nobody_behind = missing_neighbors(next_state)
    speeds = (
        next_state.speed,
        xp.where(nobody_ahead, nan, next_state.leader_speed),
        xp.where(nobody_behind, nan, next_state.follower_speed),
    )
    headway = time_gap(next_state.leader_gap, next_state.speed)
    outcome = Outcome(stack_columns(speeds), as_column(acceleration), as_column(headway), crashed, 0.0 * acceleration)
    return sum(reward(outcome).values())


@dataclass(frozen=True)
class TypicalDriver(Driver):
    """The typical driver of a road's calibrated population, with its residual; without one, its IDM alone."""

    scenario: Scenario

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return how such a driver accelerates; nothing is remembered."""
        gap = clamp_min(state.leader_gap, _MIN_GAP)
        seen = (state.speed, state.leader_speed, gap)
        acceleration = idm_acceleration(*seen, self.scenario.humans)
        return apply_population(self.scenario.driver_population, acceleration, *seen), memory


class RowModel(Ensemble):
    """An ensemble of networks for what a base leaves of a row, with all that a virtual step needs besides."""

    noise: Tensor
    reward_range: Tensor

    def __init__(
        self, settings: ModelSettings, drawn_count: int, seed: Sequence[int], device: torch.device | str = "cpu"
    ) -> None:
        """Make the model of a road whose episodes draw `drawn` numbers."""
        super().__init__(settings, len(STATE_FIELDS) + 1 + drawn_count, len(TARGET_NAMES), seed)
        self.base: BaseName = settings.base
        self.register_buffer("noise", torch.zeros((NOISE_SAMPLES, len(TARGET_NAMES))))
        self.register_buffer("reward_range", torch.zeros(2))  # of the residual of the reward
        self.to(device)
