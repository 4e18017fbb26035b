"""The files and options that SUMO reads for an episode: network, vehicle types, vehicles."""

from collections.abc import Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from unjam.physics.idm import IDMParameters
from unjam.scenarios.motorway_road import MotorwayRoad
from unjam.scenarios.road import BuiltRoad, UserNetworkRoad
from unjam.scenarios.scenario import MIN_CAV_GAP, SUMO_ACCELERATION, UNLIMITED_ACCELERATION, VEHICLE_LENGTH, Scenario
from unjam.scenarios.user_network import PASSENGER_CLASS
from unjam.sumo_files import reader
from unjam.worlds.sumo.networks import XMLAttributes, network_file, xml_element

SUMO_CAV_COLOR = "215,38,61"
W99_ACCELERATION = 2.0
"""SUMO's default of `cc8`, the acceleration from a standstill of its model W99 [m/s2]"""
CAR_FOLLOWING_ATTRIBUTES = {"carFollowModel", "tau", "minGap", "sigma", "delta", "stepping"}
"""attributes of a vehicle type that belong to its car-following model: a CAV keeps all others"""
COLLISION_OPTIONS = ("--collision.mingap-factor", "0", "--collision.check-junctions", "true")
"""options of built-in roads, where a collision is physical contact and each is reported; users' networks have their own
settings"""


class SumoInputs(NamedTuple):
    """What SUMO reads for an episode."""

    options: tuple[str, ...]
    existing_files: dict[str, tuple[Path, ...]]
    """the network and other existing files, by the option that names them"""
    traffic_xml: str
    """XML of vehicle types, and of routes and vehicles unless they are the user's"""
    traffic_option: str
    copied_files: Mapping[Path, tuple[Path, ...]] = MappingProxyType({})
    """files that SUMO must only read as a harmless copy, and the files from which the copy is made"""
    driver_count: int = 0
    """number of calibrated drivers: lists of vehicle types also name their types"""
    records_trips: bool = False
    """whether SUMO records all trips: see `Simulation.end_with_trips`"""


def single_lane_inputs(scenario: Scenario, road: BuiltRoad) -> SumoInputs:
    """Return SUMO's inputs for a road with one lane that is built for the episode."""
    humans = {"human": scenario.humans}
    if scenario.human_control == "native":
        humans |= {f"of_{name}": idm for name, idm in road.human_parameters.items()}
    types = [_vehicle_type_xml(name, scenario, _human_attributes(scenario, idm)) for name, idm in humans.items()]
    types.append(_vehicle_type_xml("cav", scenario, _single_lane_cav_attributes(scenario)))
    return _built_road_inputs(road, types, humans)


def motorway_inputs(scenario: Scenario, road: MotorwayRoad) -> SumoInputs:
    """Return SUMO's inputs for a motorway; each vehicle type has one of the CAV that may replace it."""
    lines = []
    for name, kind in road.vehicle_types.items():
        common = {"length": kind.length, "emissionClass": kind.emission_class or scenario.emission_class}
        common |= {"speedFactor": kind.speed_factor, "speedDev": 0.0, "emergencyDecel": 9.0}
        common |= {"maxSpeed": kind.max_speed, "vClass": kind.vehicle_class, **dict(kind.parameters)}
        model = {"carFollowModel": kind.model, "tau": kind.time_headway, "minGap": kind.minimum_gap}
        model |= {"accel": kind.acceleration, "decel": kind.deceleration}
        lines.append(xml_element("vType", id=name, **common, **model))
        cav = {"id": reader.CAV_TYPE_TEMPLATE.format(name), **common, **_cav_attributes(scenario)}
        lines.append(xml_element("vType", **cav))
    # Vehicles that overlap would block each other; after a collision of a CAV the episode ends.
    return _built_road_inputs(road, lines, collision_action="remove")


def _built_road_inputs(
    road: BuiltRoad, types: list[str], humans: Collection[str] = (), collision_action: str = "warn"
) -> SumoInputs:
    """Return SUMO's inputs for a road with the XML of its vehicle types; `humans` has types of single vehicles."""
    lines = [*types]
    for route in road.routes:
        laps = route.laps if route.laps > 1 else None
        lines.append(xml_element("route", id=route.name, edges=" ".join(route.edges), repeat=laps))
    for entry in road.entries:
        own_type = f"of_{entry.name}"
        is_unchecked = own_type in humans or not road.has_entry_checks
        attributes = {
            "id": entry.name,
            "type": entry.vehicle_type or (own_type if own_type in humans else "human"),
            # SUMO would not insert a vehicle below the gap that its driver keeps.
            "insertionChecks": "collision" if entry.vehicle_type else "none" if is_unchecked else None,
            "route": entry.route,
            "depart": f"{entry.time:.2f}",
            "departPos": "base" if entry.vehicle_type else repr(entry.position),
            "departSpeed": entry.speed,
            "departLane": entry.lane,
        }
        lines.append(xml_element("vehicle", **attributes))
    xml = "\n".join(["<routes>", *lines, "</routes>"])
    # Vehicles are neither teleported out of a jam nor removed from the insertion backlog.
    options = ("--time-to-teleport", "-1", "--max-depart-delay", "-1", *COLLISION_OPTIONS)
    options += ("--collision.action", collision_action)
    return SumoInputs(options, {"--net-file": (network_file(road.network),)}, xml, "--route-files")


def user_network_inputs(scenario: Scenario, road: UserNetworkRoad) -> SumoInputs:
    """Return SUMO's inputs for a user's network: never its configuration file itself."""
    files = road.files
    # Vehicles of the insertion backlog must not vanish: their waiting time counts.
    options = ["--max-depart-delay=-1", *(f"--{name}={value}" for name, value in files.options.items())]
    # Validation would download the schemas that the files name.
    options += [f"--xml-validation{suffix}=never" for suffix in ("", ".net", ".routes")]
    existing = {
        "--net-file": (files.network,),
        "--additional-files": files.additional_files,
        "--route-files": files.route_files,
        "--weight-files": files.weight_files,
    }
    types = _user_network_types_xml(scenario, road)
    copies, drivers = files.copy_sources, len(road.drivers)
    return SumoInputs(tuple(options), existing, types, "--additional-files", copies, drivers, records_trips=True)


def _user_network_types_xml(scenario: Scenario, road: UserNetworkRoad) -> str:
    """Return the XML of the types of CAVs and calibrated drivers, from which SUMO draws no speed factor."""
    cav = {"sigma": 0.0, "delta": IDMParameters().exponent, **_cav_attributes(scenario)}
    if scenario.actuation != "cruise":
        cav["accel"] = None  # commands cannot exceed the acceleration of the vehicle
    cav = {key: value for key, value in cav.items() if value is not None}
    files, lines, cav_types = road.files, list[str](), road.eligible_types.union(road.cav_types)
    for name, attributes in files.types.items():
        drivers = enumerate(road.drivers if name in road.calibrated_types else ())
        models = {reader.CALIBRATED_TYPE_TEMPLATE.format(name, number): _idm_attributes(idm) for number, idm in drivers}
        if name in cav_types:
            bases = {name: {}, **models}.items()
            models |= {reader.CAV_TYPE_TEMPLATE.format(base): {**model, **cav} for base, model in bases}
        for variant, model in models.items():
            lines.append(_variant_xml(variant, attributes, model, files.type_parameters.get(name, {})))
    return "\n".join(["<additional>", *lines, "</additional>"])


def _variant_xml(name: str, attributes: XMLAttributes, car_following: XMLAttributes, parameters: dict[str, str]) -> str:
    keys = filter(reader.is_harmless_attribute, attributes.keys() - CAR_FOLLOWING_ATTRIBUTES)
    others = {key: attributes[key] for key in sorted(keys)}
    if attributes.get("carFollowModel") == "W99":  # which accelerates by its own parameter
        others["accel"] = attributes.get("cc8", W99_ACCELERATION)
    element = xml_element("vType", **{**others, "speedFactor": 1.0, "speedDev": 0.0, **car_following, "id": name})
    harmless = filter(reader.is_harmless_parameter, parameters)
    nested = "".join(xml_element("param", key=key, value=parameters[key]) for key in harmless)
    return f"{element.removesuffix('/>')}>{nested}</vType>"


def vehicle_class_by_type(road: UserNetworkRoad) -> dict[str, str]:
    """Return the vehicle class of all types of vehicles: the user's types, and those derived from them."""
    derived, own = dict[str, str](), dict[str, str]()
    for name, attributes in road.files.types.items():
        own[name] = attributes.get("vClass", PASSENGER_CLASS)
        bases = [name, *(reader.CALIBRATED_TYPE_TEMPLATE.format(name, number) for number in range(len(road.drivers)))]
        derived |= dict.fromkeys([*bases, *map(reader.CAV_TYPE_TEMPLATE.format, bases)], own[name])
    return derived | own


def _vehicle_type_xml(name: str, scenario: Scenario, attributes: XMLAttributes) -> str:
    """Return the XML of a vehicle type without SUMO's default randomness."""
    common = {"id": name, "length": VEHICLE_LENGTH, "sigma": 0.0, "impatience": scenario.impatience}
    common |= {"speedFactor": 1.0, "speedDev": 0.0}  # otherwise SUMO draws factors between 0.8 and 1.2
    return xml_element("vType", **{**common, "emissionClass": scenario.emission_class, **attributes})


def _human_attributes(scenario: Scenario, humans: IDMParameters) -> dict[str, Any]:
    """Return how SUMO drives human-driven vehicles: its own IDM, or Flow's safety layer for commanded ones."""
    population = scenario.driver_population
    attributes = {**_idm_attributes(humans), "maxSpeed": humans.desired_speed}
    if scenario.human_control == "commanded":
        attributes |= {"accel": SUMO_ACCELERATION, "decel": 4.5, "tau": 1.0, "minGap": scenario.sumo_human_gap}
        if population:  # the layer must not slow down drivers that keep less than a second
            attributes |= {"tau": min(1.0, population.min_time_headway), "maxSpeed": population.max_desired_speed}
    return attributes


def _idm_attributes(parameters: IDMParameters) -> XMLAttributes:
    return {
        "carFollowModel": "IDM",
        "accel": parameters.max_acceleration,
        "decel": parameters.comfortable_deceleration,
        "tau": parameters.time_headway,
        "delta": parameters.exponent,
        "minGap": parameters.minimum_gap,
    }


def _single_lane_cav_attributes(scenario: Scenario) -> XMLAttributes:
    if scenario.actuation == "flow":  # without a gap CAVs would creep up to contact
        attributes = _human_attributes(scenario, scenario.humans)
        return {"color": SUMO_CAV_COLOR, **attributes, "minGap": max(attributes["minGap"], MIN_CAV_GAP)}
    return {**_cav_attributes(scenario), "maxSpeed": scenario.top_speed}


def _cav_attributes(scenario: Scenario) -> XMLAttributes:
    """Return the attributes of a CAV: those of its own ACC, or of a type that executes any safe command exactly."""
    cruise, step = scenario.cruise, scenario.simulation_step
    if scenario.actuation == "cruise":
        return {
            "color": SUMO_CAV_COLOR,
            "carFollowModel": "IDM",
            "tau": cruise.time_gap,
            "accel": cruise.acceleration,  # None: that of the vehicle
            "decel": cruise.deceleration,
            "minGap": cruise.minimum_gap,
        }
    # Such a Krauss vehicle follows commands until one would lead to a crash. With a safety filter, it has a car's
    # limits, which other vehicles expect, and SUMO only makes it yield.
    car_acceleration = max(SUMO_ACCELERATION, scenario.acceleration_limits.highest)
    return {
        "color": SUMO_CAV_COLOR,
        "carFollowModel": "Krauss",
        "accel": car_acceleration if scenario.safety.active else UNLIMITED_ACCELERATION,
        **dict.fromkeys(("decel", "emergencyDecel", "apparentDecel"), scenario.cav_max_braking),
        "tau": step,
        "actionStepLength": step,  # replaces that of the user's types
        "minGap": MIN_CAV_GAP,
    }


def lane_change_parameters(scenario: Scenario) -> dict[str, str]:
    """Return the parameters of SUMO's LC2013 that a vehicle gets as a CAV, which its new type does not change.

    https://sumo.dlr.de/docs/Definition_of_Vehicles,_Vehicle_Types,_and_Routes.html#lane-changing_models
    """
    if scenario.actuation != "cruise":
        return {}
    cruise = scenario.cruise
    values = {"lcKeepRight": cruise.keep_right, "lcSpeedGain": cruise.speed_gain}
    values |= dict.fromkeys(("lcCooperative", "lcCooperativeSpeed"), cruise.cooperation)
    return {f"laneChangeModel.{name}": str(value) for name, value in values.items() if value is not None}
