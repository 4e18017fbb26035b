"""The dynamics of the row model: thousands of rows stepped at once as tensors, without the simulator."""

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from unjam.drivers.check import check_acceleration
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import FollowingState
from unjam.drivers.user_driver import is_file_reference
from unjam.errors import MissingPartError
from unjam.models.ensemble import predict, random_members
from unjam.models.row_model import (
    NOISE_SAMPLES,
    SPEED_FIELDS,
    STATE_FIELDS,
    RowModel,
    base_reward,
    base_step,
    max_gap,
    model_inputs,
)
from unjam.models.settings import Device
from unjam.physics.kinematics import distance_driven
from unjam.scenarios.scenario import Scenario
from unjam.tree import map_leaves
from unjam.worlds.reward import Outcome, Reward, make_reward

GAP_SLICE = slice(len(SPEED_FIELDS), len(STATE_FIELDS))
"""the gaps in `STATE_FIELDS`"""
CLIPPED_QUANTITIES = ("speed", "gap", "reward")
"""quantities that are clipped to physical bounds"""


def check_device(device: Device, name: str = "device") -> None:
    """Raise `MissingPartError` if a device is not available; `name` is the setting that asks for it."""
    if device == "cuda" and not torch.cuda.is_available():
        raise MissingPartError(f"{name}: cuda is not available; allowed: cpu")


def to_device(values: NDArray[Any], device: torch.device | str) -> Tensor:
    """Return values in single precision on `device`, as model rollouts use them."""
    return torch.as_tensor(values, dtype=torch.float32, device=device)


def tensor_reward(text: str) -> Reward:
    """Return the reward for a name or for `path.py:name`; a user's function is called with NumPy arrays."""
    reward = make_reward(text)
    if not is_file_reference(text):
        return reward

    def reward_through_numpy(outcome: Outcome) -> dict[str, Tensor]:
        terms = reward(Outcome(*(values.cpu().numpy() for values in outcome)))
        return {name: to_device(np.asarray(term), outcome.speeds.device) for name, term in terms.items()}

    return reward_through_numpy


def tensor_driver(driver: Driver, device: torch.device | str) -> Driver:
    """Return a driver that takes tensors on `device`: the same, or an adapter that calls it with NumPy arrays."""
    return driver if driver.accepts_tensors else NumPyDriverAdapter(driver, torch.device(device))


def tensor_memory(driver: Driver, memory: Memory, device: torch.device | str) -> Memory:
    """Return NumPy `memory` as a driver of `tensor_driver` takes it, in single precision on `device`."""
    return memory if isinstance(driver, NumPyDriverAdapter) else map_leaves(lambda v: to_device(v, device), memory)


@dataclass(frozen=True)
class NumPyDriverAdapter(Driver):
    """Calls a driver that does not take tensors with NumPy arrays; its memory stays in NumPy."""

    accepts_tensors: ClassVar[bool] = True
    driver: Driver
    device: torch.device

    def initial_memory(self, n: int) -> Memory:
        """Return the initial memory of the driver."""
        return self.driver.initial_memory(n)

    def act(self, state: LocalState, memory: Memory) -> tuple[Tensor, Memory]:
        """Return the driver's acceleration as a tensor, and its memory; `InputError` if it is not finite."""
        arrays = state.map(lambda values: values.double().cpu().numpy())
        acceleration, memory = self.driver.act(arrays, memory)
        return to_device(check_acceleration(acceleration, len(state.speed), "model rollout"), self.device), memory

    def memory_features(self, memory: Memory) -> Tensor | None:
        """Return the driver's features as a tensor."""
        features = self.driver.memory_features(memory)
        return None if features is None else to_device(np.asarray(features), self.device)


class ModelTransition(NamedTuple):
    """The result of a model step; n rows of torch tensors."""

    state: LocalState
    reward: Tensor
    crashed: Tensor
    """whether a gap ahead or behind is used up, shape (n,)"""
    clipped: Tensor
    """which of `CLIPPED_QUANTITIES` were clipped, shape (3, n)"""


class Dynamics(Protocol):
    """The transition function of rows."""

    def step(self, state: LocalState, acceleration: Tensor, drawn_values: Tensor) -> ModelTransition:
        """Return the transitions under `acceleration` [m/s2], (n,), in episodes that drew `drawn_values`, (n, m)."""
        ...


class ModelDynamics:
    """Base plus residual of a random member of the ensemble in each step, Eq. 4, for state and reward.

    Noise is a random holdout error of the model, drawn independently for each row and step: it has their standard
    deviations, correlations and tails. Noise alone never causes a collision.
    """

    def __init__(
        self,
        model: RowModel,
        scenario: Scenario,
        reward: str,
        generator: torch.Generator,
        add_noise: bool = True,
        members: Tensor | None = None,
    ) -> None:
        """Make the dynamics on the generator's device; each of `members`, if given, always predicts the same rows."""
        self._model, self._layers, self._fixed_members = model, model.layers(), members
        self._scenario, self._generator, self._add_noise = scenario, generator, add_noise
        self._reward = tensor_reward(reward or scenario.reward)

    def step(self, state: LocalState, acceleration: Tensor, drawn_values: Tensor) -> ModelTransition:
        """Return the transitions under `acceleration`, limited by the safety filter; arguments as of `Dynamics`."""
        scenario = self._scenario
        acceleration = scenario.safety.limit(acceleration, FollowingState(*state[:3]), scenario.control_step)
        base_state = base_step(self._model.base, scenario, state, acceleration)
        expected = torch.stack([getattr(base_state, name) for name in STATE_FIELDS])
        residual = self._residual(state, acceleration, drawn_values, expected[GAP_SLICE]).T
        predicted = expected + residual[: len(STATE_FIELDS)]
        predicted_speeds, predicted_gaps = predicted[: len(SPEED_FIELDS)], predicted[GAP_SLICE]
        crashed = (predicted_gaps <= 0.0).any(0)
        largest_gap = max_gap(state)
        speeds = predicted_speeds.clip(0.0, scenario.top_speed)
        gaps = predicted_gaps.clip(0.0).minimum(largest_gap)
        residual_reward = residual[-1].clip(*self._model.reward_range)
        is_missing = gaps >= largest_gap
        speed = speeds[0]
        distance = distance_driven(state.speed, speed, scenario.simulation_step, scenario.steps_per_control_step)
        position, to_crossing = state.route_position + distance, state.distance_to_crossing
        next_state = LocalState(
            speed=speed,
            leader_speed=torch.where(is_missing[0], speed, speeds[1]),
            leader_gap=gaps[0],
            follower_speed=torch.where(is_missing[1], speed, speeds[2]),
            follower_gap=gaps[1],
            route_position=torch.where(state.loop_length.isnan(), position, position % state.loop_length),
            loop_length=state.loop_length,
            # Behind a crossing the next one is assumed a lap away: rows do not know other crossings.
            distance_to_crossing=None if to_crossing is None else (to_crossing - distance) % state.loop_length,
            penetration_rate=state.penetration_rate,
        )
        reward = base_reward(self._model.base, self._reward, next_state, acceleration, crashed)
        clipped = torch.stack(
            [(speeds != predicted_speeds).any(0), (gaps != predicted_gaps).any(0), residual_reward != residual[-1]]
        )
        return ModelTransition(next_state, reward + residual_reward * ~crashed, crashed, clipped)

    def _residual(self, state: LocalState, acceleration: Tensor, drawn_values: Tensor, expected_gaps: Tensor) -> Tensor:
        """Return the residual of the base with noise, shape (n, 6); `expected_gaps`, (2, n), are the base's."""
        rows, members, generator = len(acceleration), self._fixed_members, self._generator
        if members is None:
            members = random_members(self._model.members, rows, generator)
        residual = predict(self._layers, model_inputs(state, acceleration, drawn_values), members)
        if not self._add_noise:
            return residual
        samples = torch.randint(NOISE_SAMPLES, (rows,), generator=generator, device=generator.device)
        noisy = residual + self._model.noise.index_select(0, samples)
        # Vehicles that change lanes or merge make gaps jump; they do so only where they fit.
        is_collision = (expected_gaps + noisy.T[GAP_SLICE] <= 0.0).any(0)
        return torch.where(is_collision[:, None], residual, noisy)
