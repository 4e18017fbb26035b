"""Environment data (D_a in the paper): models are fitted to these data, and rollouts start from their states."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from math import inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.command import Limits
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.safety import INSTANT_ACTUATOR, Actuator, ActuatorState
from unjam.errors import InputError
from unjam.physics.arrays import Array
from unjam.scenarios.scenario import Scenario
from unjam.tree import map_leaves
from unjam.worlds.drive import DriveLoop
from unjam.worlds.record import Episode, Floats, Trajectory
from unjam.worlds.world import RecordedWorld

StartIndices = NDArray[np.int64]
"""n recorded states as rows (recording, control step), shape (n, 2)"""
GOLDEN_RATIO = (5**0.5 - 1) / 2
"""golden ratio; the fractional parts of its multiples cover the unit interval evenly, however many there are"""


@dataclass(frozen=True)
class Recording(Trajectory):
    """A stored trajectory, with the index of its episode and the scaled drawn values of the episode, shape (m,)."""

    drawn_values: Floats = field(default_factory=lambda: np.zeros(0))
    episode: int = 0


class Transitions(NamedTuple):
    """Control steps of many trajectories, one after the other; R rows, arrays of shape (R,)."""

    states: LocalState
    acceleration: Floats
    """commanded acceleration after the safety filter [m/s2]"""
    response: Floats
    """acceleration in the step, which follows the commands with delay and lag [m/s2]"""
    drawn_values: Floats
    """scaled drawn values of the episode, shape (R, m)"""
    next_states: LocalState
    reward: Floats
    crashed: NDArray[np.bool_]
    is_holdout: NDArray[np.bool_]

    def select(self, rows: NDArray[np.int64]) -> "Transitions":
        """Return the transitions with these indices."""
        return Transitions._make(
            column.select(rows) if isinstance(column, LocalState) else column[rows] for column in self
        )


@dataclass
class EnvironmentData:
    """The trajectories of the newest episodes; the oldest are dropped if `capacity` control steps remain."""

    capacity: int
    actuator: Actuator = INSTANT_ACTUATOR
    control_step: float = 0.1
    """duration of a control step, used if the actuator is not instant [s]"""
    recordings: list[Recording] = field(default_factory=list)
    """stored trajectories, the oldest first"""
    episode_count: int = 0
    """number of episodes that were added, including those that were dropped"""

    def __len__(self) -> int:
        return sum(len(recording.reward) for recording in self.recordings)

    def add(self, episodes: Sequence[Episode], scenario: Scenario) -> None:
        """Store the trajectories of `episodes`, and drop the oldest episodes beyond the capacity."""
        for episode in episodes:
            scaled_values = scenario.scale_drawn_values(episode.drawn_values) if episode.has_run else ()
            drawn_values = np.array(scaled_values, np.float64)
            for trajectory in episode.trajectories:
                columns = {column.name: getattr(trajectory, column.name) for column in fields(Trajectory)}
                self.recordings.append(Recording(**columns, drawn_values=drawn_values, episode=self.episode_count))
            self.episode_count += 1
        while self.recordings:
            oldest = self.recordings[0].episode
            newer = [recording for recording in self.recordings if recording.episode != oldest]
            if sum(len(recording.reward) for recording in newer) < self.capacity:
                break
            self.recordings = newer

    def transitions(self, holdout: float) -> Transitions:
        """Return all control steps, a share `holdout` of the episodes marked as holdout; `InputError` without steps."""
        if not len(self):
            raise InputError("model: there are no environment steps for its fit")

        def concatenate(column: Callable[[Recording], Any]) -> Any:
            return np.concatenate([column(recording) for recording in self.recordings])

        return Transitions(
            states=_concatenate_states([r.states.select(slice(-1)) for r in self.recordings]),
            acceleration=concatenate(lambda r: r.applied_acceleration),
            response=concatenate(self._response),
            drawn_values=concatenate(lambda r: np.tile(r.drawn_values, (len(r.reward), 1))),
            next_states=_concatenate_states([r.states.select(slice(1, None)) for r in self.recordings]),
            reward=concatenate(lambda r: r.reward),
            crashed=concatenate(lambda r: (np.arange(len(r.reward)) == len(r.reward) - 1) & r.terminated),
            is_holdout=np.concatenate(self.holdout_masks(holdout)),
        )

    def holdout_masks(self, holdout: float) -> list[NDArray[np.bool_]]:
        """Return a mask of the steps of each recording that are held out.

        Held out are fixed episodes, or the last part of each recording if these would be all episodes or none.
        """
        masks = [np.full(len(r.reward), is_holdout_episode(r.episode, holdout)) for r in self.recordings]
        if np.concatenate(masks).all() or not np.concatenate(masks).any():
            return [np.arange(len(mask)) >= max(1, (1 - holdout) * len(mask)) for mask in masks]
        return masks

    def start_indices(self, min_control_steps: int = 1, first_episode: int = 0) -> StartIndices:
        """Return the steps with a new action and enough steps after them, in episodes from `first_episode` on."""
        action_steps = {
            index: np.arange(0, len(recording.reward) - min_control_steps + 1, recording.action_repeat)
            for index, recording in enumerate(self.recordings)
            if recording.episode >= first_episode
        }
        indices = np.repeat(np.array(list(action_steps), np.int64), [len(steps) for steps in action_steps.values()])
        return np.column_stack([indices, np.concatenate([[], *action_steps.values()]).astype(np.int64)])

    def states_at(self, start_indices: StartIndices) -> LocalState:
        """Return the states at `start_indices`, arrays of shape (n,)."""
        first_rows = np.cumsum([0, *(len(recording.states.speed) for recording in self.recordings)])
        rows = first_rows[start_indices[:, 0]] + start_indices[:, 1]
        return _concatenate_states([recording.states for recording in self.recordings]).select(rows)

    def actuator_states_at(self, start_indices: StartIndices) -> ActuatorState:
        """Return the actuator states at `start_indices`, arrays of shape (n,); actuators are at rest before step 0."""
        if self.actuator.is_instant:
            return ActuatorState(np.zeros(len(start_indices)))
        starts = [(self.recordings[index], step) for index, step in start_indices]
        pending = [
            np.array([recording.applied_acceleration[step - lag] if step >= lag else 0.0 for recording, step in starts])
            for lag in range(self.actuator.delay_steps(self.control_step), 0, -1)
        ]
        changes = np.array(
            [recording.states.speed[step] - recording.states.speed[max(step - 1, 0)] for recording, step in starts]
        )
        return ActuatorState(changes / self.control_step, tuple(pending))

    def _response(self, recording: Recording) -> Floats:
        if self.actuator.is_instant:
            return recording.applied_acceleration
        return np.diff(recording.states.speed) / self.control_step


def is_holdout_episode(episode: Array, holdout: float) -> Array:
    """Return whether episodes belong to the holdout, an evenly spread share `holdout` of all episodes."""
    return (episode * GOLDEN_RATIO) % 1.0 < holdout


def _concatenate_states(states: Sequence[LocalState]) -> LocalState:
    return states[0].map(lambda *values: np.concatenate(values), *states[1:])


def reconstruct_memory(expert: Driver, recordings: Sequence[Recording], start_indices: StartIndices) -> Memory:
    """Return the expert's memory before each of `start_indices`, NumPy arrays with one row per start.

    The expert drives over the recorded states again, which reproduces its memory unless sensors have errors.
    """
    indices, rows = np.unique(start_indices[:, 0], return_inverse=True)
    started = [recordings[index] for index in indices]
    memory = map_leaves(lambda *values: np.stack(values), *(recording.initial_memory for recording in started))
    start_memory = map_leaves(lambda values: np.empty((len(start_indices), *values.shape[1:])), memory)
    if not start_memory:
        return start_memory
    last_step = int(start_indices[:, 1].max())
    steps = [np.arange(last_step).clip(0, len(recording.applied_acceleration)) for recording in started]
    states = [recording.states.select(step_indices) for recording, step_indices in zip(started, steps, strict=True)]
    order = np.argsort(start_indices[:, 1], kind="stable")
    bounds = np.searchsorted(start_indices[order, 1], np.arange(last_step + 2))

    def store(step: int, memory: Memory) -> None:
        starts = order[bounds[step] : bounds[step + 1]]
        if len(starts):
            map_leaves(lambda target, values: target.__setitem__(starts, values[rows[starts]]), start_memory, memory)

    store(0, memory)
    world = RecordedWorld(states[0].map(lambda *values: np.stack(values, 1), *states[1:]), Limits(-inf, inf))
    for step, decision in enumerate(DriveLoop(world, expert, memory=memory), start=1):
        store(step, decision.memory if decision else memory)
    return start_memory
