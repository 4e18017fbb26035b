"""The environment in SUMO. Only this package knows SUMO's files and speed modes."""

from collections.abc import Collection, Sequence
from typing import Any

from unjam.errors import InputError
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


def make_traffic(
    scenario: Scenario,
    seed: Sequence[int],
    simulation: Simulation,
    is_scalar: bool = False,
    record_details: bool = False,
    measured_fields: Collection[str] = (),
) -> Traffic:
    """Put the vehicles of a seed on the road; nothing moves yet.

    With `is_scalar`, the state and command of a single CAV on a closed road are floats. With `record_details`, fuel is
    recorded and, on roads with ends, positions (x, y). Optional fields of `LocalState` are measured if requested.
    """
    road, seeds = scenario.draw_from_seed(seed)
    if type(road) not in TRAFFIC_CLASSES:
        allowed = ", ".join(each.__name__ for each in TRAFFIC_CLASSES)
        raise InputError(f"scenario: {type(road).__name__} is not allowed as the road of SUMO; allowed: {allowed}")
    traffic = TRAFFIC_CLASSES[type(road)](scenario, road, SeedTree(tuple(seed), seeds), simulation, record_details)
    traffic.measured_fields = measured_fields
    traffic.is_scalar = is_scalar and isinstance(traffic, ClosedTraffic) and traffic.cav_count == 1
    return traffic
