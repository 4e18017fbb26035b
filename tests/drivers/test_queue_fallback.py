"""The leader of a queue falls back to another driver if and only if the queue breaks."""

from pathlib import Path

import numpy as np
import pytest

from unjam.controller import load_controller, make_driver
from unjam.controller.file import controller_bytes
from unjam.drivers import Constant, PISaturation, check_driver
from unjam.drivers.driver import scalar_memory
from unjam.drivers.local_state import COMMON_FIELDS, LocalState, state_of_ones
from unjam.drivers.registry import driver_from_recipe, driver_recipe
from unjam.drivers.road_experts import BROKEN_LAP_FRACTION, GATHERED_LAP_FRACTION
from unjam.drivers.safety import INSTANT_ACTUATOR
from unjam.drivers.wrappers import MAX_GATHERING_TIME, QueueFallback
from unjam.measures.metrics import measure
from unjam.physics.idm import IDMParameters
from unjam.scenarios import FigureEight
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend

LEADS, GAVE_UP = 0.1, 0.2
LAP = 400.0
STEP = 10.0
"""between two decisions [s]: four of them take longer than all may need to gather"""
EACH = QueueFallback(Constant(acceleration=LEADS), Constant(acceleration=GAVE_UP), STEP)
TWO = QueueFallback(make_driver("pacer:use_tuned=true", 0.1), PISaturation(), 0.1)


def observation(*free: float) -> LocalState:
    """Return the observations of CAVs with these free shares of the lap ahead."""
    everything = state_of_ones(COMMON_FIELDS, np.ones, rows=len(free))
    gap = LAP * np.array(free)
    return everything._replace(leader_gap=gap, loop_length=np.full(len(free), LAP))


@pytest.mark.parametrize(
    ("free", "driven"),
    [
        ((0.1, 0.3, 0.6, 0.6, 0.46, 0.6), (LEADS,) * 6),  # all gather, and stay so
        ((0.1, 0.6, 0.44, 0.6, 0.6), (LEADS, LEADS, GAVE_UP, GAVE_UP, GAVE_UP)),  # the queue breaks
        ((0.1, 0.2, 0.3, 0.4, 0.6), (LEADS, LEADS, LEADS, GAVE_UP, GAVE_UP)),  # no vehicle gathers in time
    ],
)
def test_who_leads_gives_up_for_good_when_the_queue_does_not_hold(
    free: tuple[float, ...], driven: tuple[float, ...]
) -> None:
    assert BROKEN_LAP_FRACTION < 0.46 < GATHERED_LAP_FRACTION
    assert 3 * STEP <= MAX_GATHERING_TIME < 4 * STEP
    memory, plain = EACH.initial_memory(1), scalar_memory(EACH.initial_memory(1))
    for share, expected in zip(free, driven, strict=True):
        wanted, memory = EACH.act(observation(share), memory)
        alone, plain = EACH.act(observation(share).map(lambda values: float(values[0])), plain)
        assert (wanted.tolist(), alone) == ([expected], expected)


def test_each_car_gives_up_by_itself_and_the_other_law_begins_then() -> None:
    watching = QueueFallback(Constant(acceleration=LEADS), PISaturation(), STEP)
    memory = watching.initial_memory(2)
    driven: list[list[bool]] = []
    for look in ((0.6, 0.6), (0.6, 0.3), (0.3, 0.3)):
        wanted, memory = watching.act(observation(*look), memory)
        driven.append((wanted == LEADS).tolist())
    assert driven == [[True, True], [True, False], [False, False]]
    assert memory["fallback"]["count"].tolist() == [1.0, 2.0], "as long as each has driven by it"


def test_it_keeps_the_contract_of_drivers() -> None:
    check_driver(EACH)
    check_driver(TWO)


def test_it_is_made_again_from_its_recipe_and_from_its_file(tmp_path: Path) -> None:
    assert driver_from_recipe(*driver_recipe(TWO)) == TWO
    (tmp_path / "two.unjam").write_bytes(controller_bytes(TWO, {}))
    assert load_controller(tmp_path / "two.unjam") == TWO


def test_among_people_who_keep_longer_distances_giving_up_helps_and_among_others_nothing_changes(
    sumo: SumoBackend,
) -> None:
    for headway, helps in ((1.0, False), (1.5, True)):
        humans = IDMParameters(time_headway=headway)
        road = FigureEight(radius=(32, 32), humans=humans, actuator=INSTANT_ACTUATOR)
        led, given_up = (
            measure(run_episode(road, driver, (3,), backend=sumo))["mean_speed_second_half"]
            for driver in (TWO.primary, TWO)
        )
        assert (given_up > led + 0.2) if helps else (given_up == led)
