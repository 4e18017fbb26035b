"""The merge: a highway that a ramp joins, with one lane each, where vehicles come and go."""

from dataclasses import field
from functools import lru_cache
from math import cos, inf, pi
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from unjam.drivers.car_following import _MIN_GAP
from unjam.drivers.safety import SafetyFilter
from unjam.parameters import STRICT, NonNegative, NonNegativeInt, Positive, PositiveInt
from unjam.physics.arrays import clamp_min
from unjam.physics.idm import IDMParameters, idm_acceleration
from unjam.physics.kinematics import next_position, next_speed
from unjam.scenarios.road import Edge, Entry, MergeRoad, Node, Origin, RoadNetwork, Route
from unjam.scenarios.scenario import VEHICLE_LENGTH, HumanControl, Scenario

MERGE_INFLOW_LENGTH, MERGE_HIGHWAY_LENGTH, MERGE_EXIT_LENGTH, MERGE_RAMP_LENGTH = 100.0, 500.0, 100.0, 100.0
"""lengths of the edges on which vehicles enter, of the highway before and after the ramp, of the ramp [m]"""
JUNCTION_RADIUS = 10.0
"""of the node where they meet [m], as Flow's"""
JUNCTION_LENGTHS = (24.525483, 23.270389)
"""lengths of the ways across that node, of highway and ramp, as netconvert makes them from the radius [m]"""
ENTRANCE_LENGTH = 0.1
"""length of the way across the nodes where the inflow edges end, as netconvert makes it [m]"""
HIGHWAY_ENTRY_SPEED, MERGE_RAMP_ENTRY_SPEED = 10.0, 7.5
"""with which vehicles enter [m/s]"""
RAMP_ANGLE = pi / 4
"""angle between ramp and highway [rad]"""
PLATOON_SIZE = 30
"""vehicles after which each drives like the one before it"""
HIGHWAY_BRANCH, RAMP_BRANCH = 0, 1
"""the branches"""


@dataclass(frozen=True, config=STRICT)
class Merge(Scenario):
    """A highway of 700 m that a ramp joins 100 m before its end; some highway vehicles are CAVs.

    At 2,000 + 100 vehicles an hour the road has two lives. From an empty start it flows freely; with a few
    vehicles standing at the start a jam grows before the ramp and stays, and traffic backs up beyond the
    entrance. Every CAV on the road is driven by the same driver, each with a memory of its own, from the
    decision after it entered until it leaves.
    """

    title: ClassVar[str] = "merge"
    reward: ClassVar[str] = "released-merge"
    is_closed: ClassVar[bool] = False
    sumo_human_gap: ClassVar[float] = 2.5

    inflow: Positive = 2000.0
    """vehicles that want to enter the highway [veh/h], evenly spaced in time"""
    ramp_flow: NonNegative = 100.0
    """vehicles that want to enter the ramp [veh/h]"""
    penetration_rate: Annotated[float, Field(ge=0, le=1)] = 0.1
    """share of the highway's vehicles that are CAVs"""
    cav_spacing: Literal["random", "even"] = "random"
    """where in the stream the CAVs are: `random` as the paper; `even`: each tenth vehicle, as Flow"""
    cavs: PositiveInt | None = None
    """exactly so many CAVs instead of a share, among those that want to enter in the first half"""
    standing_vehicles: NonNegativeInt = 5
    """people who stand on the highway at the start, evenly spread"""
    simulation_step: Positive = 0.2
    steps_per_control_step: PositiveInt = 5
    horizon: PositiveInt = 600
    """decisions in an episode"""
    human_control: HumanControl = "commanded"
    right_of_way: bool = False
    safety: SafetyFilter = field(default_factory=lambda: SafetyFilter(active=False, time_gap=0.0))
    """none: the road is as it was published"""
    enforce_human_limits: bool = False

    @model_validator(mode="after")
    def _check_settings(self) -> "Merge":
        room = VEHICLE_LENGTH + max(self.humans.minimum_gap, self.sumo_human_gap)
        most = int((MERGE_HIGHWAY_LENGTH + MERGE_INFLOW_LENGTH) / room)
        if self.standing_vehicles > most:
            raise ValueError(f"standing_vehicles: {self.standing_vehicles} is not allowed; allowed: <= {most}")
        early = len(self._first_half_times())
        if self.cavs is not None and self.cavs > early:
            raise ValueError(f"cavs: {self.cavs} is not allowed; allowed: <= {early}, who enter in the first half")
        if self.human_control == "native":
            raise ValueError("human_control: 'native' is not allowed on the merge; allowed: 'commanded'")
        return self

    def draw(self, generator: np.random.Generator) -> MergeRoad:
        """Return the road with all vehicles that may enter; random is which of them are CAVs."""
        chosen = self._draw_cavs(generator)
        entering: list[tuple[Entry, Origin]] = []
        begin = -(MERGE_HIGHWAY_LENGTH + JUNCTION_LENGTHS[HIGHWAY_BRANCH])
        start = begin - ENTRANCE_LENGTH - MERGE_INFLOW_LENGTH
        for index in range(self.standing_vehicles):
            along = index * (MERGE_INFLOW_LENGTH + MERGE_HIGHWAY_LENGTH) / max(1, self.standing_vehicles)
            past = along - MERGE_INFLOW_LENGTH
            edge, place, first = ("inflow_highway", along, start) if past < 0 else ("highway", past, begin)
            entering.append((Entry(f"human_s{index}", f"from_{edge}", place), Origin(HIGHWAY_BRANCH, place + first)))
        for index, time in enumerate(self._entry_times(self.inflow)):
            name = f"{'cav' if index in chosen else 'human'}_{index}"
            entry = Entry(name, "from_inflow_highway", 0.0, HIGHWAY_ENTRY_SPEED, time)
            entering.append((entry, Origin(HIGHWAY_BRANCH, start)))
        start = -(MERGE_INFLOW_LENGTH + ENTRANCE_LENGTH + MERGE_RAMP_LENGTH + JUNCTION_LENGTHS[RAMP_BRANCH])
        for index, time in enumerate(self._entry_times(self.ramp_flow)):
            entry = Entry(f"human_r{index}", "from_inflow_ramp", 0.0, MERGE_RAMP_ENTRY_SPEED, time)
            entering.append((entry, Origin(RAMP_BRANCH, start)))
        origins = {entry.name: origin for entry, origin in entering}
        return MergeRoad(
            network=RoadNetwork(_NODES, _EDGES, self.top_speed),
            routes=_ROUTES,
            entries=tuple(sorted((entry for entry, _ in entering), key=lambda entry: entry.time)),
            limit_speed=self.limit_speed(),
            origins=origins,
            cav_ids=frozenset(name for name in origins if name.startswith("cav")),
            junction_lengths=JUNCTION_LENGTHS,
            human_parameters=self.draw_humans(tuple(origins), generator),
        )

    def _entry_times(self, flow: float) -> list[float]:
        """Return when the vehicles of a flow want to enter [s]."""
        if flow == 0:
            return []
        seconds = self.warmup * self.simulation_step + self.horizon * self.control_step
        return [index * 3600.0 / flow for index in range(int(seconds * flow / 3600.0))]

    def _first_half_times(self) -> list[float]:
        times = self._entry_times(self.inflow)
        return times[: len(times) // 2]

    def _draw_cavs(self, generator: np.random.Generator) -> set[int]:
        """Return which of the highway's vehicles are CAVs."""
        count = len(self._entry_times(self.inflow))
        if self.cavs is not None:
            return set(generator.choice(len(self._first_half_times()), self.cavs, replace=False).tolist())
        if self.cav_spacing == "even":
            every = np.arange(count * self.penetration_rate) / max(self.penetration_rate, 1e-9)
            return set(every.astype(int).tolist())
        return set(np.flatnonzero(generator.random(count) < self.penetration_rate).tolist())

    def limit_speed(self) -> float:
        """Return the mean speed of the highway's people where no ramp, no noise and no jam disturbs them."""
        length = (
            MERGE_INFLOW_LENGTH
            + ENTRANCE_LENGTH
            + MERGE_HIGHWAY_LENGTH
            + JUNCTION_LENGTHS[HIGHWAY_BRANCH]
            + MERGE_EXIT_LENGTH
        )
        return _free_flow_speed(self.inflow, length, self.humans, self.simulation_step)

    def possible_cav_ids(self) -> tuple[str, ...]:
        """Return the ids that any of the highway's vehicles has as a CAV."""
        return tuple(f"cav_{index}" for index in range(len(self._entry_times(self.inflow))))

    def facts(self) -> list[tuple[str, str]]:
        """Return the road's own facts for `unjam scenarios`."""
        share = f"{self.cavs} CAV" if self.cavs is not None else f"{100 * self.penetration_rate:g} % CAV"
        return [
            ("road", "highway of 700 m with a ramp"),
            ("vehicles", f"{self.inflow:g} + {self.ramp_flow:g} veh/h ({share})"),
            ("limit", f"{self.limit_speed():.2f} m/s"),
            ("limit is", "the mean speed of the highway's traffic where nothing disturbs it"),
        ]


@lru_cache
def _free_flow_speed(flow: float, length: float, humans: IDMParameters, step: float) -> float:
    """Return the mean speed over `length` of people who enter one behind the other and never meet a jam."""
    delay = round(3600.0 / flow / step)
    leader: list[tuple[float, float]] = []
    own: list[tuple[float, float]] = []
    for _ in range(PLATOON_SIZE):
        own = [(0.0, HIGHWAY_ENTRY_SPEED)]
        while own[-1][0] < length:
            position, speed = own[-1]
            moment = len(own) - 1 + delay
            ahead, ahead_speed = leader[moment] if moment < len(leader) else (inf, speed)
            gap = clamp_min(ahead - position - VEHICLE_LENGTH, _MIN_GAP)
            acceleration = idm_acceleration(speed, ahead_speed, gap, humans)
            moved = next_speed(speed, acceleration, step)
            own.append((next_position(position, moved, step), moved))
        leader = own
    return length / ((len(own) - 1) * step)


_RAMP_BEGIN, _RAMP_ENTRANCE = (
    -length * cos(RAMP_ANGLE) for length in (MERGE_RAMP_LENGTH, MERGE_RAMP_LENGTH + MERGE_INFLOW_LENGTH)
)
_NODES = (
    Node("highway_entrance", -MERGE_INFLOW_LENGTH - MERGE_HIGHWAY_LENGTH, 0.0),
    Node("highway_begin", -MERGE_HIGHWAY_LENGTH, 0.0),
    Node("ramp_entrance", _RAMP_ENTRANCE, _RAMP_ENTRANCE),
    Node("ramp_begin", _RAMP_BEGIN, _RAMP_BEGIN),
    Node("meeting", 0.0, 0.0, has_priority=True, radius=JUNCTION_RADIUS),
    Node("exit", MERGE_EXIT_LENGTH, 0.0),
)
_EDGES = (
    Edge("inflow_highway", "highway_entrance", "highway_begin", MERGE_INFLOW_LENGTH),
    Edge("highway", "highway_begin", "meeting", MERGE_HIGHWAY_LENGTH),
    Edge("inflow_ramp", "ramp_entrance", "ramp_begin", MERGE_INFLOW_LENGTH),
    Edge("ramp", "ramp_begin", "meeting", MERGE_RAMP_LENGTH),
    Edge("after", "meeting", "exit", MERGE_EXIT_LENGTH),
)
_ROUTES = (
    Route("from_inflow_highway", ("inflow_highway", "highway", "after")),
    Route("from_highway", ("highway", "after")),
    Route("from_inflow_ramp", ("inflow_ramp", "ramp", "after")),
)
