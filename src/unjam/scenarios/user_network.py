"""The user network: any SUMO network with its traffic, in which some vehicles become CAVs."""

import logging
import re
import shlex
from collections.abc import Collection, Sequence
from dataclasses import field, replace
from functools import cache
from math import ceil
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from unjam.drivers.roadside import RoadsideSettings
from unjam.errors import InputError, invalid_value
from unjam.parameters import STRICT, NonNegative, Positive, PositiveInt, build_dataclass, parameter_dataclass
from unjam.scenarios.road import UserNetworkRoad
from unjam.scenarios.scenario import CruiseControl, Scenario
from unjam.sumo_files import SumoFiles, read_sumo_files
from unjam.sumo_files.reader import CAV_TYPE_TEMPLATE
from unjam.text import shorten_list

DEFAULT_DURATION = 3600.0
"""duration of an episode if the configuration defines no end [s]"""
PASSENGER_CLASS = "passenger"
"""SUMO's default vehicle class, to which calibrated human drivers belong"""
PASSENGER_CAR_CLASSES = (PASSENGER_CLASS, "private", "hov", "taxi", "evehicle")
"""SUMO's vehicle classes that are passenger cars"""
UNFINISHED_TRIPS_OPTIONS = "--tripinfo-output.write-unfinished", "--tripinfo-output.write-undeparted"
"""options with which SUMO also writes the trips of vehicles that are under way or waiting at the end"""
NON_ROAD_CLASSES = ("rail", "rail_urban", "rail_electric", "rail_fast", "tram", "subway", "cable_car")
NON_ROAD_CLASSES += ("ship", "aircraft", "drone", "pedestrian", "wheelchair", "container")
"""SUMO's vehicle classes that are not road vehicles"""
ROAD_CLASSES = (
    *(*PASSENGER_CAR_CLASSES, "ignoring", "emergency", "authority", "army", "vip", "delivery", "truck", "trailer"),
    *("bus", "coach", "motorcycle", "moped", "custom1", "custom2"),
)
"""SUMO's vehicle classes that can become CAVs"""
PLAIN_SUMO_VALUES = {"random": "false", "max-depart-delay": "-1"}
"""values of replaced options with which plain SUMO simulates the same traffic"""
DEFAULT_PENETRATION_RATE = 0.1
"""used if neither a rate nor vehicle types are set"""
DRIVERS_PER_EPISODE = 100
"""calibrated human drivers of an episode, drawn from the population"""
ACC_SETTINGS: dict[str, Any] = {"actuation": "cruise", "safety.active": False}
"""settings of CAVs with an ACC, the set speed of which drivers can only reduce"""
MAX_LOGGED_NAMES, MAX_NOTED_NAMES, MAX_NAME_LETTERS = 8, 200, 60
"""maximum number of names in a line of the log and in a note, and of letters of a name"""
DEVICE_SHARE = re.compile(r"(person-)?device\..*\.probability")
DROPPED_DEVICE_SHARE = re.compile(rf"option {DEVICE_SHARE.pattern}")
"""options and dropped items with the share of vehicles that have a device; SUMO draws them from one random sequence"""
OPERATOR_SETTINGS = "speed_limit_control", "ramp_meter"
"""settings for the operator of built-in motorways"""
ALTERNATIVES = (
    "allowed here: a fixed speed of CAVs (-d advisory-speed:advised_speed=20), or a variable speed sign or a signal in "
    "your own files"
)
_LOGGER = logging.getLogger(__name__)


@parameter_dataclass(frozen=True, config=STRICT)
class UserNetwork(Scenario):
    """A network of the user, from its .sumocfg file; its vehicle types define the human drivers.

    Roads with several lanes, traffic lights, and routes that end are supported. A vehicle becomes a CAV at the first
    control step after its entry; SUMO still chooses its lane and obeys traffic lights. SUMO reports the neighbors of a
    CAV, and counts collisions with the user's settings. In training, an episode ends with a collision of a CAV. SUMO's
    limit `max-num-teleports` ends all episodes.
    """

    title: ClassVar[str] = "user-network"
    reward: ClassVar[str] = "travel-time"
    is_closed: ClassVar[bool] = False
    has_route_position: ClassVar[bool] = False
    has_vehicle_types: ClassVar[bool] = True
    reads_user_files: ClassVar[bool] = True

    file: str = ""
    """the .sumocfg file"""
    penetration_rate: Annotated[float, Field(ge=0, le=1)] = 0.0
    """share of the vehicles of `cav_classes` that become CAVs"""
    cav_types: tuple[str, ...] = ()
    """vehicle types of which all vehicles become CAVs, independent of their class"""
    cav_classes: tuple[str, ...] = PASSENGER_CAR_CLASSES
    """SUMO's vehicle classes to which the penetration rate applies"""
    cruise: CruiseControl = field(default_factory=lambda: CruiseControl(acceleration=None, deceleration=None))
    """the CAV's own ACC, by default with the acceleration limits of its vehicle"""
    cavs: PositiveInt | None = None
    """maximum number of CAVs: the first that enter"""
    begin: NonNegative | None = None
    """begin of the simulation [s]; None: that of the configuration. Vehicles that depart earlier are left out"""
    end: Positive | None = None
    """end of an episode, if no horizon is set [s]; None: that of the configuration"""
    roadside: RoadsideSettings = field(default_factory=RoadsideSettings)
    """latency and smoothing of the speeds of traffic ahead that CAVs receive"""
    noise: Annotated[float, Field(ge=0, le=0)] = 0.0
    """always 0: the vehicle types define the human drivers"""

    @model_validator(mode="after")
    def _check_settings(self) -> Self:
        try:
            files = read_sumo_files(Path(self.file))
        except InputError as error:
            raise ValueError(str(error)) from None
        used = ", ".join(sorted(files.used_types))
        for name in files.types:
            if (cav_type := CAV_TYPE_TEMPLATE.format(name)) in files.types:
                reason = f"the type of CAVs that replace {name!r} has this name"
                raise ValueError(f"file: the vehicle type {cav_type!r} is not allowed: {reason}")
        if self.roadside.source != "vehicles":
            raise ValueError(f"roadside.source: {self.roadside.source!r} is not allowed here; allowed: 'vehicles'")
        for name in self.cav_classes:
            if name not in ROAD_CLASSES:
                raise ValueError(f"cav_classes: {name!r} is not allowed; allowed: {', '.join(ROAD_CLASSES)}")
        for name in self.cav_types:
            if name not in files.used_types:
                raise ValueError(f"cav_types: no vehicle has the type {name!r}; allowed: {used}")
            if not is_road_vehicle(files, name):
                raise ValueError(f"cav_types: {name!r} is not allowed: its vehicles are not road vehicles")
        if not self.cav_types and self.penetration_rate == 0:
            allowed = "> 0, <= 1, as in --penetration-rate 0.1"
            raise ValueError(f"penetration_rate: 0.0 is not allowed without cav_types; allowed: {allowed}")
        if not self.cav_types and not self.eligible_types(files):
            raise ValueError(
                f"penetration_rate: no vehicle has one of the classes {', '.join(self.cav_classes)}; its types are "
                f"{_format_types(files, files.used_types)}; set cav_classes or cav_types"
            )
        if self.emission_class != type(self).emission_class:
            raise ValueError("emission_class: it is not allowed on a user network: its vehicle types define it")
        self.check_native_humans("on a user network")
        if self.population and not passenger_types(files):
            raise ValueError(f"population: no vehicle is a passenger car; its types are {used}")
        return self

    @property
    def user_files(self) -> list[Path]:
        """The files of the network, of its traffic, and of calibrated drivers."""
        return [*read_sumo_files(Path(self.file)).sources, *super().user_files]

    @property
    def provided_fields(self) -> tuple[str, ...]:
        """Optional fields of a `LocalState` that this road provides."""
        return ("allowed_speed", "lane_speeds", "penetration_rate", "congestion")

    def draw(self, generator: np.random.Generator) -> UserNetworkRoad:
        """Return the network; the choice of CAVs and of calibrated drivers is random."""
        files = read_sumo_files(Path(self.file))
        begin, options = self._begin(files), dict(files.options)
        if self.begin is not None:
            options["begin"] = str(self.begin)
        if files.end is not None:
            options["end"] = str(self._end_of_flows(files))
        cav_seed = int(generator.integers(2**31))
        drivers = self.driver_population.draw(DRIVERS_PER_EPISODE, generator) if self.driver_population else ()
        return UserNetworkRoad(
            files=files._replace(begin=begin, options=options),
            drivers=tuple(drivers),
            calibrated_types=frozenset(passenger_types(files) if drivers else ()),
            limit_speed=float("nan"),
            penetration_rate=self.penetration_rate,
            cav_types=self.cav_types,
            eligible_types=self.eligible_types(files),
            cav_seed=cav_seed,
            max_cav_count=self.cavs,
            roadside=self.roadside,
        )

    def check_vehicles(self, has_entered: bool | None = None, warnings: Sequence[str] = ()) -> None:
        """Raise `InputError` if no vehicle enters, by an episode (`has_entered`) or else by the first departure."""
        files = read_sumo_files(Path(self.file))
        begin, end, departure = self._begin(files), self._end(files), files.first_departure
        message = f"no vehicle entered before {_format_time(end)}"
        if has_entered or (has_entered is None and (departure is None or departure < end)):
            return
        if departure is None or begin <= departure < end:
            detail = "" if departure is None else f", though the first departs at {_format_time(departure)}"
            raise InputError("; ".join([message + detail, *warnings]))
        is_late = files.end is not None and self.end is None and files.end <= departure
        end_option = f" --end {departure + end - begin:g}" if is_late else ""
        hint = f"use --begin {departure:g}{end_option}"
        raise InputError(f"{message}; the first departs at {_format_time(departure)}; {hint}")

    def _begin(self, files: SumoFiles) -> float:
        return files.begin if self.begin is None else self.begin

    def _end(self, files: SumoFiles) -> float:
        return self._begin(files) + self._time_before_control + self.horizon * self.control_step

    def _has_same_end(self, files: SumoFiles) -> bool:
        """Return whether an episode ends with the configuration, with the first step that reaches the end."""
        end = self._end(files)
        return files.end is not None and -1e-6 < end - files.end < self.simulation_step - 1e-6

    def _end_of_flows(self, files: SumoFiles) -> float:
        """Return the end of flows that define none: that of the configuration, but not before the horizon [s]."""
        end = self._end(files)
        return end if files.end is None else max(files.end, end)

    @property
    def _time_before_control(self) -> float:
        """Duration of the warm-up and of the step in which SUMO inserts the first vehicles [s]."""
        return (self.warmup + 1) * self.simulation_step

    @property
    def human_description(self) -> str:
        """The model of the human drivers, as one phrase."""
        others = "as the vehicle types of its files say"
        return f"in cars {super().human_description}; others {others}" if self.driver_population else others

    def eligible_types(self, files: SumoFiles) -> frozenset[str]:
        """Return the used vehicle types to which the penetration rate applies."""
        return frozenset(name for name in road_types(files) if vehicle_class(files, name) in self.cav_classes)

    @property
    def notes(self) -> list[str]:
        """Notes on differences from plain SUMO, and on vehicle types that are not eligible to become CAVs."""
        files = read_sumo_files(Path(self.file))
        notes = notes_on_files(files)
        if files.has_spread_flows and files.end is not None and not self._has_same_end(files):
            end = self._end_of_flows(files)
            owner = "episode, not of the configuration" if end > files.end else "configuration, not of the episode"
            spread = f"flows with a number of vehicles and no end are spread until {_format_time(end)}"
            notes.append(f"{files.path.name}: {spread}, the end of the {owner}")
        others = files.used_types - self.eligible_types(files) - set(self.cav_types)
        if self.penetration_rate and others:
            notes.append(
                f"eligible to become CAVs: vehicles of the classes {', '.join(self.cav_classes)}; not those of "
                f"the types {_format_types(files, others)} (see --cav-classes)"
            )
        return notes

    def plain_sumo_command(self, seed: int) -> str:
        """Return a command that runs the same traffic without CAVs in plain SUMO, or an empty text.

        The command writes the trips of which unjam measures the travel time. There is no command with calibrated
        drivers, and none if an episode ends before flows with a number of vehicles, which plain SUMO would compress.
        """
        files, words = read_sumo_files(Path(self.file)), ["sumo", "-c", self.file, "--seed", str(seed)]
        begin, end = self._begin(files), self._end(files)
        if self.driver_population or (files.has_spread_flows and end < self._end_of_flows(files)):
            return ""
        words += ["--begin", f"{begin:g}"] if self.begin is not None else []
        words += [] if self._has_same_end(files) else ["--end", f"{end:.10g}"]
        for option in filter(PLAIN_SUMO_VALUES.__contains__, files.replaced_options):
            words += [f"--{option}", PLAIN_SUMO_VALUES[option]]
        return shlex.join([*words, "--tripinfo-output", "trips.xml", *UNFINISHED_TRIPS_OPTIONS])

    def possible_cav_ids(self) -> tuple[str, ...]:
        """Return placeholders for the ids of CAVs, which SUMO defines; raise `InputError` without a maximum number."""
        if self.cavs is None:
            raise InputError("cavs: None is not allowed here on a user network; allowed: a maximum number")
        return tuple(f"cav_{index}" for index in range(self.cavs))

    def _summary_texts(self) -> tuple[str, str, str, str]:
        classes, types = ", ".join(self.cav_classes), ", ".join(self.cav_types)
        share = f"{100 * self.penetration_rate:g} % CAV of {classes}" if self.penetration_rate else ""
        vehicles = f"as its files say ({', '.join(filter(None, (share, types)))})"
        reason = "the mean speed limit at the positions of the vehicles"
        return self.file, vehicles, "the speed limits of its roads", reason


def load_user_network(file: str, changes: dict[str, Any]) -> UserNetwork:
    """Return the scenario of a .sumocfg file with `changes`; raise `InputError` for errors in its files."""
    for name in filter(changes.__contains__, OPERATOR_SETTINGS):
        reason = "it is not allowed on your own network, only on motorways such as on-ramp"
        raise InputError(f"{name}: {reason}; {ALTERNATIVES}")
    files = read_sumo_files(Path.cwd() / file)  # links are not resolved: SUMO looks for other files next to the link
    _log_once(*notes_on_files(files, MAX_LOGGED_NAMES))
    if isinstance(cruise := changes.get("cruise", {}), dict):
        changes = {**changes, "cruise": {"acceleration": None, "deceleration": None, **cruise}}
    if not changes.keys() & {"penetration_rate", "cav_types"}:
        changes = {**changes, "penetration_rate": DEFAULT_PENETRATION_RATE}
        _log_once(f"penetration rate: {100 * DEFAULT_PENETRATION_RATE:g} % by default; --penetration-rate changes it")
    values = {"file": str(files.path), "simulation_step": files.step, **changes}
    scenario = build_dataclass(UserNetwork, values, Path(file).name)
    if "horizon" not in changes:
        scenario = replace(scenario, horizon=_control_steps_until_end(files, scenario))
    scenario.check_vehicles()
    return scenario


def _control_steps_until_end(files: SumoFiles, scenario: UserNetwork) -> int:
    """Return the number of control steps until the end that the scenario or its files define, by default an hour."""
    begin = scenario._begin(files)
    end = scenario.end or (begin + DEFAULT_DURATION if files.end is None else files.end)
    duration = end - begin - scenario._time_before_control
    if duration <= 0:
        allowed = f"> {begin + scenario._time_before_control:g} s, the first step after begin"
        raise invalid_value("end", end, allowed + (" and the warm-up" if scenario.warmup else ""))
    steps = ceil(duration / scenario.simulation_step - 1e-9)  # the last step of SUMO may exceed the end
    return max(1, steps // scenario.steps_per_control_step)


def _format_time(time: float) -> str:
    return f"{time:,.10g} s"


def notes_on_files(files: SumoFiles, max_names: int = MAX_NOTED_NAMES) -> list[str]:
    """Return a note on each difference between an episode and a run of the files in plain SUMO."""
    dropped = shorten_list(files.dropped_items, max_names, MAX_NAME_LETTERS)
    replaced = shorten_list(files.replaced_options, max_names, MAX_NAME_LETTERS)
    notes = [f"{files.path.name}: left out because they only write or listen: {dropped}"] if dropped else []
    notes += [f"{files.path.name}: replaced by values of unjam: {replaced}"] if replaced else []
    if any(map(DEVICE_SHARE.fullmatch, files.options)) and any(
        map(DROPPED_DEVICE_SHARE.fullmatch, files.dropped_items)
    ):
        notes.append(f"{files.path.name}: without the devices left out, SUMO equips other vehicles with the rest")
    if files.has_bicycle_lanes:
        notes.append(
            f"{files.path.name}: has bicycle lanes, where SUMO repeats an episode only in a new process: travel "
            "times of equal seeds differ by about 0.1 %"
        )
    return notes


@cache
def _log_once(*notes: str) -> None:
    for note in notes:
        _LOGGER.warning("%s", note)


def road_types(files: SumoFiles) -> list[str]:
    """Return the sorted names of the used vehicle types that are road vehicles."""
    return sorted(name for name in files.used_types if is_road_vehicle(files, name))


def passenger_types(files: SumoFiles) -> list[str]:
    """Return the sorted names of the used vehicle types of SUMO's default class, passenger cars."""
    return [name for name in road_types(files) if vehicle_class(files, name) == PASSENGER_CLASS]


def vehicle_class(files: SumoFiles, type_name: str) -> str:
    """Return SUMO's vehicle class of a type; the default is the passenger car."""
    return files.types.get(type_name, {}).get("vClass", PASSENGER_CLASS)


def is_road_vehicle(files: SumoFiles, type_name: str) -> bool:
    """Return whether vehicles of a type are road vehicles: not trains, ships, aircraft or pedestrians."""
    is_train = files.types.get(type_name, {}).get("carFollowModel") == "Rail"
    return vehicle_class(files, type_name) not in NON_ROAD_CLASSES and not is_train


def _format_types(files: SumoFiles, names: Collection[str]) -> str:
    listed = (f"{name} ({vehicle_class(files, name)})" for name in sorted(names))
    return shorten_list(listed, MAX_LOGGED_NAMES, MAX_NAME_LETTERS)
