"""The actual environment: SUMO. The only room that knows its files and its speed modes."""

from collections.abc import Collection, Sequence
from typing import Any

from unjam.scenarios.road import ClosedRoad, MergeRoad, MotorwayRoad, Road, UserNetworkRoad
from unjam.scenarios.scenario import Scenario
from unjam.worlds.sumo.closed_road import ClosedTraffic
from unjam.worlds.sumo.merge_road import MergingTraffic
from unjam.worlds.sumo.motorway import MotorwayTraffic
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.traffic import SeedTree, Traffic
from unjam.worlds.sumo.user_network import UserNetworkTraffic

TRAFFIC_CLASSES: dict[type[Road], Any] = {
    ClosedRoad: ClosedTraffic,
    MergeRoad: MergingTraffic,
    MotorwayRoad: MotorwayTraffic,
    UserNetworkRoad: UserNetworkTraffic,
}
"""the traffic of each kind of road"""


def make_traffic(
    scenario: Scenario,
    seed: Sequence[int],
    simulation: Simulation,
    is_scalar: bool = False,
    record_details: bool = False,
    measured_fields: Collection[str] = (),
) -> Traffic:
    """Put the vehicles of `seed` on the road; nothing moves yet.

    With `accepts_floats`, a single CAV on a closed road perceives and is driven in floats instead of arrays
    of one row. With `record_details`, fuel is recorded, and on roads with ends where on the plane vehicles are. On a
    network of the user's own CAVs are told of the road ahead where `asked` has that field of `LocalState`.
    """
    road, seeds = scenario.draw_from_seed(seed)
    traffic = TRAFFIC_CLASSES[type(road)](scenario, road, SeedTree(tuple(seed), seeds), simulation, record_details)
    traffic.measured_fields = measured_fields
    traffic.is_scalar = is_scalar and isinstance(traffic, ClosedTraffic) and traffic.cav_count == 1
    return traffic
