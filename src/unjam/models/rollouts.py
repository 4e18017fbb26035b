"""Model rollouts of rows: their dynamics, their length (Eq. 15), and rollouts of the full policy."""

from dataclasses import dataclass, replace
from math import floor, isfinite
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor

from unjam.drivers.check import check_acceleration
from unjam.drivers.command import Command, Limits
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.requirements import Requirements
from unjam.drivers.residual import EXPERT_KEY, RESIDUAL_AGE_KEY, RESIDUAL_KEY, ResidualDriver
from unjam.drivers.safety import ActuatorState, FollowingState, actuate
from unjam.drivers.user_driver import is_file_reference
from unjam.errors import MissingPartError, UnjamError
from unjam.models import row_model
from unjam.models.ensemble import Seed, predict, random_members
from unjam.models.environment_data import EnvironmentData, StartIndices, reconstruct_memory
from unjam.models.settings import Device, ModelSettings
from unjam.physics.kinematics import distance_driven
from unjam.scenarios.scenario import Scenario
from unjam.tree import map_leaves
from unjam.worlds.drive import drive_world
from unjam.worlds.reward import Outcome, Reward, make_reward
from unjam.worlds.world import DriverLog, ProgressCallback

GAP_SLICE = slice(len(row_model.SPEED_FIELDS), len(row_model.STATE_FIELDS))
CLIPPED_QUANTITIES = ("speed", "gap", "reward")


def check_device(device: Device, name: str = "device") -> None:
    """Raise `MissingPartError` if a device is not available; `name` is the setting with the device."""
    if device == "cuda" and not torch.cuda.is_available():
        raise MissingPartError(f"{name}: cuda is not available; allowed: cpu")


def to_device(values: NDArray[Any], device: torch.device | str) -> Tensor:
    """Return values as a tensor on `device` in single precision, the precision of model rollouts."""
    return torch.as_tensor(values, dtype=torch.float32, device=device)


def tensor_reward(name: str) -> Reward:
    """Return the reward of a name or of `path.py:name` for tensors; a user's function is called with NumPy arrays."""
    reward = make_reward(name)
    if not is_file_reference(name):
        return reward

    def reward_through_numpy(outcome: Outcome) -> dict[str, Tensor]:
        terms = reward(Outcome(*(values.cpu().numpy() for values in outcome)))
        return {term: to_device(np.asarray(values), outcome.speeds.device) for term, values in terms.items()}

    return reward_through_numpy


def tensor_driver(driver: Driver, device: torch.device | str) -> Driver:
    """Return a driver that takes tensors on `device`: the given one, or an adapter that calls it with NumPy arrays."""
    return NumPyDriverAdapter(driver, torch.device(device)) if driver.requirements().needs_numpy else driver


def tensor_memory(driver: Driver, memory: Memory, device: torch.device | str) -> Memory:
    """Return NumPy `memory` for a driver of `tensor_driver`, in single precision on `device`."""
    return memory if isinstance(driver, NumPyDriverAdapter) else map_leaves(lambda v: to_device(v, device), memory)


@dataclass(frozen=True)
class NumPyDriverAdapter(Driver):
    """A driver for tensors that calls another driver with NumPy arrays; the memory stays in NumPy."""

    class_requirements: ClassVar[Requirements] = Requirements(needs_arrays=True)
    driver: Driver
    device: torch.device

    def initial_memory(self, n: int) -> Memory:
        """Return the initial memory of the driver."""
        return self.driver.initial_memory(n)

    def act(self, state: LocalState, memory: Memory) -> tuple[Tensor, Memory]:
        """Return acceleration, as a tensor, and memory of the driver; raise `InputError` if not finite."""
        arrays = state.map(lambda values: values.double().cpu().numpy())
        acceleration, memory = self.driver.act(arrays, memory)
        return to_device(check_acceleration(acceleration, len(state.speed), "model rollout"), self.device), memory

    def memory_features(self, memory: Memory) -> Tensor | None:
        """Return the driver's features as a tensor."""
        features = self.driver.memory_features(memory)
        return None if features is None else to_device(np.asarray(features), self.device)


AT_REST = ActuatorState(0.0)
"""state of the actuators of ideal vehicles"""


class ModelTransition(NamedTuple):
    """The result of a model step; n rows of torch tensors."""

    state: LocalState
    reward: Tensor
    crashed: Tensor
    """whether the gap to the leader or of the follower is zero or negative, shape (n,)"""
    clipped: Tensor
    """whether each of `CLIPPED_QUANTITIES` was clipped, shape (3, n)"""
    actuators: ActuatorState = AT_REST


class ModelDynamics:
    """Steps of state and reward: the base plus the residual of a random member of the ensemble, Eq. 4.

    The noise of each row and step is a random holdout error of the model; noise never causes a collision by itself.
    """

    def __init__(
        self,
        model: row_model.RowModel,
        scenario: Scenario,
        reward: str,
        generator: torch.Generator,
        add_noise: bool = True,
        members: Tensor | None = None,
    ) -> None:
        """Create the dynamics on the generator's device; `members`, if given, predict fixed blocks of rows."""
        self._model, self._layers, self._fixed_members = model, model.layers(), members
        self._scenario, self._generator, self._add_noise = scenario, generator, add_noise
        self._reward = tensor_reward(reward or scenario.reward)

    def step(
        self, state: LocalState, acceleration: Tensor, drawn_values: Tensor, actuators: ActuatorState = AT_REST
    ) -> ModelTransition:
        """Return the transitions under commands `acceleration` [m/s2], (n,), with `drawn_values`, (n, m), of episodes.

        The safety filter limits the commands, and the actuators respond with their delay and lag.
        """
        scenario, following = self._scenario, FollowingState(*state[:3])
        acceleration, actuators = actuate(
            scenario.safety, scenario.actuator, acceleration, following, actuators, scenario.control_step
        )
        response = actuators.acceleration
        base_state = row_model.base_step(self._model.base, scenario, state, response)
        expected = torch.stack([getattr(base_state, name) for name in row_model.STATE_FIELDS])
        residual = self._residual(state, response, drawn_values, expected[GAP_SLICE]).T
        predicted = expected + residual[: len(row_model.STATE_FIELDS)]
        predicted_speeds, predicted_gaps = predicted[: len(row_model.SPEED_FIELDS)], predicted[GAP_SLICE]
        crashed = (predicted_gaps <= 0.0).any(0)
        largest_gap = row_model.max_gap(state)
        speeds = predicted_speeds.clip(0.0, scenario.top_speed)
        gaps = predicted_gaps.clip(0.0).minimum(largest_gap)
        residual_reward = residual[-1].clip(*self._model.reward_range)
        is_missing = gaps >= largest_gap
        speed = speeds[0]
        distance = distance_driven(state.speed, speed, scenario.simulation_step, scenario.steps_per_control_step)
        position, crossing_distance = state.route_position + distance, state.distance_to_crossing
        next_state = LocalState(
            speed=speed,
            leader_speed=torch.where(is_missing[0], speed, speeds[1]),
            leader_gap=gaps[0],
            follower_speed=torch.where(is_missing[1], speed, speeds[2]),
            follower_gap=gaps[1],
            route_position=torch.where(state.loop_length.isnan(), position, position % state.loop_length),
            loop_length=state.loop_length,
            # Rows contain one crossing: after it, the next crossing is assumed to be a lap away.
            distance_to_crossing=(
                None if crossing_distance is None else (crossing_distance - distance) % state.loop_length
            ),
            penetration_rate=state.penetration_rate,
        )
        reward = row_model.base_reward(self._model.base, self._reward, next_state, acceleration, crashed)
        is_clipped = (speeds != predicted_speeds).any(0), (gaps != predicted_gaps).any(0)
        clipped = torch.stack([*is_clipped, residual_reward != residual[-1]])
        return ModelTransition(next_state, reward + residual_reward * ~crashed, crashed, clipped, actuators)

    def _residual(self, state: LocalState, acceleration: Tensor, drawn_values: Tensor, expected_gaps: Tensor) -> Tensor:
        """Return the residual with noise, shape (n, 6); `expected_gaps` are the gaps of the base, shape (2, n)."""
        rows, members, generator = len(acceleration), self._fixed_members, self._generator
        if members is None:
            members = random_members(self._model.members, rows, generator)
        residual = predict(self._layers, row_model.model_inputs(state, acceleration, drawn_values), members)
        if not self._add_noise:
            return residual
        samples = torch.randint(row_model.NOISE_SAMPLES, (rows,), generator=generator, device=generator.device)
        noisy_residual = residual + self._model.noise.index_select(0, samples)
        # Noise contains jumps of gaps by lane changes and merging, which vehicles only do if the gap is sufficient.
        is_collision = (expected_gaps + noisy_residual.T[GAP_SLICE] <= 0.0).any(0)
        return torch.where(is_collision[:, None], residual, noisy_residual)


def rollout_length(eps_m: float, settings: ModelSettings) -> int:
    """Return k* = min(k_max, floor(kappa / eps_m)) [control steps], Eq. 15; 0 if the model must not be used."""
    if not isfinite(eps_m):
        return 0
    return settings.k_max if eps_m * settings.k_max <= settings.kappa else floor(settings.kappa / eps_m)


def return_bound(eps_pi: float, eps_m: float, k: int, gamma: float, max_reward: float) -> float:
    """Return C, the bound of the difference between model return and environment return (paper, below Eq. 13).

    `eps_pi` is the total variation of the policy since the data were recorded, and `eps_m` that of next states in the
    model. `k` is the rollout length, and `gamma` the discount factor of a control step.
    """
    horizon = 1.0 / (1.0 - gamma)
    policy_term = gamma ** (k + 1) * eps_pi * horizon**2 + gamma**k * eps_pi * horizon
    return 2.0 * max_reward * (policy_term + k * eps_m * horizon)


class RolloutStarts(NamedTuple):
    """Recorded states from which model rollouts start; n rows."""

    state: LocalState
    """states as tensors of shape (n,)"""
    actuators: ActuatorState
    """actuator states as tensors of shape (n,)"""
    memory: Memory
    """memory of the expert for its `tensor_driver`"""
    drawn_values: Tensor
    """scaled drawn values of the episodes, shape (n, m)"""


@dataclass(frozen=True)
class RolloutBatch:
    """Model rollouts of n rows with the same number of actions of the network; tensors."""

    observations: Tensor
    """observations of the network at each action and at the end, shape (n, actions + 1, inputs)"""
    actions: Tensor
    """residuals with exploration noise, not clipped [m/s2], shape (n, actions)"""
    rewards: Tensor
    """sums of the rewards during each action, zero after a crash, shape (n, actions)"""
    lengths: Tensor
    """number of actions of each row up to its crash, shape (n,)"""
    terminated: Tensor
    """whether each row crashed instead of being truncated, shape (n,)"""
    drawn_values: Tensor
    """scaled drawn values of the episodes, shape (n, m)"""
    control_steps: int
    clipped_share: dict[str, float]
    """share of the control steps in which each of `CLIPPED_QUANTITIES` was clipped"""


def draw_starts(
    data: EnvironmentData,
    rows: int,
    min_control_steps: int,
    seed: Seed,
    first_episode: int = 0,
    *,
    episode_starts_only: bool = False,
) -> StartIndices:
    """Return `rows` random start indices, none without data; `episode_starts_only`: only first steps of recordings."""
    indices = data.start_indices(min_control_steps, first_episode)
    if episode_starts_only:
        indices = indices[indices[:, 1] == 0]
    if len(indices) == 0:
        return indices
    return indices[np.random.default_rng(list(seed)).integers(len(indices), size=rows)]


def prepare_starts(
    data: EnvironmentData, start_indices: StartIndices, expert: Driver, device: torch.device | str
) -> RolloutStarts:
    """Return the starts of rollouts at `start_indices`, with the expert's memory before these steps."""
    drawn_values = np.stack([data.recordings[index].drawn_values for index in start_indices[:, 0]])
    memory = reconstruct_memory(expert, data.recordings, start_indices)
    return RolloutStarts(
        state=data.states_at(start_indices).map(lambda values: to_device(values, device)),
        actuators=data.actuator_states_at(start_indices).map(lambda values: to_device(values, device)),
        memory=tensor_memory(tensor_driver(expert, device), memory, device),
        drawn_values=to_device(drawn_values, device),
    )


class ModelWorld:
    """A world of n rows of the model that start from recorded states; a row does not count after its crash."""

    is_scalar, entered_count, remaining_rows = False, 0, None

    def __init__(
        self,
        dynamics: ModelDynamics,
        starts: RolloutStarts,
        control_steps: int,
        limits: Limits,
        generator: Generator | None,
    ) -> None:
        self.limits, self.cav_count = limits, len(starts.state.speed)
        self.states = [starts.state]
        """states at all steps so far; the last is the current state"""
        self._dynamics, self._starts, self._control_steps, self._generator = dynamics, starts, control_steps, generator
        self._actuators = starts.actuators
        speed = starts.state.speed
        self._is_running, self._running_log, self._rewards = torch.ones_like(speed), [], []
        self._episode_noise: Tensor | None = None
        # Sums in single precision are exact only up to 2^24.
        self._step_total = torch.zeros((), dtype=torch.float64, device=speed.device)
        self._clipped_totals = torch.zeros(len(CLIPPED_QUANTITIES), dtype=torch.float64, device=speed.device)

    def start(self, is_controlled: bool, on_progress: ProgressCallback | None = None) -> None:
        """Do nothing: the starts contain the memory of the driver."""

    @property
    def has_ended(self) -> bool:
        """Whether all control steps have been simulated."""
        return len(self._rewards) >= self._control_steps

    def local_state(self) -> LocalState:
        """Return the current states, tensors of shape (n,)."""
        return self.states[-1]

    def advance(self, command: Command | None) -> None:
        """Simulate one model step in each row."""
        assert command is not None
        acceleration = self.limits.clip(command.acceleration)
        transition = self._dynamics.step(self.states[-1], acceleration, self._starts.drawn_values, self._actuators)
        self._actuators = transition.actuators
        self.states.append(transition.state)
        self._running_log.append(self._is_running)
        self._rewards.append(transition.reward * self._is_running)
        self._clipped_totals += (transition.clipped * self._is_running).sum(1)
        self._step_total += self._is_running.sum()
        self._is_running = self._is_running * ~transition.crashed

    def noise(self, episode_noise_size: int = 0) -> Tensor:
        """Return standard normal noise, independent for each row, shape (n,) or (n, episode_noise_size)."""
        speed = self.states[-1].speed
        if not episode_noise_size:
            return torch.randn(len(speed), generator=self._generator, dtype=torch.float32, device=speed.device)
        if self._episode_noise is None:
            shape = len(speed), episode_noise_size
            noise = torch.randn(shape, generator=self._generator, dtype=torch.float32, device=speed.device)
            self._episode_noise = noise.to(speed.dtype)
        return self._episode_noise

    def record(self, driver_log: DriverLog) -> RolloutBatch:
        """Return the rollouts by action; raise `UnjamError` if a value is not finite."""
        repeat, empty = driver_log.action_repeat, self.states[0].speed.new_zeros((self.cav_count, 0))
        steps = range(0, len(self._rewards), repeat)
        actions = [driver_log.decisions[step][1] for step in steps]
        observations = [*(driver_log.decisions[step][2] for step in steps), driver_log.last_observation]
        zeros = torch.zeros_like(self._is_running)
        rewards = [sum(self._rewards[step : step + repeat], zeros) for step in steps]
        clipped_shares = (self._clipped_totals / self._step_total.clip(1.0)).tolist()
        rollouts = RolloutBatch(
            observations=torch.stack(observations, 1),
            actions=torch.stack(actions, 1) if actions else empty,
            rewards=torch.stack(rewards, 1) if rewards else empty,
            lengths=sum((self._running_log[step] for step in steps), zeros).long(),
            terminated=self._is_running == 0.0,
            drawn_values=self._starts.drawn_values,
            control_steps=int(self._step_total.item()),
            clipped_share=dict(zip(CLIPPED_QUANTITIES, clipped_shares, strict=True)),
        )
        for name in ("observations", "actions", "rewards"):
            if not getattr(rollouts, name).isfinite().all():
                hint = "; speeds of vehicles outside the row are NaN in a reward" if name == "rewards" else ""
                raise UnjamError(f"model rollout: {name} are not finite{hint}")
        return rollouts


@torch.no_grad()
def roll_out(
    driver: ResidualDriver,
    dynamics: ModelDynamics,
    starts: RolloutStarts,
    control_steps: int,
    generator: Generator | None,
) -> RolloutBatch:
    """Drive the full policy in the model for `control_steps`, rounded down to whole actions of the network.

    `generator` draws the exploration noise; None: no exploration. Raise `UnjamError` or `InputError` if values are not
    finite.
    """
    speed, repeat = starts.state.speed, driver.action_repeat
    driver = replace(driver, expert=tensor_driver(driver.expert, speed.device))
    memory: Memory = {EXPERT_KEY: starts.memory}
    if repeat > 1:
        memory |= {RESIDUAL_KEY: torch.zeros_like(speed), RESIDUAL_AGE_KEY: 0.0}  # all rows start with an action
    world = ModelWorld(dynamics, starts, control_steps // repeat * repeat, driver.limits, generator)
    return drive_world(world, driver, generator is not None, memory)
