"""The virtual environment itself: thousands of rows stepped at once as tensors, free of the simulator."""

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
"""where the gaps are among NUMBERS"""
CLIPPED_QUANTITIES = ("speed", "gap", "reward")
"""what is kept within physical bounds"""


def check_device(device: Device, name: str = "device") -> None:
    """Raise `MissingPartError` where there is no such device; `name` says who names it."""
    if device == "cuda" and not torch.cuda.is_available():
        raise MissingPartError(f"{name}: cuda is not there; use cpu")


def to_device(values: NDArray[Any], device: torch.device | str) -> Tensor:
    """Return numbers in single precision on `device`, as the virtual environment has them."""
    return torch.as_tensor(values, dtype=torch.float32, device=device)


def tensor_reward(text: str) -> Reward:
    """Return the reward for a name or for `path.py:name`; a user's function is asked through NumPy."""
    reward = make_reward(text)
    if not is_file_reference(text):
        return reward

    def reward_through_numpy(outcome: Outcome) -> dict[str, Tensor]:
        terms = reward(Outcome(*(values.cpu().numpy() for values in outcome)))
        return {name: to_device(np.asarray(term), outcome.speeds.device) for name, term in terms.items()}

    return reward_through_numpy


def tensor_driver(driver: Driver, device: torch.device | str) -> Driver:
    """Return a driver that takes tensors on `device`: the same, or the same through NumPy."""
    return driver if driver.accepts_tensors else NumPyDriverAdapter(driver, torch.device(device))


def tensor_memory(driver: Driver, memory: Memory, device: torch.device | str) -> Memory:
    """Return NumPy `memory` as a driver of `tensor_driver` takes it, in single precision on `device`."""
    return memory if isinstance(driver, NumPyDriverAdapter) else map_leaves(lambda v: to_device(v, device), memory)


@dataclass(frozen=True)
class NumPyDriverAdapter(Driver):
    """A driver that knows nothing of tensors, asked through NumPy; its memory stays NumPy's."""

    accepts_tensors: ClassVar[bool] = True

    driver: Driver
    device: torch.device
    """where the world is"""

    def initial_memory(self, n: int) -> Memory:
        """Return the driver's."""
        return self.driver.initial_memory(n)

    def act(self, state: LocalState, memory: Memory) -> tuple[Tensor, Memory]:
        """Return the driver's acceleration as a tensor, and its memory.

        Raises:
            InputError: the acceleration is not finite or of a wrong shape.
        """
        numbers = state.map(lambda values: values.double().cpu().numpy())
        answer, memory = self.driver.act(numbers, memory)
        acceleration = check_acceleration(answer, len(state.speed), "virtual environment")
        return to_device(acceleration, self.device), memory

    def memory_features(self, memory: Memory) -> Tensor | None:
        """Return the driver's features as a tensor."""
        features = self.driver.memory_features(memory)
        return None if features is None else to_device(np.asarray(features), self.device)


class ModelTransition(NamedTuple):
    """What a virtual decision led to; n rows of torch tensors."""

    state: LocalState
    reward: Tensor
    crashed: Tensor
    """whether the gap ahead or behind was used up, shape (n,)"""
    clipped: Tensor
    """which of BOUNDS had to be enforced, shape (3, n)"""


class Dynamics(Protocol):
    """What a decision leads to, row by row."""

    def step(self, state: LocalState, acceleration: Tensor, drawn_values: Tensor) -> ModelTransition:
        """Return what `applied` [m/s2], shape (n,), leads to; `drawn`, (n, m), is what the episode drew."""
        ...


class ModelDynamics:
    """IDM plus residual networks; Eq. 4, for state and reward.

    In each step a random member of the ensemble answers for each row. Noise is an error that the model made
    somewhere on the holdout, drawn anew for each row and step: so it has the errors' standard deviations,
    the correlations between them, and their tails. Noise alone never makes a crash.
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
        """Make the world of `scenario` as `model` has it, on the generator's device.

        With `members`, those answer in every step, each for an equal share of the rows in turn.
        """
        self._model, self._layers, self._fixed_members = model, model.layers(), members
        self._scenario, self._generator, self._add_noise = scenario, generator, add_noise
        self._reward = tensor_reward(reward or scenario.reward)

    def step(self, state: LocalState, acceleration: Tensor, drawn_values: Tensor) -> ModelTransition:
        """Return what `applied` leads to once it is filtered: next state, reward, whether that is a crash."""
        scenario = self._scenario
        acceleration = scenario.safety.limit(acceleration, FollowingState(*state[:3]), scenario.control_step)
        known = base_step(self._model.base, scenario, state, acceleration)
        expected = torch.stack([getattr(known, name) for name in STATE_FIELDS])
        residual = self._residual(state, acceleration, drawn_values, expected[GAP_SLICE]).T
        numbers = expected + residual[: len(STATE_FIELDS)]
        wanted_speeds, wanted_gaps = numbers[: len(SPEED_FIELDS)], numbers[GAP_SLICE]
        crashed = (wanted_gaps <= 0.0).any(0)
        largest = max_gap(state)
        speeds = wanted_speeds.clip(0.0, scenario.top_speed)
        gaps = wanted_gaps.clip(0.0).minimum(largest)
        residual_reward = residual[-1].clip(*self._model.reward_range)
        nobody = gaps >= largest
        speed = speeds[0]
        driven = distance_driven(state.speed, speed, scenario.simulation_step, scenario.steps_per_control_step)
        position, ahead = state.route_position + driven, state.distance_to_crossing
        following = LocalState(
            speed=speed,
            leader_speed=torch.where(nobody[0], speed, speeds[1]),
            leader_gap=gaps[0],
            follower_speed=torch.where(nobody[1], speed, speeds[2]),
            follower_gap=gaps[1],
            route_position=torch.where(state.loop_length.isnan(), position, position % state.loop_length),
            loop_length=state.loop_length,
            # Behind a crossing the next is taken to be a lap away: rows do not know where else there is one.
            distance_to_crossing=None if ahead is None else (ahead - driven) % state.loop_length,
            penetration_rate=state.penetration_rate,
        )
        earned = base_reward(self._model.base, self._reward, following, acceleration, crashed)
        bounded = torch.stack(
            [(speeds != wanted_speeds).any(0), (gaps != wanted_gaps).any(0), residual_reward != residual[-1]]
        )
        return ModelTransition(following, earned + residual_reward * ~crashed, crashed, bounded)

    def _residual(self, state: LocalState, acceleration: Tensor, drawn_values: Tensor, expected_gaps: Tensor) -> Tensor:
        """Return what the networks add to the base, with noise, shape (n, 6).

        `expected_gaps`, shape (2, n), are those of the base.
        """
        rows, members = len(acceleration), self._fixed_members
        if members is None:
            members = random_members(self._model.members, rows, self._generator)
        residual = predict(self._layers, model_inputs(state, acceleration, drawn_values), members)
        if self._add_noise:
            generator = self._generator
            chosen = torch.randint(NOISE_SAMPLES, (rows,), generator=generator, device=generator.device)
            noisy = residual + self._model.noise.index_select(0, chosen)
            # A vehicle that changes lanes or merges makes a gap jump: it does so only where it fits.
            closes = (expected_gaps + noisy.T[GAP_SLICE] <= 0.0).any(0)
            residual = torch.where(closes[:, None], residual, noisy)
        return residual
