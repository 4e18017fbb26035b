"""Classes of the user's own are simulated as they are, or refused: never as the class from which they derive."""

from typing import Any, ClassVar

import numpy as np
import pytest

from unjam.drivers import Human
from unjam.errors import InputError
from unjam.scenarios import FigureEight, Merge, Motorway, Ring, scenario_recipe
from unjam.scenarios.road import ClosedRoad
from unjam.scenarios.scenario import Scenario
from unjam.worlds.batch.run import run_batch
from unjam.worlds.batch.support import statistically_unsupported_reason, unsupported_reason
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool


class LongRing(Ring):
    """A ring that is longer than its settings say."""

    def draw(self, generator: np.random.Generator) -> ClosedRoad:
        """Return the road of a longer ring."""
        return Ring(length=(300, 300), vehicles=self.vehicles).draw(generator)


class NamedRing(LongRing):
    """The same with a title of its own."""

    title: ClassVar[str] = "long ring"


def subclass_of(kind: type[Scenario], **members: Any) -> Scenario:
    return type(f"Other{kind.__name__}", (kind,), members)()


@pytest.mark.parametrize("scenario", [LongRing(), NamedRing()])
def test_a_subclass_is_simulated_in_one_process_and_refused_in_others(scenario: Ring, sumo: SumoBackend) -> None:
    scenario = type(scenario)(horizon=5)
    assert run_episode(scenario, Human(), 1, backend=sumo).loop_length == 300.0
    words = rf"scenario: the class {type(scenario).__name__} is not allowed in a file or another process, "
    with pytest.raises(InputError, match=words), WorkerPool(1) as workers:
        workers.run([EpisodeTask(scenario, Human(), (1,))])


@pytest.mark.parametrize("kind", [Ring, FigureEight, Merge, Motorway])
def test_no_subclass_becomes_its_base_class_in_a_file(kind: type[Scenario]) -> None:
    for members in ({}, {"title": "other"}):
        with pytest.raises(InputError, match=f"Other{kind.__name__} is not allowed"):
            scenario_recipe(subclass_of(kind, **members))


@pytest.mark.parametrize("kind", [Ring, FigureEight, Motorway])
def test_no_subclass_is_simulated_in_a_batch(kind: type[Scenario]) -> None:
    scenario = subclass_of(kind)
    assert unsupported_reason(scenario)
    assert statistically_unsupported_reason(scenario)
    with pytest.raises(InputError, match=f"Other{kind.__name__} may have another road than {scenario.title}"):
        run_batch([EpisodeTask(scenario, Human(), (1,))], allow_statistical=True)
