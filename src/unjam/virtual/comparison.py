"""Virtual beside actual: the same accelerations from the same start, and the same policy in the loop."""

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.physics.arrays import Array
from unjam.scenarios.scenario import Scenario
from unjam.virtual.data import ActualData, Transitions
from unjam.virtual.ensemble import torch_generator
from unjam.virtual.fitting import OneStepErrors, targets_of
from unjam.virtual.model import NUMBERS, EnvironmentModel, model_inputs
from unjam.virtual.rollout import ImaginedWorld, Starts
from unjam.virtual.world import VirtualDynamics, on_device
from unjam.worlds.drive import Drive
from unjam.worlds.record import Floats


class OpenLoop(NamedTuple):
    """Virtual against actual states under the same accelerations; H decisions."""

    error: dict[str, Floats]
    """root mean square of the error of a member, by number of the state [m/s, m], shape (H,)"""
    spread: dict[str, Floats]
    """standard deviation of the members about their mean [m/s, m], shape (H,); zero for one member"""
    change: dict[str, Floats]
    """root mean square of what happened: how far the actual state is from its start, shape (H,)"""


def open_loop(
    model: EnvironmentModel, data: ActualData, choices: NDArray[np.int64], decisions: int, scenario: Scenario
) -> OpenLoop:
    """Replay recorded accelerations in the virtual environment, and tell how far it goes astray.

    The arguments are those of `replay`.
    """
    actual = recorded(data, choices, decisions)
    error, spread, change = {}, {}, {}
    for name, virtual in replay(model, data, choices, decisions, scenario).items():
        error[name] = np.sqrt(np.square(virtual - actual[name][:, 1:]).mean((0, 1)))
        spread[name] = np.sqrt(virtual.var(0).mean(0))
        change[name] = np.sqrt(np.square(actual[name][:, 1:] - actual[name][:, :1]).mean(0))
    return OpenLoop(error, spread, change)


def recorded(data: ActualData, choices: NDArray[np.int64], decisions: int) -> dict[str, Floats]:
    """Return what happened from `choices` on, by number of the state [m/s, m], shape (rows, H + 1)."""
    windows = [(data.recordings[place].states, slice(at, at + decisions + 1)) for place, at in choices]
    return {name: np.stack([getattr(states, name)[at] for states, at in windows]) for name in NUMBERS}


@dataclass(frozen=True)
class Replayed(Driver):
    """Accelerations that were recorded, one decision after the other."""

    accelerations: Array
    """[m/s2], shape (H, rows)"""

    def initial_memory(self, n: int) -> Memory:
        """Return that nothing was decided yet."""
        return {"decision": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return those of this decision."""
        return self.accelerations[int(memory["decision"][0])], {"decision": memory["decision"] + 1.0}


@torch.no_grad()
def replay(
    model: EnvironmentModel, data: ActualData, choices: NDArray[np.int64], decisions: int, scenario: Scenario
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
    each_member = np.tile(choices, (model.members, 1))
    states = data.states_at(each_member).each(lambda values: on_device(values, device))
    drawn = np.stack([data.recordings[place].drawn for place in each_member[:, 0]])
    applied = np.stack([data.recordings[place].applied[at : at + decisions] for place, at in each_member], 1)
    starts = Starts(states, {}, on_device(drawn, device), each_member)
    generator = torch_generator((0,), device)  # nothing is drawn from it
    members = torch.arange(model.members, device=device)
    dynamics = VirtualDynamics(model, scenario, "", generator, noise=False, members=members)
    world = ImaginedWorld(dynamics, starts, decisions, scenario.limits, None)
    for _ in Drive(world, Replayed(on_device(applied, device))):
        pass
    shape = model.members, len(choices), decisions
    found = {name: torch.stack([getattr(state, name) for state in world.states[1:]], 1) for name in NUMBERS}
    return {name: numbers.view(shape).cpu().numpy() for name, numbers in found.items()}


def one_step_errors(
    model: EnvironmentModel, actual: Transitions, scenario: Scenario, reward: str
) -> OneStepErrors:
    """Return the errors of base and model in predicting each of the actual decisions."""
    wanted, changed = (targets_of(actual, base, scenario, reward) for base in (model.base, "none"))
    inputs = torch.as_tensor(model_inputs(actual.states, actual.applied, actual.drawn))
    answers = model.answers(inputs.to(model.input_mean.device))
    return OneStepErrors(wanted, answers * model.learned.cpu().numpy(), changed)  # elsewhere the base is used


class ReturnGap(NamedTuple):
    """Mean return of virtual rollouts beside the actual one of the same rows, over as many decisions."""

    virtual: float
    actual: float
    standard_error: float
    """of their difference, rows taken as independent"""


def return_gap(
    earned: Floats, starts: NDArray[np.int64], data: ActualData, decisions: int
) -> ReturnGap | None:
    """Compare what so many virtual decisions earned with what was earned from the same actual rows.

    `earned` has shape (rows,), `starts` where each began, rows (recording, decision).

    The comparison is fair where the same policy drove both, with exploration. Returns are sums of the
    rewards, not discounted, until the last decision or a crash. Rows that fewer recorded decisions follow are
    left out; None where nothing is left.
    """
    actually = [data.recordings[place].reward[at : at + decisions] for place, at in starts]
    whole = [len(rewards) == decisions for rewards in actually]
    if not any(whole):
        return None
    virtual = earned[whole]
    actual = np.array([rewards.sum() for rewards in itertools.compress(actually, whole)])
    error = (virtual - actual).std() / np.sqrt(len(actual))
    return ReturnGap(float(virtual.mean()), float(actual.mean()), float(error))
