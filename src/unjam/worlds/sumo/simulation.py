"""A SUMO simulation: start, read, command, step; and how vehicles carry out commands."""

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
"""overlap that is not a rounding error [m]"""
SPEED_MODES = {"shielded": 31, "raw": 30, "flow": 25, "cruise": 31}
"""SUMO's speed mode for each kind of actuation: bit 0 is the check for a safe speed"""
NO_SPEED_CHECKS = 32
"""SUMO's speed mode without any check, not even of the right of way"""
SAFE_SPEED_BIT = 1
"""the bit that stays without right of way: surprised vehicles still stop"""
ACCELERATION_LIMIT_BITS = 2 | 4
"""bits by which vehicles keep the acceleration and deceleration limits of their type"""
_consume = deque(maxlen=0).extend
"""exhausts an iterator in C: a loop would take as long as the calls"""


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
    """A vehicle that drove over a loop."""

    loop: int
    vehicle: str
    time: float
    """time at which its front bumper reached the loop [s]"""
    speed: float
    """mean speed above the loop [m/s]; NaN if it changed lanes before its rear had passed"""


def loop_name(number: int) -> str:
    """Return the name of an induction loop in SUMO."""
    return f"unjam_loop_{number}"


class Simulation(AbstractContextManager["Simulation"]):
    """One SUMO simulation, loaded again for each episode.

    libsumo silently replaces the simulation of a process by a second one. So this class refuses to open another, and
    detects if other code starts, steps or closes one meanwhile. Over TraCI each has its own process.
    """

    is_sandboxed = False

    def __init__(
        self, transport: Transport = "libsumo", gui_options: Sequence[str] = (), owns_stdout: bool = False
    ) -> None:
        """Open a simulation; raise `InUseError` if libsumo already runs one. `owns_stdout`: nothing else is printed."""
        if "," in (folder := gettempdir()):  # separates the names of SUMO's files
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
        """SUMO's messages before it has a log"""
        self._harmless_copies: dict[tuple[Path, int], tuple[list[tuple[int, int]], Path]] = {}
        """harmless copies of users' files, with the stamps of the files from which they are made"""
        self.episode_lock = Lock()
        if transport == "libsumo":
            self._bind()

    def _bind(self) -> None:
        self._sumo: Any = self._library.functions
        call = partial(sumo_function, self._sumo)
        self._get_speed, self._get_lane = call("vehicle", "getSpeed"), call("vehicle", "getLaneID")
        self._get_lane_position = call("vehicle", "getLanePosition")
        self._get_allowed_speed = call("vehicle", "getAllowedSpeed")
        self._set_speed, self._set_previous_speed = call("vehicle", "setSpeed"), call("vehicle", "setPreviousSpeed")

        def call_for_each(name: str) -> Callable[[Sequence[str]], list[float]]:
            function = call("vehicle", name)
            return lambda ids: list(map(function, ids))

        self.speeds = call_for_each("getSpeed")
        self.lane_offsets = call_for_each("getLanePosition")
        """positions of vehicles along their lanes [m]"""
        self.distances = call_for_each("getDistance")
        """distances that vehicles have driven since their entry [m]"""
        self.fuel = call_for_each("getFuelConsumption")
        """fuel rates of vehicles in the last step [mg/s], by their emission class"""
        self.time: Callable[[], float] = call("simulation", "getTime")
        self.max_speed: Callable[[str], float] = call("vehicle", "getMaxSpeed")
        """maximum speed of a vehicle, whatever the road allows [m/s]"""
        self.set_max_speed: Callable[[str, float], object] = call("vehicle", "setMaxSpeed")
        self.set_time_gap: Callable[[str, float], object] = call("vehicle", "setTau")
        self.vehicles_on_lane: Callable[[str], Sequence[str]] = call("lane", "getLastStepVehicleIDs")
        self.vehicle_count: Callable[[], int] = call("vehicle", "getIDCount")
        self.departed_vehicles: Callable[[], Sequence[str]] = call("simulation", "getDepartedIDList")
        """vehicles that entered the road in the last step"""
        self.arrived_vehicles: Callable[[], Sequence[str]] = call("simulation", "getArrivedIDList")
        """vehicles that left the road at the end of their route in the last step"""
        self.teleporting_vehicles: Callable[[], Sequence[str]] = call("simulation", "getStartingTeleportIDList")
        """vehicles that SUMO teleported in the last step; below: those that it reinserted"""
        self.reinserted_vehicles: Callable[[], Sequence[str]] = call("simulation", "getEndingTeleportIDList")
        self.colliding_vehicles: Callable[[], Sequence[str]] = call("simulation", "getCollidingVehiclesIDList")
        self._vehicles_on_loop = call("inductionloop", "getVehicleData")
        self.pending_vehicles: Callable[[], Sequence[str]] = call("simulation", "getPendingVehicles")

    def has_refused(self) -> bool:
        """Return whether a step of this episode has failed: SUMO refuses later content of a file."""
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
        options = [f"{option}={','.join(each)}" for option, each in paths.items() if each]
        options += [*inputs.options, "--step-length", str(step), "--seed", str(seed)]
        options += ["--no-step-log", "true", "--duration-log.disable", "true"]
        # Warnings only go to the log, which keeps one example and the number of each kind.
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
                        self._bind()
                self._has_sublanes = float(self._sumo.simulation.getOption("lateral-resolution")) > 0.0
                self.step()  # the first step inserts the vehicles and moves none
        except Exception as error:
            self._library.end()  # then SUMO's message is in its log, and the next episode can start
            logs = [self._error_log, *([self._stdout_log] if self._stdout_log else [])]
            message = next(filter(None, map(last_error_message, logs)), "")
            kind = SumoInputError if message or self.transport != "gui" else EpisodeError  # a window may be missing
            raise kind(f"SUMO cannot start: {message or ' '.join(str(error).split())}") from error

    def _readable_path(self, path: Path, inputs: SumoInputs) -> str:
        """Return the file that SUMO reads: the given one, or a harmless copy of its content."""
        if path not in inputs.copied_files:
            return str(path)
        new_copy = Path(self._folder.name) / f"{len(self._harmless_copies)}.xml"
        key = path, inputs.driver_count
        before, copy = self._harmless_copies.get(key, ([], new_copy))
        if (stamps := list(map(file_stamp, inputs.copied_files[path]))) != before:
            self._harmless_copies[key] = [], copy
            write_harmless_copy(path, copy, inputs.driver_count)
            self._harmless_copies[key] = stamps, copy
        return str(copy)

    def allowed_speeds(self, ids: Sequence[str]) -> list[float]:
        """Return the speeds that the road allows to vehicles [m/s]; NaN for one that is parked off the road."""
        return [speed if speed >= 0.0 else nan for speed in map(self._get_allowed_speed, ids)]

    def uncapped_speeds(self, ids: Sequence[str]) -> list[float]:
        """Return lane limit times speed factor of vehicles [m/s], whatever their maximum speed; NaN off the road."""
        limit, factor, lanes = self._sumo.lane.getMaxSpeed, self._sumo.vehicle.getSpeedFactor, map(self._get_lane, ids)
        return [limit(lane) * factor(name) if lane else nan for name, lane in zip(ids, lanes, strict=True)]

    def poses(self, ids: Sequence[str]) -> Floats:
        """Return rows (x, y, heading) of front bumpers: [m], and [rad] against the x axis."""
        vehicle = self._sumo.vehicle
        rows = [(*vehicle.getPosition(name)[:2], vehicle.getAngle(name)) for name in ids]
        poses = np.array(rows, np.float64).reshape(-1, 3)
        poses[:, 2] = np.radians(90.0 - poses[:, 2])  # SUMO's angles are clockwise from north, in degrees
        return poses

    def expects_vehicles(self) -> bool:
        """Return whether vehicles are on the road or will enter."""
        return self._sumo.simulation.getMinExpectedNumber() > 0

    def route_of(self, name: str) -> tuple[str, ...]:
        """Return the edges of a vehicle's route."""
        return tuple(self._sumo.vehicle.getRoute(name))

    def lanes(self) -> list[NetworkLane]:
        """Return all lanes of the network except those of junctions."""
        lane = self._sumo.lane
        names = [name for name in lane.getIDList() if not name.startswith(":")]
        links = [lane.getLinks(name) for name in names]
        successors = (tuple(link[0] for link in each) for each in links)
        has_stop_line = (any(link[5] not in UNCONTROLLED_LINK_STATES for link in each) for each in links)
        values = map(lane.getEdgeID, names), map(lane.getLength, names), map(lane.getMaxSpeed, names)
        return list(map(NetworkLane, names, *values, successors, has_stop_line))

    def lane_positions(self, ids: Sequence[str]) -> list[tuple[str, float]]:
        """Return the vehicles' lanes, and positions along them [m]."""
        return list(zip(map(self._get_lane, ids), map(self._get_lane_position, ids), strict=True))

    def remaining_routes(self, ids: Sequence[str]) -> list[tuple[str, ...]]:
        """Return the remaining edges of the vehicles' routes, the current edge first."""
        vehicle = self._sumo.vehicle
        return [tuple(vehicle.getRoute(name)[vehicle.getRouteIndex(name) :]) for name in ids]

    def desired_speeds(self, ids: Sequence[str]) -> list[tuple[float, float]]:
        """Return the vehicles' desired speeds over the speed limit, and their maximum speeds [m/s]."""
        return list(zip(map(self._sumo.vehicle.getSpeedFactor, ids), map(self.max_speed, ids), strict=True))

    def neighbors(self, ids: Sequence[str], max_distance: float) -> list[NeighborStates]:
        """Return the vehicles' neighbors as SUMO sees them; beyond `max_distance` [m], this gap and their own speed."""
        return [self._neighbors_of(name, max_distance) for name in ids]

    def _neighbors_of(self, name: str, max_distance: float) -> NeighborStates:
        vehicle, speed = self._sumo.vehicle, self._get_speed(name)
        if self._has_sublanes:
            leader, leader_gap, follower, follower_gap = find_lateral_neighbors(self._sumo, name, max_distance)
        else:
            leader, leader_gap = vehicle.getLeader(name, max_distance) or ("", 0.0)
            follower, follower_gap = vehicle.getFollower(name, max_distance)
            # SUMO's gap does not include the minimum gap of the vehicle behind.
            leader_gap += vehicle.getMinGap(name)
            follower_gap += vehicle.getMinGap(follower) if follower else 0.0
        values: list[float] = []
        for other, net_gap in ((leader, leader_gap), (follower, follower_gap)):
            gap = net_gap if other else max_distance
            values += [self._get_speed(other) if gap < max_distance else speed, min(max(gap, 0.0), max_distance)]
        return NeighborStates(leader if values[1] < max_distance else "", *values)

    def vehicles_on_opposite_lanes(self, ids: Sequence[str]) -> list[str]:
        """Return the vehicles that drive on a lane of the opposite direction, to overtake."""
        edges = [self._sumo.lane.getEdgeID(lane) if lane else "" for lane in map(self._get_lane, ids)]
        rows = zip(ids, edges, self.remaining_routes(ids), strict=True)
        return [name for name, edge, route in rows if edge not in ("", *route[:1]) and edge[0] != INTERNAL_EDGE_PREFIX]

    def is_in_contact(self, name: str, leader: str) -> bool:
        """Return whether a vehicle overlaps with the leader on its lane, longitudinally and laterally."""
        vehicle = self._sumo.vehicle
        gap = self._get_lane_position(leader) - vehicle.getLength(leader) - self._get_lane_position(name)
        lateral = vehicle.getLateralLanePosition(name) - vehicle.getLateralLanePosition(leader)
        overlaps = 2.0 * abs(lateral) < vehicle.getWidth(name) + vehicle.getWidth(leader)
        return self._get_lane(name) == self._get_lane(leader) and gap < -MIN_CONTACT_OVERLAP and overlaps

    def teleport_count(self) -> int:
        """Return SUMO's number of teleports since its start, without intended jumps from stop to stop."""
        return int(self._sumo.simulation.getParameter("", "stats.teleports.total"))

    def jam_teleport_count(self) -> int:
        """Return SUMO's number of teleports since its start that are no consequence of a collision."""
        get = self._sumo.simulation.getParameter
        return sum(int(get("", f"stats.teleports.{reason}")) for reason in ("jam", "yield", "wrongLane"))

    def command_speeds(self, ids: Iterable[str], speeds: Iterable[float]) -> None:
        """Command the vehicles' speeds after the next step [m/s]: plain floats."""
        _consume(starmap(self._set_speed, zip(ids, speeds, strict=True)))

    def replace_speeds(self, ids: Iterable[str], speeds: Iterable[float]) -> None:
        """Replace the vehicles' current speeds [m/s], plain floats: this adds noise."""
        _consume(map(self._set_previous_speed, ids, speeds))

    def command_humans(self, ids: Iterable[str], right_of_way: bool, has_acceleration_limits: bool) -> None:
        """Set which of SUMO's checks apply to commanded human-driven vehicles; their speed is always safe."""
        mode = _speed_mode("flow", right_of_way) | (ACCELERATION_LIMIT_BITS if has_acceleration_limits else 0)
        for name in ids:
            self._sumo.vehicle.setSpeedMode(name, mode)

    def replay(self, name: str, max_speed: float) -> None:
        """Let a vehicle obey `command_speeds` without any check, at up to `max_speed` [m/s]."""
        self._sumo.vehicle.setSpeedMode(name, NO_SPEED_CHECKS)
        self.set_max_speed(name, max_speed)

    def change_type(self, name: str, kind: str, is_modified_later: bool = False) -> None:
        """Change the type of a vehicle but not its speed factor, now and when its properties are first modified."""
        vehicle = self._sumo.vehicle
        factor = vehicle.getSpeedFactor(name)
        vehicle.setType(name, kind)
        if is_modified_later:
            vehicle.setMaxSpeed(name, vehicle.getMaxSpeed(name))
        vehicle.setSpeedFactor(name, factor)

    def type_of(self, name: str) -> str:
        """Return a vehicle's type, without the suffix that SUMO adds when properties of one vehicle change."""
        return self._sumo.vehicle.getTypeID(name).removesuffix(f"@{name}")

    def type_limits(self, kind: str) -> VehicleLimits:
        """Return the acceleration limits of a vehicle type."""
        types = self._sumo.vehicletype
        return VehicleLimits(types.getAccel(kind), types.getDecel(kind), types.getEmergencyDecel(kind))

    def limit_braking(self, kind: str, max_braking: float) -> None:
        """Limit the braking of a vehicle type [m/s2]."""
        types = self._sumo.vehicletype
        for set_limit in (types.setDecel, types.setEmergencyDecel, types.setApparentDecel):
            set_limit(kind, max_braking)

    def stop_at(self, name: str, edge: str, position: float) -> None:
        """Let a vehicle stop on the first lane of an edge [m], until `end_stop`."""
        self._sumo.vehicle.setStop(name, edge, pos=position, laneIndex=0)

    def end_stop(self, name: str, edge: str, position: float) -> None:
        """Let a vehicle drive on, whether it stands at its stop or has not yet reached it."""
        if self._sumo.vehicle.isStopped(name):
            self._sumo.vehicle.resume(name)
        else:
            self._sumo.vehicle.setStop(name, edge, pos=position, laneIndex=0, duration=0.0)

    def take_control(
        self,
        ids: Iterable[str],
        actuation: Actuation,
        right_of_way: bool = True,
        type_template: str = "cav",
        parameters: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Make vehicles CAVs, which obey `command_speeds`, with or without right of way.

        In `type_template`, `{}` stands for the old type; `parameters` are further ones, by SUMO's names.
        """
        for name in ids:
            self.change_type(name, type_template.format(self.type_of(name)), actuation == "cruise")
            self._sumo.vehicle.setSpeedMode(name, _speed_mode(actuation, right_of_way))
            for key, value in parameters.items():
                self._sumo.vehicle.setParameter(name, key, value)

    def passages(self, loops: Sequence[InductionLoop], steps: int) -> list[DetectorPassage]:
        """Simulate steps, until no vehicle is expected, and return the passages over these loops.

        A vehicle that leaves a loop by changing lanes counts without a speed, as with SUMO's own detectors.
        """
        found: dict[tuple[int, str, float], DetectorPassage] = {}
        for _ in range(steps):
            self.step()
            for number, loop in enumerate(loops):
                for vehicle, length, entry_time, exit_time, _ in self._vehicles_on_loop(loop_name(number)):
                    key = number, vehicle, entry_time
                    if exit_time > entry_time and key not in found:  # -1 while the vehicle is on the loop
                        has_passed = self._has_passed(vehicle, length, *loop)
                        speed = length / (exit_time - entry_time) if has_passed else nan
                        found[key] = DetectorPassage(*key, speed)
            if not self.expects_vehicles():
                break
        return list(found.values())

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
        """End the episode, so that SUMO writes its last records, and return the trips as `read_trips` does."""
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
        """End the episode and return SUMO's warnings: its log is only complete after its end."""
        self._library.end()
        return read_warnings(self._error_log)

    def __exit__(self, *error: object) -> None:
        self.close()


def _speed_mode(actuation: Actuation, right_of_way: bool) -> int:
    return SPEED_MODES[actuation] if right_of_way else SPEED_MODES[actuation] & SAFE_SPEED_BIT
