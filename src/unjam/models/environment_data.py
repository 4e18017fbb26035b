"""D_a, the actual data: what the virtual environment learns from, and where its rollouts begin."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from math import inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.command import Limits
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.errors import InputError
from unjam.physics.arrays import Array
from unjam.scenarios.scenario import Scenario
from unjam.tree import Arrays, map_leaves, pack, unpack
from unjam.worlds.drive import DriveLoop
from unjam.worlds.record import Episode, Floats, Trajectory
from unjam.worlds.world import RecordedWorld

GOLDEN_RATIO = (5**0.5 - 1) / 2
"""multiples of it, modulo 1, cover the unit interval evenly from the first on, and have no period"""


@dataclass(frozen=True)
class Recording(Trajectory):
    """A trajectory that is kept, with where it comes from."""

    drawn_values: Floats = field(default_factory=lambda: np.zeros(0))
    """what its episode has drawn, scaled, shape (m,)"""
    episode: int = 0
    """number of the episode that it comes from"""


class Transitions(NamedTuple):
    """Decisions of many trajectories, one behind the other; R rows."""

    states: LocalState
    """shape (R,)"""
    acceleration: Floats
    """[m/s2], shape (R,)"""
    drawn_values: Floats
    """shape (R, m)"""
    next_states: LocalState
    """the next states, shape (R,)"""
    reward: Floats
    """shape (R,)"""
    crashed: NDArray[np.bool_]
    """whether the decision ended in a collision, shape (R,)"""
    is_holdout: NDArray[np.bool_]
    """rows that no network learns from, shape (R,)"""

    def select(self, rows: NDArray[np.int64]) -> "Transitions":
        """Return the decisions with these indices."""
        states, following = (each.select(rows) for each in (self.states, self.next_states))
        others = (self.reward[rows], self.crashed[rows], self.is_holdout[rows])
        return Transitions(states, self.acceleration[rows], self.drawn_values[rows], following, *others)


class EnvironmentData:
    """The newest trajectories: at least `rows` decisions of whole episodes, once there are as many."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.recordings: list[Recording] = []
        """oldest first"""
        self.episode_count = 0
        """how many were ever added"""

    def __len__(self) -> int:
        """Return how many decisions are kept."""
        return sum(len(recording.reward) for recording in self.recordings)

    def add(self, episodes: Sequence[Episode], scenario: Scenario) -> None:
        """Keep the trajectories of `episodes`, and forget the oldest episodes beyond the size."""
        for episode in episodes:
            drawn = np.array(scenario.scale_drawn_values(episode.drawn_values)) if episode.has_run else np.zeros(0)
            for each in episode.trajectories:
                kept = {part.name: getattr(each, part.name) for part in fields(Trajectory)}
                self.recordings.append(Recording(**kept, drawn_values=drawn, episode=self.episode_count))
            self.episode_count += 1
        while self.recordings:
            oldest = self.recordings[0].episode
            newer = [recording for recording in self.recordings if recording.episode != oldest]
            if sum(len(recording.reward) for recording in newer) < self.capacity:
                break
            self.recordings = newer

    def transitions(self, holdout: float) -> Transitions:
        """Return all decisions, a share `holdout` of the episodes held out.

        Raises:
            InputError: there are no decisions yet.
        """
        if not len(self):
            raise InputError("virtual environment: there are no actual decisions to learn from")
        recordings = self.recordings
        return Transitions(
            states=_concatenate_states([r.states.select(slice(-1)) for r in recordings]),
            acceleration=np.concatenate([r.applied_acceleration for r in recordings]),
            drawn_values=np.concatenate([np.tile(r.drawn_values, (len(r.reward), 1)) for r in recordings]),
            next_states=_concatenate_states([r.states.select(slice(1, None)) for r in recordings]),
            reward=np.concatenate([r.reward for r in recordings]),
            crashed=np.concatenate([_crash_flags(r) for r in recordings]),
            is_holdout=np.concatenate(self.holdout_masks(holdout)),
        )

    def holdout_masks(self, holdout: float) -> list[NDArray[np.bool_]]:
        """Return for each recording which of its decisions no network learns from.

        An episode that is held out stays so in every fit. Where that leaves nothing on one side, it is the
        last part of every trajectory instead.
        """
        held_out = [np.full(len(r.reward), is_holdout_episode(r.episode, holdout)) for r in self.recordings]
        if np.concatenate(held_out).all() or not np.concatenate(held_out).any():
            lengths = [len(recording.reward) for recording in self.recordings]
            return [np.arange(length) >= max(1, (1 - holdout) * length) for length in lengths]
        return held_out

    def start_indices(self, min_control_steps: int = 1, first_episode: int = 0) -> NDArray[np.int64]:
        """Return where a residual was due and at least `ahead` decisions follow, rows (recording, decision).

        Only of the episodes from number `since` on.
        """
        due = {
            place: np.arange(0, len(recording.reward) - min_control_steps + 1, recording.action_repeat)
            for place, recording in enumerate(self.recordings)
            if recording.episode >= first_episode
        }
        places = np.repeat(np.array(list(due), np.int64), [len(decisions) for decisions in due.values()])
        return np.column_stack([places, np.concatenate([[], *due.values()]).astype(np.int64)])

    def states_at(self, start_indices: NDArray[np.int64]) -> LocalState:
        """Return the states at `choices`, rows (recording, decision), arrays of shape (rows,)."""
        first = np.cumsum([0, *(len(recording.states.speed) for recording in self.recordings)])
        rows = first[start_indices[:, 0]] + start_indices[:, 1]
        return _concatenate_states([recording.states for recording in self.recordings]).select(rows)


def is_holdout_episode(episode: Array, holdout: float) -> Array:
    """Return whether the networks may not learn from episodes; about `share` of them, evenly spread."""
    return (episode * GOLDEN_RATIO) % 1.0 < holdout


def _crash_flags(recording: Recording) -> NDArray[np.bool_]:
    crashed = np.zeros(len(recording.reward), bool)
    crashed[-1:] = recording.terminated
    return crashed


def _concatenate_states(parts: Sequence[LocalState]) -> LocalState:
    first, *others = parts
    return first.map(lambda *values: np.concatenate(values), *others)


def reconstruct_memory(expert: Driver, recordings: Sequence[Recording], start_indices: NDArray[np.int64]) -> Memory:
    """Return what the expert remembered before each of the decisions `choices`, rows (recording, decision).

    It is driven once more over the recorded states, from the memory with which the recording began: that is
    exact for every driver, since a driver's memory depends on what it has seen alone. Where sensors err,
    it is what exact ones would have left: what was misread is not recorded.

    Returns:
        NumPy arrays with a row for each choice.
    """
    places, rows = np.unique(start_indices[:, 0], return_inverse=True)
    used = [recordings[place] for place in places]
    memory = map_leaves(lambda *each: np.stack(each), *(recording.initial_memory for recording in used))
    found = map_leaves(lambda values: np.empty((len(start_indices), *values.shape[1:])), memory)
    if not found:
        return found
    last = int(start_indices[:, 1].max())
    steps = [np.arange(last).clip(0, len(recording.applied_acceleration)) for recording in used]
    states = [kept.states.select(at) for kept, at in zip(used, steps, strict=True)]
    order = np.argsort(start_indices[:, 1], kind="stable")
    bounds = np.searchsorted(start_indices[order, 1], np.arange(last + 2))

    def store(index: int, memory: Memory) -> None:
        here = order[bounds[index] : bounds[index + 1]]
        if len(here):
            map_leaves(lambda into, values: into.__setitem__(here, values[rows[here]]), found, memory)

    store(0, memory)
    world = RecordedWorld(states[0].map(lambda *each: np.stack(each, 1), *states[1:]), Limits(-inf, inf))
    for decision, done in enumerate(DriveLoop(world, expert, memory=memory), start=1):
        store(decision, done.memory if done else memory)
    return found


def pack_data(data: EnvironmentData) -> tuple[dict[str, Any], Arrays]:
    """Return the actual data as JSON and arrays; `unpack_data` undoes it exactly."""
    recordings, arrays = pack(data.recordings)
    return {"capacity": data.capacity, "episode_count": data.episode_count, "recordings": recordings}, arrays


def unpack_data(facts: dict[str, Any], arrays: Arrays) -> EnvironmentData:
    """Return the actual data that `pack_data` packed."""
    data = EnvironmentData(facts["capacity"])
    data.episode_count = facts["episode_count"]
    data.recordings = unpack(list[Recording], facts["recordings"], arrays)
    return data
