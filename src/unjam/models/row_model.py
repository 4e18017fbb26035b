"""The row model: a base model of a CAV, its leader and its follower, and an ensemble for the residual, Eq. 4."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from math import nan
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from unjam.drivers.car_following import ACC, IDM, MIN_IDM_GAP, OVM
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import MAX_OBSERVED_GAP, LocalState
from unjam.models.ensemble import (
    MIN_CHANGE,
    Ensemble,
    EnsembleFit,
    ModelFit,
    OneStepRMSE,
    Seed,
    fit_ensemble,
    root_mean_square,
    total_variation,
    transition_variation,
)
from unjam.models.environment_data import Transitions
from unjam.models.settings import BaseName, ModelSettings
from unjam.physics.arrays import Array, as_column, clamp_min, namespace, stack_columns
from unjam.physics.idm import idm_acceleration
from unjam.physics.kinematics import next_position, next_speed
from unjam.scenarios.population import apply_population
from unjam.scenarios.scenario import Scenario
from unjam.worlds.record import Floats
from unjam.worlds.reward import Outcome, Reward, make_reward, time_gap

SPEED_FIELDS = ("speed", "leader_speed", "follower_speed")
GAP_FIELDS = ("leader_gap", "follower_gap")
STATE_FIELDS = (*SPEED_FIELDS, *GAP_FIELDS)
TARGET_NAMES = (*STATE_FIELDS, "reward")
"""outputs of the networks: differences to the predictions of the base [m/s, m, reward]"""
NOISE_SAMPLES = 4096
"""number of stored errors on the holdout, from which the noise of model steps is drawn"""
BASE_DRIVERS: dict[str, Callable[[Scenario], Driver] | None] = {
    "idm": lambda scenario: IDM(**asdict(scenario.humans)),
    "population": lambda scenario: TypicalDriver(scenario),
    "acc": lambda scenario: ACC(set_speed=scenario.humans.desired_speed),
    "ovm": lambda scenario: OVM(max_speed=scenario.humans.desired_speed),
    "none": None,
}
"""assumed driver of the follower by name of the base, without memory; None: no base"""


def model_inputs(state: LocalState, acceleration: Array, drawn_values: Array) -> Array:
    """Return inputs of the networks, shape (n, 6 + m), SI units: `STATE_FIELDS`, acceleration and m drawn values."""
    xp = namespace(acceleration)
    columns = [getattr(state, name) for name in STATE_FIELDS]
    return xp.concatenate([xp.stack([*columns, acceleration], 1), drawn_values], 1)


def max_gap(state: LocalState) -> Array:
    """Return the largest possible gap [m], shape (n,): the length of a closed road, else `MAX_OBSERVED_GAP`."""
    xp = namespace(state.speed)
    return xp.where(xp.isnan(state.loop_length), MAX_OBSERVED_GAP, state.loop_length)


def missing_neighbors(state: LocalState) -> tuple[Array, Array]:
    """Return whether there is no leader, and whether there is no follower, shape (n,) each."""
    limit = max_gap(state)
    return state.leader_gap >= limit, state.follower_gap >= limit


def base_step(base: str, scenario: Scenario, state: LocalState, acceleration: Array) -> LocalState:
    """Return the state after one control step under `acceleration` [m/s2] according to the base, Eq. 2 of the paper.

    The follower moves by the car-following model of the base, and the leader keeps its speed. Missing neighbors are
    still missing after the step. The base `none` predicts no change.
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
    """Return the reward in the next state, (n,), of the CAV and its neighbors instead of all vehicles; 0 for `none`."""
    if BASE_DRIVERS[base] is None:
        return acceleration * 0.0
    xp = namespace(acceleration)
    no_leader, no_follower = missing_neighbors(next_state)
    leader_speed = xp.where(no_leader, nan, next_state.leader_speed)
    follower_speed = xp.where(no_follower, nan, next_state.follower_speed)
    speeds = stack_columns((next_state.speed, leader_speed, follower_speed))
    gap = as_column(time_gap(next_state.leader_gap, next_state.speed))
    cav_speed, no_backlog = as_column(next_state.speed), 0.0 * acceleration
    outcome = Outcome(speeds, as_column(acceleration), gap, crashed, no_backlog, cav_speed)
    return sum(reward(outcome).values())


@dataclass(frozen=True)
class TypicalDriver(Driver):
    """The typical driver of a road's population with the residual; without a population, the road's human driver."""

    scenario: Scenario

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration of the typical driver; the memory is not used."""
        gap = clamp_min(state.leader_gap, MIN_IDM_GAP)
        inputs = (state.speed, state.leader_speed, gap)
        acceleration = idm_acceleration(*inputs, self.scenario.humans)
        return apply_population(self.scenario.driver_population, acceleration, *inputs), memory


class RowModel(Ensemble):
    """An ensemble for the residual of the base of rows, with noise and bounds of the reward for model steps."""

    noise: Tensor
    """errors on the holdout, shape (NOISE_SAMPLES, 6)"""
    reward_range: Tensor
    """smallest and largest residual of the reward in the data, shape (2,)"""

    def __init__(
        self, settings: ModelSettings, drawn_count: int, seed: Seed, device: torch.device | str = "cpu"
    ) -> None:
        super().__init__(settings, len(STATE_FIELDS) + 1 + drawn_count, len(TARGET_NAMES), seed)
        self.base: BaseName = settings.base
        self.register_buffer("noise", torch.zeros((NOISE_SAMPLES, len(TARGET_NAMES))))
        self.register_buffer("reward_range", torch.zeros(2))
        self.to(device)


class OneStepErrors(NamedTuple):
    """One-step prediction errors [m/s, m, reward]; R rows, columns as `TARGET_NAMES`."""

    base: Floats
    """errors of the base, shape (R, 6)"""
    predictions: Floats
    """predictions of the errors of the base by the members of the ensemble, shape (members, R, 6)"""
    change: Floats
    """predicted quantities: the change in the step, and the reward, shape (R, 6)"""

    @property
    def model(self) -> Floats:
        """Errors of each member of the ensemble, shape (members, R, 6)."""
        return self.base - self.predictions

    def rmse_by_target(self) -> dict[str, OneStepRMSE]:
        """Return the root mean squared errors, by name of `TARGET_NAMES`."""
        errors_by_target = (np.moveaxis(errors, -1, 0) for errors in (self.base, self.model, self.change))
        return {
            name: OneStepRMSE(root_mean_square(base), root_mean_square(model), float(change.std()))
            for name, base, model, change in zip(TARGET_NAMES, *errors_by_target, strict=True)
        }


def fit_row_model(
    model: RowModel, transitions: Transitions, settings: ModelSettings, scenario: Scenario, reward: str, seed: Seed
) -> ModelFit:
    """Continue to fit `model` in place, see `fit_ensemble`; the result depends only on the arguments."""
    generator = np.random.default_rng(np.random.SeedSequence(list(seed)))
    device = model.input_mean.device
    columns = model_inputs(transitions.states, transitions.response, transitions.drawn_values)
    targets = torch.as_tensor(residual_targets(transitions, model.base, scenario, reward), device=device)
    model.reward_range.copy_(torch.stack([targets[:, -1].min(), targets[:, -1].max()]))
    inputs = torch.as_tensor(columns, device=device)
    fit = fit_ensemble(model, inputs, targets, transitions.is_holdout, settings, generator)
    error = fit.targets - fit.predictions.mean(0)
    noise = error[generator.integers(len(error), size=NOISE_SAMPLES)] - error.mean(0)
    model.noise.copy_(torch.as_tensor(noise))

    holdout = transitions.select(fit.holdout_indices)
    change = residual_targets(holdout, "none", scenario, reward)
    one_step = OneStepErrors(fit.targets, fit.predictions, change).rmse_by_target()
    errors = {
        "unexplained_variance": unexplained_variance([one_step[name] for name in STATE_FIELDS]),
        "transitions": _row_transition_variation(fit, holdout, scenario),
        "total_variation": total_variation(fit.predictions[:, :, :-1], error[:, :-1].std(0)),
        "training_loss": fit.loss,
    }
    learned = tuple(itertools.compress(TARGET_NAMES, model.output_mask.tolist()))
    return ModelFit(errors, one_step, learned, fit.training_rows, len(fit.holdout_indices), fit.epochs)


def residual_targets(transitions: Transitions, base: str, scenario: Scenario, reward: str) -> Floats:
    """Return the residuals of `base`, (rows, 6), SI units: for `none`, the changes of the state, and the reward."""
    states, next_states, acceleration = transitions.states, transitions.next_states, transitions.acceleration
    predicted = base_step(base, scenario, states, transitions.response)
    reward_function = make_reward(reward or scenario.reward)
    predicted_reward = base_reward(base, reward_function, next_states, acceleration, transitions.crashed)
    residual = [getattr(next_states, name) - getattr(predicted, name) for name in STATE_FIELDS]
    return np.column_stack([*residual, transitions.reward - predicted_reward])


def unexplained_variance(one_step: Sequence[OneStepRMSE]) -> float:
    """Return the mean ratio of squared error to variance; it is zero for a constant quantity."""
    ratios = [(rmse.model / rmse.change) ** 2 if rmse.change > MIN_CHANGE else 0.0 for rmse in one_step]
    return sum(ratios) / len(ratios)


def recorded_noise(transitions: Transitions, scenario: Scenario) -> Floats | None:
    """Return the noise of the speeds of leader and follower in each control step [m/s], shape (rows, 2).

    SUMO's own drivers add noise after they have moved, so that the distance shows it. None if this is not so.
    """
    if scenario.human_control != "native" or scenario.steps_per_control_step > 1:
        return None
    state, next_state, step = transitions.states, transitions.next_states, scenario.simulation_step
    leader_intended = next_state.speed + (next_state.leader_gap - state.leader_gap) / step
    follower_intended = next_state.speed - (next_state.follower_gap - state.follower_gap) / step
    return np.column_stack([next_state.leader_speed - leader_intended, next_state.follower_speed - follower_intended])


def _row_transition_variation(fit: EnsembleFit, transitions: Transitions, scenario: Scenario) -> float:
    """Return `transition_variation` of the speeds of leader and follower; unknown noise is subtracted as variance."""
    columns = [TARGET_NAMES.index("leader_speed"), TARGET_NAMES.index("follower_speed")]
    errors = (fit.targets - fit.predictions)[..., columns]
    noise, sigma = recorded_noise(transitions, scenario), scenario.noise_per_step * scenario.simulation_step
    if noise is not None:
        return transition_variation(errors - noise, sigma)
    model_variance = np.square(errors).mean((0, 1)) - sigma**2
    return transition_variation(np.sqrt(model_variance.clip(0.0)), sigma)
