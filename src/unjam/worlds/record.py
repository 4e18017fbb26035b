"""What happened in an episode, and how it travels between processes."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from heapq import heappop, heappush
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.local_state import LocalState
from unjam.physics.arrays import Floats
from unjam.worlds.audit import Audit
from unjam.worlds.trips import Trips
from unjam.worlds.world import DriverLog

SHARED_COLUMN_FRAMES = 200
"""an episode in so many frames has an empty one between two vehicles that share a column: else it would look
as if one flew back"""


@dataclass(frozen=True)
class Trajectory:
    """One stay of one CAV on the road; T decisions. Arrays of shape (T,) where nothing else is said."""

    vehicle: str
    start_step: int
    """decision of the episode at which it began"""
    states: LocalState
    """what it perceived, shape (T + 1,): the last entry is where it ended"""
    observations: Floats
    """what the residual network saw at each of its choices, and at the end, shape (choices + 1, inputs); it
    chooses every `hold` decisions; (1, 0) without a network"""
    expert_acceleration: Floats
    """the expert's acceleration within the action limit [m/s2]"""
    residual: Floats
    """the network's residual with its exploration noise, not clipped [m/s2]; zero without one"""
    applied_acceleration: Floats
    """the acceleration that was commanded, within the action limit, or harder braking where the safety filter
    demanded it; the mean over the decision [m/s2]"""
    filter_braking: Floats
    """the most that the safety filter took from what the driver wanted [m/s2]; zero where it let it pass"""
    shield_braking: Floats
    """braking that SUMO's safety check added to the command [m/s2]; zero where it let it pass"""
    initial_memory: dict[str, Any]
    """what the expert remembered before the first decision, without the axis of rows; empty without a
    network"""
    action_repeat: int
    """decisions for which one residual was held"""
    terminated: bool
    """whether a collision ended it; otherwise it was cut by the horizon or by leaving the road"""
    reward_terms: dict[str, Floats] = field(default_factory=dict)
    """terms of the reward by name"""

    @property
    def step_slice(self) -> slice:
        """Its decisions among those of the episode."""
        return slice(self.start_step, self.start_step + len(self.applied_acceleration))

    @cached_property
    def reward(self) -> Floats:
        """What each decision earned: the sum of the terms."""
        return np.sum(list(self.reward_terms.values()), axis=0)

    @property
    def actions_and_rewards(self) -> tuple[Floats, Floats]:
        """The residuals that the network chose, and what was earned while each was held; shape (choices,)."""
        starts = np.arange(0, len(self.residual), self.action_repeat)
        return self.residual[starts], np.add.reduceat(self.reward, starts)


def make_trajectory(
    vehicle: str,
    entry_number: int,
    start_step: int,
    rows: NDArray[np.intp] | None,
    states: LocalState,
    applied_acceleration: Floats,
    filter_braking: Floats,
    shield_braking: Floats,
    terminated: bool,
    driver_log: DriverLog,
) -> Trajectory:
    """Return the trajectory of a stay, with what the driver decided; arrays as `Trajectory` has them.

    Args:
        vehicle: its name.
        number: it was the so many-th CAV to enter, from 0.
        start: decision of the episode at which it began.
        rows: its row among the CAVs at each moment, shape (T + 1,); None: decisions are plain numbers.
        states: what it perceived.
        applied: its commands; of humans what they did.
        filtered: most that the safety filter took from each.
        shield: hardest braking that was added to each command.
        terminated: whether a collision ended it.
        driven: all that the driver decided.
    """
    about = (vehicle, start_step, states)
    if not driver_log.decisions:
        nothing = np.zeros((1, 0)), applied_acceleration, np.zeros_like(applied_acceleration)
        return Trajectory(*about, *nothing, applied_acceleration, filter_braking, shield_braking, {}, 1, terminated)

    def select(values: Sequence[Any], steps: Sequence[int]) -> Floats:
        """Return this CAV's of all values at some steps."""
        return np.array([values[step] if rows is None else values[step][rows[step - start_step]] for step in steps])

    experts, residuals, seen = zip(*driver_log.decisions, strict=True)
    steps = range(start_step, start_step + len(applied_acceleration))
    choices = [*steps[:: driver_log.action_repeat], steps.stop]
    looks = [*seen, driver_log.last_observation]
    if np.size(looks[steps.stop]) == 0:  # it crashed while others drove on, between two looks of the network
        choices[-1] = choices[-2]
    observations = select(looks, choices).astype(np.float64).reshape(len(choices), -1)
    decided = observations, select(experts, steps), select(residuals, steps)
    commanded = applied_acceleration, filter_braking, shield_braking
    return Trajectory(
        *about, *decided, *commanded, driver_log.initial_memories[entry_number], driver_log.action_repeat, terminated
    )


@dataclass(frozen=True)
class SumoWarning:
    """What SUMO warned of in an episode: one kind of message."""

    kind: str
    """the message with placeholders for names and numbers"""
    example: str
    """the first message of this kind"""
    count: int


@dataclass(frozen=True)
class Episode:
    """What happened in one episode; T decisions, N vehicles. The warm-up is not part of it."""

    seed: tuple[int, ...]
    status: str
    """`completed`; `failed_episodes`; `collision`, or `teleports` beyond SUMO's max-num-teleports, ended it early"""
    reason: str = ""
    """why it failed or ended early"""
    error: str = ""
    """name of the error that made it fail"""
    control_step: float = 0.1
    """time between two decisions [s]"""
    warmup: int = 0
    """simulation steps before the first decision"""
    drawn_values: dict[str, float] = field(default_factory=dict)
    """what the seed has drawn, by name"""
    loop_length: float = float("nan")
    """of a closed road [m]; NaN of one with ends"""
    crossings: tuple[tuple[float, float], ...] = ()
    """where along the road it crosses itself [m]"""
    limit_speed: float = float("nan")
    """the scenario's own limit of speed [m/s]"""
    vehicle_ids: tuple[str, ...] = ()
    cav_ids: tuple[str, ...] = ()
    vehicle_columns: tuple[int, ...] = ()
    """which of N columns each vehicle has, where those that are never there together share one: with an empty
    moment between two, and CAVs with CAVs alone; empty: each vehicle its own, in order"""
    snapshot_stride: int = 1
    """where vehicles are is kept of every so many-th moment: not of all where many drive for long"""
    collisions: int = 0
    """vehicles that collided: on a built-in road by contact, on a user's network as its settings say"""
    contacts: int = 0
    """CAVs that were in contact with another vehicle on a user's network; on other roads contact ends it"""
    speeds: Floats = field(default_factory=lambda: np.zeros((1, 0)))
    """[m/s], shape (T + 1, N); NaN where a vehicle is not on the road"""
    positions: Floats = field(default_factory=lambda: np.zeros((1, 0)))
    """front bumpers along the route, not wrapped [m], shape (T // every + 1, N)"""
    gaps: Floats = field(default_factory=lambda: np.zeros((1, 0)))
    """bumper to bumper to the vehicle ahead [m], shape (T // every + 1, N)"""
    fuel: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """fuel rate in each step [mg/s], shape (T, N), of a road with ends of all together, (T,); (0, 0) where it
    was not recorded"""
    outline: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """a closed road's centre line: rows (coordinate along the route, x, y) [m]"""
    branches: tuple[str, ...] = ()
    """where the vehicles of each column came from, on a road with several ways in"""
    arrivals: int = 0
    """vehicles that left at the end of their route"""
    teleports: int = 0
    """times that SUMO took a vehicle that had stood for long or collided off the road; until it is put back
    it waits"""
    demand_peak: tuple[float, float] = (0.0, 0.0)
    """from when to when the most vehicles want to enter [s]; (0, 0) where there is no peak"""
    planned_duration: float = float("nan")
    """how long a road with ends was to be driven [s], were nobody to touch; NaN of a closed one"""
    free_flow_time: float = float("nan")
    """mean travel time where nobody disturbs anybody [s]; NaN where it is not known"""
    backlog: Floats = field(default_factory=lambda: np.zeros(0))
    """vehicles that wanted to enter and could not, or were lifted off the road, at each moment, shape
    (T + 1,); (0,) of a closed road"""
    teleported: int = 0
    """of those that wait at the end, how many were lifted off the road and not put back"""
    lane_lines: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    """lanes of a road with ends: rows (x, y) [m], a row of NaN between two; (0, 2) where not recorded"""
    poses: Floats = field(default_factory=lambda: np.zeros((0, 0, 3)))
    """(x, y, heading) of front bumpers on a road with ends [m, rad], shape (T // every + 1, N, 3); no rows
    where not recorded"""
    lane_indices: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """which of `lane_names` each vehicle is in, shape (T // every + 1, N), NaN where in none of them; (0, 0)
    where not recorded"""
    lane_names: tuple[str, ...] = ()
    """of a road with lanes, from left to right as one drives"""
    reward_terms: dict[str, Floats] = field(default_factory=dict)
    """terms of the reward by name, shape (T,)"""
    trajectories: tuple[Trajectory, ...] = ()
    trips: Trips = field(default_factory=Trips)
    """of all vehicles, on a network of the user's own; empty elsewhere"""
    audit: Audit = field(default_factory=Audit)
    warnings: tuple[SumoWarning, ...] = ()
    """what SUMO warned of, the warm-up included; teleports, collisions and braking are counted elsewhere"""

    @property
    def reward(self) -> Floats:
        """What each decision earned, shape (T,): the sum of the terms."""
        return np.sum(list(self.reward_terms.values()), axis=0)

    @property
    def control_steps(self) -> int:
        """How many decisions were made: the episode's actual steps."""
        return len(self.speeds) - 1

    @property
    def cav_columns(self) -> list[int]:
        """Columns of the CAVs, in order of entry."""
        columns = self.vehicle_columns or range(len(self.vehicle_ids))
        column = dict(zip(self.vehicle_ids, columns, strict=True))
        return list(dict.fromkeys(column[name] for name in self.cav_ids))

    @property
    def has_run(self) -> bool:
        """Whether the episode ran, also where it ended early."""
        return self.status != "failed"


def assign_columns(
    first_moments: NDArray[np.intp], last_moments: NDArray[np.intp], groups: Sequence[Hashable], min_spacing: int = 1
) -> NDArray[np.intp]:
    """Return a column for each of n stays, with at least `apart` empty moments between two in the same one.

    `first` and `last` are the moments of each, both included; only stays of the same group share one.
    """
    columns, used = np.zeros(len(groups), np.intp), 0
    busy: dict[Hashable, list[tuple[int, int]]] = {}
    """of each group a heap: until which moment, which column"""
    for stay in np.argsort(first_moments, kind="stable").tolist():
        waiting = busy.setdefault(groups[stay], [])
        if waiting and waiting[0][0] + min_spacing < first_moments[stay]:
            _, column = heappop(waiting)
        else:
            column, used = used, used + 1
        columns[stay] = column
        heappush(waiting, (int(last_moments[stay]), column))
    return columns


def failed_episode(seed: tuple[int, ...], reason: str, error: str) -> Episode:
    """Return the row of an episode that did not run: every requested episode has one."""
    return Episode(seed=seed, status="failed", reason=reason, error=error)
