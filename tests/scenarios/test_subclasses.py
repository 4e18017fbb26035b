"""Classes of the user's own are simulated as they are, or refused: never as the class from which they derive."""

from dataclasses import replace
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
@pytest.mark.parametrize("member", ["draw", "top_speed", "helper"])
def test_no_subclass_with_code_is_simulated_in_a_batch(kind: type[Scenario], member: str) -> None:
    changed = {"draw": kind.draw, "top_speed": property(lambda self: 5.0), "helper": len}
    scenario = subclass_of(kind, **{member: changed[member]})
    assert unsupported_reason(scenario)
    assert statistically_unsupported_reason(scenario)
    with pytest.raises(InputError, match=f"Other{kind.__name__} may have another road than {scenario.title}"):
        run_batch([EpisodeTask(scenario, Human(), (1,))], allow_statistical=True)


@pytest.mark.parametrize("kind", [Ring, FigureEight, Motorway])
def test_a_subclass_with_other_values_is_simulated_in_a_batch_as_its_base(kind: type[Scenario]) -> None:
    own, base = subclass_of(kind, title="mine", horizon=4), kind(horizon=4)
    own_speeds, base_speeds = (run_episode(each, Human(), 1, backend="batch").speeds for each in (own, base))
    np.testing.assert_array_equal(own_speeds, base_speeds)
    with pytest.raises(InputError, match=r"scenario: simulation_step: 0.7 is not allowed in a batch; allowed: "):
        run_episode(replace(own, simulation_step=0.7), Human(), 1, backend="batch")
