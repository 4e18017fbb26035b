"""Transports to SUMO: libsumo in this process, or TraCI to a child process. Only this module imports libsumo and traci.

If the user runs a simulation in this process, unjam never closes, steps or replaces it, nor its TraCI connection.
"""

import importlib
import os
import socket
import subprocess
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, NamedTuple

from unjam.errors import LostWorkerError, MissingPartError, UnjamError
from unjam.processes import check_owner
from unjam.sandbox import restrict_writing

Transport = Literal["libsumo", "traci", "gui"]
"""`libsumo`: SUMO in this process; `traci`: SUMO as a child process; `gui`: the same with SUMO's window"""
TRANSPORT_MODULES = {"libsumo": "libsumo", "traci": "traci.main", "gui": "traci.main"}
"""module of each transport; what `import traci` loads depends on LIBSUMO_AS_TRACI and LIBTRACI_AS_TRACI"""
MAX_START_SECONDS = 600.0
"""time limit for SUMO to accept a connection [s]; SUMO reads the network first"""
CONNECT_RETRY_SECONDS = 0.02
"""time between two attempts to connect to SUMO [s]"""
_libsumo_lock = threading.Lock()
"""lock of the simulation that uses libsumo in this process; nothing waits for it"""


class InUseError(UnjamError):
    """libsumo already runs a simulation in this process, and can run only one."""


class Libsumo:
    """SUMO in this process. It detects whether other code has changed its simulation."""

    def __init__(self) -> None:
        """Claim libsumo; raise `InUseError` if a simulation of unjam or of the user is open in this process."""
        self.functions: Any = import_library("libsumo")
        get_function = partial(sumo_function, self.functions)
        self._is_loaded = get_function("simulation", "isLoaded")
        self._get_time, self._step = get_function("simulation", "getTime"), get_function("simulation", "step")
        self._get_time_step, self._get_option = (
            get_function("simulation", "getDeltaT"),
            get_function("simulation", "getOption"),
        )
        self._time_step = 1.0
        self._log_path: str | None = None
        """error log of the running simulation, which identifies it; None: no simulation runs"""
        self._step_count, self._begin_time = 0, 0.0
        self.has_refused = False
        self._is_claimed = _libsumo_lock.acquire(blocking=False)
        if not self._is_claimed or self._is_loaded():
            self.close()
            raise InUseError("a simulation is already open in this process; close it, or use another")

    @property
    def is_running(self) -> bool:
        """Whether the simulation has been started."""
        return self._log_path is not None

    @property
    def is_lost(self) -> bool:
        """Whether other code of this process has started, stepped or closed libsumo's simulation."""
        if not self._is_own():
            return True
        if self._log_path is None:
            return False
        return round((self._get_time() - self._begin_time) / self._time_step) != self._step_count

    def check(self) -> None:
        """Raise `LostWorkerError` if other code has changed the simulation. The check takes less than a microsecond."""
        if self.is_lost:
            raise LostWorkerError(
                "SUMO was lost: other code in this process has started, stepped or closed a simulation "
                "through libsumo; run the episode again"
            )

    def start(self, command: Sequence[str], log_path: Path) -> None:
        """Start SUMO with an error log at `log_path`."""
        self._log_path = str(log_path)
        self._start_simulation(self.functions.start, command)

    def load(self, options: Sequence[str]) -> None:
        """Start the simulation again with other options."""
        self._start_simulation(self.functions.load, options)

    def _start_simulation(self, function: Callable[[list[str]], object], arguments: Sequence[str]) -> None:
        """Start or load a simulation, and record its begin time and time step."""
        function([*arguments])
        self._begin_time, self._time_step = self._get_time(), self._get_time_step()
        self._step_count, self.has_refused = 0, False

    def step(self) -> None:
        """Simulate one time step."""
        try:
            self._step()
        except Exception:
            self.has_refused = True
            raise
        self._step_count += 1

    def end(self) -> None:
        """End the simulation unless it has ended already; a simulation of other code continues."""
        if self._log_path is not None and self._is_own():
            close_sumo(self.functions)
        self._log_path = None

    def close(self) -> None:
        """Release libsumo for other simulations; may be called twice."""
        if self._is_claimed:
            self._is_claimed = False
            _libsumo_lock.release()

    def _is_own(self) -> bool:
        """Return whether libsumo runs this simulation, or none if this one does not run."""
        if self._log_path is None or not self._is_loaded():
            return self._log_path is None and not self._is_loaded()
        return self._get_option("error-log") == self._log_path


class Traci:
    """SUMO as a child process, over a connection that other code in this process cannot use."""

    is_lost = has_refused = False
    """`is_lost` after an interrupt within a step: the next call would read the answer to that step"""

    def __init__(self) -> None:
        self._traci, self._owner = import_library("traci"), os.getpid()
        self.functions: Any = None

    @property
    def is_running(self) -> bool:
        """Whether SUMO has been started."""
        return self.functions is not None

    def check(self) -> None:
        """Raise `LostWorkerError` in a fork of the process that opened the connection."""
        check_owner(self._owner, "simulation: it")

    def start(self, command: Sequence[str], log_path: Path) -> None:
        """Start SUMO, which may write only into the folder of its log, and connect to it."""
        with socket.socket() as free_socket:
            free_socket.bind(("127.0.0.1", 0))
            port = free_socket.getsockname()[1]

        def start_process() -> subprocess.Popen[bytes]:
            restrict_writing(log_path.parent, Path("/dev"))  # SUMO needs screens and sockets
            return subprocess.Popen([*command, "--remote-port", str(port)], stdout=subprocess.DEVNULL)

        # The restriction applies to a thread and its child processes. This thread ends here.
        with ThreadPoolExecutor(1) as restricted_thread:
            process = restricted_thread.submit(start_process).result()
        deadline = time.monotonic() + MAX_START_SECONDS
        while self.functions is None:
            try:  # a single attempt: with several, traci prints each
                self.functions = self._traci.connect(port, numRetries=0, host="127.0.0.1", proc=process)
            except self._traci.FatalTraCIError:
                if time.monotonic() > deadline:
                    process.kill()
                    raise
                time.sleep(CONNECT_RETRY_SECONDS)
        # An open connection would print an error when this process ends.
        weakref.finalize(self, close_sumo, self.functions)
        self._step = sumo_function(self.functions, "simulation", "step")

    def load(self, options: Sequence[str]) -> None:
        """Start the simulation again with other options."""
        self.functions.load([*options])

    def step(self) -> None:
        """Simulate one time step."""
        try:
            self._step()
        except KeyboardInterrupt:
            self.is_lost = True
            raise

    def end(self) -> None:
        """End SUMO unless it has ended already."""
        if self.functions is not None:
            close_sumo(self.functions)
        self.functions = None

    def close(self) -> None:
        """Do nothing: `end` has closed the connection."""


class NeighborStates(NamedTuple):
    """Speeds [m/s] and net gaps [m] of a vehicle's leader and follower; `leader` is its id, empty without a leader."""

    leader: str
    leader_speed: float
    leader_gap: float
    follower_speed: float
    follower_gap: float


def close_sumo(sumo: Any) -> None:
    """End a simulation that may have ended already."""
    with suppress(Exception):
        sumo.close()


def sumo_function(sumo: Any, domain: str, name: str) -> Callable[..., Any]:
    """Return a function of libsumo or traci; of libsumo the compiled one, three times as fast as its Python wrapper."""
    compiled = getattr(getattr(sumo, "libsumo", None), "_libsumo", None)
    wrapper = sumo.simulationStep if name == "step" else getattr(getattr(sumo, domain), name)
    return getattr(compiled, f"{domain}_{name}", wrapper)


def import_library(transport: Transport) -> ModuleType:
    """Return the library of a transport; raise `MissingPartError` if it is not installed."""
    try:
        return importlib.import_module(TRANSPORT_MODULES[transport])
    except ImportError as error:
        name = TRANSPORT_MODULES[transport].partition(".")[0]
        raise MissingPartError(f"{name} cannot be imported ({error}); install it: pip install {name}==1.28.0") from None
