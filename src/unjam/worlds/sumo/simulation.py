"""A SUMO simulation: load inputs, read and command vehicles, and simulate steps."""

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from itertools import starmap
from math import nan
from pathlib import Path
from tempfile import gettempdir
from threading import Lock
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from unjam.errors import EpisodeError, SumoInputError, invalid_value
from unjam.physics.arrays import Floats
from unjam.processes import PrivateFolder, capture_stderr
from unjam.scenarios.scenario import Actuation
from unjam.sumo_files import file_stamp, write_harmless_copy
from unjam.worlds.record import SumoWarning, Trips
from unjam.worlds.sumo.inputs import SumoInputs
from unjam.worlds.sumo.networks import UNCONTROLLED_LINK_STATES, NetworkLane, last_error_message, sumo_program
from unjam.worlds.sumo.outputs import MAX_EXAMPLES_OPTION, read_trips, read_warnings, trip_options
from unjam.worlds.sumo.sublane import INTERNAL_EDGE_PREFIX, find_lateral_neighbors
from unjam.worlds.sumo.transports import Libsumo, NeighborStates, Traci, Transport, sumo_function

MIN_CONTACT_OVERLAP = 0.01
"""smallest overlap that is not a rounding error [m]"""
SPEED_MODES = {"shielded": 31, "raw": 30, "flow": 25, "cruise": 31}
"""SUMO's speed mode for each kind of actuation; with bit 0, SUMO keeps the speed safe"""
NO_SPEED_CHECKS = 32
"""SUMO's speed mode in which a vehicle obeys every command, and also ignores the right of way"""
SAFE_SPEED_BIT = 1
"""the only bit that is kept if vehicles ignore the right of way: SUMO still prevents collisions"""
ACCELERATION_LIMIT_BITS = 2 | 4
"""bits of a speed mode by which vehicles keep the acceleration and deceleration limits of their type"""
_consume = deque(maxlen=0).extend
"""exhausts an iterator in C; a Python loop would take as long as the calls themselves"""


class VehicleLimits(NamedTuple):
    """Maximum acceleration, comfortable deceleration and maximum deceleration of a vehicle [m/s2]."""

    acceleration: float
    deceleration: float
    emergency_deceleration: float


class InductionLoop(NamedTuple):
    """An induction loop at a position along a lane [m]."""

    lane: str
    position: float


class DetectorPassage(NamedTuple):
    """A passage of a vehicle over an induction loop."""

    loop: int
    """index of the loop"""
    vehicle: str
    time: float
    """time at which its front bumper reached the loop [s]"""
    speed: float
    """mean speed above the loop [m/s]; NaN if the vehicle changed lanes before its rear had passed"""


def loop_name(index: int) -> str:
    """Return the id that an induction loop has in SUMO."""
    return f"unjam_loop_{index}"


class Simulation(AbstractContextManager["Simulation"]):
    """One SUMO simulation, loaded again for each episode.

    libsumo runs one simulation per process, and silently replaces it when another is started. This class therefore
    refuses to open a second one, and detects whether other code has started, stepped or closed a simulation. Over
    TraCI, each simulation has its own process.
    """

    is_sandboxed = False

    def __init__(
        self, transport: Transport = "libsumo", gui_options: Sequence[str] = (), owns_stdout: bool = False
    ) -> None:
        """Open a simulation; raise `InUseError` if libsumo already runs one. `owns_stdout`: only SUMO prints here."""
        if "," in (folder := gettempdir()):  # SUMO reads a comma as the end of a file name
            raise invalid_value("TMPDIR", folder, "a folder without , in its name")
        self.transport = transport
        self._gui_options = gui_options
        self._library = Libsumo() if transport == "libsumo" else Traci()
        self.check: Callable[[], None] = self._library.check
        """raises `LostWorkerError` if other code of this process has changed the simulation"""
        self.step: Callable[[], None] = self._library.step
        self._folder = PrivateFolder()
        folder = Path(self._folder.name)
        files = (folder / name for name in ("error.log", "trips.xml", "traffic.rou.xml"))
        self._error_log, self._trip_file, self._traffic_file = files
        self._stdout_log = folder / "printed.log" if owns_stdout else None
        """file for the messages that SUMO prints before it opens its log"""
        self._harmless_copies: dict[tuple[Path, int], tuple[list[tuple[int, int]], Path]] = {}
        """stamps of the sources, and the harmless copy, of a user's file with a number of calibrated drivers"""
        self.episode_lock = Lock()
        if transport == "libsumo":
            self._bind_functions()

    def _bind_functions(self) -> None:
        """Look up the functions of libsumo or TraCI, which takes time, only once."""
        self._sumo: Any = self._library.functions
        get_function = partial(sumo_function, self._sumo)
        self._get_speed, self._get_lane = get_function("vehicle", "getSpeed"), get_function("vehicle", "getLaneID")
        self._get_lane_position = get_function("vehicle", "getLanePosition")
        self._get_allowed_speed = get_function("vehicle", "getAllowedSpeed")
        self._set_speed = get_function("vehicle", "setSpeed")
        self._set_previous_speed = get_function("vehicle", "setPreviousSpeed")

        def make_list_reader(name: str) -> Callable[[Sequence[str]], list[float]]:
            function = get_function("vehicle", name)
            return lambda ids: list(map(function, ids))

        self.speeds = make_list_reader("getSpeed")
        self.lane_offsets = make_list_reader("getLanePosition")
        """positions of vehicles along their lanes [m]"""
        self.distances = make_list_reader("getDistance")
        """distances that vehicles have driven since their entry [m]"""
        self.fuel = make_list_reader("getFuelConsumption")
        """fuel rates of vehicles in the last step [mg/s], by SUMO's model of their emission class"""
        self.time: Callable[[], float] = get_function("simulation", "getTime")
        self.max_speed: Callable[[str], float] = get_function("vehicle", "getMaxSpeed")
        """maximum speed of a vehicle itself, on any road [m/s]"""
        self.set_max_speed: Callable[[str, float], object] = get_function("vehicle", "setMaxSpeed")
        self.set_time_gap: Callable[[str, float], object] = get_function("vehicle", "setTau")
        self.vehicles_on_lane: Callable[[str], Sequence[str]] = get_function("lane", "getLastStepVehicleIDs")
        self.vehicle_count: Callable[[], int] = get_function("vehicle", "getIDCount")
        self.departed_vehicles: Callable[[], Sequence[str]] = get_function("simulation", "getDepartedIDList")
        """vehicles that entered the road in the last step"""
        self.arrived_vehicles: Callable[[], Sequence[str]] = get_function("simulation", "getArrivedIDList")
        """vehicles that left the road at the end of their route in the last step"""
        self.teleporting_vehicles: Callable[[], Sequence[str]] = get_function("simulation", "getStartingTeleportIDList")
        """vehicles that SUMO started to teleport in the last step"""
        self.reinserted_vehicles: Callable[[], Sequence[str]] = get_function("simulation", "getEndingTeleportIDList")
        """teleported vehicles that SUMO reinserted in the last step"""
        self.colliding_vehicles: Callable[[], Sequence[str]] = get_function("simulation", "getCollidingVehiclesIDList")
        self._vehicles_on_loop = get_function("inductionloop", "getVehicleData")
        self.pending_vehicles: Callable[[], Sequence[str]] = get_function("simulation", "getPendingVehicles")

    def has_refused(self) -> bool:
        """Return whether a step has failed in this episode, as it does at an error in a later part of a file."""
        return self._library.has_refused

    def load(self, inputs: SumoInputs, step: float, seed: int) -> None:
        """Start an episode: load network and traffic, and insert the first vehicles.

        Raise `SumoInputError` if SUMO refuses the files, `LostWorkerError` if other code has changed the simulation,
        and `EpisodeError` for other reasons.
        """
        self.check()
        self._traffic_file.write_text(inputs.traffic_xml, encoding="utf-8")
        existing = inputs.existing_files.items()
        paths = {option: [self._readable_path(path, inputs) for path in files] for option, files in existing}
        paths.setdefault(inputs.traffic_option, []).append(str(self._traffic_file))
        options = [f"{option}={','.join(files)}" for option, files in paths.items() if files]
        options += [*inputs.options, "--step-length", str(step), "--seed", str(seed)]
        options += ["--no-step-log", "true", "--duration-log.disable", "true"]
        # SUMO writes warnings only to the log: one example of each kind, and their number.
        options += ["--no-warnings", "true", "--error-log", str(self._error_log)]
        options += ["--aggregate-warnings", MAX_EXAMPLES_OPTION]
        options += trip_options(self._trip_file) if inputs.records_trips else []
        try:
            with capture_stderr(self._stdout_log) if self._stdout_log else nullcontext():
                if self._library.is_running:
                    self._library.load(options)
                else:
                    program = sumo_program("sumo-gui" if self.transport == "gui" else "sumo")
                    self._library.start([program, *options, *self._gui_options], self._error_log)
                    if self.transport != "libsumo":  # over TraCI each start makes another connection
                        self._bind_functions()
                self._has_sublanes = float(self._sumo.simulation.getOption("lateral-resolution")) > 0.0
                self.step()  # the first step inserts the vehicles and moves none
        except Exception as error:
            self._library.end()  # then SUMO's message is in its log, and the next episode can start
            logs = [self._error_log, *([self._stdout_log] if self._stdout_log else [])]
            message = next(filter(None, map(last_error_message, logs)), "")
            error_class = SumoInputError if message or self.transport != "gui" else EpisodeError  # without a screen
            raise error_class(f"SUMO cannot start: {message or ' '.join(str(error).split())}") from error

    def _readable_path(self, path: Path, inputs: SumoInputs) -> str:
        """Return the path that SUMO reads: of the file, or of its harmless copy, which is written if needed."""
        if path not in inputs.copied_files:
            return str(path)
        new_copy = Path(self._folder.name) / f"{len(self._harmless_copies)}.xml"
        key = path, inputs.driver_count
        known_stamps, copy = self._harmless_copies.get(key, ([], new_copy))
        if (stamps := list(map(file_stamp, inputs.copied_files[path]))) != known_stamps:
            self._harmless_copies[key] = [], copy
            write_harmless_copy(path, copy, inputs.driver_count)
            self._harmless_copies[key] = stamps, copy
        return str(copy)

    def allowed_speeds(self, ids: Sequence[str]) -> list[float]:
        """Return the speeds that the road allows to vehicles [m/s]; NaN for vehicles that are parked off the road."""
        return [speed if speed >= 0.0 else nan for speed in map(self._get_allowed_speed, ids)]

    def uncapped_speeds(self, ids: Sequence[str]) -> list[float]:
        """Return the speed limits of the vehicles' lanes times their speed factors [m/s]; NaN off the road."""
        limit, factor, lanes = self._sumo.lane.getMaxSpeed, self._sumo.vehicle.getSpeedFactor, map(self._get_lane, ids)
        return [limit(lane) * factor(vehicle) if lane else nan for vehicle, lane in zip(ids, lanes, strict=True)]

    def poses(self, ids: Sequence[str]) -> Floats:
        """Return rows (x, y, heading) of front bumpers [m, m, rad]; the heading is relative to the x axis."""
        vehicle = self._sumo.vehicle
        rows = [(*vehicle.getPosition(vehicle_id)[:2], vehicle.getAngle(vehicle_id)) for vehicle_id in ids]
        poses = np.array(rows, np.float64).reshape(-1, 3)
        poses[:, 2] = np.radians(90.0 - poses[:, 2])  # SUMO's angles are clockwise from north, in degrees
        return poses

    def expects_vehicles(self) -> bool:
        """Return whether vehicles that wait for no passenger or other vehicle are on the road or will enter."""
        return self._sumo.simulation.getMinExpectedNumber() > 0

    def route_of(self, vehicle_id: str) -> tuple[str, ...]:
        """Return the edges of a vehicle's route."""
        return tuple(self._sumo.vehicle.getRoute(vehicle_id))

    def lanes(self) -> list[NetworkLane]:
        """Return all lanes of the network except those within junctions."""
        lane = self._sumo.lane
        names = [name for name in lane.getIDList() if not name.startswith(":")]
        links = [lane.getLinks(name) for name in names]
        successors = (tuple(link[0] for link in lane_links) for lane_links in links)
        has_stop_line = (any(link[5] not in UNCONTROLLED_LINK_STATES for link in lane_links) for lane_links in links)
        properties = map(lane.getEdgeID, names), map(lane.getLength, names), map(lane.getMaxSpeed, names)
        return list(map(NetworkLane, names, *properties, successors, has_stop_line))

    def lane_positions(self, ids: Sequence[str]) -> list[tuple[str, float]]:
        """Return the vehicles' lanes, and positions along them [m]."""
        return list(zip(map(self._get_lane, ids), map(self._get_lane_position, ids), strict=True))

    def remaining_routes(self, ids: Sequence[str]) -> list[tuple[str, ...]]:
        """Return the remaining edges of the vehicles' routes, the current edge first."""
        vehicle = self._sumo.vehicle
        return [tuple(vehicle.getRoute(vehicle_id)[vehicle.getRouteIndex(vehicle_id) :]) for vehicle_id in ids]

    def desired_speeds(self, ids: Sequence[str]) -> list[tuple[float, float]]:
        """Return the vehicles' speed factors (desired speed divided by speed limit) and maximum speeds [m/s]."""
        return list(zip(map(self._sumo.vehicle.getSpeedFactor, ids), map(self.max_speed, ids), strict=True))

    def neighbors(self, ids: Sequence[str], max_distance: float) -> list[NeighborStates]:
        """Return leaders and followers of vehicles; an absent one has the gap `max_distance` [m] and their speed."""
        return [self._neighbor_states(vehicle_id, max_distance) for vehicle_id in ids]

    def _neighbor_states(self, vehicle_id: str, max_distance: float) -> NeighborStates:
        vehicle, speed = self._sumo.vehicle, self._get_speed(vehicle_id)
        if self._has_sublanes:
            leader, leader_gap, follower, follower_gap = find_lateral_neighbors(self._sumo, vehicle_id, max_distance)
        else:
            leader, leader_gap = vehicle.getLeader(vehicle_id, max_distance) or ("", 0.0)
            follower, follower_gap = vehicle.getFollower(vehicle_id, max_distance)
            # SUMO subtracts the minimum gap of the vehicle behind from a gap.
            leader_gap += vehicle.getMinGap(vehicle_id)
            follower_gap += vehicle.getMinGap(follower) if follower else 0.0
        speeds_and_gaps: list[float] = []
        for neighbor, net_gap in ((leader, leader_gap), (follower, follower_gap)):
            gap = net_gap if neighbor else max_distance
            neighbor_speed = self._get_speed(neighbor) if gap < max_distance else speed
            speeds_and_gaps += [neighbor_speed, min(max(gap, 0.0), max_distance)]
        return NeighborStates(leader if speeds_and_gaps[1] < max_distance else "", *speeds_and_gaps)

    def vehicles_on_opposite_lanes(self, ids: Sequence[str]) -> list[str]:
        """Return the vehicles among `ids` that overtake on a lane of the opposite direction."""
        edges = [self._sumo.lane.getEdgeID(lane) if lane else "" for lane in map(self._get_lane, ids)]
        rows = zip(ids, edges, self.remaining_routes(ids), strict=True)
        return [
            vehicle
            for vehicle, edge, route in rows
            if edge and edge not in route[:1] and edge[0] != INTERNAL_EDGE_PREFIX
        ]

    def is_in_contact(self, vehicle_id: str, leader: str) -> bool:
        """Return whether a vehicle overlaps with its leader on the same lane, longitudinally and laterally."""
        vehicle = self._sumo.vehicle
        gap = self._get_lane_position(leader) - vehicle.getLength(leader) - self._get_lane_position(vehicle_id)
        offset = vehicle.getLateralLanePosition(vehicle_id) - vehicle.getLateralLanePosition(leader)
        overlaps = 2.0 * abs(offset) < vehicle.getWidth(vehicle_id) + vehicle.getWidth(leader)
        return self._get_lane(vehicle_id) == self._get_lane(leader) and gap < -MIN_CONTACT_OVERLAP and overlaps

    def teleport_count(self) -> int:
        """Return SUMO's number of teleports since its start, without scheduled jumps between stops."""
        return int(self._sumo.simulation.getParameter("", "stats.teleports.total"))

    def jam_teleport_count(self) -> int:
        """Return SUMO's number of teleports since its start except those after collisions."""
        get = self._sumo.simulation.getParameter
        return sum(int(get("", f"stats.teleports.{reason}")) for reason in ("jam", "yield", "wrongLane"))

    def command_speeds(self, ids: Iterable[str], speeds: Iterable[float]) -> None:
        """Command the speeds that vehicles have after the next step [m/s]; `speeds` are Python floats."""
        _consume(starmap(self._set_speed, zip(ids, speeds, strict=True)))

    def replace_speeds(self, ids: Iterable[str], speeds: Iterable[float]) -> None:
        """Replace the vehicles' current speeds [m/s], to add noise; `speeds` are Python floats."""
        _consume(map(self._set_previous_speed, ids, speeds))

    def command_humans(self, ids: Iterable[str], right_of_way: bool, has_acceleration_limits: bool) -> None:
        """Set which limits SUMO applies to commanded human-driven vehicles; it always keeps their speeds safe."""
        mode = _speed_mode("flow", right_of_way) | (ACCELERATION_LIMIT_BITS if has_acceleration_limits else 0)
        for vehicle_id in ids:
            self._sumo.vehicle.setSpeedMode(vehicle_id, mode)

    def replay(self, vehicle_id: str, max_speed: float) -> None:
        """Let a vehicle obey `command_speeds` without any check, at up to `max_speed` [m/s]."""
        self._sumo.vehicle.setSpeedMode(vehicle_id, NO_SPEED_CHECKS)
        self.set_max_speed(vehicle_id, max_speed)

    def change_type(self, vehicle_id: str, type_id: str, is_modified_later: bool = False) -> None:
        """Change the type of a vehicle but not its speed factor.

        `is_modified_later`: keep the factor also when one of the vehicle's properties is set for the first time.
        """
        vehicle = self._sumo.vehicle
        factor = vehicle.getSpeedFactor(vehicle_id)
        vehicle.setType(vehicle_id, type_id)
        if is_modified_later:
            vehicle.setMaxSpeed(vehicle_id, vehicle.getMaxSpeed(vehicle_id))
        vehicle.setSpeedFactor(vehicle_id, factor)

    def type_of(self, vehicle_id: str) -> str:
        """Return a vehicle's type, without the suffix that SUMO adds when properties of one vehicle change."""
        return self._sumo.vehicle.getTypeID(vehicle_id).removesuffix(f"@{vehicle_id}")

    def type_limits(self, type_id: str) -> VehicleLimits:
        """Return the acceleration limits of a vehicle type."""
        types = self._sumo.vehicletype
        return VehicleLimits(types.getAccel(type_id), types.getDecel(type_id), types.getEmergencyDecel(type_id))

    def limit_braking(self, type_id: str, max_braking: float) -> None:
        """Limit the braking of a vehicle type [m/s2]."""
        types = self._sumo.vehicletype
        for set_limit in (types.setDecel, types.setEmergencyDecel, types.setApparentDecel):
            set_limit(type_id, max_braking)

    def stop_at(self, vehicle_id: str, edge: str, position: float) -> None:
        """Let a vehicle stop at a position [m] on the first lane of an edge, until `end_stop`."""
        self._sumo.vehicle.setStop(vehicle_id, edge, pos=position, laneIndex=0)

    def end_stop(self, vehicle_id: str, edge: str, position: float) -> None:
        """End the stop of a standing vehicle, or cancel the stop that a vehicle has not yet reached."""
        if self._sumo.vehicle.isStopped(vehicle_id):
            self._sumo.vehicle.resume(vehicle_id)
        else:
            self._sumo.vehicle.setStop(vehicle_id, edge, pos=position, laneIndex=0, duration=0.0)

    def take_control(
        self,
        ids: Iterable[str],
        actuation: Actuation,
        right_of_way: bool = True,
        type_template: str = "cav",
        parameters: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Make vehicles CAVs, which obey `command_speeds`; `right_of_way`: SUMO makes them yield.

        Their type becomes `type_template`, in which `{}` stands for the old type. `parameters` are set by SUMO's names.
        """
        for vehicle_id in ids:
            self.change_type(vehicle_id, type_template.format(self.type_of(vehicle_id)), actuation == "cruise")
            self._sumo.vehicle.setSpeedMode(vehicle_id, _speed_mode(actuation, right_of_way))
            for key, value in parameters.items():
                self._sumo.vehicle.setParameter(vehicle_id, key, value)

    def passages(self, loops: Sequence[InductionLoop], steps: int) -> list[DetectorPassage]:
        """Simulate up to `steps` steps, until no vehicle is expected, and return the passages over these loops.

        A vehicle that leaves a loop by changing lanes counts without a speed, as with SUMO's own detectors.
        """
        passages: dict[tuple[int, str, float], DetectorPassage] = {}
        for _ in range(steps):
            self.step()
            for index, loop in enumerate(loops):
                for vehicle, length, entry_time, exit_time, _ in self._vehicles_on_loop(loop_name(index)):
                    key = index, vehicle, entry_time
                    if exit_time > entry_time and key not in passages:  # the exit is -1 until the vehicle has left
                        has_passed = self._has_passed(vehicle, length, *loop)
                        speed = length / (exit_time - entry_time) if has_passed else nan
                        passages[key] = DetectorPassage(*key, speed)
            if not self.expects_vehicles():
                break
        return list(passages.values())

    def _has_passed(self, vehicle: str, length: float, loop_lane: str, loop_position: float) -> bool:
        """Return whether a vehicle that has just left a loop passed it completely, without a lane change."""
        if vehicle in self.arrived_vehicles():
            return True
        if vehicle in self.teleporting_vehicles():
            return False
        ((lane, position),) = self.lane_positions([vehicle])
        is_same_edge = lane.rpartition("_")[0] == loop_lane.rpartition("_")[0]
        return not is_same_edge or position - length >= loop_position

    def end_with_trips(self, vehicle_classes: dict[str, str], warmup_end: float, removes_jammed: bool) -> Trips:
        """End the episode, so that SUMO completes its trip records, and return the trips as `read_trips` does."""
        end = self.time()
        self._library.end()
        return read_trips(self._trip_file, vehicle_classes, warmup_end, end, removes_jammed)

    @property
    def is_lost(self) -> bool:
        """Whether other code of this process has changed the simulation, so that it must be opened again."""
        return self._library.is_lost

    def close(self) -> None:
        """End the simulation and remove its files; may be called twice."""
        self._library.end()
        self._library.close()
        self._folder.cleanup()

    def finish(self) -> tuple[SumoWarning, ...]:
        """End the episode, which completes SUMO's log, and return the warnings in it."""
        self._library.end()
        return read_warnings(self._error_log)

    def __exit__(self, *error: object) -> None:
        self.close()


def _speed_mode(actuation: Actuation, right_of_way: bool) -> int:
    return SPEED_MODES[actuation] if right_of_way else SPEED_MODES[actuation] & SAFE_SPEED_BIT
