"""Vehicles on a motorway that are not CAVs: lane changes of human drivers, trucks, and cars with an ordinary ACC."""

from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from unjam.parameters import STRICT, NonNegative, Positive, Subclassable, parameter_dataclass
from unjam.scenarios.road import VehicleType

Interval = Annotated[tuple[float, float], Field(min_length=2, max_length=2)]
Share = Annotated[float, Field(ge=0, le=1)]
Cooperation = Annotated[float, Field(ge=-1, le=1)]
TRUCK_TYPE_COUNT = 50
"""number of different types of trucks"""
LC2013_NAMES = {
    "cooperation": "lcCooperative",
    "speed_cooperation": "lcCooperativeSpeed",
    "assertiveness": "lcAssertive",
    "speed_gain": "lcSpeedGain",
    "keep_right": "lcKeepRight",
    "overtaking_right": "lcOvertakeRight",
}
"""SUMO's names of the settings of `LaneChanging`"""


def check_intervals(settings: object, *names: str) -> None:
    """Raise `ValueError` unless the ranges in the named settings have 0 < low <= high."""
    for name in names:
        low, high = getattr(settings, name)
        if not 0 < low <= high:
            raise ValueError(f"{name}: ({low:g}, {high:g}) is not allowed; allowed: 0 < low <= high")


def draw_uniform(generator: np.random.Generator, interval: tuple[float, float]) -> float:
    """Return a uniform random value of a range, rounded to four decimal places."""
    return round(float(generator.uniform(*interval)), 4)


@parameter_dataclass(frozen=True, config=STRICT)
class LaneChanging(Subclassable):
    """Lane changes of human drivers: ranges of uniform parameters of SUMO's model LC2013; None: SUMO's default.

    A CAV has the parameters of the human driver that it replaces, except those that `cruise` sets. Source:
    https://sumo.dlr.de/docs/Definition_of_Vehicles,_Vehicle_Types,_and_Routes.html#lane-changing_models
    """

    cooperation: tuple[Cooperation, Cooperation] | None = None
    """willingness to change lanes and to slow down for other vehicles, 0 to 1; default 1"""
    speed_cooperation: tuple[Cooperation, Cooperation] | None = None
    """factor of speed changes for other vehicles, 0 to 1; None: `cooperation`"""
    assertiveness: tuple[Positive, Positive] | None = None
    """divisor of the required gaps; default 1"""
    speed_gain: tuple[NonNegative, NonNegative] | None = None
    """eagerness to change lanes for a higher speed; default 1"""
    keep_right: tuple[NonNegative, NonNegative] | None = None
    """eagerness to keep right; default 1"""
    overtaking_right: tuple[Share, Share] | None = None
    """probability of overtaking on the right; default 0"""
    uncooperative_share: Share = 0.0
    """share of drivers that neither change lanes nor slow down for other vehicles"""

    @model_validator(mode="after")
    def _check_intervals(self) -> "LaneChanging":
        for name in LC2013_NAMES:
            low, high = getattr(self, name) or (0.0, 0.0)
            if low > high:
                raise ValueError(f"{name}: ({low:g}, {high:g}) is not allowed; allowed: low <= high")
        return self

    def draw(self, generator: np.random.Generator) -> tuple[tuple[str, float], ...]:
        """Return the parameters of one driver that differ from SUMO's defaults, by SUMO's names."""
        intervals = {name: getattr(self, key) for key, name in LC2013_NAMES.items()}
        parameters = {
            name: draw_uniform(generator, interval) for name, interval in intervals.items() if interval is not None
        }
        if self.uncooperative_share and generator.random() < self.uncooperative_share:
            parameters |= {LC2013_NAMES["cooperation"]: 0.0, LC2013_NAMES["speed_cooperation"]: 0.0}
        return tuple(parameters.items())


@parameter_dataclass(frozen=True, config=STRICT)
class Trucks(Subclassable):
    """Trucks, which never become CAVs."""

    share: Share = 0.0
    """share of all vehicles"""
    length: Positive = 16.0
    """length of trucks [m]"""
    desired_speeds: Interval = (22.8, 24.7)
    """range of the desired speeds of drivers [m/s]; speed limiters in the European Union allow 25 m/s"""
    time_headways: Interval = (1.5, 2.2)
    """range of the time headways of drivers [s]"""
    accelerations: Interval = (0.5, 0.8)
    """range of maximum accelerations [m/s2]"""
    decelerations: Interval = (1.5, 2.0)
    """range of comfortable decelerations [m/s2]"""
    minimum_gaps: Interval = (2.5, 4.0)
    """range of the gaps in a standing queue [m]"""
    emission_class: str = "HBEFA4/TT_AT_gt34-40t_Euro-VI_A-C"

    @model_validator(mode="after")
    def _check_intervals(self) -> "Trucks":
        check_intervals(self, "desired_speeds", "time_headways", "accelerations", "decelerations", "minimum_gaps")
        return self

    def draw(self, generator: np.random.Generator, model: str, lane_changing: LaneChanging) -> VehicleType:
        """Return a type of truck; its drivers change lanes as drivers of cars do, but not for a higher speed."""
        parameters = dict(lane_changing.draw(generator)) | {LC2013_NAMES["speed_gain"]: 0.0}
        return VehicleType(
            model=model,
            time_headway=draw_uniform(generator, self.time_headways),
            acceleration=draw_uniform(generator, self.accelerations),
            deceleration=draw_uniform(generator, self.decelerations),
            minimum_gap=draw_uniform(generator, self.minimum_gaps),
            speed_factor=1.0,
            length=self.length,
            max_speed=draw_uniform(generator, self.desired_speeds),
            vehicle_class="truck",
            emission_class=self.emission_class,
            parameters=tuple(parameters.items()),
        )


@parameter_dataclass(frozen=True, config=STRICT)
class OrdinaryACC(Subclassable):
    """Cars that an ordinary ACC drives; human drivers change their lanes and choose the desired speed."""

    share: Share = 0.0
    """share of all vehicles"""
    time_gap: Positive = 1.6
    """time gap behind the leader [s]"""
    acceleration: Positive = 1.0
    """maximum acceleration [m/s2]"""
    deceleration: Positive = 2.0
    """comfortable deceleration [m/s2]"""

    def replace_driver(self, human: VehicleType) -> VehicleType:
        """Return the vehicle type of a human driver with the ACC, an IDM, in place of the driver."""
        return human._replace(
            model="IDM", time_headway=self.time_gap, acceleration=self.acceleration, deceleration=self.deceleration
        )
