"""Traffic of the user's own network: SUMO drives people, chooses lanes, and knows who is whose neighbour."""

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.command import Command
from unjam.drivers.local_state import LARGEST_GAP, LocalState
from unjam.drivers.roadside import Messages
from unjam.drivers.safety import Ahead
from unjam.scenarios.road import OwnRoad
from unjam.worlds.record import Episode, Floats
from unjam.worlds.sumo.control import VehicleLimits
from unjam.worlds.sumo.files import CALIBRATED_TYPES, CAV_TYPES, classes_of_types
from unjam.worlds.sumo.lanes import Followed, LaneTraffic
from unjam.worlds.sumo.library import Neighbours
from unjam.worlds.sumo.networks import edge_lengths, lane_counts, network_lines
from unjam.worlds.sumo.sections import RoadAhead
from unjam.worlds.world import Driven, OnProgress

FILTER_SEES = 400.0
"""how far a safety filter looks ahead [m]: what a car at 60 m/s needs"""
FUEL_SECONDS = 1.0
"""time for which what all vehicles burn is held: SUMO computes it as long as it takes to drive"""


class OwnTraffic(LaneTraffic[OwnRoad]):
    """The actual environment of a network of the user's own."""

    def start(self, controlled: bool, on_progress: OnProgress | None = None) -> None:
        """Run the warm-up, then hand the CAVs over; drivers remember nothing of it."""
        self._routes: Counter[tuple[str, ...]] = Counter()
        self._edges: dict[str, int] = {}
        """number of each edge on which anybody was"""
        self._allowed, self._counted = 0.0, 0
        """sum of the speeds that were allowed to vehicles [m/s], and of how many"""
        self._contacts = set[str]()
        """CAVs that were in contact with another vehicle"""
        self._came, self._picked = 0, 0
        """vehicles that have entered, and CAVs among them"""
        self._limits: dict[str, VehicleLimits] = {}
        """of the vehicles that CAVs replace"""
        self._service = None
        if "lane_speeds" in self.asked:
            step = self.scenario.decision_step
            messages = Messages(self.road.roadside, step, self._noise_generator)
            self._service = RoadAhead(self._simulation, messages, step)
        self._fuel_every = max(1, int(FUEL_SECONDS / self.scenario.decision_step))
        super().start(controlled, on_progress)

    @property
    def expects_cavs(self) -> bool:
        """Whether a CAV may still enter: while anybody may, as SUMO alone knows who will."""
        return not self.over and self._room

    @property
    def _room(self) -> bool:
        """Whether there may be one more CAV."""
        return self.road.cavs is None or self._picked < self.road.cavs

    def _is_cav(self, name: str) -> bool:
        found = self._room and self._is_chosen(name)
        self._came, self._picked = self._came + 1, self._picked + found
        return found

    def _is_chosen(self, name: str) -> bool:
        """Whether a vehicle may be a CAV: by its type, or by a draw of its id and the seed alone.

        So the same vehicles are CAVs whoever drives them, also where one enters later for it.
        """
        road, kind = self.road, self._simulation.type_of(name)
        if kind in road.cav_types:
            return True
        if kind not in road.eligible_types:
            return False
        return self._drawn(name) < road.cav_share * 2**64

    def _drawn(self, name: str) -> int:
        """Return a number below 2**64 that a vehicle's id and the seed alone draw."""
        digest = hashlib.sha256(f"{self.road.cav_seed} {name}".encode()).digest()
        return int.from_bytes(digest[:8], "big")

    def _follow(self) -> None:
        """Keep up with who is on the road, and let calibrated people drive the cars that have entered."""
        self._near: dict[str, Neighbours] = {}
        self._places: dict[str, tuple[str, float]] = {}
        before = self._teleports
        super()._follow()
        most = int(self.road.files.options.get("max-num-teleports", -1))
        if self._teleports > before and 0 <= most < self._simulation.teleport_count():
            self.stopped = f"more than {most} teleports (max-num-teleports)"
        road, simulation = self.road, self._simulation
        for name in simulation.departed() if road.drivers else ():
            kind = simulation.type_of(name)
            if kind in road.driven_types:
                number = self._drawn(f"driver of {name}") % len(road.drivers)
                simulation.change_type(name, CALIBRATED_TYPES.format(kind, number))

    def _moved(self, left: Sequence[str], entered: Sequence[str]) -> None:
        # SUMO does not expect the vehicles that calibrators will bring.
        until, simulation = self.road.files.calibrated_until, self._simulation
        self.over = not simulation.more_expected() and (not until or simulation.now() >= until)
        if self.full:
            self._routes.update(self._simulation.route_of(name) for name in entered)

    @property
    def _cav_type(self) -> str:
        return "{}" if self.scenario.actuation == "flow" else CAV_TYPES

    def _vehicle_limits(self, names: Sequence[str]) -> tuple[Floats, Floats, Floats]:
        """Return acceleration, comfortable and hardest braking of the vehicles that CAVs replace [m/s2]."""
        for name in [name for name in names if name not in self._limits]:
            kind = self._simulation.type_of(name)
            own = self._simulation.type_limits(kind.removeprefix(CAV_TYPES.format("")))
            self._limits[name] = own
            if self.scenario.actuation in ("shielded", "raw"):
                self._simulation.limit_braking(kind, min(own.braking, self.scenario.cav_brakes))
        rows = np.array([self._limits[name] for name in names], np.float64).reshape(-1, 3)
        return rows[:, 0], rows[:, 1], rows[:, 2]

    def _acc_limits(self, names: Sequence[str]) -> tuple[Floats, Floats]:
        return self._vehicle_limits(names)[:2]

    def _told(self, command: Command | None) -> list[float]:
        told = super()._told(command)
        if self.scenario.actuation == "cruise":
            return told
        most, _, hardest = self._vehicle_limits(self.cavs)
        return np.clip(told, -hardest, most).tolist()

    def _legal(self, speeds: dict[str, float]) -> dict[str, float]:
        if self.scenario.actuation == "cruise":  # SUMO keeps to it, and takes set speeds for allowed ones
            return speeds
        allowed = self._simulation.allowed_speeds(list(speeds))
        return dict(zip(speeds, map(min, speeds.values(), allowed), strict=True))

    def _followed(self, names: Sequence[str]) -> list[Followed]:
        near = zip(self._simulation.speeds(names), map(self._neighbours, names), strict=True)
        return [Followed(leader, speed, ahead, gap) for speed, (leader, ahead, gap, *_) in near]

    def _ahead(self, names: Sequence[str]) -> list[Ahead]:
        if not self.scenario.safety.active:
            return super()._ahead(names)
        near = zip(names, self._simulation.speeds(names), map(self._neighbours, names), strict=True)
        found: list[Ahead] = []
        for name, speed, (leader, ahead, gap, *_) in near:
            if not leader:  # who drives fast must see farther than what drivers are told
                _, ahead, gap, *_ = self._simulation.neighbours(name, FILTER_SEES)
            found.append(Ahead(speed, ahead, gap))
        return found

    def _neighbours(self, name: str) -> Neighbours:
        """Return who is ahead of a vehicle and behind it; SUMO is asked once in a step."""
        if name not in self._near:
            self._near[name] = self._simulation.neighbours(name, LARGEST_GAP)
        return self._near[name]

    def _colliding(self) -> Sequence[str]:
        """Return what SUMO counts as collided under the user's settings, and CAVs that touch their leader.

        With `collision.action` none, SUMO itself counts nothing.
        """
        found = dict.fromkeys(super()._colliding())
        for name, (leader, _, gap, *_) in self._near.items() if self._controlled else ():
            if leader and gap <= 0.0 and self._simulation.is_in_contact(name, leader):
                found |= {name: None, leader: None}
        return list(found)

    def _ends_with(self, colliding: Sequence[str]) -> bool:
        """Whether a CAV is among them, which is recorded, and that ends the episode.

        In human-only traffic, the baseline, there are no CAVs.
        """
        found = set(self.cavs).intersection(colliding) if self._controlled else set[str]()
        self._contacts |= found
        return self.stop_at_contact and bool(found)

    def _pictured_now(self, names: Sequence[str]) -> dict[str, Any]:
        unknown = np.full(len(names), np.nan)
        if not self.full:
            return {"positions": unknown, "gaps": unknown}
        free = [name for name in names if name not in self._fastest] or names
        allowed = self._simulation.allowed_speeds(free)
        self._allowed, self._counted = self._allowed + sum(allowed), self._counted + len(allowed)
        rows: list[tuple[float, ...]] = []
        for name, along in self._places_of(names):
            edge, _, number = name.rpartition("_")
            number = float(number or -1)  # nowhere, where SUMO has lifted a vehicle off the road
            rows.append((self._edges.setdefault(edge, len(self._edges)), number, along))
        edge, lane, along = np.array(rows, np.float64).reshape(-1, 3).T
        return {"edge": edge, "lane": lane, "along": along, "gaps": unknown}

    def _states(self, names: Sequence[str]) -> LocalState:
        found = [self._neighbours(name)[1:] for name in names]
        leader_speed, leader_gap, follower_speed, follower_gap = np.array(found).reshape(-1, 4).T
        unknown = np.full(len(names), np.nan)
        speed = np.array(self._simulation.speeds(names), np.float64)
        near = LocalState(speed, leader_speed, leader_gap, follower_speed, follower_gap, unknown, unknown)
        if self._service is None:
            return near
        share = np.full(len(names), self._picked / max(self._came, 1))
        return near._replace(**self._service.told(names, self._places_of(names)), cav_share=share)

    def _note_moment(self) -> None:
        if self._service is not None:
            names, speeds = self._everybody()
            self._service.measure(self._places_of(names), speeds)

    def record(self, driven: Driven) -> Episode:
        """Return what happened since the start, with all trips; SUMO ends with it."""
        episode = super().record(driven)
        start = self.road.files.begin + self.scenario.warmup * self.scenario.simulation_step
        trips = self._simulation.end_with_trips(classes_of_types(self.road), start)
        return replace(episode, trips=trips, contacts=len(self._contacts))

    def _places_of(self, names: Sequence[str]) -> list[tuple[str, float]]:
        """Return in which lane vehicles are, and how far along it [m]; SUMO is asked once in a step."""
        new = [name for name in names if name not in self._places]
        self._places |= zip(new, self._simulation.lane_places(new) if new else (), strict=True)
        return [self._places[name] for name in names]

    def _lines(self) -> Floats:
        return network_lines(self.road.files.network)

    def _pictured(self, columns: NDArray[np.intp]) -> dict[str, Any]:
        """Return what pictures show; positions are those along the route that is driven most.

        Its lanes count from the left: what widens a road is on its right most of the time.
        """
        if not self.full:
            return super()._pictured(columns)
        gaps, places, edge = (self._log.pictures(name, columns) for name in ("gaps", "places", "edge"))
        shown = {"gaps": gaps, "places": places, "positions": np.full(edge.shape, np.nan)}
        shown["limit_speed"] = self._allowed / self._counted if self._counted else float("nan")
        if not self._routes:
            return shown
        network = self.road.files.network
        lengths, counts = edge_lengths(network), lane_counts(network)
        planned: Counter[str] = Counter()  # not where they were: all drivers' pictures show the same route
        for edges, count in self._routes.items():
            planned.update(dict.fromkeys(edges, count))
        route = max(self._routes, key=lambda edges: sum(planned[edge] for edge in set(edges)))
        starts = accumulate((lengths[edge] for edge in route), initial=0.0)
        begins = dict(reversed(list(zip(route, starts, strict=False))))
        facts = [(begins.get(name, np.nan), counts.get(name, 0)) for name in self._edges]
        nobody = (np.nan, np.nan)
        begin, lanes = np.array([*facts, nobody]).T[:, np.nan_to_num(edge, nan=-1).astype(int)]
        shown["positions"] = begin + self._log.pictures("along", columns)
        most = max(counts[edge] for edge in route)
        if most == 1:
            return shown
        lane = np.where(np.isnan(begin), np.nan, lanes - 1 - self._log.pictures("lane", columns))
        further = ("2nd", "3rd", *(f"{number}th" for number in range(4, most + 1)))
        named = ("left lane", *(f"{ordinal} lane" for ordinal in further[: most - 1]))
        return {**shown, "lanes": lane, "lane_names": named}
