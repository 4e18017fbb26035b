"""The user's own road: any SUMO network with its traffic, some of whose vehicles become CAVs."""

import logging
from collections.abc import Collection, Sequence
from dataclasses import field, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from unjam.drivers.roadside import RoadsideSettings
from unjam.errors import InputError, invalid_value
from unjam.parameters import STRICT, NonNegative, Positive, PositiveInt, build_dataclass
from unjam.scenarios.road import UserNetworkRoad
from unjam.scenarios.scenario import CruiseControl, Scenario
from unjam.sumo_files import SumoFiles, read_sumo_files

DEFAULT_DURATION = 3600.0
"""seconds of an episode where the configuration names no end"""
PASSENGER_CLASS = "passenger"
"""the class of those that calibrated people drive: SUMO's default"""
PASSENGER_CAR_CLASSES = (PASSENGER_CLASS, "private", "hov", "taxi", "evehicle")
"""SUMO's vehicle classes that are passenger cars"""
NON_ROAD_CLASSES = ("rail", "rail_urban", "rail_electric", "rail_fast", "tram", "subway", "cable_car")
NON_ROAD_CLASSES += ("ship", "aircraft", "drone", "pedestrian", "wheelchair", "container")
"""SUMO's vehicle classes that are no road vehicles"""
ROAD_CLASSES = (
    *(*PASSENGER_CAR_CLASSES, "ignoring", "emergency", "authority", "army", "vip", "delivery", "truck", "trailer"),
    *("bus", "coach", "motorcycle", "moped", "custom1", "custom2"),
)
"""SUMO's vehicle classes whose vehicles may become CAVs"""
DEFAULT_PENETRATION_RATE = 0.1
"""penetration rate where neither a rate nor vehicle types are set"""
DRIVERS_PER_EPISODE = 100
"""calibrated people of an episode, drawn from the population"""
ACC_SETTINGS: dict[str, Any] = {"actuation": "cruise", "safety.active": False}
"""CAVs have an ACC that follows and makes room for who changes lanes; drivers hold it back"""
MAX_LOGGED_NAMES, MAX_NOTED_NAMES = 8, 200
"""options and elements that a line of the log names, and a note"""
_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True, config=STRICT)
class UserNetwork(Scenario):
    """A network of your own, from its .sumocfg file; people drive as its vehicle types say.

    Roads with several lanes, signals, and routes that end are fine. A vehicle becomes a CAV at the first
    decision after it entered; SUMO still chooses its lane and obeys signals. Its neighbours are SUMO's.
    Collisions are what SUMO counts with the user's settings; one with a CAV ends an episode in training, and
    SUMO's `max-num-teleports` always does.
    """

    title: ClassVar[str] = "user-network"
    reward: ClassVar[str] = "travel-time"
    is_closed: ClassVar[bool] = False
    has_coordinate: ClassVar[bool] = False
    has_vehicle_types: ClassVar[bool] = True
    provided_fields: ClassVar[tuple[str, ...]] = ("allowed_speed", "lane_speeds", "penetration_rate", "congestion")

    file: str = ""
    """the .sumocfg file"""
    penetration_rate: Annotated[float, Field(ge=0, le=1)] = 0.0
    """share of the vehicles of `cav_classes` that become CAVs"""
    cav_types: tuple[str, ...] = ()
    """vehicle types all of whose vehicles become CAVs, whatever their class"""
    cav_classes: tuple[str, ...] = PASSENGER_CAR_CLASSES
    """SUMO's vehicle classes of which the share picks"""
    cruise: CruiseControl = field(default_factory=lambda: CruiseControl(acceleration=None, deceleration=None))
    """the CAV's own ACC: it has the limits of acceleration of its vehicle, unless it is given others"""
    cavs: PositiveInt | None = None
    """at most so many CAVs: the first of these that enter"""
    begin: NonNegative | None = None
    """time at which SUMO begins [s]; None: as its configuration says. Who departs before is left out"""
    end: Positive | None = None
    """time at which an episode ends, where no horizon is given [s]; None: as its configuration says"""
    roadside: RoadsideSettings = field(default_factory=RoadsideSettings)
    """how late and how smooth CAVs are told of the speeds ahead"""
    noise: Annotated[float, Field(ge=0, le=0)] = 0.0
    """none: people drive as the vehicle types say"""

    @model_validator(mode="after")
    def _check_settings(self) -> "UserNetwork":
        try:
            files = read_sumo_files(Path(self.file))
        except InputError as error:
            raise ValueError(str(error)) from None
        known, classes = ", ".join(sorted(files.used_types)), ", ".join(self.cav_classes)
        for name in self.cav_classes:
            if name not in ROAD_CLASSES:
                raise ValueError(f"cav_classes: {name!r} is not allowed; allowed: {', '.join(ROAD_CLASSES)}")
        for name in self.cav_types:
            if name not in files.used_types:
                raise ValueError(f"cav_types: no vehicle has the type {name!r}; allowed: {known}")
            if not is_road_vehicle(files, name):
                raise ValueError(f"cav_types: {name!r} is not allowed, for it is no type of road vehicles")
        if not self.cav_types:
            if self.penetration_rate == 0:
                raise ValueError(
                    "penetration_rate: 0.0 is not allowed without cav_types; allowed: > 0, <= 1, as --penetration-rate 0.1"
                )
            if not self.eligible_types(files):
                raise ValueError(
                    f"penetration_rate: no vehicle has one of the classes {classes}; its types are "
                    f"{_format_types(files, files.used_types)}; name cav_classes or cav_types"
                )
        if self.emission_class != type(self).emission_class:
            raise ValueError("emission_class: it is not allowed on your own network, whose vehicle types say it")
        self.check_native_humans("on your own network")
        if self.population and not passenger_types(files):
            raise ValueError(f"population: no vehicle is a passenger car; its types are {known}")
        return self

    def draw(self, generator: np.random.Generator) -> UserNetworkRoad:
        """Return the network; random is which vehicles the share picks."""
        files = read_sumo_files(Path(self.file))
        options = dict(files.options)
        if self.begin is not None:
            options["begin"] = str(self.begin)
        begin = files.begin if self.begin is None else self.begin
        if files.end is not None:  # flows without an end of their own last until it: at least to the horizon
            driven = self.warmup * self.simulation_step + self.horizon * self.control_step
            options["end"] = str(max(files.end, begin + driven))
        files = files._replace(begin=begin, options=options)
        cav_seed = int(generator.integers(2**31))
        drivers = self.driver_population.draw(DRIVERS_PER_EPISODE, generator) if self.driver_population else ()
        return UserNetworkRoad(
            files=files,
            drivers=tuple(drivers),
            calibrated_types=frozenset(passenger_types(files) if drivers else ()),
            limit_speed=float("nan"),
            penetration_rate=self.penetration_rate,
            cav_types=self.cav_types,
            eligible_types=self.eligible_types(files),
            cav_seed=cav_seed,
            cavs=self.cavs,
            roadside=self.roadside,
        )

    def check_vehicles(self, has_entered: bool | None = None, warnings: Sequence[str] = ()) -> None:
        """Raise `InputError` where no vehicle enters: by when the first departs, or as an episode has shown.

        Args:
            entered: whether a vehicle was on the road in a whole episode; None: none was driven yet.
            warnings: what SUMO warned of in it.
        """
        files = read_sumo_files(Path(self.file))
        begin = files.begin if self.begin is None else self.begin
        end = begin + self.warmup * self.simulation_step + self.horizon * self.control_step
        first, none = files.first_departure, f"no vehicle entered before {_format_time(end)}"
        if has_entered or (has_entered is None and (first is None or first < end)):
            return
        if first is None or begin <= first < end:
            depart = "" if first is None else f", though the first departs at {_format_time(first)}"
            raise InputError("; ".join([none + depart, *warnings]))
        late = files.end is not None and self.end is None and files.end <= first
        more = f" --end {first + end - begin:g}" if late else ""
        raise InputError(f"{none}; the first departs at {_format_time(first)}; use --begin {first:g}{more}")

    @property
    def human_description(self) -> str:
        """How people drive."""
        files = "as the vehicle types of its files say"
        return f"in cars {super().human_description}; others {files}" if self.driver_population else files

    def eligible_types(self, files: SumoFiles) -> frozenset[str]:
        """Return the vehicle types in use of which the share picks."""
        on_roads = (name for name in files.used_types if is_road_vehicle(files, name))
        return frozenset(name for name in on_roads if vehicle_class(files, name) in self.cav_classes)

    @property
    def notes(self) -> list[str]:
        """What differs from plain SUMO, and which vehicles stay human-driven because of their class."""
        files = read_sumo_files(Path(self.file))
        found = notes_on_files(files)
        others = files.used_types - self.eligible_types(files) - set(self.cav_types)
        if not self.penetration_rate or not others:
            return found
        return [
            *found,
            f"eligible to become CAVs: vehicles of the classes {', '.join(self.cav_classes)}; not those of "
            f"the types {_format_types(files, others)} (see --cav-classes)",
        ]

    def possible_cav_ids(self) -> tuple[str, ...]:
        """Return names for as many CAVs as there may be; what their vehicles are called SUMO alone knows.

        Raises:
            InputError: nobody says how many there may be.
        """
        if self.cavs is None:
            raise InputError("cavs: None is not allowed here on your own network; allowed: at most how many")
        return tuple(f"cav_{number}" for number in range(self.cavs))

    def facts(self) -> list[tuple[str, str]]:
        """Return the road's own facts for `unjam scenarios`."""
        types = ", ".join(self.cav_types)
        share = (
            f"{100 * self.penetration_rate:g} % CAV of {', '.join(self.cav_classes)}" if self.penetration_rate else ""
        )
        return [
            ("road", self.file),
            ("vehicles", "as its files say (" + ", ".join(filter(None, (share, types))) + ")"),
            ("limit", "what its roads allow"),
            ("limit is", "the mean speed that the roads allow where the vehicles are"),
        ]


def load_user_network(file: str, changes: dict[str, Any]) -> UserNetwork:
    """Return the scenario of a .sumocfg file: step, begin and end are its own, unless `changes` say more.

    Raises:
        InputError: one line on what is missing or broken, before SUMO starts.
    """
    files = read_sumo_files(Path(file).resolve())
    _log_once(*notes_on_files(files, MAX_LOGGED_NAMES))
    if isinstance(cruise := changes.get("cruise", {}), dict):
        changes = {**changes, "cruise": {"acceleration": None, "deceleration": None, **cruise}}
    if not changes.keys() & {"penetration_rate", "cav_types"}:
        changes = {**changes, "penetration_rate": DEFAULT_PENETRATION_RATE}
        _log_once(f"penetration rate: {100 * DEFAULT_PENETRATION_RATE:g} %, as none is set; --penetration-rate sets another")
    values = {"file": str(files.path), "simulation_step": files.step, **changes}
    made = build_dataclass(UserNetwork, values, Path(file).name)
    if "horizon" not in changes:
        made = replace(made, horizon=_control_steps_until_end(files, made))
    made.check_vehicles()
    return made


def _control_steps_until_end(files: SumoFiles, scenario: UserNetwork) -> int:
    """Return how many decisions there are before the end of a configuration, or after an hour."""
    begin = files.begin if scenario.begin is None else scenario.begin
    end = scenario.end or (begin + DEFAULT_DURATION if files.end is None else files.end)
    driven = end - begin - scenario.warmup * scenario.simulation_step
    if driven <= 0:
        raise invalid_value("end", end, f"after begin, {begin:g} s" + (" and the warm-up" if scenario.warmup else ""))
    return max(1, int(driven / scenario.control_step + 1e-9))


def _format_time(time: float) -> str:
    """Return a time as messages state it."""
    return f"{time:,.10g} s"


def notes_on_files(files: SumoFiles, max_names: int = MAX_NOTED_NAMES) -> list[str]:
    """Return in which ways an episode is not what SUMO alone would make of the files, one line each."""
    ways = {
        "left out, for they only write or listen": files.dropped_items,
        "unjam has a value of its own for": files.replaced_options,
    }
    return [f"{files.path.name}: {way}: {_shorten_list(names, max_names)}" for way, names in ways.items() if names]


def _shorten_list(names: Sequence[str], max_names: int) -> str:
    more = f" and {len(names) - max_names} more" if len(names) > max_names else ""
    return ", ".join(name[:60] for name in names[:max_names]) + more


@cache
def _log_once(*notes: str) -> None:
    for note in notes:
        _LOGGER.warning("%s", note)


def passenger_types(files: SumoFiles) -> list[str]:
    """Return the types of passenger cars that vehicles have; SUMO's default class is that one."""
    on_roads = (name for name in files.used_types if is_road_vehicle(files, name))
    return sorted(name for name in on_roads if vehicle_class(files, name) == PASSENGER_CLASS)


def vehicle_class(files: SumoFiles, name: str) -> str:
    """Return SUMO's vehicle class of a type; a type that names none is a passenger car."""
    return files.types.get(name, {}).get("vClass", PASSENGER_CLASS)


def is_road_vehicle(files: SumoFiles, name: str) -> bool:
    """Return whether vehicles of a type are road vehicles: no trains, ships, aircraft or pedestrians."""
    is_train = files.types.get(name, {}).get("carFollowModel") == "Rail"
    return vehicle_class(files, name) not in NON_ROAD_CLASSES and not is_train


def _format_types(files: SumoFiles, names: Collection[str]) -> str:
    """Return types with their classes, as far as a line has room for them."""
    return _shorten_list([f"{name} ({vehicle_class(files, name)})" for name in sorted(names)], MAX_LOGGED_NAMES)
