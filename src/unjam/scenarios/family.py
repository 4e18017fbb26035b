"""Groups of roads of the family, as scenarios."""

from typing import Any

from unjam import road_family
from unjam.drivers.wrappers import MIN_SHARED_PENETRATION_RATE
from unjam.scenarios import make_scenario
from unjam.scenarios.scenario import Scenario


def family_roads(group: str) -> dict[str, road_family.FamilyRoad]:
    """Return all roads of a group, one of `ROAD_GROUPS`, by name."""
    if group == road_family.SHARED_RINGS_GROUP:
        rings, min_rate = family_roads(road_family.GROUP_BY_SCENARIO["ring"]), MIN_SHARED_PENETRATION_RATE
        return {
            name: ring for name, ring in rings.items() if ring.options["cavs"] >= min_rate * ring.options["vehicles"]
        }
    if group == road_family.ALL_ROADS_GROUP:
        return dict(road_family.FAMILY)
    roads, group_by_scenario = road_family.FAMILY, road_family.GROUP_BY_SCENARIO
    return {name: road for name, road in roads.items() if group_by_scenario[road.scenario] == group}


def family_scenarios(
    group: str, *parts: road_family.FamilyPart, changes: dict[str, Any] | None = None
) -> dict[str, Scenario]:
    """Return scenarios with `changes` for the roads of a group that are in `parts` of the family, by road name."""
    names = (name for name, road in family_roads(group).items() if road.part in parts)
    return {name: make_scenario(f"{road_family.FAMILY_PREFIX}{name}", changes) for name in names}
