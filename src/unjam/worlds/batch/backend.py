"""The batch as a backend: batches of one road, which environments and pictures can inspect."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar, cast

from unjam.drivers.local_state import LocalState
from unjam.errors import UnjamError
from unjam.physics.arrays import Floats
from unjam.scenarios.motorway import Motorway
from unjam.scenarios.ring import LoopScenario
from unjam.scenarios.scenario import Scenario
from unjam.worlds.backend import WorldOptions, check_support
from unjam.worlds.batch.motorway.vehicles import KEYS_PER_ROAD
from unjam.worlds.batch.motorway.world import MotorwayBatch
from unjam.worlds.batch.ring.recorded import RecordedBatch
from unjam.worlds.batch.ring.world import RingBatch
from unjam.worlds.batch.support import required_batch_kind, statistically_unsupported_reason
from unjam.worlds.ordered_road import ordered_scene
from unjam.worlds.road_world import RoadScene, RoadWorld
from unjam.worlds.world import DriverLog


class BatchBackend:
    """Simulates one road at a time in a batch; `run_batches` simulates many roads at once."""

    label: ClassVar[str] = "batch"

    def supports(self, scenario: Scenario) -> str:
        """Return why a batch cannot simulate a scenario, not even in distribution; empty if it can."""
        return statistically_unsupported_reason(scenario)

    @contextmanager
    def open(self, scenario: Scenario, seed: tuple[int, ...], options: WorldOptions) -> Iterator[RoadWorld]:
        """Yield the road of an episode; raise `InputError` if a batch cannot simulate it."""
        check_support(self, scenario)
        world = SINGLE_ROADS[required_batch_kind(scenario).world](scenario, seed)
        world.measured_fields = options.measured_fields
        yield world


class _SingleRoad:
    """The common part of batches with one road."""

    roads: Sequence[Any]

    @property
    def road(self) -> Any:
        return self.roads[0]

    @property
    def has_crashed(self) -> bool:
        return bool(cast(Any, self).crashed_roads[0])

    @property
    def has_ended(self) -> bool:
        return self.has_crashed or cast(Any, super()).has_ended

    def record(self, driver_log: DriverLog) -> Any:
        return cast(Any, super()).record(driver_log)[0]

    def record_so_far(self) -> Any:
        return self.record(DriverLog())


class SingleRing(_SingleRoad, RingBatch):
    """A batch of one closed road."""

    backlog, expects_cavs = 0, False

    def __init__(self, scenario: LoopScenario, seed: Sequence[int]) -> None:
        super().__init__([scenario], [seed])
        self.cav_ids = self.road.cav_ids

    @property
    def speeds(self) -> Floats:
        """Speeds of all vehicles with a driver [m/s]."""
        return super().speeds[:, 0]

    def scene(self) -> RoadScene:
        """Return the current state of the road for pictures."""
        return ordered_scene(self.road, self._position[:, 0], self._speed[:-1, 0])


class SingleRecordedRoad(SingleRing, RecordedBatch):
    """A batch of one recorded road."""


class SingleMotorway(_SingleRoad, MotorwayBatch):
    """A batch of one motorway."""

    def __init__(self, scenario: Motorway, seed: Sequence[int]) -> None:
        super().__init__(scenario, [seed])

    @property
    def cav_ids(self) -> list[str]:
        """Ids of the CAVs on the road, in order of entry."""
        return [self.road.entries[key % KEYS_PER_ROAD].name for key in self._cav_keys.tolist()]

    @property
    def speeds(self) -> Floats:
        """Speeds of all vehicles [m/s]."""
        return self._traffic.vehicles.speed

    @property
    def backlog(self) -> int:
        """Current insertion backlog [vehicles]."""
        return int(self.backlogs[0])

    @property
    def expects_cavs(self) -> bool:
        """Whether a CAV may still enter."""
        return self.entered_count < len(self.road.cav_ids)

    def exact_state(self) -> LocalState:
        """Return the exact local state of the CAVs, whose sensors have no errors here."""
        return self.local_state()

    def scene(self) -> RoadScene:
        """Raise `UnjamError`, because batches of motorways have no coordinates."""
        raise UnjamError("render: the batch draws no pictures of motorways; allowed: backend='sumo'")


SINGLE_ROADS: dict[type, Any] = {
    RingBatch: SingleRing,
    RecordedBatch: SingleRecordedRoad,
    MotorwayBatch: SingleMotorway,
}
