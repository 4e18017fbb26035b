"""The backend SUMO: it runs all episodes in one simulation, with a class of traffic for each kind of road."""

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
    """The backend SUMO: it uses a given simulation, or one that the first episode opens and the others reuse.

    The simulation runs in a sandboxed process (no writing, no network) for users' networks, and also, with a warning,
    if libsumo already runs a simulation in this process.
    """

    label: ClassVar[str] = "sumo"

    def __init__(self, simulation: Simulation | None = None, transport: Transport | None = None) -> None:
        """Use a simulation, which is not closed at the end, or open one with a transport when it is needed."""
        self._given_simulation = simulation
        self._transport: Transport | None = transport
        self._own_simulation: Simulation | None = None

    def supports(self, scenario: Scenario) -> str:
        """Return the reason why SUMO cannot simulate a scenario; empty if it can."""
        if type(scenario) in SCENARIO_KINDS.values():  # this is faster than to draw the road of a large network
            return ""
        road, _ = scenario.draw_from_seed((0,))
        return "" if type(road) in TRAFFIC_CLASSES else _unsupported_reason(road)

    @contextmanager
    def open(self, scenario: Scenario, seed: tuple[int, ...], options: WorldOptions) -> Iterator[Traffic[Any]]:
        """Yield the traffic of an episode; raise the errors of `run_episode`."""
        simulation = self._given_simulation or self._open_simulation(scenario.reads_user_files)
        if not simulation.episode_lock.acquire(blocking=False):
            raise UnjamError("simulation: an episode is running in it; allowed: one at a time")
        try:
            yield make_traffic(scenario, seed, simulation, options)
        except Exception as error:
            simulation.check()  # otherwise changes by other code would be reported as an error of SUMO
            unjam_error = as_unjam_error(error)
            if scenario.reads_user_files and type(unjam_error) is EpisodeError and simulation.has_refused():
                raise SumoInputError(str(unjam_error)) from error  # SUMO has met the error in a later part of a file
            raise
        finally:
            simulation.episode_lock.release()

    def _open_simulation(self, is_sandboxed: bool) -> Simulation:
        """Return the open simulation, or a new one if there is none, it is lost, or it needs a sandbox."""
        needs_sandbox, simulation = is_sandboxed and self._transport is None, self._own_simulation
        if simulation is not None and (simulation.is_lost or (needs_sandbox and not simulation.is_sandboxed)):
            self.close()
        if self._own_simulation is None:
            transport = self._transport
            self._own_simulation = open_simulation(is_sandboxed) if transport is None else Simulation(transport)
        return self._own_simulation

    def close(self) -> None:
        """Close the simulation unless it was given; may be called twice."""
        if self._own_simulation is not None:
            self._own_simulation.close()
            self._own_simulation = None

    def __exit__(self, *error: object) -> None:
        self.close()


def make_traffic(
    scenario: Scenario, seed: Sequence[int], simulation: Simulation, options: WorldOptions = DEFAULT_OPTIONS
) -> Traffic[Any]:
    """Load the road of a scenario and seed, and insert its first vehicles; nothing moves yet."""
    drawn = scenario.draw_from_seed(seed)
    return _traffic_class(drawn[0])(scenario, seed, simulation, options, drawn)


def sumo_inputs(scenario: Scenario, road: Road) -> SumoInputs:
    """Return SUMO's input files and options for a scenario and its road."""
    return _traffic_class(road).inputs(scenario, road)


def _unsupported_reason(road: Road) -> str:
    allowed = ", ".join(road_class.__name__ for road_class in TRAFFIC_CLASSES)
    return f"{type(road).__name__} is not allowed as the road of SUMO; allowed: {allowed}"


def _traffic_class(road: Road) -> type[Traffic[Any]]:
    if type(road) not in TRAFFIC_CLASSES:
        raise InputError(f"scenario: {_unsupported_reason(road)}")
    return TRAFFIC_CLASSES[type(road)]
