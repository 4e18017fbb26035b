"""What SUMO reads of an episode: the network, who drives how, and who enters."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from unjam.physics.idm import IDMParameters
from unjam.scenarios.road import BuiltRoad, MotorwayRoad, Road, UserNetworkRoad
from unjam.scenarios.scenario import MIN_CAV_GAP, SUMO_ACCELERATION, UNLIMITED_ACCELERATION, VEHICLE_LENGTH, Scenario
from unjam.scenarios.user_network import PASSENGER_CLASS
from unjam.sumo_files import is_harmless_attribute, is_harmless_parameter
from unjam.worlds.sumo.networks import XMLAttributes, network_file, xml_element

SUMO_CAV_COLOR = "215,38,61"
"""red, in SUMO's window"""
CAV_TYPE_TEMPLATE = "cav_of_{}"
"""the type of a CAV whose own type is `{}`"""
CALIBRATED_TYPE_TEMPLATE = "{}_of_driver_{}"
"""the type of a car whose own type is `{}`, driven by a calibrated person of that number"""
CAR_FOLLOWING_ATTRIBUTES = {"carFollowModel", "tau", "minGap", "sigma", "delta", "stepping"}
"""attributes of a vehicle type that are its car-following law's: a CAV keeps all others"""
COLLISION_OPTIONS = (
    *("--collision.action", "warn", "--collision.mingap-factor", "0"),
    *("--collision.check-junctions", "true"),
)
"""on built-in roads a collision is real contact, and each is reported; users' networks have own settings"""


class SumoInputs(NamedTuple):
    """What SUMO reads of an episode."""

    options: tuple[str, ...]
    """that say how to simulate"""
    existing_files: dict[str, tuple[Path, ...]]
    """the network, and what else is there already, by the option that names it"""
    traffic_xml: str
    """XML of vehicle types, and of routes and vehicles where they are not the user's"""
    traffic_option: str
    """by which SUMO takes the traffic"""
    copied_files: Mapping[Path, tuple[Path, ...]] = MappingProxyType({})
    """files that SUMO must not read themselves, but in a harmless copy; and what the copy is made from"""
    records_trips: bool = False
    """whether SUMO records all trips: see `Simulation.end_with_trips`"""


def sumo_inputs(scenario: Scenario, road: Road) -> SumoInputs:
    """Return what SUMO reads of a road: one that is built for the episode, or the user's own network."""
    if isinstance(road, UserNetworkRoad):
        return _user_network_inputs(scenario, road)
    assert isinstance(road, BuiltRoad)
    # Vehicles neither vanish from a jam nor give up waiting to enter.
    patience = ("--time-to-teleport", "-1", "--max-depart-delay", "-1")
    network = {"--net-file": (network_file(road.network),)}
    return SumoInputs((*patience, *COLLISION_OPTIONS), network, _traffic_xml(scenario, road), "--route-files")


def _user_network_inputs(scenario: Scenario, road: UserNetworkRoad) -> SumoInputs:
    """Return what SUMO reads of the user's own network: never its configuration itself."""
    files = road.files
    # Who has waited long to enter must not vanish: he is among those whose time is counted.
    options = ["--max-depart-delay=-1", *(f"--{name}={value}" for name, value in files.options.items())]
    # Validation would fetch the schemas that the files name.
    options += [f"--xml-validation{what}=never" for what in ("", ".net", ".routes")]
    named = {
        "--net-file": (files.network,),
        "--additional-files": files.additional_files,
        "--route-files": files.route_files,
        "--weight-files": files.weight_files,
    }
    traffic = _user_network_types_xml(scenario, road)
    return SumoInputs(tuple(options), named, traffic, "--additional-files", files.copy_sources, records_trips=True)


def _traffic_xml(scenario: Scenario, road: BuiltRoad) -> str:
    """Return the XML of types, routes and vehicles of an episode."""
    own = road.human_parameters if scenario.human_control == "native" else {}
    if isinstance(road, MotorwayRoad):
        lines = _motorway_types_xml(scenario, road)
    else:
        humans = {"human": scenario.humans, **{f"of_{name}": one for name, one in own.items()}}
        lines = [_vehicle_type_xml(name, scenario, **_human_attributes(scenario, one)) for name, one in humans.items()]
        lines.append(_cav_type_xml(scenario))
    for route in road.routes:
        laps = route.laps if route.laps > 1 else None
        lines.append(xml_element("route", id=route.name, edges=" ".join(route.edges), repeat=laps))
    for entry in road.entries:
        attributes = {
            "id": entry.name,
            "type": entry.vehicle_type or (f"of_{entry.name}" if entry.name in own else "human"),
            # SUMO would not let a driver who keeps a large distance begin closer than that.
            "insertionChecks": "collision" if entry.vehicle_type else "none" if entry.name in own else None,
            "route": entry.route,
            "depart": f"{entry.time:.2f}",
            "departPos": "base" if entry.vehicle_type else repr(entry.position),
            "departSpeed": entry.speed,
            "departLane": entry.lane,
        }
        lines.append(xml_element("vehicle", **attributes))
    return "\n".join(["<routes>", *lines, "</routes>"])


def _motorway_types_xml(scenario: Scenario, road: MotorwayRoad) -> list[str]:
    """Return the XML of each person's type, and of the CAV's that may replace him: it wants to be as fast."""
    lines = []
    for name, person in road.vehicle_types.items():
        alike = {"length": road.vehicle_length, "emissionClass": scenario.emission_class}
        alike |= {"speedFactor": person.speed_factor, "speedDev": 0.0, "emergencyDecel": 9.0}
        follows = {
            "carFollowModel": person.model,
            "tau": person.time_headway,
            "accel": person.acceleration,
            "decel": person.deceleration,
            "minGap": person.minimum_gap,
        }
        lines.append(xml_element("vType", id=name, **alike, **follows))
        lines.append(
            xml_element("vType", **{"id": CAV_TYPE_TEMPLATE.format(name), **alike, **_cav_attributes(scenario)})
        )
    return lines


def _user_network_types_xml(scenario: Scenario, road: UserNetworkRoad) -> str:
    """Return the XML of a CAV type for each type that may become one: alike but for the car-following law.

    Each calibrated driver has such a type for each type of passenger cars. SUMO draws a new speed factor for
    a vehicle that gets another type. From these types it draws none, and the vehicle gets its own back.
    """
    layer = {"sigma": 0.0, "delta": IDMParameters().exponent, **_cav_attributes(scenario)}
    if scenario.actuation != "cruise":
        layer["accel"] = None  # no command makes a vehicle accelerate harder than it can
    layer = {key: value for key, value in layer.items() if value is not None}
    files, lines, cavs = road.files, list[str](), road.eligible_types.union(road.cav_types)
    for name, attributes in files.types.items():
        drivers = enumerate(road.drivers if name in road.calibrated_types else ())
        laws = {CALIBRATED_TYPE_TEMPLATE.format(name, number): _idm_attributes(one) for number, one in drivers}
        if name in cavs:
            laws |= {CAV_TYPE_TEMPLATE.format(own): {**law, **layer} for own, law in {name: {}, **laws}.items()}
        for variant, law in laws.items():
            lines.append(_type_variant_xml(variant, attributes, law, files.type_parameters.get(name, {})))
    return "\n".join(["<additional>", *lines, "</additional>"])


def _type_variant_xml(
    name: str, attributes: XMLAttributes, car_following: XMLAttributes, parameters: dict[str, str]
) -> str:
    """Return the XML of a vehicle type like one of the user's that follows by another law."""
    kept = {
        key: value
        for key, value in attributes.items()
        if key not in CAR_FOLLOWING_ATTRIBUTES and is_harmless_attribute(key)
    }
    opened = xml_element("vType", **{**kept, "speedFactor": 1.0, "speedDev": 0.0, **car_following, "id": name})
    nested = "".join(
        xml_element("param", key=key, value=value) for key, value in parameters.items() if is_harmless_parameter(key)
    )
    return f"{opened.removesuffix('/>')}>{nested}</vType>"


def vehicle_class_by_type(road: UserNetworkRoad) -> dict[str, str]:
    """Return the vehicle class of all types that vehicles can have: the user's, and those made of them."""
    made, own = dict[str, str](), dict[str, str]()
    for name, attributes in road.files.types.items():
        own[name] = attributes.get("vClass", PASSENGER_CLASS)
        bases = [name, *(CALIBRATED_TYPE_TEMPLATE.format(name, number) for number in range(len(road.drivers)))]
        made |= dict.fromkeys([*bases, *map(CAV_TYPE_TEMPLATE.format, bases)], own[name])
    return made | own


def _vehicle_type_xml(name: str, scenario: Scenario, **attributes: Any) -> str:
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
    return xml_element("vType", **{**common, **attributes})


def _human_attributes(scenario: Scenario, humans: IDMParameters) -> XMLAttributes:
    """Return how SUMO drives people: its own IDM; under commanded people Flow's layer, quick, with no gap."""
    population = scenario.driver_population
    layer = {**_idm_attributes(humans), "maxSpeed": humans.desired_speed}
    if scenario.human_control == "commanded":
        layer |= {"accel": SUMO_ACCELERATION, "decel": 4.5, "tau": 1.0, "minGap": scenario.sumo_human_gap}
        if population:  # the layer may not hold back who keeps less than a second
            layer |= {"tau": min(1.0, population.min_time_headway), "maxSpeed": population.max_desired_speed}
    return layer


def _idm_attributes(parameters: IDMParameters) -> XMLAttributes:
    """Return how SUMO's own IDM follows as somebody does."""
    return {
        "carFollowModel": "IDM",
        "accel": parameters.max_acceleration,
        "decel": parameters.comfortable_deceleration,
        "tau": parameters.time_headway,
        "delta": parameters.exponent,
        "minGap": parameters.minimum_gap,
    }


def _cav_type_xml(scenario: Scenario) -> str:
    """Return the XML of the CAVs: a type that executes any safe command exactly.

    Where the actuation is Flow's, it is the human type instead; with a gap, or it would creep up until it
    touches.
    """
    if scenario.actuation == "flow":
        layer = _human_attributes(scenario, scenario.humans)
        layer["minGap"] = max(layer["minGap"], MIN_CAV_GAP)
        return _vehicle_type_xml("cav", scenario, color=SUMO_CAV_COLOR, **layer)
    return _vehicle_type_xml("cav", scenario, **_cav_attributes(scenario), maxSpeed=scenario.top_speed)


def _cav_attributes(scenario: Scenario) -> XMLAttributes:
    """Return how a CAV follows in SUMO: as its own ACC does, or as it is told."""
    cruise = scenario.cruise
    if scenario.actuation != "cruise":
        return _exact_tracking_attributes(scenario)
    return {
        "color": SUMO_CAV_COLOR,
        "carFollowModel": "IDM",
        "tau": cruise.time_gap,
        "accel": cruise.acceleration,  # None: as the vehicle has it
        "decel": cruise.deceleration,
        "minGap": cruise.minimum_gap,
    }


def lane_change_parameters(scenario: Scenario) -> dict[str, str]:
    """Return what changes of how a vehicle changes lanes once it is a CAV, by the names of SUMO's LC2013.

    The type that it gets then changes nothing of that. Source:
    https://sumo.dlr.de/docs/Definition_of_Vehicles,_Vehicle_Types,_and_Routes.html#lane-changing_models
    """
    if scenario.actuation != "cruise":
        return {}
    asked = {"lcKeepRight": scenario.cruise.keep_right, "lcSpeedGain": scenario.cruise.speed_gain}
    return {f"laneChangeModel.{name}": str(eagerness) for name, eagerness in asked.items() if eagerness is not None}


def _exact_tracking_attributes(scenario: Scenario) -> XMLAttributes:
    """Return the attributes of a type that executes any safe command exactly.

    With SUMO's safe-speed check on, a Krauss vehicle with a reaction time of one step and a small minimum
    gap is the one that stays out of the way until the command would lead to a crash. Where a filter keeps it
    safe, it has a car's engine and brakes: SUMO only makes it yield, and others expect of it what it can do.
    """
    brakes = scenario.cav_max_braking
    return {
        "color": SUMO_CAV_COLOR,
        "carFollowModel": "Krauss",
        "accel": max(SUMO_ACCELERATION, scenario.acceleration_limits.highest)
        if scenario.safety.active
        else UNLIMITED_ACCELERATION,
        **dict.fromkeys(("decel", "emergencyDecel", "apparentDecel"), brakes),
        "tau": scenario.simulation_step,
        "actionStepLength": scenario.simulation_step,  # whatever the user's types have
        "minGap": MIN_CAV_GAP,
    }
