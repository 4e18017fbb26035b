"""The row model: a base model of a CAV, its leader and its follower, and an ensemble for its residual; Eq. 4."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from math import nan

import torch
from torch import Tensor

from unjam.drivers.car_following import ACC, IDM, MIN_IDM_GAP, OVM
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import MAX_OBSERVED_GAP, LocalState
from unjam.models.ensemble import Ensemble, Seed
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
"""the five predicted quantities of the state"""
TARGET_NAMES = (*STATE_FIELDS, "reward")
"""outputs of the networks: the difference of each quantity to the base's prediction [m/s, m, reward]"""
NOISE_SAMPLES = 4096
"""stored errors on the holdout, from which the noise of model steps is drawn"""
BASE_DRIVERS: dict[str, Callable[[Scenario], Driver] | None] = {
    "idm": lambda scenario: IDM(**asdict(scenario.humans)),
    "population": lambda scenario: TypicalDriver(scenario),
    "acc": lambda scenario: ACC(set_speed=scenario.humans.desired_speed),
    "ovm": lambda scenario: OVM(max_speed=scenario.humans.desired_speed),
    "none": None,
}
"""assumed driver of the follower, without memory; None: no base"""


def model_inputs(state: LocalState, acceleration: Array, drawn_values: Array) -> Array:
    """Return the inputs of the networks: `STATE_FIELDS`, acceleration and m drawn values, SI units, (n, 6 + m)."""
    xp = namespace(acceleration)
    columns = [getattr(state, name) for name in STATE_FIELDS]
    return xp.concatenate([xp.stack([*columns, acceleration], 1), drawn_values], 1)


def max_gap(state: LocalState) -> Array:
    """Return the largest possible gap [m], shape (n,): the length of a closed road, else `MAX_OBSERVED_GAP`."""
    xp = namespace(state.speed)
    return xp.where(xp.isnan(state.loop_length), MAX_OBSERVED_GAP, state.loop_length)


def missing_neighbors(state: LocalState) -> tuple[Array, Array]:
    """Return whether there is no leader, and whether there is no follower, shape (n,) each."""
    largest = max_gap(state)
    return state.leader_gap >= largest, state.follower_gap >= largest


def base_step(base: str, scenario: Scenario, state: LocalState, acceleration: Array) -> LocalState:
    """Return the state after one control step under `acceleration` [m/s2] according to the base; Eq. 2 of the paper.

    The follower moves by the base's car-following model. The leader keeps its speed, since its own leader is not
    observed. All take `scenario.steps_per_control_step` Euler steps, as in SUMO. Missing neighbors stay missing. The
    base `none` predicts no change.
    """
    make_driver = BASE_DRIVERS[base]
    if make_driver is None:
        return state
    xp, step, driver = namespace(state.speed), scenario.simulation_step, make_driver(scenario)
    speed, follower_speed = state.speed, state.follower_speed
    leader_gap, follower_gap = state.leader_gap, state.follower_gap
    for _ in range(scenario.steps_per_control_step):
        follower_state = state._replace(speed=follower_speed, leader_speed=speed, leader_gap=follower_gap)
        follower_acceleration, _ = driver.act(follower_state, {})
        speed = next_speed(speed, acceleration, step)
        follower_speed = next_speed(follower_speed, follower_acceleration, step)
        leader_gap = next_position(leader_gap, state.leader_speed - speed, step)
        follower_gap = next_position(follower_gap, speed - follower_speed, step)
    no_leader, no_follower = missing_neighbors(state)
    return state._replace(
        speed=speed,
        leader_speed=xp.where(no_leader, speed, state.leader_speed),
        leader_gap=xp.where(no_leader, state.leader_gap, leader_gap),
        follower_speed=xp.where(no_follower, speed, follower_speed),
        follower_gap=xp.where(no_follower, state.follower_gap, follower_gap),
    )


def base_reward(base: str, reward: Reward, next_state: LocalState, acceleration: Array, crashed: Array) -> Array:
    """Return the reward in the next state, (n,), with the mean speed of CAV and neighbors for all; 0 for `none`."""
    if BASE_DRIVERS[base] is None:
        return acceleration * 0.0
    xp = namespace(acceleration)
    no_leader, no_follower = missing_neighbors(next_state)
    leader_speed = xp.where(no_leader, nan, next_state.leader_speed)
    follower_speed = xp.where(no_follower, nan, next_state.follower_speed)
    speeds = stack_columns((next_state.speed, leader_speed, follower_speed))
    gap = as_column(time_gap(next_state.leader_gap, next_state.speed))
    return sum(reward(Outcome(speeds, as_column(acceleration), gap, crashed, 0.0 * acceleration)).values())


@dataclass(frozen=True)
class TypicalDriver(Driver):
    """The typical driver of a road's calibrated population, with its residual; without a population, its IDM."""

    scenario: Scenario

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return its acceleration; the memory is not used."""
        gap = clamp_min(state.leader_gap, MIN_IDM_GAP)
        inputs = (state.speed, state.leader_speed, gap)
        acceleration = idm_acceleration(*inputs, self.scenario.humans)
        return apply_population(self.scenario.driver_population, acceleration, *inputs), memory


class RowModel(Ensemble):
    """An ensemble for the residual of a base of rows, with the noise and the reward bounds of model steps."""

    noise: Tensor
    """errors on the holdout, shape (NOISE_SAMPLES, 6)"""
    reward_range: Tensor
    """smallest and largest residual of the reward"""

    def __init__(
        self, settings: ModelSettings, drawn_count: int, seed: Seed, device: torch.device | str = "cpu"
    ) -> None:
        super().__init__(settings, len(STATE_FIELDS) + 1 + drawn_count, len(TARGET_NAMES), seed)
        self.base: BaseName = settings.base
        self.register_buffer("noise", torch.zeros((NOISE_SAMPLES, len(TARGET_NAMES))))
        self.register_buffer("reward_range", torch.zeros(2))
        self.to(device)
