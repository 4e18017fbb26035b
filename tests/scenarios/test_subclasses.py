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
@pytest.mark.parametrize("member", ["draw", "top_speed", "sumo_human_gap", "is_closed"])
def test_no_subclass_with_code_is_simulated_in_a_batch(kind: type[Scenario], member: str) -> None:
    changed = {"draw": lambda self, generator: kind.draw(self, generator), "top_speed": property(lambda self: 5.0)}
    values = {"sumo_human_gap": 3.0, "is_closed": not kind.is_closed}
    scenario = subclass_of(kind, **{member: (changed | values)[member]})
    assert unsupported_reason(scenario)
    assert statistically_unsupported_reason(scenario)
    with pytest.raises(InputError, match=f"Other{kind.__name__}.{member} is not allowed: the backend"):
        run_batch([EpisodeTask(scenario, Human(), (1,))], allow_statistical=True)


@pytest.mark.parametrize("kind", [Ring, FigureEight, Motorway])
def test_a_subclass_with_other_values_is_simulated_in_a_batch_as_its_base(kind: type[Scenario]) -> None:
    own, base = subclass_of(kind, title="mine", horizon=4), kind(horizon=4)
    own_speeds, base_speeds = (run_episode(each, Human(), 1, backend="batch").speeds for each in (own, base))
    np.testing.assert_array_equal(own_speeds, base_speeds)
    with pytest.raises(InputError, match=r"scenario: simulation_step: 0.7 is not allowed in a batch; allowed: "):
        run_episode(replace(own, simulation_step=0.7), Human(), 1, backend="batch")


class Constants:
    """A mixin with a member of its own, a value of a setting, and a method."""

    marker, noise = 3, 0.4

    def twice(self) -> int:
        """Return a number."""
        return 2


@pytest.mark.parametrize("kind", [Ring, FigureEight])
def test_a_mixin_with_members_of_its_own_changes_the_values_that_it_names(kind: type[Scenario]) -> None:
    mixed: Any = type("Mixed", (Constants, kind), {"horizon": 4})
    assert (mixed().noise, mixed().marker, mixed(noise=0.1).noise) == (0.4, 3, 0.1)
    mixed_speeds, expected = (
        run_episode(each, Human(), 1, backend="batch").speeds for each in (mixed(), kind(horizon=4, noise=0.4))
    )
    np.testing.assert_array_equal(mixed_speeds, expected)
    other = type("Gap", (), {"sumo_human_gap": 3.0})
    assert "sumo_human_gap is not allowed" in statistically_unsupported_reason(type("Hum", (other, kind), {})())


@pytest.mark.parametrize(("name", "field"), [("lenght", "length"), ("horizn", "horizon"), ("vehicle", "vehicles")])
def test_a_misspelt_value_in_the_body_of_a_class_or_of_its_mixin_is_refused(name: str, field: str) -> None:
    message = f"class .*: {name}: unknown name; did you mean '{field}'"
    with pytest.raises(InputError, match=message):
        type("Typo", (Ring,), {name: 50})
    with pytest.raises(InputError, match=message):
        type("Typo", (type("Help", (), {name: 50}), Ring), {})
    kept: Any = type("Own", (Ring,), {name: 50, "__annotations__": {name: int}})
    assert getattr(kept(), name) == 50  # a further setting
