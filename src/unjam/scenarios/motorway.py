"""Motorways with any number of lanes and on-ramps, a peak of demand, and different human drivers that overtake."""

from collections.abc import Callable, Iterator
from dataclasses import field, replace
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from unjam.drivers.roadside import RoadsideSettings
from unjam.drivers.safety import SafetyFilter
from unjam.parameters import STRICT, NonNegative, Positive, PositiveInt, Subclassable, parameter_dataclass
from unjam.scenarios import motorway_vehicles
from unjam.scenarios.motorway_road import MAIN_ROUTE, MotorwayGeometry, MotorwayRoad, RampGeometry
from unjam.scenarios.road import Entry, VehicleType
from unjam.scenarios.road_control import RampMeter, SpeedLimitControl
from unjam.scenarios.scenario import Actuation, Horizon, Scenario, SimulationStep

MAX_LANES = 5
MIN_RAMP_HEADWAY = 2.0
"""smallest time between two vehicles that want to enter a ramp [s]"""
SPEED_FACTOR_RANGE = 0.8, 1.2
"""range of desired speed / speed limit among human drivers"""
MIN_END_LENGTH = 50.0
"""minimum length of the road downstream of the last merging section [m]"""
DEMAND_STEP = 60.0
"""duration of each step of a rising or falling demand [s]"""
HUMAN_TYPE_COUNT = 200
"""number of different human drivers"""
Arrival = tuple[float, str, int, float | Literal["last"]]
"""time at which a vehicle wants to enter [s], its route, lane and speed [m/s]"""
SectionLength = Annotated[float, Field(ge=50, le=1_000_000)]
"""length of a part of the road [m]"""


@parameter_dataclass(frozen=True, config=STRICT)
class Ramp(Subclassable):
    """An on-ramp of a motorway, with its demand."""

    position: Positive
    """distance from the entrance of the motorway to the begin of the acceleration lane [m]"""
    merging_length: SectionLength = 300.0
    """length of the acceleration lane, along which vehicles merge [m]"""
    length: SectionLength = 400.0
    """length of the ramp upstream of the acceleration lane [m]"""
    speed_limit: Positive = 22.22
    """speed limit of the ramp upstream of the acceleration lane [m/s]"""
    entry_speed: Positive | Literal["last"] = 15.0
    """speed of vehicles that enter the ramp [m/s]; `last`: the speed of the vehicle that entered before"""
    inflow: NonNegative = 500.0
    """demand in the peak [veh/h]"""
    off_peak_inflow: NonNegative = 250.0
    """demand before and after the peak [veh/h]"""

    @property
    def geometry(self) -> RampGeometry:
        """The geometry of the ramp."""
        merge_end = self.position + self.merging_length
        return RampGeometry(self.position, merge_end, self.length, self.speed_limit)


@parameter_dataclass(frozen=True, config=STRICT)
class Motorway(Scenario):
    """A motorway with any number of on-ramps and a peak of demand.

    Human drivers follow SUMO's extended IDM, each with other parameters, and change lanes. If the demand of the peak is
    above capacity, a jam forms at a ramp and sends waves upstream. A CAV replaces a human-driven vehicle and has the
    same desired speed. Its ACC follows the leader, and its driver can reduce the set speed upstream of a ramp.
    """

    title: ClassVar[str] = "motorway"
    reward: ClassVar[str] = "travel-time"
    road_model: ClassVar[str] = "motorway"
    is_closed: ClassVar[bool] = False

    length: SectionLength = 3000.0
    """length of the motorway [m]"""
    lanes: Annotated[int, Field(ge=1, le=MAX_LANES)] = 2
    """number of lanes, without acceleration lanes"""
    speed_limit: Positive = 27.78
    """speed limit of the motorway [m/s]"""
    ramps: tuple[Ramp, ...] = ()
    """the on-ramps, from upstream to downstream"""
    inflow: Positive = 3200.0
    """demand at the entrance of the motorway in the peak [veh/h]"""
    off_peak_inflow: NonNegative = 1800.0
    """demand at the entrance before and after the peak [veh/h]"""
    peak: motorway_vehicles.Interval = (300.0, 1500.0)
    """begin and end of the peak of demand [s]"""
    peak_rise: Annotated[float, Field(ge=0, le=86_400)] = 0.0
    """time in which demand rises before the peak, and falls after it, in steps of a minute [s]"""
    min_entry_headway: NonNegative = 1.1
    """smallest time between two vehicles that want to enter a lane of the motorway [s]"""
    penetration_rate: Annotated[float, Field(ge=0, le=1)] = 0.1
    """share of CAVs among all cars; with equal seeds, a higher share has all CAVs of a lower share"""
    cavs: PositiveInt | None = None
    """exact number of CAVs, among the cars of the first half; None: `penetration_rate` applies"""
    car_following: Literal["EIDM", "IDM"] = "EIDM"
    """SUMO's car-following model of human drivers"""
    time_headways: motorway_vehicles.Interval = (1.0, 1.8)
    """range of the time headways of human drivers [s]"""
    accelerations: motorway_vehicles.Interval = (1.0, 1.5)
    """range of the maximum accelerations of human drivers [m/s2]"""
    decelerations: motorway_vehicles.Interval = (1.5, 2.0)
    """range of comfortable decelerations among human drivers [m/s2]"""
    minimum_gaps: motorway_vehicles.Interval = (2.0, 2.5)
    """range of the gaps of human drivers in a standing queue [m]"""
    speed_factor_std: NonNegative = 0.1
    """standard deviation of desired speed / speed limit; the mean is 1, and values are limited to 0.8 to 1.2"""
    vehicle_length: Positive = 4.8
    """length of cars [m]"""
    lane_changing: motorway_vehicles.LaneChanging = field(default_factory=motorway_vehicles.LaneChanging)
    """lane changes of human drivers"""
    trucks: motorway_vehicles.Trucks = field(default_factory=motorway_vehicles.Trucks)
    ordinary_acc: motorway_vehicles.OrdinaryACC = field(default_factory=motorway_vehicles.OrdinaryACC)
    """cars with an ACC that are not CAVs"""
    speed_limit_control: SpeedLimitControl = field(default_factory=SpeedLimitControl)
    """variable speed limits for all vehicles upstream of each ramp"""
    ramp_meter: RampMeter = field(default_factory=RampMeter)
    """ramp meters at all ramps"""
    roadside: RoadsideSettings = field(default_factory=RoadsideSettings)
    """latency and smoothing of the speeds of traffic ahead that CAVs receive"""
    simulation_step: SimulationStep = 0.5
    steps_per_control_step: PositiveInt = 2
    horizon: Horizon = 2400
    """control steps in an episode"""
    action_limit: Positive = 2.5
    actuation: Actuation = "cruise"
    safety: SafetyFilter = field(default_factory=lambda: SafetyFilter(active=False))
    """inactive: the CAV's own ACC keeps the distance to the leader"""
    noise: Annotated[float, Field(ge=0, le=0)] = 0.0
    """always 0: the car-following model has its own noise"""
    emission_class: str = "HBEFA4/PC_petrol_Euro-6d"

    @model_validator(mode="after")
    def _check_settings(self) -> Self:
        motorway_vehicles.check_intervals(self, "time_headways", "accelerations", "decelerations", "minimum_gaps")
        begin, end = self.peak
        if not 0 <= begin <= end:
            raise ValueError(f"peak: ({begin:g}, {end:g}) is not allowed; allowed: 0 <= begin <= end")
        if self.peak_rise > self.peak[0]:
            allowed = f"<= {self.peak[0]:g}, before the peak"
            raise ValueError(f"peak_rise: {self.peak_rise:g} is not allowed; allowed: {allowed}")
        capacity = 3600.0 * self.lanes / max(self.min_entry_headway, 1e-9)
        entrances = (
            ("", self, capacity, ", by min_entry_headway"),
            *((f"ramps.{index}.", ramp, 3600.0 / MIN_RAMP_HEADWAY, "") for index, ramp in enumerate(self.ramps)),
        )
        for prefix, entrance, max_flow, reason in entrances:
            for name in ("inflow", "off_peak_inflow"):
                if (flow := getattr(entrance, name)) >= max_flow:
                    raise ValueError(f"{prefix}{name}: {flow:g} is not allowed; allowed: < {max_flow:.0f}{reason}")
        if (shares := self.trucks.share + self.ordinary_acc.share) > 1:
            raise ValueError(f"trucks.share + ordinary_acc.share: {shares:g} is not allowed; allowed: <= 1")
        self._check_ramps()
        self.check_native_humans("on a motorway")
        return self

    def _check_ramps(self) -> None:
        """Raise `ValueError` if ramps overlap or reach beyond the road, or if vehicles enter a ramp too fast."""
        upstream_end, upstream_section = 0.0, "the entrance"
        for index, ramp in enumerate(self.ramps):
            geometry, name, position = ramp.geometry, f"ramps.{index}", f"{ramp.position:g}"
            if geometry.start < upstream_end:
                allowed = f">= {upstream_end + ramp.length:g}, its length downstream of {upstream_section}"
                raise ValueError(f"{name}.position: {position} is not allowed; allowed: {allowed}")
            if geometry.merge_end > self.length - MIN_END_LENGTH:
                allowed = f"<= {self.length - MIN_END_LENGTH - ramp.merging_length:g}, upstream of the end of the road"
                raise ValueError(f"{name}.position: {position} is not allowed; allowed: {allowed}")
            if ramp.entry_speed != "last" and ramp.entry_speed > (
                max_speed := SPEED_FACTOR_RANGE[0] * ramp.speed_limit
            ):
                allowed = f"<= {max_speed:g}, the speed of the slowest drivers"
                raise ValueError(f"{name}.entry_speed: {ramp.entry_speed:g} is not allowed; allowed: {allowed}")
            upstream_end, upstream_section = geometry.merge_end, f"the merging section of {name}"

    @property
    def max_vehicles(self) -> float:
        """Twice the number of vehicles that the largest demand has on average, because headways are random."""
        peak_inflow = sum(max(entrance.inflow, entrance.off_peak_inflow) for entrance in self._entrances)
        return self.max_duration / 3600.0 * 2.0 * peak_inflow

    @property
    def _entrances(self) -> tuple["Motorway | Ramp", ...]:
        return self, *self.ramps

    def draw(self, generator: np.random.Generator) -> MotorwayRoad:
        """Return the road with its demand; human drivers, entry times and the choice of CAVs are random."""
        types, draw_type = self._draw_types(generator)
        entries, draws = list[Entry](), dict[str, float]()
        for index, (time, route, lane, speed) in enumerate(sorted(self._arrivals(generator))):
            name, human_type = f"vehicle_{index}", f"human_type_{generator.integers(HUMAN_TYPE_COUNT)}"
            draws[name] = generator.random()
            entries.append(Entry(name, route, 0.0, speed, time, lane, draw_type(human_type)))
        cars = {entry.name: draws[entry.name] for entry in entries if types[entry.vehicle_type].vehicle_class is None}
        geometry = self.geometry
        return MotorwayRoad(
            geometry=geometry,
            network=geometry.network,
            routes=geometry.routes,
            entries=tuple(entries),
            limit_speed=self.speed_limit,
            merge_positions=tuple(ramp.merge_start - geometry.origin for ramp in geometry.ramps),
            vehicle_types=types,
            cav_ids=self._select_cavs(cars),
            peak=self.peak,
            free_flow_time=self.free_flow_time,
            roadside=self.roadside,
        )

    @property
    def geometry(self) -> MotorwayGeometry:
        """The geometry of the road, which all simulators read."""
        ramps = tuple(ramp.geometry for ramp in self.ramps)
        return MotorwayGeometry(self.length, self.speed_limit, self.lanes, self.vehicle_length, ramps)

    @property
    def free_flow_time(self) -> float:
        """Mean travel time of human drivers in free flow [s]: as measured, or at speed limits with off-peak demand."""
        geometry = self.geometry
        if measured_time := FREE_FLOW_TIMES.get(geometry._replace(vehicle_length=0.0)):
            return measured_time
        times, flows = [self.length / self.speed_limit], [self.off_peak_inflow]
        for ramp in self.ramps:
            times.append(ramp.length / ramp.speed_limit + (self.length - ramp.position) / self.speed_limit)
            flows.append(ramp.off_peak_inflow)
        return float(np.average(times, weights=flows if sum(flows) else None))

    @property
    def provided_fields(self) -> tuple[str, ...]:
        """Optional fields of a `LocalState` that this road provides, given its ramps and roadside information."""
        to_merge = ("distance_to_merge",) if self.ramps else ()
        ahead = () if self.roadside.source == "none" else ("lane_speeds", "road_speeds")
        return ("allowed_speed", *to_merge, *ahead, "adjacent_gaps", "adjacent_speeds", "penetration_rate")

    def _select_cavs(self, draws: dict[str, float]) -> frozenset[str]:
        if self.cavs is None:
            return frozenset(name for name, draw in draws.items() if draw < self.penetration_rate)
        candidates = sorted(list(draws)[: len(draws) // 2], key=draws.__getitem__)
        return frozenset(candidates[: self.cavs])

    def _draw_types(self, generator: np.random.Generator) -> tuple[dict[str, VehicleType], Callable[[str], str]]:
        """Return all vehicle types, and a function that draws a vehicle's type: the given one, a truck or an ACC."""
        (lane_change_generator,) = generator.spawn(1)
        humans = {f"human_type_{index}": self._draw_human_type(generator) for index in range(HUMAN_TYPE_COUNT)}
        lane_changing, trucks, acc = self.lane_changing, self.trucks, self.ordinary_acc
        types = {
            name: human_type._replace(parameters=lane_changing.draw(lane_change_generator))
            for name, human_type in humans.items()
        }
        truck_type_count = motorway_vehicles.TRUCK_TYPE_COUNT if trucks.share else 0
        truck_types = [f"truck_type_{index}" for index in range(truck_type_count)]
        if acc.share:
            types |= {_acc_type(name): acc.replace_driver(types[name]) for name in humans}
        types |= {name: trucks.draw(lane_change_generator, self.car_following, lane_changing) for name in truck_types}

        def draw_type(human_type: str) -> str:
            draw = lane_change_generator.random()
            if draw < trucks.share:
                return truck_types[lane_change_generator.integers(motorway_vehicles.TRUCK_TYPE_COUNT)]
            return _acc_type(human_type) if draw < trucks.share + acc.share else human_type

        return types, draw_type

    def _draw_human_type(self, generator: np.random.Generator) -> VehicleType:
        human = VehicleType(
            model=self.car_following,
            time_headway=motorway_vehicles.draw_uniform(generator, self.time_headways),
            acceleration=motorway_vehicles.draw_uniform(generator, self.accelerations),
            deceleration=motorway_vehicles.draw_uniform(generator, self.decelerations),
            minimum_gap=motorway_vehicles.draw_uniform(generator, self.minimum_gaps),
            speed_factor=round(float(np.clip(generator.normal(1.0, self.speed_factor_std), *SPEED_FACTOR_RANGE)), 4),
            length=self.vehicle_length,
        )
        if self.driver_population is None:
            return human
        (driver,) = self.driver_population.draw(1, generator)
        # The desired speed is not replaced: recordings of jams do not contain it.
        human = human._replace(model="IDM", time_headway=driver.time_headway, minimum_gap=driver.minimum_gap)
        return human._replace(acceleration=driver.max_acceleration, deceleration=driver.comfortable_deceleration)

    def _arrivals(self, generator: np.random.Generator) -> Iterator[Arrival]:
        """Yield the arrivals of vehicles, lane by lane and ramp by ramp."""
        for lane in range(self.lanes):
            flows = self.off_peak_inflow / self.lanes, self.inflow / self.lanes
            for time in self._entry_times(generator, *flows, self.min_entry_headway):
                yield time, MAIN_ROUTE, lane, "last"
        for ramp, route in zip(self.ramps, self.geometry.route_names[1:], strict=True):
            for time in self._entry_times(generator, ramp.off_peak_inflow, ramp.inflow, MIN_RAMP_HEADWAY):
                yield time, route, 0, ramp.entry_speed

    def _entry_times(
        self, generator: np.random.Generator, off_peak: float, peak: float, min_headway: float
    ) -> Iterator[float]:
        """Yield entry times [s] with shifted exponential headways; flows in veh/h, `min_headway` in s."""
        begin = 0.0
        for end, flow in self._demand_periods(off_peak, peak):
            time = begin
            while flow:
                time += min_headway + float(generator.exponential(3600.0 / flow - min_headway))
                if time >= min(end, self.max_duration):
                    break
                yield round(time, 2)
            begin = max(begin, end)

    def _demand_periods(self, off_peak: float, peak: float) -> Iterator[tuple[float, float]]:
        """Yield the end of each period [s] and its flow [veh/h]."""
        step_count = int(self.peak_rise // DEMAND_STEP)
        flows = [off_peak + (peak - off_peak) * (index + 0.5) / step_count for index in range(step_count)]
        begin, end = self.peak[0] - step_count * DEMAND_STEP, self.peak[1]
        yield begin, off_peak
        yield from ((begin + (index + 1) * DEMAND_STEP, flow) for index, flow in enumerate(flows))
        yield end, peak
        yield from ((end + (index + 1) * DEMAND_STEP, flow) for index, flow in enumerate(flows[::-1]))
        yield self.max_duration, off_peak

    @property
    def top_speed(self) -> float:
        """The speed limit of the motorway [m/s]."""
        return self.speed_limit

    @property
    def human_description(self) -> str:
        """The model of the human drivers, as one phrase."""
        model = f"as {self.population_description}" if self.driver_population else self.car_following
        return f"{HUMAN_TYPE_COUNT} different human drivers, {model}, with SUMO's lane changes"

    def possible_cav_ids(self) -> tuple[str, ...]:
        """Return the ids of all vehicles: each can be a CAV."""
        return tuple(f"vehicle_{index}" for index in range(int(self.max_vehicles)))

    def _summary_texts(self) -> tuple[str, str, str, str]:
        lanes = "one lane" if self.lanes == 1 else f"{self.lanes} lanes"
        ramps = {0: "without ramps", 1: "with a ramp"}.get(len(self.ramps), f"with {len(self.ramps)} ramps")
        peak, off_peak = (
            " + ".join(f"{getattr(entrance, name):g}" for entrance in self._entrances)
            for name in ("inflow", "off_peak_inflow")
        )
        peak = f"{peak} veh/h from {self.peak[0]:g} to {self.peak[1]:g} s"
        vehicles = f"{peak}, else {off_peak} ({100 * self.penetration_rate:g} % CAV)"
        road = f"motorway of {self.length / 1000:g} km, {lanes}, {ramps}"
        return road, vehicles, f"{self.speed_limit:.2f} m/s", "the speed limit of the motorway"


def _acc_type(human_type: str) -> str:
    return f"acc_{human_type}"


ON_RAMP = Motorway(ramps=(Ramp(position=2000.0),))
_ON_RAMP_1 = replace(
    ON_RAMP,
    lanes=1,
    inflow=1400.0,
    off_peak_inflow=900.0,
    ramps=(Ramp(position=2000.0, inflow=350.0, off_peak_inflow=125.0),),
)
MOTORWAY_SCENARIOS = {
    "on-ramp": ON_RAMP,
    "on-ramp-1": _ON_RAMP_1,
    "on-ramp-steady": replace(ON_RAMP, peak=(300.0, 2400.0)),
    "two-ramps": replace(
        ON_RAMP,
        length=4500.0,
        inflow=2900.0,
        off_peak_inflow=1600.0,
        ramps=(Ramp(position=2000.0, inflow=400.0), Ramp(position=3500.0, inflow=400.0)),
    ),
}
"""built-in motorways by name"""
FREE_FLOW_TIMES = {
    motorway.geometry._replace(vehicle_length=0.0): time for motorway, time in ((_ON_RAMP_1, 113.0), (ON_RAMP, 106.6))
}
"""measured mean travel times in human-only traffic without a peak, six seeds [s], by geometry"""
