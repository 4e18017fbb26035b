"""What to know before trusting a drive: controllers on a road that they were not made for."""

from collections.abc import Iterable

from unjam.controller import SHIPPED, shipped_file
from unjam.controller.domain import controller_of, other_road, outside_domain
from unjam.scenarios import scenario_recipe
from unjam.scenarios.scenario import Scenario
from unjam.worlds.record import Episode

MUCH = 0.05
"""share of decisions outside of what a controller is certified for, from which a note says so"""


def notes_on_controllers(scenario: Scenario, names: Iterable[str], shown: dict[str, Episode]) -> list[str]:
    """Return a line for each controller that was not made for this road, or met there what it never had."""
    recipe, notes = scenario_recipe(scenario), []
    for name in names:
        shipped = shipped_file(name.removeprefix(SHIPPED)) if name.startswith(SHIPPED) else None
        controller = controller_of(name, shipped)
        if controller is None:
            continue
        if other := other_road(controller.manifest, recipe):
            notes.append(f"{name} {other}")
        states = [each.states for each in shown[name].trajectories] if name in shown else []
        share = max((outside_domain(controller, each) for each in states), default=0.0)
        if share > MUCH:
            notes.append(f"{name} was outside of its certified domain in {100 * share:.0f} % of decisions")
    return notes
