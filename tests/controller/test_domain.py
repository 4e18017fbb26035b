from dataclasses import replace

import numpy as np
import pytest

from unjam.controller import make_driver, shipped_file
from unjam.controller.domain import notes_on_controllers, other_road, other_step, outside_domain, road_of
from unjam.controller.file import read_controller
from unjam.drivers import IDM, LocalState
from unjam.scenarios import Ring, Scenario, make_scenario, scenario_recipe

TRAINED = {"scenario": scenario_recipe(Ring())}


@pytest.mark.parametrize(
    ("road", "words"),
    [
        (Ring(), ""),
        (make_scenario("ring", {"length": 230, "horizon": 100}), ""),
        (Ring(length=(260, 280)), "was trained on another ring: length 260-280 (there 220-270)"),
        (Ring(warmup=6000, vehicles=20), "warmup 6000 (there 0), vehicles 20 (there 22)"),
        (make_scenario("ring", {"safety.active": False}), ": safety.active False (there True)"),
        (make_scenario("merge"), "was trained on the ring, not on the merge"),
    ],
)
def test_another_road_than_that_of_the_training_is_told(road: Scenario, words: str) -> None:
    told = other_road(TRAINED, scenario_recipe(road))
    assert told.endswith(words) if words else told == ""


def test_a_tuned_controller_was_not_trained_and_an_unknown_road_is_no_other() -> None:
    told = other_road({**TRAINED, "tuned": {}}, scenario_recipe(make_scenario("merge")))
    assert told == "was tuned on the ring, not on the merge"
    assert other_road({}, scenario_recipe(Ring())) == ""
    assert road_of(TRAINED) == "ring, length 220-270, vehicles 22, cavs 1, warmup 0"


def test_states_outside_of_the_certified_domain_are_counted() -> None:
    controller = read_controller(shipped_file("ring-best"))
    inside = LocalState(*(np.full(4, value) for value in (3.5, 3.5, 6.0, 3.5, 6.0, 1.0, 230.0)))
    assert outside_domain(controller, inside) == 0.0
    far = inside._replace(leader_gap=np.array([6.0, 6.0, 900.0, 6.0]))
    assert outside_domain(controller, far) == 0.25
    assert outside_domain(replace(controller, parts={}), far) == 0.0


def test_only_controllers_on_another_road_get_a_note() -> None:
    road = scenario_recipe(make_scenario("figure-eight"))
    names = ["pi", "human", "unjam:figure-eight-tuned", "unjam:ring-tuned"]
    assert notes_on_controllers(road, names, {}) == [
        "unjam:ring-tuned was tuned on the ring, not on the figure-eight"
    ]


def test_a_controller_that_counts_time_otherwise_gets_a_note() -> None:
    loop = make_driver("unjam:best", 0.1).inner["loop"]
    slow = scenario_recipe(make_scenario("ring-jammed", {"steps_per_decision": 10}))
    assert other_step(loop, slow) == "counts time in steps of 0.1 s, and decisions here take 1 s"
    assert other_step(loop, scenario_recipe(make_scenario("ring-jammed"))) == ""
    assert other_step(IDM(), slow) == ""
