"""D_a, the actual data: what the virtual environment learns from, and where its rollouts begin."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.local_state import LocalState
from unjam.errors import InputError
from unjam.scenarios.scenario import Scenario
from unjam.worlds.record import Episode, Floats

GOLDEN_RATIO = (5**0.5 - 1) / 2
"""multiples of it, modulo 1, cover the unit interval evenly from the first on, and have no period"""


@dataclass(frozen=True)
class Recording:
    """What is kept of one trajectory; T decisions."""

    states: LocalState
    """shape (T + 1,)"""
    applied: Floats
    """[m/s2], shape (T,)"""
    reward: Floats
    """shape (T,)"""
    memory: dict[str, Floats]
    """what the expert remembered before the first decision, without the axis of rows"""
    hold: int
    """decisions for which one residual was held"""
    terminated: bool
    """whether a collision ended it"""
    drawn: Floats
    """what its episode has drawn, scaled, shape (m,)"""
    episode: int
    """number of the episode that it comes from"""


class Transitions(NamedTuple):
    """Decisions of many trajectories, one behind the other; R rows."""

    states: LocalState
    """shape (R,)"""
    applied: Floats
    """[m/s2], shape (R,)"""
    drawn: Floats
    """shape (R, m)"""
    following: LocalState
    """the next states, shape (R,)"""
    reward: Floats
    """shape (R,)"""
    crashed: NDArray[np.bool_]
    """whether the decision ended in a collision, shape (R,)"""
    held_out: NDArray[np.bool_]
    """rows that no network learns from, shape (R,)"""

    def chosen(self, rows: NDArray[np.int64]) -> "Transitions":
        """Return the decisions with these indices."""
        return Transitions(
            states=LocalState(*(values[rows] for values in self.states)),
            applied=self.applied[rows],
            drawn=self.drawn[rows],
            following=LocalState(*(values[rows] for values in self.following)),
            reward=self.reward[rows],
            crashed=self.crashed[rows],
            held_out=self.held_out[rows],
        )


class ActualData:
    """The newest trajectories: at least `rows` decisions of whole episodes, once there are as many."""

    def __init__(self, rows: int) -> None:
        self.rows = rows
        self.recordings: list[Recording] = []
        """oldest first"""
        self.episodes = 0
        """how many were ever added"""

    def __len__(self) -> int:
        """Return how many decisions are kept."""
        return sum(len(recording.reward) for recording in self.recordings)

    def add(self, episodes: Sequence[Episode], scenario: Scenario) -> None:
        """Keep the trajectories of `episodes`, and forget the oldest episodes beyond the size."""
        for episode in episodes:
            drawn = np.array(scenario.drawn_scaled(episode.drawn)) if episode.ok else np.zeros(0)
            self.recordings += [
                Recording(
                    states=trajectory.states,
                    applied=trajectory.applied,
                    reward=trajectory.reward,
                    memory=trajectory.memory,
                    hold=trajectory.hold,
                    terminated=trajectory.terminated,
                    drawn=drawn,
                    episode=self.episodes,
                )
                for trajectory in episode.trajectories
            ]
            self.episodes += 1
        while self.recordings:
            oldest = self.recordings[0].episode
            newer = [recording for recording in self.recordings if recording.episode != oldest]
            if sum(len(recording.reward) for recording in newer) < self.rows:
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
            states=_joined([_between(r.states, 0, -1) for r in recordings]),
            applied=np.concatenate([r.applied for r in recordings]),
            drawn=np.concatenate([np.tile(r.drawn, (len(r.reward), 1)) for r in recordings]),
            following=_joined([_between(r.states, 1, None) for r in recordings]),
            reward=np.concatenate([r.reward for r in recordings]),
            crashed=np.concatenate([_crashes(r) for r in recordings]),
            held_out=np.concatenate(self.held_out(holdout)),
        )

    def held_out(self, holdout: float) -> list[NDArray[np.bool_]]:
        """Return for each recording which of its decisions no network learns from.

        An episode that is held out stays so in every fit. Where that leaves nothing on one side, it is the
        last part of every trajectory instead.
        """
        held_out = [np.full(len(r.reward), is_held_out(r.episode, holdout)) for r in self.recordings]
        if np.concatenate(held_out).all() or not np.concatenate(held_out).any():
            lengths = [len(recording.reward) for recording in self.recordings]
            return [np.arange(length) >= max(1, (1 - holdout) * length) for length in lengths]
        return held_out

    def looks(self, ahead: int = 1) -> NDArray[np.int64]:
        """Return where a residual was due and at least `ahead` decisions follow.

        Rows (recording, decision).
        """
        due = [np.arange(0, len(r.reward) - ahead + 1, r.hold) for r in self.recordings]
        places = np.repeat(np.arange(len(due)), [len(decisions) for decisions in due])
        return np.column_stack([places, np.concatenate([[], *due]).astype(np.int64)])

    def states_at(self, looks: NDArray[np.int64]) -> LocalState:
        """Return the states at `looks`, rows (recording, decision), arrays of shape (rows,)."""
        found = LocalState(*(np.empty(len(looks)) for _ in LocalState._fields))
        for place in np.unique(looks[:, 0]):
            rows = np.flatnonzero(looks[:, 0] == place)
            for into, values in zip(found, self.recordings[place].states, strict=True):
                into[rows] = values[looks[rows, 1]]
        return found


def is_held_out(episode: int, share: float) -> bool:
    """Return whether the networks may not learn from this episode; about `share` of them, evenly spread."""
    return (episode * GOLDEN_RATIO) % 1.0 < share


def _crashes(recording: Recording) -> NDArray[np.bool_]:
    crashed = np.zeros(len(recording.reward), bool)
    crashed[-1:] = recording.terminated
    return crashed


def _between(states: LocalState, start: int, end: int | None) -> LocalState:
    return LocalState(*(values[start:end] for values in states))


def _joined(parts: Sequence[LocalState]) -> LocalState:
    return LocalState(*(np.concatenate(values) for values in zip(*parts, strict=True)))


_RECORDING_ARRAYS = ("applied", "reward", "drawn")


def pack_data(data: ActualData) -> tuple[dict[str, Any], dict[str, Floats]]:
    """Return the actual data as JSON and arrays; `unpack_data` undoes it exactly."""
    arrays: dict[str, Floats] = {}
    about = []
    for index, recording in enumerate(data.recordings):
        arrays |= {f"{index}.{name}": getattr(recording, name) for name in _RECORDING_ARRAYS}
        arrays |= {f"{index}.states.{name}": array for name, array in recording.states._asdict().items()}
        arrays |= {f"{index}.memory.{name}": array for name, array in recording.memory.items()}
        about.append({name: getattr(recording, name) for name in ("hold", "terminated", "episode")})
        about[-1]["memory"] = list(recording.memory)
    return {"rows": data.rows, "episodes": data.episodes, "recordings": about}, arrays


def unpack_data(facts: dict[str, Any], arrays: dict[str, Floats]) -> ActualData:
    """Return the actual data that `pack_data` packed."""
    data = ActualData(facts["rows"])
    data.episodes = facts["episodes"]
    data.recordings = [
        Recording(
            **{name: arrays[f"{index}.{name}"] for name in _RECORDING_ARRAYS},
            states=LocalState(*(arrays[f"{index}.states.{name}"] for name in LocalState._fields)),
            **{**about, "memory": {name: arrays[f"{index}.memory.{name}"] for name in about["memory"]}},
        )
        for index, about in enumerate(facts["recordings"])
    ]
    return data
