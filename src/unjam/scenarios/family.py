"""Groups of roads of the family, as scenarios."""

from unjam.drivers.wrappers import MIN_SHARED_PENETRATION_RATE
from unjam.road_family import (
    ALL_ROADS_GROUP,
    FAMILY,
    FAMILY_PREFIX,
    GROUP_BY_SCENARIO,
    SHARED_RINGS_GROUP,
    FamilyPart,
    FamilyRoad,
)
from unjam.scenarios import make_scenario
from unjam.scenarios.scenario import Scenario


def family_roads(group: str) -> dict[str, FamilyRoad]:
    """Return all roads of a group, one of `ROAD_GROUPS`, by name."""
    if group == SHARED_RINGS_GROUP:
        rings, limit = family_roads(GROUP_BY_SCENARIO["ring"]), MIN_SHARED_PENETRATION_RATE
        return {name: ring for name, ring in rings.items() if ring.options["cavs"] >= limit * ring.options["vehicles"]}
    groups = {name: (GROUP_BY_SCENARIO[road.scenario], ALL_ROADS_GROUP) for name, road in FAMILY.items()}
    return {name: road for name, road in FAMILY.items() if group in groups[name]}


def family_scenarios(group: str, *parts: FamilyPart) -> dict[str, Scenario]:
    """Return the scenarios of some parts of a group, one of `ROAD_GROUPS`, by name."""
    names = (name for name, road in family_roads(group).items() if road.part in parts)
    return {name: make_scenario(f"{FAMILY_PREFIX}{name}") for name in names}
