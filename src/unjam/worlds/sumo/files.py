"""What SUMO reads of an episode: who drives how as vehicle types, routes, and who enters."""

from pathlib import Path
from typing import Any, NamedTuple

from unjam.physics.idm import IDMParameters
from unjam.scenarios.road import BuiltRoad, OwnRoad
from unjam.scenarios.scenario import VEHICLE_LENGTH, Scenario
from unjam.worlds.sumo.network_files import Attributes, element_xml, network_file

SMALLEST_CAV_GAP = 0.5
"""gap that SUMO keeps for a CAV [m]"""
CAV_COLOUR = "215,38,61"
"""red, in SUMO's window"""
OBEDIENT = 20.0
"""accelerations of an obedient CAV's type [m/s2]: far beyond what it asks for, so that only safety clips"""
CAV_TYPES = "cav_of_{}"
"""the type of a CAV whose own type is `{}`"""
KEPT = ("vClass", "length", "width", "height", "maxSpeed", "speedFactor", "guiShape", "emissionClass")
"""attributes of a vehicle type that a CAV takes over, beside those of changing lanes"""


class Files(NamedTuple):
    """What SUMO reads of an episode."""

    options: tuple[str, ...]
    """that name the network, and what else is of the road"""
    traffic: str
    """XML of vehicle types, and of routes and vehicles where they are not the user's"""
    option: str
    """by which SUMO takes the traffic"""
    beside: tuple[Path, ...] = ()
    """files that the same option must name too"""


def files_of_built(scenario: Scenario, road: BuiltRoad) -> Files:
    """Return what SUMO reads of a road that is built for the episode."""
    # Vehicles neither vanish from a jam nor give up waiting to enter.
    patience = ("--time-to-teleport", "-1", "--max-depart-delay", "-1")
    options = ("--net-file", str(network_file(road.network)), *patience)
    return Files(options, _traffic_xml(scenario, road), "--route-files")


def files_of_own(scenario: Scenario, road: OwnRoad) -> Files:
    """Return what SUMO reads of the user's own network: its own words about all that is not named here."""
    options = ("--configuration-file", str(road.files.path), "--verbose", "false")
    traffic = _own_types_xml(scenario, road)
    return Files(options, traffic, "--additional-files", road.files.additional_files)


def _traffic_xml(scenario: Scenario, road: BuiltRoad) -> str:
    """Return the XML of types, routes and vehicles of an episode."""
    own = road.people if scenario.people == "native" else {}
    types = [
        _vehicle_type("human", scenario, **_human_layer(scenario, scenario.humans)),
        *(_vehicle_type(f"of_{name}", scenario, **_human_layer(scenario, one)) for name, one in own.items()),
        _cav_type(scenario),
    ]
    routes = [
        element_xml("route", {"id": route.name, "edges": " ".join(route.edges), "repeat": route.laps})
        if route.laps > 1
        else element_xml("route", {"id": route.name, "edges": " ".join(route.edges)})
        for route in road.routes
    ]
    vehicles = []
    for entry in road.entries:
        attributes: Attributes = {
            "id": entry.name,
            "type": f"of_{entry.name}" if entry.name in own else "human",
        }
        if entry.name in own:  # SUMO would not let a driver who keeps a large distance begin closer than that
            attributes["insertionChecks"] = "none"
        attributes |= {"route": entry.route, "depart": f"{entry.time:.2f}", "departPos": repr(entry.position)}
        vehicles.append(element_xml("vehicle", {**attributes, "departSpeed": entry.speed, "departLane": 0}))
    return "\n".join(["<routes>", *types, *routes, *vehicles, "</routes>"])


def _own_types_xml(scenario: Scenario, road: OwnRoad) -> str:
    """Return the XML of a CAV type beside each of the user's types: as large, but driven by commands."""
    lines = ["<additional>"]
    for name, attributes in road.files.types.items():
        kept = {
            key: value
            for key, value in attributes.items()
            if key in KEPT or key.startswith("lc") or key == "laneChangeModel"
        }
        calm = {"id": CAV_TYPES.format(name), "sigma": 0.0, "speedDev": 0.0}
        lines.append(element_xml("vType", {**kept, **calm, **_obedient_layer(scenario.simulation_step)}))
    return "\n".join([*lines, "</additional>"])


def _vehicle_type(name: str, scenario: Scenario, **attributes: Any) -> str:
    """Return the XML of a vehicle type: SUMO's defaults of chance switched off, the rest as given."""
    common = {
        "id": name,
        "length": VEHICLE_LENGTH,
        "speedFactor": 1.0,
        "speedDev": 0.0,  # without it SUMO draws factors between 0.8 and 1.2
        "sigma": 0.0,
        "impatience": scenario.impatience,
        "emissionClass": scenario.emission_class,
    }
    return element_xml("vType", {**common, **attributes})


def _human_layer(scenario: Scenario, humans: IDMParameters) -> Attributes:
    """Return how SUMO drives people: its own IDM; under commanded people Flow's layer, quick, with no gap."""
    population = scenario.calibrated
    layer = {
        "carFollowModel": "IDM",
        "accel": humans.max_acceleration,
        "decel": humans.comfortable_deceleration,
        "tau": humans.time_headway,
        "delta": humans.exponent,
        "minGap": humans.minimum_gap,
        "maxSpeed": humans.desired_speed,
    }
    if scenario.people == "commanded":
        layer |= {"accel": 2.6, "decel": 4.5, "tau": 1.0, "minGap": scenario.people_gap}
        if population:  # the layer may not hold back who keeps less than a second
            layer |= {"tau": min(1.0, population.quickest), "maxSpeed": population.fastest}
    return layer


def _cav_type(scenario: Scenario) -> str:
    """Return the XML of the CAVs: a type that executes any safe command exactly.

    Where the actuation is Flow's, it is the human type instead; with a gap, or it would creep up until it
    touches.
    """
    if scenario.actuation == "flow":
        layer = _human_layer(scenario, scenario.humans)
        layer["minGap"] = max(layer["minGap"], SMALLEST_CAV_GAP)
        return _vehicle_type("cav", scenario, color=CAV_COLOUR, **layer)
    return _vehicle_type(
        "cav", scenario, **_obedient_layer(scenario.simulation_step), maxSpeed=scenario.top_speed
    )


def _obedient_layer(simulation_step: float) -> Attributes:
    """Return the attributes of a type that executes any safe command exactly.

    With SUMO's safe-speed check on, a Krauss vehicle with a reaction time of one step and a small minimum
    gap is the one that stays out of the way until the command would lead to a crash.
    """
    return {
        "color": CAV_COLOUR,
        "carFollowModel": "Krauss",
        "accel": OBEDIENT,
        "decel": OBEDIENT,
        "emergencyDecel": OBEDIENT,
        "apparentDecel": OBEDIENT,
        "tau": simulation_step,
        "minGap": SMALLEST_CAV_GAP,
    }
