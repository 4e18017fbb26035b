"""Traffic of the user's own network: SUMO drives people, chooses lanes, and knows who is whose neighbour."""

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any

import numpy as np

from unjam.drivers.local_state import LARGEST_GAP, LocalState
from unjam.scenarios.road import OwnRoad
from unjam.worlds.record import Episode, Floats
from unjam.worlds.sumo.files import CAV_TYPES
from unjam.worlds.sumo.lanes import Followed, LaneTraffic
from unjam.worlds.sumo.networks import edge_lengths, lane_counts, network_lines
from unjam.worlds.sumo.open import Moment
from unjam.worlds.world import Driven, OnProgress


class OwnTraffic(LaneTraffic[OwnRoad]):
    """The actual environment of a network of the user's own."""

    def start(self, controlled: bool, on_progress: OnProgress | None = None) -> None:
        """Run the warm-up, then hand the CAVs over; drivers remember nothing of it."""
        self._routes: Counter[tuple[str, ...]] = Counter()
        self._log_edges: list[list[tuple[str, int, float]]] = []
        self._allowed: list[float] = []
        self._picked = 0
        """vehicles that have entered and are CAVs"""
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
        self._picked += found
        return found

    def _is_chosen(self, name: str) -> bool:
        """Whether a vehicle may be a CAV: by its type, or by a draw of its id and the seed alone.

        So the same vehicles are CAVs whoever drives them, also where one enters later for it.
        """
        road, kind = self.road, self._simulation.type_of(name)
        if kind in road.cav_types:
            return True
        if kind not in road.cars:
            return False
        digest = hashlib.sha256(f"{road.cav_seed} {name}".encode()).digest()
        return int.from_bytes(digest[:8], "big") < road.cav_share * 2**64

    def _moved(self, left: Sequence[str], entered: Sequence[str]) -> None:
        self.over = not self._simulation.more_expected()
        if self.full:
            self._routes.update(self._simulation.route_of(name) for name in entered)

    @property
    def _cav_type(self) -> str:
        return "{}" if self.scenario.actuation == "flow" else CAV_TYPES

    def _legal(self, speeds: dict[str, float]) -> dict[str, float]:
        allowed = self._simulation.allowed_speeds(list(speeds))
        told = super()._legal(speeds).items()
        return {name: min(speed, most) for (name, speed), most in zip(told, allowed, strict=True)}

    def _followed(self, names: Sequence[str]) -> list[Followed]:
        simulation, leaders = self._simulation, [self._simulation.leader(name, LARGEST_GAP) for name in names]
        near = zip(simulation.speeds(names), leaders, strict=True)
        return [Followed(leader, speed, ahead, gap) for speed, (leader, ahead, gap) in near]

    def _ends_with(self, colliding: Sequence[str]) -> bool:
        return any(name in self.cavs for name in colliding)

    def _moment(self) -> Moment:
        names = list(self._on_road)
        if self.full:
            self._log_edges.append(self._simulation.edge_places(names))
            self._allowed += self._simulation.allowed_speeds(names)
        unknown = [float("nan")] * len(names)
        return Moment(names, self._simulation.speeds(names), unknown, unknown)

    def _states(self, names: Sequence[str]) -> LocalState:
        found = [self._simulation.neighbours(name, LARGEST_GAP) for name in names]
        leader_speed, leader_gap, follower_speed, follower_gap = np.array(found).reshape(-1, 4).T
        unknown = np.full(len(names), np.nan)
        speed = np.array(self._simulation.speeds(names), np.float64)
        return LocalState(speed, leader_speed, leader_gap, follower_speed, follower_gap, unknown, unknown)

    def record(self, driven: Driven) -> Episode:
        """Return what happened since the start; positions are those along the route that is driven most.

        Its lanes count from the left: what widens a road is on its right most of the time.
        """
        found = super().record(driven)
        if not self.full or not self._routes:
            return found
        network = self.road.files.network
        lengths, counts = edge_lengths(network), lane_counts(network)
        planned: Counter[str] = Counter()  # not where they were: all drivers' pictures show the same route
        for edges, count in self._routes.items():
            planned.update(dict.fromkeys(edges, count))
        route = max(self._routes, key=lambda edges: sum(planned[edge] for edge in set(edges)))
        starts = accumulate((lengths[edge] for edge in route), initial=0.0)
        begins = dict(reversed(list(zip(route, starts, strict=False))))
        column = {name: index for index, name in enumerate(found.vehicle_ids)}
        positions, lanes = np.full((2, *found.positions.shape), np.nan)
        for time, ((names, *_), places) in enumerate(zip(self._log_moments, self._log_edges, strict=True)):
            for name, (edge, lane, along) in zip(names, places, strict=True):
                if edge in begins:
                    positions[time, column[name]] = begins[edge] + along
                    lanes[time, column[name]] = counts[edge] - 1 - lane
        most = max(counts[edge] for edge in route)
        if most == 1:
            return replace(found, positions=positions)
        further = ("2nd", "3rd", *(f"{number}th" for number in range(4, most + 1)))
        named = ("left lane", *(f"{ordinal} lane" for ordinal in further[: most - 1]))
        return replace(found, positions=positions, lanes=lanes, lane_names=named)

    def _lines(self) -> Floats:
        return network_lines(self.road.files.network)

    def _pictured(self, vehicles: Sequence[str]) -> dict[str, Any]:
        if not self.full:
            return {}
        return {"limit_speed": float(np.mean(self._allowed)) if self._allowed else float("nan")}
