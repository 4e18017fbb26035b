"""What a road operator does at on-ramps, for all vehicles: variable speed limits and ramp meters control a density."""

from unjam.parameters import STRICT, NonNegative, Positive, Subclassable, parameter_dataclass

LIMIT_STEP = 10.0 / 3.6
"""speed limits are multiples of 10 km/h [m/s]"""
MEASURED_DOWNSTREAM = 200.0
"""the density is that from the begin of the merging section to this far downstream of its end [m]"""


@parameter_dataclass(frozen=True, config=STRICT)
class SpeedLimitControl(Subclassable):
    """A variable speed limit for all vehicles upstream of a merging section, which all of them obey.

    Integral control of the density, mainstream traffic flow control as in Carlson, Papamichail and Papageorgiou 2011,
    IEEE Trans. Intell. Transp. Syst. 12:1261-1276. Vehicles accelerate again before they reach the merging section.
    If several limits or the cap of a CAV apply to a vehicle, the lowest of them holds.
    """

    active: bool = False
    target_density: Positive = 24.0
    """density that the limits aim at [veh/km per lane]"""
    gain: NonNegative = 0.02
    """change of limit / unlimited speed in each interval, per veh/km of deviation"""
    min_limit: Positive = 11.12
    """smallest speed limit that is shown [m/s]"""
    interval: Positive = 30.0
    """time between two changes of the limits [s]"""
    length: Positive = 1500.0
    """length of the road with the limit [m]"""
    acceleration_length: NonNegative = 500.0
    """length between its end and the merging section [m]"""

    def next_share(self, share: float, density: float, speed_limit: float) -> float:
        """Return the next share of the unlimited speed, given the last one and the density [veh/km per lane]."""
        return min(1.0, max(self.min_limit / speed_limit, share + self.gain * (self.target_density - density)))

    def limit(self, share: float, speed_limit: float) -> float:
        """Return the limit that signs show [m/s]."""
        return min(speed_limit, max(self.min_limit, round(share * speed_limit / LIMIT_STEP) * LIMIT_STEP))


@parameter_dataclass(frozen=True, config=STRICT)
class RampMeter(Subclassable):
    """A ramp meter, which lets vehicles pass one by one: ALINEA, on density.

    It is off at its highest rate, which it also has while the queue is close to the entrance of the ramp.
    Papageorgiou, Hadj-Salem and Blosseville 1991, Transp. Res. Rec. 1320:58-64.
    """

    active: bool = False
    target_density: Positive = 24.0
    """density that the meters aim at [veh/km per lane]"""
    gain: NonNegative = 20.0
    """change of the rate in each interval, per veh/km of deviation [veh/h]"""
    rates: tuple[Positive, Positive] = (240.0, 1200.0)
    """lowest and highest rate [veh/h]"""
    interval: Positive = 30.0
    """time between two changes of the metered flow [s]"""
    distance_to_merge: Positive = 100.0
    """distance from the stop line to the merging section [m]"""

    def next_rate(self, rate: float, density: float) -> float:
        """Return the next rate, given the last one [veh/h] and the density [veh/km per lane]."""
        lowest, highest = self.rates
        return min(highest, max(lowest, rate + self.gain * (self.target_density - density)))
