"""What happened in an episode, and how it travels between processes."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.local_state import LocalState
from unjam.worlds.reward import Outcome, time_headway

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Trajectory:
    """One stay of one CAV on the road; T decisions. Arrays of shape (T,) where nothing else is said."""

    vehicle: str
    start: int
    """decision of the episode at which it began"""
    states: LocalState
    """what it perceived, shape (T + 1,): the last entry is where it ended"""
    observations: Floats
    """what the residual network saw at each of its looks, and at the end, shape (looks + 1, inputs); it
    looks every `hold` decisions; (1, 0) without a network"""
    expert: Floats
    """the expert's acceleration within the action limit [m/s2]"""
    residual: Floats
    """the network's residual with its exploration noise, not clipped [m/s2]; zero without one"""
    applied: Floats
    """the acceleration that was commanded, within the action limit [m/s2]"""
    shield: Floats
    """braking that SUMO's safety check added to the command [m/s2]; zero where it let it pass"""
    terms: dict[str, Floats]
    """terms of the reward by name"""
    memory: dict[str, Floats]
    """what the expert remembered before the first decision, without the axis of rows; empty without a
    network"""
    hold: int
    """decisions for which one residual was held"""
    terminated: bool
    """whether a collision ended it; otherwise it was cut by the horizon or by leaving the road"""

    @property
    def reward(self) -> Floats:
        """What each decision earned: the sum of the terms."""
        return np.sum(list(self.terms.values()), axis=0)

    @property
    def looks(self) -> tuple[Floats, Floats]:
        """The residuals that the network chose, and what was earned while each was held; shape (looks,)."""
        starts = np.arange(0, len(self.residual), self.hold)
        return self.residual[starts], np.add.reduceat(self.reward, starts)


@dataclass(frozen=True)
class Episode:
    """What happened in one episode; T decisions, N vehicles. The warm-up is not part of it."""

    seed: tuple[int, ...]
    status: str
    """`completed`, `collision`, or `failed`"""
    reason: str = ""
    """why it failed"""
    error: str = ""
    """name of the error that made it fail"""
    step: float = 0.1
    """time between two decisions [s]"""
    warmup: int = 0
    """simulation steps before the first decision"""
    drawn: dict[str, float] = field(default_factory=dict)
    """what the seed has drawn, by name"""
    loop_length: float = float("nan")
    """of a closed road [m]; NaN of one with ends"""
    crossings: tuple[tuple[float, float], ...] = ()
    """where along the road it crosses itself [m]"""
    limit_speed: float = float("nan")
    """the scenario's own limit of speed [m/s]"""
    vehicle_ids: tuple[str, ...] = ()
    cav_ids: tuple[str, ...] = ()
    collisions: int = 0
    """vehicles in contact with another when the episode ended"""
    speeds: Floats = field(default_factory=lambda: np.zeros((1, 0)))
    """[m/s], shape (T + 1, N); NaN where a vehicle is not on the road"""
    positions: Floats = field(default_factory=lambda: np.zeros((1, 0)))
    """front bumpers along the route, not wrapped [m], shape (T + 1, N)"""
    gaps: Floats = field(default_factory=lambda: np.zeros((1, 0)))
    """bumper to bumper to the vehicle ahead [m], shape (T + 1, N)"""
    fuel: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """fuel rate in each step [mg/s], shape (T, N); (0, 0) where it was not recorded"""
    outline: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """a closed road's centre line: rows (coordinate along the route, x, y) [m]"""
    branches: tuple[str, ...] = ()
    """where each vehicle of a merging road came from"""
    arrived: int = 0
    """vehicles that left at the end of their route"""
    waiting: Floats = field(default_factory=lambda: np.zeros(0))
    """vehicles that wanted to enter and could not, at each moment, shape (T + 1,); (0,) of a closed road"""
    lines: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    """lanes of a road with ends: rows (x, y) [m], a row of NaN between two; (0, 2) where not recorded"""
    places: Floats = field(default_factory=lambda: np.zeros((0, 0, 3)))
    """(x, y, heading) of front bumpers on a road with ends [m, rad], shape (T + 1, N, 3); no rows where not
    recorded"""
    terms: dict[str, Floats] = field(default_factory=dict)
    """terms of the reward by name, shape (T,)"""
    trajectories: tuple[Trajectory, ...] = ()

    @property
    def reward(self) -> Floats:
        """What each decision earned, shape (T,): the sum of the terms."""
        return np.sum(list(self.terms.values()), axis=0)

    @property
    def steps(self) -> int:
        """How many decisions were made: the episode's actual steps."""
        return len(self.speeds) - 1

    @property
    def ok(self) -> bool:
        """Whether the episode ran to its end, be it a collision."""
        return self.status != "failed"


def failed_episode(seed: tuple[int, ...], reason: str, error: str) -> Episode:
    """Return the row of an episode that did not run: every requested episode has one."""
    return Episode(seed=seed, status="failed", reason=reason, error=error)


def outcome_of(speeds: Floats, stays: Sequence[Any], crashed: bool) -> Outcome:
    """Return what a reward function sees of a whole episode.

    Args:
        speeds: of all vehicles, shape (T + 1, N).
        stays: of CAVs: each with its first decision, states and commands; or trajectories.
        crashed: whether the last decision ended in a collision.
    """
    steps = len(speeds) - 1
    accelerations, headways = (np.full((steps, len(stays)), np.nan) for _ in range(2))
    for column, stay in enumerate(stays):
        during = slice(stay.start, stay.start + len(stay.applied))
        accelerations[during, column] = stay.applied
        headways[during, column] = time_headway(stay.states.leader_gap[1:], stay.states.speed[1:])
    collided = np.zeros(steps, bool)
    collided[-1:] = crashed
    return Outcome(speeds[1:], accelerations, headways, collided)


_ARRAYS = ("speeds", "positions", "gaps", "fuel", "outline", "waiting", "lines", "places")
_TRAJECTORY_ARRAYS = ("observations", "expert", "residual", "applied", "shield")


def pack_episode(episode: Episode) -> tuple[dict[str, Any], dict[str, Floats]]:
    """Return an episode as JSON and arrays; `unpack_episode` undoes it exactly."""
    arrays = {name: getattr(episode, name) for name in _ARRAYS}
    facts: dict[str, Any] = {
        field.name: getattr(episode, field.name)
        for field in fields(Episode)
        if field.name not in (*_ARRAYS, "terms", "trajectories")
    }
    arrays |= {f"terms.{name}": array for name, array in episode.terms.items()}
    facts["terms"] = list(episode.terms)
    facts["trajectories"] = []
    for index, trajectory in enumerate(episode.trajectories):
        arrays |= {f"{index}.{name}": getattr(trajectory, name) for name in _TRAJECTORY_ARRAYS}
        arrays |= {f"{index}.states.{name}": array for name, array in trajectory.states._asdict().items()}
        arrays |= {f"{index}.terms.{name}": array for name, array in trajectory.terms.items()}
        arrays |= {f"{index}.memory.{name}": array for name, array in trajectory.memory.items()}
        facts["trajectories"].append(
            {
                "vehicle": trajectory.vehicle,
                "start": trajectory.start,
                "terminated": trajectory.terminated,
                "hold": trajectory.hold,
                "terms": list(trajectory.terms),
                "memory": list(trajectory.memory),
            }
        )
    return facts, arrays


def unpack_episode(facts: dict[str, Any], arrays: dict[str, Floats]) -> Episode:
    """Return the episode that `pack_episode` packed."""
    trajectories = []
    for index, about in enumerate(facts["trajectories"]):
        trajectories.append(
            Trajectory(
                vehicle=about["vehicle"],
                start=about["start"],
                terminated=about["terminated"],
                hold=about["hold"],
                states=LocalState(*(arrays[f"{index}.states.{name}"] for name in LocalState._fields)),
                terms={name: arrays[f"{index}.terms.{name}"] for name in about["terms"]},
                memory={name: arrays[f"{index}.memory.{name}"] for name in about["memory"]},
                **{name: arrays[f"{index}.{name}"] for name in _TRAJECTORY_ARRAYS},
            )
        )
    values: dict[str, Any] = {**facts, **{name: arrays[name] for name in _ARRAYS}}
    values["terms"] = {name: arrays[f"terms.{name}"] for name in facts["terms"]}
    for name in ("seed", "vehicle_ids", "cav_ids", "branches"):
        values[name] = tuple(values[name])
    values["crossings"] = tuple((start, end) for start, end in values["crossings"])
    values["trajectories"] = tuple(trajectories)
    return Episode(**values)
