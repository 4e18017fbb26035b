"""SUMO as a backend: one simulation for all episodes, and the traffic of each kind of road."""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any, ClassVar

from unjam.errors import EpisodeError, InputError, SumoInputError, UnjamError, as_unjam_error
from unjam.scenarios import SCENARIO_KINDS
from unjam.scenarios.motorway_road import MotorwayRoad
from unjam.scenarios.road import ClosedRoad, MergeRoad, RecordedRoad, Road, UserNetworkRoad
from unjam.scenarios.scenario import Scenario
from unjam.worlds.backend import DEFAULT_OPTIONS, WorldOptions
from unjam.worlds.sumo.inputs import SumoInputs
from unjam.worlds.sumo.merge_road import MergingTraffic
from unjam.worlds.sumo.motorway import MotorwayTraffic
from unjam.worlds.sumo.ordered_road import OrderedTraffic, RecordedTraffic
from unjam.worlds.sumo.sandboxed import open_simulation
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.traffic import Traffic
from unjam.worlds.sumo.transports import Transport
from unjam.worlds.sumo.user_network import UserNetworkTraffic

TRAFFIC_CLASSES: dict[type[Road], type[Traffic[Any]]] = {
    ClosedRoad: OrderedTraffic,
    MergeRoad: MergingTraffic,
    MotorwayRoad: MotorwayTraffic,
    RecordedRoad: RecordedTraffic,
    UserNetworkRoad: UserNetworkTraffic,
}


class SumoBackend(AbstractContextManager["SumoBackend"]):
    """SUMO: a given simulation, or one that the first episode opens and the others reuse.

    It runs in a sandboxed process (no writing, no network) for users' networks, and in its own process with a warning
    if libsumo already holds a simulation in this process.
    """

    label: ClassVar[str] = "sumo"

    def __init__(self, simulation: Simulation | None = None, transport: Transport | None = None) -> None:
        """Use a simulation, which is not closed at the end, or open one of a transport when it is needed."""
        self._given = simulation
        self._transport: Transport | None = transport
        self._opened: Simulation | None = None

    def supports(self, scenario: Scenario) -> str:
        """Return why SUMO cannot simulate a scenario; empty if it can."""
        if type(scenario) in SCENARIO_KINDS.values():  # drawing the roads of large networks takes time
            return ""
        road, _ = scenario.draw_from_seed((0,))
        return "" if type(road) in TRAFFIC_CLASSES else _unsupported_reason(road)

    @contextmanager
    def open(self, scenario: Scenario, seed: tuple[int, ...], options: WorldOptions) -> Iterator[Traffic[Any]]:
        """Yield the traffic of an episode; raise errors as `run_episode`."""
        simulation = self._given or self._open_simulation(scenario.reads_user_files)
        if not simulation.episode_lock.acquire(blocking=False):
            raise UnjamError("simulation: an episode is running in it; allowed: one at a time")
        try:
            yield make_traffic(scenario, seed, simulation, options)
        except Exception as error:
            simulation.check()  # otherwise changes by other code would be reported as an error of SUMO
            unjam_error = as_unjam_error(error)
            if scenario.reads_user_files and type(unjam_error) is EpisodeError and simulation.has_refused():
                raise SumoInputError(str(unjam_error)) from error  # SUMO read further into a file
            raise
        finally:
            simulation.episode_lock.release()

    def _open_simulation(self, is_sandboxed: bool) -> Simulation:
        """Return the open simulation, or a new one if there is none, it is lost, or a sandbox is missing."""
        lacks_sandbox = is_sandboxed and self._transport is None
        opened = self._opened
        if opened is not None and (opened.is_lost or (lacks_sandbox and not opened.is_sandboxed)):
            self.close()
        if self._opened is None:
            transport = self._transport
            self._opened = open_simulation(is_sandboxed) if transport is None else Simulation(transport)
        return self._opened

    def close(self) -> None:
        """Close the simulation unless it was given; may be called twice."""
        if self._opened is not None:
            self._opened.close()
            self._opened = None

    def __exit__(self, *error: object) -> None:
        self.close()


def make_traffic(
    scenario: Scenario, seed: Sequence[int], simulation: Simulation, options: WorldOptions = DEFAULT_OPTIONS
) -> Traffic[Any]:
    """Put the vehicles of a seed on the road; nothing moves yet."""
    drawn = scenario.draw_from_seed(seed)
    return _traffic_class(drawn[0])(scenario, seed, simulation, options, drawn)


def sumo_inputs(scenario: Scenario, road: Road) -> SumoInputs:
    """Return the network and traffic of a scenario and its road, as SUMO reads them."""
    return _traffic_class(road).inputs(scenario, road)


def _unsupported_reason(road: Road) -> str:
    allowed = ", ".join(each.__name__ for each in TRAFFIC_CLASSES)
    return f"{type(road).__name__} is not allowed as the road of SUMO; allowed: {allowed}"


def _traffic_class(road: Road) -> type[Traffic[Any]]:
    if type(road) not in TRAFFIC_CLASSES:
        raise InputError(f"scenario: {_unsupported_reason(road)}")
    return TRAFFIC_CLASSES[type(road)]
