"""Control by the road operator at on-ramps: variable speed limits and ramp meters, for all vehicles."""

from unjam.parameters import STRICT, NonNegative, Positive, Subclassable, parameter_dataclass

LIMIT_STEP = 10.0 / 3.6
"""step of posted speed limits, 10 km/h [m/s]"""
MEASURED_DOWNSTREAM = 200.0
"""length downstream of a merging section in which density is measured, in addition to the section [m]"""


@parameter_dataclass(frozen=True, config=STRICT)
class SpeedLimitControl(Subclassable):
    """A variable speed limit upstream of a merging section, which all vehicles obey.

    Integral control of the density, mainstream traffic flow control as in Carlson, Papamichail and Papageorgiou 2011,
    IEEE Trans. Intell. Transp. Syst. 12:1261-1276. Vehicles accelerate again before they reach the merging section.
    If several limits, or a limit and the cap of a CAV, apply to a vehicle, the lowest one holds.
    """

    active: bool = False
    target_density: Positive = 24.0
    """target of the density control [veh/km per lane]"""
    gain: NonNegative = 0.02
    """change of the limit relative to the unlimited speed in each interval, per veh/km of deviation"""
    min_limit: Positive = 11.12
    """lowest posted speed limit [m/s]"""
    interval: Positive = 30.0
    """time between two changes of the limits [s]"""
    length: Positive = 1500.0
    """length of the section with the limit [m]"""
    acceleration_length: NonNegative = 500.0
    """distance between the end of this section and the merging section [m]"""

    def next_share(self, share: float, density: float, speed_limit: float) -> float:
        """Return the next limit / unlimited speed, given the previous one and the density [veh/km per lane]."""
        return min(1.0, max(self.min_limit / speed_limit, share + self.gain * (self.target_density - density)))

    def posted_limit(self, share: float, speed_limit: float) -> float:
        """Return the posted limit at a share of the unlimited speed limit [m/s]."""
        return min(speed_limit, max(self.min_limit, round(share * speed_limit / LIMIT_STEP) * LIMIT_STEP))


@parameter_dataclass(frozen=True, config=STRICT)
class RampMeter(Subclassable):
    """A ramp meter, which lets vehicles pass one by one, controlled by ALINEA with density as its input.

    The meter is off at its highest rate, which also applies while the queue is close to the entrance of the ramp.
    Papageorgiou, Hadj-Salem and Blosseville 1991, Transp. Res. Rec. 1320:58-64.
    """

    active: bool = False
    target_density: Positive = 24.0
    """target of the density control [veh/km per lane]"""
    gain: NonNegative = 20.0
    """change of the rate in each interval, per veh/km of deviation [veh/h]"""
    rates: tuple[Positive, Positive] = (240.0, 1200.0)
    """lowest and highest rate [veh/h]"""
    interval: Positive = 30.0
    """time between two changes of the rate [s]"""
    distance_to_merge: Positive = 100.0
    """distance from the stop line to the merging section [m]"""

    def next_rate(self, rate: float, density: float) -> float:
        """Return the next rate, given the previous one [veh/h] and the density [veh/km per lane]."""
        lowest, highest = self.rates
        return min(highest, max(lowest, rate + self.gain * (self.target_density - density)))
