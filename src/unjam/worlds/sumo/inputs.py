"""SUMO's inputs for an episode: network, vehicle types, vehicles and options."""

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
"""SUMO's default of `cc8`, the acceleration of its model W99 from a standstill [m/s2]"""
CAR_FOLLOWING_ATTRIBUTES = {"carFollowModel", "tau", "minGap", "sigma", "delta", "stepping"}
"""attributes of the car-following model of a vehicle type; a CAV keeps all other attributes"""
COLLISION_OPTIONS = ("--collision.mingap-factor", "0", "--collision.check-junctions", "true")
"""options of built-in roads, which define a collision as physical contact; users' networks have their own settings"""


class SumoInputs(NamedTuple):
    """The inputs of SUMO for an episode."""

    options: tuple[str, ...]
    existing_files: dict[str, tuple[Path, ...]]
    """paths of the network and other existing files, by SUMO's option"""
    traffic_xml: str
    """XML of vehicle types and, on built-in roads, of routes and vehicles"""
    traffic_option: str
    """SUMO's option for the file with `traffic_xml`"""
    copied_files: Mapping[Path, tuple[Path, ...]] = MappingProxyType({})
    """sources of the harmless copy that SUMO reads instead of a file, by file"""
    driver_count: int = 0
    """number of calibrated drivers; copies of lists of vehicle types include the types with these drivers"""
    records_trips: bool = False
    """whether SUMO records all trips, for `Simulation.end_with_trips`"""


def single_lane_inputs(scenario: Scenario, road: BuiltRoad) -> SumoInputs:
    """Return SUMO's inputs for a built-in road with one lane."""
    humans = {"human": scenario.humans}
    if scenario.human_control == "native":
        humans |= {f"of_{name}": idm for name, idm in road.human_parameters.items()}
    types = [_vehicle_type_xml(name, scenario, _human_attributes(scenario, idm)) for name, idm in humans.items()]
    types.append(_vehicle_type_xml("cav", scenario, _single_lane_cav_attributes(scenario)))
    return _built_road_inputs(road, types, humans)


def motorway_inputs(scenario: Scenario, road: MotorwayRoad) -> SumoInputs:
    """Return SUMO's inputs for a motorway, with a type of CAVs for each vehicle type."""
    types = []
    for name, vehicle in road.vehicle_types.items():
        common = {"length": vehicle.length, "emissionClass": vehicle.emission_class or scenario.emission_class}
        common |= {"speedFactor": vehicle.speed_factor, "speedDev": 0.0, "emergencyDecel": 9.0}
        common |= {"maxSpeed": vehicle.max_speed, "vClass": vehicle.vehicle_class, **dict(vehicle.parameters)}
        model = {"carFollowModel": vehicle.model, "tau": vehicle.time_headway, "minGap": vehicle.minimum_gap}
        model |= {"accel": vehicle.acceleration, "decel": vehicle.deceleration}
        types.append(xml_element("vType", id=name, **common, **model))
        cav = {"id": reader.CAV_TYPE_TEMPLATE.format(name), **common, **_cav_attributes(scenario)}
        types.append(xml_element("vType", **cav))
    # Otherwise overlapping vehicles would block each other. The episode ends after a collision of a CAV.
    return _built_road_inputs(road, types, collision_action="remove")


def _built_road_inputs(
    road: BuiltRoad, types: list[str], humans: Collection[str] = (), collision_action: str = "warn"
) -> SumoInputs:
    """Return SUMO's inputs for a built-in road; `types` are XML, `humans` has ids of types of single vehicles."""
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
            # With all checks, SUMO would not insert a vehicle at a gap below the desired one.
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
    """Return SUMO's inputs for a user's network; SUMO does not read the user's configuration file."""
    files = road.files
    # Vehicles stay in the insertion backlog, as their waiting time counts.
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
    copies, driver_count = files.copy_sources, len(road.drivers)
    return SumoInputs(tuple(options), existing, types, "--additional-files", copies, driver_count, records_trips=True)


def _user_network_types_xml(scenario: Scenario, road: UserNetworkRoad) -> str:
    """Return the XML of the vehicle types of CAVs and calibrated drivers, which have no random speed factor."""
    cav = {"sigma": 0.0, "delta": IDMParameters().exponent, **_cav_attributes(scenario)}
    if scenario.actuation != "cruise":
        cav["accel"] = None  # the CAV keeps the maximum acceleration of its vehicle
    cav = {key: value for key, value in cav.items() if value is not None}
    files, lines, cav_types = road.files, list[str](), road.eligible_types.union(road.cav_types)
    for name, attributes in files.types.items():
        drivers = enumerate(road.drivers if name in road.calibrated_types else ())
        models = {reader.CALIBRATED_TYPE_TEMPLATE.format(name, index): _idm_attributes(idm) for index, idm in drivers}
        if name in cav_types:
            bases = {name: {}, **models}.items()
            models |= {reader.CAV_TYPE_TEMPLATE.format(base): {**model, **cav} for base, model in bases}
        for variant, model in models.items():
            lines.append(_derived_type_xml(variant, attributes, model, files.type_parameters.get(name, {})))
    return "\n".join(["<additional>", *lines, "</additional>"])


def _derived_type_xml(name: str, attributes: XMLAttributes, model: XMLAttributes, parameters: dict[str, str]) -> str:
    """Return the XML of a user's vehicle type with another car-following model, and without harmful attributes."""
    keys = filter(reader.is_harmless_attribute, attributes.keys() - CAR_FOLLOWING_ATTRIBUTES)
    common = {key: attributes[key] for key in sorted(keys)}
    if attributes.get("carFollowModel") == "W99":  # its acceleration has another name
        common["accel"] = attributes.get("cc8", W99_ACCELERATION)
    element = xml_element("vType", **{**common, "speedFactor": 1.0, "speedDev": 0.0, **model, "id": name})
    harmless = filter(reader.is_harmless_parameter, parameters)
    nested = "".join(xml_element("param", key=key, value=parameters[key]) for key in harmless)
    return f"{element.removesuffix('/>')}>{nested}</vType>"


def vehicle_class_by_type(road: UserNetworkRoad) -> dict[str, str]:
    """Return the vehicle class of each of the user's vehicle types, and of the types derived from them."""
    derived, original = dict[str, str](), dict[str, str]()
    for name, attributes in road.files.types.items():
        original[name] = attributes.get("vClass", PASSENGER_CLASS)
        bases = [name, *(reader.CALIBRATED_TYPE_TEMPLATE.format(name, index) for index in range(len(road.drivers)))]
        derived |= dict.fromkeys([*bases, *map(reader.CAV_TYPE_TEMPLATE.format, bases)], original[name])
    return derived | original


def _vehicle_type_xml(name: str, scenario: Scenario, attributes: XMLAttributes) -> str:
    """Return the XML of a vehicle type without SUMO's default randomness."""
    common = {"id": name, "length": VEHICLE_LENGTH, "sigma": 0.0, "impatience": scenario.impatience}
    common |= {"speedFactor": 1.0, "speedDev": 0.0}  # by default, SUMO draws factors between 0.8 and 1.2
    return xml_element("vType", **{**common, "emissionClass": scenario.emission_class, **attributes})


def _human_attributes(scenario: Scenario, humans: IDMParameters) -> dict[str, Any]:
    """Return the attributes of human-driven vehicles: SUMO's IDM, or for commanded ones Flow's safety layer."""
    population = scenario.driver_population
    attributes = {**_idm_attributes(humans), "maxSpeed": humans.desired_speed}
    if scenario.human_control == "commanded":
        attributes |= {"accel": SUMO_ACCELERATION, "decel": 4.5, "tau": 1.0, "minGap": scenario.sumo_human_gap}
        if population:  # the safety layer must not slow down drivers with a time headway below 1 s
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
    if scenario.actuation == "flow":  # without a minimum gap, CAVs would creep up to contact
        attributes = _human_attributes(scenario, scenario.humans)
        return {"color": SUMO_CAV_COLOR, **attributes, "minGap": max(attributes["minGap"], MIN_CAV_GAP)}
    return {**_cav_attributes(scenario), "maxSpeed": scenario.top_speed}


def _cav_attributes(scenario: Scenario) -> XMLAttributes:
    """Return the attributes of CAVs: those of their ACC, or of a model that executes any safe command exactly."""
    cruise, step = scenario.cruise, scenario.simulation_step
    if scenario.actuation == "cruise":
        return {
            "color": SUMO_CAV_COLOR,
            "carFollowModel": "IDM",
            "tau": cruise.time_gap,
            "accel": cruise.acceleration,  # None: of the vehicle's type
            "decel": cruise.deceleration,
            "minGap": cruise.minimum_gap,
        }
    # SUMO limits the commands to this Krauss vehicle only to prevent a crash. With a safety filter, SUMO only makes it
    # yield, and it has the acceleration of a car, which other vehicles expect.
    car_acceleration = max(SUMO_ACCELERATION, scenario.acceleration_limits.highest)
    return {
        "color": SUMO_CAV_COLOR,
        "carFollowModel": "Krauss",
        "accel": car_acceleration if scenario.safety.active else UNLIMITED_ACCELERATION,
        **dict.fromkeys(("decel", "emergencyDecel", "apparentDecel"), scenario.cav_max_braking),
        "tau": step,
        "actionStepLength": step,  # instead of the value of the user's type
        "minGap": MIN_CAV_GAP,
    }


def lane_change_parameters(scenario: Scenario) -> dict[str, str]:
    """Return the parameters of SUMO's lane-change model LC2013 for a CAV; a change of the type does not set them.

    https://sumo.dlr.de/docs/Definition_of_Vehicles,_Vehicle_Types,_and_Routes.html#lane-changing_models
    """
    if scenario.actuation != "cruise":
        return {}
    cruise = scenario.cruise
    values = {"lcKeepRight": cruise.keep_right, "lcSpeedGain": cruise.speed_gain}
    values |= dict.fromkeys(("lcCooperative", "lcCooperativeSpeed"), cruise.cooperation)
    return {f"laneChangeModel.{name}": str(value) for name, value in values.items() if value is not None}
