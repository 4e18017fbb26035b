"""The user's own road: any SUMO network with its traffic, some of whose vehicles become CAVs."""

import logging
from dataclasses import field, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from unjam.drivers.roadside import Roadside
from unjam.errors import InputError, wrong
from unjam.parameters import STRICT, Count, NotNegative, Positive, build
from unjam.scenarios.road import OwnRoad
from unjam.scenarios.scenario import Scenario
from unjam.sumo_files import SumoFiles, read_sumo_files

LONGEST = 3600.0
"""seconds of an episode where the configuration names no end"""
CARS = ("passenger", "private", "hov", "taxi", "evehicle", "delivery", "truck", "trailer", "bus", "coach")
"""SUMO's vehicle classes that a share picks from"""
PASSENGER = "passenger"
"""the class of those that calibrated people drive: SUMO's default"""
DRAWN = 100
"""calibrated people of an episode, drawn from the population"""
WITH_OWN_ACC: dict[str, Any] = {"actuation": "cruise", "safety.active": False}
"""CAVs have an ACC that follows and makes room for who changes lanes; drivers hold it back"""
MOST_NAMED = 8
"""things of the files that are not used, in the line that tells of them"""
LOG = logging.getLogger(__name__)


@dataclass(frozen=True, config=STRICT)
class OwnNetwork(Scenario):
    """A network of your own, from its .sumocfg file; people drive as its vehicle types say.

    Roads with several lanes, signals, and routes that end are fine. A vehicle becomes a CAV at the first
    decision after it entered; SUMO still chooses its lane and obeys signals. Its neighbours are SUMO's.
    Only a collision with a CAV ends an episode.
    """

    title: ClassVar[str] = "own-network"
    reward: ClassVar[str] = "travel-time"
    closed: ClassVar[bool] = False
    has_coordinate: ClassVar[bool] = False
    tells: ClassVar[tuple[str, ...]] = ("allowed_speed", "lane_speeds", "cav_share", "congestion")

    file: str = ""
    """the .sumocfg file"""
    cav_share: Annotated[float, Field(ge=0, le=1)] = 0.0
    """share of the vehicles that become CAVs, cars and the like alone"""
    cav_types: tuple[str, ...] = ()
    """vehicle types all of whose vehicles become CAVs"""
    cavs: Count | None = None
    """at most so many CAVs: the first of these that enter"""
    begin: NotNegative | None = None
    """time at which SUMO begins [s]; None: as its configuration says. Who departs before is left out"""
    end: Positive | None = None
    """time at which an episode ends, where no horizon is given [s]; None: as its configuration says"""
    roadside: Roadside = field(default_factory=Roadside)
    """how late and how smooth CAVs are told of the speeds ahead"""
    noise: Annotated[float, Field(ge=0, le=0)] = 0.0
    """none: people drive as the vehicle types say"""

    @model_validator(mode="after")
    def _fits(self) -> "OwnNetwork":
        try:
            files = read_sumo_files(Path(self.file))
        except InputError as error:
            raise ValueError(str(error)) from None
        known = ", ".join(sorted(files.used_types))
        for name in self.cav_types:
            if name not in files.used_types:
                raise ValueError(f"cav_types: no vehicle has the type {name!r}; allowed: {known}")
        if not self.cav_types:
            if self.cav_share == 0:
                raise ValueError(
                    "cav_share: 0.0 is not allowed without cav_types; allowed: > 0, <= 1, as --cav-share 0.1"
                )
            if not any(is_car(files.types.get(name, {})) for name in files.used_types):
                raise ValueError(f"cav_share: no vehicle is a car; its types are {known}; name cav_types")
        if self.emission_class != type(self).emission_class:
            raise ValueError(
                "emission_class: it is not allowed on your own network, whose vehicle types say it"
            )
        self.check_people_are_native("on your own network")
        if self.population and not passenger_types(files):
            raise ValueError(f"population: no vehicle is a passenger car; its types are {known}")
        return self

    def draw(self, generator: np.random.Generator) -> OwnRoad:
        """Return the network; random is which vehicles the share picks."""
        files = read_sumo_files(Path(self.file))
        # The horizon ends an episode: at an earlier end of the configuration's SUMO would let flows stop.
        options = {name: value for name, value in files.options.items() if name != "end"}
        if self.begin is not None:
            options["begin"] = str(self.begin)
        begin = files.begin if self.begin is None else self.begin
        files = files._replace(begin=begin, options=options)
        cav_seed = int(generator.integers(2**31))
        drivers = self.calibrated.draw(DRAWN, generator) if self.calibrated else ()
        return OwnRoad(
            files=files,
            drivers=tuple(drivers),
            driven_types=frozenset(passenger_types(files) if drivers else ()),
            limit_speed=float("nan"),
            cav_share=self.cav_share,
            cav_types=self.cav_types,
            cars=frozenset(name for name, attributes in files.types.items() if is_car(attributes)),
            cav_seed=cav_seed,
            cavs=self.cavs,
            roadside=self.roadside,
        )

    @property
    def people_in_words(self) -> str:
        """How people drive."""
        files = "as the vehicle types of its files say"
        return f"in cars {super().people_in_words}; others {files}" if self.calibrated else files

    def possible_cavs(self) -> tuple[str, ...]:
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
        share = f"{100 * self.cav_share:g} % CAV" if self.cav_share else ""
        return [
            ("road", self.file),
            ("vehicles", "as its files say (" + ", ".join(filter(None, (share, types))) + ")"),
            ("limit", "what its roads allow"),
            ("limit is", "the mean speed that the roads allow where the vehicles are"),
        ]


def own_network(file: str, changes: dict[str, Any]) -> OwnNetwork:
    """Return the scenario of a .sumocfg file: step, begin and end are its own, unless `changes` say more.

    Raises:
        InputError: one line on what is missing or broken, before SUMO starts.
    """
    files = read_sumo_files(Path(file).resolve())
    if files.dropped:
        _tell_dropped(files.path.name, files.dropped)
    values = {"file": str(files.path), "simulation_step": files.step, **changes}
    made = build(OwnNetwork, values, Path(file).name)
    if "horizon" in changes:
        return made
    begin = files.begin if made.begin is None else made.begin
    end = made.end or (begin + LONGEST if files.end is None else files.end)
    driven = end - begin - made.warmup * made.simulation_step
    if driven <= 0:
        raise wrong("end", end, f"after begin, {begin:g} s" + (" and the warm-up" if made.warmup else ""))
    return replace(made, horizon=max(1, int(driven / made.decision_step + 1e-9)))


@cache
def _tell_dropped(file: str, dropped: tuple[str, ...]) -> None:
    """Tell once, in one line, what of the files SUMO is not given."""
    names = ", ".join(name[:60] for name in dropped[:MOST_NAMED])
    more = f" and {len(dropped) - MOST_NAMED} more" if len(dropped) > MOST_NAMED else ""
    LOG.warning("%s: left out, so that SUMO only simulates: %s%s", file, names, more)


def passenger_types(files: SumoFiles) -> list[str]:
    """Return the types of passenger cars that vehicles have; SUMO's default class is that one."""
    classes = {name: files.types.get(name, {}).get("vClass", PASSENGER) for name in files.used_types}
    return sorted(name for name, kind in classes.items() if kind == PASSENGER)


def is_car(attributes: dict[str, str]) -> bool:
    """Return whether a share may pick vehicles of a type; SUMO's default class is a passenger car."""
    return attributes.get("vClass", "passenger") in CARS
