"""The traffic of one episode, whatever the kind of its road."""

from collections.abc import Sequence

import numpy as np

from unjam.scenarios.road import ClosedRoad, MergingRoad, OwnRoad
from unjam.scenarios.scenario import Scenario
from unjam.worlds.sumo.closed import ClosedTraffic
from unjam.worlds.sumo.merging import MergingTraffic
from unjam.worlds.sumo.own import OwnTraffic
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.traffic import Traffic


def make_traffic(
    scenario: Scenario,
    seed: Sequence[int],
    simulation: Simulation,
    plain_numbers: bool = False,
    full: bool = False,
) -> Traffic:
    """Put the vehicles of `seed` on the road; nothing moves yet.

    With `plain_numbers`, a single CAV on a closed road perceives and is driven in floats instead of arrays
    of one row. With `full`, fuel is recorded, and on roads with ends where on the plane vehicles are.
    """
    road_seed, *seeds = np.random.SeedSequence(list(seed)).spawn(4)
    road = scenario.draw(np.random.default_rng(road_seed))
    if isinstance(road, ClosedRoad):
        return ClosedTraffic(scenario, road, seeds, simulation, plain_numbers, full)
    if isinstance(road, MergingRoad):
        return MergingTraffic(scenario, road, seeds, simulation, full)
    if isinstance(road, OwnRoad):
        return OwnTraffic(scenario, road, seeds, simulation, full)
    raise TypeError(f"no traffic for {type(road).__name__}")
