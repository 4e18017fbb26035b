"""The learned model of a run, with which users simulate n rows, each a CAV with its leader and follower."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import ActuatorState
from unjam.drivers.user_driver import DriverLike, as_driver
from unjam.errors import InputError, invalid_value
from unjam.models.ensemble import torch_generator
from unjam.models.environment_data import StartIndices
from unjam.models.registry import RowWorldModel
from unjam.models.rollouts import ModelDynamics, ModelTransition, draw_starts, tensor_driver, tensor_memory, to_device
from unjam.parameters import check_integer
from unjam.training.model_facts import TrainedModel, read_trained_model, trained_model_facts
from unjam.training.random_state import torch_defaults
from unjam.training.run_folder import read_config
from unjam.worlds.episode import check_can_drive

DEVICE = "cpu"


class ModelState(NamedTuple):
    """Complete state of n rows of a learned model, in tensors of single precision."""

    observed: LocalState
    """observations of the CAVs, shape (n,)"""
    actuators: ActuatorState
    """accelerations and pending commands of the CAVs [m/s2], shape (n,)"""
    drawn_values: Tensor
    """scaled drawn values of the recorded episodes, shape (n, m)"""
    is_running: Tensor
    """1 before a collision, else 0, shape (n,)"""
    generator_state: Tensor
    """state of the generator of the model's random numbers"""


class ModelTrajectories(NamedTuple):
    """Trajectories of n rows over H control steps of a learned model, as tensors."""

    states: LocalState
    """shape (n, H + 1)"""
    rewards: Tensor
    """zero after a collision, shape (n, H)"""
    crashed: Tensor
    """whether the CAV collided, shape (n,)"""


class LearnedModel:
    """The learned model of a run, from `unjam.load_world_model`; it starts with one row.

    As in training, a random network of the ensemble corrects the base model for each row in each step, and noise as
    large as the model's errors is added. Steps are differentiable in the accelerations and in the state.
    """

    def __init__(self, trained: TrainedModel) -> None:
        """Take the model from a checkpoint."""
        self._trained, model = trained, trained.rollouts.world_model
        assert isinstance(model, RowWorldModel)
        self.world_model = model
        self._generator = torch_generator((0,), DEVICE)
        reward, has_noise = model.task.reward, model.settings.add_noise
        self._dynamics = ModelDynamics(model.ensemble, model.scenario, reward, self._generator, has_noise)
        self.reset(1)

    def reset(self, rows: int, seed: int = 0, episode_starts_only: bool = False) -> LocalState:
        """Start from random recorded states, or random first states of episodes, and return the observations.

        `seed` determines these states and the model's noise. Raise `InputError` if `rows` is below 1.
        """
        data, rows = self.world_model.data, check_integer("rows", rows, 1)
        return self.reset_at(draw_starts(data, rows, 1, (seed, 0), episode_starts_only=episode_starts_only), seed)

    def reset_at(self, start_indices: StartIndices, seed: int = 0) -> LocalState:
        """Start from the recorded states with the indices (recording, control step), shape (n, 2), as `reset` does."""
        data = self.world_model.data
        drawn_values = np.stack([data.recordings[index].drawn_values for index in start_indices[:, 0]])
        observed = data.states_at(start_indices).map(lambda values: to_device(values, DEVICE))
        generator_state = torch_generator((seed,), DEVICE).get_state()
        is_running = torch.ones_like(observed.speed)
        actuators = data.actuator_states_at(start_indices).map(lambda values: to_device(values, DEVICE))
        self.set_state(ModelState(observed, actuators, to_device(drawn_values, DEVICE), is_running, generator_state))
        return observed

    def state(self) -> ModelState:
        """Return the current state, which later steps do not change."""
        return self._state._replace(generator_state=self._generator.get_state())

    def set_state(self, state: ModelState) -> None:
        """Continue from a state; raise `InputError` if it has tensors of different sizes, or NaN."""
        rows, drawn_size = len(state.observed.speed), len(self.world_model.scenario.drawn_ranges)
        actuator_tensors = state.actuators.acceleration, *state.actuators.pending
        for name, tensor, shape in (
            *((name, tensor, (rows,)) for name, tensor in state.observed._asdict().items() if tensor is not None),
            *(("actuators", tensor, (rows,)) for tensor in actuator_tensors),
            ("drawn_values", state.drawn_values, (rows, drawn_size)),
            ("is_running", state.is_running, (rows,)),
        ):
            if tuple(tensor.shape) != shape:
                raise invalid_value(f"state: shape of {name}", tuple(tensor.shape), str(shape))
            if bool(tensor.isnan().any()):
                raise invalid_value(f"state: {name}", "nan", "numbers")
        self._generator.set_state(state.generator_state)
        self._state = state

    def step(self, acceleration: Any) -> ModelTransition:
        """Make one control step with `acceleration` [m/s2], shape (n,), within the limits and the safety filter.

        After a collision, a row still moves, but its reward is zero; `crashed` is true from the collision on.
        """
        observed, actuators, drawn_values, is_running, _ = self._state
        if not isinstance(acceleration, Tensor):  # torch's default type would depend on the program
            acceleration = np.asarray(acceleration, np.float64)
        acceleration = torch.as_tensor(acceleration, device=DEVICE)
        if tuple(acceleration.shape) != tuple(observed.speed.shape):
            raise invalid_value("acceleration: shape", tuple(acceleration.shape), str(tuple(observed.speed.shape)))
        if not bool((is_finite := acceleration.isfinite()).all()):
            raise invalid_value("acceleration", float(acceleration[~is_finite][0]), "finite numbers")
        limits = self.world_model.scenario.acceleration_limits
        command = limits.clip(acceleration.to(observed.speed))
        transition = self._dynamics.step(observed, command, drawn_values, actuators)
        still_running = is_running * ~transition.crashed
        self._state = self._state._replace(
            observed=transition.state, actuators=transition.actuators, is_running=still_running
        )
        return transition._replace(reward=transition.reward * is_running, crashed=still_running == 0.0)

    @torch.no_grad()
    def roll_out(self, driver: DriverLike, control_steps: int) -> ModelTrajectories:
        """Let a driver with its initial memory drive all rows from the current state on.

        Raise `InputError` if the driver needs fields that rows do not have, or returns a value that is not finite, or
        if `control_steps` is below 1.
        """
        check_integer("control_steps", control_steps, 1)
        scenario, rows = self.world_model.scenario, len(self._state.observed.speed)
        array_driver = as_driver(driver, scenario.control_step)
        check_can_drive(array_driver, scenario)
        torch_driver = tensor_driver(array_driver, DEVICE)
        memory = tensor_memory(torch_driver, torch_driver.initial_memory(rows), DEVICE)
        states, rewards = [self._state.observed], []
        for _ in range(control_steps):
            acceleration, memory = torch_driver.act(states[-1], memory)
            transition = self.step(acceleration)
            states.append(transition.state)
            rewards.append(transition.reward)
        stacked = states[0].map(lambda *values: torch.stack(values, 1), *states[1:])
        return ModelTrajectories(stacked, torch.stack(rewards, 1), self._state.is_running == 0.0)

    @torch_defaults()
    def error_report(self) -> dict[str, Any]:
        """Return the errors of the model on holdout episodes, which no network was fitted to, as `unjam model` does.

        `one_step` and `by_state` have the RMSE of single steps, `replay` the RMSE of replays over time, and `bound` the
        bound by rollout length, or None.
        """
        return trained_model_facts(self._trained)


@torch_defaults()
def load_world_model(run: Path | str) -> LearnedModel:
    """Return the learned model in the newest checkpoint of a run folder.

    Raise `InputError` if the folder is damaged, or has no checkpoint or no row model, as with several tasks.
    """
    if not isinstance(run, Path | str):
        raise invalid_value("run", run, "a run folder")
    folder = Path(run)
    config = read_config(folder)
    if config.model.kind == "road" and config.model.model_ratio > 0:
        raise InputError(f"run: {str(folder)!r} has a model of whole roads, model.kind 'road'; allowed: 'row'")
    return LearnedModel(read_trained_model(folder, config))
