"""Virtual beside actual: the same accelerations from the same start, and the same policy in the loop."""

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.models.dynamics import ModelDynamics, to_device
from unjam.models.ensemble import torch_generator
from unjam.models.environment_data import EnvironmentData, Transitions
from unjam.models.fitting import OneStepErrors, residual_targets
from unjam.models.rollouts import ModelWorld, RolloutStarts
from unjam.models.row_model import STATE_FIELDS, RowModel, model_inputs
from unjam.physics.arrays import Array
from unjam.scenarios.scenario import Scenario
from unjam.worlds.drive import DriveLoop
from unjam.worlds.record import Floats


class OpenLoopErrors(NamedTuple):
    """Virtual against actual states under the same accelerations; H decisions."""

    error: dict[str, Floats]
    """root mean square of the error of a member, by number of the state [m/s, m], shape (H,)"""
    spread: dict[str, Floats]
    """standard deviation of the members about their mean [m/s, m], shape (H,); zero for one member"""
    change: dict[str, Floats]
    """root mean square of what happened: how far the actual state is from its start, shape (H,)"""


def open_loop_errors(
    model: RowModel, data: EnvironmentData, start_indices: NDArray[np.int64], control_steps: int, scenario: Scenario
) -> OpenLoopErrors:
    """Replay recorded accelerations in the virtual environment, and tell how far it goes astray.

    The arguments are those of `replay`.
    """
    actual = recorded_states(data, start_indices, control_steps)
    error, spread, change = {}, {}, {}
    for name, virtual in replay_accelerations(model, data, start_indices, control_steps, scenario).items():
        error[name] = np.sqrt(np.square(virtual - actual[name][:, 1:]).mean((0, 1)))
        spread[name] = np.sqrt(virtual.var(0).mean(0))
        change[name] = np.sqrt(np.square(actual[name][:, 1:] - actual[name][:, :1]).mean(0))
    return OpenLoopErrors(error, spread, change)


def recorded_states(data: EnvironmentData, start_indices: NDArray[np.int64], control_steps: int) -> dict[str, Floats]:
    """Return what happened from `choices` on, by number of the state [m/s, m], shape (rows, H + 1)."""
    windows = [(data.recordings[place].states, slice(at, at + control_steps + 1)) for place, at in start_indices]
    return {name: np.stack([getattr(states, name)[at] for states, at in windows]) for name in STATE_FIELDS}


@dataclass(frozen=True)
class ReplayDriver(Driver):
    """Accelerations that were recorded, one decision after the other."""

    accelerations: Array
    """[m/s2], shape (H, rows)"""

    def initial_memory(self, n: int) -> Memory:
        """Return that nothing was decided yet."""
        return {"index": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return those of this decision."""
        return self.accelerations[int(memory["index"][0])], {"index": memory["index"] + 1.0}


@torch.no_grad()
def replay_accelerations(
    model: RowModel, data: EnvironmentData, start_indices: NDArray[np.int64], control_steps: int, scenario: Scenario
) -> dict[str, Floats]:
    """Replay recorded accelerations in the virtual environment, without noise, each member by itself.

    Args:
        model: fitted, or new: then it is the base alone.
        data: actual data.
        choices: where to begin, rows (recording, decision); at least `decisions` recorded ones must follow.
        decisions: H.
        scenario: the road.

    Returns:
        By number of the state [m/s, m], shape (members, rows, H).
    """
    device = model.input_mean.device
    each_member = np.tile(start_indices, (model.members, 1))
    states = data.states_at(each_member).map(lambda values: to_device(values, device))
    drawn = np.stack([data.recordings[place].drawn_values for place in each_member[:, 0]])
    applied = np.stack([data.recordings[place].applied_acceleration[at : at + control_steps] for place, at in each_member], 1)
    starts = RolloutStarts(states, {}, to_device(drawn, device), each_member)
    generator = torch_generator((0,), device)  # nothing is drawn from it
    members = torch.arange(model.members, device=device)
    dynamics = ModelDynamics(model, scenario, "", generator, add_noise=False, members=members)
    world = ModelWorld(dynamics, starts, control_steps, scenario.acceleration_limits, None)
    for _ in DriveLoop(world, ReplayDriver(to_device(applied, device))):
        pass
    shape = model.members, len(start_indices), control_steps
    found = {name: torch.stack([getattr(state, name) for state in world.states[1:]], 1) for name in STATE_FIELDS}
    return {name: numbers.view(shape).cpu().numpy() for name, numbers in found.items()}


def one_step_errors(model: RowModel, transitions: Transitions, scenario: Scenario, reward: str) -> OneStepErrors:
    """Return the errors of base and model in predicting each of the actual decisions."""
    wanted, changed = (residual_targets(transitions, base, scenario, reward) for base in (model.base, "none"))
    inputs = torch.as_tensor(model_inputs(transitions.states, transitions.acceleration, transitions.drawn_values))
    answers = model.member_predictions(inputs.to(model.input_mean.device))
    return OneStepErrors(wanted, answers * model.output_mask.cpu().numpy(), changed)  # elsewhere the base is used


class ReturnGap(NamedTuple):
    """Mean return of virtual rollouts beside the actual one of the same rows, over as many decisions."""

    model_return: float
    environment_return: float
    standard_error: float
    """of their difference, rows taken as independent"""


def return_gap(
    model_returns: Floats, start_indices: NDArray[np.int64], data: EnvironmentData, control_steps: int
) -> ReturnGap | None:
    """Compare what so many virtual decisions earned with what was earned from the same actual rows.

    `earned` has shape (rows,), `starts` where each began, rows (recording, decision).

    The comparison is fair where the same policy drove both, with exploration. Returns are sums of the
    rewards, not discounted, until the last decision or a crash. Rows that fewer recorded decisions follow are
    left out; None where nothing is left.
    """
    actually = [data.recordings[place].reward[at : at + control_steps] for place, at in start_indices]
    whole = [len(rewards) == control_steps for rewards in actually]
    if not any(whole):
        return None
    virtual = model_returns[whole]
    actual = np.array([rewards.sum() for rewards in itertools.compress(actually, whole)])
    error = (virtual - actual).std() / np.sqrt(len(actual))
    return ReturnGap(float(virtual.mean()), float(actual.mean()), float(error))
