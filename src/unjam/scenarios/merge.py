"""The merge: a highway that a ramp joins, with one lane each, where vehicles come and go."""

from dataclasses import field
from functools import lru_cache
from math import cos, inf, pi
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from unjam.drivers.car_following import SMALLEST_GAP
from unjam.drivers.safety import SafetyFilter
from unjam.parameters import STRICT, Count, CountOrNone, NotNegative, Positive
from unjam.physics.arrays import at_least
from unjam.physics.idm import IDMParameters, idm_acceleration
from unjam.physics.kinematics import next_position, next_speed
from unjam.scenarios.road import Edge, Entry, MergingRoad, Node, Origin, RoadNetwork, Route
from unjam.scenarios.scenario import VEHICLE_LENGTH, HumanControl, Scenario

INFLOW_EDGE, BEFORE, AFTER, RAMP = 100.0, 500.0, 100.0, 100.0
"""lengths of the edges on which vehicles enter, of the highway before and after the ramp, of the ramp [m]"""
JUNCTION_RADIUS = 10.0
"""of the node where they meet [m], as Flow's"""
JUNCTION_WAYS = (24.525483, 23.270389)
"""lengths of the ways across that node, of highway and ramp, as netconvert makes them from the radius [m]"""
ENTRANCE_WAY = 0.1
"""length of the way across the nodes where the inflow edges end, as netconvert makes it [m]"""
HIGHWAY_SPEED, RAMP_SPEED = 10.0, 7.5
"""with which vehicles enter [m/s]"""
JOINS_IN = pi / 4
"""angle between ramp and highway [rad]"""
PLATOON = 30
"""vehicles after which each drives like the one before it"""
HIGHWAY, ON_RAMP = 0, 1
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
    closed: ClassVar[bool] = False
    people_gap: ClassVar[float] = 2.5

    inflow: Positive = 2000.0
    """vehicles that want to enter the highway [veh/h], evenly spaced in time"""
    ramp_flow: NotNegative = 100.0
    """vehicles that want to enter the ramp [veh/h]"""
    cav_share: Annotated[float, Field(ge=0, le=1)] = 0.1
    """share of the highway's vehicles that are CAVs"""
    spacing: Literal["random", "even"] = "random"
    """where in the stream the CAVs are: `random` as the paper; `even`: each tenth vehicle, as Flow"""
    cavs: Count | None = None
    """exactly so many CAVs instead of a share, among those that want to enter in the first half"""
    standing: CountOrNone = 5
    """people who stand on the highway at the start, evenly spread"""
    simulation_step: Positive = 0.2
    steps_per_decision: Count = 5
    horizon: Count = 600
    """decisions in an episode"""
    human_control: HumanControl = "commanded"
    right_of_way: bool = False
    safety: SafetyFilter = field(default_factory=lambda: SafetyFilter(active=False, time_headway=0.0))
    """none: the road is as it was published"""
    bounded: bool = False

    @model_validator(mode="after")
    def _fits(self) -> "Merge":
        room = VEHICLE_LENGTH + max(self.humans.minimum_gap, self.people_gap)
        most = int((BEFORE + INFLOW_EDGE) / room)
        if self.standing > most:
            raise ValueError(f"standing: {self.standing} is not allowed; allowed: <= {most}")
        early = len(self._early())
        if self.cavs is not None and self.cavs > early:
            raise ValueError(
                f"cavs: {self.cavs} is not allowed; allowed: <= {early}, who enter in the first half"
            )
        if self.human_control == "native":
            raise ValueError("human_control: 'native' is not allowed on the merge; allowed: 'commanded'")
        return self

    def draw(self, generator: np.random.Generator) -> MergingRoad:
        """Return the road with all vehicles that may enter; random is which of them are CAVs."""
        chosen = self._chosen(generator)
        entering: list[tuple[Entry, Origin]] = []
        begin = -(BEFORE + JUNCTION_WAYS[HIGHWAY])
        start = begin - ENTRANCE_WAY - INFLOW_EDGE
        for index in range(self.standing):
            along = index * (INFLOW_EDGE + BEFORE) / max(1, self.standing)
            past = along - INFLOW_EDGE
            edge, place, first = ("inflow_highway", along, start) if past < 0 else ("highway", past, begin)
            entering.append((Entry(f"human_s{index}", f"from_{edge}", place), Origin(HIGHWAY, place + first)))
        for index, time in enumerate(self._times(self.inflow)):
            name = f"{'cav' if index in chosen else 'human'}_{index}"
            entry = Entry(name, "from_inflow_highway", 0.0, HIGHWAY_SPEED, time)
            entering.append((entry, Origin(HIGHWAY, start)))
        start = -(INFLOW_EDGE + ENTRANCE_WAY + RAMP + JUNCTION_WAYS[ON_RAMP])
        for index, time in enumerate(self._times(self.ramp_flow)):
            entry = Entry(f"human_r{index}", "from_inflow_ramp", 0.0, RAMP_SPEED, time)
            entering.append((entry, Origin(ON_RAMP, start)))
        origins = {entry.name: origin for entry, origin in entering}
        return MergingRoad(
            network=RoadNetwork(_NODES, _EDGES, self.top_speed),
            routes=_ROUTES,
            entries=tuple(sorted((entry for entry, _ in entering), key=lambda entry: entry.time)),
            limit_speed=self.limit(),
            origins=origins,
            cav_ids=frozenset(name for name in origins if name.startswith("cav")),
            junctions=JUNCTION_WAYS,
            people=self.draw_people(tuple(origins), generator),
        )

    def _times(self, flow: float) -> list[float]:
        """Return when the vehicles of a flow want to enter [s]."""
        if flow == 0:
            return []
        seconds = self.warmup * self.simulation_step + self.horizon * self.decision_step
        return [index * 3600.0 / flow for index in range(int(seconds * flow / 3600.0))]

    def _early(self) -> list[float]:
        times = self._times(self.inflow)
        return times[: len(times) // 2]

    def _chosen(self, generator: np.random.Generator) -> set[int]:
        """Return which of the highway's vehicles are CAVs."""
        count = len(self._times(self.inflow))
        if self.cavs is not None:
            return set(generator.choice(len(self._early()), self.cavs, replace=False).tolist())
        if self.spacing == "even":
            every = np.arange(count * self.cav_share) / max(self.cav_share, 1e-9)
            return set(every.astype(int).tolist())
        return set(np.flatnonzero(generator.random(count) < self.cav_share).tolist())

    def limit(self) -> float:
        """Return the mean speed of the highway's people where no ramp, no noise and no jam disturbs them."""
        length = INFLOW_EDGE + ENTRANCE_WAY + BEFORE + JUNCTION_WAYS[HIGHWAY] + AFTER
        return _undisturbed_speed(self.inflow, length, self.humans, self.simulation_step)

    def possible_cavs(self) -> tuple[str, ...]:
        """Return the ids that any of the highway's vehicles has as a CAV."""
        return tuple(f"cav_{index}" for index in range(len(self._times(self.inflow))))

    def facts(self) -> list[tuple[str, str]]:
        """Return the road's own facts for `unjam scenarios`."""
        share = f"{self.cavs} CAV" if self.cavs is not None else f"{100 * self.cav_share:g} % CAV"
        return [
            ("road", "highway of 700 m with a ramp"),
            ("vehicles", f"{self.inflow:g} + {self.ramp_flow:g} veh/h ({share})"),
            ("limit", f"{self.limit():.2f} m/s"),
            ("limit is", "the mean speed of the highway's traffic where nothing disturbs it"),
        ]


@lru_cache
def _undisturbed_speed(flow: float, length: float, humans: IDMParameters, step: float) -> float:
    """Return the mean speed over `length` of people who enter one behind the other and never meet a jam."""
    delay = round(3600.0 / flow / step)
    leader: list[tuple[float, float]] = []
    own: list[tuple[float, float]] = []
    for _ in range(PLATOON):
        own = [(0.0, HIGHWAY_SPEED)]
        while own[-1][0] < length:
            position, speed = own[-1]
            moment = len(own) - 1 + delay
            ahead, ahead_speed = leader[moment] if moment < len(leader) else (inf, speed)
            gap = at_least(ahead - position - VEHICLE_LENGTH, SMALLEST_GAP)
            acceleration = idm_acceleration(speed, ahead_speed, gap, humans)
            moved = next_speed(speed, acceleration, step)
            own.append((next_position(position, moved, step), moved))
        leader = own
    return length / ((len(own) - 1) * step)


_RAMP_BEGIN, _RAMP_ENTRANCE = (-length * cos(JOINS_IN) for length in (RAMP, RAMP + INFLOW_EDGE))
_NODES = (
    Node("highway_entrance", -INFLOW_EDGE - BEFORE, 0.0),
    Node("highway_begin", -BEFORE, 0.0),
    Node("ramp_entrance", _RAMP_ENTRANCE, _RAMP_ENTRANCE),
    Node("ramp_begin", _RAMP_BEGIN, _RAMP_BEGIN),
    Node("meeting", 0.0, 0.0, priority=True, radius=JUNCTION_RADIUS),
    Node("exit", AFTER, 0.0),
)
_EDGES = (
    Edge("inflow_highway", "highway_entrance", "highway_begin", INFLOW_EDGE),
    Edge("highway", "highway_begin", "meeting", BEFORE),
    Edge("inflow_ramp", "ramp_entrance", "ramp_begin", INFLOW_EDGE),
    Edge("ramp", "ramp_begin", "meeting", RAMP),
    Edge("after", "meeting", "exit", AFTER),
)
_ROUTES = (
    Route("from_inflow_highway", ("inflow_highway", "highway", "after")),
    Route("from_highway", ("highway", "after")),
    Route("from_inflow_ramp", ("inflow_ramp", "ramp", "after")),
)
