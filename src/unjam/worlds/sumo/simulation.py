"""SUMO: start, read, command, step."""

import io
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, redirect_stdout
from functools import partial
from itertools import count, starmap
from pathlib import Path
from tempfile import gettempdir
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from unjam.errors import EpisodeError, RefusedError, UnjamError, wrong
from unjam.processes import PrivateFolder, printed_to
from unjam.sandbox import keep_disk
from unjam.scenarios.scenario import Actuation
from unjam.sumo_files import copy_harmless, stamp_of
from unjam.worlds.sumo.files import Files
from unjam.worlds.sumo.library import Backend, close, function_of, library
from unjam.worlds.sumo.networks import FREE_LINKS, NetworkLane, said_in, sumo_program

SPEED_MODES = {"shielded": 31, "raw": 30, "flow": 25, "cruise": 31}
"""SUMO's speed mode bits for each way of actuation: bit 0 is the check for a safe speed."""
WITHOUT_RIGHT_OF_WAY = 1
"""the bit that stays where vehicles need not obey the right of way: who is surprised stops as it must"""
LIMITS_OF_ACCELERATION = 2 | 4
"""the bits by which vehicles keep to the acceleration and the braking of their type"""
_exhaust = deque(maxlen=0).extend
"""runs through an iterator, in C: a loop would cost as much as the calls"""
_open: "Simulation | None" = None
"""the one simulation that libsumo runs in this process"""
_labels = count()
"""of connections over TraCI, of which a process may have many"""


class Neighbours(NamedTuple):
    """Who is ahead of a vehicle and behind it [m/s, m from bumper to bumper]; no name: nobody is ahead."""

    leader: str
    leader_speed: float
    leader_gap: float
    follower_speed: float
    follower_gap: float


class Simulation:
    """One SUMO simulation, loaded anew for each episode.

    libsumo holds one simulation per process and silently replaces the first by a second, so this class
    refuses to open another while one is open. Over TraCI there may be several, each a process of its own.
    """

    def __init__(
        self, backend: Backend = "libsumo", gui_options: Sequence[str] = (), alone: bool = False
    ) -> None:
        """Open a simulation; nothing runs before `load`.

        `gui_options` go to SUMO's window. `alone`: this process prints nothing else while SUMO starts.
        """
        global _open
        if "," in (folder := gettempdir()):  # between the names of files that SUMO is given
            raise wrong("TMPDIR", folder, "a folder without , in its name")
        if backend == "libsumo" and _open is not None:
            raise UnjamError("a simulation is already open in this process; close it, or use another")
        self.backend = backend
        self._gui_options = gui_options
        self._sumo: Any = library(backend)
        self._folder = PrivateFolder()
        self._error_log = Path(self._folder.name) / "error.log"
        self._copies: dict[Path, tuple[tuple[int, int] | None, Path]] = {}
        """of users' own files, with the stamps of those"""
        self._running = False
        self._printed = Path(self._folder.name) / "printed.log" if alone else None
        """what SUMO says before it has a log"""
        if backend == "libsumo":
            self._bind()
            _open = self

    def _bind(self) -> None:
        """Look up the functions that are called often."""
        call = partial(function_of, self._sumo)
        self._get_speed = call("vehicle", "getSpeed")
        self._get_distance = call("vehicle", "getDistance")
        self._get_along = call("vehicle", "getLanePosition")
        self._get_lane = call("vehicle", "getLaneID")
        self._get_fuel = call("vehicle", "getFuelConsumption")
        self._set_speed = call("vehicle", "setSpeed")
        self.type_of: Callable[[str], str] = call("vehicle", "getTypeID")
        """a vehicle's type"""
        self.change_type: Callable[[str, str], object] = call("vehicle", "setType")
        """gives a vehicle another type"""
        self.fastest: Callable[[str], float] = call("vehicle", "getMaxSpeed")
        """how fast a vehicle drives at most, whatever the road allows [m/s]"""
        self.set_fastest: Callable[[str, float], object] = call("vehicle", "setMaxSpeed")
        """changes that for one vehicle"""
        self.set_headway: Callable[[str, float], object] = call("vehicle", "setTau")
        """changes the time headway that a vehicle keeps [s]"""
        self.set_parameter: Callable[[str, str, str], object] = call("vehicle", "setParameter")
        """changes one of a vehicle's other parameters, by name"""
        self._set_previous_speed = call("vehicle", "setPreviousSpeed")
        self.on_lane: Callable[[str], Sequence[str]] = call("lane", "getLastStepVehicleIDs")
        """whose front bumpers are on a lane"""
        self.vehicle_count: Callable[[], int] = call("vehicle", "getIDCount")
        """how many vehicles are on the road"""
        self.step: Callable[[], object] = call("simulation", "step")
        """simulates one time step"""
        self.departed: Callable[[], Sequence[str]] = call("simulation", "getDepartedIDList")
        """who entered the road in the last step"""
        self.arrived: Callable[[], Sequence[str]] = call("simulation", "getArrivedIDList")
        """who left the road at the end of its route in the last step"""
        self.lifted: Callable[[], Sequence[str]] = call("simulation", "getStartingTeleportIDList")
        """whom SUMO lifted off the road in the last step, for it had stood for long; and whom it put back"""
        self.put_back: Callable[[], Sequence[str]] = call("simulation", "getEndingTeleportIDList")
        self.colliding: Callable[[], Sequence[str]] = call("simulation", "getCollidingVehiclesIDList")
        """who touched another in the last step"""
        self.on_loop: Callable[[str], Sequence[Any]] = call("inductionloop", "getVehicleData")
        """who was on a loop in the last step: (name, length, when it came, when it left or -1, type)"""
        self.waiting: Callable[[], Sequence[str]] = call("simulation", "getPendingVehicles")
        """who wants to enter and cannot"""

    def load(self, files: Files, step: float, seed: int) -> None:
        """Start an episode: load network and traffic, and put the vehicles on the road.

        Raises:
            RefusedError: SUMO refuses the files; the message holds its reason.
            EpisodeError: it cannot start for another one.
        """
        traffic = Path(self._folder.name) / "traffic.rou.xml"
        traffic.write_text(files.traffic)
        named = {
            option: [self._readable(path, files) for path in paths] for option, paths in files.named.items()
        }
        named.setdefault(files.option, []).append(str(traffic))
        inputs = [f"{option}={','.join(paths)}" for option, paths in named.items() if paths]
        options = [*inputs, *files.options, *self._options(step, seed)]
        try:
            with printed_to(self._printed) if self._printed else nullcontext():
                if self._running:
                    self._sumo.load(options)
                else:
                    program = "sumo-gui" if self.backend == "gui" else "sumo"
                    self._start([sumo_program(program), *options, *self._gui_options])
                    self._running = True
                self.step()  # the first step inserts the vehicles and moves none
        except Exception as error:
            self._end()  # only then are SUMO's words in its log, and can the next episode start afresh
            words = said_in(self._error_log) or (said_in(self._printed) if self._printed else "")
            kind = RefusedError if words or self.backend != "gui" else EpisodeError  # a window may be missing
            raise kind(f"SUMO cannot start: {words or ' '.join(str(error).split())}") from error

    def _readable(self, path: Path, files: Files) -> str:
        """Return what SUMO reads instead of a file: itself, or a harmless copy of its content."""
        if path not in files.to_copy:
            return str(path)
        stamp, copy = self._copies.get(path, (None, Path(self._folder.name) / f"{len(self._copies)}.xml"))
        if stamp_of(path) != stamp:
            self._copies[path] = None, copy
            copy_harmless(path, copy)
            self._copies[path] = stamp_of(path), copy
        return str(copy)

    def _start(self, command: list[str]) -> None:
        if self.backend == "libsumo":
            self._sumo.start(command)
            return
        label = f"unjam-{next(_labels)}"
        traci = library("traci")

        def start() -> None:
            keep_disk(Path(self._folder.name), Path("/dev"))  # screens and sockets it needs
            traci.start(command, label=label)

        # A thread that ends with it: what is forbidden to SUMO is forbidden to nobody else here.
        with redirect_stdout(io.StringIO()), ThreadPoolExecutor(1) as confined:
            confined.submit(start).result()  # traci announces each of its attempts to connect
        self._sumo = traci.getConnection(label)
        # One that nobody closes would complain aloud of the lost connection as this process ends.
        weakref.finalize(self, close, self._sumo)
        self._bind()

    def _options(self, step: float, seed: int) -> list[str]:
        return [
            *("--step-length", str(step), "--seed", str(seed)),
            *("--no-step-log", "true", "--no-warnings", "true", "--duration-log.disable", "true"),
            *("--error-log", str(self._error_log)),
            # The only setting in which a collision is real contact and every one is reported.
            *("--collision.action", "warn", "--collision.mingap-factor", "0"),
            *("--collision.check-junctions", "true"),
        ]

    def speeds(self, ids: Sequence[str]) -> list[float]:
        """Return the speeds of `ids` [m/s]."""
        return list(map(self._get_speed, ids))

    def along_lanes(self, ids: Sequence[str]) -> list[float]:
        """Return how far each of `ids` is along its lane [m]."""
        return list(map(self._get_along, ids))

    def places(self, ids: Sequence[str]) -> NDArray[np.float64]:
        """Return rows (x, y, heading) of front bumpers: [m], and [rad] against the x axis."""
        vehicle = self._sumo.vehicle
        rows = [(*vehicle.getPosition(name)[:2], vehicle.getAngle(name)) for name in ids]
        places = np.array(rows, np.float64).reshape(-1, 3)
        places[:, 2] = np.radians(90.0 - places[:, 2])  # SUMO counts clockwise from north, in degrees
        return places

    def more_expected(self) -> bool:
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
        stops = (any(link[5] not in FREE_LINKS for link in each) for each in links)
        facts = map(lane.getEdgeID, names), map(lane.getLength, names), map(lane.getMaxSpeed, names)
        return list(map(NetworkLane, names, *facts, leads_to, stops))

    def lane_places(self, ids: Sequence[str]) -> list[tuple[str, float]]:
        """Return in which lane each of `ids` is, and how far along it [m]."""
        return list(zip(map(self._get_lane, ids), map(self._get_along, ids), strict=True))

    def ways(self, ids: Sequence[str]) -> list[tuple[str, ...]]:
        """Return the edges that each of `ids` has before it, its own first."""
        vehicle = self._sumo.vehicle
        return [tuple(vehicle.getRoute(name)[vehicle.getRouteIndex(name) :]) for name in ids]

    def wishes(self, ids: Sequence[str]) -> list[tuple[float, float]]:
        """Return how fast each of `ids` wants to drive over what a road allows, and at most [m/s]."""
        return list(zip(map(self._sumo.vehicle.getSpeedFactor, ids), map(self.fastest, ids), strict=True))

    def allowed_speeds(self, ids: Sequence[str]) -> list[float]:
        """Return how fast each of `ids` may drive where it is [m/s]."""
        return [self._sumo.vehicle.getAllowedSpeed(name) for name in ids]

    def neighbours(self, name: str, farthest: float) -> Neighbours:
        """Return who is ahead and behind, as SUMO sees them.

        Who is farther than `farthest` [m] is not there: as fast, and that far away.
        """
        vehicle, speed = self._sumo.vehicle, self._get_speed(name)
        leader, ahead = vehicle.getLeader(name, farthest) or ("", 0.0)
        follower, behind = vehicle.getFollower(name, farthest)
        found: list[float] = []
        for other, gap, keeper in ((leader, ahead, name), (follower, behind, follower)):
            # SUMO's gap lacks the one that the vehicle behind keeps.
            true_gap = gap + vehicle.getMinGap(keeper) if other else farthest
            there = true_gap < farthest
            found += [self._get_speed(other) if there else speed, min(max(true_gap, 0.0), farthest)]
        return Neighbours(leader if found[1] < farthest else "", *found)

    def distances(self, ids: Sequence[str]) -> list[float]:
        """Return how far each of `ids` has driven since it entered [m]."""
        return list(map(self._get_distance, ids))

    def fuel(self, ids: Sequence[str]) -> list[float]:
        """Return the fuel rates of `ids` in the last step [mg/s], by their emission class."""
        return list(map(self._get_fuel, ids))

    def command_speeds(self, ids: Iterable[str], speeds: Iterable[float]) -> None:
        """Ask for the speeds that `ids` shall have after the next step [m/s]: plain floats."""
        _exhaust(starmap(self._set_speed, zip(ids, speeds, strict=True)))

    def replace_speeds(self, ids: Iterable[str], speeds: Iterable[float]) -> None:
        """Give `ids` other current speeds [m/s], plain floats: how noise enters."""
        _exhaust(map(self._set_previous_speed, ids, speeds))

    def command_people(self, ids: Iterable[str], right_of_way: bool, bounded: bool) -> None:
        """Let SUMO keep `ids` safe and to the right of way and, if `bounded`, to limits of acceleration."""
        mode = SPEED_MODES["flow"] if right_of_way else SPEED_MODES["flow"] & WITHOUT_RIGHT_OF_WAY
        mode |= LIMITS_OF_ACCELERATION if bounded else 0
        for name in ids:
            self._sumo.vehicle.setSpeedMode(name, mode)

    def take_control(
        self, ids: Iterable[str], actuation: Actuation, right_of_way: bool = True, types: str = "cav"
    ) -> None:
        """Make `ids` CAVs: from now on they obey `command_speeds`.

        Their type becomes `types`, in which `{}` stands for the type that they had.
        """
        mode = SPEED_MODES[actuation] if right_of_way else SPEED_MODES[actuation] & WITHOUT_RIGHT_OF_WAY
        for name in ids:
            self._sumo.vehicle.setType(name, types.format(self._sumo.vehicle.getTypeID(name)))
            self._sumo.vehicle.setSpeedMode(name, mode)

    def close(self) -> None:
        """End the simulation and remove its files; may be called twice."""
        global _open
        if self._running:
            self._end()
        self._folder.cleanup()
        if _open is self:
            _open = None

    def _end(self) -> None:
        """End SUMO; one that is gone already is no error."""
        self._running = False
        close(self._sumo)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def is_open() -> bool:
    """Return whether libsumo runs a simulation in this process."""
    return _open is not None
