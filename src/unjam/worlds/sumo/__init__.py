"""The actual environment: SUMO. The only room that knows its files and its speed modes."""

from collections.abc import Collection, Sequence
from typing import Any

from unjam.scenarios.road import ClosedRoad, MergingRoad, MotorwayRoad, OwnRoad, Road
from unjam.scenarios.scenario import Scenario
from unjam.worlds.sumo.closed import ClosedTraffic
from unjam.worlds.sumo.merging import MergingTraffic
from unjam.worlds.sumo.motorway import MotorwayTraffic
from unjam.worlds.sumo.own import OwnTraffic
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.traffic import Seed, Traffic

KINDS: dict[type[Road], Any] = {
    ClosedRoad: ClosedTraffic,
    MergingRoad: MergingTraffic,
    MotorwayRoad: MotorwayTraffic,
    OwnRoad: OwnTraffic,
}
"""the traffic of each kind of road"""


def make_traffic(
    scenario: Scenario,
    seed: Sequence[int],
    simulation: Simulation,
    plain_numbers: bool = False,
    full: bool = False,
    asked: Collection[str] = (),
) -> Traffic:
    """Put the vehicles of `seed` on the road; nothing moves yet.

    With `plain_numbers`, a single CAV on a closed road perceives and is driven in floats instead of arrays
    of one row. With `full`, fuel is recorded, and on roads with ends where on the plane vehicles are. On a
    network of the user's own CAVs are told of the road ahead where `asked` has that field of `LocalState`.
    """
    road, seeds = scenario.of_seed(seed)
    traffic = KINDS[type(road)](scenario, road, Seed(tuple(seed), seeds), simulation, full)
    traffic.asked = asked
    traffic.single = plain_numbers and isinstance(traffic, ClosedTraffic) and traffic.rows == 1
    return traffic
