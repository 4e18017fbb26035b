"""SUMO: start, read, command, step."""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from functools import partial
from itertools import starmap
from pathlib import Path
from tempfile import gettempdir
from threading import Lock
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from unjam.errors import EpisodeError, SumoInputError, invalid_value
from unjam.processes import PrivateFolder, capture_stderr
from unjam.sumo_files import file_stamp, write_harmless_copy
from unjam.worlds.record import SumoWarning
from unjam.worlds.sumo.backends import Backend, Libsumo, NeighborStates, Traci, sumo_function
from unjam.worlds.sumo.control import VehicleControl
from unjam.worlds.sumo.inputs import SumoInputs
from unjam.worlds.sumo.networks import UNCONTROLLED_LINK_STATES, NetworkLane, last_error_message, sumo_program
from unjam.worlds.sumo.tripinfo import read_trips, trip_options
from unjam.worlds.sumo.warnings_log import MAX_EXAMPLES_OPTION, read_warnings
from unjam.worlds.trips import Trips

MIN_CONTACT_OVERLAP = 0.01
"""overlap that is no rounding error [m]"""
_consume = deque(maxlen=0).extend
"""runs through an iterator, in C: a loop would cost as much as the calls"""


class Simulation(VehicleControl):
    """One SUMO simulation, loaded anew for each episode.

    libsumo holds one simulation per process and silently replaces the first by a second. So this class
    refuses to open another while one is open, be it the user's own, and detects where other code in the
    process starts, steps or closes one meanwhile. Over TraCI there may be several, each in its own process.
    """

    def __init__(
        self, backend: Backend = "libsumo", gui_options: Sequence[str] = (), owns_stdout: bool = False
    ) -> None:
        """Open a simulation; nothing runs before `load`.

        `gui_options` go to SUMO's window. `alone`: this process prints nothing else while SUMO starts.

        Raises:
            InUseError: libsumo already runs a simulation in this process.
        """
        if "," in (folder := gettempdir()):  # between the names of files that SUMO is given
            raise invalid_value("TMPDIR", folder, "a folder without , in its name")
        self.backend = backend
        self._gui_options = gui_options
        self._library = Libsumo() if backend == "libsumo" else Traci()
        self.check: Callable[[], None] = self._library.check
        """raises `LostWorkerError` where other code of this process has changed the simulation"""
        self.step: Callable[[], None] = self._library.step
        """simulates one time step"""
        self._folder = PrivateFolder()
        self._error_log = Path(self._folder.name) / "error.log"
        self._harmless_copies: dict[Path, tuple[list[tuple[int, int]], Path]] = {}
        """of users' own files, with the stamps of what they are made from"""
        self._trip_file = Path(self._folder.name) / "trips.xml"
        self._stdout_log = Path(self._folder.name) / "printed.log" if owns_stdout else None
        """what SUMO says before it has a log"""
        self.episode_lock = Lock()
        """held by the episode that runs"""
        if backend == "libsumo":
            self._bind()

    def _bind(self) -> None:
        """Look up the functions that are called often."""
        self._sumo: Any = self._library.functions
        call = partial(sumo_function, self._sumo)
        self._get_speed = call("vehicle", "getSpeed")
        self._get_distance = call("vehicle", "getDistance")
        self._get_lane_position = call("vehicle", "getLanePosition")
        self._get_lane = call("vehicle", "getLaneID")
        self._get_fuel = call("vehicle", "getFuelConsumption")
        self._set_speed = call("vehicle", "setSpeed")
        self.max_speed: Callable[[str], float] = call("vehicle", "getMaxSpeed")
        """how fast a vehicle drives at most, whatever the road allows [m/s]"""
        self.set_max_speed: Callable[[str, float], object] = call("vehicle", "setMaxSpeed")
        """changes that for one vehicle"""
        self.set_time_gap: Callable[[str, float], object] = call("vehicle", "setTau")
        """changes the time headway that a vehicle keeps [s]"""
        self._set_previous_speed = call("vehicle", "setPreviousSpeed")
        self.vehicles_on_lane: Callable[[str], Sequence[str]] = call("lane", "getLastStepVehicleIDs")
        """whose front bumpers are on a lane"""
        self.vehicle_count: Callable[[], int] = call("vehicle", "getIDCount")
        """how many vehicles are on the road"""
        self.departed_vehicles: Callable[[], Sequence[str]] = call("simulation", "getDepartedIDList")
        """who entered the road in the last step"""
        self.arrived_vehicles: Callable[[], Sequence[str]] = call("simulation", "getArrivedIDList")
        """who left the road at the end of its route in the last step"""
        self.teleporting_vehicles: Callable[[], Sequence[str]] = call("simulation", "getStartingTeleportIDList")
        """whom SUMO lifted off the road in the last step, for it had stood for long; and whom it put back"""
        self.reinserted_vehicles: Callable[[], Sequence[str]] = call("simulation", "getEndingTeleportIDList")
        self.colliding_vehicles: Callable[[], Sequence[str]] = call("simulation", "getCollidingVehiclesIDList")
        """who touched another in the last step"""
        self.vehicles_on_loop: Callable[[str], Sequence[Any]] = call("inductionloop", "getVehicleData")
        """who was on a loop in the last step: (name, length, when it came, when it left or -1, type)"""
        self.pending_vehicles: Callable[[], Sequence[str]] = call("simulation", "getPendingVehicles")
        """who wants to enter and cannot"""

    def now(self) -> float:
        """Return SUMO's time [s]."""
        return float(self._sumo.simulation.getTime())

    def has_refused(self) -> bool:
        """Return whether a step of this episode has failed: SUMO refuses what a file holds further on."""
        return self._library.has_refused

    def load(self, files: SumoInputs, step: float, seed: int) -> None:
        """Start an episode: load network and traffic, and put the vehicles on the road.

        Raises:
            RefusedError: SUMO refuses the files; the message holds its reason.
            LostError: other code of this process has changed the simulation.
            EpisodeError: it cannot start for another one.
        """
        self.check()
        traffic = Path(self._folder.name) / "traffic.rou.xml"
        traffic.write_text(files.traffic_xml)
        named = {
            option: [self._readable_path(path, files) for path in paths]
            for option, paths in files.existing_files.items()
        }
        named.setdefault(files.traffic_option, []).append(str(traffic))
        inputs = [f"{option}={','.join(paths)}" for option, paths in named.items() if paths]
        options = [*inputs, *files.options, *self._simulation_options(step, seed)]
        if files.records_trips:
            options += trip_options(self._trip_file)
        try:
            with capture_stderr(self._stdout_log) if self._stdout_log else nullcontext():
                if self._library.is_running:
                    self._library.load(options)
                else:
                    program = sumo_program("sumo-gui" if self.backend == "gui" else "sumo")
                    self._library.start([program, *options, *self._gui_options], self._error_log)
                    if self.backend != "libsumo":  # over TraCI each start makes another connection
                        self._bind()
                self.step()  # the first step inserts the vehicles and moves none
        except Exception as error:
            self._library.end()  # only then is SUMO's message in its log, and can the next episode start
            words = last_error_message(self._error_log) or (
                last_error_message(self._stdout_log) if self._stdout_log else ""
            )
            kind = SumoInputError if words or self.backend != "gui" else EpisodeError  # a window may be missing
            raise kind(f"SUMO cannot start: {words or ' '.join(str(error).split())}") from error

    def _readable_path(self, path: Path, files: SumoInputs) -> str:
        """Return what SUMO reads instead of a file: itself, or a harmless copy of its content."""
        if path not in files.copied_files:
            return str(path)
        before, copy = self._harmless_copies.get(
            path, ([], Path(self._folder.name) / f"{len(self._harmless_copies)}.xml")
        )
        if (stamps := list(map(file_stamp, files.copied_files[path]))) != before:
            self._harmless_copies[path] = [], copy
            write_harmless_copy(path, copy)
            self._harmless_copies[path] = stamps, copy
        return str(copy)

    def _simulation_options(self, step: float, seed: int) -> list[str]:
        return [
            *("--step-length", str(step), "--seed", str(seed)),
            *("--no-step-log", "true", "--duration-log.disable", "true"),
            # Warnings go to the log alone, which keeps one example and the number of each kind.
            *("--no-warnings", "true", "--error-log", str(self._error_log)),
            *("--aggregate-warnings", MAX_EXAMPLES_OPTION),
        ]

    def speeds(self, ids: Sequence[str]) -> list[float]:
        """Return the speeds of `ids` [m/s]."""
        return list(map(self._get_speed, ids))

    def lane_offsets(self, ids: Sequence[str]) -> list[float]:
        """Return how far each of `ids` is along its lane [m]."""
        return list(map(self._get_lane_position, ids))

    def poses(self, ids: Sequence[str]) -> NDArray[np.float64]:
        """Return rows (x, y, heading) of front bumpers: [m], and [rad] against the x axis."""
        vehicle = self._sumo.vehicle
        rows = [(*vehicle.getPosition(name)[:2], vehicle.getAngle(name)) for name in ids]
        places = np.array(rows, np.float64).reshape(-1, 3)
        places[:, 2] = np.radians(90.0 - places[:, 2])  # SUMO counts clockwise from north, in degrees
        return places

    def expects_vehicles(self) -> bool:
        """Return whether anybody is on the road or will be."""
        return self._sumo.simulation.getMinExpectedNumber() > 0

    def route_of(self, name: str) -> tuple[str, ...]:
        """Return the edges of a vehicle's route."""
        return tuple(self._sumo.vehicle.getRoute(name))

    def lanes(self) -> list[NetworkLane]:
        """Return all lanes of the network but those of junctions."""
        lane = self._sumo.lane
        names = [name for name in lane.getIDList() if not name.startswith(":")]
        links = [lane.getLinks(name) for name in names]
        leads_to = (tuple(link[0] for link in each) for each in links)
        stops = (any(link[5] not in UNCONTROLLED_LINK_STATES for link in each) for each in links)
        facts = map(lane.getEdgeID, names), map(lane.getLength, names), map(lane.getMaxSpeed, names)
        return list(map(NetworkLane, names, *facts, leads_to, stops))

    def lane_positions(self, ids: Sequence[str]) -> list[tuple[str, float]]:
        """Return in which lane each of `ids` is, and how far along it [m]."""
        return list(zip(map(self._get_lane, ids), map(self._get_lane_position, ids), strict=True))

    def remaining_routes(self, ids: Sequence[str]) -> list[tuple[str, ...]]:
        """Return the edges that each of `ids` has before it, its own first."""
        vehicle = self._sumo.vehicle
        return [tuple(vehicle.getRoute(name)[vehicle.getRouteIndex(name) :]) for name in ids]

    def desired_speeds(self, ids: Sequence[str]) -> list[tuple[float, float]]:
        """Return how fast each of `ids` wants to drive over what a road allows, and at most [m/s]."""
        return list(zip(map(self._sumo.vehicle.getSpeedFactor, ids), map(self.max_speed, ids), strict=True))

    def allowed_speeds(self, ids: Sequence[str]) -> list[float]:
        """Return how fast each of `ids` may drive where it is [m/s]."""
        return [self._sumo.vehicle.getAllowedSpeed(name) for name in ids]

    def neighbors(self, name: str, max_distance: float) -> NeighborStates:
        """Return who is ahead and behind, as SUMO sees them.

        Who is farther than `farthest` [m] is not there: as fast, and that far away.
        """
        vehicle, speed = self._sumo.vehicle, self._get_speed(name)
        leader, ahead = vehicle.getLeader(name, max_distance) or ("", 0.0)
        follower, behind = vehicle.getFollower(name, max_distance)
        found: list[float] = []
        for other, gap, keeper in ((leader, ahead, name), (follower, behind, follower)):
            # SUMO's gap lacks the one that the vehicle behind keeps.
            true_gap = gap + vehicle.getMinGap(keeper) if other else max_distance
            there = true_gap < max_distance
            found += [self._get_speed(other) if there else speed, min(max(true_gap, 0.0), max_distance)]
        return NeighborStates(leader if found[1] < max_distance else "", *found)

    def is_in_contact(self, name: str, leader: str) -> bool:
        """Return whether a vehicle overlaps with the one ahead of it on its lane, along it and across."""
        vehicle = self._sumo.vehicle
        gap = self._get_lane_position(leader) - vehicle.getLength(leader) - self._get_lane_position(name)
        apart = vehicle.getLateralLanePosition(name) - vehicle.getLateralLanePosition(leader)
        across = 2.0 * abs(apart) < vehicle.getWidth(name) + vehicle.getWidth(leader)
        return self._get_lane(name) == self._get_lane(leader) and gap < -MIN_CONTACT_OVERLAP and across

    def teleport_count(self) -> int:
        """Return how many teleports SUMO has counted since it started."""
        return int(self._sumo.simulation.getParameter("", "stats.teleports.total"))

    def distances(self, ids: Sequence[str]) -> list[float]:
        """Return how far each of `ids` has driven since it entered [m]."""
        return list(map(self._get_distance, ids))

    def fuel(self, ids: Sequence[str]) -> list[float]:
        """Return the fuel rates of `ids` in the last step [mg/s], by their emission class."""
        return list(map(self._get_fuel, ids))

    def command_speeds(self, ids: Iterable[str], speeds: Iterable[float]) -> None:
        """Ask for the speeds that `ids` shall have after the next step [m/s]: plain floats."""
        _consume(starmap(self._set_speed, zip(ids, speeds, strict=True)))

    def replace_speeds(self, ids: Iterable[str], speeds: Iterable[float]) -> None:
        """Give `ids` other current speeds [m/s], plain floats: how noise enters."""
        _consume(map(self._set_previous_speed, ids, speeds))

    def end_with_trips(self, vehicle_classes: dict[str, str], warmup_end: float) -> Trips:
        """End the episode, so that SUMO writes its last records, and return what `read_trips` finds."""
        self._library.end()
        return read_trips(self._trip_file, vehicle_classes, warmup_end)

    @property
    def is_lost(self) -> bool:
        """Whether other code of this process has changed the simulation: only a new one can go on."""
        return self._library.is_lost

    def close(self) -> None:
        """End the simulation and remove its files; may be called twice."""
        self._library.end()
        self._library.close()
        self._folder.cleanup()

    def finish(self) -> tuple[SumoWarning, ...]:
        """End the episode and return what SUMO warned of: its log is complete only once SUMO has ended."""
        self._library.end()
        return read_warnings(self._error_log)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
