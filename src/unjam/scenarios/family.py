"""Groups of roads of the family, as scenarios."""

from typing import Any

from unjam import road_family
from unjam.drivers.wrappers import MIN_SHARED_PENETRATION_RATE
from unjam.scenarios import make_scenario
from unjam.scenarios.scenario import Scenario


def family_roads(group: str) -> dict[str, road_family.FamilyRoad]:
    """Return all roads of a group, one of `ROAD_GROUPS`, by name."""
    if group == road_family.SHARED_RINGS_GROUP:
        rings, limit = family_roads(road_family.GROUP_BY_SCENARIO["ring"]), MIN_SHARED_PENETRATION_RATE
        return {name: ring for name, ring in rings.items() if ring.options["cavs"] >= limit * ring.options["vehicles"]}
    roads, every = road_family.FAMILY.items(), road_family.ALL_ROADS_GROUP
    groups = {name: (road_family.GROUP_BY_SCENARIO[road.scenario], every) for name, road in roads}
    return {name: road for name, road in road_family.FAMILY.items() if group in groups[name]}


def family_scenarios(
    group: str, *parts: road_family.FamilyPart, changes: dict[str, Any] | None = None
) -> dict[str, Scenario]:
    """Return the scenarios of some parts of a group, one of `ROAD_GROUPS`, by name, each with the same changes."""
    names = (name for name, road in family_roads(group).items() if road.part in parts)
    return {name: make_scenario(f"{road_family.FAMILY_PREFIX}{name}", changes) for name in names}
