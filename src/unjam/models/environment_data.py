"""Environment data (D_a in the paper): models are fitted to them, and rollouts start from their states."""

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
"""golden ratio; the fractional parts of its multiples cover the unit interval evenly, for any number of them"""


@dataclass(frozen=True)
class Recording(Trajectory):
    """A stored trajectory, with the number of its episode and the scaled values that it drew, shape (m,)."""

    drawn_values: Floats = field(default_factory=lambda: np.zeros(0))
    episode: int = 0


class Transitions(NamedTuple):
    """Control steps of many trajectories in a row; R rows, arrays of shape (R,)."""

    states: LocalState
    acceleration: Floats
    """commanded, after the filter [m/s2]"""
    response: Floats
    """acceleration in the step, which follows the commands with delay and lag [m/s2]"""
    drawn_values: Floats
    """scaled values that the episode drew, shape (R, m)"""
    next_states: LocalState
    reward: Floats
    crashed: NDArray[np.bool_]
    is_holdout: NDArray[np.bool_]

    def select(self, rows: NDArray[np.int64]) -> "Transitions":
        """Return the transitions with these indices."""
        return Transitions._make(part.select(rows) if isinstance(part, LocalState) else part[rows] for part in self)


@dataclass
class EnvironmentData:
    """The trajectories of the newest episodes; old ones are dropped as long as `capacity` control steps remain."""

    capacity: int
    actuator: Actuator = INSTANT_ACTUATOR
    control_step: float = 0.1
    """used with an actuator that is not instant [s]"""
    recordings: list[Recording] = field(default_factory=list)
    """stored trajectories, the oldest first"""
    episode_count: int = 0
    """number of episodes that were added, including dropped ones"""

    def __len__(self) -> int:
        return sum(len(recording.reward) for recording in self.recordings)

    def add(self, episodes: Sequence[Episode], scenario: Scenario) -> None:
        """Store the trajectories of `episodes`, and drop the oldest episodes beyond the capacity."""
        for episode in episodes:
            drawn_values = (
                np.array(scenario.scale_drawn_values(episode.drawn_values)) if episode.has_run else np.zeros(0)
            )
            for trajectory in episode.trajectories:
                values = {part.name: getattr(trajectory, part.name) for part in fields(Trajectory)}
                self.recordings.append(Recording(**values, drawn_values=drawn_values, episode=self.episode_count))
            self.episode_count += 1
        while self.recordings:
            oldest = self.recordings[0].episode
            newer = [recording for recording in self.recordings if recording.episode != oldest]
            if sum(len(recording.reward) for recording in newer) < self.capacity:
                break
            self.recordings = newer

    def transitions(self, holdout: float) -> Transitions:
        """Return all control steps, with a share `holdout` of the episodes held out; `InputError` if there are none."""
        if not len(self):
            raise InputError("model: there are no environment steps to fit it to")

        def concatenate(values: Callable[[Recording], Any]) -> Any:
            return np.concatenate([values(recording) for recording in self.recordings])

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
        """Return which steps of each recording are held out, an array of booleans for each.

        These are whole episodes, always the same ones; if they were all or none, the last part of each recording.
        """
        masks = [np.full(len(r.reward), is_holdout_episode(r.episode, holdout)) for r in self.recordings]
        if np.concatenate(masks).all() or not np.concatenate(masks).any():
            return [np.arange(len(mask)) >= max(1, (1 - holdout) * len(mask)) for mask in masks]
        return masks

    def start_indices(self, min_control_steps: int = 1, first_episode: int = 0) -> StartIndices:
        """Return the steps with a new residual and enough steps after them, of episodes from the first on."""
        new = [
            (index, recording) for index, recording in enumerate(self.recordings) if recording.episode >= first_episode
        ]
        due = {
            index: np.arange(0, len(recording.reward) - min_control_steps + 1, recording.action_repeat)
            for index, recording in new
        }
        indices = np.repeat(np.array(list(due), np.int64), [len(steps) for steps in due.values()])
        return np.column_stack([indices, np.concatenate([[], *due.values()]).astype(np.int64)])

    def states_at(self, start_indices: StartIndices) -> LocalState:
        """Return the states at `start_indices`, arrays of shape (n,)."""
        first = np.cumsum([0, *(len(recording.states.speed) for recording in self.recordings)])
        rows = first[start_indices[:, 0]] + start_indices[:, 1]
        return _concatenate_states([recording.states for recording in self.recordings]).select(rows)

    def actuator_states_at(self, start_indices: StartIndices) -> ActuatorState:
        """Return the states of the actuators at `start_indices`, arrays of shape (n,); at rest at the beginning."""
        if self.actuator.is_instant:
            return ActuatorState(np.zeros(len(start_indices)))
        starts = [(self.recordings[index], step) for index, step in start_indices]
        pending = [
            np.array([recording.applied_acceleration[at - lag] if at >= lag else 0.0 for recording, at in starts])
            for lag in range(self.actuator.delay_steps(self.control_step), 0, -1)
        ]
        changes = np.array(
            [recording.states.speed[at] - recording.states.speed[max(at - 1, 0)] for recording, at in starts]
        )
        return ActuatorState(changes / self.control_step, tuple(pending))

    def _response(self, recording: Recording) -> Floats:
        if self.actuator.is_instant:
            return recording.applied_acceleration
        return np.diff(recording.states.speed) / self.control_step


def is_holdout_episode(episode: Array, holdout: float) -> Array:
    """Return whether episodes are held out from the training of networks; a share `holdout`, evenly spread."""
    return (episode * GOLDEN_RATIO) % 1.0 < holdout


def _concatenate_states(parts: Sequence[LocalState]) -> LocalState:
    return parts[0].map(lambda *values: np.concatenate(values), *parts[1:])


def reconstruct_memory(expert: Driver, recordings: Sequence[Recording], start_indices: StartIndices) -> Memory:
    """Return the expert's memory before each of `start_indices`, NumPy arrays with one row per start.

    The expert is driven over the recorded states once more, which is exact unless sensors have errors.
    """
    indices, rows = np.unique(start_indices[:, 0], return_inverse=True)
    used = [recordings[index] for index in indices]
    memory = map_leaves(lambda *values: np.stack(values), *(recording.initial_memory for recording in used))
    result = map_leaves(lambda values: np.empty((len(start_indices), *values.shape[1:])), memory)
    if not result:
        return result
    last = int(start_indices[:, 1].max())
    steps = [np.arange(last).clip(0, len(recording.applied_acceleration)) for recording in used]
    states = [recording.states.select(at) for recording, at in zip(used, steps, strict=True)]
    order = np.argsort(start_indices[:, 1], kind="stable")
    bounds = np.searchsorted(start_indices[order, 1], np.arange(last + 2))

    def store(step: int, memory: Memory) -> None:
        starts = order[bounds[step] : bounds[step + 1]]
        if len(starts):
            map_leaves(lambda into, values: into.__setitem__(starts, values[rows[starts]]), result, memory)

    store(0, memory)
    world = RecordedWorld(states[0].map(lambda *values: np.stack(values, 1), *states[1:]), Limits(-inf, inf))
    for step, decision in enumerate(DriveLoop(world, expert, memory=memory), start=1):
        store(step, decision.memory if decision else memory)
    return result
