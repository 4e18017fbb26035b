"""The merge: a highway that a ramp joins, with one lane each, where vehicles come and go."""

from dataclasses import field
from functools import lru_cache
from math import cos, inf, pi
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from unjam.drivers.car_following import MIN_IDM_GAP
from unjam.drivers.safety import SafetyFilter
from unjam.errors import invalid_value
from unjam.parameters import STRICT, NonNegative, NonNegativeInt, Positive, PositiveInt, parameter_dataclass
from unjam.physics.arrays import clamp_min
from unjam.physics.idm import IDMParameters, idm_acceleration
from unjam.physics.kinematics import next_position, next_speed
from unjam.scenarios.road import Edge, Entry, MergeRoad, Node, Origin, RoadNetwork, Route
from unjam.scenarios.scenario import VEHICLE_LENGTH, Horizon, HumanControl, Scenario, SimulationStep

MERGE_INFLOW_LENGTH, MERGE_HIGHWAY_LENGTH, MERGE_EXIT_LENGTH, MERGE_RAMP_LENGTH = 100.0, 500.0, 100.0, 100.0
"""lengths of the edges on which vehicles enter, of the highway upstream and downstream of the ramp, of the ramp [m]"""
JUNCTION_RADIUS = 10.0
"""radius of the node where highway and ramp meet [m], as in Flow"""
JUNCTION_LENGTHS = (24.525483, 23.270389)
"""lengths of the lanes across that node, of highway and ramp [m], as netconvert makes them from the radius"""
ENTRANCE_LENGTH = 0.1
"""length of the lane across the nodes where the inflow edges end [m], as netconvert makes it"""
HIGHWAY_ENTRY_SPEED, MERGE_RAMP_ENTRY_SPEED = 10.0, 7.5
"""speed of vehicles that enter [m/s]"""
RAMP_ANGLE = pi / 4
"""angle between ramp and highway [rad]"""
MAX_FREE_FLOW_SECONDS = 3600.0
"""maximum time in which a vehicle may pass the highway in free flow [s]"""
PLATOON_SIZE = 30
"""number of vehicles from which on consecutive vehicles drive alike"""
HIGHWAY_BRANCH, RAMP_BRANCH = 0, 1


@parameter_dataclass(frozen=True, config=STRICT)
class Merge(Scenario):
    """A highway of 700 m that a ramp joins 100 m before its end; some highway vehicles are CAVs.

    At 2,000 + 100 vehicles an hour, traffic from an empty start flows freely. If a few vehicles stand on the road at
    the start, a jam grows upstream of the ramp and stays, and the queue spills back beyond the entrance. All CAVs have
    the same driver, each CAV with its own memory, from the control step after its entry until it leaves.
    """

    title: ClassVar[str] = "merge"
    reward: ClassVar[str] = "released-merge"
    is_closed: ClassVar[bool] = False
    sumo_human_gap: ClassVar[float] = 2.5

    inflow: Positive = 2000.0
    """demand of the highway [veh/h], evenly spaced in time"""
    ramp_flow: NonNegative = 100.0
    """demand of the ramp [veh/h]"""
    penetration_rate: Annotated[float, Field(ge=0, le=1)] = 0.1
    """share of CAVs among the vehicles of the highway"""
    cav_spacing: Literal["random", "even"] = "random"
    """CAVs in the stream: `random` as in the paper; `even` as in Flow, where every tenth vehicle is a CAV"""
    cavs: PositiveInt | None = None
    """exact number of CAVs among the first half of the highway vehicles; None: `penetration_rate` applies"""
    standing_vehicles: NonNegativeInt = 5
    """human-driven vehicles that stand on the highway at the start, evenly spread"""
    simulation_step: SimulationStep = 0.2
    steps_per_control_step: PositiveInt = 5
    horizon: Horizon = 600
    """control steps in an episode"""
    human_control: HumanControl = "commanded"
    right_of_way: bool = False
    safety: SafetyFilter = field(default_factory=lambda: SafetyFilter(active=False, time_gap=0.0))
    """inactive: the road is as published"""
    enforce_human_limits: bool = False

    @model_validator(mode="after")
    def _check_settings(self) -> Self:
        spacing = VEHICLE_LENGTH + max(self.humans.minimum_gap, self.sumo_human_gap)
        max_standing = int((MERGE_HIGHWAY_LENGTH + MERGE_INFLOW_LENGTH) / spacing)
        if self.standing_vehicles > max_standing:
            raise ValueError(f"standing_vehicles: {self.standing_vehicles} is not allowed; allowed: <= {max_standing}")
        max_cavs = len(self._entry_times(self.inflow)) // 2
        if self.cavs is not None and self.cavs > max_cavs:
            raise ValueError(
                f"cavs: {self.cavs} is not allowed; allowed: <= {max_cavs}, the vehicles of the first half"
            )
        if self.human_control == "native":
            raise ValueError("human_control: 'native' is not allowed on the merge; allowed: 'commanded'")
        return self

    @property
    def max_vehicles(self) -> float:
        """Number of vehicles that want to enter, of both flows."""
        return self.max_duration * (self.inflow + self.ramp_flow) / 3600.0

    def draw(self, generator: np.random.Generator) -> MergeRoad:
        """Return the road with all vehicles that can enter; the choice of CAVs is random."""
        cav_indices = self._draw_cav_indices(generator)
        entering: list[tuple[Entry, Origin]] = []
        highway_start = -(MERGE_HIGHWAY_LENGTH + JUNCTION_LENGTHS[HIGHWAY_BRANCH])
        inflow_start = highway_start - ENTRANCE_LENGTH - MERGE_INFLOW_LENGTH
        for index in range(self.standing_vehicles):
            position = index * (MERGE_INFLOW_LENGTH + MERGE_HIGHWAY_LENGTH) / max(1, self.standing_vehicles)
            edge, edge_start = "inflow_highway", inflow_start
            if position >= MERGE_INFLOW_LENGTH:
                edge, edge_start, position = "highway", highway_start, position - MERGE_INFLOW_LENGTH
            entry = Entry(f"human_s{index}", f"from_{edge}", position)
            entering.append((entry, Origin(HIGHWAY_BRANCH, position + edge_start)))
        for index, time in enumerate(self._entry_times(self.inflow)):
            name = f"{'cav' if index in cav_indices else 'human'}_{index}"
            entry = Entry(name, "from_inflow_highway", 0.0, HIGHWAY_ENTRY_SPEED, time)
            entering.append((entry, Origin(HIGHWAY_BRANCH, inflow_start)))
        ramp_start = -(MERGE_INFLOW_LENGTH + ENTRANCE_LENGTH + MERGE_RAMP_LENGTH + JUNCTION_LENGTHS[RAMP_BRANCH])
        for index, time in enumerate(self._entry_times(self.ramp_flow)):
            entry = Entry(f"human_r{index}", "from_inflow_ramp", 0.0, MERGE_RAMP_ENTRY_SPEED, time)
            entering.append((entry, Origin(RAMP_BRANCH, ramp_start)))
        origins = {entry.name: origin for entry, origin in entering}
        return MergeRoad(
            network=RoadNetwork(_NODES, _EDGES, self.top_speed),
            routes=_ROUTES,
            entries=tuple(sorted((entry for entry, _ in entering), key=lambda entry: entry.time)),
            limit_speed=self.limit_speed(),
            merge_positions=(0.0,),
            origins=origins,
            cav_ids=frozenset(name for name in origins if name.startswith("cav")),
            junction_lengths=JUNCTION_LENGTHS,
            human_parameters=self.draw_humans(tuple(origins), generator),
        )

    def _entry_times(self, flow: float) -> list[float]:
        """Return the times at which the vehicles of a flow want to enter [s]."""
        seconds = self.warmup * self.simulation_step + self.horizon * self.control_step
        return [index * 3600.0 / flow for index in range(int(seconds * flow / 3600.0))]

    def _draw_cav_indices(self, generator: np.random.Generator) -> set[int]:
        count = len(self._entry_times(self.inflow))
        if self.cavs is not None:
            return set(generator.choice(count // 2, self.cavs, replace=False).tolist())
        if self.cav_spacing == "even":
            indices = np.arange(count * self.penetration_rate) / max(self.penetration_rate, 1e-9)
            return set(indices.astype(int).tolist())
        return set(np.flatnonzero(generator.random(count) < self.penetration_rate).tolist())

    def limit_speed(self) -> float:
        """Return the mean speed of human drivers on the highway without ramp, noise and jams [m/s]."""
        upstream = MERGE_INFLOW_LENGTH + ENTRANCE_LENGTH + MERGE_HIGHWAY_LENGTH
        length = upstream + JUNCTION_LENGTHS[HIGHWAY_BRANCH] + MERGE_EXIT_LENGTH
        return _free_flow_speed(self.inflow, length, self.humans, self.simulation_step)

    def possible_cav_ids(self) -> tuple[str, ...]:
        """Return the ids that the vehicles of the highway have as CAVs."""
        return tuple(f"cav_{index}" for index in range(len(self._entry_times(self.inflow))))

    def _summary_texts(self) -> tuple[str, str, str, str]:
        cavs = f"{self.cavs} CAV" if self.cavs is not None else f"{100 * self.penetration_rate:g} % CAV"
        vehicles = f"{self.inflow:g} + {self.ramp_flow:g} veh/h ({cavs})"
        reason = "the mean speed of undisturbed traffic on the highway"
        return "highway of 700 m with a ramp", vehicles, f"{self.limit_speed():.2f} m/s", reason


@lru_cache
def _free_flow_speed(flow: float, length: float, humans: IDMParameters, step: float) -> float:
    """Return the mean speed over `length` of human drivers that enter one after the other in free flow [m/s]."""
    delay = round(3600.0 / flow / step)
    leader, trajectory = list[tuple[float, float]](), list[tuple[float, float]]()
    for _ in range(PLATOON_SIZE):
        trajectory = [(0.0, HIGHWAY_ENTRY_SPEED)]
        while trajectory[-1][0] < length:
            if len(trajectory) * step > MAX_FREE_FLOW_SECONDS:
                allowed = f"human drivers that need at most {MAX_FREE_FLOW_SECONDS:g} s for {length:g} m"
                raise invalid_value("humans", humans, allowed)
            position, speed = trajectory[-1]
            index = len(trajectory) - 1 + delay
            leader_position, leader_speed = leader[index] if index < len(leader) else (inf, speed)
            gap = clamp_min(leader_position - position - VEHICLE_LENGTH, MIN_IDM_GAP)
            speed = next_speed(speed, idm_acceleration(speed, leader_speed, gap, humans), step)
            trajectory.append((next_position(position, speed, step), speed))
        leader = trajectory
    return length / ((len(trajectory) - 1) * step)


_RAMP_BEGIN = -MERGE_RAMP_LENGTH * cos(RAMP_ANGLE)
_RAMP_ENTRANCE = -(MERGE_RAMP_LENGTH + MERGE_INFLOW_LENGTH) * cos(RAMP_ANGLE)
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
