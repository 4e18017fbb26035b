"""The on-ramp: a motorway of one or two lanes that a ramp joins, with different human drivers that overtake."""

from collections.abc import Iterator
from dataclasses import field, replace
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from unjam.drivers.roadside import RoadsideSettings
from unjam.drivers.safety import SafetyFilter
from unjam.parameters import STRICT, NonNegative, Positive, PositiveInt
from unjam.scenarios.road import Connection, Edge, EdgeLane, Entry, MotorwayRoad, Node, RoadNetwork, Route, VehicleType
from unjam.scenarios.scenario import Actuation, Scenario

UPSTREAM_LENGTH, MERGING_LENGTH, DOWNSTREAM_LENGTH, RAMP_LENGTH = 2000.0, 300.0, 700.0, 400.0
"""lengths of the motorway upstream of the merging section, of that section, downstream of it, and of the ramp [m]"""
MOTORWAY_LENGTH = UPSTREAM_LENGTH + MERGING_LENGTH + DOWNSTREAM_LENGTH
"""[m]"""
MOTORWAY_SPEED_LIMIT, RAMP_SPEED_LIMIT, RAMP_ENTRY_SPEED = 27.78, 22.22, 15.0
"""[m/s]"""
MIN_RAMP_HEADWAY = 2.0
"""smallest time between two vehicles that want to enter the ramp [s]"""
FREE_FLOW_TIMES = {1: 113.0, 2: 106.6}
"""mean travel time in human-only traffic without a peak, by lanes, of six seeds [s]"""
HUMAN_TYPE_COUNT = 200
"""number of different human drivers"""
RAMP_OFFSET = 60.0
"""distance between the nodes where motorway and ramp begin [m]"""

Arrival = tuple[float, str, int, float | Literal["last"]]
Interval = Annotated[tuple[float, float], Field(min_length=2, max_length=2)]


@dataclass(frozen=True, config=STRICT)
class OnRamp(Scenario):
    """A motorway of 3 km that a ramp joins after 2 km, with a peak of demand slightly above capacity.

    Human drivers follow SUMO's extended IDM, each with other parameters, and change lanes. In the peak a jam forms at
    the ramp, in nine of ten episodes, and sends waves upstream. A CAV replaces a human-driven vehicle and desires the
    same speed; its own ACC follows, and its driver can reduce the set speed upstream of the ramp.
    """

    title: ClassVar[str] = "on-ramp"
    reward: ClassVar[str] = "travel-time"
    is_closed: ClassVar[bool] = False
    provided_fields: ClassVar[tuple[str, ...]] = (
        *("allowed_speed", "distance_to_merge", "lane_speeds", "road_speeds"),
        *("adjacent_gaps", "adjacent_speeds", "penetration_rate"),
    )

    lanes: Literal[1, 2] = 2
    """of the motorway"""
    inflow: Positive = 3200.0
    """demand of the motorway in the peak [veh/h]"""
    ramp_flow: NonNegative = 500.0
    """demand of the ramp in the peak [veh/h]"""
    off_peak_inflow: NonNegative = 1800.0
    """of the motorway, before and after the peak [veh/h]"""
    off_peak_ramp_flow: NonNegative = 250.0
    """of the ramp, before and after the peak [veh/h]"""
    peak: Interval = (300.0, 1500.0)
    """its begin and end [s]"""
    min_entry_headway: NonNegative = 1.1
    """smallest time between two vehicles that want to enter a lane of the motorway [s]"""
    penetration_rate: Annotated[float, Field(ge=0, le=1)] = 0.1
    """share of CAVs among all vehicles; the CAVs of a smaller share are part of those of a larger one"""
    cavs: PositiveInt | None = None
    """exact number of CAVs instead of a share, among the vehicles of the first half"""
    car_following: Literal["EIDM", "IDM"] = "EIDM"
    """SUMO's car-following model of human drivers"""
    time_headways: Interval = (1.0, 1.8)
    """range among human drivers [s]"""
    accelerations: Interval = (1.0, 1.5)
    """range among human drivers [m/s2]"""
    decelerations: Interval = (1.5, 2.0)
    """range of comfortable decelerations among human drivers [m/s2]"""
    minimum_gaps: Interval = (2.0, 2.5)
    """range among human drivers, in a standing queue [m]"""
    speed_factor_std: NonNegative = 0.1
    """standard deviation of desired speed / speed limit, with mean 1; at most 0.2 from the mean"""
    vehicle_length: Positive = 4.8
    """[m]"""
    roadside: RoadsideSettings = field(default_factory=RoadsideSettings)
    """latency and smoothing of the speeds ahead that CAVs receive"""
    simulation_step: Positive = 0.5
    steps_per_control_step: PositiveInt = 2
    horizon: PositiveInt = 2400
    """control steps in an episode"""
    action_limit: Positive = 2.5
    actuation: Actuation = "cruise"
    safety: SafetyFilter = field(default_factory=lambda: SafetyFilter(active=False))
    """inactive: the CAV's own ACC keeps its distance"""
    noise: Annotated[float, Field(ge=0, le=0)] = 0.0
    """none: the car-following model has its own"""
    emission_class: str = "HBEFA4/PC_petrol_Euro-6d"

    @model_validator(mode="after")
    def _check_settings(self) -> Self:
        for name in ("time_headways", "accelerations", "decelerations", "minimum_gaps", "peak"):
            low, high = getattr(self, name)
            if not 0 <= low <= high or (high == 0 and name != "peak"):
                raise ValueError(f"{name}: ({low:g}, {high:g}) is not allowed; allowed: 0 < low <= high")
        capacity = 3600.0 * self.lanes / max(self.min_entry_headway, 1e-9)
        for name, most, reason in (
            *((name, capacity, ", by min_entry_headway") for name in ("inflow", "off_peak_inflow")),
            *((name, 3600.0 / MIN_RAMP_HEADWAY, "") for name in ("ramp_flow", "off_peak_ramp_flow")),
        ):
            if getattr(self, name) >= most:
                raise ValueError(f"{name}: {getattr(self, name):g} is not allowed; allowed: < {most:.0f}{reason}")
        self.check_native_humans("on the on-ramp")
        return self

    def draw(self, generator: np.random.Generator) -> MotorwayRoad:
        """Return the road with its demand; random are the human drivers, their entry times and the choice of CAVs."""
        types = {f"human_type_{number}": self._draw_human_type(generator) for number in range(HUMAN_TYPE_COUNT)}
        entries, draws = list[Entry](), dict[str, float]()
        for number, (time, route, lane, speed) in enumerate(sorted(self._arrivals(generator))):
            name, vehicle_type = f"vehicle_{number}", f"human_type_{generator.integers(HUMAN_TYPE_COUNT)}"
            draws[name] = generator.random()
            entries.append(Entry(name, route, 0.0, speed, time, lane, vehicle_type))
        return MotorwayRoad(
            network=_network(self.lanes),
            routes=_ROUTES,
            entries=tuple(entries),
            limit_speed=MOTORWAY_SPEED_LIMIT,
            vehicle_types=types,
            cav_ids=self._select_cavs(draws),
            edge_lanes=_edge_lanes(self.lanes),
            lane_names=("ramp", "motorway") if self.lanes == 1 else ("ramp", "right lane", "left lane"),
            merge_position=UPSTREAM_LENGTH,
            length=MOTORWAY_LENGTH,
            vehicle_length=self.vehicle_length,
            peak=self.peak,
            free_flow_time=FREE_FLOW_TIMES[self.lanes],
            roadside=self.roadside,
        )

    def _select_cavs(self, draws: dict[str, float]) -> frozenset[str]:
        """Return the CAVs: the vehicles with the lowest draws."""
        if self.cavs is None:
            return frozenset(name for name, draw in draws.items() if draw < self.penetration_rate)
        early = sorted(list(draws)[: len(draws) // 2], key=draws.__getitem__)
        return frozenset(early[: self.cavs])

    def _draw_human_type(self, generator: np.random.Generator) -> VehicleType:
        def draw_uniform(interval: tuple[float, float]) -> float:
            return round(float(generator.uniform(*interval)), 4)

        human = VehicleType(
            model=self.car_following,
            time_headway=draw_uniform(self.time_headways),
            acceleration=draw_uniform(self.accelerations),
            deceleration=draw_uniform(self.decelerations),
            minimum_gap=draw_uniform(self.minimum_gaps),
            speed_factor=round(float(np.clip(generator.normal(1.0, self.speed_factor_std), 0.8, 1.2)), 4),
        )
        if self.driver_population is None:
            return human
        (one,) = self.driver_population.draw(1, generator)
        # Only following is calibrated: recordings of jams say nothing about desired speeds.
        return human._replace(
            model="IDM",
            time_headway=one.time_headway,
            acceleration=one.max_acceleration,
            deceleration=one.comfortable_deceleration,
            minimum_gap=one.minimum_gap,
        )

    def _arrivals(self, generator: np.random.Generator) -> Iterator[Arrival]:
        """Yield time, route, lane and speed of vehicles that want to enter."""
        for lane in range(self.lanes):
            flows = self.off_peak_inflow / self.lanes, self.inflow / self.lanes
            for time in self._entry_times(generator, *flows, self.min_entry_headway):
                yield time, "motorway", lane, "last"
        for time in self._entry_times(generator, self.off_peak_ramp_flow, self.ramp_flow, MIN_RAMP_HEADWAY):
            yield time, "ramp", 0, RAMP_ENTRY_SPEED

    def _entry_times(
        self, generator: np.random.Generator, off_peak: float, peak: float, min_headway: float
    ) -> Iterator[float]:
        """Yield times with shifted exponential headways, period by period [s]; flows in veh/h."""
        begin = 0.0
        for end, flow in ((self.peak[0], off_peak), (self.peak[1], peak), (self.max_duration, off_peak)):
            time = begin
            while flow:
                time += min_headway + float(generator.exponential(3600.0 / flow - min_headway))
                if time >= min(end, self.max_duration):
                    break
                yield round(time, 2)
            begin = max(begin, end)

    @property
    def top_speed(self) -> float:
        """The speed limit of the motorway [m/s]."""
        return MOTORWAY_SPEED_LIMIT

    @property
    def human_description(self) -> str:
        """How human drivers drive, as one phrase."""
        model = f"as {self.population_description}" if self.driver_population else self.car_following
        return f"{HUMAN_TYPE_COUNT} different human drivers, {model}, with SUMO's lane changes"

    def possible_cav_ids(self) -> tuple[str, ...]:
        """Return the ids of all vehicles: each can be a CAV."""
        flow = max(self.inflow, self.off_peak_inflow) + max(self.ramp_flow, self.off_peak_ramp_flow)
        most = int(self.max_duration / 3600.0 * 2.0 * flow)
        return tuple(f"vehicle_{number}" for number in range(most))

    def _fact_values(self) -> tuple[str, str, str, str]:
        lanes = "one lane" if self.lanes == 1 else f"{self.lanes} lanes"
        road = f"motorway of {MOTORWAY_LENGTH / 1000:g} km, {lanes}, with a ramp"
        peak = f"{self.inflow:g} + {self.ramp_flow:g} veh/h from {self.peak[0]:g} to {self.peak[1]:g} s"
        off_peak = f"else {self.off_peak_inflow:g} + {self.off_peak_ramp_flow:g}"
        vehicles = f"{peak}, {off_peak} ({100 * self.penetration_rate:g} % CAV)"
        return road, vehicles, f"{MOTORWAY_SPEED_LIMIT:.2f} m/s", "the speed limit of the motorway"


def _network(lanes: int) -> RoadNetwork:
    nodes = (
        Node("entrance", -UPSTREAM_LENGTH, 0.0),
        Node("ramp_entrance", -RAMP_LENGTH + 1.0, -RAMP_OFFSET),
        Node("joins", 0.0, 0.0),
        Node("closes", MERGING_LENGTH, 0.0),
        Node("exit", MERGING_LENGTH + DOWNSTREAM_LENGTH, 0.0),
    )
    edges = (
        Edge("motorway", "entrance", "joins", UPSTREAM_LENGTH, lanes=lanes),
        Edge("ramp", "ramp_entrance", "joins", RAMP_LENGTH, speed_limit=RAMP_SPEED_LIMIT),
        Edge("merging", "joins", "closes", MERGING_LENGTH, lanes=lanes + 1),
        Edge("after", "closes", "exit", DOWNSTREAM_LENGTH, lanes=lanes),
    )
    connections = (
        *(Connection("motorway", "merging", lane, lane + 1) for lane in range(lanes)),
        Connection("ramp", "merging", 0, 0),
        *(Connection("merging", "after", lane + 1, lane) for lane in range(lanes)),
    )
    return RoadNetwork(nodes, edges, MOTORWAY_SPEED_LIMIT, has_internal_links=False, connections=connections)


def _edge_lanes(lanes: int) -> tuple[EdgeLane, ...]:
    """Return all lanes; lane 0 is the ramp with its extension along the motorway, where it ends."""
    result = [
        EdgeLane("ramp_0", 0, UPSTREAM_LENGTH - RAMP_LENGTH, RAMP_SPEED_LIMIT),
        EdgeLane("merging_0", 0, UPSTREAM_LENGTH, MOTORWAY_SPEED_LIMIT, is_merging=True),
    ]
    for lane in range(lanes):
        result += [
            EdgeLane(f"motorway_{lane}", lane + 1, 0.0, MOTORWAY_SPEED_LIMIT),
            EdgeLane(f"merging_{lane + 1}", lane + 1, UPSTREAM_LENGTH, MOTORWAY_SPEED_LIMIT, is_merging=True),
            EdgeLane(f"after_{lane}", lane + 1, UPSTREAM_LENGTH + MERGING_LENGTH, MOTORWAY_SPEED_LIMIT),
        ]
    return tuple(result)


_ROUTES = (Route("motorway", ("motorway", "merging", "after")), Route("ramp", ("ramp", "merging", "after")))

ON_RAMP = OnRamp()
ON_RAMP_SCENARIOS = {
    "on-ramp": ON_RAMP,
    "on-ramp-1": replace(
        ON_RAMP, lanes=1, inflow=1400.0, ramp_flow=350.0, off_peak_inflow=900.0, off_peak_ramp_flow=125.0
    ),
    "on-ramp-steady": replace(ON_RAMP, peak=(300.0, 2400.0)),
}
"""the named roads of this kind"""
