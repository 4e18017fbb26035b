"""Comparison of a row model and the environment: replayed accelerations and one-step errors."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.models.ensemble import torch_generator
from unjam.models.environment_data import EnvironmentData, StartIndices, Transitions
from unjam.models.rollouts import ModelDynamics, ModelWorld, RolloutStarts, to_device
from unjam.models.row_model import STATE_FIELDS, OneStepErrors, RowModel, model_inputs, residual_targets
from unjam.physics.arrays import Array
from unjam.scenarios.scenario import Scenario
from unjam.worlds.drive import DriveLoop
from unjam.worlds.record import Floats


class OpenLoopErrors(NamedTuple):
    """Errors of model states relative to recorded states under the same accelerations; H control steps."""

    error: dict[str, Floats]
    """root mean squared error of the members by name of `STATE_FIELDS` [m/s, m], shape (H,)"""
    spread: dict[str, Floats]
    """standard deviation of the members around their mean by name [m/s, m], shape (H,); zero for one member"""
    change: dict[str, Floats]
    """root mean square of the recorded change since the start by name [m/s, m], shape (H,)"""


def open_loop_errors(
    model: RowModel, data: EnvironmentData, start_indices: StartIndices, control_steps: int, scenario: Scenario
) -> OpenLoopErrors:
    """Replay recorded accelerations in the model, and return its errors; arguments as in `replay_accelerations`."""
    recorded = recorded_states(data, start_indices, control_steps)
    error, spread, change = {}, {}, {}
    for name, predicted in replay_accelerations(model, data, start_indices, control_steps, scenario).items():
        error[name] = np.sqrt(np.square(predicted - recorded[name][:, 1:]).mean((0, 1)))
        spread[name] = np.sqrt(predicted.var(0).mean(0))
        change[name] = np.sqrt(np.square(recorded[name][:, 1:] - recorded[name][:, :1]).mean(0))
    return OpenLoopErrors(error, spread, change)


def recorded_states(data: EnvironmentData, start_indices: StartIndices, control_steps: int) -> dict[str, Floats]:
    """Return the recorded states from each start on, by name of `STATE_FIELDS` [m/s, m], shape (n, H + 1)."""
    slices = [(data.recordings[index].states, slice(step, step + control_steps + 1)) for index, step in start_indices]
    return {name: np.stack([getattr(states, name)[window] for states, window in slices]) for name in STATE_FIELDS}


@dataclass(frozen=True)
class ReplayDriver(Driver):
    """A driver that applies recorded accelerations step by step."""

    accelerations: Array
    """accelerations of n CAVs [m/s2], shape (steps, n)"""

    def initial_memory(self, n: int) -> Memory:
        """Return the index of the first step."""
        return {"index": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the recorded accelerations of the step in the memory."""
        return self.accelerations[int(memory["index"][0])], {"index": memory["index"] + 1.0}


@torch.no_grad()
def replay_accelerations(
    model: RowModel, data: EnvironmentData, start_indices: StartIndices, control_steps: int, scenario: Scenario
) -> dict[str, Floats]:
    """Replay H recorded accelerations in each member of the model without noise; an unfitted model is the base.

    Returns states by name of `STATE_FIELDS` [m/s, m], shape (members, n, H).
    """
    device = model.input_mean.device
    indices = np.tile(start_indices, (model.members, 1))
    recordings = [data.recordings[index] for index in indices[:, 0]]
    states = data.states_at(indices).map(lambda values: to_device(values, device))
    drawn_values = to_device(np.stack([recording.drawn_values for recording in recordings]), device)
    steps, applied = indices[:, 1], [recording.applied_acceleration for recording in recordings]
    windows = [values[step : step + control_steps] for values, step in zip(applied, steps, strict=True)]
    accelerations = np.stack(windows, 1)
    generator = torch_generator((0,), device)  # not used
    members = torch.arange(model.members, device=device)
    dynamics = ModelDynamics(model, scenario, "", generator, add_noise=False, members=members)
    actuators = data.actuator_states_at(indices).map(lambda values: to_device(values, device))
    starts = RolloutStarts(states, actuators, {}, drawn_values)
    world = ModelWorld(dynamics, starts, control_steps, scenario.acceleration_limits, None)
    for _ in DriveLoop(world, ReplayDriver(to_device(accelerations, device))):
        pass
    shape = model.members, len(start_indices), control_steps
    columns = {name: torch.stack([getattr(state, name) for state in world.states[1:]], 1) for name in STATE_FIELDS}
    return {name: values.view(shape).cpu().numpy() for name, values in columns.items()}


def one_step_errors(model: RowModel, transitions: Transitions, scenario: Scenario, reward: str) -> OneStepErrors:
    """Return the errors of base and model in the prediction of each transition."""
    targets, change = (residual_targets(transitions, base, scenario, reward) for base in (model.base, "none"))
    inputs = torch.as_tensor(model_inputs(transitions.states, transitions.response, transitions.drawn_values))
    predictions = model.member_predictions(inputs.to(model.input_mean.device))
    return OneStepErrors(targets, predictions * model.output_mask.cpu().numpy(), change)
